"""How much of a skin is covered, as text: a bar for each patch, and the skin with a sign for each sensor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from skinware.cli._heat_map import arrange
from skinware.structure import Structure

SIGNS = "·▂▃▄▅▆▇█"
"""Of a sensor: nothing at all; in between; all that is wanted."""
_BAR = 20
_HEIGHT = 40


def bars(structure: Structure, type_name: str, coverage: npt.NDArray[np.float64]) -> Iterator[str]:
    """A line for each patch: its name, a bar, and how many of its sensors have all that is wanted.

    Args:
        structure: of the driver.
        type_name: of the sensors.
        coverage: (n,) 0 to 1 of each.
    """
    patch = structure.patch_of(type_name)
    width = max(map(len, structure.patch_names))
    for number, name in enumerate(structure.patch_names):
        own = coverage[patch == number]
        if len(own):
            full = "█" * round(_BAR * float(own.mean()))
            yield f"{name:<{width}}  {full:░<{_BAR}}  {int((own >= 1).sum())} of {len(own)}"


def picture(structure: Structure, type_name: str, coverage: npt.NDArray[np.float64], width: int) -> Iterator[str]:
    """The sensors, module by module as ``skin-top`` draws them, each with a sign for what it has.

    Args:
        structure: of the driver.
        type_name: of the sensors.
        coverage: (n,) 0 to 1 of each.
        width: of the terminal.
    """
    drawn = arrange(structure, list(range(structure.n_patches)), type_name, width, _HEIGHT, smallest=2)
    of_sensor = np.zeros(structure.n_sensors)
    of_sensor[structure.index(type_name)] = coverage
    level = np.where(of_sensor >= 1, len(SIGNS) - 1, np.ceil(of_sensor * (len(SIGNS) - 2)))
    codes = level.astype(np.uint8)[drawn.sensors]
    pixels = np.append(codes, np.uint8(len(SIGNS)))[drawn.pixels]
    for number in range(drawn.lines):
        upper, lower = pixels[2 * number : 2 * number + 2]
        signs = [(SIGNS + " ")[code] for code in np.where(upper == len(SIGNS), lower, upper).tolist()]
        for label in drawn.labels.get(number, ()):
            signs[label.column : label.column + len(label.text)] = label.text
        yield "".join(signs).rstrip()
