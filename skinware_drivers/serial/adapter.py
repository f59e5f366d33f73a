"""The adapter that drivers of serial devices subclass, and answers to commands that begin with a status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from skinware.errors import BusError
from skinware_drivers.adapter import Adapter
from skinware_drivers.bus import Bus
from skinware_drivers.fields import Identifier
from skinware_drivers.options import OptionsT
from skinware_drivers.polling import Poll
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.framing import Encoding, Framing
from skinware_drivers.serial.ports import DEFAULT_BAUDRATE

_BITS_PER_BYTE = 10


class SerialAdapter(Adapter[OptionsT]):
    """One serial line of a driver; see :class:`skinware_drivers.adapter.Adapter`.

    The identifier of a frame is a number in its header if the framing names one, else 0; the payload is its body.

    Attributes:
        framing: how frames lie in the stream.
        commands: how commands are sent, if not in the same way (``Unframed()``: as they are).
        baudrate: bits per second, unless the name of the bus gives another.
    """

    medium: ClassVar[str] = "serial"
    framing: Framing
    commands: Encoding | None = None
    baudrate: int = DEFAULT_BAUDRATE
    _line: SerialBus | None = None

    @property
    def payload_size(self) -> int:
        """Bytes of the longest payload; answers to commands must fit, too."""
        return max(self.layout.payload_size, -(-self.framing.maximum_body // 8) * 8)

    def fit(self, bus: Bus) -> None:
        """Give the line the framing, the encoding of commands and the baud rate."""
        super().fit(bus)
        self._line = bus if isinstance(bus, SerialBus) else None
        self.change_framing(self.framing)

    def wire_s(self, poll: Poll) -> float:
        """Return the time of the question and the shortest answer with data on the line, s; 10 bits a byte."""
        if self._line is None or not self._line.baudrate:
            return 0.0
        size = _size(self.commands or self.framing, poll.identifier, poll.payload)
        if (answer := poll.answer) is not None:
            lengths = []
            for frame in self.layout.frames:
                conditions = [condition for condition in frame.when if isinstance(condition, Identifier)]
                if all((c.value ^ answer.value) & c.mask & answer.mask == 0 for c in conditions):
                    lengths.append(min(frame.length, default=0))
            payload = answer.prefix.ljust(min(lengths, default=0), b"\0")
            size += _size(self.framing, answer.value, payload)
        return _BITS_PER_BYTE * size / self._line.baudrate

    def change_framing(self, framing: Framing) -> None:
        """Change to another framing, for devices that report in ``describe`` how long their frames are.

        Bytes that are no whole frame yet count for the new one. ``payload_size`` must allow for the framing from the
        beginning.
        """
        self.framing = framing
        if self._line is not None:
            self._line.use(framing, self.commands, self.baudrate)


def _size(encoding: Encoding, identifier: int, payload: bytes) -> int:
    try:
        return len(encoding.encode(identifier, payload))
    except ValueError:  # no such frame
        return 0


class Refused(BusError):
    """A device refused a command.

    Attributes:
        status: the number with which it answered.
    """

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class Answers:
    """Answers that begin with a status: 0, or a number that says why the command was not done.

    Attributes:
        device: name of the devices in messages.
        reasons: meaning of each status other than 0, in words.
        offset: first byte of the status.
        dtype: of the status: unsigned, with byte order.
    """

    device: str
    reasons: Mapping[int, str] = field(hash=False)
    offset: int = 0
    dtype: str = "u1"

    def result(self, command: int, payload: bytes, size: int = 0) -> bytes:
        """Return the bytes behind the status of an answer.

        Args:
            command: the command that was answered, for messages.
            payload: of the answer.
            size: least bytes of the result.

        Raises:
            Refused: the status is not 0.
            BusError: the answer is too short.
        """
        start = self.offset + np.dtype(self.dtype).itemsize
        if len(payload) < start:
            raise BusError(f"the {self.device}'s answer to command {command:#04x} has no status")
        status = int(np.frombuffer(payload, self.dtype, 1, self.offset)[0])
        if status:
            why = self.reasons.get(status, "look into the maker's manual")
            raise Refused(f"the {self.device} refuses command {command:#04x} with status {status}: {why}", status)
        result = payload[start:]
        if len(result) < size:
            raise BusError(
                f"the {self.device}'s answer to command {command:#04x} has {len(result)} bytes instead of {size}"
            )
        return result
