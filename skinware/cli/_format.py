"""Numbers, times, states and tables as people read them."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence

import click

from skinware.cli._terminal import repaint

NO_VALUE = "-"
NOT_FRESH = "not fresh"
"""Shown instead of ``live`` where frames come, but not one sensor of them is fresh."""
_BETWEEN = "  "


def age_text(age_ns: int | float | None) -> str:
    """A duration with its unit, in two figures or so: ``40 us``, ``0.6 ms``, ``12 ms``, ``3.4 s``, ``5 min``."""
    if age_ns is None:
        return NO_VALUE
    milliseconds = max(0.0, age_ns / 1e6)
    if 0 < milliseconds < 0.0995:
        return f"{max(1, round(milliseconds * 1e3))} us"
    if milliseconds < 9.95:
        return f"{milliseconds:.1f} ms"
    if milliseconds < 999.5:
        return f"{milliseconds:.0f} ms"
    seconds = milliseconds / 1e3
    if seconds < 99.95:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 99.5 else f"{minutes / 60:.0f} h"


def rate_text(rate_hz: float | None) -> str:
    """A rate with its unit: ``0.25 Hz``, ``20.0 Hz``, ``1000 Hz``."""
    if rate_hz is None:
        return NO_VALUE
    if 0 < rate_hz < 1:
        return f"{rate_hz:.2f} Hz"
    return f"{rate_hz:.1f} Hz" if rate_hz < 999.95 else f"{rate_hz:.0f} Hz"


def count_text(count: int | None) -> str:
    """A count with its thousands set apart: ``30,848``."""
    return NO_VALUE if count is None else f"{count:,}"


def figure_text(value: float, digits: int = 4) -> str:
    """A measured value to so many digits, large ones whole: ``0.012``, ``150``, ``20,000``."""
    return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


def plural(count: int, what: str, several: str = "") -> str:
    """``1 patch``, ``4 patches``."""
    return f"{count_text(count)} {what if count == 1 else several or what + 's'}"


def state_shown(state: str, fresh: int, sensors: int) -> str:
    """A state for people: nothing is called live of which no sensor is fresh."""
    return NOT_FRESH if state == "live" and sensors and not fresh else state


def table(
    titles: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1, width: int | None = None
) -> list[str]:
    """Aligned columns under their titles; the first ``left`` of them begin left, the others end right.

    What is wider than ``width`` goes on in a table below, of which the first column is the same.
    """
    lines = [list(titles), *(list(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(titles))]
    parts = [[0]]
    for column in range(1, len(titles)):
        used = sum(widths[c] + len(_BETWEEN) for c in parts[-1])
        if width is not None and used + widths[column] > width and len(parts[-1]) > 1:
            parts.append([0])
        parts[-1].append(column)
    return [
        _BETWEEN.join(line[c].ljust(widths[c]) if c < left else line[c].rjust(widths[c]) for c in columns).rstrip()
        for columns in parts
        for line in lines
    ]


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
