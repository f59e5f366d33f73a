"""``skin-doctor`` as people and scripts use it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import click
import pytest

from skinware import Namespace, PatchState
from skinware.cli._command import exit_status
from skinware_drivers.cli.doctor import command
from skinware_drivers.doctor.rules import RULES
from tests.cli.fake_skin import FakeSkin, publishing
from tests.commands import run

DOCS = Path(__file__).parents[2] / "docs"


def printed(capsys: pytest.CaptureFixture[str], *arguments: str, status: int) -> str:
    assert exit_status(command, list(arguments)) == status
    return capsys.readouterr().out


def test_the_worst_comes_first_and_everything_fits_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    skin = FakeSkin("torso")
    skin.break_some()
    skin.patch_state[1] = PatchState.EXPECTED
    with publishing(skin):
        text = printed(capsys, "-T", "0.2", status=1)
        data: dict[str, Any] = json.loads(printed(capsys, "-T", "0.2", "--json", status=1))
    lines = text.splitlines()
    assert re.match(r"\d errors?, .*\(namespace test-", lines[0])
    assert all(len(line) <= 80 or line.lstrip().startswith("$ ") for line in lines), text
    signs = [line[0] for line in lines if re.match(r"[✗!·] ", line)]
    assert signs == sorted(signs, key="✗!·".index)
    severities = [finding["severity"] for finding in data["findings"]]
    assert severities == sorted(severities, key=["error", "warning", "note"].index)
    assert {"looked at", "not looked at"} <= set(lines)
    for finding in data["findings"]:
        for command_line in finding["commands"]:
            assert f"            $ {command_line}" in lines
    assert "\x1b" not in text


def test_nothing_found_is_said_with_status_0(capsys: pytest.CaptureFixture[str]) -> None:
    with publishing(FakeSkin("torso")):
        text = printed(capsys, "-T", "0.2", status=0)
    assert text.startswith("nothing found  (namespace ")
    assert "torso: can0: live" in text


@pytest.mark.parametrize("name", ["nothing", "text", "folder", "mcap"])
def test_what_is_no_recording_is_one_clear_line(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text").write_text("not a recording\n" * 10)
    (tmp_path / "nothing").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    status = exit_status(command, [str(tmp_path / name)])
    error = capsys.readouterr().err
    if name == "mcap":  # the beginning of one, of which nothing is left
        assert status == 1
    else:
        assert status == 2
        assert "Traceback" not in error
        assert name in error


@pytest.mark.thorough
def test_bad_arguments() -> None:
    for arguments in (["-T", "soon"], ["-T", "-1"], ["no-such.mcap"], ["--namespace", "a/b"]):
        done = run("skin-doctor", *arguments)
        assert done.returncode == 2, arguments
        assert "Traceback" not in done.stderr


def test_it_changes_nothing_and_is_no_reader(namespace: Namespace) -> None:
    with publishing(FakeSkin("torso")):
        before = {path.name for path in namespace.path.rglob("*")}
        assert exit_status(command, ["-T", "0.1", "--json"]) == 0
        assert {path.name for path in namespace.path.rglob("*")} == before


def test_every_link_leads_to_a_section_that_is_there() -> None:
    links = {rule.see for rules in RULES.values() for rule in rules.values()}
    assert links
    for link in links:
        page, _, section = link.partition("#")
        text = (DOCS / page).read_text()
        headings = {_anchor(heading) for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE)}
        assert not section or section in headings, link


def _anchor(heading: str) -> str:
    plain = re.sub(r"[^\w\s-]", "", click.unstyle(heading).lower())
    return re.sub(r"\s", "-", plain.strip())
