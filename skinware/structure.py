"""The structure of a skin: patches of modules of sensors, as plain numpy columns, fixed for one generation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from skinware import _names
from skinware.errors import StructureError
from skinware.sensor_types import SensorType

_T = TypeVar("_T", bound=np.generic)

Index = slice | npt.NDArray[np.int64]
"""Positions of sensors in a frame: a slice where they lie together, otherwise (n,) int64."""

VALUE_DTYPES = tuple(np.dtype(code) for code in ("u1", "<i2", "<u2", "<i4", "<f4"))
"""The dtypes that values of a service may have."""

_COLUMNS: tuple[tuple[str, str], ...] = (
    ("type_id", "<u4"),
    ("type_name", "|S32"),
    ("type_unit", "|S16"),
    ("type_scale", "<f8"),
    ("type_offset", "<f8"),
    ("type_minimum", "<f8"),
    ("type_maximum", "<f8"),
    ("bus_name", "|S64"),
    ("patch_name", "|S32"),
    ("patch_bus", "<u4"),
    ("module_patch", "<u4"),
    ("module_kind", "|S16"),
    ("module_name", "|S32"),
    ("sensor_uid", "<u8"),
    ("sensor_type", "<u4"),
    ("sensor_module", "<u4"),
)
_OPTIONAL = ("module_name",)
"""Columns that files of earlier versions do not have."""


class Structure:
    """Immutable tables of one driver's skin.

    Attributes:
        types: the sensor types of this driver.
        buses: names of the buses that the patches hang on.
        patch_name: (n_patches,) bytes.
        patch_bus: (n_patches,) uint32, index into ``buses``.
        module_patch: (n_modules,) uint32, index of the module's patch.
        module_kind: (n_modules,) bytes; hardware-specific (``triangle``, ``fingertip``).
        module_name: (n_modules,) bytes; within its patch (``triangle 3``), empty where the driver gives none.
        sensor_uid: (n_sensors,) uint64, unique per type.
        sensor_type: (n_sensors,) uint32, id of a type in ``types``.
        sensor_module: (n_sensors,) uint32, index of the sensor's module.
        dtype: dtype of the values, one of :data:`VALUE_DTYPES`.

    Raises:
        StructureError: tables that contradict each other; the message names the row.
    """

    def __init__(
        self,
        *,
        types: Iterable[SensorType],
        buses: Sequence[str],
        patch_name: npt.ArrayLike,
        patch_bus: npt.ArrayLike,
        module_patch: npt.ArrayLike,
        module_kind: npt.ArrayLike,
        sensor_uid: npt.ArrayLike,
        sensor_type: npt.ArrayLike,
        sensor_module: npt.ArrayLike,
        dtype: npt.DTypeLike,
        module_name: npt.ArrayLike | None = None,
    ) -> None:
        self.types: tuple[SensorType, ...] = tuple(types)
        self.buses: tuple[str, ...] = tuple(buses)
        self.patch_name: npt.NDArray[np.bytes_] = _column("patch_name", patch_name)
        self.patch_bus: npt.NDArray[np.uint32] = _column("patch_bus", patch_bus)
        self.module_patch: npt.NDArray[np.uint32] = _column("module_patch", module_patch)
        self.module_kind: npt.NDArray[np.bytes_] = _column("module_kind", module_kind)
        self.module_name: npt.NDArray[np.bytes_] = _column(
            "module_name", [b""] * len(self.module_kind) if module_name is None else module_name
        )
        self.sensor_uid: npt.NDArray[np.uint64] = _column("sensor_uid", sensor_uid)
        self.sensor_type: npt.NDArray[np.uint32] = _column("sensor_type", sensor_type)
        self.sensor_module: npt.NDArray[np.uint32] = _column("sensor_module", sensor_module)
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        self._check()

    @property
    def n_sensors(self) -> int:
        """Number of sensors."""
        return len(self.sensor_uid)

    @property
    def n_modules(self) -> int:
        """Number of modules."""
        return len(self.module_patch)

    @property
    def n_patches(self) -> int:
        """Number of patches."""
        return len(self.patch_name)

    @cached_property
    def _index_by_type(self) -> dict[str, Index]:
        return {t.name: as_index(np.flatnonzero(self.sensor_type == t.id)) for t in self.types}

    @cached_property
    def _index_by_module(self) -> list[Index]:
        return _group(self.sensor_module, self.n_modules)

    @cached_property
    def sensor_patch(self) -> npt.NDArray[np.uint32]:
        """(n_sensors,) uint32, index of the patch that each sensor belongs to."""
        return _frozen(self.module_patch[self.sensor_module])

    @cached_property
    def _index_by_patch(self) -> list[Index]:
        return _group(self.sensor_patch, self.n_patches)

    @cached_property
    def _position(self) -> dict[tuple[int, int], int]:
        pairs = zip(self.sensor_type.tolist(), self.sensor_uid.tolist(), strict=True)
        return {pair: position for position, pair in enumerate(pairs)}

    @cached_property
    def patch_names(self) -> tuple[str, ...]:
        """Name of every patch, as people know it: ``board 8``; of those that share one ``board 8 on can0``."""
        return _names.distinct(texts(self.patch_name), [self.buses[bus] for bus in self.patch_bus.tolist()], "on")

    @cached_property
    def module_names(self) -> tuple[str, ...]:
        """Name of every module, as people know it: ``board 8, triangle 3``.

        Where the driver gives none, its kind and a number, both as they are in the patch; the only module of a patch
        is called as the patch.
        """
        return _names.module_names(
            texts(self.module_name), texts(self.module_kind), self.module_patch.tolist(), self.patch_names
        )

    def sensor_name(self, position: int) -> str:
        """Name of a sensor's place, as people know it: ``board 8, triangle 3, taxel 5``.

        All axes of a taxel have one name. Taxels are counted by uid from the lowest of their module, which is 0; the
        only one of a module is called as the module. Temperatures, accelerations and angular rates have the name of
        their type instead of ``taxel``.

        Args:
            position: in a frame.
        """
        return _names.joined(self.module_names[self.sensor_module[position]], self.name_in_module(position))

    def name_in_module(self, position: int) -> str:
        """What ``sensor_name`` adds to the name of the module: ``taxel 5``; empty where it adds nothing."""
        of_module = self.module_index(int(self.sensor_module[position]))
        type_id = int(self.sensor_type[position])
        return _names.name_in_module(
            next(t.name for t in self.types if t.id == type_id),
            int(self.sensor_uid[position] - self.sensor_uid[of_module].min()),
            is_only=int((self.sensor_type[of_module] == type_id).sum()) == 1,
        )

    def type(self, name: str) -> SensorType:
        """The driver's sensor type of this name.

        Raises:
            StructureError: no sensor of that type here; the message lists those there are.
        """
        for candidate in self.types:
            if candidate.name == name:
                return candidate
        raise StructureError(
            f"no sensor type {name!r} in this skin; it has: {', '.join(t.name for t in self.types) or 'none'}"
        )

    def index(self, type_name: str) -> Index:
        """Positions in a frame of all sensors of a type, in frame order.

        Raises:
            StructureError: no such type here.
        """
        return self._index_by_type[self.type(type_name).name]

    def module_index(self, module: int) -> Index:
        """Positions in a frame of the sensors of a module, in frame order."""
        return self._index_by_module[module]

    def patch_index(self, patch: int) -> Index:
        """Positions in a frame of the sensors of a patch, in frame order."""
        return self._index_by_patch[patch]

    def position(self, type_name: str, uid: int) -> int:
        """Position in a frame of one sensor.

        Raises:
            StructureError: no such type, or no sensor of that uid with this type.
        """
        sensor_type = self.type(type_name)
        try:
            return self._position[sensor_type.id, uid]
        except KeyError:
            raise StructureError(f"no {type_name} sensor with uid {uid:#x} in this skin") from None

    def module_of(self, type_name: str) -> npt.NDArray[np.uint32]:
        """(n,) uint32, index of the module of each sensor of a type, in the order of ``index(type_name)``.

        Raises:
            StructureError: no such type here.
        """
        return self.sensor_module[self.index(type_name)]

    def patch_of(self, type_name: str) -> npt.NDArray[np.uint32]:
        """(n,) uint32, index of the patch of each sensor of a type, likewise."""
        return self.sensor_patch[self.index(type_name)]

    def physical(self, values: npt.NDArray[np.generic], type_name: str) -> npt.NDArray[np.floating[Any]]:
        """Physical values of all sensors of a type.

        Args:
            values: (n_sensors,) raw values of a whole frame.
            type_name: which sensors to take.

        Returns:
            (n,) float32 in the type's unit, in the order of ``index(type_name)``; float64 if the raw values are
            int32, which have more digits than float32 holds.
        """
        sensor_type = self.type(type_name)
        raw = values[self.index(type_name)]
        if self.dtype == np.int32:
            exact: npt.NDArray[np.float64] = raw.astype(np.float64)
            return exact * sensor_type.scale + sensor_type.offset
        single: npt.NDArray[np.float32] = raw.astype(np.float32)
        return single * np.float32(sensor_type.scale) + np.float32(sensor_type.offset)

    def to_columns(self) -> dict[str, npt.NDArray[np.generic]]:
        """The tables as named columns, for a service's file."""
        types = self.types
        data: dict[str, npt.ArrayLike] = {
            "type_id": [t.id for t in types],
            "type_name": [t.name.encode() for t in types],
            "type_unit": [t.unit.encode() for t in types],
            "type_scale": [t.scale for t in types],
            "type_offset": [t.offset for t in types],
            "type_minimum": [t.minimum for t in types],
            "type_maximum": [t.maximum for t in types],
            "bus_name": [name.encode()[:64] for name in self.buses],
        }
        return {
            name: np.asarray(data[name], dtype=code) if name in data else getattr(self, name) for name, code in _COLUMNS
        }

    @classmethod
    def from_columns(cls, columns: Mapping[str, npt.NDArray[np.generic]], dtype: npt.DTypeLike) -> Structure:
        """Rebuild a structure from ``to_columns``' columns.

        Raises:
            StructureError: a column is missing, or the tables contradict each other.
        """
        for name, code in _COLUMNS:
            if name in _OPTIONAL and name not in columns:
                continue
            if name not in columns or columns[name].dtype != np.dtype(code):
                raise StructureError(f"structure column {name!r} is missing or not {code}")
        fields = ("id", "name", "unit", "scale", "offset", "minimum", "maximum")
        rows = zip(*(columns[f"type_{field}"].tolist() for field in fields), strict=True)
        types = [
            SensorType(name.decode(), identifier, unit.decode(), scale, offset, minimum, maximum)
            for identifier, name, unit, scale, offset, minimum, maximum in rows
        ]
        own = [name for name, _ in _COLUMNS if not name.startswith(("type_", "bus_")) and name in columns]
        return cls(
            types=types,
            buses=[name.decode() for name in columns["bus_name"].tolist()],
            dtype=dtype,
            **{name: np.array(columns[name]) for name in own},
        )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Structure):
            return NotImplemented
        if self.dtype != other.dtype:
            return False
        mine, theirs = self.to_columns(), other.to_columns()
        return all(np.array_equal(mine[name], theirs[name]) for name in mine)

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __repr__(self) -> str:
        names = ", ".join(t.name for t in self.types)
        return (
            f"<Structure patches: {self.n_patches}, modules: {self.n_modules},"
            f" sensors: {self.n_sensors} ({names}), {self.dtype.name}>"
        )

    def _check(self) -> None:
        if self.dtype not in VALUE_DTYPES:
            allowed = ", ".join(d.name for d in VALUE_DTYPES)
            raise StructureError(f"values of dtype {self.dtype.name}: choose one of {allowed}")
        if not self.n_sensors:
            raise StructureError("a skin needs at least one sensor")
        _same_length("patch", self.patch_name, self.patch_bus)
        _same_length("module", self.module_patch, self.module_kind, self.module_name)
        _same_length("sensor", self.sensor_uid, self.sensor_type, self.sensor_module)
        _within("patch", "bus", self.patch_bus, len(self.buses))
        _within("module", "patch", self.module_patch, self.n_patches)
        _within("sensor", "module", self.sensor_module, self.n_modules)
        ids = [t.id for t in self.types]
        if len(set(ids)) < len(ids) or len({t.name for t in self.types}) < len(ids):
            raise StructureError("two sensor types share a name or an id")
        unknown = ~np.isin(self.sensor_type, np.array(ids, np.uint32))
        if unknown.any():
            row = int(np.argmax(unknown))
            raise StructureError(f"sensor {row} has type {self.sensor_type[row]}, which is not in the type table")
        if len(self._position) < self.n_sensors:
            seen: set[tuple[int, int]] = set()
            for row, pair in enumerate(zip(self.sensor_type.tolist(), self.sensor_uid.tolist(), strict=True)):
                if pair in seen:
                    raise StructureError(f"sensor {row}: uid {pair[1]:#x} appears twice for type {pair[0]}")
                seen.add(pair)


def as_index(positions: npt.NDArray[np.int64]) -> Index:
    """``positions`` (ascending) as a slice where they are contiguous, else as they are (read-only int64)."""
    if len(positions) and positions[-1] - positions[0] + 1 == len(positions):
        return slice(int(positions[0]), int(positions[-1]) + 1)
    if not len(positions):
        return slice(0, 0)
    return _frozen(positions.astype(np.int64))


def _group(owner: npt.NDArray[np.uint32], count: int) -> list[Index]:
    order = np.argsort(owner, kind="stable")
    bounds = np.searchsorted(owner[order], np.arange(count + 1))
    return [as_index(order[bounds[i] : bounds[i + 1]]) for i in range(count)]


def _column(name: str, data: npt.ArrayLike) -> npt.NDArray[Any]:
    wanted = np.dtype(dict(_COLUMNS)[name])
    given = np.asarray(data)
    if given.ndim != 1:
        raise StructureError(f"{name} must be one-dimensional, not of shape {given.shape}")
    if wanted.kind == "S":
        if given.dtype.kind == "U":
            given = np.char.encode(given, "utf-8")
        too_long = np.char.str_len(given.astype(bytes)) > wanted.itemsize if given.size else np.zeros(0, bool)
        if too_long.any():
            row = int(np.argmax(too_long))
            raise StructureError(f"{name} {row} is longer than {wanted.itemsize} bytes: {given[row]!r}")
        return _frozen(given.astype(wanted))
    if given.size and given.dtype.kind not in "ui":
        raise StructureError(f"{name} must be integers, not {given.dtype.name}")
    bounds = np.iinfo(wanted)
    if given.size and (int(given.min()) < 0 or int(given.max()) > bounds.max):
        raise StructureError(f"{name} has a value outside 0 to {bounds.max}")
    return _frozen(given.astype(wanted))


def texts(column: npt.NDArray[np.bytes_]) -> list[str]:
    """The texts of a column of names."""
    return [text.decode(errors="replace") for text in column.tolist()]


def _frozen(array: npt.NDArray[_T]) -> npt.NDArray[_T]:
    array.flags.writeable = False
    return array


def _same_length(what: str, *columns: npt.NDArray[np.generic]) -> None:
    lengths = [len(column) for column in columns]
    if len(set(lengths)) > 1:
        raise StructureError(f"the {what} columns have different lengths: {lengths}")


def _within(what: str, owner: str, column: npt.NDArray[np.generic], count: int) -> None:
    if len(column) and int(column.max()) >= count:
        row = int(np.argmax(column))
        raise StructureError(f"{what} {row} belongs to {owner} {column[row]}, but there are only {count}")
