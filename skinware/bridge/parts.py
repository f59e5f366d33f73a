"""Cut the sensors that a peer wants out of a driver, for as long as it asks for them."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware._columns import Index, as_index, texts
from skinware.bridge.messages import Service
from skinware.bridge.streaming import FrameStream
from skinware.errors import BadRecording, StructureError
from skinware.memory.file_layout import SLOT
from skinware.memory.ring import Sample
from skinware.memory.schema import Schema
from skinware.structure import Structure
from skinware.tactile.regions import SensorChoice
from skinware.text import names_in_patches
from skinware.transfer.generation import Generation, RecordedDriverSnapshot


@dataclass
class ServiceFile:
    """The file of a service up to its slots, packed and parsed at most once."""

    name: str
    raw: bytes

    @cached_property
    def packed(self) -> bytes:
        """Its bytes for the link; the first time takes milliseconds."""
        return zlib.compress(self.raw)

    @cached_property
    def driver(self) -> Generation | None:
        """The generation, if it is one of a driver that can be read."""
        try:
            generation = Generation(self.raw, self.name)
        except BadRecording:
            return None
        return generation if generation.is_driver else None


@dataclass
class ServedService:
    stream: FrameStream
    file: ServiceFile
    service: Service


class Cut:
    """Some sensors of a driver, by (n,) ascending positions in a frame, with their modules, patches and buses."""

    def __init__(self, whole: Generation, positions: npt.NDArray[np.int64]) -> None:
        structure = whole.structure
        if structure is None:
            raise StructureError(f"service {whole.name!r} is not a driver: it has no sensors")
        modules = np.unique(structure.sensor_module[positions])
        groups = np.unique(structure.sensor_group[positions])
        patches = np.unique(structure.module_patch[modules])
        buses = np.unique(structure.patch_bus[patches])
        rows_of: dict[str, tuple[int, npt.NDArray[Any]]] = {
            "values status": (structure.n_sensors, positions),
            "module_time_ns module_untouched": (structure.n_modules, modules),
            "group_time_ns": (structure.n_groups, groups),
            "patch_state patch_counters patch_interval_counts patch_age_counts": (structure.n_patches, patches),
            "bus_state bus_reason bus_since_ns bus_load bus_samples bus_counters bus_data_path": (
                len(structure.buses),
                buses,
            ),
        }
        columns = dict(whole.schema.columns)
        self._stay: list[tuple[str, int, int, Index]] = []  # of each column: name, rows, rows that stay, and which
        for names, (count, rows) in rows_of.items():
            for name in names.split():
                size = math.prod(columns[name].shape) if name in columns else 0
                if size:
                    columns[name] = replace(columns[name], shape=(size // count * len(rows),))
                    self._stay.append((name, count, len(rows), as_index(rows.astype(np.int64))))
        others = columns.keys() - {name for name, *_ in self._stay}
        self._stay += [(name, 1, 1, slice(0, 1)) for name in others if math.prod(columns[name].shape)]
        cut = _structure(structure, positions, groups, modules, patches, buses)
        self.file = ServiceFile(whole.name, whole.head_with(cut, Schema(columns, whole.schema.description)))
        self.generation: Generation = Generation(self.file.raw, whole.name)

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
    """Return the structure of what stays; modules without a name of their own keep the one that readers showed."""
    own = texts(whole.module_name), texts(whole.module_kind), whole.module_patch.tolist()
    module_names = names_in_patches(*own)
    types = set(whole.sensor_type[sensors].tolist())
    return whole.replace(
        types=[each for each in whole.types if each.id in types],
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


class RobotPart:
    """Some sensors of the drivers of a robot; ``stream_of`` makes the stream of a service.

    One thread calls ``fit``, ``expire`` and ``close``; others may call ``take`` and ``find`` meanwhile.

    Attributes:
        asked_ns: when a peer asked for it last.
    """

    def __init__(self, choice: SensorChoice, stream_of: Callable[[str], FrameStream]) -> None:
        self.choice, self._stream_of = choice, stream_of
        self.asked_ns: int = 0
        self._cuts: dict[str, tuple[Generation, Cut | None]] = {}  # by service, each with the whole generation
        self._streams: dict[str, FrameStream] = {}

    def fit(self, name: str, whole: Generation) -> bool:
        """Follow a driver to a generation; return whether that has any of the sensors."""
        known, cut = self._cuts.get(name, (None, None))
        if known is not whole:
            cut = None
            structure = whole.structure
            nothing = np.zeros(0, np.int64)
            wanted = nothing if structure is None else np.flatnonzero(self.choice.of(name, structure))
            if len(wanted):
                cut = Cut(whole, wanted)
                stream = self._streams.get(name) or self._stream_of(name)
                stream.begin(cut.generation.generation, cut.generation.coded, cut.frame)
                self._streams[name] = stream
            self._cuts[name] = whole, cut
        return cut is not None

    def take(self, name: str, frame: Sample) -> None:
        """Send the sensors of this part of a driver's frame, if the frame is of the known generation."""
        _, cut = self._cuts.get(name, (None, None))
        if cut is not None and cut.generation.generation == frame.generation:
            self._streams[name].take(frame)

    def find(self, name: str) -> tuple[ServiceFile, FrameStream] | None:
        _, cut = self._cuts.get(name, (None, None))
        return None if cut is None else (cut.file, self._streams[name])

    def expire(self) -> None:
        for stream in self._streams.values():
            stream.expire()

    def close(self) -> None:
        self._cuts.clear()
        for stream in self._streams.values():
            stream.close()
