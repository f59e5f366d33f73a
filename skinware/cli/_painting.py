"""Colours and characters for the codes of :mod:`._heat_map`. Pure functions: codes to segments and text of rich."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import numpy.typing as npt
from rich.color import Color
from rich.color_triplet import ColorTriplet
from rich.segment import Segment
from rich.style import Style
from rich.text import Text

from skinware._printable import printable
from skinware.cli import _heat_map as heat
from skinware.cli._format import figure_text
from skinware.cli._heat_map import BACKGROUND, LEVELS, Label
from skinware.cli._palette import Palette

MARK_CHARACTERS = {
    heat.FRESH: " ",
    heat.STALE: "░",
    heat.OUT_OF_RANGE: "^",
    heat.SUSPECT: "?",
    heat.UNHEALTHY: "+",
    heat.NO_ACK: "!",
    heat.MASKED: "-",
    heat.NEVER_SEEN: "·",
    heat.NOT_CONNECTED: "x",
    heat.UNMOVED: "□",
}
MARK_NAMES = {
    heat.STALE: "stale",
    heat.OUT_OF_RANGE: "out of range",
    heat.SUSPECT: "suspect",
    heat.UNHEALTHY: "unhealthy",
    heat.NO_ACK: "no answer",
    heat.MASKED: "switched off",
    heat.NEVER_SEEN: "never seen",
    heat.NOT_CONNECTED: "not connected",
    heat.UNMOVED: "never moved",
}


def colour_of(code: int, palette: Palette) -> ColorTriplet:
    """What a sensor of this code looks like where there is no room for its character."""
    mark, level = divmod(code, LEVELS)
    if mark == heat.UNMOVED:
        return palette.unmoved
    if mark >= heat.FIRST_WITHOUT_VALUE:
        return palette.no_value
    return palette.stale[level] if mark == heat.STALE else palette.ramp[level]


def changed_lines(before: npt.NDArray[np.uint8], now: npt.NDArray[np.uint8]) -> list[int]:
    """Lines in which any pixel has another code than before; both are (2 * lines, columns) uint8."""
    differs = (before != now).any(axis=1)
    lines: list[int] = np.flatnonzero(differs[0::2] | differs[1::2]).tolist()
    return lines


def segments_of(
    upper: npt.NDArray[np.uint8], lower: npt.NDArray[np.uint8], labels: Sequence[Label], palette: Palette
) -> list[Segment]:
    """One line of a map.

    Args:
        upper: (columns,) uint8, codes of the pixels in the upper half of the line.
        lower: (columns,) uint8, codes of those in the lower half.
        labels: words to put in.
        palette: the terminal's.
    """
    pairs = upper.astype(np.uint16) << 8 | lower
    edges = (np.flatnonzero(pairs[1:] != pairs[:-1]) + 1).tolist()
    segments = []
    for start, end in zip([0, *edges], [*edges, len(pairs)], strict=True):
        character, style = _cell(int(pairs[start]), palette)
        segments.append(Segment(character * (end - start), style))
    for label in labels:
        end = label.column + len(label.text)
        before, _, after = Segment.divide(segments, [label.column, end, max(end, len(pairs))])
        segments = [*before, Segment(printable(label.text), _MARK if label.is_mark else _LABEL), *after]
    return segments


_LABEL = Style.parse("#8a8a8a")
_MARK = Style.parse("bold #ffffff on #27548a")


@cache
def _cell(pair: int, palette: Palette) -> tuple[str, Style]:
    """Character and colours of one cell: its upper code in the high byte, its lower one in the low."""
    upper, lower = divmod(pair, 256)
    if palette.characters:
        return _character(lower if upper == BACKGROUND else upper, palette), Style.null()
    if upper != lower and BACKGROUND in (upper, lower):
        return ("▀", _style(upper, palette)) if lower == BACKGROUND else ("▄", _style(lower, palette))
    if upper != lower:
        return "▀", Style(color=_colour(colour_of(upper, palette)), bgcolor=_colour(colour_of(lower, palette)))
    if upper == BACKGROUND:
        return " ", Style.null()
    ground = colour_of(upper, palette)
    mark, level = divmod(upper, LEVELS)
    ink = palette.ramp[level] if mark == heat.STALE else _ink(ground)
    return _character(upper, palette), Style(color=_colour(ink), bgcolor=_colour(ground))


def _character(code: int, palette: Palette) -> str:
    if code == BACKGROUND:
        return " "
    mark, level = divmod(code, LEVELS)
    return palette.characters[level] if palette.characters and mark == heat.FRESH else MARK_CHARACTERS.get(mark, "?")


def _ink(colour: ColorTriplet) -> ColorTriplet:
    """Black or white, whichever can be read on a colour."""
    red, green, blue = colour
    return ColorTriplet(0, 0, 0) if 0.3 * red + 0.59 * green + 0.11 * blue > 110 else ColorTriplet(255, 255, 255)


def _colour(triplet: ColorTriplet) -> Color:
    return Color.from_triplet(triplet)


def _style(code: int, palette: Palette) -> Style:
    return Style(color=_colour(colour_of(code, palette)))


def scale_text(values: Sequence[float], unit: str, palette: Palette) -> Text:
    """The colours, from that of the least level to that of the highest.

    Args:
        values: of the lowest level, the middle one if it is to be said, the highest.
        unit: of the values.
        palette: the terminal's.
    """
    first, *others = map(figure_text, values)
    text = Text(f"{first} ", no_wrap=True)
    half = LEVELS // len(others)
    for number, other in enumerate(others):
        for level in range(number * half, (number + 1) * half, 2):
            if palette.characters:
                text.append(palette.characters[level + 1])
            else:
                left, right = palette.ramp[level : level + 2]
                text.append("▌", Style(color=_colour(left), bgcolor=_colour(right)))
        text.append(f" {other}{' ' * (number + 1 < len(others))}")
    return text.append(f" {unit}".rstrip())


def marks_text(marks: npt.NDArray[np.uint8], palette: Palette) -> Text:
    """How many sensors are fresh, and which of the other marks are to be seen, with what they mean.

    Args:
        marks: (n,) uint8, marks of all sensors that are drawn.
        palette: the terminal's.
    """
    counts = np.bincount(marks, minlength=len(MARK_CHARACTERS)).tolist()
    fresh = counts[heat.FRESH] + counts[heat.UNMOVED]  # a stuck one comes in time, too
    text = Text(f"{fresh} fresh", no_wrap=True, overflow="ellipsis")
    for mark, name in MARK_NAMES.items():
        if counts[mark]:
            level = LEVELS // 2 if mark < heat.FIRST_WITHOUT_VALUE else 0
            character, style = _cell((mark * LEVELS + level) * 0x101, palette)
            text.append("  ")
            text.append(character, style)
            text.append(f" {counts[mark]} {name}")
    return text
