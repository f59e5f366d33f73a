"""The bus ``virtual``: an emulated CAN bus, serial line or Modbus line in the driver's own process."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, ClassVar

import numpy as np

from skinware.errors import BusError, BusNotAvailable, BusSendError
from skinware.geometry import Geometry
from skinware.status import Unused
from skinware_drivers.bus import Bus, FrameBatch, chosen_by, wire_dtype
from skinware_drivers.description import Patch
from skinware_drivers.link import Link
from skinware_drivers.modbus.bus import ModbusBus
from skinware_drivers.modbus.registers import Wanted
from skinware_drivers.operations import operation
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import Port
from skinware_drivers.virtual.hand_clock import REAL_CLOCK, Clock, Timer
from skinware_drivers.virtual.hardware import (
    EmulatedHardware,
    PlacedHardware,
    Pressing,
    WireFrame,
    due_frames,
    emulators_instead,
    load_emulator,
    medium_of,
    put_away,
)
from skinware_drivers.virtual.stage import Stage

DEFAULT_EMULATOR = "roboskin"

_AT_ONCE = 0


class EmulatedBus(Bus):
    """A bus with emulated devices at the other end.

    Its name is ``virtual:NAME?key=value``, with an emulator as NAME (an entry point of the group
    ``skinware.emulators``; ``roboskin`` if empty) and the emulator's options.

    Args:
        payload_size: longest payload of the driver's frames; longer ones are counted as refused.
        hardware: devices that exist already, instead of ``channel`` and ``options``.
        clock: stamps what comes, and makes the timer behind ``fileno``.
    """

    opens_slowly: ClassVar[bool] = False

    def __init__(
        self,
        channel: str,
        options: dict[str, str] | None = None,
        *,
        payload_size: int = 8,
        listen_only: bool = False,
        hardware: EmulatedHardware | None = None,
        clock: Clock = REAL_CLOCK,
    ) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only)
        self._emulated = channel or (type(hardware).__name__ if hardware else DEFAULT_EMULATOR)
        if hardware is None:
            emulator = load_emulator(self._emulated)
            hardware = emulator(options_from_strings(emulator.Options, options or {}))
        self.hardware: EmulatedHardware = hardware
        self._clock = clock
        self._is_away = False

    @property
    def name(self) -> str:
        return f"bus virtual:{self._emulated}"

    def instead(self, medium: str) -> str:
        return emulators_instead(medium) or super().instead(medium)

    def vanish(self) -> None:
        """Go away as an unplugged interface does: ``receive`` raises, and ``open`` until :meth:`come_back`."""
        self._is_away = True

    def come_back(self) -> None:
        """End :meth:`vanish`. A driver that has not noticed it yet still gets the error once."""
        self._is_away = False


class VirtualCanBus(EmulatedBus):
    """Emulated hardware as a CAN bus.

    Frames are stamped with the time at which they went onto the emulated wire, and arrive in that order. Frames that
    are not fetched for a second are dropped and counted in ``counters.dropped``.
    """

    medium: ClassVar[str] = "can"

    def __init__(self, channel: str, options: dict[str, str] | None = None, **others: Any) -> None:
        super().__init__(channel, options, **others)
        self._wire = self.hardware.wire if isinstance(self.hardware, Stage) else None
        self.bit_rate: int = self._wire.bit_rate if self._wire else 0
        self._timer: Timer | None = None
        self._pending: list[WireFrame] = []
        self._next_error: BusError | None = None

    # Bus

    @classmethod
    def fits(cls, medium: str) -> bool:
        """Return whether a driver of CAN devices, or of a program that makes values, can use the bus."""
        return medium in ("can", "virtual")

    def open(self) -> None:
        """Listen to the devices. The first call powers them up; frames sent before a later one are gone.

        Raises:
            BusNotAvailable: after :meth:`vanish`, until :meth:`come_back`.
            PlatformError: this system has no timerfd.
        """
        if self._is_away:
            raise BusNotAvailable(f"{self.name}: the emulated interface is away")
        if self._timer is None:
            self._timer = self._clock.timer()
            self.hardware.skip(self._clock())
            self._wake_when_due()

    def fileno(self) -> int:
        """A descriptor that is readable when ``receive`` has something to do; -1 while the bus is closed."""
        return -1 if self._timer is None else self._timer.fileno()

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Append the frames that are due, at most ``batch.free``; the others stay, and the bus stays readable."""
        if self._next_error is not None:
            error, self._next_error = self._next_error, None
            raise error
        if self._timer is None or self._is_away:
            raise BusNotAvailable(f"{self.name} is not open")
        now_ns = self._clock()
        if len(self._pending) < batch.free:
            frames, too_old = due_frames(self.hardware, now_ns)
            self.counters.dropped += too_old
            for frame in frames:
                if len(frame.payload) <= self.payload_size:
                    self._pending.append(frame)
                else:
                    self.counters.refused += 1
                    self.samples.note(Unused.REFUSED, frame.identifier, frame.payload)
                    self.tap.keep_frame(*frame)
        if self._wire is not None:
            self.wire_bits = self._wire.bits
        frames, self._pending = self._pending[: batch.free], self._pending[batch.free :]
        if frames:
            self._append(batch, ordinal, frames)
            self.counters.frames += len(frames)
        self._wake_when_due()
        return len(frames)

    def send(self, identifier: int, payload: bytes) -> None:
        """Send one frame to the devices."""
        try:
            self.may_send_by(None if self._is_away else self._timer)
            if len(payload) > self.payload_size:
                raise BusSendError(f"{self.name}: {len(payload)} bytes of payload, in frames of {self.payload_size}")
        except BusSendError:
            self.counters.send_failures += 1
            raise
        sent_ns = self._clock()  # not later than an answer
        self.hardware.receive(identifier, payload, sent_ns)
        self.counters.sent += 1
        if self.tap.is_open:
            self.tap.keep_frame(sent_ns, identifier, payload, is_sent=True)
        self._wake_when_due()

    def close(self) -> None:
        if self._timer is not None:
            self._timer.close()
            self._timer = None
        self._pending = []
        put_away(self.hardware)

    # Faults of the bus itself, for tests

    def fail_next_receive(self, error: BusError) -> None:
        self._next_error = error
        self._wake_at(_AT_ONCE)

    def vanish(self) -> None:
        super().vanish()
        self.fail_next_receive(BusNotAvailable(f"{self.name}: the emulated interface went away"))

    # Within

    def _append(self, batch: FrameBatch, ordinal: int, frames: Sequence[WireFrame]) -> None:
        pack = _packer(batch.payload_size)
        rows = b"".join([pack(identifier, len(payload), payload) for _, identifier, payload in frames])
        stop = batch.stop + len(frames)
        batch.wire[batch.stop : stop] = np.frombuffer(rows, batch.wire.dtype)
        batch.time_ns[batch.stop : stop] = [frame.time_ns for frame in frames]
        batch.bus[batch.stop : stop] = ordinal
        if self.tap.is_open:
            self.tap.keep_rows(batch.wire[batch.stop : stop], batch.time_ns[batch.stop : stop])
        batch.stop = stop

    def _wake_when_due(self) -> None:
        """Become readable when a frame is due; at once while some wait."""
        self._wake_at(_AT_ONCE if self._pending else self.hardware.next_due_ns())

    def _wake_at(self, time_ns: int | None) -> None:
        if self._timer is not None:
            self._timer.wake_at(time_ns)


@cache
def _packer(payload_size: int) -> Callable[[int, int, bytes], bytes]:
    """Return the function that packs (identifier, length, payload) as a row of a batch."""
    if wire_dtype(payload_size)["length"].itemsize > 1:
        return struct.Struct(f"=II{payload_size}s").pack
    return struct.Struct(f"=IB3x{payload_size}s").pack


class PlacedCanBus(VirtualCanBus):
    hardware: PlacedHardware

    @property
    def geometry(self) -> Geometry | None:
        return self.hardware.geometry()

    @operation()
    async def press(
        self,
        link: Link,  # noqa: ARG002 - as every operation
        patches: Sequence[Patch],  # noqa: ARG002
        at_m: Sequence[float],
        force_n: float = 3.0,
        radius_m: float = 0.006,
        seconds: float = 1.0,
    ) -> dict[str, object]:
        """Press the emulated skin at a place for a while.

        Raises:
            ValueError: the numbers make no sense, or no taxel would feel it.
        """
        return self.hardware.press(Pressing.of(at_m, force_n, radius_m, seconds), self._clock())


class EmulatedLine(EmulatedBus):
    """A line; the payloads of its emulator's frames are the bytes, framing and all, and their identifier is 0."""

    _end: EmulatedPort | None = None

    def vanish(self) -> None:
        super().vanish()
        if self._end is not None:
            self._end.vanish()

    def _open_port(self) -> Port:
        if self._is_away:
            raise BusNotAvailable(f"{self.name}: the emulated line is away")
        self._end = EmulatedPort(self.hardware, self._clock)
        return self._end


class VirtualSerialBus(EmulatedLine, SerialBus):
    """Emulated serial devices as a bus, with a name as that of ``VirtualCanBus``."""


class VirtualModbusBus(EmulatedLine, ModbusBus):
    def cycle_s(self, wanted: Wanted, baudrate: int) -> float:  # noqa: ARG002
        """Return 0: it has no baud rate."""
        return 0.0


class EmulatedPort(Port):
    def __init__(self, hardware: EmulatedHardware, clock: Clock) -> None:
        self._hardware, self._clock, self._timer = hardware, clock, clock.timer()
        self._unread: deque[WireFrame] = deque()
        self._is_away = False
        hardware.skip(clock())
        self._wake_when_due()

    def fileno(self) -> int:
        return self._timer.fileno()

    def read(self, size: int) -> bytes:
        if self._is_away:
            raise BusNotAvailable("the emulated line went away, perhaps unplugged")
        self._unread += due_frames(self._hardware, self._clock())[0]
        if getattr(self._hardware, "datagrams", False):
            data = self._unread.popleft().payload if self._unread else b""
        else:
            data = b"".join(frame.payload for frame in self._unread)
            self._unread = deque([WireFrame(0, 0, data[size:])] if len(data) > size else ())
        self._wake_when_due()
        return data[:size]

    def write(self, data: bytes) -> int:
        if self._is_away:
            raise OSError("unplugged")
        self._hardware.receive(0, data, self._clock())
        self._wake_when_due()
        return len(data)

    def close(self) -> None:
        self._timer.close()
        put_away(self._hardware)

    def vanish(self) -> None:
        self._is_away = True
        self._timer.wake_at(0)

    def _wake_when_due(self) -> None:
        self._timer.wake_at(_AT_ONCE if self._unread else self._hardware.next_due_ns())


BUSES: dict[str, type[EmulatedBus]] = {
    "can": VirtualCanBus,
    "virtual": VirtualCanBus,
    "serial": VirtualSerialBus,
    "modbus": VirtualModbusBus,
}
"""The emulated bus of each medium."""


def _class_of(channel: str, _options: object) -> type[Bus]:
    emulator = load_emulator(channel or DEFAULT_EMULATOR)
    kind = BUSES.get(medium_of(emulator), VirtualCanBus)
    has_places = isinstance(emulator, type) and issubclass(emulator, PlacedHardware)
    return PlacedCanBus if has_places and kind is VirtualCanBus else kind


@chosen_by(_class_of)
def virtual_bus(
    channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
) -> Bus:
    """Return the bus ``virtual``: CAN, a serial line or a Modbus line, as the devices need it."""
    return _class_of(channel, options)(channel, options, payload_size=payload_size, listen_only=listen_only)
