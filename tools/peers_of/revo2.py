"""BrainCo's own program (bc_stark_sdk) at emulated Revo2 hands."""

from __future__ import annotations

import asyncio
import sys
from importlib import import_module
from typing import Any

from brainco import Comparison, at_a_port

from skinware_drivers.virtual.devices.registers import EmulatedRevo2

_UNIT = 127
_FORCES = [1000, 20, 300, 1, 2, 3, 2500, 7, 359, 4, 5, 6, 7, 8, 9]
_PROXIMITIES = [1, 65535, 65536, 0x0102_0304, 0]


async def _connected(sdk: Any, port: str, hardware: str) -> Any:
    program = await sdk.modbus_open(port, sdk.Baudrate.Baud460800)
    if hardware:
        program.set_hardware_type(_UNIT, getattr(sdk.StarkHardwareType, hardware))
    return program


async def _touch(sdk: Any, port: str, compare: Comparison) -> None:
    program = await _connected(sdk, port, "")
    device = await program.get_device_info(_UNIT)
    compare.agree("serial number", "BCXTR0000000001", device.serial_number)
    compare.agree("firmware", "1.0.14.U", device.firmware_version)
    compare.agree("edition by the serial number", sdk.StarkHardwareType.Revo2Touch, device.hardware_type)
    compare.agree("switches", 0b11111, await program.get_touch_sensor_enabled(_UNIT))
    for write in (program.touch_sensor_setup, program.touch_sensor_calibrate, program.touch_sensor_reset):
        await write(_UNIT, 0b11111)
    fingers = await program.get_touch_sensor_status(_UNIT)
    forces = [(one.normal_force1, one.tangential_force1, one.tangential_direction1) for one in fingers]
    compare.agree("forces", _FORCES, [value for finger in forces for value in finger])
    compare.agree("proximities", _PROXIMITIES, [one.self_proximity1 for one in fingers])
    compare.agree("status", [0, 1, 0, 0, 2], [one.status for one in fingers])


async def _pressure(sdk: Any, port: str, compare: Comparison) -> None:
    program = await _connected(sdk, port, "Revo2TouchPressure")
    compare.agree("points", list(range(1, 92)), await program.get_modulus_touch_data(_UNIT))
    compare.agree("sums", list(range(92, 98)), await program.get_modulus_touch_summary(_UNIT))
    kind = await program.get_modulus_touch_data_type(_UNIT)
    compare.agree("kind of values", sdk.ModulusTouchDataType.Force, kind)
    compare.agree("switches", 0b111111, await program.get_touch_sensor_enabled(_UNIT))
    await program.touch_sensor_calibrate(_UNIT, 0b111111)


async def _force3d(sdk: Any, port: str, compare: Comparison) -> None:
    program = await _connected(sdk, port, "Revo2TouchForce3D")
    for finger in range(4):
        points = await program.get_force3d_finger_array(_UNIT, finger)
        values = [value for point in points for value in (point.fx, point.fy, point.fz)]
        compare.agree(f"points of finger {finger}", _FORCE3D[93 * finger : 93 * finger + 93], values)
    await program.touch_sensor_calibrate(_UNIT, 0b1111)


async def _array_pressure(sdk: Any, port: str, compare: Comparison) -> None:
    program = await _connected(sdk, port, "Revo2TouchArrayPressure")
    told = await program.get_array_pressure_touch_data(_UNIT)
    compare.agree("forces and moments", list(range(1, 26)), list(told.data))
    compare.agree("warm", True, told.status.warmup_complete)
    await program.touch_sensor_calibrate(_UNIT, 0b11111)


_FORCE3D = [(-1 if place % 3 == 0 else 1) * (place % 127) if place % 3 < 2 else place for place in range(4 * 93 + 12)]
_EXCHANGES = (
    (_touch, [*_FORCES, *_PROXIMITIES], {"abnormal": (1,), "missing": (4,)}),
    (_pressure, list(range(1, 98)), {"edition": "pressure", "kind": 2}),
    (_force3d, _FORCE3D, {"edition": "force3d"}),
    (_array_pressure, list(range(1, 26)), {"edition": "array_pressure"}),
)


def main() -> int:
    """Compare, and give the exit status: 1 if anything differs."""
    sdk = import_module("bc_stark_sdk.main_mod")
    sdk.init_logging(sdk.LogLevel.Error, False)
    compare = Comparison("bc_stark_sdk")
    for exchange, values, options in _EXCHANGES:
        with at_a_port(EmulatedRevo2, values, **options) as port:
            asyncio.run(exchange(sdk, port, compare))
    return int(compare.differs)


if __name__ == "__main__":
    sys.exit(main())
