"""Emulated devices on a real bus that turn bad: a flood of garbage, a second device of the same kind, a lost one."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import msgspec
import numpy as np

from skinware.errors import SkinwareError
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.waiting import SLOWER, wait_until
from skinware_drivers.virtual.emulation import Emulation
from skinware_drivers.virtual.hardware import WireFrame, load_emulator, medium_of

Mode = Literal["sound", "flood", "doubled"]

_PERIOD_NS = 2_000_000
_FRAMES, _BYTES = 40, 4096  # of garbage a period: 20,000 frames or 2 MB a second
_LONGEST = {"can": 8}


class _Hostile:
    """Devices, a second set of the same, and garbage between their frames, as emulated hardware."""

    def __init__(self, emulator: Any, options: Any, seed: int) -> None:
        self.mode: Mode = "sound"
        self.garbage = 0
        self._devices, self._twins = emulator(options), emulator(options)
        self._medium = medium_of(emulator)
        self._datagrams = bool(getattr(emulator, "datagrams", False))
        self._random = np.random.default_rng(seed)
        self._identifiers = [0x123]
        self._next_ns = 0

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        self._devices.receive(identifier, payload, now_ns)
        if self.mode == "doubled":
            self._twins.receive(identifier, payload, now_ns)

    def next_due_ns(self) -> int | None:
        due_ns = [self._devices.next_due_ns()]
        if self.mode == "doubled":
            due_ns.append(self._twins.next_due_ns())
        if self.mode == "flood":
            due_ns.append(self._next_ns)
        return min((moment for moment in due_ns if moment is not None), default=None)

    def emit(self, now_ns: int) -> list[WireFrame]:
        frames: list[WireFrame] = self._devices.emit(now_ns)
        self._identifiers = sorted({*self._identifiers[-32:], *(frame.identifier for frame in frames[:8])})
        twins = self._twins.emit(now_ns)
        if self.mode == "doubled":
            frames = sorted([*frames, *twins], key=lambda frame: frame.time_ns)
        if self.mode == "flood" and now_ns >= self._next_ns:
            self._next_ns = now_ns + _PERIOD_NS
            frames = [*frames, *self._garbage(now_ns)]
        return frames

    def skip(self, now_ns: int) -> int:
        self._twins.skip(now_ns)
        skipped: int = self._devices.skip(now_ns)
        return skipped

    def totals(self) -> dict[str, int]:
        return {"garbage": self.garbage}

    def _garbage(self, now_ns: int) -> Iterator[WireFrame]:
        """Frames under own and foreign identifiers; on a line, random bytes; over a network, random messages."""
        if self._medium != "can" and not self._datagrams:
            self.garbage += _BYTES
            yield WireFrame(now_ns, 0, self._random.bytes(_BYTES))
            return
        self.garbage += _FRAMES
        for _ in range(_FRAMES):
            own = self._random.random() < 0.5
            identifier = int(self._random.choice(self._identifiers)) if own else int(self._random.integers(0, 0x800))
            longest = 8 if self._medium == "can" else 600
            yield WireFrame(now_ns, identifier, self._random.bytes(int(self._random.integers(0, longest + 1))))


class HostileDevices:
    """The devices of a driver on a real bus, in a thread of this process.

    Args:
        emulator: name of the emulator.
        bus: name of the bus, at the end of the devices.
        options: of the emulator.
    """

    def __init__(self, emulator: str, bus: str, **options: Any) -> None:
        factory = load_emulator(emulator)
        self._made = factory, factory.Options(**options)
        self._bus = bus
        self._life: _Life | None = None
        self._lives = 0

    def appear(self) -> None:
        """Power the devices up, on a bus that is opened for it."""
        factory, options = self._made
        self._lives += 1
        hardware = _Hostile(factory, options, self._lives)
        self._life = _Life(
            hardware, self._bus, getattr(factory, "payload_size", _LONGEST.get(medium_of(factory), 4096))
        )

    def vanish(self) -> None:
        """Take the devices away, and their end of the bus with them."""
        if self._life is not None:
            self._life.end()
            self._life = None

    def turn(self, mode: Mode) -> None:
        """From now on, be ``sound``, under a ``flood`` of garbage, or ``doubled``."""
        assert self._life is not None
        self._life.hardware.mode = mode

    def flood(self, amount: int) -> None:
        """Send so many frames, or bytes, of garbage between the devices' own; ends when they have been sent."""
        assert self._life is not None
        hardware = self._life.hardware
        before = hardware.garbage
        self.turn("flood")
        wait_until(lambda: hardware.garbage - before >= amount, 60 * SLOWER)
        self.turn("sound")


class _NoOptions(msgspec.Struct):
    """An emulation reports its options; those of hostile devices concern no other program."""


class _Life:
    """From power-up to the end: an emulation in a thread."""

    def __init__(self, hardware: _Hostile, bus: str, payload_size: int) -> None:
        self.hardware = hardware
        self.stopped = False
        self._woken, self._wake = socket.socketpair()
        self._error: SkinwareError | None = None
        emulation = Emulation(make_bus(bus, payload_size=payload_size, for_devices=True), hardware, self.event)
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(emulation, bus))
        self._thread.start()
        assert self._ready.wait(30 * SLOWER)
        assert self._error is None, self._error

    def fileno(self) -> int:
        return self._woken.fileno()

    def event(self, name: str, **_facts: Any) -> None:
        if name == "ready":
            self._ready.set()

    def end(self) -> None:
        self.stopped = True
        self._wake.send(b"\0")
        self._thread.join(30 * SLOWER)
        self._woken.close()
        self._wake.close()
        assert not self._thread.is_alive()
        if self._error is not None:
            raise self._error

    def _run(self, emulation: Emulation, bus: str) -> None:
        try:
            emulation.run(self, bus_name=bus, driver="hostile", options=_NoOptions())
        except SkinwareError as error:
            self._error = error
            self._ready.set()


@contextmanager
def hostile_devices(emulator: str, bus: str, **options: Any) -> Iterator[HostileDevices]:
    """Devices that are there at once, and gone at the end."""
    devices = HostileDevices(emulator, bus, **options)
    devices.appear()
    try:
        yield devices
    finally:
        devices.vanish()


def processor_s(pid: int) -> float:
    """Seconds of processor that a process has used."""
    with open(f"/proc/{pid}/stat") as stat:
        fields = stat.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_bytes(pid: int) -> int:
    """Memory of a process."""
    with open(f"/proc/{pid}/statm") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
