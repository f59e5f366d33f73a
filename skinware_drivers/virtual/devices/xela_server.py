"""An emulated server of XELA: its messages, a line each.

Source: XELA's program xela_server_ros2; the vectors in tests/streams/test_xela_server.py. A device is a sensor; each
sends messages of its own, while the real server puts all sensors into one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware_drivers.virtual.emulator import Device
from skinware_drivers.virtual.press import on_a_grid
from skinware_drivers.virtual.serial_device import SerialEmulator, SerialEmulatorOptions

_TAXELS = {"uSPa44": (16, 4), "uSPa46": (24, 6), "uSPa22": (4, 2), "uSCuAH": (30, 6)}


class EmulatedXelaServerOptions(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which sensors there are."""

    sensors: Annotated[tuple[int, ...], Meta(description="numbers of the sensors")] = (1,)
    model: Annotated[Literal["uSPa44", "uSPa46", "uSPa22", "uSCuAH"], Meta(description="of all sensors")] = "uSPa44"
    calibrated: Annotated[bool, Meta(description="tell forces, beside the counts")] = True


class EmulatedXelaServer(SerialEmulator[EmulatedXelaServerOptions]):
    """One server; see :class:`skinware_drivers.virtual.serial_device.SerialEmulator`.

    Values: x, y and z of each taxel in 1/256 N, or as counts.
    """

    full_scale = 0x4000
    rest = 0
    swing = 2000
    speed_mbit_s = 100

    def __init__(self, options: EmulatedXelaServerOptions, **more: object) -> None:
        self.numbers = options.sensors
        super().__init__(options, **more)

    def places(self) -> npt.NDArray[np.float64]:
        count, columns = _TAXELS[self.options.model]
        return np.repeat(on_a_grid(count, columns), 3, axis=0)

    def boot(self, device: Device, now_ns: int) -> None:
        if device.number == self.numbers[0]:
            self.say(device, json.dumps({"message": "Welcome"}).encode() + b"\n", now_ns)
        self.start(device, now_ns)

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """``sensor1`` and so on; the welcome is another."""
        told = json.loads(payload)
        return next((f"sensor{number}" for number in self.numbers if str(number) in told), "welcome")

    def kinds(self) -> Sequence[str]:
        return [f"sensor{number}" for number in self.numbers]

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        time_s = device.sampled_ns / 1e9
        sensor: dict[str, object] = {
            "sensor": str(device.number),
            "model": self.options.model,
            "taxels": len(values) // 3,
            "time": time_s,
            "data": ",".join(f"{value:X}" for value in values),
        }
        if self.options.calibrated:
            sensor["calibrated"] = [value / 256 for value in values]
        told = {"message": device.cycle, "time": time_s, "sensors": 1, "type": "routine", str(device.number): sensor}
        return [json.dumps(told).encode() + b"\n"]
