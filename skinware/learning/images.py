"""Images of touch: each taxel a patch of pixels, with colours of a fixed range."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.matrices import filled_by
from skinware.skin_layout import SkinLayout

Pixels = npt.NDArray[np.uint8]
Positions = npt.NDArray[np.int64]
ColourMap = Literal["grey", "signed", "log", "shear"]


@dataclass(frozen=True)
class Colours:
    """How values become colours.

    Attributes:
        map: ``grey``: lowest black, highest white. ``signed``: above 0 red, below 0 blue, 0 black. ``log``: grey, by
            the logarithm of 1 + value - lowest. ``shear``: red and green are two tangential values with 0 in the
            middle (128), blue is the third, normal one.
        lowest, highest: values of the darkest and the brightest colour: fixed, whatever the image has. For ``signed``
            and ``shear`` the range is symmetric, of the size of the larger one.

    Raises:
        ConfigurationError: a range without a size.
    """

    map: ColourMap = "grey"
    lowest: float = 0.0
    highest: float = 255.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.lowest) and math.isfinite(self.highest) and self.lowest < self.highest):
            raise ConfigurationError(f"colours from {self.lowest:g} to {self.highest:g}: give a finite range")

    def of_values(self, values: npt.NDArray[Any]) -> Pixels:
        """Return (..., 3) uint8 of values (...,); for ``shear`` of values (..., 3)."""
        if self.map in ("grey", "log"):
            share = (np.clip(values, self.lowest, self.highest) - self.lowest) / (self.highest - self.lowest)
            if self.map == "log":
                span = self.highest - self.lowest
                share = np.log1p(share * span) / math.log1p(span)
            return np.repeat(_bytes(share)[..., np.newaxis], 3, axis=-1)
        reach = max(abs(self.lowest), abs(self.highest))
        share = np.clip(values / reach, -1.0, 1.0)
        if self.map == "signed":
            return np.stack((_bytes(share), np.zeros(share.shape, np.uint8), _bytes(-share)), axis=-1)
        tangential = np.rint(128 + 127 * share[..., :2]).astype(np.uint8)
        return np.concatenate((tangential, _bytes(share[..., 2:])), axis=-1)


def range_of(layout: SkinLayout, type_name: str) -> tuple[float, float]:
    """Return the lowest and highest value that drivers give for a type; infinite where they give none.

    Raises:
        StructureError: no driver has such sensors.
    """
    types = [layout.structures[driver].type(type_name) for driver, _ in layout.parts(type_name)]
    return min(each.minimum for each in types), max(each.maximum for each in types)


class TouchImage:
    """Where the pixels of an image get their values.

    Each module is a field of the image, beside the others. A matrix fills its field row by row; another module has its
    taxels at their places in it, each pixel that of the nearest one; without places, they fill rows in their order.

    Args:
        layout: of the skin.
        type_name: type of the sensors.
        positions: (n,) of the sensors in the image, among those of the type.
        height, width: of the image, pixels.
        colours: of the values.

    Attributes:
        sensor: (height, width) int64: which of the n values each pixel shows; -1: none, and black.

    Raises:
        ConfigurationError: the image is too small for so many modules.
        StructureError: no driver has such sensors.
    """

    def __init__(
        self, layout: SkinLayout, type_name: str, positions: Positions, height: int, width: int, colours: Colours
    ) -> None:
        self.colours = colours
        self.sensor: Positions = np.full((height, width), -1)
        module_of = layout.module_of(type_name)[positions]
        modules = np.unique(module_of)
        kinds = [kind.decode() for structure in layout.structures for kind in structure.module_kind.tolist()]
        geometry = layout.geometry(type_name)
        columns = min(len(modules), math.ceil(math.sqrt(len(modules) * width / height))) or 1
        rows = math.ceil(len(modules) / columns)
        field = height // (rows or 1), width // columns
        if not len(modules) or min(field) < 2:
            raise ConfigurationError(f"{len(modules)} modules in {height} x {width} pixels: give more of them")
        for number, module in enumerate(modules.tolist()):
            own = np.flatnonzero(module_of == module)
            row, column = divmod(number, columns)
            places = geometry.position_m[positions[own]]
            inside = _field(kinds[module], len(own), places, field[0] - 1, field[1] - 1)
            begin = row * field[0], column * field[1]
            self.sensor[begin[0] : begin[0] + field[0] - 1, begin[1] : begin[1] + field[1] - 1] = own[inside]

    def of(self, values: npt.NDArray[Any]) -> Pixels:
        """Return (height, width, 3) uint8 of (n,) values; for ``shear`` of (n, 3)."""
        colours = np.concatenate((self.colours.of_values(values), np.zeros((1, 3), np.uint8)))
        pixels: Pixels = colours[self.sensor]
        return pixels


def _field(kind: str, count: int, places: npt.NDArray[np.float64], height: int, width: int) -> Positions:
    """(height, width): which of the sensors of a module each pixel shows."""
    y, x = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    shape = filled_by(kind, count)
    if shape is None and np.isfinite(places).all() and count > 1:
        flat = places - places.mean(axis=0)
        plane = flat @ np.linalg.svd(flat, full_matrices=False)[2][:2].T
        span = np.maximum(np.ptp(plane, axis=0), 1e-9)
        at = (plane - plane.min(axis=0)) / span  # each in 0 to 1
        distance = (at[:, 0, np.newaxis, np.newaxis] - x) ** 2 + (at[:, 1, np.newaxis, np.newaxis] - y) ** 2
        nearest: Positions = np.argmin(distance, axis=0)
        return nearest
    columns = math.ceil(math.sqrt(count)) if shape is None else shape[1]
    rows = math.ceil(count / columns)
    number = (y * rows).astype(np.int64) * columns + (x * columns).astype(np.int64)
    return np.minimum(number, count - 1)


def _bytes(share: npt.NDArray[Any]) -> Pixels:
    found: Pixels = np.rint(np.clip(share, 0.0, 1.0) * 255).astype(np.uint8)
    return found
