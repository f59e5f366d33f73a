"""The adapter that every driver of serial devices subclasses."""

from __future__ import annotations

from typing import ClassVar

from skinware_drivers.adapter import Adapter
from skinware_drivers.bus import Bus
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Frame
from skinware_drivers.link import Match
from skinware_drivers.options import OptionsT
from skinware_drivers.polling import Poll
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.framing import Encoding, Framing
from skinware_drivers.serial.opening import DEFAULT_BAUDRATE

_BITS_PER_BYTE = 10


class SerialAdapter(Adapter[OptionsT]):
    """One serial line of a driver; see :class:`skinware_drivers.adapter.Adapter`.

    What the layout calls the identifier is a number in the header of the frames, if the framing names one, and 0
    otherwise; the payload is the body.

    Attributes:
        framing: how frames lie in the stream.
        commands: how commands are sent, if not in the same way (``Unframed()``: as they are).
        baudrate: unless the bus' name says another.
    """

    medium: ClassVar[str] = "serial"
    framing: Framing
    commands: Encoding | None = None
    baudrate: int = DEFAULT_BAUDRATE
    _line: SerialBus | None = None

    @property
    def payload_size(self) -> int:
        """Longest payload: also answers to commands must fit."""
        return max(self.layout.payload_size, -(-self.framing.maximum_body // 8) * 8)

    def fit(self, bus: Bus) -> None:
        """Tell the line what is on it.

        Raises:
            ConfigurationError: it is another kind of bus.
        """
        super().fit(bus)
        self._line = bus if isinstance(bus, SerialBus) else None
        self.change_framing(self.framing)

    def wire_s(self, poll: Poll) -> float:
        """Question, and the shortest answer that has data; 10 bits a byte."""
        if self._line is None or not self._line.baudrate:
            return 0.0
        size = _size(self.commands or self.framing, poll.identifier, poll.payload)
        if (answer := poll.answer) is not None:
            lengths = [min(frame.length, default=0) for frame in self.layout.frames if _may_be(frame, answer)]
            payload = answer.prefix.ljust(min(lengths, default=0), b"\0")
            size += _size(self.framing, answer.value, payload)
        return _BITS_PER_BYTE * size / self._line.baudrate

    def change_framing(self, framing: Framing) -> None:
        """Go over to another framing, for devices that tell in ``describe`` how long their frames are.

        What was received and not yet fetched is dropped. ``payload_size`` must have allowed for it from the beginning.
        """
        self.framing = framing
        if self._line is not None:
            self._line.use(framing, self.commands, self.baudrate)


def _may_be(frame: Frame, answer: Match) -> bool:
    conditions = [condition for condition in frame.when if isinstance(condition, Identifier)]
    return all((c.value ^ answer.value) & c.mask & answer.mask == 0 for c in conditions)


def _size(encoding: Encoding, identifier: int, payload: bytes) -> int:
    """Bytes of a frame on the line; 0 if there is no such frame."""
    try:
        return len(encoding.encode(identifier, payload))
    except ValueError:
        return 0
