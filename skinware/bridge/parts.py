"""Cut the sensors that a peer wants out of a driver, for as long as it asks for them."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from skinware import _names
from skinware._columns import Index, as_index, texts
from skinware.bridge.giving import Stream
from skinware.bridge.messages import Head, Wish
from skinware.errors import BridgeError, StructureError
from skinware.memory.file_layout import SLOT
from skinware.memory.ring import Sample
from skinware.memory.schema import Schema
from skinware.realtime import NS_PER_S, now_ns
from skinware.structure import Structure
from skinware.tactile.choosing import SensorChoice
from skinware.transfer.generation import Generation, RecordedDriverSnapshot

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

    def frame(self, frame: Sample) -> RecordedDriverSnapshot:
        slot = np.zeros(self.generation.slot_stride, np.uint8)
        slot[: SLOT.itemsize] = np.frombuffer(frame.slot, np.uint8, SLOT.itemsize)
        cut = RecordedDriverSnapshot(self.generation, memoryview(slot.data))
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


_KEPT_NS = 10 * NS_PER_S
"""How long a part is kept that nobody asks for."""
_MOST = 64


class Part:
    """Some sensors of the drivers of a robot.

    Args:
        choice: which.
        stream_of: makes what gives the frames of this part of a service.
    """

    def __init__(self, choice: SensorChoice, stream_of: Callable[[str], Stream]) -> None:
        self.choice, self._stream_of = choice, stream_of
        self._lock = threading.Lock()
        self._wholes: dict[str, Generation] = {}
        self._cuts: dict[str, Cut] = {}
        self._streams: dict[str, Stream] = {}

    def fit(self, name: str, whole: Generation) -> bool:
        """Go over to a generation of a driver; whether it has any of the sensors."""
        with self._lock:
            if self._wholes.get(name) is not whole:
                self._wholes[name] = whole
                self._cuts.pop(name, None)
                assert isinstance(whole.context, Structure)  # noqa: S101 - it is a driver
                wanted = np.flatnonzero(self.choice.of(name, whole.context))
                if len(wanted):
                    self._begin(name, Cut(whole, wanted))
            return name in self._cuts

    def take(self, name: str, frame: Sample) -> None:
        """Give what is of this part of a driver's frame, if it is of the generation that is known."""
        cut = self._cuts.get(name)
        if cut is not None and cut.generation.generation == frame.generation:
            self._streams[name].take(frame)

    def cut(self, name: str) -> Cut | None:
        """What there is of a driver."""
        return self._cuts.get(name)

    def stream(self, name: str) -> Stream | None:
        """What gives its frames."""
        return self._streams[name] if name in self._cuts else None

    def let_go(self) -> None:
        """Of questions that no frame comes for."""
        for stream in list(self._streams.values()):
            stream.let_go()

    def close(self) -> None:
        """Nothing is given any more."""
        with self._lock:
            self._cuts.clear()
            for stream in self._streams.values():
                stream.close()

    def _begin(self, name: str, cut: Cut) -> None:
        if name not in self._streams:
            self._streams[name] = self._stream_of(name)
        self._streams[name].begin(cut.generation.generation, cut.generation.coded, cut.frame)
        self._cuts[name] = cut


class Parts:
    """All parts that are wanted now.

    Args:
        stream_of: makes what gives the frames of a part: (service, number of the wish).
    """

    def __init__(self, stream_of: Callable[[str, str], Stream]) -> None:
        self._stream_of = stream_of
        self._lock = threading.Lock()
        self._parts: dict[str, Part] = {}
        self._asked_ns: dict[str, int] = {}

    def wanted(self, wish: Wish) -> Part:
        """The part of a wish, which is asked for now.

        Raises:
            BridgeError: there are too many others.
            ConfigurationError: the wish contradicts itself.
        """
        number = wish.number
        with self._lock:
            part = self._parts.get(number)
            if part is None:
                if len(self._parts) >= _MOST:
                    raise BridgeError(f"{_MOST} other parts of it are wanted already")
                part = Part(wish.choice(), lambda service: self._stream_of(service, number))
                self._parts[number] = part
            self._asked_ns[number] = now_ns()
            return part

    def find(self, number: str) -> Part | None:
        return self._parts.get(number)

    def take(self, name: str, frame: Sample) -> None:
        """Give what is of each part of a driver's frame."""
        for part in list(self._parts.values()):
            part.take(name, frame)

    def let_go(self) -> None:
        """Of parts that nobody wants any more, and of questions that no frame comes for."""
        time_ns = now_ns()
        with self._lock:
            over = [number for number, asked_ns in self._asked_ns.items() if time_ns - asked_ns > _KEPT_NS]
            for number in over:
                del self._asked_ns[number]
                self._parts.pop(number).close()
        for part in list(self._parts.values()):
            part.let_go()
