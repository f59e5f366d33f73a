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

from skinware.cli import _heat_map as heat
from skinware.cli._heat_map import BACKGROUND, LEVELS, Label
from skinware.sensor_types import SensorType

_ANCHORS = ("#22304f", "#243c66", "#27548a", "#2a7f96", "#3aa882", "#8cc152", "#e6c440", "#f08c38", "#e8453c")
"""From no touch to full scale: the higher, the warmer and brighter."""
_GROUND = ColorTriplet(18, 18, 18)
_NO_VALUE = ColorTriplet(48, 48, 48)

MARK_CHARACTERS = {
    heat.FRESH: " ",
    heat.STALE: "░",
    heat.OUT_OF_RANGE: "^",
    heat.SUSPECT: "?",
    heat.NO_ACK: "!",
    heat.MASKED: "-",
    heat.NEVER_SEEN: "·",
    heat.NOT_CONNECTED: "x",
}
MARK_NAMES = {
    heat.STALE: "stale",
    heat.OUT_OF_RANGE: "out of range",
    heat.SUSPECT: "suspect",
    heat.NO_ACK: "no answer",
    heat.MASKED: "switched off",
    heat.NEVER_SEEN: "never seen",
    heat.NOT_CONNECTED: "not connected",
}


def _ramp() -> list[ColorTriplet]:
    anchors = [Color.parse(text).get_truecolor() for text in _ANCHORS]
    colours = []
    for level in range(LEVELS):
        place = level * (len(anchors) - 1) / (LEVELS - 1)
        first = min(int(place), len(anchors) - 2)
        colours.append(_mixed(anchors[first], anchors[first + 1], place - first))
    return colours


def _mixed(one: ColorTriplet, other: ColorTriplet, share: float) -> ColorTriplet:
    """A colour between two: ``one`` at share 0, ``other`` at 1."""
    return ColorTriplet(*(round(a + (b - a) * share) for a, b in zip(one, other, strict=True)))


RAMP = _ramp()
"""One colour per level."""


def colour_of(code: int) -> ColorTriplet:
    """What a sensor of this code looks like where there is no room for its character."""
    mark, level = divmod(code, LEVELS)
    if mark >= heat.FIRST_WITHOUT_VALUE:
        return _NO_VALUE
    return _mixed(RAMP[level], _GROUND, 0.6) if mark == heat.STALE else RAMP[level]


def changed_lines(before: npt.NDArray[np.uint8], now: npt.NDArray[np.uint8]) -> list[int]:
    """Lines in which any pixel has another code than before; both are (2 * lines, columns) uint8."""
    differs = (before != now).any(axis=1)
    lines: list[int] = np.flatnonzero(differs[0::2] | differs[1::2]).tolist()
    return lines


def segments_of(upper: npt.NDArray[np.uint8], lower: npt.NDArray[np.uint8], labels: Sequence[Label]) -> list[Segment]:
    """One line of a map.

    Args:
        upper: (columns,) uint8, codes of the pixels in the upper half of the line.
        lower: (columns,) uint8, codes of those in the lower half.
        labels: words to put in.
    """
    pairs = upper.astype(np.uint16) << 8 | lower
    edges = (np.flatnonzero(pairs[1:] != pairs[:-1]) + 1).tolist()
    segments = []
    for start, end in zip([0, *edges], [*edges, len(pairs)], strict=True):
        character, style = _cell(int(pairs[start]))
        segments.append(Segment(character * (end - start), style))
    for label in labels:
        end = label.column + len(label.text)
        before, _, after = Segment.divide(segments, [label.column, end, max(end, len(pairs))])
        segments = [*before, Segment(label.text, _LABEL), *after]
    return segments


_LABEL = Style.parse("#8a8a8a")


@cache
def _cell(pair: int) -> tuple[str, Style]:
    """Character and colours of one cell: its upper code in the high byte, its lower one in the low."""
    upper, lower = divmod(pair, 256)
    if upper != lower and BACKGROUND in (upper, lower):
        return ("▀", _style(upper)) if lower == BACKGROUND else ("▄", _style(lower))
    if upper != lower:
        return "▀", Style(color=_colour(colour_of(upper)), bgcolor=_colour(colour_of(lower)))
    if upper == BACKGROUND:
        return " ", Style.null()
    mark, level = divmod(upper, LEVELS)
    if mark == heat.STALE:
        ground = _mixed(RAMP[level], _GROUND, 0.75)
        return MARK_CHARACTERS[mark], Style(color=_colour(_mixed(RAMP[level], _GROUND, 0.35)), bgcolor=_colour(ground))
    colour = colour_of(upper)
    ink = ColorTriplet(150, 150, 150) if mark >= heat.FIRST_WITHOUT_VALUE else _ink(colour)
    return MARK_CHARACTERS.get(mark, "?"), Style(color=_colour(ink), bgcolor=_colour(colour))


def _ink(colour: ColorTriplet) -> ColorTriplet:
    """Black or white, whichever can be read on a colour."""
    red, green, blue = colour
    return ColorTriplet(0, 0, 0) if 0.3 * red + 0.59 * green + 0.11 * blue > 110 else ColorTriplet(255, 255, 255)


def _colour(triplet: ColorTriplet) -> Color:
    return Color.from_triplet(triplet)


def _style(code: int) -> Style:
    return Style(color=_colour(colour_of(code)))


def scale_text(sensor_type: SensorType, low: float, high: float) -> Text:
    """The colours, from the value of the first one to that of the last one."""
    text = Text(f"{low:.5g} ", no_wrap=True)
    for left, right in zip(RAMP[0::2], RAMP[1::2], strict=True):
        text.append("▌", Style(color=_colour(left), bgcolor=_colour(right)))
    text.append(f" {high:.5g} {sensor_type.unit}")
    return text


def marks_text(marks: npt.NDArray[np.uint8]) -> Text:
    """How many sensors are fresh, and which of the other marks are to be seen, with what they mean.

    Args:
        marks: (n,) uint8, marks of all sensors that are drawn.
    """
    counts = np.bincount(marks, minlength=len(MARK_CHARACTERS)).tolist()
    text = Text(f"{counts[heat.FRESH]} fresh", no_wrap=True, overflow="ellipsis")
    for mark, name in MARK_NAMES.items():
        if counts[mark]:
            level = LEVELS // 2 if mark < heat.FIRST_WITHOUT_VALUE else 0
            character, style = _cell((mark * LEVELS + level) * 0x101)
            text.append("  ")
            text.append(character, style)
            text.append(f" {counts[mark]} {name}")
    return text
