"""An emulated board DEV001 of Contactile with its sensors.

Source: contactile/dev001, ``src/main.cpp``; the vectors in tests/serial/test_dev001.py.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_a_grid

_FIELDS = {"temp": 0x20, "fz": 0x200, "fy": 0x400, "fx": 0x800}
_ALL, _FORCES = 0xE20, 0xE00
_DEFAULT_HZ = 1000


class EmulatedDev001Options(SerialEmulatorOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    ports: Annotated[tuple[int, ...], Meta(description="ports with a sensor: 0 to 4")] = (0, 1, 2, 3, 4)
    biased: Annotated[bool, Meta(description="sensors were zeroed; no: they send no number until `bias`")] = True
    period_ms: Annotated[float, Meta(ge=1, description="time between two records until the host changes it, ms")] = 1


class EmulatedDev001(SerialEmulator[EmulatedDev001Options]):
    """One board, device 1. Values, of each port: temperature in 1/1000 and force z, y and x in mN."""

    full_scale = (60_000, 15_000, 5_000, 5_000) * 5
    lowest = (0, -5_000, -5_000, -5_000) * 5
    rest = (27_000, 0, 0, 0) * 5
    swing = (0, 6_000, 400, -300) * 5
    speed_mbit_s = 12

    def places(self) -> Places:
        return on_a_grid(5, 5, each=4)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        *lines, rest = heard.replace(b"\r", b"").split(b"\n")
        return lines, rest

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        name, *arguments = command.decode("latin-1").lower().split() or [""]
        if name in ("bias", "b"):
            return self._bias(device)
        if name == "z":
            return self._bias(device) + self._stream(
                device, ["start", "-d", "force", "-f", "1000", "-p", "binary"], now_ns
            )
        if name in ("stream", "s"):
            return self._stream(device, arguments, now_ns)
        if name in ("info", "i"):
            ports = "".join(f"Port {n}: {'' if n in self.options.ports else '[Not connected]'}\r\n" for n in range(5))
            return f"\r\n-- Contactile C3DFBS Development Board --\r\nSensorHub FW 1.0.0\r\n{ports}".encode()
        return None

    def kinds(self) -> Sequence[str]:
        return [f"port{port}" for port in self.options.ports]

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        return "records" if len(payload) > 3 and payload[0] < 5 and payload[1:4] == bytes(3) else "answer"

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        contents = device.memory.get("contents", _ALL)
        uptime_ms = (device.sampled_ns - device.ready_ns) // 1_000_000
        sent = b""
        for port in self.options.ports:
            if f"port{port}" in self.silent:
                self.counts["silenced"] += 1
                continue
            temperature, *forces = (value / 1e3 for value in values[4 * port : 4 * port + 4])
            if not device.memory.get("biased", self.options.biased):
                forces = [math.nan] * 3
            sent += struct.pack("<III", port, uptime_ms & 0xFFFF_FFFF, contents)
            for bit, value in zip(_FIELDS.values(), (temperature, *forces), strict=True):
                sent += struct.pack("<f", value) if contents & bit else b""
        return [sent] if sent and device.memory.get("binary") else []

    def _bias(self, device: Device) -> bytes:
        device.memory["biased"] = True
        lines = (f" Port {n}... OK!" if n in self.options.ports else f" Port {n}... No response" for n in range(5))
        return "\r\n".join(["Biasing...", *lines, ""]).encode()

    def _stream(self, device: Device, arguments: Sequence[str], now_ns: int) -> bytes:
        given = dict(pairwise(arguments))
        if "-d" in given:
            named = sum(bit for name, bit in _FIELDS.items() if name in given["-d"])
            device.memory["contents"] = {"all": _ALL, "force": _FORCES}.get(given["-d"], named)
        if "-p" in given:
            device.memory["binary"] = given["-p"] == "binary"
        self.stop(device)
        if "start" in arguments:
            self.start(device, now_ns, 1 / int(given.get("-f", _DEFAULT_HZ)))
        words = "Starting data stream" if "start" in arguments else "Data stream stopped"
        return "".join(f"Port {port}:\r\n {words}\r\n" for port in self.options.ports).encode()
