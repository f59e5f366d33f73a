"""Colour the codes of a heat map as a terminal can show them: palettes, texts, and a widget of Textual."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from rich.color import Color
from rich.color_triplet import ColorTriplet
from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual import events
from textual.geometry import Region, Size
from textual.message import Message
from textual.scroll_view import ScrollView
from textual.strip import Strip

from skinware.cli import _heat_map as heat
from skinware.cli._heat_map import BACKGROUND, LEVELS, Arrangement, Label
from skinware.text import SETTLING, figure_text, prefixed, printable, words

Colours = tuple[ColorTriplet, ...]
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class Palette:
    """The looks of levels and marks.

    Attributes:
        ramp: one colour for each level.
        stale: the same for stale values: darker, or grey.
        characters: one for each level where colours are not wanted, otherwise empty.
    """

    ramp: Colours
    stale: Colours
    no_value: ColorTriplet
    settling: ColorTriplet
    characters: str = ""


def palette_for(color_system: str | None, *, no_color: bool = False) -> Palette:
    """Return the palette for a terminal, of a colour system as rich detects it."""
    if no_color or color_system is None:
        return CHARACTERS
    return {"truecolor": TRUE_COLOURS, "256": COLOURS_256}.get(color_system, COLOURS_16)


def mixed(one: ColorTriplet, other: ColorTriplet, share: float) -> ColorTriplet:
    """Return a colour between two: ``one`` at share 0, ``other`` at 1."""
    return ColorTriplet(*(round(a + (b - a) * share) for a, b in zip(one, other, strict=True)))


def _spread(colours: Sequence[_T]) -> tuple[_T, ...]:
    """Return one of a few colours for each level; the first is level 0 alone, so that the lightest touch is seen."""
    return tuple(colours[-(-level * (len(colours) - 1) // (LEVELS - 1))] for level in range(LEVELS))


def _ansi(numbers: Sequence[int]) -> Colours:
    """Return colours of the table of 256, which stay the same when they are turned into numbers again."""
    return tuple(Color.from_ansi(number).get_truecolor() for number in numbers)


_GROUND = ColorTriplet(18, 18, 18)
"""Colour of the screen."""
_BLACK, _WHITE = ColorTriplet(0, 0, 0), ColorTriplet(255, 255, 255)
_VIRIDIS = tuple(
    ColorTriplet(*rgb.tolist())
    for rgb in np.frombuffer(
        bytes.fromhex(
            "482475 443780 3f4988 375a8c 31698d 2a788e 25878d 21968a"
            "22a386 30b17c 44bf70 64ca5d 87d448 b0dc2f d7e226 fde725"
        ),
        np.uint8,
    ).reshape(-1, 3)
)
"""One colour for each level."""
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
"""The 16 colours as rich defines them: these exact values are sent as their numbers."""

TRUE_COLOURS = Palette(
    ramp=_VIRIDIS,
    stale=tuple(mixed(colour, _GROUND, 0.6) for colour in _VIRIDIS),
    no_value=ColorTriplet(74, 16, 16),
    settling=ColorTriplet(40, 44, 52),
)
COLOURS_256 = Palette(
    ramp=_spread(_ansi((54, 24, 30, 36, 42, 149, 191, 227))),
    stale=_spread(_ansi((236, 238, 240, 242))),
    no_value=_ansi((52,))[0],
    settling=_ansi((235,))[0],
)
COLOURS_16 = Palette(
    ramp=_spread([_BASIC[name] for name in ("blue", "bright blue", "cyan", "bright green", "bright yellow")]),
    stale=_spread([_BASIC["grey"], _BASIC["light grey"]]),
    no_value=_BASIC["red"],
    settling=_BASIC["grey"],
)
CHARACTERS = replace(TRUE_COLOURS, characters="".join(_spread("▁▂▃▄▅▆▇█")))


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
    heat.SETTLING: "~",
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
    heat.SETTLING: SETTLING,
}


def colour_of(code: int, palette: Palette) -> ColorTriplet:
    """Return the colour of a sensor with this code where there is no room for its character."""
    mark, level = divmod(code, LEVELS)
    if mark >= heat.FIRST_WITHOUT_VALUE:
        return palette.settling if mark == heat.SETTLING else palette.no_value
    return palette.stale[level] if mark == heat.STALE else palette.ramp[level]


def changed_lines(before: npt.NDArray[np.uint8], now: npt.NDArray[np.uint8]) -> list[int]:
    """Return the lines in which any pixel has another code; both are (2 * lines, columns) uint8."""
    differs = (before != now).any(axis=1)
    lines: list[int] = np.flatnonzero(differs[0::2] | differs[1::2]).tolist()
    return lines


def segments_of(
    upper: npt.NDArray[np.uint8], lower: npt.NDArray[np.uint8], labels: Sequence[Label], palette: Palette
) -> list[Segment]:
    """Return one line of a map from the codes of its pixels, (columns,) uint8 for each half of the line."""
    pairs = upper.astype(np.uint16) << 8 | lower
    segments: list[Segment] = []
    text, style = "", _PLAIN
    for pair in pairs.tolist():
        character, own = _cell(pair, palette)
        if own is not style and (character != " " or own.bgcolor != style.bgcolor):  # a blank has no ink
            if text:
                segments.append(Segment(text, style))
            text, style = "", own
        text += character
    segments.append(Segment(text, style))
    label_style, mark_style = (_PLAIN, _PLAIN_MARK) if palette.characters else (_LABEL, _MARK)
    for label in labels:
        end = label.column + len(label.text)
        before, _, after = Segment.divide(segments, [label.column, end, max(end, len(pairs))])
        segments = [*before, Segment(printable(label.text), mark_style if label.is_mark else label_style), *after]
    return segments


_GROUND_STYLE = Style.parse("on #121212")
_LABEL = Style.parse("#8a8a8a on #121212")
_MARK = Style.parse("bold #ffffff on #27548a")
_PLAIN, _PLAIN_MARK = Style.null(), Style.parse("bold reverse")


@cache
def _cell(pair: int, palette: Palette) -> tuple[str, Style]:
    """Return character and colours of a cell, whose upper code is the high byte and whose lower code is the low one."""
    upper, lower = divmod(pair, 256)
    if palette.characters:
        return _character(lower if upper == BACKGROUND else upper, palette), Style.null()
    if upper != lower and BACKGROUND in (upper, lower):
        code = upper if lower == BACKGROUND else lower
        return "▀" if code == upper else "▄", _GROUND_STYLE + Style(color=Color.from_triplet(colour_of(code, palette)))
    if upper != lower:
        return "▀", Style(
            color=Color.from_triplet(colour_of(upper, palette)), bgcolor=Color.from_triplet(colour_of(lower, palette))
        )
    if upper == BACKGROUND:
        return " ", _GROUND_STYLE
    ground = colour_of(upper, palette)
    mark, level = divmod(upper, LEVELS)
    red, green, blue = ground
    readable = _BLACK if 0.3 * red + 0.59 * green + 0.11 * blue > 110 else _WHITE
    ink = palette.ramp[level] if mark == heat.STALE else readable
    return _character(upper, palette), Style(color=Color.from_triplet(ink), bgcolor=Color.from_triplet(ground))


def _character(code: int, palette: Palette) -> str:
    if code == BACKGROUND:
        return " "
    mark, level = divmod(code, LEVELS)
    return palette.characters[level] if palette.characters and mark == heat.FRESH else MARK_CHARACTERS.get(mark, "?")


def scale_text(values: Sequence[float], unit: str, palette: Palette) -> Text:
    """Return the colours from the lowest level to the highest, with values at both and perhaps in the middle."""
    factor, unit = prefixed(unit, max(map(abs, values)))
    first, *others = (figure_text(value / factor) for value in values)
    text = Text(f"{first} ", no_wrap=True)
    half = LEVELS // len(others)
    for number, other in enumerate(others):
        for level in range(number * half, (number + 1) * half, 2):
            if palette.characters:
                text.append(palette.characters[level + 1])
            else:
                left, right = palette.ramp[level : level + 2]
                text.append("▌", Style(color=Color.from_triplet(left), bgcolor=Color.from_triplet(right)))
        text.append(f" {other}{' ' * (number + 1 < len(others))}")
    return text.append(f" {unit}".rstrip())


def marks_text(marks: npt.NDArray[np.uint8], reasons: Mapping[str, int], palette: Palette) -> Text:
    """Return how many sensors are fresh, the other marks that are seen, and the reasons of a calmed driver."""
    counts = np.bincount(marks, minlength=len(MARK_CHARACTERS)).tolist()
    text = Text(f"{counts[heat.FRESH]} fresh", no_wrap=True, overflow="ellipsis")
    for mark, name in MARK_NAMES.items():
        if counts[mark]:
            level = LEVELS // 2 if mark < heat.FIRST_WITHOUT_VALUE else 0
            character, style = _cell((mark * LEVELS + level) * 0x101, palette)
            text.append("  ")
            text.append(character, style)
            text.append(f" {name}, {counts[mark]} left" if mark == heat.SETTLING else f" {counts[mark]} {name}")
    for name, count in reasons.items():
        text.append(f"  {count} {words(name)}")
    return text


class TextLines(ScrollView, can_focus=False):
    """Lines of which only those that changed are made again.

    They have all their colours: what Textual does for lines of any widget costs more than making them.
    """

    def __init__(self, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self._strips: dict[int, Strip] = {}
        self._made_for = (0, 0)

    def make_line(self, y: int) -> Strip:
        """Return a line in which nothing is scrolled."""
        raise NotImplementedError

    def changed(self, lines: Iterable[int]) -> None:
        """Make these lines again when they are seen."""
        (width, height), top = self.size, self.scroll_offset.y
        for line in (seen := list(lines)):
            self._strips.pop(line, None)
        regions = [Region(0, line - top, width, 1) for line in seen if top <= line < top + height]
        if regions:
            self.refresh(*regions)

    def changed_all(self, columns: int, lines: int) -> None:
        """Make all lines again, in another size."""
        self._strips.clear()
        self.virtual_size = Size(columns, lines)
        self.refresh()

    def render_lines(self, crop: Region) -> list[Strip]:
        (left, top), width = self.scroll_offset, self.size.width
        if self._made_for != (left, width):
            self._made_for = left, width
            self._strips.clear()
        for line in range(crop.y + top, crop.bottom + top):
            if line not in self._strips:
                self._strips[line] = self.make_line(line).crop_extend(left, left + width, self.ground)
        return [self._strips[line].crop(crop.x, crop.right) for line in range(crop.y + top, crop.bottom + top)]

    @property
    def ground(self) -> Style:
        return Style.null() if self.app.no_color else _GROUND_STYLE


class HeatMap(TextLines):
    class Pointed(Message):
        """The mouse points at a sensor (its position in a snapshot), or at none."""

        def __init__(self, sensor: int | None) -> None:
            super().__init__()
            self.sensor = sensor

    def __init__(self, palette: Palette, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self._palette = palette
        self._arrangement: Arrangement | None = None
        self._pixels: npt.NDArray[np.uint8] | None = None
        self._marks: Mapping[int, Sequence[Label]] = {}

    def show(
        self,
        arrangement: Arrangement,
        pixels: npt.NDArray[np.uint8],
        marks: Mapping[int, Sequence[Label]],
    ) -> None:
        """Draw the lines that changed; ``pixels`` of ``arrangement.draw`` are not changed afterwards."""
        before = self._pixels if arrangement is self._arrangement else None
        moved = {line for line in self._marks.keys() | marks.keys() if self._marks.get(line) != marks.get(line)}
        self._arrangement, self._pixels, self._marks = arrangement, pixels, marks
        if before is None:
            self.changed_all(arrangement.columns, arrangement.lines)
        else:
            self.changed(moved.union(changed_lines(before, pixels)))

    def make_line(self, y: int) -> Strip:
        arrangement, pixels = self._arrangement, self._pixels
        if arrangement is None or pixels is None or y >= arrangement.lines:
            return Strip.blank(0)
        upper, lower = pixels[2 * y : 2 * y + 2]
        labels = [*arrangement.labels.get(y, ()), *self._marks.get(y, ())]
        return Strip(segments_of(upper, lower, labels, self._palette), arrangement.columns)

    def on_mouse_move(self, event: events.MouseMove) -> None:
        if self._arrangement is not None:
            left, top = self.scroll_offset
            self.post_message(self.Pointed(self._arrangement.sensor_at(event.y + top, event.x + left)))

    def on_leave(self) -> None:
        self.post_message(self.Pointed(None))
