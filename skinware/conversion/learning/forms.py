"""Forms of touch that stock policies of LeRobot read: numbers of the state, images, point sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.conversion.learning.features import IMAGE, Batch, Feature
from skinware.conversion.learning.wanted import LearningSet
from skinware.conversion.tables import package
from skinware.errors import ConfigurationError
from skinware.learning.features import Totals, points, state_name
from skinware.learning.images import Colours, TouchImage, range_of
from skinware.skin_layout import SkinLayout
from skinware.structure import Structure

STATE, AGE = "observation.state", state_name("age_s")
_TACTILE = "observation.tactile."
INTERPOLATED = _TACTILE + "interpolated"


class SetForm:
    """Touch in one of these forms, made of the features of each driver.

    A value whose status is not good is 0. With several sensor types, names have that of the type.
    """

    def __init__(self, wanted: LearningSet, structures: Mapping[str, Structure]) -> None:
        if wanted.window != 1:
            raise ConfigurationError(f"touch as {wanted.form} has one sample in a row: leave out --window")
        self._wanted, self._drivers = wanted, tuple(structures)
        self._layout = SkinLayout(self._drivers, tuple(structures.values()))
        self._types = tuple(name for name in self._layout.types if len(self._all(name)))
        of_state = self._types if wanted.form == "state" else ()
        self._totals = {name: Totals(self._layout, name, self._all(name), wanted.numbers) for name in of_state}
        self._images = {name: self._image(name) for name in self._types} if wanted.form == "images" else {}

    def described(self, features: Mapping[str, Feature]) -> dict[str, Feature]:
        others = {name: each for name, each in features.items() if not name.startswith(_TACTILE)}
        if self._wanted.resample == "linear":
            others[INTERPOLATED] = Feature("float32", (1,))
        if self._wanted.form == "images":
            height, width = self._wanted.size
            shape, axes = (height, width, 3), ["height", "width", "channels"]
            return others | {
                self._named("observation.images.touch", name): Feature(IMAGE, shape, axes) for name in self._types
            }
        if self._wanted.form == "points":
            counts = {name: len(self._all(name)) for name in self._types}
            return others | {
                self._named(f"{_TACTILE}points", name): Feature("float32", (count, 6), ["sensor", "number"])
                for name, count in counts.items()
            }
        joined = others.get(STATE)
        names = [*(joined.names or () if joined else ()), *self._state_names()]
        return others | {STATE: Feature("float32", (len(names),), names)}

    def rows(self, batch: Batch) -> Batch:
        others = {name: rows for name, rows in batch.items() if not name.startswith(_TACTILE)}
        if self._wanted.resample == "linear":
            shares = [batch[f"{_TACTILE}{self._key(driver)}.interpolated"] for driver in self._drivers]
            others[INTERPOLATED] = np.max(shares, axis=0)
        values = {name: self._values(batch, name) for name in self._types}
        if self._wanted.form == "images":
            return others | {
                self._named("observation.images.touch", name): _pngs(self._images[name], of)
                for name, of in values.items()
            }
        if self._wanted.form == "points":
            return others | {
                self._named(f"{_TACTILE}points", name): points(self._layout, of, name, self._all(name))
                for name, of in values.items()
            }
        parts: list[npt.NDArray[Any]] = [others[STATE]] if STATE in others else []
        parts += [np.stack([self._totals[name].of(row) for row in of]) for name, of in values.items()]
        age_s = np.max([batch[f"{_TACTILE}{self._key(driver)}.age"] for driver in self._drivers], axis=0)
        return others | {STATE: np.concatenate((*parts, age_s), axis=1).astype(np.float32)}

    def _state_names(self) -> Sequence[str]:
        each = [(name, number) for name, totals in self._totals.items() for number in totals.names]
        return [
            *(state_name(number if len(self._types) == 1 else f"{name}.{number}") for name, number in each),
            AGE,
        ]

    def _named(self, feature: str, type_name: str) -> str:
        return feature if len(self._types) == 1 else f"{feature}_{type_name}"

    def _all(self, type_name: str) -> npt.NDArray[np.int64]:
        return np.arange(len(self._layout.module_of(type_name)))

    def _values(self, batch: Batch, type_name: str) -> npt.NDArray[Any]:
        """(rows, n) of all drivers that have the type, in order; 0 where the status is not good."""
        names = [
            f"{_TACTILE}{self._key(self._drivers[driver])}.{type_name}"
            for driver in np.unique(self._layout.driver_of(type_name)).tolist()
        ]
        return np.concatenate([np.where(batch[f"{name}_status"] == 0, batch[name], 0) for name in names], axis=1)

    def _image(self, type_name: str) -> TouchImage:
        own, wanted = range_of(self._layout, type_name), self._wanted
        lowest, highest = own if wanted.value_range is None else wanted.value_range
        if not np.isfinite((lowest, highest)).all():
            raise ConfigurationError(f"{type_name} has no range of values of its own: give --range LOWEST..HIGHEST")
        colours = Colours(wanted.colours, lowest, highest)
        return TouchImage(self._layout, type_name, self._all(type_name), *wanted.size, colours)

    @staticmethod
    def _key(driver: str) -> str:
        return driver.replace("/", "_")


def _pngs(image: TouchImage, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(rows,) PNG files as bytes objects."""
    pillow = package("PIL.Image", "data sets with images")
    files = np.empty(len(values), object)
    for row, of in enumerate(values):
        file = BytesIO()
        pillow.fromarray(image.of(of)).save(file, "PNG")
        files[row] = file.getvalue()
    return files
