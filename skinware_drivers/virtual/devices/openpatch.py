"""An emulated open patch: it behaves as a microcontroller with ``openpatch.h``.

Source: docs/protocols/patch-serial.md.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Sequence
from typing import Annotated, Any

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_pads

_TAXELS = 12
_SHORTEST_US, _LONGEST_US = 1000, 1_000_000
_SECOND_NS = 1_000_000_000
_BOOT, _REPORT, _DATA = 0x60, 0x61, 0x80
_OK, _UNKNOWN, _BAD_LENGTH, _NO_SUCH, _BAD_VALUE, _OTHER_DESCRIPTION = 0, 1, 2, 3, 4, 8
_NEEDED = {0x01: 2, 0x02: 2, 0x03: 4, 0x04: 0, 0x05: 4, 0x06: 2, 0x07: 1, 0x08: 0}  # bytes of arguments
_START, _ENABLE = 0x03, 0x06
_POWER_UP, _BROWN_OUT = 1, 4
_MASKED = 32
_LONGEST = 1100  # bytes of a request on the line


def message(number: int, payload: bytes) -> bytes:
    body = bytes([number]) + payload
    return stuff(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


def stuff(data: bytes) -> bytes:
    """Return data without zeros: each run of other bytes after its length plus 1; no zero follows a run of 254."""
    stuffed = b""
    runs = data.split(b"\0")
    for at, run in enumerate(runs):
        while len(run) >= 254:
            stuffed += b"\xff" + run[:254]
            run = run[254:]
            if not run and at == len(runs) - 1:
                return stuffed
        stuffed += bytes([len(run) + 1]) + run
    return stuffed


def unstuff(stuffed: bytes) -> bytes:
    """Return the data before stuffing; empty if these bytes are not stuffed."""
    data, at = b"", 0
    while at < len(stuffed):
        code = stuffed[at]
        run = stuffed[at + 1 : at + code]
        if len(run) != code - 1:
            return b""
        at += code
        data += run
        if code < 0xFF and at < len(stuffed):
            data += b"\0"
    return data


class EmulatedOpenPatchOptions(SerialEmulatorOptions, frozen=True):
    modules: Annotated[int, Meta(ge=1, le=64, description="modules of twelve pressure sensors")] = 4
    period_ms: Annotated[float, Meta(ge=1, le=1000, description="time between two samples, ms")] = 10
    serial_number: Annotated[str, Meta(max_length=16, description="name of the patch")] = "1"


class EmulatedOpenPatch(SerialEmulator[EmulatedOpenPatchOptions]):
    """One patch, device number 1.

    Values: those of the pressure sensors of module 0, of module 1 ...
    """

    full_scale = 0xFFFF
    rest = 1000
    swing = 40_000

    def __init__(self, options: EmulatedOpenPatchOptions, **more: Any) -> None:
        super().__init__(options, **more)
        own_us = round(1000 * options.period_ms)
        text = f"emulated\0{options.serial_number}\0" + "1.0\0"
        self._items = [
            b"\x01" + struct.pack("<III", own_us, _SHORTEST_US, _LONGEST_US) + text.encode(),
            b"\x02" + struct.pack("<Iffff", 1, 0.01, 0.0, 0.0, 655.35) + b"pressure\0kPa\0",
            b"\x03triangle\0" + struct.pack("<BBHBB", 2, 1, _TAXELS, 1, 0),
            b"\x04\x01" + bytes((0, options.modules)),
        ]
        self._crc = zlib.crc32(b"".join(self._items))

    def places(self) -> Places:
        return on_pads(*[(_TAXELS, 4)] * self.options.modules)

    def boot(self, device: Device, now_ns: int) -> None:
        is_first = "reset" not in device.memory and device.cycle == 0
        device.memory.update(
            reset=_POWER_UP if is_first else _BROWN_OUT,
            booted_ns=now_ns,
            greeted=False,
            period_us=round(1000 * self.options.period_ms),
            off=set(),
            tared=set(),
            first_cycle=device.cycle,
            us=0,  # device time of cycle us_cycle, the first with this period
            us_cycle=0,
            stamp_us=0,
            sent=0,
        )
        device.every("announce", _SECOND_NS, now_ns)
        super().boot(device, now_ns)

    def on_timer(self, device: Device, name: str, time_ns: int) -> None:
        if name != "announce":
            self.burst(device, time_ns)
        elif device.streams_from_ns is not None:
            self.say(device, message(_REPORT, self._report(device, time_ns)), time_ns)
        elif not device.memory["greeted"]:
            self.say(device, message(_BOOT, self._greeting(device, time_ns)), time_ns)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        *whole, rest = heard.split(b"\0")
        return whole, rest[-_LONGEST:]

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        """Answer a request; a patch ignores all else."""
        heard = unstuff(command)
        body = heard[:-4]
        if len(body) < 2 or zlib.crc32(body) != int.from_bytes(heard[-4:], "little") or not 0x01 <= body[0] <= 0x1F:
            return None
        request, number, arguments = body[0], body[1:2], body[2:]
        device.memory["greeted"] = True
        if request not in _NEEDED:
            error, answer = _UNKNOWN, b""
        elif len(arguments) < _NEEDED[request]:
            error, answer = _BAD_LENGTH, b""
        else:
            error, answer = self._answer(device, request, arguments, now_ns)
        reply = message(0x40 + request, number + bytes([error]) + answer)
        if error == _OK and request == _START:
            reply += self._masked(device, device.memory["off"])
        elif error == _OK and request == _ENABLE and not arguments[1]:
            reply += self._masked(device, self._meant(arguments[0]))
        return reply

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Return ``module0`` and so on, ``boot`` or ``report``; other messages are answers."""
        body = unstuff(payload.split(b"\0")[0])
        return f"module{body[1]}" if body[0] == _DATA else {_BOOT: "boot", _REPORT: "report"}.get(body[0], "answer")

    def kinds(self) -> Sequence[str]:
        return [*super().kinds(), "boot", "report"]

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        memory = device.memory
        cycles = device.cycle - memory["first_cycle"]
        memory["stamp_us"] = memory["us"] + memory["period_us"] * (cycles - memory["us_cycle"])
        sent = []
        for module in range(self.options.modules):
            if module in memory["off"]:
                continue
            own = [0] * _TAXELS if module in memory["tared"] else values[_TAXELS * module : _TAXELS * (module + 1)]
            header = struct.pack("<BHIB", module, cycles & 0xFFFF, memory["stamp_us"] & 0xFFFF_FFFF, 0)
            sent.append(message(_DATA, header + struct.pack(f"<{_TAXELS}H", *own)))
        memory["sent"] += len(sent)
        return sent

    def _answer(self, device: Device, request: int, arguments: bytes, now_ns: int) -> tuple[int, bytes]:
        memory = device.memory
        if request == 0x01:
            return _OK, self._greeting(device, now_ns)
        if request == 0x02:
            item = int.from_bytes(arguments[:2], "little")
            return (_OK, arguments[:2] + self._items[item]) if item < len(self._items) else (_NO_SUCH, b"")
        if request == _START:
            if int.from_bytes(arguments[:4], "little") != self._crc:
                return _OTHER_DESCRIPTION, b""
            self.start(device, now_ns, memory["period_us"] / 1e6)
        elif request == 0x04:
            self.stop(device)
        elif request == 0x05:
            return self._set_period(device, int.from_bytes(arguments[:4], "little"), now_ns)
        elif request == 0x08:
            return _OK, self._report(device, now_ns)
        else:
            modules = self._meant(arguments[0])
            if not modules:
                return _NO_SUCH, b""
            if request == 0x07:
                memory["tared"] |= modules
            elif arguments[1]:
                memory["off"] -= modules
            else:
                memory["off"] |= modules
        return _OK, b""

    def _meant(self, module: int) -> set[int]:
        known = set(range(self.options.modules))
        return known if module == 0xFF else known & {module}

    def _set_period(self, device: Device, period_us: int, now_ns: int) -> tuple[int, bytes]:
        if not _SHORTEST_US <= period_us <= _LONGEST_US:
            return _BAD_VALUE, b""
        memory = device.memory
        cycles = device.cycle - memory["first_cycle"]
        memory["us"] += memory["period_us"] * (cycles - memory["us_cycle"])
        memory["us_cycle"], memory["period_us"] = cycles, period_us
        self.change_period(device, now_ns, period_us / 1e6)
        return _OK, struct.pack("<I", period_us)

    def _masked(self, device: Device, modules: Collection[int]) -> bytes:
        if device.streams_from_ns is None:
            return b""
        cycles = device.cycle - device.memory["first_cycle"]
        said = b""
        for module in sorted(modules):
            header = struct.pack("<BHIB", module, cycles & 0xFFFF, device.memory["stamp_us"] & 0xFFFF_FFFF, _MASKED)
            said += message(_DATA, header + bytes(2 * _TAXELS))
        return said

    def _greeting(self, device: Device, now_ns: int) -> bytes:
        uptime_ms = (now_ns - device.memory["booted_ns"]) // 1_000_000
        streams = device.streams_from_ns is not None
        return struct.pack("<BBBBIIH", 1, 0, device.memory["reset"], streams, uptime_ms, self._crc, len(self._items))

    def _report(self, device: Device, now_ns: int) -> bytes:
        uptime_ms = (now_ns - device.memory["booted_ns"]) // 1_000_000
        return struct.pack("<IIII", uptime_ms, device.memory["sent"], 0, 0)
