"""Base classes of emulators of devices on serial lines and Modbus."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, NamedTuple, TypeVar

from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware_drivers.virtual.device import Device, EmulatorOptions
from skinware_drivers.virtual.emulator import CanFrame, Emulator

_ANSWER = 1 << 11
"""Identifier of messages besides the data, which have 0: lines have no identifiers."""
_HEARD = "heard"  # in the memory of a device: the beginning of a command, and when it came
_LONGEST_PAUSE_NS = 200_000_000
"""Longest pause within a command. An older beginning is forgotten: its host has gone, or meant another device."""


class SerialEmulatorOptions(EmulatorOptions, frozen=True):
    """The period of a device; an emulator adds options for the device itself."""

    period_ms: Annotated[float, Meta(ge=0.1, description="time between two bursts until the host changes it, ms")] = 10


OptionsT = TypeVar("OptionsT", bound=SerialEmulatorOptions)


class SerialEmulator(Emulator[OptionsT]):
    """Emulated devices on one serial line, by default one with the number 1.

    A subclass defines the :meth:`messages` of a device and the ``places`` of its values. If its devices take commands,
    it also defines how to :meth:`cut` them out of the bytes on the line, and how to :meth:`answer` them.

    Attributes:
        speed_mbit_s: of the line.
        datagrams: each message is a datagram of its own, as over UDP, not part of a stream.
    """

    medium = "serial"
    least_options = SerialEmulatorOptions
    numbers: Sequence[int] = (1,)
    speed_mbit_s: ClassVar[int] = 1
    datagrams: ClassVar[bool] = False

    def __init__(self, options: OptionsT, **more: Any) -> None:
        if options.foreign_hz:
            raise ConfigurationError("option foreign_hz: nothing else is attached to a serial line")
        super().__init__(options, **more)
        self.wire.speed = self.speed_mbit_s

    # A subclass defines these

    @abstractmethod
    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """Return the whole messages of one burst, checksums included."""

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:  # noqa: ARG002
        """Cut commands out of a stream; by default there are none. See :func:`cut_packets`.

        Args:
            heard: bytes after the last command.

        Returns:
            The whole commands, whatever their checksums; and the rest, which comes again with more bytes after it.
        """
        return [], b""

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:  # noqa: ARG002
        """Obey a whole command; return the answer, or None if the command means nothing to the device."""
        return None

    # A subclass may use these

    def say(self, device: Device, message: bytes, now_ns: int) -> None:
        """Send a message besides the data."""
        self.reply(device, (_ANSWER, message), now_ns)

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Name the kind of a message, by default ``data`` or ``answer``: those of ``say`` have an identifier."""
        return "answer" if identifier else "data"

    def kinds(self) -> Sequence[str]:
        """Name the kinds of messages with data: those of a burst, or ``data`` of devices that only answer."""
        return ["data"] if self.streams == "never" else super().kinds()

    # Within

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:  # noqa: ARG002
        """Take bytes of the host, in any pieces."""
        begun, heard_ns = device.memory.get(_HEARD, (b"", now_ns))
        commands, rest = self.cut(payload if now_ns - heard_ns > _LONGEST_PAUSE_NS else begun + payload)
        device.memory[_HEARD] = rest, now_ns
        obeyed = False
        for command in commands:
            answer = self.answer(device, command, now_ns)
            obeyed |= answer is not None
            if answer:
                self.say(device, answer, now_ns)
        return obeyed

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        """Return the messages as frames."""
        return [(0, message) for message in self.messages(device, values)]


def cut_packets(heard: bytes, begin: bytes, total: Callable[[bytes], int]) -> tuple[list[bytes], bytes]:
    """Cut commands that begin with known bytes; return them and the rest, as ``SerialEmulator.cut`` does.

    Args:
        heard: bytes after the last command.
        begin: first bytes of every command.
        total: returns the length of a command from its first bytes; 0: they are too few.
    """
    found: list[bytes] = []
    while (at := heard.find(begin)) >= 0:
        heard = heard[at:]
        length = total(heard)
        if not length or len(heard) < length:
            return found, heard
        found.append(heard[:length])
        heard = heard[length:]
    return found, heard[max(0, len(heard) - len(begin) + 1) :]


_HEADER_OF_TCP = 6
_READS, _WRITE_ONE, _WRITE_MANY = (3, 4), 6, 16
_NO_SUCH_FUNCTION, _NO_SUCH_REGISTERS = 1, 2
_MOST_READ = 125
_SAMPLE, _ASKED = "sample", "asked"  # in the memory of a device


class _Asked(NamedTuple):
    """A question; its number is None on a serial line."""

    number: bytes | None
    unit: int
    message: bytes


class ModbusEmulator(SerialEmulator[OptionsT]):
    """Emulated Modbus units, whose numbers are their addresses.

    A unit samples its sensors when it is asked for their lowest register, or for another one before the first sample.
    Other questions are answered from the newest sample, so that a whole round of questions is one burst.

    Attributes:
        step: from the address of one register to the next.
        function: that reads the registers, 3 or 4.
    """

    medium = "modbus"
    streams = "never"
    step: int = 1
    function: int = 3

    @abstractmethod
    def registers(self, device: Device, values: Sequence[int]) -> Mapping[int, int]:
        """Return the content of the registers for values of the sensors: address -> 16 bits."""

    def beside(self, device: Device) -> Mapping[int, int]:  # noqa: ARG002
        """Return the content of registers that do not belong to its sensors. By default there are none."""
        return {}

    def of_other_function(self, device: Device) -> Mapping[int, int]:  # noqa: ARG002
        """Return the content of the registers that the other function reads, 3 or 4. By default there are none."""
        return {}

    def written(self, device: Device, address: int, value: int) -> bool:  # noqa: ARG002
        """Write a register; return whether it can be written. By default none can."""
        return False

    # Within

    def kinds(self) -> Sequence[str]:
        """Name the registers with data; a question for a silent one gets no answer."""
        device = next(iter(self.devices.values()))
        return [str(address) for address in sorted(self.registers(device, self._each("rest").tolist()))]

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        """Cut questions out of a stream, as on a line or as over TCP."""
        found: list[bytes] = []
        while heard:
            size = _size_on_line(heard) or _size_over_tcp(heard)
            if size is None:
                return found, heard
            if size:
                found.append(heard[:size])
            heard = heard[size or 1 :]
        return found, b""

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        """Answer a question to this unit."""
        if _size_on_line(command) == len(command):
            asked = _Asked(None, command[0], command[1:-2])
        else:
            asked = _Asked(command[:2], command[6], command[7:])
        if asked.unit != device.number:
            return None
        function = asked.message[0]
        address, count = int.from_bytes(asked.message[1:3], "big"), int.from_bytes(asked.message[3:5], "big")
        if function == self.function and 1 <= count <= _MOST_READ:
            wanted = range(address, address + count * self.step, self.step)
            if not self.silent.isdisjoint(map(str, wanted)):
                self.counts["silenced"] += 1
                return b""
            sample = device.memory.get(_SAMPLE)
            if min(sample) in wanted if sample else not set(wanted) <= set(self.beside(device)):
                device.memory[_ASKED] = asked
                self.burst(device, now_ns)
                return b""
            return _read_from({**self.beside(device), **(sample or {})}, asked, self.step)
        if function in _READS and 1 <= count <= _MOST_READ and (others := self.of_other_function(device)):
            return _read_from(others, asked, self.step)
        if function in (_WRITE_ONE, _WRITE_MANY):
            return self._write(device, asked, address)
        return _reply(asked, bytes([function | 0x80, _NO_SUCH_FUNCTION]))

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """Take a new sample; return the answer to the question that asked for it."""
        device.memory[_SAMPLE] = self.registers(device, values)
        return [_read_from({**self.beside(device), **device.memory[_SAMPLE]}, device.memory[_ASKED], self.step)]

    def _write(self, device: Device, asked: _Asked, address: int) -> bytes:
        message = asked.message
        data = message[3:5] if message[0] == _WRITE_ONE else message[6:]
        pairs: Any = zip(range(address, address + len(data) // 2), data[::2], data[1::2], strict=True)
        if all(self.written(device, register, high << 8 | low) for register, high, low in pairs):
            return _reply(asked, message[:5])
        return _reply(asked, bytes([message[0] | 0x80, _NO_SUCH_REGISTERS]))


def _read_from(known: Mapping[int, int], asked: _Asked, step: int) -> bytes:
    address, count = int.from_bytes(asked.message[1:3], "big"), int.from_bytes(asked.message[3:5], "big")
    wanted = range(address, address + count * step, step)
    if not all(one in known for one in wanted):
        return _reply(asked, bytes([asked.message[0] | 0x80, _NO_SUCH_REGISTERS]))
    data = b"".join(known[one].to_bytes(2, "big") for one in wanted)
    return _reply(asked, bytes([asked.message[0], len(data)]) + data)


def _size_on_line(heard: bytes) -> int:
    """Return the bytes of the question as on a line that begins here; 0: none does, or it is not whole yet."""
    size = 9 + heard[6] if len(heard) > 6 and heard[1] == _WRITE_MANY else 8
    whole = heard[:size]
    return size if len(whole) == size and _crc(whole[:-2]) == whole[-2:] else 0


def _size_over_tcp(heard: bytes) -> int | None:
    """Return the bytes of the question as over TCP that begins here; 0: none does, None: not known yet."""
    if any(heard[2:4]):
        return 0
    if len(heard) < _HEADER_OF_TCP:
        return None
    size = _HEADER_OF_TCP + int.from_bytes(heard[4:6], "big")
    if not _HEADER_OF_TCP + 6 <= size <= _HEADER_OF_TCP + 254:
        return None if len(heard) < 8 else 0  # possibly half a question of a line
    return size if len(heard) >= size else None


def _reply(asked: _Asked, message: bytes) -> bytes:
    body = bytes([asked.unit]) + message
    if asked.number is None:
        return body + _crc(body)
    return asked.number + b"\0\0" + len(body).to_bytes(2, "big") + body


def _crc(data: bytes) -> bytes:
    """Return the checksum of Modbus: polynomial 8005, reflected, from FFFF, low byte first."""
    remainder = 0xFFFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = remainder >> 1 ^ (0xA001 if remainder & 1 else 0)
    return remainder.to_bytes(2, "little")
