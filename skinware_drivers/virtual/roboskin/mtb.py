"""The two kinds of patch controllers: the older MTB3 and the newer MTB4.

The application of the MTB3 starts and stops one timer, which paces both acquisition and transmission; several commands
touch that timer, and not all mean to. Sources: the dsPIC application of the MTB3, revision 2.10.14 (``can_interface.c``
and ``main.c``; a descendant is kolintang/skin_sensor:mtb_main/main_v1.4.c, an ancestor
icub-main:src/firmware/MTB3/can_interface.c). SET_BRD_CFG disables all triangles in later revisions only:
icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp, "as in application of mtb3".

Sources of the MTB4: icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp (effects of
commands), embot_app_application_theCANparserSkin.cpp and ..._theCANparserBasic.cpp (commands that it hears) in the same
folder, emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can_analog_polling.cpp (their bytes).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from skinware_drivers.virtual.device import DATA as BURSTS
from skinware_drivers.virtual.hardware import Event
from skinware_drivers.virtual.roboskin.boards import DATA, MTB3_UNITS, MTB4_UNITS, OLD_DATA, EmulatedBoard, Units
from skinware_drivers.virtual.roboskin.converters import DEFAULT_NO_LOAD, DEFAULT_SKIN_TYPE
from skinware_drivers.virtual.roboskin.touch import DEFAULT_CDC_OFFSET

_MTB3_BYTES = {0x07: 2, 0x1C: 3, 0x32: 2, 0x4C: 8, 0x4D: 4, 0x4E: 7, 0x4F: 3, 0x50: 7}
_MTB4_BYTES = {0x07: 2, 0x1C: 3, 0x32: 2, 0x33: 8, 0x35: 2, 0x4C: 1, 0x4D: 4, 0x4F: 3, 0x50: 7}
_NOT_COMPENSATED = 2
_OWN_TIMER = 3
"""Timer byte of TACT_SETUP (0x4C) for a period in its last two bytes."""
_TIMER_TICK_NS = 3200


class Mtb3(EmulatedBoard):
    """A board that hears broadcasts only in the bootloader's class, and is silenced by such a command.

    It sends the old class 3 until one of the newer commands 0x4D, 0x50 and 0x07 00 comes. Command 0x50 does not stop
    it for good: it calibrates for three periods and then goes on if it was enabled, even after a discovery silenced it.
    """

    is_mtb3: ClassVar[bool] = True
    board_type: ClassVar[int] = 5
    firmware: ClassVar[tuple[int, int, int]] = (2, 10, 14)
    protocol: ClassVar[tuple[int, int]] = (1, 0)  # assumed: no public source has its GET_FW_VERSION
    units: ClassVar[Units] = MTB3_UNITS
    command_bytes: ClassVar[Mapping[int, int]] = _MTB3_BYTES

    def begin(self, now_ns: int) -> None:
        super().begin(now_ns)
        self._data_class = OLD_DATA
        self._enabled = False
        self._busy_until_ns = now_ns
        self._calibrate(now_ns, "power_up")

    def _obey_bootloader(self, host: int, payload: bytes, now_ns: int) -> bool:
        """Stop the timers, whatever the command is, until a skin command starts them again."""
        if self.runs(BURSTS):
            self.stage.log.append(Event("board_silenced", now_ns, board=self.number))
        self.stop(BURSTS)
        self._send_inertial(False, 0, now_ns)
        if payload[0] == 0xFF:
            self._send_discovery(host, now_ns)
        return True

    def _obey(self, command: int, payload: bytes, now_ns: int) -> bool:
        if command in (0x4C, 0x4E):
            return self._obey_old(command, payload, now_ns)
        if command == 0x4D:
            self._data_class = DATA
            self._set_board(payload)
            self._begin_if_enabled(now_ns)
        elif command == 0x50:
            self._data_class = DATA
            if not self._set_triangles(payload):
                return False
            self._calibrate_slowly(now_ns + self._period_ns, "command")
            self._begin_if_enabled(now_ns)
        elif payload[1]:
            self._enabled = False
            self.stop(BURSTS)
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
            self._converters.set_triangles(cdc_offset=payload[4] | payload[5] << 8)
            self._enabled = True
            self._calibrate_slowly(now_ns + self._period_ns, "command")
        else:
            compensated = payload[4] & 0x08
            self._converters.set_board(payload[4] & 0x03 if compensated else _NOT_COMPENSATED, payload[3])
            self._converters.set_triangles(shift=payload[1] & 0x0F)
            enabled = payload[5] | payload[6] << 8
            self._active[:] = [bool(enabled >> triangle & 1) for triangle in range(len(self._active))]
        self._begin_if_enabled(now_ns)
        return True

    def _calibrate_slowly(self, tick_ns: int, reason: Literal["command", "no_ack"]) -> None:
        """Wait one period of the timer, acquire, wait another; send nothing from the tick ``tick_ns`` on."""
        self._calibrate(tick_ns + self._period_ns, reason)
        self._busy_until_ns = tick_ns + 2 * self._period_ns

    def _begin_if_enabled(self, now_ns: int) -> None:
        """Start the timer again, also where only a discovery had stopped it."""
        if self._enabled:
            self._begin_bursts(now_ns)

    def _begin_bursts(self, now_ns: int, not_before_ns: int = 0) -> None:
        super()._begin_bursts(now_ns, max(not_before_ns, self._busy_until_ns))

    def _recalibrate_by_itself(self, time_ns: int) -> bool:
        """Calibrate for two periods, without data."""
        self._calibrate_slowly(time_ns, "no_ack")
        self.every(BURSTS, self._period_ns, self._busy_until_ns)
        return False


class Mtb4(EmulatedBoard):
    """A board that hears its own address and the broadcast in both classes; command 0x50 stops its stream."""

    is_mtb3: ClassVar[bool] = False
    board_type: ClassVar[int] = 11
    # icub-firmware:emBODY/eBcode/arch-arm/board/mtb4/application/src/main-appcan.cpp
    firmware: ClassVar[tuple[int, int, int]] = (1, 25, 0)
    protocol: ClassVar[tuple[int, int]] = (2, 0)
    units: ClassVar[Units] = MTB4_UNITS
    command_bytes: ClassVar[Mapping[int, int]] = _MTB4_BYTES

    def begin(self, now_ns: int) -> None:
        super().begin(now_ns)
        self._converters_ready = False

    def _obey_bootloader(self, host: int, payload: bytes, now_ns: int) -> bool:
        if payload[0] == 0xFF:
            self._send_discovery(host, now_ns)
            return True
        return payload[0] == 0x32 and len(payload) >= 2 and self._set_address(payload[1])

    def _obey(self, command: int, payload: bytes, now_ns: int) -> bool:
        if command == 0x33:
            self.inertial.configure_imu(payload[1] | payload[2] << 8)
            return True
        if command == 0x35:
            self._send_inertial(self.inertial.transmit_imu(), payload[1], now_ns)
            return True
        if not self._converters_ready:  # the first skin command takes the first baseline (``hwinit``)
            self._converters_ready = True
            self._calibrate(now_ns, "power_up")
        if command == 0x4D:
            self._set_board(payload)
            if self.runs(BURSTS):
                self._begin_bursts(now_ns)
        elif command == 0x50:
            if not self._set_triangles(payload):
                return False
            self.stop(BURSTS)
            self._calibrate(now_ns, "command")
        elif command == 0x07:
            if payload[1]:
                self.stop(BURSTS)
            else:
                self._begin_bursts(now_ns)
        else:  # 0x4C, TACT_SETUP: this board ignores its parameters
            self._active[:] = True
            self._period_ns = 40_000_000
            self._converters.set_board(DEFAULT_SKIN_TYPE, DEFAULT_NO_LOAD)
            self._converters.set_triangles(cdc_offset=DEFAULT_CDC_OFFSET)
            self._calibrate(now_ns, "command")
            self._begin_bursts(now_ns)
        return True

    def _recalibrate_by_itself(self, time_ns: int) -> bool:
        """Take new baselines at the beginning of a burst, which follows at once (``tick``)."""
        self._calibrate(time_ns, "no_ack")
        return True
