"""An emulated patch controller: the part that both kinds of MTB share. The kinds differ in their commands.

Messages of inertial sensors: icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can_inertial_periodic.cpp
(data), embot_prot_can_analog_polling.cpp (commands) and embot_prot_can.h (numbers of an IMU's sensors) in the same
folder.
"""

from __future__ import annotations

import math
import struct
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from skinware_drivers.virtual.device import DATA as BURSTS
from skinware_drivers.virtual.device import Device, Transmission
from skinware_drivers.virtual.hardware import Event
from skinware_drivers.virtual.roboskin.converters import Converters, TriangleFaults, TriangleState
from skinware_drivers.virtual.roboskin.touch import TRIANGLES, EmulatedRoboskinOptions, PressedSkin, Touch, WireSource
from skinware_drivers.virtual.stage import Stage

GYROSCOPE_MESSAGE, ACCELEROMETER_MESSAGE, IMU_MESSAGE = 0, 1, 3
"""Low four bits of the identifiers of class 5."""

_ACCELEROMETERS, _GYROSCOPE = 0b1011, 0b0100
_ACCELERATION, _MAGNETIC_FIELD, _ANGULAR_RATE = 0, 1, 2
_MEASURED_BY_IMU = (_ACCELERATION, _MAGNETIC_FIELD, _ANGULAR_RATE)
_SWAY = 0.1
"""Radians to each side, at one radian a second."""
_FIELD_XZ_UT = (22, -42)


class Units(NamedTuple):
    """Counts per unit of a kind of board."""

    per_m_s2: float
    per_deg_s: float


MTB3_UNITS = Units(0x8000 / (2 * 9.80665), 0x8000 / 250)
"""An LIS331DLH with a range of 2 g and an L3G4200D of 250 deg/s (robotology/icub-main pull request 543)."""
MTB4_UNITS = Units(100, 16)
"""A BNO055, whose numbers go out as they are (data sheet of the BNO055)."""


class InertialSensors:
    """The choice of a board's inertial sensors, none at power-up, and their messages; its robot sways a little."""

    def __init__(self, units: Units) -> None:
        self._units = units
        self._mask = self._imu_mask = self._sequence = 0

    def set_up(self, mask: int) -> bool:
        """Choose sensors as ACC_GYRO_SETUP (0x4F) does; return whether there are any."""
        self._mask, self._imu_mask = mask & 0xF, 0
        return bool(self._mask)

    def configure_imu(self, mask: int) -> None:
        """Choose sensors of an IMU as IMU_CONFIG_SET (0x33) does."""
        self._mask, self._imu_mask = 0, mask

    def transmit_imu(self) -> bool:
        """Begin a sequence as IMU_TRANSMIT (0x35) does; return whether there are sensors."""
        self._sequence = 0
        return bool(self._imu_mask)

    def messages(self, time_ns: int) -> list[tuple[int, bytes]]:
        """Return the messages of one period: low four bits of the identifier, and payload."""
        time_s = time_ns * 1e-9
        messages = []
        if self._mask & _ACCELEROMETERS:
            messages.append((ACCELEROMETER_MESSAGE, self._three(_ACCELERATION, time_s)))
        if self._mask & _GYROSCOPE:
            messages.append((GYROSCOPE_MESSAGE, self._three(_ANGULAR_RATE, time_s)))
        if self._imu_mask:
            self._sequence = (self._sequence + 1) & 0xFF
            messages += [
                (IMU_MESSAGE, bytes((self._sequence, sensor)) + self._three(sensor, time_s))
                for sensor in _MEASURED_BY_IMU
                if self._imu_mask >> sensor & 1
            ]
        return messages

    def skip(self, times: int) -> int:
        """Leave out the messages of some periods; return their number."""
        if self._imu_mask:
            self._sequence = (self._sequence + times) & 0xFF
            return times * sum(self._imu_mask >> sensor & 1 for sensor in _MEASURED_BY_IMU)
        return times * (bool(self._mask & _ACCELEROMETERS) + bool(self._mask & _GYROSCOPE))

    def _three(self, sensor: int, time_s: float) -> bytes:
        """Return x, y and z as little-endian int16, for a board that sways about its y axis."""
        tilt = _SWAY * math.sin(time_s)
        if sensor == _ACCELERATION:
            scale, x, y, z = 9.80665 * self._units.per_m_s2, math.sin(tilt), 0.0, math.cos(tilt)
        elif sensor == _ANGULAR_RATE:
            scale, x, y, z = self._units.per_deg_s, 0.0, math.degrees(_SWAY * math.cos(time_s)), 0.0
        else:
            along, down = _FIELD_XZ_UT
            x, z = along * math.cos(tilt) - down * math.sin(tilt), along * math.sin(tilt) + down * math.cos(tilt)
            scale, y = 16, 0.0
        return struct.pack("<3h", round(scale * x), round(scale * y), round(scale * z))


POLLING, OLD_DATA, DATA, INERTIAL, BOOTLOADER = 2, 3, 4, 5, 7
"""Message classes (icub-firmware-shared:can/canProtocolLib/iCubCanProto_classes.h)."""
EVERY_BOARD = 15
"""Destination of all boards (icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can.cpp)."""

_REPLY_NS = 200_000
_NO_ACKS_TO_RECALIBRATE = 5
_INERTIAL = "inertial"  # the timer of the inertial sensors


class EmulatedBoard(Device):
    """One board.

    Defaults: icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp, ``setdefault`` and
    ``TriangleCfg``. It is silent until a command starts it.

    Args:
        address: on the bus, the ``number`` of the device, which commands can change.
        phase: 0-1, when in its period a started board sends its first burst.
        skin: of all boards, with the presses on it.

    Attributes:
        command_bytes: bytes of each command; shorter ones are ignored here, real boards read old bytes of their buffer.
    """

    is_mtb3: ClassVar[bool]
    board_type: ClassVar[int]
    firmware: ClassVar[tuple[int, int, int]]
    protocol: ClassVar[tuple[int, int]]
    units: ClassVar[Units]
    command_bytes: ClassVar[Mapping[int, int]]

    def __init__(
        self,
        address: int,
        stage: Stage[EmulatedRoboskinOptions],
        queue: deque[Transmission],
        now_ns: int,
        *,
        phase: float,
        skin: PressedSkin,
        source: WireSource | None,
    ) -> None:
        options = stage.options
        super().__init__(address, queue, now_ns, options.seed)
        self.stage = stage
        self.touch = Touch(options.seed, options.boards.index(address), skin)
        self._source = source
        self.faults = TriangleFaults(options, address)
        self._phase = phase
        self._identifiers_for: tuple[object, list[int]] = None, []

    def begin(self, now_ns: int) -> None:  # noqa: ARG002
        """Get power, with the settings of the firmware."""
        self.inertial: InertialSensors = InertialSensors(self.units)
        self._data_class = DATA
        self._no_acks = 0
        self._recalibration_due = False
        self._converters = Converters(
            self.touch, self.faults, mtb3=self.is_mtb3, short_tail=self.stage.options.short_tail
        )
        self._active = np.ones(TRIANGLES, np.bool_)
        self._period_ns = 50_000_000

    def clear(self) -> None:
        super().clear()
        self.touch.stream_from(None)

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> bool:
        """Take a frame from the bus; return whether the board obeyed or answered it. Nothing is ever acknowledged."""
        message_class, host, destination = identifier >> 8, identifier >> 4 & 0xF, identifier & 0xF
        is_for_all = destination == EVERY_BOARD and (message_class == BOOTLOADER or not self.is_mtb3)
        if destination != self.number and not is_for_all:
            return False
        if message_class == BOOTLOADER:
            return self._obey_bootloader(host, payload, now_ns)
        command = payload[0] & (0xFF if self.is_mtb3 else 0x7F)
        if message_class != POLLING or len(payload) < self.command_bytes.get(command, 9):
            return False
        if command == 0x1C:
            self._send_version(host, payload, now_ns)
        elif command == 0x32:
            return self._set_address(payload[1])
        elif command == 0x4F:
            self._send_inertial(self.inertial.set_up(payload[1]), payload[2], now_ns)
        else:
            return self._obey(command, payload, now_ns)
        return True

    @abstractmethod
    def _obey_bootloader(self, host: int, payload: bytes, now_ns: int) -> bool:
        """Obey a command in the class of the bootloader."""

    @abstractmethod
    def _obey(self, command: int, payload: bytes, now_ns: int) -> bool:
        """Obey a command of polling that only this kind of board has, or obeys in its own way."""

    def set_triangle(self, triangle: int, fault: TriangleState, now_ns: int) -> None:
        """Break or mend a triangle, from the next burst on."""
        self.faults.set_triangle(triangle, fault)
        self._log_triangle(now_ns, triangle, fault)

    def on_timer(self, name: str, time_ns: int) -> None:
        if name == _INERTIAL:
            for low, payload in self.inertial.messages(time_ns):
                self._send(time_ns, INERTIAL, low, payload)
        elif self._active.any():
            self._burst(time_ns)

    def frames_of(self, name: str, times: int) -> int:
        """Skip ``times`` turns of a timer; return the number of their frames."""
        return times * 2 * int(self._active.sum()) if name == BURSTS else self.inertial.skip(times)

    def _burst(self, time_ns: int) -> None:
        for triangle, fault in self.faults.take_due(self.cycle):
            self._log_triangle(time_ns, triangle, fault)
        if self._recalibration_due:
            self._recalibration_due = False
            if not self._recalibrate_by_itself(time_ns):
                return
        source = self._source
        if source is None:
            acquired = self._converters.acquire(time_ns, self.cycle, self._period_ns)
        else:
            active = np.flatnonzero(self._active).tolist()
            values = {triangle: source(self.number, triangle, self.cycle, time_ns) for triangle in active}
            acquired = self._converters.acquire_values(time_ns, self.cycle, values)
        no_acks = self._no_acks + int((acquired.no_ack & self._active).sum())
        self._recalibration_due = no_acks >= _NO_ACKS_TO_RECALIBRATE
        self._no_acks = no_acks % _NO_ACKS_TO_RECALIBRATE
        identifiers, payloads = self._identifiers(), acquired.payloads
        if len(identifiers) < len(payloads):
            payloads = [payloads[2 * (identifier & 0xF) + at % 2] for at, identifier in enumerate(identifiers)]
        self.stage.send_burst(self, identifiers, payloads, time_ns, usual=not self.stage.options.short_tail)

    @abstractmethod
    def _recalibrate_by_itself(self, time_ns: int) -> bool:
        """Take new baselines because converters did not acknowledge; return whether this burst is sent at all."""

    def _calibrate(self, time_ns: int, reason: Literal["power_up", "command", "no_ack"]) -> None:
        """Take the readings at ``time_ns`` as the new baseline of all triangles."""
        self._converters.calibrate(time_ns, self.cycle)
        self.stage.counts["recalibrations"] += 1
        self.stage.log.append(Event("recalibrated", time_ns, board=self.number, cycle=self.cycle, reason=reason))

    def _identifiers(self) -> list[int]:
        """Return the identifiers of the frames of all active triangles: HEAD, TAIL, HEAD ..."""
        first = self._data_class << 8 | self.number << 4
        key = (first, self._active.tobytes())
        if self._identifiers_for[0] != key:
            active = np.flatnonzero(self._active).tolist()
            self._identifiers_for = key, [first | triangle for triangle in active for _ in ("head", "tail")]
        return self._identifiers_for[1]

    # Both kinds of boards obey these commands alike

    def _set_board(self, payload: bytes) -> None:
        """Obey SKIN_BRD_CFG (0x4D): type, period, no load; all triangles are disabled."""
        self._converters.set_board(payload[1] & 0x0F, payload[3])
        self._period_ns = payload[2] * 1_000_000
        self._active[:] = False

    def _set_triangles(self, payload: bytes) -> bool:
        """Obey SET_TRIANG_CFG (0x50): range, shift, enable, offset. Return False for one that is ignored."""
        first, last, shift, enable = payload[1:5]
        if first > last or last >= TRIANGLES:
            return False
        self._active[first : last + 1] = bool(enable & 1)
        self._converters.set_triangles(first, last, shift=shift, cdc_offset=payload[5] | payload[6] << 8)
        return True

    def _set_address(self, address: int) -> bool:
        """Obey SET_BOARD_ADX (0x32). Only the addresses 1-14 are taken; a random one (0xFF) is not emulated.

        Source: icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theCANparserBasic.cpp
        """
        if not 0 < address < EVERY_BOARD:
            return False
        self.number = address
        return True

    def _send_inertial(self, wanted: bool, period_ms: int, now_ns: int) -> None:
        period_ns = period_ms * 1_000_000
        if wanted and period_ns:
            self.every(_INERTIAL, period_ns, now_ns + period_ns)
        else:
            self.stop(_INERTIAL)

    def _begin_bursts(self, now_ns: int, not_before_ns: int = 0) -> None:
        """Stream from here on. A period of 0 means never."""
        first_ns = max(now_ns + max(1, round(self._phase * self._period_ns)), not_before_ns)
        if self._period_ns:
            self.every(BURSTS, self._period_ns, first_ns)
        else:
            self.stop(BURSTS)
        if not self.touch.streams:
            self.touch.stream_from(first_ns if self._period_ns else None)

    def _send_version(self, host: int, payload: bytes, now_ns: int) -> None:
        """Answer GET_FW_VERSION (0x1C): compatible means the same major protocol and no older minor one.

        Source: icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can.cpp, ``Message_GET_VERSION``
        """
        major, minor = self.protocol
        compatible = major == payload[1] and minor >= payload[2]
        version = bytes([0x1C, self.board_type, *self.firmware, major, minor, compatible])
        self._send(now_ns + _REPLY_NS, POLLING, host, version)

    def _send_discovery(self, host: int, now_ns: int) -> None:
        """Answer BROADCAST (0xFF) as a running application: with five bytes; a bootloader would send four.

        Source: icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can_bootloader.cpp
        """
        self._send(now_ns + _REPLY_NS, BOOTLOADER, host, bytes([0xFF, self.board_type, *self.firmware]))

    def _send(self, ready_ns: int, message_class: int, low: int, payload: bytes) -> None:
        identifier = message_class << 8 | self.number << 4 | low
        self.queue.append(Transmission(ready_ns, [identifier], [payload]))

    def _log_triangle(self, time_ns: int, triangle: int, fault: TriangleState) -> None:
        event = Event("triangle_fault", time_ns, board=self.number, triangle=triangle, cycle=self.cycle, fault=fault)
        self.stage.log.append(event)
