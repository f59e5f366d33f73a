"""Numbers, times and tables as people read them."""

from __future__ import annotations

from collections.abc import Sequence

NO_VALUE = "-"


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


def plural(count: int, what: str, several: str = "") -> str:
    """``1 patch``, ``4 patches``."""
    return f"{count_text(count)} {what if count == 1 else several or what + 's'}"


def table(titles: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1) -> list[str]:
    """Aligned columns under their titles; the first ``left`` of them begin left, the others end right."""
    lines = [list(titles), *(list(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(titles))]
    return [
        "  ".join(
            text.ljust(width) if column < left else text.rjust(width)
            for column, (text, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    ]
