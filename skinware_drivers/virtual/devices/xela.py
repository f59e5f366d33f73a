"""Emulated uSkin boards of XELA, and XELA's server."""

from __future__ import annotations

import json
import struct
from collections.abc import Collection, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import (
    CanFrame,
    Device,
    Emulator,
    EmulatorOptions,
    Places,
    SerialEmulator,
    SerialEmulatorOptions,
    on_a_grid,
)


class EmulatedXelaOptions(EmulatorOptions, frozen=True):
    boards: Annotated[tuple[int, ...], Meta(description="numbers of the boards")] = (1,)
    model: Annotated[
        Literal["4x4", "4x6"],
        Meta(description="4x4: identifiers from 0x710 on; 4x6: hexadecimal 1, row, column"),
    ] = "4x4"
    period_ms: Annotated[int, Meta(ge=1, description="time between two messages of a taxel, ms")] = 10


class EmulatedXela(Emulator[EmulatedXelaOptions]):
    """Boards on one bus.

    Values: x, y, z of taxel 0, of taxel 1 ... Several boards have identifiers 0x20 apart (4x4) or 0x100 apart (4x6).
    """

    full_scale = 0xFFFF
    rest = 33_000
    swing = 9_000
    numbered_by = "boards"

    def __init__(self, options: EmulatedXelaOptions, **more: Any) -> None:
        super().__init__(options, **more)
        taxels = {taxel for board in options.boards for taxel in self._taxels(board)}
        self.identifiers: Collection[int] = taxels.union(range(0x200, 0x210))  # commands

    def places(self) -> Places:
        return on_a_grid(16 if self.options.model == "4x4" else 24, 4, each=3)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        if identifier != 0x200 + device.number or payload not in (b"\x07\x00", b"\x07\x01"):
            return False
        if payload[1]:
            self.stop(device)
        else:
            self.start(device, now_ns)
        return True

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        xyz = zip(values[0::3], values[1::3], values[2::3], strict=True)
        return [(i, struct.pack(">x3Hx", *axes)) for i, axes in zip(self._taxels(device.number), xyz, strict=True)]

    def _taxels(self, board: int) -> list[int]:
        nth = self.numbers.index(board)
        if self.options.model == "4x4":
            return list(range(0x710 + 0x20 * nth, 0x720 + 0x20 * nth))
        return [int(f"{1 + nth}{row}{column}", 16) for column in "012345" for row in "0123"]


_TAXELS = {"uSPa44": (16, 4), "uSPa46": (24, 6), "uSPa22": (4, 2), "uSCuAH": (30, 6)}


class EmulatedXelaServerOptions(SerialEmulatorOptions, frozen=True):
    sensors: Annotated[tuple[int, ...], Meta(description="numbers of the sensors")] = (1,)
    model: Annotated[Literal["uSPa44", "uSPa46", "uSPa22", "uSCuAH"], Meta(description="of all sensors")] = "uSPa44"
    calibrated: Annotated[bool, Meta(description="send forces, besides the counts")] = True


class EmulatedXelaServer(SerialEmulator[EmulatedXelaServerOptions]):
    """One server.

    Values: x, y and z of each taxel in 1/256 N, or as counts.
    """

    full_scale = 0x4000
    rest = 0
    swing = 2000
    speed_mbit_s = 100
    numbered_by = "sensors"

    def places(self) -> Places:
        count, columns = _TAXELS[self.options.model]
        return np.repeat(on_a_grid(count, columns), 3, axis=0)

    def boot(self, device: Device, now_ns: int) -> None:
        if device.number == self.numbers[0]:
            self.say(device, json.dumps({"message": "Welcome"}).encode() + b"\n", now_ns)
        self.start(device, now_ns)

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Return ``sensor1`` and so on, or ``welcome``."""
        sent = json.loads(payload)
        return next((f"sensor{number}" for number in self.numbers if str(number) in sent), "welcome")

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
        routine = {"message": device.cycle, "time": time_s, "sensors": 1, "type": "routine", str(device.number): sensor}
        return [json.dumps(routine).encode() + b"\n"]
