"""The inertial sensors of an emulated board: the robot that it is on sways a little.

Messages: icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can_inertial_periodic.cpp (data),
embot_prot_can_analog_polling.cpp (commands) and embot_prot_can.h (numbers of an IMU's sensors) in the same folder.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

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


class InertialMessage(NamedTuple):
    """What a board sends of its own in class 5."""

    low: int
    payload: bytes


class InertialSensors:
    """What a board is to send of its inertial sensors, and when; nothing at power-up.

    Attributes:
        next_ns: when the next messages are due; None while there are none.
    """

    def __init__(self, units: Units) -> None:
        self._units = units
        self._mask = self._imu_mask = self._sequence = self._period_ns = 0
        self.next_ns: int | None = None

    def set_up(self, mask: int, period_ms: int, now_ns: int) -> None:
        """ACC_GYRO_SETUP (0x4F): which sensors, and their period."""
        self._mask, self._imu_mask = mask & 0xF, 0
        self._begin(bool(self._mask), period_ms, now_ns)

    def configure_imu(self, mask: int) -> None:
        """IMU_CONFIG_SET (0x33): which sensors of an IMU."""
        self._mask, self._imu_mask = 0, mask

    def transmit_imu(self, period_ms: int, now_ns: int) -> None:
        """IMU_TRANSMIT (0x35): from now on, or (0) no more."""
        self._sequence = 0
        self._begin(bool(self._imu_mask), period_ms, now_ns)

    def stop(self) -> None:
        """Send nothing until told again."""
        self.next_ns = None

    def take(self) -> list[InertialMessage]:
        if self.next_ns is None:
            return []
        time_s = self.next_ns * 1e-9
        self.next_ns += self._period_ns
        messages = []
        if self._mask & _ACCELEROMETERS:
            messages.append(InertialMessage(ACCELEROMETER_MESSAGE, self._three(_ACCELERATION, time_s)))
        if self._mask & _GYROSCOPE:
            messages.append(InertialMessage(GYROSCOPE_MESSAGE, self._three(_ANGULAR_RATE, time_s)))
        if self._imu_mask:
            self._sequence = (self._sequence + 1) & 0xFF
            messages += [
                InertialMessage(IMU_MESSAGE, bytes((self._sequence, sensor)) + self._three(sensor, time_s))
                for sensor in _MEASURED_BY_IMU
                if self._imu_mask >> sensor & 1
            ]
        return messages

    def skip_to(self, now_ns: int) -> int:
        """Leave out what is due before ``now_ns``; returns how many messages that is."""
        if self.next_ns is None or self.next_ns >= now_ns:
            return 0
        times = -((self.next_ns - now_ns) // self._period_ns)
        self.next_ns += times * self._period_ns
        if self._imu_mask:
            self._sequence = (self._sequence + times) & 0xFF
            return times * sum(self._imu_mask >> sensor & 1 for sensor in _MEASURED_BY_IMU)
        return times * (bool(self._mask & _ACCELEROMETERS) + bool(self._mask & _GYROSCOPE))

    def _begin(self, wanted: bool, period_ms: int, now_ns: int) -> None:
        self._period_ns = period_ms * 1_000_000
        self.next_ns = now_ns + self._period_ns if wanted and period_ms else None

    def _three(self, sensor: int, time_s: float) -> bytes:
        """x, y and z as little-endian int16, for a board that sways about its y axis."""
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
