"""The sensors that the makers' library of the AGNI protocol knows by name, and how it reads their payloads.

Source: ``libio/registered_sensors_impl.h`` of ubi-agni/agni_serial_protocol 18b224d (2024-06-25). It converts no units.

* Words of Myrmex and iObject+ have the channel of their converter in the upper 4 bits and the value in the lower 12.
  Myrmex: 16 x 16 taxels, row by row; the taxel at row r and column c is channel 4 (r // 4) + c // 4 of the converter
  that ``_CONVERTERS`` has at (r % 4, c % 4). iObject+: a message has one channel of 60 converters, of the first 30 and
  the other 30 in turn; taxel = 16 * converter + channel.
* The glove sends three bytes for each taxel, or bend: its number, and a word with 12 bits, which fall under pressure.
* Inertial sensors: quaternions have w first. A5 in all bytes is no measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.sensor_types import ACCELERATION, ANGULAR_RATE, MAGNETIC_FIELD, PRESSURE, SensorType
from skinware.status import Status
from skinware_drivers.fields import Byte, Condition, DeviceTime, Identifier, Sentinel
from skinware_drivers.layout import Expand, Frame, Values

TIME = 4
"""Bytes of the time in front of the values."""
_VENDOR = 0xA6111 << 12
_CONVERTERS = np.array(((13, 14, 2, 0), (12, 3, 1, 4), (11, 9, 7, 5), (10, 15, 8, 6)))
_ROW, _COLUMN = np.divmod(np.arange(256), 16)
_MYRMEX_WORDS = 16 * _CONVERTERS[_ROW % 4, _COLUMN % 4] + 4 * (_ROW // 4) + _COLUMN // 4
_CHANNELS, _CONVERTERS_OF_A_BLOCK = 16, 30

Bytes = npt.NDArray[np.uint8]
Found = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[Any]]
Name = Literal[
    "undefined",
    "MID_tactile_fingertip_teensy",
    "BMP388modified_pressure_array",
    "BMP388_testboard_4sensors",
    "tactile_module_16x16_v2",
    "iobject_myrmex",
    "tactile_glove_teensy",
    "tactile_glove_teensy_bend",
    "Generic_position_sensors_float",
    "MPU9250",
    "MPU9250_accelerometer",
    "BNO055",
    "BNO08X",
    "BMA255",
    "mpl115a2",
    "AS5013",
    "AS5013_y_position",
]


def _own(first: int, *names: str) -> tuple[SensorType, ...]:
    return tuple(SensorType(name, _VENDOR | first + n, "counts") for n, name in enumerate(names))


def _raw(types: Sequence[SensorType]) -> tuple[SensorType, ...]:
    return tuple(kind.measured(unit="counts") for kind in types)


TAXEL = _raw([PRESSURE])
_ACCELERATION, _RATE, _FIELD = _raw(ACCELERATION), _raw(ANGULAR_RATE), _raw(MAGNETIC_FIELD)
_ORIENTATION = _own(1, "orientation_w", "orientation_x", "orientation_y", "orientation_z")
_POSITION, _AIR, _STICK = _own(5, "joint_position"), _own(6, "air_pressure"), _own(7, "stick_x", "stick_y")


def _words(payload: Bytes, first: int, count: int) -> npt.NDArray[np.int64]:
    low, high = (payload[:, first + at : first + 2 * count : 2].astype(np.int64) for at in (0, 1))
    return low | high << 8


def _found(channels: npt.NDArray[np.int64], values: npt.NDArray[np.int64]) -> Found:
    rows = np.arange(len(values)).repeat(values.shape[1])
    return rows, np.broadcast_to(channels, values.shape).ravel(), values.ravel()


def _read_myrmex(payload: Bytes, _: Bytes) -> Found:
    return _found(np.arange(256), _words(payload, TIME, 256)[:, _MYRMEX_WORDS] & 0x0FFF)


def _read_glove(payload: Bytes, _: Bytes, length: int) -> Found:
    each = payload[:, TIME : TIME + length].reshape(len(payload), -1, 3).astype(np.int64)
    return _found(each[..., 0], 4095 - (each[..., 1] | (each[..., 2] & 0x0F) << 8))


def _taxels_of(channel: int) -> npt.NDArray[np.int64]:
    """Return the taxels in the order of the words of iObject+."""
    first, second = (_CHANNELS * np.arange(_CONVERTERS_OF_A_BLOCK) + channel + 480 * block for block in (0, 1))
    return np.stack([first, second], 1).ravel()


def _read_iobject(payload: Bytes, _: Bytes, channel: int) -> Found:
    words = _words(payload, TIME, 2 * _CONVERTERS_OF_A_BLOCK)
    if (words >> 12 != channel).any():
        raise ValueError("a message with several channels")
    return _found(_taxels_of(channel), words & 0x0FFF)


Part = tuple[int | None, Values | Expand]
"""The channel that a message has, if each has one of several; and how it is read."""


def _iobject_parts(_: int) -> list[Part]:
    channels = range(_CHANNELS)
    return [(one, Expand(partial(_read_iobject, channel=one), _taxels_of(one).tolist())) for one in channels]


def _glove_parts(length: int) -> list[Part]:
    return [(None, Expand(partial(_read_glove, length=length)))]


class AgniDevice(NamedTuple):
    """A sensor of the library.

    Attributes:
        dtype: of a value, as numpy reads it; of Myrmex, iObject+ and the glove, as the driver shows it.
        types: of the values of an item.
        size: bytes of an item.
        is_single: there is one item, and what follows is left out; else there are as many as fit.
        each: channels that an item becomes, if not one for each type.
        none: the value that is no measurement; None: all are.
        parts: returns how payloads of so many bytes are read; None: their values follow each other.
    """

    dtype: str
    types: Sequence[SensorType] = TAXEL
    size: int = 2
    is_single: bool = False
    each: int = 0
    none: int | None = None
    parts: Callable[[int], Sequence[Part]] | None = None

    def count(self, length: int) -> int:
        """Return the number of values of a payload; 0: it is no payload of this sensor."""
        items = int(length >= self.size) if self.is_single else 0 if length % self.size else length // self.size
        return items * (self.each or len(self.types))

    def frames(self, number: int, length: int, time: DeviceTime | None, period_s: float) -> list[Frame]:
        """Return the frames of sensor ``number`` (from 1), which sends ``length`` bytes every ``period_s``."""
        parts = self.parts(length) if self.parts else [(None, Values(TIME, self.dtype, self.count(length)))]
        flags = [] if self.none is None else [Sentinel(Status.SUSPECT, self.none)]
        found = []
        for channel, values in parts:
            when: list[Condition] = [Identifier(number)]
            if channel is not None:
                when.append(Byte(TIME + 1, channel << 4, 0xF0))
            found.append(
                Frame(
                    f"sensor {number}" if channel is None else f"sensor {number} channel {channel}",
                    when,
                    [TIME + length],
                    values,
                    module=number,
                    flags=flags,
                    time=time,
                    period_s=None if channel is None else len(parts) * period_s,
                )
            )
        return found


_INERTIAL = AgniDevice("<f4", (*_ACCELERATION, *_RATE, *_FIELD, *_ORIENTATION), 52, is_single=True)
_GLOVE = AgniDevice("<u2", TAXEL, 3, parts=_glove_parts)
DEVICES: dict[Name, AgniDevice] = {
    "MID_tactile_fingertip_teensy": AgniDevice("<u2"),
    "BMP388modified_pressure_array": AgniDevice("<i2"),
    "BMP388_testboard_4sensors": AgniDevice("<i2"),
    "tactile_module_16x16_v2": AgniDevice(
        "<u2", TAXEL, 512, is_single=True, each=256, parts=lambda _: [(None, Expand(_read_myrmex))]
    ),
    "iobject_myrmex": AgniDevice("<u2", TAXEL, 120, is_single=True, each=960, parts=_iobject_parts),
    "tactile_glove_teensy": _GLOVE,
    "tactile_glove_teensy_bend": _GLOVE._replace(types=_POSITION),
    "Generic_position_sensors_float": AgniDevice("<f4", _POSITION, 4),
    "MPU9250": _INERTIAL,
    "MPU9250_accelerometer": AgniDevice("<f4", _ACCELERATION, 12, is_single=True),
    "BNO055": AgniDevice("<i2", (*_ORIENTATION, *_ACCELERATION, *_FIELD, *_RATE), 26, is_single=True, none=-0x5A5B),
    "BNO08X": AgniDevice("<f4", (*_ACCELERATION, *_RATE, *_ORIENTATION), 40, is_single=True),
    "BMA255": AgniDevice("<i2", _ACCELERATION, 6, is_single=True),
    "mpl115a2": AgniDevice("<f4", _AIR, 4, is_single=True),
    "AS5013": AgniDevice("<i1", _STICK, 2, is_single=True),
    "AS5013_y_position": AgniDevice("<i1", _STICK[1:], 1, is_single=True),
}
"""By the names of the library; for ``undefined``, options say what it sends."""
