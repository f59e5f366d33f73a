"""The MTB3: the older patch controller.

Its application starts and stops one timer, which paces both acquisition and transmission; several commands touch
that timer, and not all mean to. Sources: the dsPIC application of the MTB3, revision 2.10.14 (``can_interface.c``
and ``main.c``; a descendant is kolintang/skin_sensor:mtb_main/main_v1.4.c, an ancestor
icub-main:src/firmware/MTB3/can_interface.c). That SET_BRD_CFG disables all triangles is in later revisions:
icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp, "as in application of mtb3".
"""

from __future__ import annotations

from typing import ClassVar, Literal

from skinware_drivers.virtual import events
from skinware_drivers.virtual.roboskin.boards import BOOTLOADER, DATA, EVERY_BOARD, OLD_DATA, POLLING, Board
from skinware_drivers.virtual.roboskin.inertial import MTB3_UNITS, Units

_SHORTEST = {0x07: 2, 0x1C: 3, 0x32: 2, 0x4C: 8, 0x4D: 4, 0x4E: 7, 0x4F: 3, 0x50: 7}
"""Bytes of each command. Shorter ones are ignored here; real boards read what their buffer happens to hold."""
_NOT_COMPENSATED = 2
_OWN_TIMER = 3
"""Timer byte of TACT_SETUP (0x4C) that says: the period is in the last two bytes."""
_TIMER_TICK_NS = 3200


class Mtb3(Board):
    """Hears broadcasts only in the bootloader's class, and such a command silences it.

    Sends the old class 3 until one of the newer commands 0x4D, 0x50 and 0x07 00 comes. Command 0x50 does not stop
    it for good: it calibrates for three periods and then goes on if it was enabled, as it also does when only a
    discovery had silenced it.
    """

    is_mtb3: ClassVar[bool] = True
    board_type: ClassVar[int] = 5
    firmware: ClassVar[tuple[int, int, int]] = (2, 10, 14)
    protocol: ClassVar[tuple[int, int]] = (1, 0)  # assumed: no public source tells what its GET_FW_VERSION says
    units: ClassVar[Units] = MTB3_UNITS

    def _power_up(self, ready_ns: int) -> None:
        super()._power_up(ready_ns)
        self._data_class = OLD_DATA
        self._enabled = False
        self._busy_until_ns = ready_ns
        self._calibrate(ready_ns, "power_up")

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> bool:
        if not self.hears(now_ns):
            return False
        host, destination = identifier >> 4 & 0xF, identifier & 0xF
        if identifier >> 8 == BOOTLOADER and destination in (self.address, EVERY_BOARD):
            return self._obey_bootloader(host, payload, now_ns)
        if identifier >> 8 != POLLING or destination != self.address:
            return False
        command = payload[0]
        if len(payload) < _SHORTEST.get(command, 9):
            return False
        if command == 0x1C:
            self._send_version(host, payload, now_ns)
        elif command == 0x32:
            return self._set_address(payload[1])
        elif command == 0x4F:
            self.inertial.set_up(payload[1], payload[2], now_ns)
        elif command in (0x4C, 0x4E):
            return self._obey_old(command, payload, now_ns)
        else:
            return self._obey_new(command, payload, now_ns)
        return True

    def _obey_bootloader(self, host: int, payload: bytes, now_ns: int) -> bool:
        """Whatever it is, the timers stop until a skin command starts them again."""
        if self.next_burst_ns is not None:
            self.parts.log.append(events.BoardSilenced(time_ns=now_ns, board=self.address))
        self.next_burst_ns = None
        self.inertial.stop()
        if payload[0] == 0xFF:
            self._send_discovery(host, now_ns)
        return True

    def _obey_new(self, command: int, payload: bytes, now_ns: int) -> bool:
        if command == 0x4D:
            self._data_class = DATA
            self._converters.set_board(payload[1] & 0x0F, payload[3])
            self._period_ns = payload[2] * 1_000_000
            self._active[:] = False
            self._begin_if_enabled(now_ns)
        elif command == 0x50:
            self._data_class = DATA
            if not self._set_triangles(payload):
                return False
            self._calibrate_slowly(now_ns + self._period_ns, "command")
            self._begin_if_enabled(now_ns)
        elif payload[1]:
            self._enabled = False
            self.next_burst_ns = None
        else:
            self._data_class = DATA
            self._enabled = True
            self._begin_bursts(now_ns)
        return True

    def _obey_old(self, command: int, payload: bytes, now_ns: int) -> bool:
        if command == 0x4C:
            if payload[1] >> 4:
                return False  # averages over areas of a triangle: other frames, not emulated
            ticks = payload[6] | payload[7] << 8
            own = payload[3] & 0xF == _OWN_TIMER
            self._period_ns = ticks * _TIMER_TICK_NS if own else 50_000_000
            self._converters.set_cdc_offset(payload[4] | payload[5] << 8)
            self._enabled = True
            self._calibrate_slowly(now_ns + self._period_ns, "command")
        else:
            compensated = payload[4] & 0x08
            self._converters.set_board(payload[4] & 0x03 if compensated else _NOT_COMPENSATED, payload[3])
            self._converters.set_shift(payload[1] & 0x0F)
            enabled = payload[5] | payload[6] << 8
            self._active[:] = [bool(enabled >> triangle & 1) for triangle in range(len(self._active))]
        self._begin_if_enabled(now_ns)
        return True

    def _calibrate_slowly(self, tick_ns: int, reason: Literal["command", "no_ack"]) -> None:
        """Wait one period of the timer, acquire, wait another: from the tick ``tick_ns`` on nothing is sent."""
        self._calibrate(tick_ns + self._period_ns, reason)
        self._busy_until_ns = tick_ns + 2 * self._period_ns

    def _begin_if_enabled(self, now_ns: int) -> None:
        """Start the timer again, also where only a discovery had stopped it."""
        if self._enabled:
            self._begin_bursts(now_ns)

    def _begin_bursts(self, now_ns: int) -> None:
        super()._begin_bursts(now_ns)
        if self.next_burst_ns is not None:
            self.next_burst_ns = max(self.next_burst_ns, self._busy_until_ns)

    def _recalibrate_by_itself(self, time_ns: int) -> bool:
        """Two periods without data: nothing is sent while the board calibrates."""
        self._calibrate_slowly(time_ns, "no_ack")
        self.next_burst_ns = self._busy_until_ns
        return False
