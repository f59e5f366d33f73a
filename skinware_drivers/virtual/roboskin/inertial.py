"""The inertial sensors of an emulated board on a robot that sways a little.

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


class InertialSensors:
    """The choice of a board's inertial sensors, none at power-up, and their messages."""

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
