"""Numbers, times, states and tables as people read them."""

from __future__ import annotations

import shutil
import sys

import click

from skinware.cli._terminal import repaint

NOT_FRESH = "not fresh"
"""Shown instead of ``live`` where frames come, but not one sensor of them is fresh."""


def state_shown(state: str, fresh: int, sensors: int) -> str:
    """A state for people: nothing is called live of which no sensor is fresh."""
    return NOT_FRESH if state == "live" and sensors and not fresh else state


def terminal_width() -> int | None:
    """Columns of the terminal on stdout; None where there is none, and lines may be as long as they are."""
    is_terminal = sys.stdout is not None and sys.stdout.isatty()
    return shutil.get_terminal_size().columns if is_terminal else None


def wrapped(line: str, width: int | None) -> list[str]:
    """A line that may have colours, broken where it is wider than ``width``; what follows is indented further."""
    if width is None or len(click.unstyle(line)) <= width:
        return [line]
    indent = line[: len(line) - len(line.lstrip())]
    first, *words = line.lstrip().split(" ")
    lines = [indent + first]
    for word in words:
        if len(click.unstyle(lines[-1])) + 1 + len(click.unstyle(word)) <= width:
            lines[-1] += f" {word}"
        elif word:
            lines.append(f"{indent}    {word}")
    return lines


def redraw(lines: list[str]) -> None:
    """Put lines in the place of what is on the terminal, without flicker; what does not fit is cut."""
    height = shutil.get_terminal_size().lines - 1
    if len(lines) > height:
        lines = [*lines[: height - 1], f"... {len(lines) - height + 1} more lines; make the window higher"]
    repaint(lines)
