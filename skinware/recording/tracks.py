"""Read the samples of one recorded service, one by one or as whole columns."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from skinware._columns import Index, as_index
from skinware.errors import BadRecording, StructureError
from skinware.limits import LIMITS
from skinware.realtime import NS_PER_S
from skinware.status import is_fresh
from skinware.structure import Structure
from skinware.transfer.codec import HEADER, Run, runs
from skinware.transfer.generation import PER_SENSOR, Generation, RecordedSample, frames_of

if TYPE_CHECKING:
    from skinware.recording.mcap_reading import ChunkContents
    from skinware.recording.reading import Recording


class Series:
    """n samples of one service that have the same columns and tables.

    Args:
        origin: one of their generations.
        headers: (n,) of :data:`skinware.transfer.codec.HEADER`.
        time_s: (n,) time of publication, s since the recording began.
        columns: (n, ...) by name.

    Attributes:
        generation: (n,) uint64, number of each sample's generation.
        sequence: (n,) uint64, number of each sample in its generation; a jump means lost samples.
        acquired_ns: (n,) int64, newest time stamp of the data, CLOCK_MONOTONIC of the machine that recorded.
        published_ns: (n,) int64, time of publication by the same clock.
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
        """Concatenate one or more series of the same columns."""
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
        """Return one column of all samples, (n, ...).

        Raises:
            KeyError: no such column, or it was not read.
        """
        try:
            return self.columns[name]
        except KeyError:
            known = "was not read" if name in self.origin.columns else "is not there"
            raise KeyError(f"column {name!r} {known}; there are {', '.join(self.columns)}") from None

    def raw(self, type_name: str) -> npt.NDArray[Any]:
        """Return (n, sensors) raw counts of a type, in the order of ``structure.index``.

        Raises:
            StructureError: no such type; also raised by the other methods that take a type.
        """
        return self.column("values")[:, self.structure.span(type_name)]

    def physical(self, type_name: str) -> npt.NDArray[np.floating[Any]]:
        """Return (n, sensors) float32 values in the type's unit; float64 for raw values of int32."""
        return self.structure.physical(self.column("values"), type_name)

    def status_of(self, type_name: str) -> npt.NDArray[np.uint8]:
        """Return (n, sensors) uint8, bits of :class:`skinware.Status`."""
        return self.column("status")[:, self.structure.span(type_name)]

    def time_ns(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n, sensors) int64, the time of each sensor's data (of its update group); 0: never seen."""
        structure = self.structure
        times_ns = self.column("group_time_ns" if "group_time_ns" in self.origin.columns else "module_time_ns")
        return times_ns[:, structure.sensor_group[structure.span(type_name)]]

    def fresh(self, type_name: str, *, max_age_s: float | None = None) -> npt.NDArray[np.bool_]:
        """Return (n, sensors) bool: whether each value was fresh when its sample was published.

        Args:
            type_name: a sensor type.
            max_age_s: oldest fresh age; default: as for :meth:`skinware.DriverSnapshot.fresh`.
        """
        limits_ns = self.structure.age_limits_ns(self.origin.period_ns)[self.structure.span(type_name)]
        max_age_ns = limits_ns if max_age_s is None else round(max_age_s * NS_PER_S)
        at_ns = self.published_ns[:, np.newaxis]
        return is_fresh(self.status_of(type_name), self.time_ns(type_name), at_ns=at_ns, max_age_ns=max_age_ns)

    def __repr__(self) -> str:
        return f"<Series of {len(self)} samples of {self.origin.name!r}: {', '.join(self.columns)}>"


_FOR_DRIVERS = ("values", "status", "module_time_ns")


class Track:
    """The recorded samples of one service.

    Args:
        recording: the source of its chunks.
        name: of the service.
        channel: number of the channel of its samples.
        generations: the generations to read, by number.
        known: numbers of all generations that the recording describes; default: the same.
    """

    def __init__(
        self,
        recording: Recording,
        name: str,
        channel: int,
        generations: Mapping[int, Generation],
        known: Collection[int] | None = None,
    ) -> None:
        self._recording = recording
        self.name: str = name
        self.channel: int = channel
        self._generations = generations
        self._known: Collection[int] = generations.keys() if known is None else known

    @property
    def generations(self) -> tuple[Generation, ...]:
        """Its generations, by number."""
        return tuple(self._generations[number] for number in sorted(self._generations))

    def generation(self, number: int) -> Generation:
        """Return one of its generations."""
        return self._generations[number]

    @property
    def is_driver(self) -> bool:
        """Whether it is a driver."""
        return any(generation.is_driver for generation in self._generations.values())

    @property
    def parts(self) -> tuple[Track, ...]:
        """Successive tracks, one for each stretch in which the columns and tables stayed the same."""
        parts: list[dict[int, Generation]] = []
        for generation in self.generations:
            if not parts or next(iter(parts[-1].values())).digest != generation.digest:
                parts.append({})
            parts[-1][generation.generation] = generation
        return tuple(Track(self._recording, self.name, self.channel, part, self._known) for part in parts)

    @property
    def structure(self) -> Structure:
        """The structure of the driver.

        Raises:
            StructureError: the service is not a driver, or its structure changed.
        """
        origin = self._only_origin()
        if not isinstance(origin.context, Structure):
            raise StructureError(f"service {self.name!r} is not a driver: it has no sensors")
        return origin.context

    def samples(self, *, start_s: float = 0.0, end_s: float | None = None) -> Iterator[RecordedSample]:
        """Yield every sample in order; those of a driver as driver snapshots.

        Args:
            start_s: begin at this time, s since the recording began.
            end_s: end before this time; None: after the last sample.
        """
        for contents in self._recording.chunks({self.channel}, start_s, end_s):
            for time_s, frame in self.samples_in(contents):
                if time_s >= start_s and (end_s is None or time_s < end_s):
                    yield frame

    def samples_in(self, contents: ChunkContents) -> Iterator[tuple[float, RecordedSample]]:
        """Yield (time, sample) of each sample in a chunk; times in s since the recording began."""
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
        """Return whole columns of all samples.

        Args:
            columns: names; default: all columns; for a driver its values, status and times.
            type_name: only sensors of this type; the series has a structure of these alone.
            sensors: only some of this type, in the order of ``structure.index(type_name)``: a region, for instance.
            start_s: begin at this time, s since the recording began.
            end_s: end before this time; None: after the last sample.

        Raises:
            StructureError: the columns or tables changed meanwhile (read the ``parts`` one by one), or no such sensors.
            KeyError: no such column.
            BadRecording: a small file becomes more than the limits allow (:meth:`skinware.limits.Limits.room`).
        """
        request = self._request(columns, type_name, sensors)
        formats = request.origin.columns
        nothing = {name: np.zeros((0, *formats[name][0]), formats[name][1]) for name in request.columns}
        parts = [Series(request.origin, np.zeros(0, HEADER), np.zeros(0), nothing)]
        room = LIMITS.room(self._recording.size)
        for part in self._blocks(request, start_s, end_s):
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
        """Yield whole columns in pieces of a quarter of a second, for recordings that memory cannot hold.

        The arguments and errors are those of :meth:`read`.
        """
        return self._blocks(self._request(columns, type_name, sensors), start_s, end_s)

    def _blocks(self, request: _Request, start_s: float, end_s: float | None) -> Iterator[Series]:
        numbers = {column.name: number for number, column in enumerate(self._only_origin().coded)}
        for contents in self._recording.chunks({self.channel}, start_s, end_s):
            for part in self._decodable(contents):
                until_s = np.inf if end_s is None else end_s
                wanted = np.flatnonzero((part.time_s >= start_s) & (part.time_s < until_s))
                rows = slice(int(wanted[0]), int(wanted[-1]) + 1) if len(wanted) else slice(0)
                arrays = {name: part.column(numbers[name], rows) for name in request.columns}
                if request.positions is not None:
                    arrays |= {name: arrays[name][:, request.positions] for name in PER_SENSOR if name in arrays}
                yield Series(request.origin, part.run.headers[rows], part.time_s[rows], arrays)

    def _request(self, columns: Collection[str] | None, type_name: str | None, sensors: Index | None) -> _Request:
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
            return _Request(origin, names, None)
        positions = self.structure.index(type_name)
        index = as_index(positions if sensors is None else positions[sensors])
        return _Request(origin.only(index), names, index)

    def _only_origin(self) -> Generation:
        origins = self.generations
        if not origins:
            raise BadRecording(f"{self._recording.path}: the description of the samples of {self.name!r} is lost")
        if len({origin.digest for origin in origins}) > 1:
            raise StructureError(
                f"service {self.name!r} changed its columns or tables during the recording: use its parts"
            )
        return origins[0]

    def _decodable(self, contents: ChunkContents) -> Iterator[_PartOfChunk]:
        messages = [message for message in contents.messages if message.channel_id == self.channel]
        left = LIMITS.frames_size
        for number, which in runs([message.data for message in messages]):
            generation = self._generations.get(number)
            if generation is None:
                if number not in self._known:
                    self._recording.note(f"samples of {self.name!r} left out: their description is lost")
                continue
            left -= generation.slot_stride * (which.stop - which.start)
            if left < 0:
                what = f"samples that become more than {LIMITS.frames_size} bytes in one chunk"
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


class _Request(NamedTuple):
    """Which part of the samples to read.

    Attributes:
        origin: their generation, reduced to the sensors to read.
        positions: of these sensors in a sample; None: all.
    """

    origin: Generation
    columns: tuple[str, ...]
    positions: Index | None


class _PartOfChunk(NamedTuple):
    """The samples of one generation in one chunk; ``time_s``: (n,) s since the recording began."""

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
