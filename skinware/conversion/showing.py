"""Make the messages that viewers show of a driver: point clouds, images and a state."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.records import Schema

from skinware._columns import Index
from skinware.conversion import ros_messages
from skinware.conversion.ros_messages import Cdr, acquired_ns
from skinware.driver_snapshot import DriverSnapshot
from skinware.matrices import rows_and_columns
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S
from skinware.sensor_types import SensorType
from skinware.state import state_name
from skinware.status import BusState, PatchState
from skinware.structure import Structure
from skinware.text import distinct
from skinware.transfer.generation import Generation
from skinware.views.scene import shape_of

_FLOAT32, _UINT8 = 7, 2
"""Field types of a PointCloud2."""
_FIELDS = (
    *((name, _FLOAT32) for name in ("x", "y", "z", "intensity", "age")),
    ("status", _UINT8),
)
_POINT = np.dtype([(name, "<f4" if kind == _FLOAT32 else "u1") for name, kind in _FIELDS])
_NOT_IN_TOPICS = re.compile(r"[^A-Za-z0-9_]")


class ViewerMessage(NamedTuple):
    topic: str
    encoding: str
    schema: Schema
    data: bytes


class Showing:
    """Makes messages for viewers from the samples of one generation of a driver.

    Args:
        json_state: write the state as JSON; False: in a ``std_msgs/String``, for ROS 2.

    Attributes:
        has_points: whether the place of any sensor is known.
    """

    def __init__(self, name: str, structure: Structure, *, json_state: bool = True) -> None:
        self._name, self._structure, self._json_state = name, structure, json_state
        clouds = list(_clouds(name, structure))
        self.has_points: bool = bool(clouds)
        self._shown: list[_Cloud | _Image] = [*clouds, *_images(name, structure, only_grids=self.has_points)]

    @property
    def topics(self) -> dict[str, Schema]:
        return {each.topic: each.schema for each in self._shown}

    def messages(self, frame: DriverSnapshot, time_ns: int) -> Iterator[ViewerMessage]:
        """Yield the pictures and the state of a sample.

        Args:
            time_ns: time of publication, wall clock.
        """
        yield from self.pictures(frame, time_ns)
        yield self._state(frame)

    def pictures(
        self,
        frame: DriverSnapshot,
        time_ns: int,
        *,
        status: npt.NDArray[np.uint8] | None = None,
        wanted: Callable[[str], bool] = lambda _: True,
    ) -> Iterator[ViewerMessage]:
        """Yield the point clouds and images of a sample.

        Args:
            time_ns: time of publication, wall clock.
            status: (n_sensors,) status of the sensors; default: that of the sample.
            wanted: says for a topic whether to make its message.
        """
        status = frame.status if status is None else status
        shown = [each for each in self._shown if wanted(each.topic)]
        names = {each.type_name for each in shown}
        values = {name: self._structure.physical(frame.values, name) for name in names}
        stamp_ns = acquired_ns(frame, time_ns)
        for each in shown:
            yield each.message(frame, values[each.type_name], status, stamp_ns)

    def _state(self, frame: DriverSnapshot) -> ViewerMessage:
        structure = self._structure
        fresh = np.bincount(structure.sensor_patch[frame.status == 0], minlength=structure.n_patches)
        state = {
            "driver": self._name,
            "sequence": frame.sequence,
            "age_ms": (frame.published_ns - frame.acquired_ns) / 1e6,
            "patches": [
                {"name": name, "state": state_name(PatchState, state), "fresh": count}
                for name, state, count in zip(
                    structure.patch_names, frame.patch_state.tolist(), fresh.tolist(), strict=True
                )
            ],
            "buses": [
                {"name": name, "state": state_name(BusState, state), "load": load / 1000}
                for name, state, load in zip(
                    structure.buses, frame.bus_state.tolist(), frame.bus_load.tolist(), strict=True
                )
            ],
        }
        topic, text = f"/skin/{in_topic(self._name)}/state", json.dumps(state)
        if self._json_state:
            return ViewerMessage(topic, "json", ros_messages.STATE, text.encode())
        return ViewerMessage(topic, "cdr", ros_messages.TEXT, Cdr().text(text).done())


def in_topic(text: str) -> str:
    """A text as a part of a ROS topic: letters, digits and underscores, no digit first."""
    plain = _NOT_IN_TOPICS.sub("_", text)
    return f"_{plain}" if not plain or plain[0].isdigit() else plain


class _Cloud:
    """Sensors of one type whose places are known in one coordinate frame."""

    schema = ros_messages.POINTS

    def __init__(
        self, topic: str, type_name: str, frame: str, index: npt.NDArray[np.int64], rows: npt.NDArray[np.int64]
    ) -> None:
        self.topic, self.type_name = topic, type_name
        self._frame, self._index, self._rows = frame, index, rows
        self.points = np.zeros(len(rows), _POINT)

    def message(
        self, frame: DriverSnapshot, values: npt.NDArray[Any], status: npt.NDArray[np.uint8], time_ns: int
    ) -> ViewerMessage:
        self.points["intensity"], self.points["status"] = values[self._rows], status[self._index]
        seen_ns = frame.group_time_ns[frame.structure.sensor_group[self._index]]
        self.points["age"] = np.where(seen_ns, (frame.published_ns - seen_ns) / NS_PER_S, np.nan)
        cdr = Cdr().header(time_ns, self._frame).numbers("I", 1, len(self.points), len(_FIELDS))
        for number, (name, kind) in enumerate(_FIELDS):
            cdr.text(name).numbers("I", 4 * number).numbers("B", kind).numbers("I", 1)
        cdr.numbers("?", False).numbers("I", _POINT.itemsize, self.points.nbytes).array(self.points)
        is_dense = bool(np.isfinite(self.points["intensity"]).all())
        return ViewerMessage(self.topic, "cdr", self.schema, cdr.numbers("?", is_dense).done())


def _clouds(name: str, structure: Structure) -> Iterator[_Cloud]:
    geometry = structure.geometry
    if geometry is None:
        return
    for sensor_type in structure.types:
        positions = structure.index(sensor_type.name)
        frames = geometry.frame[positions]
        known = geometry.known[positions]
        found = sorted(set(frames[known].tolist()))
        for frame in found:
            rows = np.flatnonzero(known & (frames == frame))
            parts = ["points", in_topic(sensor_type.name), *([in_topic(frame)] * (len(found) > 1))]
            cloud = _Cloud("/".join(["/skin", in_topic(name), *parts]), sensor_type.name, frame, positions[rows], rows)
            for axis, letter in enumerate("xyz"):
                cloud.points[letter] = geometry.position_m[positions[rows], axis]
            yield cloud


class _Image:
    """Sensors of one type of a patch, side by side; the brighter, the more. Black: no sensor, or no good value."""

    schema = ros_messages.IMAGE

    def __init__(
        self, topic: str, frame: str, sensor_type: SensorType, index: Index, pixels: npt.NDArray[np.int64]
    ) -> None:
        self.topic, self.type_name = topic, sensor_type.name
        self._type, self._frame, self._index, self._pixels = sensor_type, frame, index, pixels
        self._is_bounded = math.isfinite(sensor_type.minimum) and math.isfinite(sensor_type.maximum)

    def message(
        self, _frame: DriverSnapshot, values: npt.NDArray[Any], status: npt.NDArray[np.uint8], time_ns: int
    ) -> ViewerMessage:
        good = (status[self._index] == 0) & np.isfinite(values)
        if self._is_bounded:
            span = max(self._type.maximum - self._type.minimum, 1e-30)
            scaled = np.clip((values - self._type.minimum) / span, 0, 1) * 65534 + 1
            shown = np.where(good, scaled, 0).astype("<u2")
        else:
            shown = np.where(good, values, 0).astype("<f4")
        image = np.append(shown, shown.dtype.type(0))[self._pixels]
        height, width = image.shape
        cdr = Cdr().header(time_ns, self._frame).numbers("I", height, width)
        cdr.text("mono16" if self._is_bounded else "32FC1").numbers("B", 0).numbers("I", width * image.itemsize)
        return ViewerMessage(self.topic, "cdr", self.schema, cdr.array(image.reshape(-1).view(np.uint8)).done())


def _images(name: str, structure: Structure, *, only_grids: bool) -> Iterator[_Image]:
    plain = [in_topic(each) for each in structure.patch_names]
    patches = [in_topic(each) for each in distinct(plain, list(map(str, range(len(plain)))), "")]
    kinds = [kind.decode(errors="replace") for kind in structure.module_kind.tolist()]
    for sensor_type in structure.types:
        index = structure.index(sensor_type.name)
        modules = structure.module_of(sensor_type.name)
        for patch, patch_name in enumerate(patches):
            of_patch = np.flatnonzero(structure.module_patch[modules] == patch)
            numbers = list(dict.fromkeys(modules[of_patch].tolist()))
            is_grid = all(rows_and_columns(kinds[module]) for module in numbers)
            if numbers and (is_grid or not only_grids):
                rows = [of_patch[modules[of_patch] == module] for module in numbers]
                pixels = _side_by_side([_pixels(kinds[m], each) for m, each in zip(numbers, rows, strict=True)])
                parts = ["image", in_topic(patch_name), in_topic(sensor_type.name)]
                topic = "/".join(["/skin", in_topic(name), *parts])
                yield _Image(topic, patch_name, sensor_type, index, pixels)


def _pixels(kind: str, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """(height, width) which of its sensors each pixel of a module is; -1: none. A sensor is a pixel, or two by two."""
    shape = shape_of(kind, len(rows))
    pixels = np.full((2 * shape.rows, shape.halves), -1)
    for row, (line, half) in zip(rows.tolist(), shape.cells, strict=True):
        pixels[2 * line : 2 * line + 2, half : half + 2] = row
    return pixels if any(half % 2 for _, half in shape.cells) else pixels[::2, ::2]


def _side_by_side(parts: Sequence[npt.NDArray[np.int64]]) -> npt.NDArray[np.int64]:
    """Modules in rows, with a pixel between them; -1 where there is none."""
    height, width = (max(part.shape[axis] for part in parts) for axis in (0, 1))
    columns = max(1, round(math.sqrt(len(parts) * height / width)))
    lines = -(-len(parts) // columns)
    pixels = np.full((lines * (height + 1) - 1, min(columns, len(parts)) * (width + 1) - 1), -1)
    for number, part in enumerate(parts):
        line, column = divmod(number, columns)
        top, left = line * (height + 1), column * (width + 1)
        pixels[top : top + part.shape[0], left : left + part.shape[1]] = part
    return pixels


RATE_HZ = 30.0


@dataclass
class _Driver:
    """``due_ns``: when its next frame is shown, wall clock."""

    generation: Generation
    showing: Showing
    due_ns: int = 0


class Viewers:
    """Messages for viewers, beside the frames that they are made of."""

    def __init__(self, *, json_state: bool = True) -> None:
        self._json_state, self._period_ns = json_state, round(NS_PER_S / RATE_HZ)
        self._drivers: dict[str, _Driver] = {}

    def messages(self, service: str, generation: Generation, frame: Sample, time_ns: int) -> Iterator[ViewerMessage]:
        """Yield the messages of a sample if the next ones of its driver are due.

        Args:
            time_ns: time of publication, wall clock.
        """
        if not isinstance(generation.context, Structure):
            return
        driver = self._drivers.get(service)
        if driver is None or driver.generation is not generation:
            showing = Showing(service, generation.context, json_state=self._json_state)
            driver = self._drivers[service] = _Driver(generation, showing, 0 if driver is None else driver.due_ns)
        if time_ns < driver.due_ns:
            return
        driver.due_ns = max(driver.due_ns + self._period_ns, time_ns + self._period_ns // 2)
        yield from driver.showing.messages(DriverSnapshot(generation, frame.slot), time_ns)
