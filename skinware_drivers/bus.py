"""The contract of a bus, and the batch of frames that all buses of a driver fill.

A bus knows nothing of skins. It moves frames between a wire and a :class:`FrameBatch`, stamps them with
``CLOCK_MONOTONIC`` and counts those that it dropped. Implementations: ``can.socketcan`` (Linux), ``can.pythoncan``
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

Every identifier of 29 bits has this bit set: ``EXTENDED_FLAG | 0x18DA00F1``. As text it is written as candump does
(:func:`identifier_text`).
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
"""Room of a batch: frames in all, or frames of each bus if there are many; long frames fill at most a MiB."""

_MEDIA = {
    "can": ("a CAN bus", ", as vcan0, can0, slcan:/dev/ttyACM0 or virtual"),
    "serial": ("a serial line", ", as /dev/ttyUSB0, ./port (a path has a slash in it) or virtual"),
    "modbus": ("a Modbus line", ", as modbus:/dev/ttyUSB0 or modbus:tcp://192.168.1.10"),
    "virtual": ("a bus of this process", ": virtual"),
}
"""The name of a bus of each medium, for people, and examples of how it is written."""


CHOOSE = "__skinware_choose_class__"
"""The attribute that :func:`chosen_by` sets."""

_WayT = TypeVar("_WayT")
_MakeT = TypeVar("_MakeT", bound=Callable[..., Any])


def identifier_text(identifier: int) -> str:
    """Return an identifier as candump writes it: three digits for 11 bits, eight for 29."""
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
    """Return the name of a bus of a medium for people: ``a CAN bus``."""
    return _MEDIA[medium][0] if medium in _MEDIA else f"a bus of medium {medium!r}"


def wire_dtype(payload_size: int) -> np.dtype[np.void]:
    """Return the dtype of a row of a batch, the layout of ``struct can_frame`` and ``struct canfd_frame``.

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
        start: first valid row. The rows before it are headroom for frames of the batch before that wait for partners.
        stop: one past the last valid row.
        limit: rows before it may be filled, so that no bus takes the room of the others.
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
        """Return a batch with room for so many buses; for long frames, with fewer rows."""
        wanted = max(BATCH_FRAMES, _FRAMES_OF_A_BUS * count)
        return cls(max(_FEWEST_FRAMES, min(wanted, _BATCH_BYTES // payload_size)), payload_size, headroom)

    @property
    def free(self) -> int:
        """Rows that a bus may still fill."""
        return self.limit - self.stop

    def clear(self) -> None:
        """Remove all rows; the memory stays."""
        self.start = self.stop = self.headroom
        self.limit = self.capacity

    def append(self, bus: int, time_ns: int, identifier: int, payload: bytes) -> None:
        """Add one frame; slow, for buses that receive frames one by one.

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
        device_end: makes the end to which emulated devices are attached; None: both ends are alike.
        samples: some of the frames that could not be used.
        tap: keeps what goes over the wire, in both directions, while a program records it.
        narrows: it can leave out unwanted frames, see ``narrow``.
        bit_rate: of the wire, bit/s; 0 where it is not known, or not all frames are seen.
        wire_bits: about how many bits of that rate the frames seen so far took; counted where the bit rate is known.
        fullest: largest share of the receive buffer in use after a ``receive``, since it was last set to 0.

    Frames of one bus arrive in order. ``counters.dropped`` counts frames that were lost. A bus that goes down or away
    raises :class:`skinware.errors.BusNotAvailable` from ``receive`` once; its owner then closes it and opens it again,
    indefinitely, with growing pauses.

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
        """Whether the bus itself asks its devices, so that the next question waits until the answer is taken."""
        return False

    @abstractmethod
    def open(self) -> None:
        """Connect to the wire. A closed bus may be opened again; its counters continue.

        Raises:
            skinware.errors.BusNotAvailable: no such interface, interface down, or not permitted.
        """

    @abstractmethod
    def fileno(self) -> int:
        """Return a descriptor that is readable (for epoll) when ``receive`` has something to do; -1: not open."""

    @abstractmethod
    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Append the frames that have arrived to ``batch``, marked with this bus' ``ordinal``; never block.

        Returns:
            The number of frames appended; at most ``batch.free``.

        Raises:
            skinware.errors.BusNotAvailable: the interface went down or away.
        """

    @abstractmethod
    def send(self, identifier: int, payload: bytes) -> None:
        """Hand one frame to the wire; never block.

        Raises:
            skinware.errors.BusSendError: down, queue full, or ``listen_only``.
        """

    def may_send_by(self, way: _WayT | None) -> _WayT:
        """Refuse to send where nothing may be sent; ``send`` begins with it.

        Args:
            way: what hands frames to the wire, None while the bus is closed; returned.

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
        """Disconnect from the wire. Idempotent."""

    def narrow(self, filters: Sequence[Filter]) -> None:  # noqa: B027  (a bus need not be able to)
        """Receive only frames that one of these filters lets through; without filters, receive all.

        Called only if ``narrows`` is true. The filters hold until the next call, also over ``close`` and ``open``.
        """

    def check(self) -> None:  # noqa: B027  (nothing to look after is the default)
        """Look for a loss that does not show in ``receive``; called twice a second while nothing comes.

        Raises:
            skinware.errors.BusNotAvailable: the interface is down or away.
        """

    def reason(self, time_ns: int) -> BusReason:  # noqa: ARG002
        """Return what is wrong with the open bus, as far as its hardware reports it.

        Args:
            time_ns: now, CLOCK_MONOTONIC ns.
        """
        return BusReason.NONE

    @property
    def geometry(self) -> Geometry | None:
        """Positions of the sensors on the bus, by the types and uids of their driver; None: unknown to the bus."""
        return None

    @property
    def note(self) -> str:
        """A warning about this bus for people, such as a receive buffer smaller than requested; empty: none."""
        return ""

    @property
    def name(self) -> str:
        """The name of the bus in messages."""
        return f"bus {self.channel}"

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.channel}>"


class KernelBus(Bus):
    """A bus of the kernel: a socket whose datagrams are ``struct can_frame`` or ``struct canfd_frame``, or a line."""

    @property
    @abstractmethod
    def reads_natively(self) -> bool:
        """Whether C can read the open bus in place of ``receive``."""

    @abstractmethod
    def hand_over(self, batch: FrameBatch, source: Any) -> bool:
        """Describe the bus to C, which then reads it in place of ``receive``.

        Args:
            source: filled in: the descriptor, and the stream of a line; for a socket, the memory of ancillary data, the
                clocks and the counts so far.

        Returns:
            Whether C can read it now.
        """

    @abstractmethod
    def take_back(self, source: Any) -> None:
        """Take over what C counted since ``hand_over``; called before any other method."""

    def sort_out(self, batch: FrameBatch, new: slice) -> int:  # noqa: ARG002
        """Remove rows that are no data frames from new rows of a batch; return the number of rows that are left."""
        return len(range(new.start, new.stop))

    @abstractmethod
    def nothing_received(self, number: int) -> int:
        """Handle an error of the kernel in place of frames; 0: there were none although the socket was readable.

        Raises:
            skinware.errors.BusNotAvailable: the interface went down or away.
        """


def is_read_natively(bus: Bus) -> bool:
    """Return whether C can read a bus, as far as it is known."""
    return isinstance(bus, KernelBus) and bus.reads_natively


def chosen_by(choose: Callable[[str, dict[str, str]], type[Bus]]) -> Callable[[_MakeT], _MakeT]:
    """Mark a function that makes buses of several classes.

    Args:
        choose: returns the class for a channel and its options, and raises ``ConfigurationError`` for a wrong channel.
    """

    def mark(make: _MakeT) -> _MakeT:
        setattr(make, CHOOSE, choose)
        return make

    return mark
