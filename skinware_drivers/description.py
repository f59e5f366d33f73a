"""Describe the devices on a bus: patches of modules of channels, with the keys by which frames name them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from skinware.errors import StructureError
from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S
from skinware.sensor_types import SensorType
from skinware.status import LONGEST_PERIOD_S
from skinware.structure import Structure

_BUS_SHIFT = 32


@dataclass(frozen=True)
class Sensor:
    """One channel of a module that is a sensor.

    Attributes:
        type_name: name of one of the driver's types.
        uid: unique per type on its bus, below 2**32.
    """

    type_name: str
    uid: int


@dataclass(frozen=True)
class Module:
    """A part of a patch, with sensors on its channels.

    Attributes:
        channels: the sensor on each channel; None: no sensor, its values are dropped.
        key: the number by which frames name it within its patch.
        kind: of hardware, for people and geometry.
        name: within its patch, for people (``triangle 3``); default: its kind, numbered if the patch has several.
        period_s: nominal time between two of its updates, if it differs from that of its frames or the driver: a
            thermometer that sends once a second is fresh for three seconds.
    """

    channels: Sequence[Sensor | None]
    key: int = 0
    kind: str = ""
    name: str = ""
    period_s: float | None = None


@dataclass(frozen=True)
class Patch:
    """One microcontroller with its modules.

    Attributes:
        name: for people, unique on the bus.
        modules: its modules, in the order of the frame.
        key: the number by which frames name it on its bus.
    """

    name: str
    modules: Sequence[Module]
    key: int = 0


def taxels(count: int, *type_names: str, first_uid: int = 0) -> list[Sensor]:
    """Return the channels of ``count`` taxels with one or more axes; all axes of a taxel share its uid."""
    return [Sensor(name, first_uid + i) for i in range(count) for name in type_names or ("pressure",)]


@dataclass(frozen=True)
class SkinTables:
    """The descriptions of all buses: the structure, and the way from keys and channels into it.

    Attributes:
        patch_key: (bus, key) -> patch.
        module_key: (patch, key) -> module.
        channel_to_sensor: (n_modules, n_channels) int64, sensor of each channel; ``n_sensors`` = none.
        module_period_ns: (n_modules,) int64, declared nominal time between two updates of each module; 0: none.
    """

    structure: Structure
    patch_key: dict[tuple[int, int], int] = field(repr=False)
    module_key: dict[tuple[int, int], int] = field(repr=False)
    channel_to_sensor: npt.NDArray[np.int64] = field(repr=False)
    module_period_ns: npt.NDArray[np.int64] = field(repr=False)

    def placed(self, geometry: Geometry) -> SkinTables:
        """Return the same sensors with the positions of a geometry."""
        return replace(self, structure=self.structure.placed(geometry))


def uid_on_bus(bus: int, uid: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return the uids in the whole driver of sensors that have these uids on their bus."""
    return uid | np.uint64(bus << _BUS_SHIFT)


def join_types(types_of_buses: Sequence[Sequence[SensorType]]) -> list[SensorType]:
    """Return the types of all buses, each once.

    Raises:
        StructureError: two buses mean different things by one type.
    """
    known: dict[int, SensorType] = {}
    for types in types_of_buses:
        for sensor_type in types:
            other = known.setdefault(sensor_type.id, sensor_type)
            if other != sensor_type:
                raise StructureError(
                    f"the buses disagree on the type {sensor_type.name!r}: {other} and {sensor_type};"
                    " run a driver for each"
                )
    return list(known.values())


def assemble(
    buses: Sequence[tuple[str, Sequence[Patch]]], types: Sequence[SensorType], dtype: npt.DTypeLike
) -> SkinTables:
    """Return the patches of all buses in one structure; uid = bus index << 32 | the driver's uid.

    Raises:
        StructureError: no sensor at all, two patches or modules of one key, an unknown type, or no possible period.
    """
    type_ids = {t.name: t.id for t in types}
    patch_key: dict[tuple[int, int], int] = {}
    module_key: dict[tuple[int, int], int] = {}
    patch_name: list[str] = []
    patch_bus: list[int] = []
    module_patch: list[int] = []
    module_kind: list[str] = []
    module_name: list[str] = []
    period_ns: list[int] = []
    uids: list[int] = []
    sensor_type: list[int] = []
    sensor_module: list[int] = []
    channels: list[list[int]] = []
    for bus, (bus_name, patches) in enumerate(buses):
        for patch in patches:
            if (bus, patch.key) in patch_key:
                raise StructureError(f"bus {bus_name}: two patches answer to key {patch.key:#x}")
            patch_key[bus, patch.key] = len(patch_name)
            for module in patch.modules:
                if (len(patch_name), module.key) in module_key:
                    raise StructureError(f"{patch.name} on {bus_name}: two modules answer to key {module.key:#x}")
                module_key[len(patch_name), module.key] = len(module_patch)
                row = []
                for channel in module.channels:
                    row.append(-1 if channel is None else len(uids))
                    if channel is None:
                        continue
                    if channel.type_name not in type_ids:
                        raise StructureError(f"{patch.name}: the driver declares no type {channel.type_name!r}")
                    uids.append(bus << _BUS_SHIFT | channel.uid)
                    sensor_type.append(type_ids[channel.type_name])
                    sensor_module.append(len(module_patch))
                channels.append(row)
                module_patch.append(len(patch_name))
                module_kind.append(module.kind)
                module_name.append(module.name)
                period_s = module.period_s
                if period_s is not None and not 0 < period_s <= LONGEST_PERIOD_S:
                    raise StructureError(
                        f"{patch.name}, module {module.key:#x}: period_s = {period_s}: give more than 0, at most"
                        f" {LONGEST_PERIOD_S:g}"
                    )
                period_ns.append(0 if period_s is None else max(1, round(period_s * NS_PER_S)))
            patch_name.append(patch.name)
            patch_bus.append(bus)
    structure = Structure(
        types=types,
        buses=[name for name, _ in buses],
        patch_name=patch_name,
        patch_bus=patch_bus,
        module_patch=module_patch,
        module_kind=module_kind,
        module_name=module_name,
        sensor_uid=np.array(uids, np.uint64),
        sensor_type=sensor_type,
        sensor_module=sensor_module,
        group_period_ns=period_ns,
        dtype=dtype,
    )
    table = np.full((len(channels), max(map(len, channels))), -1, np.int64)
    for module_index, row in enumerate(channels):
        table[module_index, : len(row)] = row
    table[table < 0] = structure.n_sensors
    return SkinTables(structure, patch_key, module_key, table, structure.group_period_ns)
