"""Emulators of devices on serial lines: what a new one need not say, beyond what :mod:`.emulator` does for all."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Annotated, Any, ClassVar, TypeVar

from msgspec import Meta

from skinware.errors import ConfigurationError
from skinware_drivers.virtual.emulator import CanFrame, Device, Emulator
from skinware_drivers.virtual.emulator_options import EmulatorOptions

_HEARD = "heard"  # in the memory of a device: the beginning of a command whose end it did not hear yet, and when
_LONGEST_PAUSE_NS = 200_000_000
"""Within a command. What was begun longer ago is forgotten: its host has gone, or it was meant for another device."""


class SerialEmulatorOptions(EmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How often a device sends; an emulator adds what the device is."""

    period_ms: Annotated[float, Meta(ge=0.1, description="time between two bursts until the host changes it, ms")] = 10


OptionsT = TypeVar("OptionsT", bound=SerialEmulatorOptions)


class SerialEmulator(Emulator[OptionsT]):
    """Emulated devices on one serial line, by default one with the number 1.

    A subclass says which :meth:`messages` a device sends and where the values are felt (``places``); one whose devices
    hear something says how to :meth:`cut` commands out of what they hear, and how they :meth:`answer`.

    Attributes:
        speed_mbit_s: of the line.
        datagrams: each message is a datagram of its own, as over UDP, and no part of a stream.

    Raises:
        ConfigurationError: the options want frames of other devices, of which a line has none.
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

    # What a subclass says

    @abstractmethod
    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        """What a device sends in one burst, with beginning, checksum and all."""

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:  # noqa: ARG002
        """Cut commands out of a stream; by default there are none. See :func:`cut_packets`.

        Args:
            heard: what was heard, from the end of the last command on.

        Returns:
            The whole commands, whether or not their checksums are right; and what must be heard again with more behind
            it.
        """
        return [], b""

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:  # noqa: ARG002
        """Obey a whole command; gives what the device answers, or None if the command means nothing to it."""
        return None

    # What it may use

    def say(self, device: Device, message: bytes, now_ns: int) -> None:
        """Send a message beside the data."""
        self.reply(device, (0, message), now_ns)

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Name the kind of a message; by default all are ``data``."""
        return "data"

    def kinds(self) -> Sequence[str]:
        """Name the kinds of messages with data; by default there is one."""
        return ["data"]

    # What it need not care about

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:  # noqa: ARG002
        """Take what the host wrote, in whatever pieces it comes."""
        begun, heard_ns = device.memory.get(_HEARD, (b"", now_ns))
        commands, rest = self.cut(payload if now_ns - heard_ns > _LONGEST_PAUSE_NS else begun + payload)
        device.memory[_HEARD] = rest, now_ns
        obeyed = False
        for command in commands:
            said = self.answer(device, command, now_ns)
            obeyed |= said is not None
            if said:
                self.say(device, said, now_ns)
        return obeyed

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        """The messages."""
        return [(0, message) for message in self.messages(device, values)]


def cut_packets(heard: bytes, begin: bytes, total: Callable[[bytes], int]) -> tuple[list[bytes], bytes]:
    """Cut commands that begin with known bytes; what a ``SerialEmulator.cut`` returns.

    Args:
        heard: what was heard, from the end of the last command on.
        begin: first bytes of every command.
        total: tells from the bytes of a command how many it has; 0: too few to tell.
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
