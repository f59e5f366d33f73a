"""What goes over a bridge, byte by byte, and under which keys.

Keys of robot R: ``skinware/1/R/INSTANCE/``..., INSTANCE being the number of the bridge that serves it: two that serve
robots of one name are never taken for each other.

======================  ===============================================================================================
``ping``                who asks (16 letters), i64 when, by his clock; answered with ``pong/WHO``: that time, and when
                        it came and was answered, i64 CLOCK_MONOTONIC ns each
``services``            question; answer: :class:`Services` as JSON. Sent unasked whenever something of it changes.
                        Asked with :class:`Wish` as JSON: answered for those sensors, and asked again once a second
                        for as long as they are wanted
``summary``             :class:`Summary` as JSON, once a second
``S/generation``        question with ``number``; answer: u4 size of JSON, :class:`About` as JSON, the service's file in
                        shared memory up to its slots, packed (zlib)
``S/frame``             every frame: ``RAW`` below
``S/frame/PART``        likewise, some sensors of it: those of the wish of that number
``S/newest``            question with ``generation`` and ``sequence`` of the last frame, ``who`` asks, ``base``:
                        sequence of the newest frame that the asker keeps, else 0, ``others``: questions of this kind
                        that are open. Each is answered with a frame of its own, the newest as soon as there is one that
                        was not sent for an open question, with nothing after half a second: ``CODED`` below, ``RAW``
                        with ``form=0``
``S/call/OPERATION``    question with arguments as JSON; answer: :class:`Answered` as JSON
======================  ===============================================================================================

Questions for ``generation`` and ``newest`` may have ``part``: the number of a wish.

``skinware/live/R/1/INSTANCE`` is a token of who serves the robot.

A frame begins with a byte for its form and seven that are 0. ``RAW``: u64 generation, then the slot of the ring.
``CODED``: a message of :mod:`skinware.transfer.codec`; the second byte is 1 where the receiver keeps the frame, since
later ones may be the difference to it. It keeps the last two of those.
"""

from __future__ import annotations

import hashlib
import re
import socket
import struct
import threading
import zlib
from typing import Annotated, Literal, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import BridgeError, ConfigurationError
from skinware.limits import LIMITS, read_json, unpack
from skinware.memory.ring import Sample
from skinware.tactile.choosing import SensorChoice
from skinware.tactile.regions import Region, Regions

VERSION = 1
RAW, CODED = 0, 1

_HEAD = struct.Struct("<B7xQ")
_CODED_HEAD = struct.Struct("<BB6x")
_SIZE = struct.Struct("<I")
MOST_FRAMES = 1 << 53
"""More frames than any robot ever published: a number above it is wrong."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,46}")
_INSTANCE = re.compile(r"[0-9a-f]{16}")

_Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 62) - 1)]
_Figure = Annotated[float, msgspec.Meta(ge=-1e18, le=1e18)]
_Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,46}$")]
_Word = Annotated[str, msgspec.Meta(max_length=256)]
_Line = Annotated[str, msgspec.Meta(max_length=1 << 14)]
State = Literal["live", "paused", "closed", "dead"]

_Kind = TypeVar("_Kind")


class Service(msgspec.Struct, frozen=True):
    """How a service is.

    Attributes:
        generation: its number; 0: not known yet.
        state: ``live``, ``paused``, ``closed`` or ``dead``.
        sequence: of its newest frame when it became so: those up to it may be on their way still.
    """

    generation: _Count = 0
    state: State = "live"
    sequence: _Count = 0


class Services(msgspec.Struct, frozen=True):
    """All services of a robot.

    Attributes:
        instance: number of the bridge that serves them.
        start: which start of the machine times count from, and which namespace is served; another one has another clock
            and other generations.
        callers: who may call, by the names in their certificates; empty: whoever is let in.
        services: by name.
        missing: what of a wish is not there, a line for people; empty if nothing is missing.
        host: name of the machine, for people.
    """

    instance: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$")]
    start: _Word = ""
    callers: Annotated[tuple[_Word, ...], msgspec.Meta(max_length=256)] = ()
    services: Annotated[dict[_Name, Service], msgspec.Meta(max_length=LIMITS.services)] = {}
    missing: _Line = ""
    host: _Word = ""


class Wish(msgspec.Struct, frozen=True):
    """Some sensors that are wanted: those of which all of it is true.

    Attributes:
        patches: names; empty: all.
        in_regions: names of regions; empty: all.
        regions: what they are, and those that they refer to.
    """

    patches: tuple[str, ...] = ()
    in_regions: tuple[str, ...] = ()
    regions: tuple[Region, ...] = ()

    @property
    def number(self) -> str:
        """The same for the same wish."""
        return hashlib.blake2b(msgspec.json.encode(self), digest_size=8).hexdigest()

    def choice(self) -> SensorChoice:
        """The wish as others know it.

        Raises:
            ConfigurationError: the regions contradict each other.
        """
        return SensorChoice((), self.patches, Regions(self.regions), self.in_regions)


class DriverSummary(msgspec.Struct, frozen=True):
    """How a driver is.

    Attributes:
        state: ``live``, ``paused``, ``closed`` or ``dead``.
        rate_hz: frames in the last second.
        age_ms: of the newest data in its newest frame, on the robot; None before the first.
        lost: frames lost on its buses since it started.
        sensors, fresh: how many it has, and of how many the value is good and new.
        patches: how many it has.
        silent: names of patches that do not send, the first of them.
        n_silent: how many those are.
        problems: what is not in order: the driver, or each of its buses and patches.
    """

    state: State
    rate_hz: _Figure
    age_ms: _Figure | None
    lost: _Count
    sensors: _Count
    fresh: _Count
    patches: _Count
    silent: Annotated[tuple[_Word, ...], msgspec.Meta(max_length=16)]
    n_silent: _Count
    problems: _Count


class Summary(msgspec.Struct, frozen=True):
    """How a robot is.

    Attributes:
        namespace: that is served.
        drivers: by name.
        services: how many others there are.
        lost: frames that the bridge could not take from their rings.
        host: name of the machine, for people.
    """

    namespace: _Name
    drivers: Annotated[dict[_Name, DriverSummary], msgspec.Meta(max_length=LIMITS.services)] = {}
    services: _Count = 0
    lost: _Count = 0
    host: _Word = ""


class About(msgspec.Struct, frozen=True):
    """What a generation's file does not tell.

    Attributes:
        operations: of the service: descriptions by name.
    """

    operations: Annotated[dict[_Word, _Line], msgspec.Meta(max_length=256)] = {}


class Answered(msgspec.Struct, frozen=True):
    """How a call ended.

    Attributes:
        generation, sequence: a frame that was published after it was carried out, by the robot's count; 0: none.
        result: what the operation returned.
        error: what went wrong; None if nothing did.
        why: kind of error: ``refused``, ``failed``, ``paused``, ``cancelled``.
    """

    generation: _Count = 0
    sequence: _Count = 0
    result: msgspec.Raw = msgspec.Raw(b"null")
    error: _Line | None = None
    why: Literal["", "refused", "failed", "paused", "cancelled"] = ""


def read_text(message: bytes, kind: type[_Kind]) -> _Kind:
    """The content of a JSON message of somebody else.

    Raises:
        BridgeError: it is longer, deeper or otherwise than such a message can be; says what is wrong.
    """
    try:
        return read_json(message, kind)
    except ValueError as error:
        raise BridgeError(str(error)) from None


ALL_TOKENS = "skinware/live/*/*/*"
ALL_SUMMARIES = f"skinware/{VERSION}/*/*/summary"


class Keys:
    """The keys of a robot.

    Args:
        robot: its name.
        instance: number of the bridge that serves it; ``*``: of whichever does.

    Raises:
        ConfigurationError: it is no name.
    """

    def __init__(self, robot: str, instance: str = "*") -> None:
        if not _NAME.fullmatch(robot):
            raise ConfigurationError(
                f"robot {robot!r}: give 1 to 47 letters, digits, '_' or '-', the first a letter or digit"
            )
        self.robot, self._instance = robot, instance
        self._root = f"skinware/{VERSION}/{robot}/{instance}"
        self.ping, self.services = f"{self._root}/ping", f"{self._root}/services"
        self.summary = f"{self._root}/summary"

    def pong(self, who: str) -> str:
        return f"{self._root}/pong/{who}"

    @property
    def token(self) -> str:
        return f"skinware/live/{self.robot}/{VERSION}/{self._instance}"

    def of(self, service: str, what: str) -> str:
        """Of something of a service; either may be ``*``."""
        return f"{self._root}/{service}/{what}"

    def frame(self, service: str, part: str = "") -> str:
        return self.of(service, f"frame/{part}" if part else "frame")

    def call(self, service: str, operation: str) -> str:
        """Of an operation; likewise."""
        return f"{self._root}/{service}/call/{operation}"


def parts_of(key: str) -> tuple[str, str]:
    """(service, operation or what else) of a key of a service."""
    parts = key.split("/")
    return parts[4], parts[-1]


def bridge_of(key: str) -> tuple[str, str]:
    robot, instance = key.split("/")[2:4]
    return robot, instance


def token_parts(key: str) -> tuple[str, int, str]:
    """(robot, version, instance) of a token; version 0: not to be understood.

    Raises:
        BridgeError: it is no token.
    """
    parts = key.split("/")
    if len(parts) != 5 or not _NAME.fullmatch(parts[2]) or len(key) > 256:
        raise BridgeError("a token of no bridge")
    robot, version, instance = parts[2:]
    if version == str(VERSION) and not _INSTANCE.fullmatch(instance):
        raise BridgeError("a token of no bridge")
    return robot, number_in(version), instance


def number_in(text: str) -> int:
    """A number from 0 to 2**64 - 1 that is written in digits; 0 if it is none."""
    return min(int(text), (1 << 64) - 1) if text.isascii() and text.isdecimal() and len(text) <= 20 else 0


def host_name() -> str:
    return socket.gethostname()[:64]


def raw_message(frame: Sample) -> bytes:
    return b"".join((_HEAD.pack(RAW, frame.generation), frame.slot))


def coded_message(coded: bytes, keeps: bool) -> bytes:
    """A message of :mod:`skinware.transfer.codec`, for the link; ``keeps``: the receiver keeps the frame."""
    return _CODED_HEAD.pack(CODED, keeps) + coded


def form_of(message: bytes) -> int:
    """Whether a frame is raw or coded.

    Raises:
        BridgeError: neither.
    """
    if len(message) < _HEAD.size or message[0] not in (RAW, CODED):
        raise BridgeError("a frame of no known form")
    return message[0]


def generation_of(message: bytes) -> int:
    """The generation of a frame; it stands at the same place in both forms."""
    number: int = _HEAD.unpack_from(message)[1]
    return number


def slot_of(message: bytes) -> npt.NDArray[np.uint8]:
    return np.frombuffer(message, np.uint8, offset=_HEAD.size)


def coded_part(message: bytes) -> tuple[memoryview, bool]:
    """What was coded, of a coded frame, and whether the receiver keeps the frame."""
    return memoryview(message)[_CODED_HEAD.size :], bool(message[1])


class Head:
    """A service's file up to its slots, packed once for all who ask; for any thread.

    Args:
        raw: its bytes.

    Attributes:
        raw: the same bytes.
    """

    def __init__(self, raw: bytes) -> None:
        self.raw = raw
        self._lock, self._packed = threading.Lock(), b""

    def packed(self) -> bytes:
        """It, for the link; the first time takes milliseconds."""
        with self._lock:
            self._packed = self._packed or zlib.compress(self.raw)
            return self._packed


def generation_message(about: About, head: Head) -> bytes:
    text = msgspec.json.encode(about)
    return _SIZE.pack(len(text)) + text + head.packed()


def split_generation(message: bytes) -> tuple[About, bytes]:
    """(what its file does not tell, its file up to the slots).

    Raises:
        BridgeError: it is no such message.
    """
    try:
        (size,) = _SIZE.unpack_from(message)
        begin = _SIZE.size + size
        about = read_text(message[_SIZE.size : begin], About)
        return about, unpack(memoryview(message)[begin:], LIMITS.head_size)
    except (struct.error, BridgeError, ValueError) as error:
        raise BridgeError(f"a generation that is not one ({error})") from None
