"""``skin`` lists every command, runs any of them, and completes their names and options."""

from __future__ import annotations

import json
import os
import subprocess
import tomllib
from pathlib import Path

import pytest

from skinware.cli._command import exit_status
from skinware_drivers.cli import skin
from tests.commands import BIN, run

PROJECT = Path(__file__).parents[2]


def test_every_installed_command_is_listed_with_its_module() -> None:
    scripts = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts.pop("skin") == "skinware_start:skinware_drivers.cli.skin.main"
    assert {f"skin-{name}": f"skinware_start:{entry.module}.main" for name, entry in skin.COMMANDS.items()} == scripts


def test_alone_it_lists_them_in_groups_with_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(skin.command, []) == 0
    lines = capsys.readouterr().out.splitlines()
    for title, group in skin.GROUPS.items():
        begin = lines.index(f"{title}:") + 1
        assert [line.split(maxsplit=1) for line in lines[begin : begin + len(group)]] == [
            [name, entry.summary] for name, entry in group.items()
        ]


def test_an_unknown_command_is_an_error_with_the_nearest_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(skin.command, ["tpo"]) == 2
    assert "no command 'tpo'; did you mean 'top'?" in capsys.readouterr().err


@pytest.mark.thorough
def test_a_command_runs_as_by_its_own_name() -> None:
    joined, alone = run("skin", "info", "--json"), run("skin-info", "--json")
    assert (joined.returncode, joined.stderr) == (alone.returncode, alone.stderr)
    assert json.loads(joined.stdout).keys() == json.loads(alone.stdout).keys()
    wrong = run("skin", "info", "--jsn")
    assert (wrong.returncode, wrong.stderr.split()[1]) == (2, "skin-info")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("program", "words", "found"),
    [
        ("skin", "skin re", "record"),
        ("skin", "skin top --na", "--namespace"),
        ("skin-top", "skin-top --na", "--namespace"),
        ("skin-driver", "skin-driver --listen", "--listen-only"),
        ("skin-record", "skin-record --ou", "--output"),
    ],
)
def test_names_and_options_are_completed(program: str, words: str, found: str) -> None:
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    environment = os.environ | asked | {f"_{program}_COMPLETE".upper().replace("-", "_"): "bash_complete"}
    answer = subprocess.run([BIN / program], env=environment, capture_output=True, text=True)
    assert f"plain,{found}" in answer.stdout.splitlines()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_names_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(skin.command, ["completion", shell]) == 0
    script = capsys.readouterr().out
    for name in ("skin", *(f"skin-{each}" for each in skin.COMMANDS)):
        assert f"_{name}_COMPLETE={shell}_complete".upper().replace("-", "_").rpartition("=")[0] in script
    if shell == "bash":
        subprocess.run(["bash", "-n"], input=script, text=True, check=True)
