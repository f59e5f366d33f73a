"""The adapter that every driver of serial devices subclasses."""

from __future__ import annotations

from typing import ClassVar

from skinware_drivers.adapter import Adapter
from skinware_drivers.bus import Bus
from skinware_drivers.options import OptionsT
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.framing import Encoding, Framing
from skinware_drivers.serial.opening import DEFAULT_BAUDRATE


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

    def change_framing(self, framing: Framing) -> None:
        """Go over to another framing, for devices that tell in ``describe`` how long their frames are.

        What was received and not yet fetched is dropped. ``payload_size`` must have allowed for it from the beginning.
        """
        self.framing = framing
        if self._line is not None:
            self._line.use(framing, self.commands, self.baudrate)
