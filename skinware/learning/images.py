"""Images of touch: each taxel a patch of pixels, with colours of a fixed range."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.learning.live import LiveTouch, TouchSample
from skinware.matrices import filled_by
from skinware.realtime import now_ns
from skinware.skin_layout import SkinLayout
from skinware.tactile.contacts import NO_CONTACT

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


class LiveImage:
    """Live touch as images: see :class:`TouchImage`.

    Args:
        touch: what is shown; with colours ``shear`` of the normal component, such as ``force_z``.
        height, width: of the images, pixels.
        map: of the colours.
        lowest, highest: range of the colours; default: that of the drivers' sensor type.
        tangential: types of the two tangential components for ``shear``, of the same taxels.
        shows: the ``values``; or, of touch with contacts, ``contacts``: of each taxel the load of its contact.
    """

    def __init__(
        self,
        touch: LiveTouch,
        height: int,
        width: int,
        map: ColourMap = "grey",  # noqa: A002, as in Colours
        *,
        lowest: float | None = None,
        highest: float | None = None,
        tangential: tuple[str, str] = ("force_x", "force_y"),
        shows: Literal["values", "contacts"] = "values",
    ) -> None:
        self.touch, self._shows = touch, shows
        self._size, self._map, self._range, self._tangential = (height, width), map, (lowest, highest), tangential
        self._image: TouchImage | None = None

    def open(self, *, timeout_s: float = 5.0) -> Self:
        """Open the touch, and lay out the image.

        Raises:
            ConfigurationError: the drivers give no range, the image is too small, or the components are not of the same
                taxels.
            ServiceTimeout, StructureError: as :meth:`LiveTouch.open`.
        """
        self.touch.open(timeout_s=timeout_s)
        layout, type_name = self.touch.layout, self.touch.sensors.type_name
        try:
            lowest, highest = self._range
            own = range_of(layout, type_name)
            lowest, highest = own[0] if lowest is None else lowest, own[1] if highest is None else highest
            if self._map == "shear" and any(
                not np.array_equal(layout.uids(name), layout.uids(type_name)) for name in self._tangential
            ):
                raise ConfigurationError(f"{', '.join(self._tangential)} are not of the same taxels as {type_name}")
            colours = Colours(self._map, lowest, highest)
            self._image = TouchImage(layout, type_name, self.touch.positions, *self._size, colours)
        except BaseException:
            self.touch.close()
            raise
        return self

    def now(self) -> tuple[Pixels, TouchSample]:
        """Return (height, width, 3) uint8, and the touch it shows; errors as :meth:`LiveTouch.now`."""
        return self.at(now_ns())

    def at(self, time_ns: int) -> tuple[Pixels, TouchSample]:
        """Return the image of a moment, as :meth:`LiveTouch.at`."""
        return self._shown(self.touch.at(time_ns))

    def newer(self, *, timeout_s: float) -> tuple[Pixels, TouchSample]:
        """Return the next image, as :meth:`LiveTouch.newer`."""
        return self._shown(self.touch.newer(timeout_s=timeout_s))

    def _shown(self, touch: TouchSample) -> tuple[Pixels, TouchSample]:
        if self._image is None:
            raise ConfigurationError("an image is read before it was opened")
        values = self._loads(touch) if self._shows == "contacts" else touch.values
        if self._map == "shear":
            parts = [touch.snapshot.physical(name)[self.touch.positions] * touch.fresh for name in self._tangential]
            values = np.stack((*parts, values), axis=1)
        return self._image.of(values), touch

    def _loads(self, touch: TouchSample) -> npt.NDArray[Any]:
        """(n,) load of the contact that each sensor is in; 0: in none."""
        layout, type_name = self.touch.layout, self.touch.sensors.type_name
        loads = np.zeros(len(layout.uids(type_name)))
        if touch.contacts is None:
            raise ConfigurationError("contacts cannot be shown: make LiveTouch with contacts_in")
        source, found = touch.contacts.source, touch.contacts.contacts
        own = np.flatnonzero(layout.driver_of(type_name) == list(layout.drivers).index(source.driver))
        if source.type_name != type_name or not np.array_equal(layout.uids(type_name)[own], source.uid):
            raise ConfigurationError(f"the contacts are of {source.type_name} of {source.driver}, not of {type_name}")
        loads[own] = np.append(found.load, 0.0)[np.maximum(found.contact_of, NO_CONTACT)]
        return loads[self.touch.positions]

    def close(self) -> None:
        """Detach from all drivers. Idempotent."""
        self.touch.close()


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
