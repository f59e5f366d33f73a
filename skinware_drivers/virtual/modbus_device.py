"""The base class of emulators of Modbus devices, which declare their registers and the content.

They answer a question in the form in which it came, as on a serial line (RTU) or as over TCP, so that one emulator
serves both. They share no code with the drivers.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from skinware_drivers.virtual.device import Device
from skinware_drivers.virtual.serial_device import OptionsT, SerialEmulator

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
        device = Device(self.numbers[0], self, self.wire.attach(), 0)
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
        asked = _read(command)
        if asked.unit != device.number:
            return None
        function = asked.message[0]
        address, count = int.from_bytes(asked.message[1:3], "big"), int.from_bytes(asked.message[3:5], "big")
        if function == self.function and 1 <= count <= _MOST_READ:
            wanted = range(address, address + count * self.step, self.step)
            if not self.silent.isdisjoint(map(str, wanted)):
                self.counts["silenced"] += 1
                return b""
            if self._is_to_sample(device, wanted):
                device.memory[_ASKED] = asked
                self.burst(device, now_ns)
                return b""
            return _read_from({**self.beside(device), **device.memory.get(_SAMPLE, {})}, asked, self.step)
        if function in _READS and 1 <= count <= _MOST_READ and (others := self.of_other_function(device)):
            return _read_from(others, asked, self.step)
        if function in (_WRITE_ONE, _WRITE_MANY):
            return self._write(device, asked, address)
        return _reply(asked, bytes([function | 0x80, _NO_SUCH_FUNCTION]))

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """Take a new sample; return the answer to the question that asked for it."""
        device.memory[_SAMPLE] = self.registers(device, values)
        return [_read_from({**self.beside(device), **device.memory[_SAMPLE]}, device.memory[_ASKED], self.step)]

    def _is_to_sample(self, device: Device, wanted: range) -> bool:
        if _SAMPLE in device.memory:
            return min(device.memory[_SAMPLE]) in wanted
        return not set(wanted) <= set(self.beside(device))

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


def _read(command: bytes) -> _Asked:
    if _size_on_line(command) == len(command):
        return _Asked(None, command[0], command[1:-2])
    return _Asked(command[:2], command[6], command[7:])


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
