"""The bus ``virtual``: an emulated CAN bus, serial line or Modbus line in the driver's own process.

On a line, the payloads of the emulator's frames are the bytes, framing and all; their identifier is 0.
"""

from __future__ import annotations

from collections import deque
from typing import ClassVar

from skinware.errors import BusNotAvailable
from skinware_drivers.bus import Bus, chosen_by
from skinware_drivers.modbus.bus import ModbusBus
from skinware_drivers.modbus.registers import Wanted
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import Port
from skinware_drivers.virtual.bus import DEFAULT_EMULATOR, PlacedCanBus, VirtualCanBus
from skinware_drivers.virtual.hand_clock import REAL_CLOCK, Clock
from skinware_drivers.virtual.hardware import (
    EmulatedHardware,
    PlacedHardware,
    WireFrame,
    emulators_instead,
    load_emulator,
    medium_of,
    put_away,
)

_LONGEST_BACKLOG_NS = 1_000_000_000
"""Bytes that wait longer are dropped, as from a full buffer of the kernel."""


class EmulatedLine(Bus):
    """A bus of lines with emulated devices at the other end.

    Args:
        payload_size: longest body that fits into a batch.
        listen_only: refuse every ``send``.
        hardware: devices that exist already, instead of ``channel`` and ``options``.
        clock: stamps what is read, and makes the timer that wakes the reader.

    Raises:
        ConfigurationError: no such emulator, or an option is unknown or has a bad value.
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
        if hardware is None:
            emulator = load_emulator(channel)
            hardware = emulator(options_from_strings(emulator.Options, options or {}))
        self.hardware: EmulatedHardware = hardware
        self._clock = clock
        self._end: EmulatedPort | None = None
        self._is_away = False

    @property
    def name(self) -> str:
        return f"bus virtual:{self.channel}"

    def instead(self, medium: str) -> str:
        return emulators_instead(medium) or super().instead(medium)

    def vanish(self) -> None:
        """Go away as an unplugged port does: ``receive`` raises, and ``open`` until :meth:`come_back`."""
        self._is_away = True
        if self._end is not None:
            self._end.vanish()

    def come_back(self) -> None:
        """End :meth:`vanish`."""
        self._is_away = False

    def _open_port(self) -> Port:
        if self._is_away:
            raise BusNotAvailable(f"{self.name}: the emulated line is away")
        self._end = EmulatedPort(self.hardware, self._clock)
        return self._end


class VirtualSerialBus(EmulatedLine, SerialBus):
    """Emulated serial devices as a bus, with a name as that of ``VirtualCanBus``."""


class VirtualModbusBus(EmulatedLine, ModbusBus):
    """Emulated Modbus devices as a bus, with a name as that of ``VirtualCanBus``."""

    def cycle_s(self, wanted: Wanted, baudrate: int) -> float:  # noqa: ARG002
        """Return 0: it has no baud rate."""
        return 0.0


class EmulatedPort(Port):
    """The host's end of a line with emulated devices at the other."""

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
        now_ns = self._clock()
        due_ns = self._hardware.next_due_ns()
        if due_ns is not None and due_ns < now_ns - _LONGEST_BACKLOG_NS:
            self._hardware.skip(now_ns - _LONGEST_BACKLOG_NS)
        self._unread += self._hardware.emit(now_ns)
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
        self._timer.wake_at(0 if self._unread else self._hardware.next_due_ns())


def _class_of(channel: str, _options: object) -> type[Bus]:
    emulator = load_emulator(channel or DEFAULT_EMULATOR)
    kinds: dict[str, type[Bus]] = {"serial": VirtualSerialBus, "modbus": VirtualModbusBus}
    has_places = isinstance(emulator, type) and issubclass(emulator, PlacedHardware)
    return kinds.get(medium_of(emulator), PlacedCanBus if has_places else VirtualCanBus)


@chosen_by(_class_of)
def virtual_bus(
    channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
) -> Bus:
    """Return the bus ``virtual``: CAN, a serial line or a Modbus line, as the devices need it.

    Raises:
        ConfigurationError: there is no such emulator, or an option is unknown or has a bad value.
    """
    return _class_of(channel, options)(channel, options, payload_size=payload_size, listen_only=listen_only)
