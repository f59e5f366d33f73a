"""The MTB4: the newer patch controller.

Sources: icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp (what commands do),
embot_app_application_theCANparserSkin.cpp and ..._theCANparserBasic.cpp (which it hears) in the same folder,
emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can_analog_polling.cpp (their bytes).
"""

from __future__ import annotations

from typing import ClassVar

from skinware_drivers.virtual.roboskin.boards import BOOTLOADER, EVERY_BOARD, POLLING, Board
from skinware_drivers.virtual.roboskin.converters import DEFAULT_NO_LOAD, DEFAULT_SKIN_TYPE
from skinware_drivers.virtual.roboskin.inertial import MTB4_UNITS, Units
from skinware_drivers.virtual.roboskin.touch import DEFAULT_CDC_OFFSET

_SHORTEST = {0x07: 2, 0x1C: 3, 0x32: 2, 0x33: 8, 0x35: 2, 0x4C: 1, 0x4D: 4, 0x4F: 3, 0x50: 7}
"""Bytes of each command. Shorter ones are ignored here; real boards read what their buffer happens to hold."""


class Mtb4(Board):
    """Hears its own address and the broadcast in both classes; stops streaming for command 0x50."""

    is_mtb3: ClassVar[bool] = False
    board_type: ClassVar[int] = 11
    # icub-firmware:emBODY/eBcode/arch-arm/board/mtb4/application/src/main-appcan.cpp
    firmware: ClassVar[tuple[int, int, int]] = (1, 25, 0)
    protocol: ClassVar[tuple[int, int]] = (2, 0)
    units: ClassVar[Units] = MTB4_UNITS

    def _power_up(self, ready_ns: int) -> None:
        super()._power_up(ready_ns)
        self._converters_ready = False

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> bool:
        destination = identifier & 0xF
        if not self.hears(now_ns) or destination not in (self.address, EVERY_BOARD):
            return False
        host = identifier >> 4 & 0xF
        if identifier >> 8 == BOOTLOADER:
            return self._obey_bootloader(host, payload, now_ns)
        if identifier >> 8 != POLLING:
            return False
        command = payload[0] & 0x7F
        if len(payload) < _SHORTEST.get(command, 9):
            return False
        if command == 0x1C:
            self._send_version(host, payload, now_ns)
        elif command == 0x32:
            return self._set_address(payload[1])
        elif command == 0x4F:
            self.inertial.set_up(payload[1], payload[2], now_ns)
        elif command == 0x33:
            self.inertial.configure_imu(payload[1] | payload[2] << 8)
        elif command == 0x35:
            self.inertial.transmit_imu(payload[1], now_ns)
        else:
            self._start_converters(now_ns)
            return self._obey_skin(command, payload, now_ns)
        return True

    def _obey_bootloader(self, host: int, payload: bytes, now_ns: int) -> bool:
        if payload[0] == 0xFF:
            self._send_discovery(host, now_ns)
            return True
        return payload[0] == 0x32 and len(payload) >= 2 and self._set_address(payload[1])

    def _obey_skin(self, command: int, payload: bytes, now_ns: int) -> bool:
        if command == 0x4D:
            self._converters.set_board(payload[1] & 0x0F, payload[3])
            self._period_ns = payload[2] * 1_000_000
            self._active[:] = False
            if self.next_burst_ns is not None:
                self._begin_bursts(now_ns)
        elif command == 0x50:
            if not self._set_triangles(payload):
                return False
            self.next_burst_ns: None = None
            self._calibrate(now_ns, "command")
        elif command == 0x07:
            if payload[1]:
                self.next_burst_ns = None
            else:
                self._begin_bursts(now_ns)
        else:  # 0x4C, TACT_SETUP: its parameters mean nothing to this board
            self._active[:] = True
            self._period_ns = 40_000_000
            self._converters.set_board(DEFAULT_SKIN_TYPE, DEFAULT_NO_LOAD)
            self._converters.set_cdc_offset(DEFAULT_CDC_OFFSET)
            self._calibrate(now_ns, "command")
            self._begin_bursts(now_ns)
        return True

    def _start_converters(self, now_ns: int) -> None:
        """The first skin command makes the converters work, which takes the first baseline (``hwinit``)."""
        if not self._converters_ready:
            self._converters_ready = True
            self._calibrate(now_ns, "power_up")

    def _recalibrate_by_itself(self, time_ns: int) -> bool:
        """New baselines at the beginning of a burst, which follows at once (``tick``)."""
        self._calibrate(time_ns, "no_ack")
        return True
