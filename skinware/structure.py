"""The structure of a skin: patches of modules of sensors, as plain numpy columns, fixed for one generation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from skinware import text
from skinware._columns import Index, as_index, column, frozen, group, same_length, texts, within
from skinware.errors import StructureError
from skinware.geometry import Geometry
from skinware.matrices import Matrices
from skinware.realtime import NS_PER_S
from skinware.sensor_types import SensorType, name_in_module
from skinware.status import LONGEST_PERIOD_S, age_limit_ns
from skinware.text import nearest_name

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
    ("sensor_group", "<u4"),
    ("group_module", "<u4"),
    ("group_period_ns", "<i8"),
)
_OWN_COLUMNS = tuple(name for name, _ in _COLUMNS if not name.startswith(("type_", "bus_")))
OF_GROUPS = ("sensor_group", "group_module", "group_period_ns")
"""Columns that a file has only where a module has several update groups, or a group a period of its own."""
_OPTIONAL = ("module_name", *OF_GROUPS)
"""Columns that files need not have: of earlier versions, or where every module is one update group."""


def _column(name: str, data: npt.ArrayLike) -> npt.NDArray[Any]:
    return column(name, data, dict(_COLUMNS)[name])


class Structure:
    """Immutable tables of one driver's skin.

    Attributes:
        types: the sensor types of this driver.
        buses: names of the buses that the patches are attached to.
        patch_name: (n_patches,) bytes.
        patch_bus: (n_patches,) uint32, index into ``buses``.
        module_patch: (n_modules,) uint32, index of the module's patch.
        module_kind: (n_modules,) bytes; hardware-specific (``triangle``, ``fingertip``).
        module_name: (n_modules,) bytes; within its patch (``triangle 3``), empty if the driver gives none.
        sensor_uid: (n_sensors,) uint64, unique per type.
        sensor_type: (n_sensors,) uint32, id of a type in ``types``.
        sensor_module: (n_sensors,) uint32, index of the sensor's module.
        sensor_group: (n_sensors,) uint32, index of the sensor's update group: sensors of a module that arrive together,
            and so have one time and one age.
        group_module: (n_groups,) uint32, ascending, index of the group's module. By default, each module is one group.
        group_period_ns: (n_groups,) int64, nominal time between two updates of a group; 0: the driver's period.
        dtype: dtype of the values, one of :data:`VALUE_DTYPES`.
        geometry: positions of the n_sensors sensors, in the same order; None if the driver does not publish them.

    Raises:
        StructureError: the tables contradict each other; the message names the row.
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
        sensor_group: npt.ArrayLike | None = None,
        group_module: npt.ArrayLike | None = None,
        group_period_ns: npt.ArrayLike | None = None,
        geometry: Geometry | None = None,
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
        self.sensor_group: npt.NDArray[np.uint32] = _column(
            "sensor_group", self.sensor_module if sensor_group is None else sensor_group
        )
        self.group_module: npt.NDArray[np.uint32] = _column(
            "group_module", np.arange(len(self.module_patch)) if group_module is None else group_module
        )
        self.group_period_ns: npt.NDArray[np.int64] = _column(
            "group_period_ns",
            np.zeros(len(self.group_module), np.int64) if group_period_ns is None else group_period_ns,
        )
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        self.geometry: Geometry | None = geometry
        self._check()

    def replace(self, **changes: Any) -> Structure:
        """Return the same tables, but for some: arguments as of the constructor.

        Raises:
            StructureError: they contradict the others.
        """
        own = ("types", "buses", "dtype", "geometry", *_OWN_COLUMNS)
        return Structure(**{name: getattr(self, name) for name in own} | changes)

    def only(self, positions: Index) -> Structure:
        """Return the same patches and modules with some of their sensors.

        Args:
            positions: in a sample, of the sensors that stay, in their order.

        Raises:
            StructureError: there are none.
        """
        return self.replace(
            sensor_uid=self.sensor_uid[positions],
            sensor_type=self.sensor_type[positions],
            sensor_module=self.sensor_module[positions],
            sensor_group=self.sensor_group[positions],
            geometry=None if self.geometry is None else self.geometry[positions],
        )

    def placed(self, geometry: Geometry) -> Structure:
        """Return the same sensors, at the places that a geometry has for them by type and uid."""
        by_id = {t.id: t.name for t in self.types}
        type_names = [by_id[type_id] for type_id in self.sensor_type.tolist()]
        return self.replace(geometry=geometry.at(type_names, self.sensor_uid))

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

    @property
    def n_groups(self) -> int:
        """Number of update groups."""
        return len(self.group_module)

    @cached_property
    def groups_are_modules(self) -> bool:
        """Whether every module is one update group, so that samples need no times of groups beside those of modules."""
        return np.array_equal(self.group_module, np.arange(self.n_modules))

    @cached_property
    def group_patch(self) -> npt.NDArray[np.uint32]:
        """(n_groups,) uint32, index of the patch that each update group belongs to."""
        return frozen(self.module_patch[self.group_module])

    def age_limits_ns(self, period_ns: int) -> npt.NDArray[np.int64]:
        """Return (n_sensors,) int64: how old the data of each sensor may be and still count as fresh.

        Args:
            period_ns: the driver's nominal period, for groups that have none of their own; 0 if it has none.
        """
        if period_ns not in self._age_limits_ns:
            self._age_limits_ns[period_ns] = frozen(self.group_age_limits_ns(period_ns)[self.sensor_group])
        return self._age_limits_ns[period_ns]

    def group_age_limits_ns(self, period_ns: int) -> npt.NDArray[np.int64]:
        """Return (n_groups,) int64: the same for each update group."""
        return np.array([age_limit_ns(own or period_ns) for own in self.group_period_ns.tolist()], np.int64)

    @cached_property
    def _age_limits_ns(self) -> dict[int, npt.NDArray[np.int64]]:
        return {}

    @cached_property
    def _matrices(self) -> dict[str, Matrices[str]]:
        return {}

    @cached_property
    def _index_by_type(self) -> dict[str, npt.NDArray[np.int64]]:
        return {t.name: frozen(np.flatnonzero(self.sensor_type == t.id)) for t in self.types}

    @cached_property
    def _span_by_type(self) -> dict[str, Index]:
        return {name: as_index(positions) for name, positions in self._index_by_type.items()}

    @cached_property
    def _conversion(self) -> tuple[npt.NDArray[np.floating[Any]], npt.NDArray[np.floating[Any]]]:
        """(n_sensors,) scale and (n_sensors,) offset of the sensors."""
        scale, offset = np.empty((2, self.n_sensors), np.float64 if self.dtype == np.int32 else np.float32)
        for t in self.types:
            span = self._span_by_type[t.name]
            scale[span], offset[span] = t.scale, t.offset
        return scale, offset

    @cached_property
    def _module_by_type(self) -> dict[str, npt.NDArray[np.int64]]:
        modules = self.sensor_module.astype(np.int64)
        return {name: frozen(modules[index]) for name, index in self._index_by_type.items()}

    @cached_property
    def _index_by_module(self) -> list[npt.NDArray[np.int64]]:
        return group(self.sensor_module, self.n_modules)

    @cached_property
    def sensor_patch(self) -> npt.NDArray[np.uint32]:
        """(n_sensors,) uint32, index of the patch that each sensor belongs to."""
        return frozen(self.module_patch[self.sensor_module])

    @cached_property
    def _index_by_patch(self) -> list[npt.NDArray[np.int64]]:
        return group(self.sensor_patch, self.n_patches)

    @cached_property
    def _position(self) -> dict[tuple[int, int], int]:
        pairs = zip(self.sensor_type.tolist(), self.sensor_uid.tolist(), strict=True)
        return {pair: position for position, pair in enumerate(pairs)}

    @cached_property
    def patch_names(self) -> tuple[str, ...]:
        """Name of every patch, as people know it: ``board 8``; of those that share one ``board 8 on can0``."""
        return text.distinct(texts(self.patch_name), [self.buses[bus] for bus in self.patch_bus.tolist()], "on")

    @cached_property
    def module_names(self) -> tuple[str, ...]:
        """Name of every module, as people know it: ``board 8, triangle 3``.

        Where the driver gives none, its kind and a number, both as they are in the patch; the only module of a patch
        is called as the patch.
        """
        return text.module_names(
            texts(self.module_name), texts(self.module_kind), self.module_patch.tolist(), self.patch_names
        )

    def sensor_name(self, position: int) -> str:
        """Return name of a sensor's place, as people know it: ``board 8, triangle 3, taxel 5``.

        All axes of a taxel have one name. Taxels are counted by uid from the lowest of their module, which is 0; the
        only one of a module is called as the module. Temperatures, accelerations and angular rates have the name of
        their type instead of ``taxel``.

        Args:
            position: in a sample.
        """
        return text.joined(self.module_names[self.sensor_module[position]], self.name_in_module(position))

    def sensor_names(self, type_name: str) -> list[str]:
        """``sensor_name`` of all sensors of a type, in the order of ``index(type_name)``.

        Raises:
            StructureError: no such type here.
        """
        of_type, module = self.index(type_name), self.module_of(type_name)
        lowest = np.full(self.n_modules, np.iinfo(np.uint64).max, np.uint64)
        np.minimum.at(lowest, self.sensor_module, self.sensor_uid)
        numbers = (self.sensor_uid[of_type] - lowest[module]).tolist()
        is_only = (np.bincount(module, minlength=self.n_modules) == 1)[module].tolist()
        return [
            text.joined(self.module_names[of], name_in_module(type_name, number, is_only=only))
            for of, number, only in zip(module.tolist(), numbers, is_only, strict=True)
        ]

    def name_in_module(self, position: int) -> str:
        """Return what ``sensor_name`` adds to the name of the module: ``taxel 5``; empty where it adds nothing."""
        of_module = self.module_index(int(self.sensor_module[position]))
        type_id = int(self.sensor_type[position])
        return name_in_module(
            next(t.name for t in self.types if t.id == type_id),
            int(self.sensor_uid[position] - self.sensor_uid[of_module].min()),
            is_only=int((self.sensor_type[of_module] == type_id).sum()) == 1,
        )

    def type(self, name: str) -> SensorType:
        """Return the driver's sensor type of this name.

        Raises:
            StructureError: no sensor of that type here; the message lists those there are.
        """
        for candidate in self.types:
            if candidate.name == name:
                return candidate
        raise StructureError(f"no sensor type {name!r} in this skin{nearest_name(name, [t.name for t in self.types])}")

    def index(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64, read-only: positions in a snapshot of all sensors of a type, ascending.

        Raises:
            StructureError: no such type here.
        """
        return self._index_by_type[self.type(type_name).name]

    def span(self, type_name: str) -> Index:
        """Return the positions of ``index`` as a slice where they lie together, so that arrays are not copied.

        Raises:
            StructureError: no such type here.
        """
        return self._span_by_type[self.type(type_name).name]

    def module_index(self, module: int) -> npt.NDArray[np.int64]:
        """Return (n,) int64, read-only: positions in a snapshot of the sensors of a module, ascending."""
        return self._index_by_module[module]

    def patch_index(self, patch: int) -> npt.NDArray[np.int64]:
        """Return (n,) int64, read-only: positions in a snapshot of the sensors of a patch, ascending."""
        return self._index_by_patch[patch]

    def position(self, type_name: str, uid: int) -> int:
        """Return position in a sample of one sensor.

        Raises:
            StructureError: no such type, or no sensor of that uid with this type.
        """
        sensor_type = self.type(type_name)
        try:
            return self._position[sensor_type.id, uid]
        except KeyError:
            raise StructureError(f"no {type_name} sensor with uid {uid:#x} in this skin") from None

    def module_of(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64, index of the module of each sensor of a type, in the order of ``index(type_name)``.

        Raises:
            StructureError: no such type here.
        """
        return self._module_by_type[self.type(type_name).name]

    def patch_of(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64, index of the patch of each sensor of a type, in the same order."""
        return self.module_patch[self.module_of(type_name)].astype(np.int64)

    def matrices(self, type_name: str) -> Matrices[str]:
        """Return the places of a type's sensors in modules that are matrices: indices into arrays as of ``index``.

        Returns:
            By names of modules, (rows, columns) int64.

        Raises:
            StructureError: no such type here.
        """
        module_of = self.module_of(type_name)
        if type_name not in self._matrices:
            self._matrices[type_name] = Matrices(type_name, self.module_names, texts(self.module_kind), module_of)
        return self._matrices[type_name]

    def physical(self, values: npt.NDArray[np.generic], type_name: str) -> npt.NDArray[np.floating[Any]]:
        """Physical values of all sensors of a type.

        Args:
            values: (..., n_sensors) raw values of a whole sample, or of many.
            type_name: which sensors to take.

        Returns:
            (..., n) float32 in the type's unit, in the order of ``index(type_name)``; float64 if the raw values are
            int32, which have more digits than float32 holds.
        """
        at, (scale, offset) = self.span(type_name), self._conversion
        physical: npt.NDArray[np.floating[Any]] = values[..., at].astype(scale.dtype) * scale[at] + offset[at]
        return physical

    def physical_values(self, values: npt.NDArray[np.generic]) -> npt.NDArray[np.floating[Any]]:
        """Return (..., n_sensors) physical values of all sensors, in their units; else as :meth:`physical`."""
        scale, offset = self._conversion
        physical: npt.NDArray[np.floating[Any]] = values.astype(scale.dtype) * scale + offset
        return physical

    def to_columns(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return the tables as named columns, for a service's file."""
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
        is_plain = self.groups_are_modules and not self.group_period_ns.any()
        tables = {
            name: np.asarray(data[name], dtype=code) if name in data else getattr(self, name)
            for name, code in _COLUMNS
            if not (is_plain and name in OF_GROUPS)
        }
        return tables | (self.geometry.to_columns() if self.geometry is not None else {})

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
        own = [name for name in _OWN_COLUMNS if name in columns]
        type_names = {t.id: t.name for t in types}
        return cls(
            types=types,
            buses=[name.decode() for name in columns["bus_name"].tolist()],
            dtype=dtype,
            geometry=Geometry.from_columns(
                columns, [type_names.get(type_id, "") for type_id in columns["sensor_type"].tolist()]
            ),
            **{name: np.array(columns[name]) for name in own},
        )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Structure):
            return NotImplemented
        if self.dtype != other.dtype:
            return False
        mine, theirs = self.to_columns(), other.to_columns()
        return mine.keys() == theirs.keys() and all(
            np.array_equal(mine[name], theirs[name], equal_nan=mine[name].dtype.kind == theirs[name].dtype.kind == "f")
            for name in mine
        )

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
        same_length("patch", self.patch_name, self.patch_bus)
        same_length("module", self.module_patch, self.module_kind, self.module_name)
        if self.geometry is not None and len(self.geometry) != self.n_sensors:
            raise StructureError(f"places of {len(self.geometry)} sensors, for {self.n_sensors}")
        same_length("sensor", self.sensor_uid, self.sensor_type, self.sensor_module)
        within("patch", "bus", self.patch_bus, len(self.buses))
        within("module", "patch", self.module_patch, self.n_patches)
        within("sensor", "module", self.sensor_module, self.n_modules)
        self._check_groups()
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

    def _check_groups(self) -> None:
        same_length("group", self.group_module, self.group_period_ns)
        if self.group_period_ns.size and self.group_period_ns.max() > LONGEST_PERIOD_S * NS_PER_S:
            raise StructureError(f"a period of {int(self.group_period_ns.max())} ns: give at most a day")
        same_length("sensor", self.sensor_uid, self.sensor_group)
        within("group", "module", self.group_module, self.n_modules)
        within("sensor", "group", self.sensor_group, self.n_groups)
        if (self.group_module[1:] < self.group_module[:-1]).any():
            raise StructureError("groups come in the order of their modules")
        foreign = self.group_module[self.sensor_group] != self.sensor_module
        if foreign.any():
            row = int(np.argmax(foreign))
            raise StructureError(f"sensor {row} is in a group of another module")
