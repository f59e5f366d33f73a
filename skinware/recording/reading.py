"""Read recordings: sample by sample, as snapshots, or as whole columns."""

from __future__ import annotations

import operator
from collections.abc import Collection, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec

from skinware.errors import BadRecording, ConfigurationError
from skinware.limits import LIMITS, read_json
from skinware.memory.namespace import is_name
from skinware.realtime import NS_PER_S
from skinware.recording.mcap_reading import ChunkContents, ChunkPlace, Damaged, McapMessage, McapSource
from skinware.recording.timeline import GONE, Moment, Timeline
from skinware.recording.topics import CLOCK, EVENTS, FRAME, GENERATION, about_of, newer_format, service_of, wire_of
from skinware.recording.tracks import Track
from skinware.recording.wire import WireTrack
from skinware.skin_layout import SkinLayout
from skinware.text import nearest_name
from skinware.transfer.collecting import LIVE, PAUSED
from skinware.transfer.generation import Generation, RecordedDriverSnapshot, RecordedSnapshot


@dataclass
class _Service:
    frame_channel: int = 0
    head_channel: int = 0
    generations: dict[int, Generation] = field(default_factory=dict)


_Int = Annotated[int, msgspec.Meta(ge=-LIMITS.time_ns, le=LIMITS.time_ns)]
_Count = Annotated[int, msgspec.Meta(ge=0, le=LIMITS.time_ns)]


class _Event(msgspec.Struct):
    event: str = ""
    service: str = ""
    time_ns: _Int = 0
    count: _Count = 0
    before: Annotated[int, msgspec.Meta(ge=0)] = 0
    why: str = ""


class _Clock(msgspec.Struct):
    monotonic_ns: _Int = 0
    realtime_ns: _Int = 0
    boottime_ns: _Int = 0
    boot: str = ""


class _AboutBus(msgspec.Struct):
    medium: str = ""
    options: dict[str, Any] = {}


class _About(msgspec.Struct):
    driver_type: str = ""
    listen_only: bool = False
    versions: dict[str, Any] = {}
    buses: dict[str, _AboutBus] = {}


_CHECKED: dict[str, type] = {EVENTS: _Event, CLOCK: _Clock}


class Recording:
    """A recording. Use it in one thread at a time.

    Damaged chunks are left out and named in ``problems``.

    Args:
        path: of the file.

    Attributes:
        is_whole: it ends with its summary; others can be read too, but more slowly (``skin-recover``).
        start_ns, end_ns: time of its first and last message, ns since 1970. Times between them follow
            CLOCK_MONOTONIC; ``clock`` says how the wall clock was set meanwhile.

    Raises:
        BadRecording: it is not a recording, or needs a newer version.
        OSError: it cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path: Path = Path(path)
        self._source = McapSource(self.path)
        self.is_whole: bool = self._source.is_whole
        self.start_ns: int = min((place.start_ns for place in self._source.chunks), default=0)
        self.end_ns: int = max((place.end_ns for place in self._source.chunks), default=0)
        self._topics: dict[str, int] = {}
        self._wires: dict[tuple[str, str], WireTrack] = {}
        self._abouts: dict[str, int] = {}
        self._problems: dict[str, None] = {}
        self._damaged: set[int] = set()
        self._unread: set[str] = set()
        try:
            self._services = self._find_services()
        except BaseException:
            self.close()
            raise

    @property
    def services(self) -> tuple[str, ...]:
        """Names of all services with samples, drivers among them."""
        return tuple(sorted(self._services))

    @property
    def drivers(self) -> tuple[str, ...]:
        """Names of the services that are drivers."""
        return tuple(name for name in self.services if self[name].is_driver)

    @property
    def wires(self) -> tuple[WireTrack, ...]:
        """The wires of the drivers, bus by bus, if they were recorded (``skin-record --wire``)."""
        return tuple(self._wires[key] for key in sorted(self._wires))

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._source.size

    @property
    def recorded_by(self) -> str:
        """Program and version that wrote the file, ``skinware 0.1.0``; empty if that is damaged."""
        return self._source.library

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last."""
        return (self.end_ns - self.start_ns) / NS_PER_S

    @property
    def events(self) -> list[dict[str, Any]]:
        """Events of services in order, each with its ``time_s``: see "Recordings" in the documentation."""
        return list(self._json(EVENTS))

    @property
    def clock(self) -> list[dict[str, Any]]:
        """The clocks of the machine at the same moments, once a second: see "Recordings" in the documentation."""
        return list(self._json(CLOCK))

    @property
    def missed(self) -> int:
        """Samples that were published meanwhile and could not be recorded."""
        return sum(event.get("count", 0) for event in self._json(EVENTS) if event.get("event") == "missed")

    @property
    def problems(self) -> list[str]:
        """Faults of the file that were found so far; complete when all of it was read."""
        damaged = self._source.damaged + len(self._damaged)
        chunks = [f"{damaged} chunk{'s' * (damaged > 1)} damaged and left out"] if damaged else []
        return [*chunks, *self._source.refused, *self._problems]

    def __getitem__(self, name: str) -> Track:
        """Return the recorded samples of a service.

        Raises:
            ConfigurationError: the recording has none; the message lists its services.
        """
        if name not in self._services:
            raise ConfigurationError(f"no service {name!r} in {self.path}{nearest_name(name, self.services)}")
        service = self._services[name]
        return Track(self, name, service.frame_channel, service.generations)

    def snapshots(
        self, drivers: Collection[str] | None = None, *, start_s: float = 0.0, end_s: float | None = None
    ) -> Iterator[RecordedSnapshot]:
        """Yield a snapshot whenever a driver published, as :class:`skinware.Skin` would have.

        A driver joins with its first sample, and leaves when it was closed or died.

        Args:
            drivers: names; None: all.
            start_s: begin at this time, s since the recording began.
            end_s: end before this time; None: after the last snapshot.
        """
        newest: dict[str, RecordedDriverSnapshot] = {}
        layout = SkinLayout((), ())
        for time_s, driver, frame, event in self.moments(self.drivers if drivers is None else drivers, end_s=end_s):
            if event in GONE:
                newest.pop(driver, None)
            if not isinstance(frame, RecordedDriverSnapshot):
                continue
            newest[driver] = frame
            names = tuple(sorted(newest))
            frames = tuple(newest[name] for name in names)
            structures = tuple(each.structure for each in frames)
            if names != layout.drivers or any(map(operator.is_not, structures, layout.structures)):
                layout = SkinLayout(names, structures)
            if time_s >= start_s:
                yield RecordedSnapshot(layout, frames, frame.published_ns, time_s)

    def moments(
        self, services: Collection[str] | None = None, *, start_s: float = 0.0, end_s: float | None = None
    ) -> Iterator[Moment]:
        """Yield every sample of several services, and the events that paused, resumed or ended them, by time.

        Args:
            services: names; None: all.
            start_s: begin at this time, s since the recording began.
            end_s: end before this time; None: after the last moment.
        """
        timeline = self.timeline(services)
        timeline.seek(start_s)
        while (moment := timeline.next()) is not None and (end_s is None or moment.time_s < end_s):
            yield moment

    def timeline(self, services: Collection[str] | None = None, *, ahead: Executor | None = None) -> Timeline:
        """Return the moments of several services, to move in forward and back.

        Args:
            services: names; None: all.
            ahead: see :class:`Timeline`.

        Raises:
            ConfigurationError: the recording has no samples of one of them.
        """
        names = self.services if services is None else tuple(services)
        for name in names:
            self[name]
        return Timeline(self, names, ahead)

    def close(self) -> None:
        """Close the file; data that were read stay valid. Idempotent."""
        self._source.close()

    def chunks(
        self, channels: Collection[int], start_s: float = 0.0, end_s: float | None = None
    ) -> Iterator[ChunkContents]:
        """Yield the chunks that may have messages of some channels within a time; for tracks."""
        for place in self._source.chunks:
            has_some = place.channel_ids is None or not place.channel_ids.isdisjoint(channels)
            begins_in_time = end_s is None or self.time_s(place.start_ns) < end_s
            if has_some and begins_in_time and self.time_s(place.end_ns) >= start_s:
                yield self._contents(place)

    def note(self, problem: str) -> None:
        """Note a fault of the file; for tracks."""
        self._problems[problem] = None

    # -- for timelines ------------------------------------------------------------------------------------------

    @property
    def places(self) -> list[ChunkPlace]:
        """Places of its chunks, in order."""
        return self._source.chunks

    def time_s(self, time_ns: int) -> float:
        """Return the time of a message, s since the recording began."""
        return (time_ns - self.start_ns) / NS_PER_S

    def may_have(self, place: ChunkPlace, services: Collection[str], *, events: bool = True) -> bool:
        """Return whether a chunk may have samples of some services, or events."""
        if place.channel_ids is None:
            return True
        channels = {self._services[name].frame_channel for name in services}
        return not place.channel_ids.isdisjoint(channels | {self._topics.get(EVENTS, 0)} if events else channels)

    def moments_in(self, place: ChunkPlace, services: Collection[str]) -> list[Moment]:
        """Return the moments of some services in a chunk, by time; none if it is damaged."""
        contents = self._contents(place)
        frames = [Moment(time_s, name, frame) for name in services for time_s, frame in self[name].samples_in(contents)]
        return sorted([*self._changes_in(contents, services), *frames], key=lambda moment: moment.time_s)

    def _changes_in(self, contents: ChunkContents, services: Collection[str]) -> list[Moment]:
        """Return the events of some services, none later than the samples after it in the file."""
        channels = {self._services[name].frame_channel: name for name in services}
        next_s: dict[str, float] = {}
        changes = []
        for message in reversed(contents.messages):
            time_s = self.time_s(message.time_ns)
            if message.channel_id in channels:
                next_s[channels[message.channel_id]] = time_s
            elif message.channel_id == self._topics.get(EVENTS):
                event = self._checked(EVENTS, message) or {}
                name, what = str(event.get("service")), str(event.get("event"))
                if name in services and what in (PAUSED, LIVE, *GONE):
                    next_s[name] = min(time_s, next_s.get(name, time_s))
                    changes.append(Moment(next_s[name], name, None, what))
        return changes[::-1]

    def _contents(self, place: ChunkPlace) -> ChunkContents:
        try:
            return self._source.contents(place)
        except Damaged:
            self._damaged.add(place.offset)
            return ChunkContents()

    # -- contents of the file -----------------------------------------------------------------------------------

    def _find_services(self) -> dict[str, _Service]:
        services: dict[str, _Service] = {}
        for channel in self._source.channels.values():
            newer = newer_format(channel)
            if newer is not None:
                raise BadRecording(f"{self.path}: recorded by a newer version ({newer}): update skinware to read it")
            self._topics[channel.topic] = channel.id
            driver = about_of(channel)
            if driver is not None:
                self._abouts[driver] = channel.id
            wire = wire_of(channel)
            if wire is not None:
                self._wires[wire] = WireTrack(self, *wire, channel.id)
            found = service_of(channel)
            if found is not None and not is_name(found[0]):
                self.note(f"a service {found[0][:48]!r} left out: no service can have this name")
            elif found is not None:
                service = services.setdefault(found[0], _Service())
                if found[1] == FRAME:
                    service.frame_channel = channel.id
                elif found[1] == GENERATION:
                    service.head_channel = channel.id
        if self._source.channels and not services and not self._problems and CLOCK not in self._topics:
            raise BadRecording(f"{self.path}: an MCAP file, but not a recording of a skin")
        self._read_heads(services)
        return {name: service for name, service in services.items() if service.frame_channel}

    def _read_heads(self, services: dict[str, _Service]) -> None:
        by_channel = {service.head_channel: name for name, service in services.items() if service.head_channel}
        for contents in self.chunks(by_channel):
            for message in contents.messages:
                name = by_channel.get(message.channel_id)
                if name is None:
                    continue
                try:
                    generation = Generation(bytes(message.data), name)
                except BadRecording as error:
                    self.note(str(error))
                else:
                    services[name].generations.setdefault(generation.generation, generation)

    def about(self, driver: str) -> dict[str, Any]:
        """Return the last description of a driver: see "Recordings" in the documentation.

        Empty if its wires were not recorded, and in files of earlier versions.
        """
        about: dict[str, Any] = {}
        channel = self._abouts.get(driver)
        for contents in self.chunks({channel} if channel is not None else ()):
            for message in contents.messages:
                if message.channel_id == channel:
                    about = self._checked(f"/wire/{driver}", message) or about
        return about

    def _json(self, topic: str) -> Iterator[dict[str, Any]]:
        channel = self._topics.get(topic, 0)
        for contents in self.chunks({channel}):
            for message in contents.messages:
                data = self._checked(topic, message) if message.channel_id == channel else None
                if data is not None:
                    yield {**data, "time_s": self.time_s(message.time_ns)}

    def _checked(self, topic: str, message: McapMessage) -> dict[str, Any] | None:
        """Return the fields of a JSON message; None, with a note, if they are not what they should be."""
        try:
            data = read_json(message.data, dict[str, Any])
            msgspec.convert(data, _CHECKED.get(topic, _About))
        except ValueError as error:
            if topic not in self._unread:
                self._unread.add(topic)
                where = f"the first at {self.time_s(message.time_ns):.3f} s"
                self.note(f"{topic}: unreadable messages left out, {where} ({error})")
            return None
        return data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Recording {self.path}: {', '.join(self.services) or 'nothing'}, {self.duration_s:.1f} s>"
