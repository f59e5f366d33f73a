"""The more is felt, the brighter: in every terminal and for every eye."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from rich.color import Color, ColorSystem
from rich.color_triplet import ColorTriplet

from skinware.cli._painting import CHARACTERS, COLOURS_16, COLOURS_256, TRUE_COLOURS, Palette, palette_for

PALETTES = {
    "truecolor": (TRUE_COLOURS, ColorSystem.TRUECOLOR),
    "256": (COLOURS_256, ColorSystem.EIGHT_BIT),
    "16, xterm": (COLOURS_16, ColorSystem.STANDARD),
    "16, console": (COLOURS_16, ColorSystem.STANDARD),
}
SIXTEEN = {
    "16, xterm": "000 c00 0c0 cc0 00e c0c 0cc eee 777 f00 0f0 ff0 66f f0f 0ff fff",
    "16, console": "000 a00 0a0 a50 00a a0a 0aa aaa 555 f55 5f5 ff5 55f f5f 5ff fff",
}
"""What terminals make of the 16 colours: red, green and blue, a digit each."""
EYES = {
    "most": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    # Machado, Oliveira, Fernandes 2009: linear RGB as it is seen without one kind of cone
    "no red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "no green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "no blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def lightness(colour: ColorTriplet, eye: str = "most") -> float:
    """L* (0 black, 100 white) of what an eye sees."""
    share = np.array(colour) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    seen: npt.NDArray[np.float64] = np.clip(np.array(EYES[eye]) @ linear, 0, 1)
    luminance = float(seen @ [0.2126, 0.7152, 0.0722])
    return 116 * luminance ** (1 / 3) - 16 if luminance > 0.008856 else 903.3 * luminance


def as_shown(name: str, colour: ColorTriplet) -> ColorTriplet:
    sent = Color.from_triplet(colour).downgrade(PALETTES[name][1])
    if name in SIXTEEN:
        assert sent.number is not None
        return ColorTriplet(*(17 * int(digit, 16) for digit in SIXTEEN[name].split()[sent.number]))
    return sent.get_truecolor()


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("name", PALETTES)
def test_a_higher_level_is_never_darker(name: str, eye: str) -> None:
    palette, _ = PALETTES[name]
    for colours in (palette.ramp, palette.stale):
        seen = [lightness(as_shown(name, colour), eye) for colour in colours]
        assert seen == sorted(seen)


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("name", PALETTES)
def test_the_lightest_touch_is_brighter_than_rest_and_the_hardest_far_brighter(name: str, eye: str) -> None:
    palette, _ = PALETTES[name]
    rest, light, *_, hard = (lightness(as_shown(name, colour), eye) for colour in palette.ramp)
    assert light > rest + 2
    assert hard > rest + 50
    assert rest > lightness(ColorTriplet(18, 18, 18), eye) + 8  # and a sensor at rest is not the background


@pytest.mark.parametrize("name", PALETTES)
def test_no_level_looks_like_a_mark(name: str) -> None:
    palette, _ = PALETTES[name]
    ramp = {as_shown(name, colour) for colour in palette.ramp}
    stale = {as_shown(name, colour) for colour in palette.stale}
    no_value = as_shown(name, palette.no_value)
    assert no_value not in ramp | stale
    assert not stale & ramp


@pytest.mark.parametrize(
    ("color_system", "no_color", "palette"),
    [
        ("truecolor", False, TRUE_COLOURS),
        ("256", False, COLOURS_256),
        ("standard", False, COLOURS_16),
        ("windows", False, COLOURS_16),
        (None, False, CHARACTERS),
        ("truecolor", True, CHARACTERS),
    ],
)
def test_the_terminal_and_the_person_choose(color_system: str | None, no_color: bool, palette: Palette) -> None:
    assert palette_for(color_system, no_color=no_color) is palette


def test_without_colours_bars_grow() -> None:
    assert list(CHARACTERS.characters) == sorted(CHARACTERS.characters)
    assert CHARACTERS.characters[0] != CHARACTERS.characters[1]
    assert CHARACTERS.characters[-1] == "█"
