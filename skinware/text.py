"""Numbers, times and tables as people read them: the text of every command and of every finding."""

from __future__ import annotations

from collections.abc import Sequence

NO_VALUE = "-"
_BETWEEN = "  "


def age_text(age_ns: int | float | None) -> str:
    """Return a duration with its unit, in about two figures: ``40 us``, ``0.6 ms``, ``12 ms``, ``3.4 s``, ``5 min``."""
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
    """Return a rate with its unit: ``0.25 Hz``, ``20.0 Hz``, ``1000 Hz``."""
    if rate_hz is None:
        return NO_VALUE
    if 0 < rate_hz < 1:
        return f"{rate_hz:.2f} Hz"
    return f"{rate_hz:.1f} Hz" if rate_hz < 999.95 else f"{rate_hz:.0f} Hz"


def count_text(count: int | None) -> str:
    """Return a count with its thousands separated: ``30,848``."""
    return NO_VALUE if count is None else f"{count:,}"


def figure_text(value: float, digits: int = 4) -> str:
    """Return a measured value to ``digits`` significant digits, large ones whole: ``0.012``, ``150``, ``20,000``."""
    return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


def plural(count: int, what: str, several: str = "") -> str:
    """Return a count and its noun: ``1 patch``, ``4 patches``."""
    return f"{count_text(count)} {what if count == 1 else several or what + 's'}"


def table(
    titles: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1, width: int | None = None
) -> list[str]:
    """Return the lines of a table with aligned columns under their titles.

    Args:
        titles: of the columns.
        rows: cells, as many in a row as there are titles.
        left: number of columns, from the first, that are aligned to the left; the others are aligned to the right.
        width: columns that do not fit in it continue in a table below, which repeats the first column.
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
