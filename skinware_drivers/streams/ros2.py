"""Topics of ROS 2 as a skin: point clouds, pictures, arrays, forces, known messages of tactile sensors, and any other.

A sample of a topic (a record of :mod:`skinware_drivers.streams.dds`) becomes a frame for each of its modules: the
source's time u32, the values as the message has them, a status byte for each if the map names a field for it, and the
message's number if the map names one. The places of the values in a sample are learnt of one, and hold as long as all
lengths and texts in it stay the same.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.geometry import Geometry
from skinware.ros_types import Definitions
from skinware.sensor_types import SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Patch, Sensor
from skinware_drivers.fields import NO_NUMBER, AnyFlag, Identifier, Match, SequenceNumber, StatusBytes
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.operations import operation
from skinware_drivers.options import Options
from skinware_drivers.polling import Notice
from skinware_drivers.serial.framing import Framing
from skinware_drivers.serial.framings import Split
from skinware_drivers.streams.cdr import CdrMessage
from skinware_drivers.streams.dds import LONGEST, SOURCE_TIME, DdsAdapter, DdsTopic, TopicBus, samples
from skinware_drivers.streams.ros2_map import guessed, preset, read_map, texts_of
from skinware_drivers.streams.ros2_parts import MOST_VALUES, Making, ModulePart, Plan
from skinware_drivers.streams.ros2_presets import PRESETS, TEXTS

_TYPES = 64
"""Numbers of a topic: one for each type that it may have; the last is that of a map."""
_MOST_TOPICS, _MOST_PARTS, _MOST_LISTED = 128, 190, 20
_NEWS, _NO_MESSAGE = 0, 0x7FF
_FIRST_S, _LISTEN_S, _AGAIN_S = 5.0, 0.05, 5.0
_LIST_EVERY = 64
_NUMBER = struct.Struct("<H")
_DTYPES = (np.uint8, np.int16, np.uint16, np.int32, np.float32)

Key = tuple[str, str]
"""Names of a patch and a module."""


class Ros2Options(Options, frozen=True):
    topic: Annotated[
        tuple[str, ...], Meta(description="topics; with =TYPE if not any known type is to be read, as /t=std_msgs/Int8")
    ] = ("/touch",)
    map: Annotated[
        str, Meta(description="TOML file with topics and the meaning of their fields, in place of topic")
    ] = ""
    time: Annotated[
        Literal["source", "header"], Meta(description="time of the values: when published, or by the message's header")
    ] = "source"
    period_ms: Annotated[float, Meta(ge=1, le=10_000, description="nominal time between two messages, ms")] = 20
    learn_s: Annotated[
        float, Meta(ge=0.05, le=60, description="time to learn topics, modules and rates after the first message, s")
    ] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _topics(self)


class Ros2Driver(DdsAdapter[Ros2Options]):
    """Topics; a patch is a topic, or as the map says. uid = number of the module << 16 | taxel."""

    reads_any_name = True
    topics: Sequence[DdsTopic] = ()
    types: Sequence[SensorType] = ()
    dtype: npt.DTypeLike = np.float32
    layout: Layout
    payload_size = 8 + 9 * MOST_VALUES

    def __init__(self, options: Ros2Options) -> None:
        super().__init__(options)
        self.period_s: float = options.period_ms / 1e3
        self.geometry: Geometry | None = None
        self._reading = {topic.number: (topic, making) for topic, making in _topics(options)}
        self.topics = [topic for topic, _ in self._reading.values()]
        self.framing: Framing = Split(samples(LONGEST), self._split)
        self._plans: dict[int, Plan] = {}
        self._parts: dict[Key, tuple[int, ModulePart]] = {}
        self._uids: dict[Key, int] = {}
        self._identifiers: dict[Key, tuple[int, Any]] = {}
        self._described: Sequence[Patch] = ()

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Learn the modules of the first messages."""
        self._parts.clear()
        self._plans.clear()
        return await self.join(link, ())

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:  # noqa: ARG002
        """Return all modules that were heard so far, in their newest form."""
        await self._hear(link)
        self._collect()
        if not self._parts:
            raise HandshakeTimeout(f"{link.bus_name}: {self._nothing()}")
        self._described = self._describe()
        return self._described

    async def attend(self, link: Link) -> None:
        """Notice modules that come later, or in another form."""
        with link.follow(Match(_NEWS)) as news:
            while True:
                await news.get()
                if self._described and not all(map(self._is_known, self._plans.values())):
                    self.tell(self._described[0], Notice.CHANGED)
                    await link.sleep(_AGAIN_S)

    @operation(looks=True, alone=True)
    async def write_map(
        self,
        link: Link,
        patches: Sequence[Patch],  # noqa: ARG002
        file: str = "map.toml",
        definitions: str = "",
    ) -> str:
        """Write a map of the first topic, guessed of one message, as a file for --map."""
        if not isinstance(self._line, TopicBus):
            raise BusError(f"{link.bus_name}: maps are written of topics, as on dds://0")
        name, kept = self.topics[0].name, list[bytes]()

        def keep(_number: int, body: bytes) -> Iterable[tuple[int, bytes]]:
            kept.append(body[SOURCE_TIME.end :])
            return ()

        known: Definitions | None = None
        for _ in range(round(2 * _FIRST_S / _LISTEN_S)):
            heard = [one.ros_type for one in self._line.heard() if one.topic == name and one.ros_type]
            if heard and known is None:
                known = texts_of(heard[0], definitions)
                self.change_framing(Split(samples(LONGEST), keep))
                self._line.read_only(DdsTopic(name, known, _TYPES - 1))
            if kept and known is not None:
                text = guessed(_in_ros(name), heard[0], CdrMessage(kept[0], known), known)
                await asyncio.to_thread(Path(file).write_text, text, encoding="utf-8")
                return f"{file}: {text.count('[[topic.values]]') or 'no'} fields of {heard[0]}; correct what it guesses"
            await link.sleep(_LISTEN_S)
        raise BusError(f"{link.bus_name}: {self._nothing()}")

    async def _hear(self, link: Link) -> None:
        """Listen for the first message, and then for a while to learn the others and their rates."""
        for plan in self._plans.values():
            plan.messages = 0
        learning = 0
        with link.follow(Match(_NEWS)) as news:
            for _ in range(round(_FIRST_S / _LISTEN_S)):
                await link.sleep(_LISTEN_S)
                while not news.empty():
                    number, sample = _NUMBER.unpack_from(data := news.get_nowait().payload)[0], data[_NUMBER.size :]
                    with contextlib.suppress(ValueError, KeyError):
                        if sample and number not in self._plans:  # the framing is of another object
                            self._plan(number, sample)
                learning += bool(self._plans)
                if learning * _LISTEN_S >= self.options.learn_s:
                    return

    def _collect(self) -> None:
        """Keep the modules of the newest messages."""
        for number, plan in sorted(self._plans.items()):
            for part in plan.parts:
                key = part.patch, part.name
                if self._parts.get(key, (number, part))[0] != number:
                    self.log_once(f"{part.name} of {part.patch} is in two topics: one is shown")
                elif key not in self._parts and len(self._parts) >= _MOST_PARTS:
                    self.log_once(f"more than {_MOST_PARTS} modules: {part.name} of {part.patch} is not shown")
                else:
                    self._parts[key] = number, part

    def _describe(self) -> Sequence[Patch]:
        modules: dict[str, list[Module]] = {}
        frames, places = [], []
        keys = {name: key for key, name in enumerate(dict.fromkeys(patch for patch, _ in self._parts))}
        topics = {name: {number for (patch, _), (number, _) in self._parts.items() if patch == name} for name in keys}
        identifiers = {}
        for number, ((patch, name), (topic, part)) in enumerate(self._parts.items(), 1):
            uid = self._uid(patch, name, topic)
            identifiers[patch, name] = number, part.form
            types = [each.name for each in part.types]
            sensors = [Sensor(each, uid + taxel) for taxel in range(part.taxels) for each in types]
            period_s = self._plans[topic].period_s(self.options.learn_s)
            slow = period_s if period_s > 1.5 * self.period_s else None
            modules.setdefault(patch, []).append(Module(sensors, key=number, kind=part.kind, name=name, period_s=slow))
            frames.append(_frame(number, part, keys[patch], is_timed=len(topics[patch]) == 1))
            if part.position_m is not None:
                places.append(_places(part, part.position_m, uid))
        self.types = self._types()
        widest = np.result_type(*(part.dtype for _, part in self._parts.values()))
        self.dtype = next((each for each in _DTYPES if np.can_cast(widest, each)), np.float32)
        self.geometry = Geometry.joined(places) if places else None
        self.layout, self._identifiers = Layout(frames), identifiers
        return [Patch(name, modules[name], key=key) for name, key in keys.items()]

    def _uid(self, patch: str, name: str, topic: int) -> int:
        """Return the uid of a module's first taxel, which stays the same."""
        ordinal = topic // _TYPES
        index = sum(uid >> 24 == ordinal for uid in self._uids.values())
        return self._uids.setdefault((patch, name), ordinal << 24 | index << 16)

    def _types(self) -> Sequence[SensorType]:
        types: dict[str, SensorType] = {}
        for (patch, name), (_, part) in self._parts.items():
            for each in part.types:
                if types.setdefault(each.name, each) != each:
                    raise BusError(
                        f"{name} of {patch}: {each.name} in {each.unit}, and elsewhere in {types[each.name].unit}: read"
                        " them by two drivers, or give the map another quantity"
                    )
        return tuple(types.values())

    def _nothing(self) -> str:
        """Return why nothing is shown, and which topics there are."""
        names = sorted({topic.name for topic in self.topics})
        why = f"no messages on {', '.join(map(_in_ros, names))} within {_FIRST_S:g} s"
        why += f" that fit ({'; '.join(sorted(self.troubles))})" if self.troubles else ""
        if not isinstance(self._line, TopicBus):
            return why
        heard = self._line.heard()
        known = {(topic.name, topic.dds_type) for topic in self.topics}
        strange = [one for one in heard if one.topic in names and (one.topic, one.type_name) not in known]
        others = [f"{_in_ros(one.topic)} ({one.ros_type or one.type_name})" for one in strange]
        if others:
            return f"{why}; {', '.join(others)}: a type that is not known needs a map (operation write_map)"
        listed = [f"{_in_ros(one.topic)} ({one.ros_type})" for one in heard if one.ros_type][:_MOST_LISTED]
        return f"{why}; topics there: {', '.join(listed) or 'none'}"

    def _split(self, number: int, body: bytes) -> Iterable[tuple[int, bytes]]:
        """Return the frames of a sample's modules; a short one, counted by its length, if it does not fit."""
        stamp, sample = body[: SOURCE_TIME.end], body[SOURCE_TIME.end :]
        plan = self._plans.get(number)
        news: list[tuple[int, bytes]] = []
        if plan is None or not plan.fits(sample):
            try:
                plan = self._plan(number, sample)
            except (ValueError, KeyError) as error:
                topic, _ = self._reading.get(number, (None, None))
                self.log_once(f"a message of {_in_ros(topic.name) if topic else f'topic {number}'}: {error}")
                own = (known for key, (known, _) in self._identifiers.items() if self._parts[key][0] == number)
                return [(next(own, _NO_MESSAGE), stamp)]
            plan.listed = _LIST_EVERY if self._is_known(plan) else 0
        plan.messages += 1
        plan.listed -= 1
        if plan.listed < 0:
            plan.listed = _LIST_EVERY
            fits = len(sample) + _NUMBER.size <= self.payload_size
            news = [(_NEWS, _NUMBER.pack(number) + (sample if fits else b""))]
        if self.options.time == "header":
            stamp = plan.stamp(sample) or stamp
        found = ((self._identifiers.get((part.patch, part.name), (0, 0)), part) for part in plan.parts)
        return [*news, *((known, stamp + part.body(sample)) for (known, form), part in found if form == part.form)]

    def _is_known(self, plan: Plan) -> bool:
        """Return whether all modules of a message are described in this form."""
        return all(self._identifiers.get((part.patch, part.name), (0, 0))[1] == part.form for part in plan.parts)

    def _plan(self, number: int, sample: bytes) -> Plan:
        if number not in self._reading:
            raise ValueError("a topic that is not known")
        topic, making = self._reading[number]
        message = CdrMessage(sample, topic.definitions)
        plan, before = Plan(message, making(message, _in_ros(topic.name))), self._plans.get(number)
        plan.messages = before.messages if before else 0
        self._plans[number] = plan
        return plan


def _topics(options: Ros2Options) -> list[tuple[DdsTopic, Making]]:
    """Return topics to read, each once for each type that it may have, and what makes parts of their messages."""
    found = []
    if options.map:
        for ordinal, (name, definitions, making) in enumerate(read_map(options.map)):
            found.append((DdsTopic(_in_dds(name), definitions, ordinal * _TYPES + _TYPES - 1), making))
    else:
        for ordinal, text in enumerate(options.topic):
            name, _, type_name = text.partition("=")
            for number, (known, making) in enumerate(PRESETS.items()):
                if not type_name or known == type_name:
                    topic = DdsTopic(_in_dds(name), Definitions(known, TEXTS), ordinal * _TYPES + number)
                    found.append((topic, making))
            if type_name:
                preset(type_name)
    if not found or len({topic.name for topic, _ in found}) > _MOST_TOPICS:
        raise ConfigurationError(f"give 1 to {_MOST_TOPICS} topics")
    return found


def _frame(number: int, part: ModulePart, patch: int, *, is_timed: bool) -> Frame:
    count = part.taxels * len(part.types)
    end = SOURCE_TIME.end + count * part.dtype.itemsize
    flags: list[AnyFlag] = list(NO_NUMBER) if part.dtype.kind == "f" else []
    if part.doubt is not None:
        flags.append(StatusBytes(end, Status.SUSPECT))
    number_at, bytes_of_it = end if part.doubt is None else end + count, part.number[2] if part.number else 0
    return Frame(
        f"module {number}",
        [Identifier(number)],
        [number_at + bytes_of_it],
        Values(SOURCE_TIME.end, part.dtype.str, count),
        patch=patch,
        module=number,
        flags=flags,
        sequence=SequenceNumber(number_at, f"<u{bytes_of_it}") if bytes_of_it else None,
        time=SOURCE_TIME if is_timed else None,
    )


def _places(part: ModulePart, position_m: npt.NDArray[np.float64], first_uid: int) -> Geometry:
    n, k = part.taxels, len(part.types)
    normal = np.full((n, 3), np.nan) if part.normal is None else part.normal
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.full((n, 3), np.nan), where=length > 0)
    uid = np.tile(np.arange(first_uid, first_uid + n, dtype=np.uint64), k)
    return replace(
        Geometry.unknown(np.repeat([each.name for each in part.types], n).tolist(), uid),
        frame=np.full(k * n, part.frame, object),
        position_m=np.tile(position_m, (k, 1)),
        normal=np.tile(normal, (k, 1)),
    )


def _in_dds(name: str) -> str:
    return name if name.startswith("rt/") else f"rt/{name.lstrip('/')}"


def _in_ros(name: str) -> str:
    return name.removeprefix("rt")


Ros2Driver.topics = [topic for topic, _ in _topics(Ros2Options())]
