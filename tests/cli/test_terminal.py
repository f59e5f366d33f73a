"""Text of others reaches a terminal without its control characters, through whatever command it is printed."""

from __future__ import annotations

import json
import logging
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
import numpy as np
import pytest
from rich.text import Text

import skinware
import skinware_drivers
from skinware import DriverWriter, Structure
from skinware.cli._command import exit_status
from skinware.cli._terminal import Formatter, echo, enter_pressed, json_text, overwrite, shown, style
from skinware.cli._top_app import _printable
from skinware.cli.top import show_lines
from skinware.memory.namespace import Namespace
from skinware.realtime import now_ns
from skinware.sensor_types import PRESSURE
from skinware.text import printable
from tests.cli.test_all_commands import command_of

HOSTILE = "\x1b]0;owned\x07\x1b[31m<b>[red]\x9b2J\u202eX"
SHORT = "\x1b[2J\u202ex"
UNPRINTABLE = re.compile(r"[^\n\t\r]")


def bad(text: str) -> set[str]:
    """Characters that a terminal must not have."""
    return {sign for sign in UNPRINTABLE.findall(text) if not sign.isprintable()}


def structure(sensors: int = 32) -> Structure:
    return Structure(
        types=[PRESSURE.measured(unit=SHORT)],
        buses=[HOSTILE],
        patch_name=[HOSTILE, "p" + SHORT],
        patch_bus=[0, 0],
        module_patch=[0, 1],
        module_kind=["triangle"] * 2,
        module_name=[SHORT, "m"],
        sensor_uid=np.arange(sensors),
        sensor_type=[PRESSURE.id] * sensors,
        sensor_module=np.arange(sensors) // 16,
        dtype="u2",
    )


@contextmanager
def hostile(namespace: Namespace) -> Iterator[None]:
    """A driver whose names are hostile."""
    with DriverWriter("arm", structure(), namespace=namespace, rate_hz=100) as writer:
        columns = writer.begin(from_last=True)
        columns["values"][:] = 5
        columns["status"][:] = 0
        columns["module_time_ns"][:] = now_ns()
        writer.commit(now_ns())
        del columns
        yield


COMMANDS = [
    ("skin-info",),
    ("skin-info", "--sensors", "arm"),
    ("skin-info", "--health"),
    ("skin-info", "--json"),
    ("skin-top", "-T", "0.1"),
    ("skin-dump", "arm", "-n", "1"),
    ("skin-dump", "arm", "-n", "1", "--json"),
    ("skin-doctor",),
    ("skin-doctor", "--json"),
    ("skin-info", "nobody" + SHORT),
    ("skin-press", "arm", "--patch", SHORT),
    ("skin-convert", SHORT, "x" + SHORT),
    ("skin-recover", "nothing" + SHORT),
    ("skin-replay", "nothing" + SHORT),
]


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_no_command_prints_control_characters_of_others(
    namespace: Namespace,
    arguments: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SKINWARE_NAMESPACE", namespace.name)
    with hostile(namespace):
        exit_status(command_of(arguments[0]), list(arguments[1:]))
    printed = capsys.readouterr()
    assert printed.out or printed.err
    assert not bad(printed.out + printed.err)


def test_the_lines_of_top_have_none(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    with hostile(namespace):
        show_lines(namespace, 0.05)
    assert "arm" in (out := capsys.readouterr().out)
    assert not bad(out)


def test_cells_and_lines_of_the_live_view_have_none() -> None:
    line = _printable(Text(HOSTILE))
    assert not isinstance(line, str)
    assert not bad(line.plain)
    assert not bad(str(_printable(HOSTILE)))


def test_own_colours_stay_and_those_of_others_go() -> None:
    text = style("own", fg="red") + "\x1b[32mother\x1b[0m\n"
    assert shown(text) == "\x1b[31mown\x1b[0m?[32mother?[0m\n"
    assert click.unstyle(style("own", fg="red", bold=True)) == "own"


def test_a_line_that_is_overwritten_has_none(capsys: pytest.CaptureFixture[str]) -> None:
    overwrite(HOSTILE)
    echo(HOSTILE, err=True)
    printed = capsys.readouterr()
    assert printed.out == f"\r{printable(HOSTILE)}\x1b[K"
    assert printed.err == f"{printable(HOSTILE)}\n"


def test_the_log_has_none() -> None:
    record = logging.LogRecord("x", logging.WARNING, "x", 1, "%s\nsecond", (HOSTILE,), None)
    assert Formatter("%(message)s").format(record) == f"{printable(HOSTILE)}\nsecond"


@pytest.mark.parametrize("text", [HOSTILE, "Füße 12 µm", "\U0001f916\U000e0001", "line\nline"])
def test_programs_have_every_character(text: str) -> None:
    made = json_text({"name": text})
    assert json.loads(made) == {"name": text}
    assert made.isprintable()


def test_there_is_one_way_to_print() -> None:
    others = [
        f"{path.name}: {line}"
        for package in (skinware, skinware_drivers)
        for path in Path(str(package.__file__)).parent.rglob("cli/*.py")
        if path.name != "_terminal.py"
        for line in path.read_text().splitlines()
        if re.search(r"click\.(echo|secho|style)\(|^\s*print\(", line) and "noqa: T201" not in line
    ]
    assert not others, "use echo and style of skinware.cli._terminal"


def test_enter_belongs_to_the_program_in_the_foreground(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = os.openpty()
    with open(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        assert not enter_pressed()
        os.write(ours, b"\n")
        monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
        assert not enter_pressed()
        monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())
        assert (enter_pressed(), enter_pressed()) == (True, False)
    os.close(ours)
