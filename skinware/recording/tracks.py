"""Give what was recorded of one service: sample by sample, or as whole columns."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
import numpy.typing as npt

from skinware._columns import Index, as_index
from skinware.errors import BadRecording, StructureError
from skinware.limits import LIMITS
from skinware.realtime import NS_PER_S
from skinware.recording.mcap_reading import ChunkContents
from skinware.status import is_fresh
from skinware.structure import Structure
from skinware.transfer.codec import HEADER, Run, runs
from skinware.transfer.generation import PER_SENSOR, Generation, RecordedSample, frames_of


class Series:
    """n frames of one service, whose columns and tables are the same in all of them.

    Args:
        origin: one of their generations.
        headers: (n,) of :data:`skinware.transfer.codec.HEADER`.
        time_s: (n,) when each was published, s since the recording began.
        columns: (n, ...) by name.

    Attributes:
        origin, headers, time_s, columns: as given.
        generation: (n,) uint64, which incarnation of the service each frame belongs to.
        sequence: (n,) uint64, number of each within it; a gap are frames that were lost.
        acquired_ns: (n,) int64, newest time stamp of the data in each, CLOCK_MONOTONIC of the machine that recorded.
        published_ns: (n,) int64, when the writer handed it out, likewise.
        flags: (n,) uint64, bits for the service's own use.
    """

    def __init__(
        self,
        origin: Generation,
        headers: npt.NDArray[np.void],
        time_s: npt.NDArray[np.float64],
        columns: Mapping[str, npt.NDArray[Any]],
    ) -> None:
        self.origin, self.headers, self.columns = origin, headers, columns
        self.time_s = time_s
        self.generation: npt.NDArray[np.uint64] = headers["generation"]
        self.sequence: npt.NDArray[np.uint64] = headers["sequence"]
        self.acquired_ns: npt.NDArray[np.int64] = headers["acquired_ns"]
        self.published_ns: npt.NDArray[np.int64] = headers["published_ns"]
        self.flags: npt.NDArray[np.uint64] = headers["flags"]

    @classmethod
    def joined(cls, parts: Sequence[Series]) -> Series:
        """Join at least one series of the same columns, one after the other."""
        return cls(
            parts[0].origin,
            np.concatenate([part.headers for part in parts]),
            np.concatenate([part.time_s for part in parts]),
            {name: np.concatenate([part.column(name) for part in parts]) for name in parts[0].columns},
        )

    def __len__(self) -> int:
        return len(self.sequence)

    @property
    def structure(self) -> Structure:
        """The structure of the driver.

        Raises:
            StructureError: it is not a driver.
        """
        if not self.origin.is_driver:
            raise StructureError(f"service {self.origin.name!r} is not a driver: it has no sensors")
        return cast(Structure, self.origin.context)

    def column(self, name: str) -> npt.NDArray[Any]:
        """(n, ...) one column of all frames.

        Raises:
            KeyError: no such column, or it was not read.
        """
        try:
            return self.columns[name]
        except KeyError:
            known = "was not read" if name in self.origin.columns else "is not there"
            raise KeyError(f"column {name!r} {known}; there are {', '.join(self.columns)}") from None

    def raw(self, type_name: str) -> npt.NDArray[Any]:
        """(n, sensors) raw counts of all sensors of a type, in the order of ``structure.index``.

        Raises:
            StructureError: no such type here; the same for all that take a type.
        """
        return self.column("values")[:, self.structure.index(type_name)]

    def physical(self, type_name: str) -> npt.NDArray[np.floating[Any]]:
        """(n, sensors) float32 values in the type's unit; float64 where raw values are int32."""
        return self.structure.physical(self.column("values"), type_name)

    def status_of(self, type_name: str) -> npt.NDArray[np.uint8]:
        """(n, sensors) uint8, bits of :class:`skinware.Status`."""
        return self.column("status")[:, self.structure.index(type_name)]

    def time_ns(self, type_name: str) -> npt.NDArray[np.int64]:
        """(n, sensors) int64: time of the data of each sensor (of its update group), 0: never seen."""
        structure = self.structure
        times_ns = self.column("group_time_ns" if "group_time_ns" in self.origin.columns else "module_time_ns")
        return times_ns[:, structure.sensor_group[structure.index(type_name)]]

    def fresh(self, type_name: str, *, max_age_s: float | None = None) -> npt.NDArray[np.bool_]:
        """(n, sensors) bool: which could be trusted when their frame was published.

        Args:
            type_name: which sensors.
            max_age_s: the age beyond which nothing is fresh; default: as for :meth:`skinware.DriverSnapshot.fresh`.
        """
        limits_ns = self.structure.age_limits_ns(self.origin.period_ns)[self.structure.index(type_name)]
        max_age_ns = limits_ns if max_age_s is None else round(max_age_s * NS_PER_S)
        at_ns = self.published_ns[:, np.newaxis]
        return is_fresh(self.status_of(type_name), self.time_ns(type_name), at_ns=at_ns, max_age_ns=max_age_ns)

    def __repr__(self) -> str:
        return f"<Series of {len(self)} frames of {self.origin.name!r}: {', '.join(self.columns)}>"


_FOR_DRIVERS = ("values", "status", "module_time_ns")


class ChunkSource(Protocol):
    """Where the chunks of a recording come from."""

    path: Path
    start_ns: int

    @property
    def size(self) -> int:
        """Bytes of the file."""

    def chunks(
        self, channels: Collection[int], start_s: float = 0.0, end_s: float | None = None
    ) -> Iterator[ChunkContents]:
        """The chunks in which there may be messages of some channels, of a time."""

    def note(self, problem: str) -> None:
        """Something is wrong with the file."""


class Track:
    """What was recorded of one service.

    Args:
        recording: where it is.
        name: of the service.
        channel: number of the channel of its frames.
        generations: those whose frames are wanted, by number.
        told: all that are told in the recording; default: the same.

    Attributes:
        name: of the service.
    """

    def __init__(
        self,
        recording: ChunkSource,
        name: str,
        channel: int,
        generations: Mapping[int, Generation],
        told: Collection[int] | None = None,
    ) -> None:
        self._recording = recording
        self.name: str = name
        self.channel: int = channel
        self._generations = generations
        self._told: Collection[int] = generations.keys() if told is None else told

    @property
    def generations(self) -> tuple[Generation, ...]:
        """Its generations, in order."""
        return tuple(self._generations[number] for number in sorted(self._generations))

    def generation(self, number: int) -> Generation:
        """One of them, by its number."""
        return self._generations[number]

    @property
    def is_driver(self) -> bool:
        """Whether it is a driver."""
        return any(generation.is_driver for generation in self._generations.values())

    @property
    def parts(self) -> tuple[Track, ...]:
        """One for each time that its columns or tables changed; their frames are one after the other."""
        parts: list[dict[int, Generation]] = []
        for generation in self.generations:
            if not parts or next(iter(parts[-1].values())).digest != generation.digest:
                parts.append({})
            parts[-1][generation.generation] = generation
        return tuple(Track(self._recording, self.name, self.channel, part, self._told) for part in parts)

    @property
    def structure(self) -> Structure:
        """The structure of a driver.

        Raises:
            StructureError: it is not a driver, or had several.
        """
        origin = self._only_origin()
        if not isinstance(origin.context, Structure):
            raise StructureError(f"service {self.name!r} is not a driver: it has no sensors")
        return origin.context

    def frames(self, *, start_s: float = 0.0, end_s: float | None = None) -> Iterator[RecordedSample]:
        """Every frame, in order; those of a driver are driver frames.

        Args:
            start_s: where to begin, s since the recording began.
            end_s: where to end, likewise; default: with the last.
        """
        for contents in self._recording.chunks({self.channel}, start_s, end_s):
            for time_s, frame in self.frames_in(contents):
                if time_s >= start_s and (end_s is None or time_s < end_s):
                    yield frame

    def frames_in(self, contents: ChunkContents) -> Iterator[tuple[float, RecordedSample]]:
        """The frames in a chunk, each with its time, s since the recording began."""
        for part in self._decodable(contents):
            yield from zip(part.time_s.tolist(), frames_of(part.generation, part.run), strict=True)

    def read(
        self,
        columns: Collection[str] | None = None,
        *,
        type_name: str | None = None,
        sensors: Index | None = None,
        start_s: float = 0.0,
        end_s: float | None = None,
    ) -> Series:
        """Whole columns of all frames.

        Args:
            columns: names; default: all, of a driver values, status and times.
            type_name: only sensors of this type; the series then has a structure of these alone.
            sensors: of these, only some, in the order of ``structure.index(type_name)``: a region, for instance.
            start_s: where to begin, s since the recording began.
            end_s: where to end, likewise; default: with the last.

        Raises:
            StructureError: the columns or tables changed in between: read the ``parts`` one by one; or there are no
                such sensors.
            KeyError: no such column.
            BadRecording: a small file becomes more than the limits allow (:meth:`skinware.limits.Limits.room`).
        """
        asked = self._asked(columns, type_name, sensors)
        parts, room = [_nothing(asked)], LIMITS.room(self._recording.size)
        for part in self._blocks(asked, start_s, end_s):
            room -= sum(column.nbytes for column in part.columns.values())
            if room < 0:
                what = f"{self.name!r} becomes more than {LIMITS.room(self._recording.size)} bytes"
                raise BadRecording(f"{self._recording.path}: {what}: read fewer columns, a shorter time, or its blocks")
            parts.append(part)
        return Series.joined(parts)

    def blocks(
        self,
        columns: Collection[str] | None = None,
        *,
        type_name: str | None = None,
        sensors: Index | None = None,
        start_s: float = 0.0,
        end_s: float | None = None,
    ) -> Iterator[Series]:
        """The same in pieces of a quarter of a second, one after the other; for recordings that memory cannot hold.

        Args:
            columns: as for ``read``, which lists the errors.
            type_name: likewise.
            sensors: likewise.
            start_s: likewise.
            end_s: likewise.
        """
        return self._blocks(self._asked(columns, type_name, sensors), start_s, end_s)

    def _blocks(self, asked: _Asked, start_s: float, end_s: float | None) -> Iterator[Series]:
        numbers = {column.name: number for number, column in enumerate(self._only_origin().coded)}
        for part in self._runs(start_s, end_s):
            rows = _rows(part.time_s, start_s, end_s)
            arrays = {name: part.column(numbers[name], rows) for name in asked.columns}
            if asked.positions is not None:
                arrays |= {name: arrays[name][:, asked.positions] for name in PER_SENSOR if name in arrays}
            yield Series(asked.origin, part.run.headers[rows], part.time_s[rows], arrays)

    def _asked(self, columns: Collection[str] | None, type_name: str | None, sensors: Index | None) -> _Asked:
        origin = self._only_origin()
        if columns is not None:
            names = tuple(columns)
        elif origin.is_driver:
            names = (*_FOR_DRIVERS, *({"group_time_ns"} & origin.columns.keys()))
        else:
            names = tuple(origin.columns)
        for name in names:
            if name not in origin.columns:
                raise KeyError(f"no column {name!r}; there are {', '.join(origin.columns)}")
        if type_name is None:
            if sensors is not None:
                raise StructureError("sensors are counted by type: give type_name")
            return _Asked(origin, names, None)
        positions = np.arange(self.structure.n_sensors)[self.structure.index(type_name)]
        index = as_index(positions if sensors is None else positions[sensors])
        return _Asked(origin.only(index), names, index)

    def _only_origin(self) -> Generation:
        origins = self.generations
        if not origins:
            raise BadRecording(f"{self._recording.path}: what the frames of {self.name!r} are made of is lost")
        if len({origin.digest for origin in origins}) > 1:
            raise StructureError(
                f"service {self.name!r} changed its columns or tables during the recording: use its parts"
            )
        return origins[0]

    def _runs(self, start_s: float, end_s: float | None) -> Iterator[_PartOfChunk]:
        for contents in self._recording.chunks({self.channel}, start_s, end_s):
            yield from self._decodable(contents)

    def _decodable(self, contents: ChunkContents) -> Iterator[_PartOfChunk]:
        messages = [message for message in contents.messages if message.channel_id == self.channel]
        left = LIMITS.frames_size
        for number, which in runs([message.data for message in messages]):
            generation = self._generations.get(number)
            if generation is None:
                if number not in self._told:
                    self._recording.note(f"frames of {self.name!r} left out: what they are made of is lost")
                continue
            left -= generation.slot_stride * (which.stop - which.start)
            if left < 0:
                what = f"frames that become more than {LIMITS.frames_size} bytes in one chunk"
                self._recording.note(f"{self.name}: {what} left out")
                continue
            try:
                run = Run([message.data for message in messages[which]], generation.coded)
            except BadRecording as error:
                self._recording.note(f"{self.name}: {error}")
                continue
            times_ns = np.array([message.time_ns for message in messages[which]], np.int64)
            yield _PartOfChunk(generation, run, (times_ns - self._recording.start_ns) / NS_PER_S)

    def __repr__(self) -> str:
        return f"<Track of {self.name!r}>"


class _Asked(NamedTuple):
    """What is wanted of the frames.

    Attributes:
        origin: what they are made of, with no other sensors.
        columns: names.
        positions: in a frame, of the sensors; None: all.
    """

    origin: Generation
    columns: tuple[str, ...]
    positions: Index | None


class _PartOfChunk(NamedTuple):
    """Frames of one generation that stand in one chunk.

    Attributes:
        generation, run: they.
        time_s: (n,) of each, s since the recording began.
    """

    generation: Generation
    run: Run
    time_s: npt.NDArray[np.float64]

    def column(self, number: int, rows: slice) -> npt.NDArray[Any]:
        coded = self.generation.coded[number]
        shape, dtype, _ = self.generation.columns[coded.name]
        words = np.empty((len(self.time_s), coded.count), coded.words)
        self.run.decode(number, words)
        wanted = words[rows]
        return wanted.view(np.uint8).view(dtype).reshape(len(wanted), *shape)


def _nothing(asked: _Asked) -> Series:
    formats = asked.origin.columns
    columns = {name: np.zeros((0, *formats[name][0]), formats[name][1]) for name in asked.columns}
    return Series(asked.origin, np.zeros(0, HEADER), np.zeros(0), columns)


def _rows(time_s: npt.NDArray[np.float64], start_s: float, end_s: float | None) -> slice:
    """The rows within a time, from the first to the last of them."""
    wanted = np.flatnonzero((time_s >= start_s) & (time_s < (np.inf if end_s is None else end_s)))
    return slice(int(wanted[0]), int(wanted[-1]) + 1) if len(wanted) else slice(0)
