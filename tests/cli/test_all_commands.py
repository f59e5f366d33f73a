"""What every command has."""

from __future__ import annotations

import importlib
from importlib.metadata import entry_points, version

import click
import pytest

from skinware.cli._command import exit_status

COMMANDS = {e.name: e.module for e in entry_points(group="console_scripts") if e.name.startswith("skin-")}


def command_of(name: str) -> click.Command:
    command = importlib.import_module(COMMANDS[name]).command
    assert isinstance(command, click.Command)
    return command


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_it_tells_its_version(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command_of(name), ["--version"]) == 0
    assert capsys.readouterr().out == f"{name} {version('skinware')}\n"


@pytest.mark.parametrize("name", ["skin-config", "skin-import"])
def test_alone_it_prints_its_help_where_it_needs_to_be_told_what_to_do(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_status(command_of(name), []) == 2
    assert f"Usage: {name} " in capsys.readouterr().err
