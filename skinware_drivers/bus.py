"""What carries frames: the contract of a bus, and the batch that all buses of a driver fill.

A bus knows nothing of skins. It moves frames between a wire and a :class:`FrameBatch`, stamps them with
``CLOCK_MONOTONIC`` and counts what it had to drop. Implementations: ``can.socketcan`` (Linux), ``can.pythoncan``
(every python-can interface), ``virtual.bus`` (emulated hardware in the same process).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np
import numpy.typing as npt

from skinware.errors import BusSendError, ConfigurationError
from skinware.geometry import Geometry
from skinware.status import BusReason
from skinware_drivers.counters import BusCounters, Samples
from skinware_drivers.wire_tap import WireTap

EXTENDED_FLAG = 0x8000_0000
"""Identifier bit of a 29-bit CAN frame (``CAN_EFF_FLAG`` of linux/can.h).

Wherever an identifier is a number, one of 29 bits has this bit set: ``EXTENDED_FLAG | 0x18DA00F1``. As text it is what
candump writes (:func:`identifier_text`).
"""
IDENTIFIER_MASK = 0x1FFF_FFFF
"""Identifier bits of a frame, without the flags."""
LARGEST_STANDARD = 0x7FF
"""The largest identifier of 11 bits."""
REMOTE_FLAG = 0x4000_0000
"""Identifier bit of a remote frame (``CAN_RTR_FLAG``)."""
ERROR_FLAG = 0x2000_0000
"""Identifier bit of an error frame (``CAN_ERR_FLAG``)."""

BATCH_FRAMES, _FRAMES_OF_A_BUS, _FEWEST_FRAMES, _BATCH_BYTES = 2048, 256, 64, 1 << 20
"""What is read at once: so many frames or, of many buses, so many of each; of long frames as many as fill a MiB."""

_MEDIA = {
    "can": ("a CAN bus", ", as vcan0, can0, slcan:/dev/ttyACM0 or virtual"),
    "serial": ("a serial line", ", as /dev/ttyUSB0, ./port (a path has a slash in it) or virtual"),
    "modbus": ("a Modbus line", ", as modbus:/dev/ttyUSB0 or modbus:tcp://192.168.1.10"),
    "virtual": ("a bus of this process", ": virtual"),
}
"""What the buses of a medium are called, and how they are written."""


CHOOSE = "__skinware_choose_class__"
"""The attribute that :func:`chosen_by` sets."""

_WayT = TypeVar("_WayT")
_MakeT = TypeVar("_MakeT", bound=Callable[..., Any])


def identifier_text(identifier: int) -> str:
    """An identifier as candump writes it: three digits for one of 11 bits, eight for one of 29."""
    if identifier & EXTENDED_FLAG:
        return f"{identifier & IDENTIFIER_MASK:08X}"
    return f"{identifier:03X}"


def check_identifier(identifier: int) -> None:
    """Refuse a CAN identifier that no frame has.

    Raises:
        ConfigurationError: it has more than 11 bits without ``EXTENDED_FLAG``, or more than 29 with it.
    """
    largest = IDENTIFIER_MASK if identifier & EXTENDED_FLAG else LARGEST_STANDARD
    if not 0 <= identifier & ~EXTENDED_FLAG <= largest:
        raise ConfigurationError(
            f"identifier 0x{identifier:X} has more than 11 bits; one of 29 bits is written EXTENDED_FLAG |"
            f" 0x{identifier:X}"
            if 0 <= identifier <= IDENTIFIER_MASK
            else f"identifier 0x{identifier:X} cannot be: it has 11 bits, or 29 and EXTENDED_FLAG"
        )


class Filter(NamedTuple):
    """Frames that are wanted: ``identifier & mask == value``, flags of the identifier included."""

    value: int
    mask: int


_CAN_PAYLOAD = 64


def kind_of_bus(medium: str | None) -> str:
    """What people call a bus of a medium: ``a CAN bus``."""
    return _MEDIA[medium][0] if medium in _MEDIA else f"a bus of medium {medium!r}"


def wire_dtype(payload_size: int) -> np.dtype[np.void]:
    """Row of a batch: the layout of ``struct can_frame`` (payload 8) and ``struct canfd_frame`` (64).

    Frames of serial devices can be longer; their rows have a wider ``length``.

    Args:
        payload_size: bytes of payload a row can hold, a multiple of 8.
    """
    if payload_size > _CAN_PAYLOAD:
        return np.dtype([("identifier", np.uint32), ("length", np.uint32), ("payload", np.uint8, (payload_size,))])
    return np.dtype(
        [
            ("identifier", np.uint32),
            ("length", np.uint8),
            ("flags", np.uint8),
            ("reserved", np.uint16),
            ("payload", np.uint8, (payload_size,)),
        ]
    )


class FrameBatch:
    """Frames of all buses of a driver, in order of arrival per bus; filled by buses, emptied by the decoder.

    Attributes:
        wire: (capacity,) :func:`wire_dtype`; rows ``start`` to ``stop`` are valid.
        time_ns: (capacity,) int64, CLOCK_MONOTONIC ns at which the kernel (or device) saw the frame.
        bus: (capacity,) uint16, ordinal of the bus in the driver.
        start: first valid row. The rows before it are headroom, into which the decoder puts frames that
            it still holds from the batch before.
        stop: one past the last valid row.
        limit: rows before it may be filled: buses that share a batch must not crowd each other out.
    """

    def __init__(self, capacity: int, payload_size: int = 8, headroom: int = 0) -> None:
        self.capacity: int = capacity + headroom
        self.payload_size = payload_size
        self.headroom = headroom
        self.wire: npt.NDArray[np.void] = np.zeros(self.capacity, wire_dtype(payload_size))
        self.time_ns: npt.NDArray[np.int64] = np.zeros(self.capacity, np.int64)
        self.bus: npt.NDArray[np.uint16] = np.zeros(self.capacity, np.uint16)
        self.start: int = headroom
        self.stop: int = headroom
        self.limit: int = self.capacity

    def __len__(self) -> int:
        return self.stop - self.start

    @classmethod
    def for_buses(cls, count: int, payload_size: int, headroom: int = 0) -> Self:
        """Room for what so many buses bring at once; of long frames, fewer."""
        wanted = max(BATCH_FRAMES, _FRAMES_OF_A_BUS * count)
        return cls(max(_FEWEST_FRAMES, min(wanted, _BATCH_BYTES // payload_size)), payload_size, headroom)

    @property
    def free(self) -> int:
        """Rows that a bus may still fill."""
        return self.limit - self.stop

    def clear(self) -> None:
        """Forget all rows; the memory stays."""
        self.start = self.stop = self.headroom
        self.limit = self.capacity

    def append(self, bus: int, time_ns: int, identifier: int, payload: bytes) -> None:
        """Add one frame: the slow path of buses that hand out frames one by one.

        Raises:
            ValueError: the payload is longer than a row holds.
            IndexError: the batch is full.
        """
        if len(payload) > self.payload_size:
            raise ValueError(f"payload of {len(payload)} bytes in a batch of {self.payload_size}-byte rows")
        row = self.wire[self.stop]
        row["identifier"] = identifier
        row["length"] = len(payload)
        row["payload"] = np.frombuffer(payload.ljust(self.payload_size, b"\0"), np.uint8)
        self.time_ns[self.stop] = time_ns
        self.bus[self.stop] = bus
        self.stop += 1


class Bus(ABC):
    """One link to hardware.

    Attributes:
        medium: kind of bus, as drivers name it; None: whatever the driver speaks.
        opens_slowly: ``open`` may take long, and ``close`` too: a driver calls them in threads of their own.
        device_end: makes the end at which emulated devices are, like the class itself; None: both ends are alike.
        counters: what happened on it so far.
        samples: some of the frames that could not be used.
        tap: what goes over the wire, in both directions, as long as somebody wants it.
        narrows: it can leave out frames that nobody wants, see ``narrow``.
        bit_rate: of the wire, bit/s; 0 where it is not known, or not all frames are seen.
        wire_bits: about how many bits of that rate the frames seen so far took; counted where the bit rate is known.
        fullest: largest share of the receive buffer in use after a ``receive``, since it was last set to 0.

    Frames of one bus arrive in order. Frames can be lost: ``counters.lost`` says how many. A bus that goes
    down or away raises :class:`skinware.errors.BusNotAvailable` from ``receive`` once and is then closed and
    opened again by its owner, indefinitely, with growing pauses.

    Args:
        channel: the part of the bus' name behind ``interface:`` (``vcan0``, ``/dev/ttyUSB0``).
        options: the ``key=value`` pairs behind ``?``, as strings.
        payload_size: the longest payload the driver's layout knows, 8 or 64 for CAN.
        listen_only: refuse every ``send``.

    Raises:
        skinware.errors.ConfigurationError: an option is unknown or has a bad value.
    """

    medium: ClassVar[str | None] = None
    opens_slowly: ClassVar[bool] = False
    device_end: ClassVar[Callable[..., Bus] | None] = None

    def __init__(
        self,
        channel: str,
        options: dict[str, str] | None = None,
        *,
        payload_size: int = 8,
        listen_only: bool = False,
    ) -> None:
        self.channel = channel
        self.options: dict[str, str] = dict(options or {})
        self.payload_size = payload_size
        self.listen_only = listen_only
        self.counters: BusCounters = BusCounters()
        self.samples: Samples = Samples()
        self.tap: WireTap = WireTap()
        self.narrows = False
        self.bit_rate = 0
        self.wire_bits: float = 0.0
        self.fullest: float = 0.0

    @classmethod
    def fits(cls, medium: str) -> bool:
        """Return whether drivers of devices on this medium can use such a bus."""
        return cls.medium in (None, medium)

    def instead(self, medium: str) -> str:
        """Return what fits a driver of this medium instead, as the end of a sentence for people."""
        return _MEDIA[medium][1] if medium in _MEDIA else ""

    @property
    def asks(self) -> bool:
        """Whether it asks its devices by itself, so that the next question waits until the answer is taken."""
        return False

    @abstractmethod
    def open(self) -> None:
        """Connect to the wire. Opening again after ``close`` is allowed; counters go on.

        Raises:
            skinware.errors.BusNotAvailable: no such interface, interface down, or not permitted.
        """

    @abstractmethod
    def fileno(self) -> int:
        """A descriptor that is readable (for epoll) when ``receive`` has something to do."""

    @abstractmethod
    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Append what has arrived to ``batch``, marked with this bus' ``ordinal``; never blocks.

        Returns:
            The number of frames appended; at most ``batch.free``.

        Raises:
            skinware.errors.BusNotAvailable: the interface went down or away.
        """

    @abstractmethod
    def send(self, identifier: int, payload: bytes) -> None:
        """Hand one frame to the wire; never blocks.

        Raises:
            skinware.errors.BusSendError: down, queue full, or ``listen_only``.
        """

    def may_send_by(self, way: _WayT | None) -> _WayT:
        """The first thing in ``send``: refuse where nothing may be sent.

        Args:
            way: what hands frames to the wire, None while the bus is closed; given back.

        Raises:
            skinware.errors.BusSendError: closed, or ``listen_only``.
        """
        if self.listen_only:
            raise BusSendError(f"{self.name} is opened to listen only")
        if way is None:
            raise BusSendError(f"{self.name} is not open")
        return way

    @abstractmethod
    def close(self) -> None:
        """Let go of the wire. Idempotent."""

    def narrow(self, filters: Sequence[Filter]) -> None:  # noqa: B027  (a bus need not be able to)
        """From now on leave out what none of these lets through; without any, nothing is left out.

        Called only where ``narrows`` is true. It holds until the next call, also over ``close`` and ``open``.
        """

    def check(self) -> None:  # noqa: B027  (nothing to look after is the default)
        """Look after a bus from which nothing comes, twice a second: a loss need not show in ``receive``.

        Raises:
            skinware.errors.BusNotAvailable: the interface is down or away.
        """

    def reason(self, time_ns: int) -> BusReason:  # noqa: ARG002
        """What is wrong with the open bus as of now, as far as its hardware tells.

        Args:
            time_ns: now, CLOCK_MONOTONIC ns.
        """
        return BusReason.NONE

    @property
    def geometry(self) -> Geometry | None:
        """Where the sensors on it are, by the types and uids of their driver; None: the bus does not know."""
        return None

    @property
    def note(self) -> str:
        """What a person should know about this bus (say, a receive buffer smaller than asked for)."""
        return ""

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"bus {self.channel}"

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.channel}>"


def chosen_by(choose: Callable[[str, dict[str, str]], type[Bus]]) -> Callable[[_MakeT], _MakeT]:
    """Mark a function that makes buses of several classes.

    Args:
        choose: returns the class for a channel and its options, and raises ``ConfigurationError`` for a wrong channel.
    """

    def mark(make: _MakeT) -> _MakeT:
        setattr(make, CHOOSE, choose)
        return make

    return mark
