"""skin-new: which names it takes, and that it makes all of a package or nothing. What it makes: tests/outside."""

from __future__ import annotations

import subprocess
import tomllib
from pathlib import Path

import pytest

import skinware_drivers
from skinware.cli._command import exit_status
from skinware.errors import ConfigurationError, SkinwareError
from skinware_drivers.cli import new
from skinware_drivers.cli.new import check_name, command, make_package
from tests.commands import BIN

TRANSPORTS = ["can", "serial", "modbus", "tcp", "virtual"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("My-Finger", "how about 'my_finger'"),
        ("MyFinger", "how about 'my_finger'"),
        ("9lives", "beginning with a letter$"),
        ("", "beginning with a letter$"),
        ("../up", "how about 'up'"),
        ("x" * 21, "21 letters"),
        ("lambda", "a word of Python"),
        ("roboskin", r"there is driver 'roboskin' already \(skinware_drivers"),
        ("json", "there is a Python package 'json' already"),
        ("numpy", "there is a Python package 'numpy' already"),
    ],
)
def test_names_that_cannot_be_are_refused_with_a_reason(name: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        check_name(name)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_package_says_its_name_wherever_it_must(transport: str, tmp_path: Path) -> None:
    made = make_package("left_hand", transport, tmp_path)
    folder = tmp_path / "left_hand"
    assert sorted(path for path in folder.rglob("*") if path.is_file()) == sorted(folder / path for path in made)
    assert {str(path) for path in made} >= {"pyproject.toml", ".github/workflows/ci.yml", "tests/test_left_hand.py"}
    points = tomllib.loads((folder / "pyproject.toml").read_text())["project"]["entry-points"]
    assert points["skinware.drivers"] == {"left_hand": "left_hand.driver:LeftHandDriver"}
    assert points["skinware.emulators"] == {"left_hand": "left_hand.emulator:EmulatedLeftHand"}
    for path in made:
        text = (folder / path).read_text()
        assert "$name" not in text
        assert "$Class" not in text
        assert "${Class}" not in text
    assert "${{ matrix.python }}" in (folder / ".github/workflows/ci.yml").read_text()


@pytest.mark.parametrize("make", [Path.mkdir, Path.touch])
def test_what_is_there_is_left_alone(make: object, tmp_path: Path) -> None:
    assert callable(make)
    make(tmp_path / "hand")
    with pytest.raises(ConfigurationError, match=r"hand already exists; nothing was changed"):
        make_package("hand", "can", tmp_path)
    assert [path.name for path in tmp_path.rglob("*")] == ["hand"]


def test_nothing_is_left_of_a_package_that_could_not_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[Path] = []
    write_text = Path.write_text

    def full_disk(path: Path, text: str) -> int:
        if len(written) == 5:
            raise OSError(28, "No space left on device")
        written.append(path)
        return write_text(path, text)

    monkeypatch.setattr(Path, "write_text", full_disk)
    with pytest.raises(SkinwareError, match=r"cannot make .*hand: No space left on device"):
        make_package("hand", "can", tmp_path)
    assert len(written) == 5
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("name", ["q", "the_longest_of_names"])
def test_what_is_made_is_clean_whatever_its_name(transport: str, name: str, tmp_path: Path) -> None:
    make_package(name, transport, tmp_path)
    for arguments in (["check", "--no-cache"], ["format", "--check", "--no-cache"]):
        done = subprocess.run([BIN / "ruff", *arguments], cwd=tmp_path / name, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


def test_every_template_is_used() -> None:
    folder = Path(skinware_drivers.__file__).parent / "templates"
    found = {(path.parent.name, path.name) for path in folder.rglob("*") if path.is_file()}
    used = {("common", f"{name}.template") for name in new._COMMON}
    used |= {(part, f"{name}.template") for part in TRANSPORTS for name in new._OF_TRANSPORT}
    assert found == used


def test_the_command_tells_what_to_do_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert exit_status(command, ["palm", "--transport", "can"]) == 0
    told = capsys.readouterr().out
    assert "\n  pip install -e '.[test]'\n  pytest\n  skin-driver --driver palm --bus virtual\n" in told
    assert exit_status(command, ["palm", "--transport", "can"]) == 2
    assert "already exists" in capsys.readouterr().err
    assert exit_status(command, ["palm", "--transport", "usb"]) == 2
    assert exit_status(command, ["Palm", "--transport", "can"]) == 2
