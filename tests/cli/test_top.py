from __future__ import annotations

import json
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from skinware import Namespace
from skinware.cli import top
from skinware.cli._command import exit_status
from skinware.cli.top import command
from skinware.tactile.regions import Region, put_region
from tests.cli.fake_skin import FakeSkin, fake_structure
from tests.commands import BIN, PATIENCE_S


def lines(capsys: pytest.CaptureFixture[str], *arguments: str) -> list[str]:
    assert exit_status(command, list(arguments)) == 0
    return capsys.readouterr().out.splitlines()


def test_a_line_per_driver(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(1, 2)) as skin, FakeSkin("b"):
        skin.publish(2)
        first, second = lines(capsys, "--plain", "-T", "0.01")
    assert first.startswith("a  ")
    assert " Hz  age " in first
    assert "sensors 24 (fresh 24, stale 0)  patches 1 live  dropped 0  orphans 0" in first
    assert second == "b  starting, no sample yet  sensors 768"


def test_plain_is_what_pipes_get(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a"):
        assert lines(capsys, "-T", "0.01") == ["a  starting, no sample yet  sensors 768"]


def test_nobody_runs(capsys: pytest.CaptureFixture[str], namespace: Namespace) -> None:
    assert lines(capsys, "--plain", "-T", "0.01") == [
        f"no driver runs in namespace {namespace.name!r}; start one: skin-driver --bus virtual"
    ]
    assert lines(capsys, "--json", "-T", "0.01") == []


def test_drivers_that_are_named(capsys: pytest.CaptureFixture[str], namespace: Namespace) -> None:
    with FakeSkin("arm"), FakeSkin("leg"), FakeSkin("torso"):
        assert [line.split()[0] for line in lines(capsys, "torso", "arm", "-T", "0.01")] == ["arm", "torso"]
        (missing,) = lines(capsys, "torzo", "-T", "0.01")
    assert missing.startswith(
        f"no driver torzo runs in namespace {namespace.name!r}; did you mean 'torso'? There are: arm"
    )
    assert exit_status(command, ["my skin"]) == 2
    assert "name 'my skin'" in capsys.readouterr().err


def test_json(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(1, 2)) as skin:
        skin.publish(2)
        (line,) = lines(capsys, "--json", "-T", "0.01")
    told = json.loads(line)
    assert told.keys() == {
        "driver",
        "state",
        "rate_hz",
        "age_ms",
        "sensors",
        "status",
        "patches",
        "counters",
        "contacts",
    }
    assert (told["driver"], told["sensors"], told["status"]["fresh"]) == ("a", 24, 24)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-T", "nan"], "-T"),
        (["--nonsense"], "--nonsense"),
        (["--namespace", "a/b"], "namespace name 'a/b'"),
        (["a name"], "driver name 'a name'"),
        (["./walk.mcap"], "skin-top: ./walk.mcap is a recording, and runs nowhere: skin-view ./walk.mcap shows it"),
    ],
)
def test_mistakes(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command, ["--plain", *arguments]) == 2
    assert words in (errors := capsys.readouterr().err)
    assert "Traceback" not in errors


def test_a_namespace_that_cannot_be_read_fails(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a"):
        namespace.path.chmod(0o777)
        assert exit_status(command, ["--plain", "-T", "5"]) == 1
        assert "can be written by others" in capsys.readouterr().err
        namespace.path.chmod(0o2750)


def test_without_the_extra_a_person_is_told_and_gets_plain_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(top, "are_terminals", lambda *_: True)
    monkeypatch.setattr(top, "find_spec", lambda _: None)
    with FakeSkin("a"):
        assert exit_status(command, ["-T", "0.01"]) == 0
    printed = capsys.readouterr()
    extra = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert f"{sys.executable} -m pip install '{extra['top'][0]}'" in printed.err
    assert printed.out.startswith("a  starting")


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_in_good_order(number: int) -> None:
    with FakeSkin("a"):
        process = subprocess.Popen([BIN / "skin-top"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdout is not None
        assert process.stdout.readline().startswith(b"a  starting")
        process.send_signal(number)
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, errors) == (0, b"")


@pytest.mark.thorough
def test_the_live_view_is_loaded_only_when_it_is_needed() -> None:
    code = "import sys, skinware.cli.top; assert not {'textual', 'rich'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_nothing_is_imported_between_the_first_look_and_its_lines(namespace: Namespace) -> None:
    code = (
        "import sys; from skinware import Namespace; from skinware.cli.top import show_lines;"
        "from skinware.views.live import Overview;"
        "Overview.look = lambda _: sys.exit('skinware.cli._top_rows' not in sys.modules);"
        f"show_lines(Namespace('{namespace.name}'), 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_region_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "regions.toml"
    put_region(file, Region("palm", uid=(1,)))
    assert exit_status(command, ["-T", "0", "--region", "palm", "--regions", str(file)]) == 0
    capsys.readouterr()
    for arguments, why in (
        (["--region", "plam", "--regions", str(file)], "no region 'plam'; there are: palm"),
        (["--regions", str(tmp_path / "none.toml")], "none.toml: No such file"),
        (["--plain", "--region", "palm"], "--plain goes without --region"),
        (["--json", "--type", "pressure"], "--json goes without --type"),
    ):
        assert exit_status(command, arguments) == 2
        assert why in capsys.readouterr().err
