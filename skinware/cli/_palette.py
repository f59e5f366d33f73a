"""The colours of a heat map, for what terminals can show: the more is felt, the brighter, in every palette.

Brightness alone tells levels apart: people who see fewer hues, and those whose terminal has few colours or none,
see the same. Hues follow viridis (Smith and van der Walt), from violet to yellow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from rich.color import Color
from rich.color_triplet import ColorTriplet

from skinware.cli._heat_map import LEVELS

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
