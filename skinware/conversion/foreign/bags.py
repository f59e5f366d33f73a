"""Read bags of ROS 1 and ROS 2 with the package rosbags: each topic is a table."""

from __future__ import annotations

import bz2
import contextlib
import functools
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from skinware.conversion.foreign.source import BLOCK_BYTES, ColumnSource, Rows, blamed
from skinware.conversion.tables import package
from skinware.errors import ConfigurationError
from skinware.limits import LIMITS
from skinware.realtime import NS_PER_S

LOG_TIME = "log_time"
"""The column with the time at which a message was recorded."""
_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of numbers in points."""
_PIXELS = {"8": "u1", "16": "u2", "32": "f4", "mono8": "u1", "mono16": "u2"}
_MOST_ROWS = 1000
_MCAP = "rosbag2.storage_mcap"


class BagSource(ColumnSource):
    """A bag: a ``.bag`` of ROS 1, a folder or an ``.mcap`` or ``.db3`` of ROS 2.

    Numbers in messages within messages are columns, as ``header.stamp``; lists of messages are arrays; a point cloud
    has a column for each of its fields, an image the column ``image``.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        bags = package("rosbags.highlevel", "bags of ROS")
        _bound_rosbags()
        stores = package("rosbags.typesys", "bags of ROS")
        self._files, self._miscounts = ExitStack(), dict[str, str]()
        with self._blamed("open it with its own tools, or record it again"):
            usual = stores.get_typestore(stores.Stores.LATEST)
            self._bag = self._files.enter_context(bags.AnyReader([path], default_typestore=usual))
        try:
            firsts = {topic: next(self._messages(topic), None) for topic in self._bag.topics}
        except BaseException:
            self.close()
            raise
        heard = {topic: first[1] for topic, first in firsts.items() if first is not None}
        self.left_out = {topic: "no message" for topic in firsts if topic not in heard}
        self.tables = {
            topic: {LOG_TIME: (), **{name: np.shape(each) for name, each in _columns(message).items()}}
            for topic, message in heard.items()
        }
        self.frames = {
            topic: getattr(getattr(message, "header", None), "frame_id", "") for topic, message in heard.items()
        }

    def blocks(self, table: str, names: Collection[str]) -> Iterator[Rows]:
        shapes, waiting, size = self.tables[table], dict[str, list[Any]]({name: [] for name in names}), 0
        for number, (time_ns, message) in enumerate(self._messages(table)):
            found = {LOG_TIME: time_ns, **_columns(message)}
            for name, parts in waiting.items():
                row = np.asarray(found.get(name, ()))
                if row.shape != shapes[name]:
                    raise ConfigurationError(
                        f"{self.path}, {table}, message {number + 1}: {name} has the shape {row.shape}, and had"
                        f" {shapes[name]} at first: a skin has a fixed shape"
                    )
                parts.append(row)
                size += row.nbytes
            if size > BLOCK_BYTES or number % _MOST_ROWS == _MOST_ROWS - 1:
                yield {name: np.stack(parts) for name, parts in waiting.items()}
                waiting, size = {name: [] for name in names}, 0
        if any(waiting.values()):
            yield {name: np.stack(parts) for name, parts in waiting.items()}

    @property
    def problems(self) -> Sequence[str]:
        return list(self._miscounts.values())

    def close(self) -> None:
        self._files.close()

    def _messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        bag = self._bag
        begin_ns, length_ns, count = bag.start_time, max(1, bag.duration), 0
        with self._blamed(f"recover the bag, or leave {topic} out of the map"):
            for connection, time_ns, data in bag.messages(bag.topics[topic].connections):
                self.share = (time_ns - begin_ns) / length_ns
                yield time_ns, bag.deserialize(data, connection.msgtype)
                count += 1
        if count != bag.topics[topic].msgcount:
            self._miscounts[topic] = f"{topic} has {count} messages, and should have {bag.topics[topic].msgcount}"

    def _blamed(self, what_to_do: str) -> contextlib.AbstractContextManager[None]:
        def say(reason: str) -> str:
            where = f" at {self.share:.0%}" if self.share else ""
            return f"{self.path}: no bag of ROS, or damaged{where} ({reason}): {what_to_do}"

        return blamed(say)


@functools.cache
def _bound_rosbags() -> None:
    """Let rosbags decompress no more than the limits allow, in memory and to files: it asks for no limit."""
    ros1, ros2, mcap = (import_module(f"rosbags.{name}") for name in ("rosbag1.reader", "rosbag2.reader", _MCAP))
    unbound, lz4 = ros2.zstd, _bounded(import_module("lz4.frame").LZ4FrameDecompressor)
    zstd = _bounded(unbound.ZstdDecompressor)

    @contextlib.contextmanager
    def opened(file: IO[bytes], mode: str) -> Iterator[SimpleNamespace]:
        most = LIMITS.room(os.fstat(file.fileno()).st_size)
        with unbound.open(file, mode) as stream:

            def read(size: int) -> bytes:
                if stream.tell() > most:
                    raise ValueError(f"its file becomes more than {most} bytes")
                data: bytes = stream.read(size)
                return data

            yield SimpleNamespace(read=read)

    ros1.decompressors.update(bz2=_bounded(bz2.BZ2Decompressor), lz4=lz4)
    mcap.DECOMPRESSORS.update(zstd=zstd, lz4=lz4)
    ros2.zstd = SimpleNamespace(open=opened, decompress=zstd)  # type: ignore[attr-defined]


def _bounded(make: Callable[[], Any]) -> Callable[..., bytes]:
    def decompress(data: bytes, *_: object) -> bytes:
        unpacker = make()
        unpacked: bytes = unpacker.decompress(data, LIMITS.chunk_size)
        if not unpacker.eof:
            raise ValueError(f"{len(data)} packed bytes end too early, or become more than {LIMITS.chunk_size} bytes")
        return unpacked

    return decompress


def _columns(message: Any) -> dict[str, Any]:
    kind = getattr(message, "__msgtype__", "")
    if kind == "sensor_msgs/msg/PointCloud2":
        return {**_column("header", message.header), **_points(message)}
    if kind == "sensor_msgs/msg/Image":
        return {**_column("header", message.header), **_image(message)}
    found: dict[str, Any] = {}
    for each in fields(message):
        found |= _column(each.name, getattr(message, each.name))
    return found


def _column(name: str, value: Any) -> dict[str, Any]:
    if hasattr(value, "sec") and hasattr(value, "nanosec"):
        return {name: value.sec * NS_PER_S + value.nanosec}
    if is_dataclass(value):
        return {f"{name}.{inner}": each for inner, each in _columns(value).items()}
    if isinstance(value, list) and value and all(map(is_dataclass, value)):
        rows = [_columns(each) for each in value]
        same = [inner for inner in rows[0] if len({np.shape(row.get(inner, ())) for row in rows}) == 1]
        return {f"{name}.{inner}": np.stack([row[inner] for row in rows]) for inner in same}
    numbers = np.asarray(value) if not isinstance(value, str | list) else np.zeros(0)
    return {name: numbers} if numbers.dtype.kind in "iufb" and (numbers.size or numbers.ndim > 1) else {}


def _points(message: Any) -> Mapping[str, npt.NDArray[Any]]:
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(
        {
            "names": [each.name for each in message.fields],
            "formats": [(order + _FIELDS[each.datatype], (each.count,)) for each in message.fields],
            "offsets": [each.offset for each in message.fields],
            "itemsize": message.point_step,
        }
    )
    rows = np.frombuffer(message.data, np.uint8)[: message.height * message.row_step].reshape(message.height, -1)
    points = np.ascontiguousarray(rows[:, : message.width * message.point_step]).view(dtype).ravel()
    return {name: points[name][:, 0] if points[name].shape[1] == 1 else points[name] for name in dtype.names or ()}


def _image(message: Any) -> Mapping[str, npt.NDArray[Any]]:
    encoding = str(message.encoding)
    code = _PIXELS.get(encoding) or _PIXELS.get("".join(filter(str.isdigit, encoding.partition("C")[0])), "u1")
    dtype = np.dtype((">" if message.is_bigendian else "<") + code)
    rows = np.frombuffer(message.data, np.uint8)[: message.height * message.step].reshape(message.height, -1)
    pixels = np.ascontiguousarray(rows[:, : message.step // dtype.itemsize * dtype.itemsize]).view(dtype)
    channels = max(1, pixels.shape[1] // max(1, message.width))
    return {"image": np.squeeze(pixels[:, : message.width * channels].reshape(message.height, message.width, channels))}
