"""Colour the codes of a heat map for what a terminal can show: palettes, segments and text of rich."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from rich.color import Color
from rich.color_triplet import ColorTriplet
from rich.segment import Segment
from rich.style import Style
from rich.text import Text

from skinware.cli import _heat_map as heat
from skinware.cli._heat_map import BACKGROUND, LEVELS, Label
from skinware.text import figure_text, printable

Colours = tuple[ColorTriplet, ...]
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class Palette:
    """How levels and marks look.

    Attributes:
        ramp: one colour per level.
        stale: the same for what is not current: darker, or grey.
        no_value: of a sensor of which nothing is known.
        unmoved: of a sensor that never moved in a wipe test; no level looks like it.
        characters: one per level where colours are not wanted, otherwise empty.
    """

    ramp: Colours
    stale: Colours
    no_value: ColorTriplet
    unmoved: ColorTriplet
    characters: str = ""


def palette_for(color_system: str | None, *, no_color: bool = False) -> Palette:
    """The palette for a terminal.

    Args:
        color_system: what rich found out about it: ``truecolor``, ``256``, ``standard`` (16 colours), None (none).
        no_color: the person wants none (``NO_COLOR`` is set).
    """
    if no_color or color_system is None:
        return CHARACTERS
    return {"truecolor": TRUE_COLOURS, "256": COLOURS_256}.get(color_system, COLOURS_16)


def mixed(one: ColorTriplet, other: ColorTriplet, share: float) -> ColorTriplet:
    """A colour between two: ``one`` at share 0, ``other`` at 1."""
    return ColorTriplet(*(round(a + (b - a) * share) for a, b in zip(one, other, strict=True)))


def _spread(colours: Sequence[_T]) -> tuple[_T, ...]:
    """One of a few colours per level; the first is level 0 alone, so that the lightest touch is seen."""
    return tuple(colours[-(-level * (len(colours) - 1) // (LEVELS - 1))] for level in range(LEVELS))


def _between(anchors: Sequence[str]) -> Colours:
    """One colour per level, from the first anchor to the last."""
    colours = [Color.parse(text).get_truecolor() for text in anchors]
    steps = [level * (len(colours) - 1) / (LEVELS - 1) for level in range(LEVELS)]
    return tuple(
        mixed(colours[int(step)], colours[min(int(step) + 1, len(colours) - 1)], step - int(step)) for step in steps
    )


def _ansi(numbers: Sequence[int]) -> Colours:
    """Colours of the table of 256; they stay what they are when a triplet is turned into a number again."""
    return tuple(Color.from_ansi(number).get_truecolor() for number in numbers)


_GROUND = ColorTriplet(18, 18, 18)
"""Of the screen."""
_WHITE = ColorTriplet(255, 255, 255)
_VIRIDIS = _between(
    (
        "#482475",
        "#414487",
        "#355f8d",
        "#2a788e",
        "#21918c",
        "#22a884",
        "#44bf70",
        "#7ad151",
        "#bddf26",
        "#fde725",
    )
)
_BASIC = {
    name: ColorTriplet(*rgb)
    for name, rgb in {
        "blue": (0, 0, 170),
        "bright blue": (85, 85, 255),
        "cyan": (0, 170, 170),
        "bright green": (85, 255, 85),
        "bright yellow": (255, 255, 85),
        "grey": (85, 85, 85),
        "light grey": (170, 170, 170),
        "red": (170, 0, 0),
    }.items()
}
"""As rich has the 16 colours: these exact values are sent as their numbers."""

TRUE_COLOURS = Palette(
    ramp=_VIRIDIS,
    stale=tuple(mixed(colour, _GROUND, 0.6) for colour in _VIRIDIS),
    no_value=ColorTriplet(74, 16, 16),
    unmoved=_WHITE,
)
COLOURS_256 = Palette(
    ramp=_spread(_ansi((54, 24, 30, 36, 42, 149, 191, 227))),
    stale=_spread(_ansi((236, 238, 240, 242))),
    no_value=_ansi((52,))[0],
    unmoved=_WHITE,
)
COLOURS_16 = Palette(
    ramp=_spread([_BASIC[name] for name in ("blue", "bright blue", "cyan", "bright green", "bright yellow")]),
    stale=_spread([_BASIC["grey"], _BASIC["light grey"]]),
    no_value=_BASIC["red"],
    unmoved=_WHITE,
)
CHARACTERS = Palette(
    ramp=TRUE_COLOURS.ramp,
    stale=TRUE_COLOURS.stale,
    no_value=TRUE_COLOURS.no_value,
    unmoved=_WHITE,
    characters="".join(_spread("▁▂▃▄▅▆▇█")),
)


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
