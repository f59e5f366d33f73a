"""The base class of emulators of devices on serial lines."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Annotated, Any, ClassVar, TypeVar

from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware_drivers.virtual.device import Device, EmulatorOptions
from skinware_drivers.virtual.emulator import CanFrame, Emulator

_HEARD = "heard"  # in the memory of a device: the beginning of a command, and when it came
_LONGEST_PAUSE_NS = 200_000_000
"""Longest pause within a command. An older beginning is forgotten: its host has gone, or meant another device."""


class SerialEmulatorOptions(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
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

    Raises:
        ConfigurationError: the options ask for frames of other devices, which a line does not have.
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
        self.reply(device, (0, message), now_ns)

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Name the kind of a message; by default all are ``data``."""
        return "data"

    def kinds(self) -> Sequence[str]:
        """Name the kinds of messages with data; by default there is one."""
        return ["data"]

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
