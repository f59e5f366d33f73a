"""The picture of docs/benchmarks.md: what frames cost here, beside what they cost elsewhere.

Usage: python tools/pictures/benchmarks.py FILE.svg

The figures are those of the page's tables, copied here by whoever repeats a measurement; a test holds both together.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple


class Bar(NamedTuple):
    """Who, the figure as the page has it, and its value in the unit of its group."""

    who: str
    text: str
    value: float
    is_ours: bool = False


GROUPS: dict[str, list[Bar]] = {
    "Received and decoded on one core, frames/s (more is better)": [
        Bar("recvmmsg alone, the limit", "2,176,588", 2.18),
        Bar("skinware", "1,765,286", 1.77, True),
        Bar("the specification in numpy", "974,731", 0.97, True),
        Bar("python-can Notifier", "143,371", 0.14),
    ],
    "A driver of 768 sensors at 20 Hz, % of a core (less is better)": [
        Bar("a C loop that only receives", "0.44", 0.44),
        Bar("skinware", "0.75", 0.75, True),
    ],
    "240,000 frames/s of 30 buses, % of a core (less is better)": [
        Bar("a C loop that only receives", "12.2", 12.2),
        Bar("skinware", "10.1", 10.1, True),
    ],
    "A serial line of 3 Mbaud, % of a core (less is better)": [
        Bar("a C loop that only reads", "0.42", 0.42),
        Bar("skinware", "0.77", 0.77, True),
    ],
    "Age of 30,848 sensors when a reader has them, 100 Hz, µs (less is better)": [
        Bar("a C program of skinware.h", "49", 49),
        Bar("skinware", "46", 46, True),
        Bar("iceoryx2", "73", 73),
        Bar("zenoh", "245", 245),
    ],
}

_WIDTH, _LEFT, _RIGHT, _ROW, _GAP, _TOP = 860, 260, 90, 26, 22, 20
_OURS, _OTHERS, _INK = "#15803d", "#94a3b8", "#1f2933"


def picture() -> str:
    """The SVG."""
    rows: list[str] = []
    y = _TOP
    for title, bars in GROUPS.items():
        y += 18
        rows.append(f'<text x="20" y="{y}" font-weight="bold" fill="{_INK}">{title}</text>')
        y += 10
        longest = max(bar.value for bar in bars)
        for bar in bars:
            width = round((_WIDTH - _LEFT - _RIGHT) * bar.value / longest, 1)
            colour = _OURS if bar.is_ours else _OTHERS
            middle = y + _ROW - 9
            rows.append(f'<text x="{_LEFT - 10}" y="{middle}" text-anchor="end" fill="{_INK}">{bar.who}</text>')
            rows.append(f'<rect x="{_LEFT}" y="{y + 3}" width="{width}" height="{_ROW - 6}" rx="3" fill="{colour}"/>')
            rows.append(f'<text x="{_LEFT + width + 8}" y="{middle}" fill="{_INK}">{bar.text}</text>')
            y += _ROW
        y += _GAP
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {y}" font-family="sans-serif" font-size="14"'
        ' role="img">\n<title>What frames cost in skinware, and elsewhere</title>\n'
        f'<rect width="{_WIDTH}" height="{y}" rx="8" fill="#ffffff"/>\n'
    )
    return head + "\n".join(rows) + "\n</svg>\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(picture(), encoding="utf-8")
