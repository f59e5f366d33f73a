"""The messages of a bridge, byte by byte, and their keys.

Keys of robot R begin with ``skinware/1/R/INSTANCE/``. INSTANCE is the number of the bridge that serves R, so that two
bridges of one name are never mixed up.

======================  ===============================================================================================
``ping``                who asks (16 letters), i64 time of its clock; answered under ``pong/WHO`` with that time, and
                        the times at which it came and was answered, i64 CLOCK_MONOTONIC ns each
``services``            question; answer: :class:`Services` as JSON. Also sent without a question after each change. A
                        question may carry :class:`Wish` as JSON, to get only those sensors; it is repeated each second
                        for as long as they are wanted
``summary``             :class:`Summary` as JSON, once a second
``S/generation``        question with ``number``; answer: u4 size of JSON, :class:`About` as JSON, the service's file in
                        shared memory up to its slots, packed (zlib)
``S/frame``             every frame of service S: ``RAW`` below
``S/frame/PART``        every frame of S, cut to the sensors of the wish of that number
``S/newest``            question for a newer frame, with ``generation`` and ``sequence`` of the last one, ``who`` asks,
                        ``base``: sequence of the newest frame that the asker keeps, else 0, ``others``: number of such
                        questions that are open. Each is answered with another frame, as soon as there is one, and with
                        nothing after half a second: ``CODED`` below, or ``RAW`` with ``form=0``
``S/call/OPERATION``    question with arguments as JSON; answer: :class:`CallResult` as JSON
======================  ===============================================================================================

Questions for ``generation`` and ``newest`` may have ``part``: the number of a wish.

``skinware/live/R/1/INSTANCE`` is a token of the bridge that serves the robot.

A frame begins with one byte for its form and seven that are 0. ``RAW``: u64 generation, then the slot of the ring.
``CODED``: a message of :mod:`skinware.transfer.codec`; the second byte is 1 if the receiver keeps the frame, since
later ones may be differences to it. The receiver keeps the last two of those.
"""

from __future__ import annotations

import hashlib
import re
import socket
import struct
from typing import Annotated, Literal, NamedTuple, TypeVar

import msgspec

from skinware.errors import BridgeError, ConfigurationError
from skinware.limits import LIMITS, read_json, unpack
from skinware.memory.namespace import is_name
from skinware.memory.ring import Sample
from skinware.tactile.regions import Region, Regions, SensorChoice

VERSION = 1
RAW, CODED = 0, 1

_RAW_HEAD = struct.Struct("<B7xQ")
_CODED_HEAD = struct.Struct("<BB6x")
_SIZE = struct.Struct("<I")
MOST_FRAMES = 1 << 53
"""More frames than any robot publishes: a larger number is wrong."""
_INSTANCE = re.compile(r"[0-9a-f]{16}")

_Count = Annotated[int, msgspec.Meta(ge=0, le=(1 << 62) - 1)]
_Figure = Annotated[float, msgspec.Meta(ge=-1e18, le=1e18)]
_Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,46}$")]
_Word = Annotated[str, msgspec.Meta(max_length=256)]
_Line = Annotated[str, msgspec.Meta(max_length=1 << 14)]
State = Literal["live", "paused", "closed", "dead"]

_Kind = TypeVar("_Kind")


class Service(msgspec.Struct, frozen=True):
    """State of a service.

    Attributes:
        generation: its number; 0: not known yet.
        state: ``live``, ``paused``, ``closed`` or ``dead``.
        sequence: of the newest frame when the state began: frames up to it may still be on their way.
    """

    generation: _Count = 0
    state: State = "live"
    sequence: _Count = 0


class Services(msgspec.Struct, frozen=True):
    """All services of a robot.

    Attributes:
        start: boot of the machine, and namespace; another one has another clock and other generations.
        callers: names of the certificates that may call; empty: all.
        missing: parts of a wish that do not exist, in one line; empty: none.
    """

    instance: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$")]
    start: _Word = ""
    callers: Annotated[tuple[_Word, ...], msgspec.Meta(max_length=256)] = ()
    services: Annotated[dict[_Name, Service], msgspec.Meta(max_length=LIMITS.services)] = {}
    missing: _Line = ""
    host: _Word = ""


class Wish(msgspec.Struct, frozen=True):
    """The sensors that a peer wants: those that meet all conditions.

    Attributes:
        patches: names; empty: all.
        in_regions: names of regions; empty: all.
        regions: definitions of these regions, and of those that they refer to.
    """

    patches: tuple[str, ...] = ()
    in_regions: tuple[str, ...] = ()
    regions: tuple[Region, ...] = ()

    @property
    def number(self) -> str:
        return hashlib.blake2b(msgspec.json.encode(self), digest_size=8).hexdigest()

    def choice(self) -> SensorChoice:
        """Return the wish in the form that the rest of Skinware uses."""
        return SensorChoice((), self.patches, Regions(self.regions), self.in_regions)


class DriverSummary(msgspec.Struct, frozen=True):
    """Summary of a driver.

    Attributes:
        state: ``live``, ``paused``, ``closed`` or ``dead``.
        rate_hz: frames in the last second.
        age_ms: age of the newest data in its newest frame, on the robot; None before the first.
        dropped: frames dropped on its buses since it started.
        sensors, fresh: number of sensors, and of those whose value is good and new.
        silent: names of the first patches that do not send.
        n_silent: number of patches that do not send.
        problems: 1 if the driver is not live, else the number of its buses and patches that are not.
    """

    state: State
    rate_hz: _Figure
    age_ms: _Figure | None
    dropped: _Count
    sensors: _Count
    fresh: _Count
    patches: _Count
    silent: Annotated[tuple[_Word, ...], msgspec.Meta(max_length=16)]
    n_silent: _Count
    problems: _Count


class Summary(msgspec.Struct, frozen=True):
    """Summary of a robot.

    Attributes:
        services: number of services that are no drivers.
        missed: frames that the bridge missed in their rings.
    """

    namespace: _Name
    drivers: Annotated[dict[_Name, DriverSummary], msgspec.Meta(max_length=LIMITS.services)] = {}
    services: _Count = 0
    missed: _Count = 0
    host: _Word = ""


class About(msgspec.Struct, frozen=True):
    """Facts about a generation that its file does not have: the operations of the service, descriptions by name."""

    operations: Annotated[dict[_Word, _Line], msgspec.Meta(max_length=256)] = {}


class CallResult(msgspec.Struct, frozen=True):
    """Result of a call.

    Attributes:
        generation, sequence: a frame that was published after the operation, by the robot's count; 0: none.
        error: in words; None: the call succeeded.
        why: kind of error: ``refused``, ``failed``, ``paused``, ``cancelled``.
    """

    generation: _Count = 0
    sequence: _Count = 0
    result: msgspec.Raw = msgspec.Raw(b"null")
    error: _Line | None = None
    why: Literal["", "refused", "failed", "paused", "cancelled"] = ""


def read_text(message: bytes, kind: type[_Kind]) -> _Kind:
    """Return the content of a JSON message of a peer, or raise BridgeError."""
    try:
        return read_json(message, kind)
    except ValueError as error:
        raise BridgeError(str(error)) from None


ALL_TOKENS = "skinware/live/*/*/*"
ALL_SUMMARIES = f"skinware/{VERSION}/*/*/summary"


class Keys:
    """The keys of a robot; ``instance``: number of the bridge that serves it, or ``*`` for any."""

    def __init__(self, robot: str, instance: str = "*") -> None:
        if not is_name(robot):
            raise ConfigurationError(
                f"robot {robot!r}: give 1 to 47 letters, digits, '_' or '-', the first a letter or digit"
            )
        self.robot, self.instance = robot, instance
        self.root = f"skinware/{VERSION}/{robot}/{instance}"
        self.ping, self.services, self.summary = (f"{self.root}/{key}" for key in ("ping", "services", "summary"))
        self.token = f"skinware/live/{robot}/{VERSION}/{instance}"

    def pong(self, who: str) -> str:
        return f"{self.root}/pong/{who}"

    def of(self, service: str, what: str) -> str:
        """Return a key of a service; either argument may be ``*``."""
        return f"{self.root}/{service}/{what}"

    def frame(self, service: str, part: str = "") -> str:
        return self.of(service, f"frame/{part}" if part else "frame")


def token_parts(key: str) -> tuple[str, int, str]:
    """Return (robot, version, instance) of a token, or raise BridgeError; version 0: not known here."""
    parts = key.split("/")
    if len(parts) != 5 or not is_name(parts[2]) or len(key) > 256:
        raise BridgeError("a token of no bridge")
    robot, version, instance = parts[2:]
    if version == str(VERSION) and not _INSTANCE.fullmatch(instance):
        raise BridgeError("a token of no bridge")
    return robot, number_in(version), instance


def number_in(text: str) -> int:
    """Return a number from 0 to 2**64 - 1 that is written in digits; 0 for any other text."""
    return min(int(text), (1 << 64) - 1) if text.isascii() and text.isdecimal() and len(text) <= 20 else 0


def host_name() -> str:
    return socket.gethostname()[:64]


def raw_message(frame: Sample) -> bytes:
    return b"".join((_RAW_HEAD.pack(RAW, frame.generation), frame.slot))


def coded_message(coded: bytes, keeps: bool) -> bytes:
    return _CODED_HEAD.pack(CODED, keeps) + coded


class FrameMessage(NamedTuple):
    """The parts of a frame's message; ``content``: the slot (``RAW``), or the coded frame (``CODED``)."""

    form: int
    generation: int
    content: memoryview
    keeps: bool


def split_frame(message: bytes) -> FrameMessage:
    """Return the parts of a frame's message, or raise BridgeError."""
    if len(message) < _RAW_HEAD.size or message[0] not in (RAW, CODED):
        raise BridgeError("a frame of no known form")
    form, generation = _RAW_HEAD.unpack_from(message)  # the generation has the same place in both forms
    size = _RAW_HEAD.size if form == RAW else _CODED_HEAD.size
    return FrameMessage(form, generation, memoryview(message)[size:], bool(message[1]))


def generation_message(about: About, packed: bytes) -> bytes:
    """Return the answer to a question for a generation; ``packed``: the service's file up to its slots, by zlib."""
    text = msgspec.json.encode(about)
    return _SIZE.pack(len(text)) + text + packed


def split_generation(message: bytes) -> tuple[About, bytes]:
    """Return the parts of a generation's message; the second is the service's file up to its slots."""
    try:
        (size,) = _SIZE.unpack_from(message)
        begin = _SIZE.size + size
        about = read_text(message[_SIZE.size : begin], About)
        return about, unpack(memoryview(message)[begin:], LIMITS.head_size)
    except (struct.error, BridgeError, ValueError) as error:
        raise BridgeError(f"a generation that is not one ({error})") from None
