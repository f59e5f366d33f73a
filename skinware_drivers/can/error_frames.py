"""CAN error frames: what a controller says of the wire and of itself, by the classes of linux/can/error.h.

They come in the stream of data frames, with ``CAN_ERR_FLAG`` in the identifier and the class in its other bits. With
``berr-reporting`` a wire in trouble brings thousands a second, so they are read batch by batch.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.status import BusReason

# classes, in the identifier
_CONTROLLER = 0x4
_PROTOCOL = 0x8
_TRANSCEIVER = 0x10
_NO_ACK = 0x20
_BUS_OFF = 0x40
_BUS_ERROR = 0x80
_RESTARTED = 0x100
# details of the controller, in byte 1
_RX_OVERFLOW = 0x01
_WARNING = 0x04 | 0x08
_PASSIVE = 0x10 | 0x20
_ACTIVE = 0x40
# where in a frame a protocol error was met, in byte 3: the two places of the acknowledgement
_ACK_SLOT, _ACK_DELIMITER = 0x19, 0x1B

_ACTIVE_CODE, _WARNING_CODE, _PASSIVE_CODE, _BUS_OFF_CODE = 1, 2, 3, 4
_STATES = {
    _ACTIVE_CODE: BusReason.NONE,
    _WARNING_CODE: BusReason.ERROR_WARNING,
    _PASSIVE_CODE: BusReason.ERROR_PASSIVE,
    _BUS_OFF_CODE: BusReason.BUS_OFF,
}
CONTROLLER_STATES = (BusReason.NONE, BusReason.ERROR_WARNING, BusReason.ERROR_PASSIVE, BusReason.BUS_OFF)
"""What the kernel calls states 0 to 3 of a controller (``enum can_state``)."""
_TROUBLES = (BusReason.OVERFLOW, BusReason.NO_ACKNOWLEDGEMENT, BusReason.BUS_ERRORS)
TROUBLE_LASTS_S = 5.0
"""How long something counts that has a beginning but no end."""


class ControllerHealth:
    """What the error frames of one controller add up to.

    Attributes:
        overflows: how often the controller told that it had lost frames.
        bus_offs: how often it left the wire.
    """

    def __init__(self) -> None:
        self.overflows: int = 0
        self.bus_offs: int = 0
        self._state = BusReason.NONE
        self._trouble_until_ns = dict.fromkeys(_TROUBLES, 0)

    def take(self, identifier: npt.NDArray[np.uint32], payload: npt.NDArray[np.uint8], time_ns: int) -> None:
        """Take error frames in.

        Args:
            identifier: (n,) uint32, in order of arrival.
            payload: (n, 8 or more) uint8.
            time_ns: now, CLOCK_MONOTONIC ns.
        """
        detail = np.where(identifier & _CONTROLLER, payload[:, 1], 0)
        protocol = (identifier & (_PROTOCOL | _BUS_ERROR | _TRANSCEIVER)) != 0
        at_ack = protocol & np.isin(payload[:, 3], (_ACK_SLOT, _ACK_DELIMITER))
        overflows = np.count_nonzero(detail & _RX_OVERFLOW)
        told = {
            BusReason.OVERFLOW: overflows,
            BusReason.NO_ACKNOWLEDGEMENT: np.count_nonzero(at_ack | ((identifier & _NO_ACK) != 0)),
            BusReason.BUS_ERRORS: np.count_nonzero(protocol & ~at_ack),
        }
        for trouble, count in told.items():
            if count:
                self._trouble_until_ns[trouble] = time_ns + round(TROUBLE_LASTS_S * NS_PER_S)
        code = np.zeros(len(identifier), np.uint8)  # of the controller's state; what is worse overwrites what is not
        code[(detail & _ACTIVE) | (identifier & _RESTARTED) != 0] = _ACTIVE_CODE
        code[detail & _WARNING != 0] = _WARNING_CODE
        code[detail & _PASSIVE != 0] = _PASSIVE_CODE
        code[identifier & _BUS_OFF != 0] = _BUS_OFF_CODE
        self.overflows += int(overflows)
        self._count_bus_offs(code[code != 0])

    def _count_bus_offs(self, code: npt.NDArray[np.uint8]) -> None:
        if not len(code):
            return
        was_off = np.append(self._state == BusReason.BUS_OFF, code[:-1] == _BUS_OFF_CODE)
        self.bus_offs += int(np.count_nonzero((code == _BUS_OFF_CODE) & ~was_off))
        self._state = _STATES[int(code[-1])]

    def heard_data(self) -> None:
        """A data frame came after all error frames so far: a controller that receives is not off the wire."""
        if self._state == BusReason.BUS_OFF:
            self._state = BusReason.NONE

    def believe(self, state: BusReason) -> None:
        """Take over the controller's state as the kernel knows it: error frames can be lost."""
        if state == BusReason.BUS_OFF != self._state:
            self.bus_offs += 1
        self._state = state

    def reset(self) -> None:
        """Forget what was wrong: the interface is another, or was set down and up. Counts go on."""
        self._state = BusReason.NONE
        self._trouble_until_ns = dict.fromkeys(_TROUBLES, 0)

    def reason(self, time_ns: int) -> BusReason:
        """The worst that is wrong now; ``NONE`` if nothing is."""
        if self._state != BusReason.NONE:
            return self._state
        return next((t for t, until_ns in self._trouble_until_ns.items() if time_ns < until_ns), BusReason.NONE)
