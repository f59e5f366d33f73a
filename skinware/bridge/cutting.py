"""Some sensors of a driver, cut out of it: the structure of those alone, and its frames."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from skinware import _names
from skinware._columns import Index, as_index, texts
from skinware.bridge.messages import Head
from skinware.errors import StructureError
from skinware.memory.file_layout import SLOT
from skinware.memory.ring import Sample
from skinware.memory.schema import Schema
from skinware.structure import Structure
from skinware.transfer.frames import RecordedDriverFrame
from skinware.transfer.generation import Generation

_OF_SENSORS = ("values", "status")
_OF_MODULES = ("module_time_ns", "module_untouched")
_OF_GROUPS = ("group_time_ns",)
_OF_PATCHES = ("patch_state", "patch_counters", "patch_interval_counts", "patch_age_counts")
_OF_BUSES = (
    "bus_state", "bus_reason", "bus_since_ns", "bus_load", "bus_samples", "bus_counters", "bus_data_path",
)  # fmt: skip


class Cut:
    """A part of a generation of a driver: some sensors, with their modules, patches and buses.

    Args:
        whole: the generation.
        positions: (n,) of the sensors that stay, in a frame, ascending.

    Attributes:
        generation: of the same number, with what stays.
        head: its file up to its slots.

    Raises:
        StructureError: it is not a driver, or no sensor stays.
    """

    def __init__(self, whole: Generation, positions: npt.NDArray[np.int64]) -> None:
        if not isinstance(whole.context, Structure):
            raise StructureError(f"service {whole.name!r} is not a driver: it has no sensors")
        structure = whole.context
        modules = np.unique(structure.sensor_module[positions])
        groups = np.unique(structure.sensor_group[positions])
        patches = np.unique(structure.module_patch[modules])
        buses = np.unique(structure.patch_bus[patches])
        rows_of = (
            (_OF_SENSORS, structure.n_sensors, positions),
            (_OF_MODULES, structure.n_modules, modules),
            (_OF_GROUPS, structure.n_groups, groups),
            (_OF_PATCHES, structure.n_patches, patches),
            (_OF_BUSES, len(structure.buses), buses),
        )
        columns = dict(whole.schema.columns)
        self._stay: list[tuple[str, int, int, Index]] = []  # of a column: rows there were, rows that stay, and which
        for names, count, rows in rows_of:
            for name in names:
                size = math.prod(columns[name].shape) if name in columns else 0
                if size:
                    columns[name] = replace(columns[name], shape=(size // count * len(rows),))
                    self._stay.append((name, count, len(rows), as_index(rows.astype(np.int64))))
        others = columns.keys() - {name for name, *_ in self._stay}
        self._stay += [(name, 1, 1, slice(0, 1)) for name in others if math.prod(columns[name].shape)]
        cut = _structure(structure, positions, groups, modules, patches, buses)
        self.head = Head(whole.head_with(cut, Schema(columns, whole.schema.description)))
        self.generation: Generation = Generation(self.head.raw, whole.name)

    def frame(self, frame: Sample) -> RecordedDriverFrame:
        slot = np.zeros(self.generation.slot_stride, np.uint8)
        slot[: SLOT.itemsize] = np.frombuffer(frame.slot, np.uint8, SLOT.itemsize)
        cut = RecordedDriverFrame(self.generation, memoryview(slot.data))
        for name, count, n_stay, rows in self._stay:
            cut.column(name).reshape(n_stay, -1)[...] = frame.column(name).reshape(count, -1)[rows]
        return cut


def _structure(
    whole: Structure,
    sensors: npt.NDArray[np.int64],
    groups: npt.NDArray[np.uint32],
    modules: npt.NDArray[np.uint32],
    patches: npt.NDArray[np.uint32],
    buses: npt.NDArray[np.uint32],
) -> Structure:
    """The structure of what stays; modules that had no name of their own keep the one that they were known by."""
    own = texts(whole.module_name), texts(whole.module_kind), whole.module_patch.tolist()
    module_names = _names.names_in_patches(*own)
    there = set(whole.sensor_type[sensors].tolist())
    return whole.replace(
        types=[each for each in whole.types if each.id in there],
        buses=[whole.buses[bus] for bus in buses.tolist()],
        patch_name=whole.patch_name[patches],
        patch_bus=np.searchsorted(buses, whole.patch_bus[patches]),
        module_patch=np.searchsorted(patches, whole.module_patch[modules]),
        module_kind=whole.module_kind[modules],
        module_name=[module_names[module].encode() for module in modules.tolist()],
        sensor_uid=whole.sensor_uid[sensors],
        sensor_type=whole.sensor_type[sensors],
        sensor_module=np.searchsorted(modules, whole.sensor_module[sensors]),
        sensor_group=np.searchsorted(groups, whole.sensor_group[sensors]),
        group_module=np.searchsorted(modules, whole.group_module[groups]),
        group_period_ns=whole.group_period_ns[groups],
        geometry=None if whole.geometry is None else whole.geometry[as_index(sensors)],
    )
