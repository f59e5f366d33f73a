"""What every command has."""

from __future__ import annotations

import importlib
import logging
import re
from importlib.metadata import version
from pathlib import Path

import click
import pytest

from skinware import Namespace
from skinware.cli._command import EXIT_FAILED, EXIT_USAGE, exit_status
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin
from tests.commands import COMMANDS, refused, running


def command_of(name: str) -> click.Command:
    command = importlib.import_module(COMMANDS[name]).command
    assert isinstance(command, click.Command)
    return command


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_it_tells_its_version(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command_of(name), ["--version"]) == 0
    assert capsys.readouterr().out == f"{name} {version('skinware')}\n"


def test_warnings_begin_with_the_name_of_the_command() -> None:
    assert exit_status(command_of("skin-record"), ["--version"]) == 0
    record = logging.LogRecord("skinware", logging.WARNING, "", 0, "cannot be read", None, None)
    assert logging.lastResort is not None
    assert logging.lastResort.format(record) == "skin-record: cannot be read"


@pytest.mark.parametrize("name", ["skin-config", "skin-import"])
def test_alone_it_prints_its_help_where_it_needs_to_be_told_what_to_do(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_status(command_of(name), []) == 2
    assert f"Usage: {name} " in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_an_unknown_option_is_wrong_usage(name: str) -> None:
    wrong = refused(name, "--nonesuch")
    assert (wrong.returncode, "--nonesuch" in wrong.stderr) == (EXIT_USAGE, True)


MISSING = {
    "skin-bridge": ["serve --robot icub --tls {gone}", "join icub --connect tcp/127.0.0.1:7448 --tls {gone}"],
    "skin-calibrate": ["check {gone}"],
    "skin-calm": ["torso --config {gone}", "torso --regions {gone}"],
    "skin-config": ["nonesuch0 versions --config {gone}", "nonesuch0 versions --driver {gone}.py"],
    "skin-convert": ["{gone} --to npz"],
    "skin-doctor": ["{gone}"],
    "skin-driver": [
        "--config {gone}",
        "--bus virtual --geometry {gone}",
        "--bus virtual --driver {gone}.py",
        "--bus replay:{gone}",
    ],
    "skin-emulate": ["--bus pty --driver {gone}.py"],
    "skin-import": ["icub {gone}"],
    "skin-prove": ["--captured {gone}"],
    "skin-recover": ["{gone}"],
    "skin-regions": ["list {gone}"],
    "skin-replay": ["{gone}"],
    "skin-view": ["--links {gone}"],
}
"""Every way in which a command names a file that has to be there."""
NO_FILE_IN = {"skin-dump", "skin-find", "skin-info", "skin-new", "skin-press", "skin-record", "skin-top"}
"""Commands that read no file, or take a missing one for an empty one."""


def test_every_command_is_asked_for_a_missing_file() -> None:
    assert MISSING.keys() | NO_FILE_IN | {"skin-wipe"} == COMMANDS.keys()


@pytest.mark.parametrize("line", [f"{name} {rest}" for name, rests in MISSING.items() for rest in rests])
def test_a_missing_file_is_wrong_usage(line: str, tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    done = refused(*line.format(gone=gone).split())
    assert done.returncode == EXIT_USAGE, done.stderr
    assert str(gone) in done.stderr


@pytest.mark.parametrize(
    "line",
    [
        "skin-config torzo versions --timeout 0.1",
        "skin-dump torzo -n 1",
        "skin-info torzo",
        "skin-info torzo --health",
        "skin-press 0 0 0",
        "skin-wipe torzo",
    ],
)
@pytest.mark.parametrize("elsewhere", [False, True])
def test_an_unknown_driver_or_namespace_is_a_failure(line: str, elsewhere: bool) -> None:
    done = refused(*line.split(), *(["--namespace", "nonesuch"] if elsewhere else []))
    assert done.returncode == EXIT_FAILED, done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.thorough
def test_calm_names_the_driver_that_may_be_meant(namespace: Namespace) -> None:
    with FakeSkin("torso"), running("skin-calm", "torzo") as calm:
        wait_until(lambda: "There are" in calm.errors)
        assert (
            f"waiting for driver 'torzo' in '{namespace.name}'; did you mean 'torso'? There are: torso" in calm.errors
        )


def test_calmed_drivers_of_another_namespace_have_a_place_of_their_own() -> None:
    assert Namespace("default").calm_name == "calm"
    assert Namespace("lab").calm_name == "lab-calm"


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_its_help_names_no_other_status(name: str) -> None:
    for line in refused(name, "--help").stdout.split("Exit status:")[1:]:
        assert set(re.findall(r"[,:] (\d) ", ":" + line.split("\n\n")[0])) <= {"0", "1", "2"}
