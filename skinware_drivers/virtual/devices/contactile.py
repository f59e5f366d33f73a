"""Emulated devices of Contactile: a board DEV001 with its sensors, and a PapillArray Controller.

Source: contactile/dev001, ``src/main.cpp``, with the vectors in tests/serial/test_dev001.py; PTSCOM_2.0_SPEC_SEP22 and
programs that read hardware, as the driver's. The maker's library reads the PapillArray Controller.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_a_grid

_FIELDS = {"temp": 0x20, "fz": 0x200, "fy": 0x400, "fx": 0x800}
_ALL, _FORCES = 0xE20, 0xE00
_DEFAULT_HZ = 1000


class EmulatedDev001Options(SerialEmulatorOptions, frozen=True):
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


_KINDS = {"pillars": 3, "total": 4, "pillar_slip": 5, "slip": 6}
_AXES, _WHOLE = 6, 6
_CONTACT_MN, _WIDTH_MM = 500, 21
_NOT_IN_CONTACT, _IN_CONTACT = -2, 1

_RANGES = {
    "full_scale": ((4000, 4000, 15_000, 1000, 1000, 2500), 60_000, 3, (2, 2000, 60_000)),
    "lowest": ((-4000, -4000, -1000, -1000, -1000, -500), -60_000, -2, (0, -1000, -1000)),
    "rest": ((0,) * _AXES, 0, 0, (0, -1000, -1000)),
    "swing": ((300, -200, 4000, 75, -50, 660), 0, 0, (0, 0, 0)),
}
"""Values of a pillar, of the whole, a slip state, and those of slip; a pillar's friction is as that of slip."""


def _each(name: str, sensors: int = 2, pillars: int = 9) -> tuple[int, ...]:
    pillar, whole, state, slip = _RANGES[name]
    return (*pillar * pillars, *(whole,) * _WHOLE, *(state,) * pillars, *(slip[1],) * pillars, *slip) * sensors


class EmulatedPapillArrayOptions(SerialEmulatorOptions, frozen=True):
    sensors: Annotated[int, Meta(ge=1, le=2, description="sensors that are plugged in")] = 2
    pillars: Annotated[int, Meta(ge=1, le=9, description="pillars of each")] = 9
    period_ms: Annotated[float, Meta(ge=1, description="time between two packets until the host changes it, ms")] = 1


class EmulatedPapillArray(SerialEmulator[EmulatedPapillArrayOptions]):
    """One Controller, device 1.

    Values, of each sensor: force (mN) and displacement (um) of each pillar; total force (mN) and torque (N um); slip
    states, then 1000 times the friction of the pillars; state of the detection, 1000 times friction, grip force (mN).
    """

    full_scale: Sequence[int] = _each("full_scale")
    lowest: Sequence[int] = _each("lowest")
    rest: Sequence[int] = _each("rest")
    swing: Sequence[int] = _each("swing")
    speed_mbit_s: ClassVar[int] = 12
    streams = "always"

    def __init__(self, options: EmulatedPapillArrayOptions, **more: Any) -> None:
        n = options.pillars
        self._n = _AXES * n + _WHOLE + 2 * n + 3
        self._edges = np.cumsum([_AXES * n, _WHOLE, n, n]).tolist()
        self._arms_mm = (on_a_grid(n, 3)[:, :2].T - 0.5) * _WIDTH_MM
        for name in _RANGES:
            setattr(self, name, _each(name, options.sensors, n))
        super().__init__(options, **more)

    def places(self) -> Places:
        n = self.options.pillars
        pillars, whole = on_a_grid(n, 3), np.array([[0.5, 0.5, 0.0]])
        of_sensor = [
            np.repeat(pillars, _AXES, axis=0),
            np.repeat(whole, _WHOLE, axis=0),
            pillars,
            pillars,
            *[whole] * 3,
        ]
        return np.concatenate(of_sensor * self.options.sensors)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        """Return the lines; the maker's library ends some with a zero, too."""
        *lines, rest = heard.replace(b"\0", b"").split(b"\n")
        return lines, rest

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        if command in (b"f100", b"f250", b"f500", b"f1000"):
            self.change_period(device, now_ns, 1 / int(command[1:]))
        elif command == b"z":
            device.memory["zero"] = None
        elif command in (b"S", b"s"):
            device.memory["slip"] = command == b"S"
        else:
            return None
        return b""

    def feel(self, device: Device, time_s: float) -> Sequence[int]:
        values = np.reshape(super().feel(device, time_s), (self.options.sensors, self._n))
        n = self.options.pillars
        pillars = values[:, : _AXES * n].reshape(-1, n, _AXES)
        force = pillars[..., :3]
        x, y, z = np.moveaxis(force, -1, 0)
        total, (right_mm, up_mm) = _AXES * n, self._arms_mm
        values[:, total : total + 3] = force.sum(axis=1)
        values[:, total + 3 : total + 6] = np.stack([z @ up_mm, -z @ right_mm, y @ right_mm - x @ up_mm], axis=1)
        if device.memory.get("slip"):
            in_contact = force[..., 2] > _CONTACT_MN
            values[:, total + 6 : total + 6 + n] = np.where(in_contact, _IN_CONTACT, _NOT_IN_CONTACT)
            values[:, total + 6 + 2 * n] = 1 + in_contact.any(axis=1)
        felt: list[int] = values.ravel().tolist()
        return felt

    def kinds(self) -> Sequence[str]:
        return list(_KINDS)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        sent = device.memory["sent"] = device.memory.get("sent", -1) + 1
        uptime_us = (device.sampled_ns - device.ready_ns) // 1000
        entries = self._entries(self._zeroed(device, np.array(values)).reshape(self.options.sensors, self._n))
        self.counts["silenced"] += len(self.silent & _KINDS.keys())
        kinds = [kind for name, kind in _KINDS.items() if name not in self.silent]
        begin = 1 + 4 * (1 + len(kinds)) + 3  # zeros follow the table
        table, data = struct.pack("<BHH", 2, 1, begin), struct.pack("<IQ", sent & 0xFFFF_FFFF, uptime_us)
        for kind in kinds:
            table += struct.pack("<HH", kind, begin + len(data))
            data += _block(begin + len(data), entries[kind])
        packet = table.ljust(begin, b"\0") + data
        return [b"\x55\x66\x77\x88" + packet + struct.pack("<H", sum(packet) & 0xFFFF) + b"\xaa\xbb\xcc\xdd"]

    def _zeroed(self, device: Device, values: Any) -> Any:
        if "zero" not in device.memory:
            return values
        if device.memory["zero"] is None:
            is_measured = np.arange(self._n) < _AXES * self.options.pillars + _WHOLE
            device.memory["zero"] = np.where(np.tile(is_measured, self.options.sensors), values, 0)
        return values - device.memory["zero"]

    def _entries(self, sensors: Any) -> dict[int, Any]:
        """Return what each block has of pillars or sensors: (sensors, pillars) or (sensors,)."""
        shape = (len(sensors), self.options.pillars)
        at = (0, *self._edges, self._n)
        pillars, total, states, frictions, slip = (sensors[:, i:j] for i, j in pairwise(at))
        entries = {
            3: np.zeros(shape, [("type", "<u2"), ("values", "<f4", _AXES)]),
            4: np.zeros(shape[0], [("type", "<u2"), ("values", "<f4", _WHOLE)]),
            5: np.zeros(shape, [("type", "<u2"), ("state", "i1"), ("values", "<f4")]),
            6: np.zeros(shape[0], [("type", "<u2"), ("state", "i1"), ("values", "<f4", 2)]),
        }
        for kind, number in ((3, 2), (4, 2), (5, 1), (6, 1)):
            entries[kind]["type"] = number
        entries[3]["values"] = pillars.reshape(*shape, _AXES) / 1e3
        entries[4]["values"] = total / 1e3
        entries[5]["state"], entries[5]["values"] = states, frictions / 1e3
        entries[6]["state"], entries[6]["values"] = slip[:, 0], slip[:, 1:] / 1e3
        return entries


def _block(begin: int, entries: Any) -> bytes:
    n, size = len(entries), entries[0].nbytes
    if entries.ndim == 1:
        return _positions(begin, n, size) + bytes(entries.tobytes())
    pillars = entries.shape[1]
    whole = 2 + 2 * pillars + size
    first = begin + 2 + 2 * n
    parts = (
        _positions(first + whole * sensor, pillars, entries.itemsize) + entries[sensor].tobytes() for sensor in range(n)
    )
    return _positions(begin, n, whole) + b"".join(parts)


def _positions(begin: int, count: int, size: int) -> bytes:
    """Return a number of parts of one size, and the positions of those that follow."""
    return struct.pack(f"<{1 + count}H", count, *(begin + 2 + 2 * count + size * part for part in range(count)))
