"""One fuzzer's input, run through the whole data path in C, from sockets and lines of the kernel to the ring.

An input is a script: which driver on how many buses, then datagrams and bytes, good ones and any, that wait in the
kernel when C looks; ends that go away and come back, time that passes. Datagrams of the loopback stand in for CAN:
there they can also be shorter and longer than any frame. Nothing of it may raise anything, and everything is counted.
"""

from __future__ import annotations

import functools
import os
import select
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any
from unittest import mock

import numpy as np

from skinware.driver_service import DriverWriter
from skinware.wire import read_pieces
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus, is_read_natively
from skinware_drivers.can import CanAdapter
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.counters import read_own
from skinware_drivers.decoding.decoder import PATCH_COUNTERS, Decoder
from skinware_drivers.description import assemble, join_types
from skinware_drivers.fields import Match
from skinware_drivers.layout import Frame
from skinware_drivers.options import NoOptions
from skinware_drivers.registry import load_driver
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.generation import Flow, Generation
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS, Publisher
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import DescriptorPort, Port
from skinware_drivers.virtual.hand_clock import HandClock
from tests.native.traffic import identifier_of
from tests.sdk.cable import Cable
from tests.serial.fuzzing import Script

_MOST_BUSES, _MOST_BYTES = 6, 200
"""More buses than C asks one by one."""
_MOST_FRAMES, _MOST_ON_LINE = 300, 5000
"""That are sent at once: more than a small batch and the kernel's small buffer hold, more than a chunk of a line."""
_ROWS = (64, 2048)
"""Of a batch; the smaller one is full after a call of the kernel."""
_BUFFERS = (1 << 20, 20_000)
"""Bytes; the smaller one loses frames."""


class _CableBus(SocketCanBus):
    """One end of a cable."""

    def __init__(self, payload_size: int, buffer: int) -> None:
        super().__init__("cable", {"buffer": str(buffer)}, payload_size=payload_size)
        self.cable = Cable()

    def open(self) -> None:
        """The end is there."""
        self.adopt(socket.socket(fileno=os.dup(self.cable.end.fileno())))
        self.bit_rate = 500_000


class _EndOfLine(SerialBus):
    """One end of a line."""

    def __init__(self, payload_size: int) -> None:
        super().__init__("line", payload_size=payload_size)
        self.far, self.near = socket.socketpair()
        self.far.setblocking(False)

    def _open_port(self) -> Port:
        return DescriptorPort("line", socket.socket(fileno=os.dup(self.near.fileno())))


class _Wire(ABC):
    """A bus, and what sends on it.

    Attributes:
        bus: the driver's end.
        sent: what the kernel took at the other end.
        is_whole: the other end is still there.
    """

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.bus.tap.open()
        self.sent = 0
        self.is_whole = True
        self._kept = 0

    def kept(self) -> int:
        """Frames or bytes that the tap kept so far."""
        for batch in self.bus.tap.fetch():
            pieces, is_whole = read_pieces(batch)
            assert is_whole
            self._kept += sum(len(piece.data) if piece.frames is None else len(piece.frames) for piece in pieces)
        return self._kept

    @abstractmethod
    def frame(self, identifier: int, payload: bytes) -> bytes:
        """What is sent for a frame."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Whatever it is, as far as the kernel takes it."""

    @abstractmethod
    def send_many(self, data: bytes, script: Script) -> None:
        """The same, many times at once."""

    @abstractmethod
    def break_off(self) -> None:
        """The other end goes away."""

    @abstractmethod
    def check(self) -> None:
        """All that was sent was taken, and is counted once."""

    @abstractmethod
    def close(self) -> None:
        """Let go of both ends."""


class _Can(_Wire):
    def __init__(self, adapter: AnyAdapter, buffer: int) -> None:
        self._end = _CableBus(adapter.payload_size, buffer)
        super().__init__(self._end)

    def frame(self, identifier: int, payload: bytes) -> bytes:
        size = self.bus.payload_size
        return identifier.to_bytes(4, "little") + bytes([len(payload) & 0xFF, 0, 0, 0]) + payload[:size].ljust(size)

    def send(self, data: bytes) -> None:
        with suppress(OSError):
            self._end.cable.out.send(data)
            self.sent += 1

    def send_many(self, data: bytes, script: Script) -> None:
        for _ in range(script.number(_MOST_FRAMES)):
            self.send(data)

    def break_off(self) -> None:
        self._end.cable.out.close()
        with suppress(OSError):
            self._end.cable.end.send(b"")  # whoever sends is told that nobody is there
        self.is_whole = False

    def check(self) -> None:
        counters = self.bus.counters
        counted = counters.frames + counters.errors + counters.refused + counters.dropped
        assert counted == self.sent or not self.is_whole, f"{self.sent} datagrams, {counters}"
        assert self.kept() + self.bus.tap.missed == counted - counters.dropped, f"{self._kept} kept, {counters}"

    def close(self) -> None:
        self.bus.close()
        self._end.cable.close()


class _Line(_Wire):
    def __init__(self, adapter: SerialAdapter[Any]) -> None:
        self._end = _EndOfLine(adapter.payload_size)
        self._encode = adapter.framing.encode
        super().__init__(self._end)

    def frame(self, identifier: int, payload: bytes) -> bytes:
        try:
            return self._encode(identifier, payload)
        except ValueError:  # no frame can carry it
            return payload

    def send(self, data: bytes) -> None:
        with suppress(OSError):
            self.sent += self._end.far.send(data)

    def send_many(self, data: bytes, script: Script) -> None:
        self.send(data * script.number(_MOST_ON_LINE))

    def break_off(self) -> None:
        self._end.far.close()
        self.is_whole = False

    def check(self) -> None:
        found = self.bus.counters.framing
        assert found.bytes_in == self.sent or not self.is_whole, f"{self.sent} bytes, {found}"
        assert self.kept() + self.bus.tap.missed == found.bytes_in, f"{self._kept} bytes kept, {found}"
        assert 0 <= found.frame_bytes + found.idle_bytes + found.skipped_bytes <= found.bytes_in

    def close(self) -> None:
        self.bus.close()
        self._end.far.close()
        self._end.near.close()


@functools.cache
def _makers() -> list[Callable[[], AnyAdapter]]:
    """What makes an adapter, for every skin that says what is on its bus."""
    from tests.native.fuzzing import designs

    makers: list[Callable[[], AnyAdapter]] = []
    for name, design in sorted(designs().items()):
        if name.startswith("driver_"):
            driver: type[AnyAdapter] = load_driver(name.removeprefix("driver_"))
            if driver.medium in ("can", "serial"):
                makers.append(functools.partial(_adapter_of, driver))
            continue
        for bus in design.buses:
            if bus.layout is not None:
                of_bus = {"layout": bus.layout, "patches": bus.patches, "period_s": bus.period_s}
                of_bus |= {"types": design.types, "dtype": np.dtype(design.dtype)}
                makers.append(functools.partial(type("Made", (CanAdapter,), of_bus), NoOptions()))
    return makers


def _adapter_of(driver: type[AnyAdapter]) -> AnyAdapter:
    return driver(driver.Options())


def run(clock: HandClock, script: Script) -> int:
    """Run one input; how many frames it published.

    Raises:
        AssertionError: something was not counted.
    """
    makers = _makers()
    make = makers[script.number(len(makers))]
    clock.now_ns = max(clock.now_ns, time.monotonic_ns())  # the kernel's stamps are of this time
    with ExitStack() as stack:
        fuzz = _Fuzz(clock, script, [make() for _ in range(1 + script.number(_MOST_BUSES))], stack)
        return fuzz.run()


class _Fuzz:
    """Plays a script."""

    def __init__(self, clock: HandClock, script: Script, adapters: list[AnyAdapter], stack: ExitStack) -> None:
        self._clock, self._script, self._stack = clock, script, stack
        epoll = stack.enter_context(select.epoll())
        self._loop_fd = os.eventfd(1)  # Python always has something to do: C takes once, and comes back
        stack.callback(os.close, self._loop_fd)
        self._wires, self._lines = list[_Wire](), list[BusLine]()
        for number, adapter in enumerate(adapters):
            if isinstance(adapter, SerialAdapter):
                wire: _Wire = _Line(adapter)
            else:
                wire = _Can(adapter, _BUFFERS[script.number(len(_BUFFERS))])
            stack.callback(wire.close)
            line = BusLine(f"bus{number}", number, adapter, wire.bus, epoll)
            line.patches = adapter.patches
            self._wires.append(wire)
            self._lines.append(line)
            self._open(line)
        self._generation = self._make_generation()
        # of one adapter, as all have the same
        self._frames: list[tuple[Frame, int]] = [
            (frame, identifier_of(frame, patch.key, module.key))
            for frame in adapters[0].layout.frames
            for patch in adapters[0].patches
            for module in patch.modules
        ]
        latency_s = script.number(3) * 0.005
        self._flow = Flow(self._generation, epoll.fileno(), latency_s, self._not_wanted, self._fail)

    def run(self) -> int:
        if not any(is_read_natively(wire.bus) for wire in self._wires):  # Python reads these lines
            return 0
        while not self._script.is_over:
            what = self._script.number(16)
            if what < 6:
                self._send(is_good=True)
            elif what < 10:
                self._send(is_good=False)
            elif what < 14:
                self._take(self._script.number(64) * 1_000_000)
            elif what == 14:
                self._take(self._script.number(1 << 16) * 100_000)
            else:
                self._happen()
        self._take_all()
        for wire, line in zip(self._wires, self._lines, strict=True):
            if not line.connection.lost.is_set():
                wire.check()
        return self._generation.publisher.writer.sequence

    def _make_generation(self) -> Generation:
        adapters = [line.adapter for line in self._lines]
        tables = assemble(
            [(line.name, line.patches or ()) for line in self._lines],
            join_types([adapter.types for adapter in adapters]),
            np.result_type(*(adapter.dtype for adapter in adapters)),
        )
        decoder = Decoder([adapter.layout for adapter in adapters], tables, [a.period_s for a in adapters])
        writer = DriverWriter(
            "flow", decoder.tables.structure, bus_counters=ALL_BUS_COUNTERS, patch_counters=PATCH_COUNTERS
        )
        self._stack.callback(writer.close)
        watch, period_s = adapters[0].watch(tables), adapters[0].period_s
        publisher = Publisher(writer, decoder, watch, period_s, by_cycle=self._script.number(4) > 0)
        rows = _ROWS[self._script.number(len(_ROWS))]
        with mock.patch.multiple("skinware_drivers.bus", BATCH_FRAMES=rows, _FRAMES_OF_A_BUS=1):
            return Generation(self._lines, decoder, watch, publisher, period_s)

    def _open(self, line: BusLine) -> None:
        line.bus.open()
        line.connection.opened()

    def _send(self, *, is_good: bool) -> None:
        script = self._script
        wire = self._wires[script.number(len(self._wires))]
        if not is_good:
            wire.send(script.bytes(script.number(_MOST_BYTES)))
            return
        frame, identifier = self._frames[script.number(len(self._frames))]
        lengths = sorted(frame.length)
        length = lengths[script.number(len(lengths))]
        data = wire.frame(identifier, script.bytes(min(length, 1 + script.number(24))).ljust(length, b"\xa5"))
        if script.number(16) == 0:
            wire.send_many(data, script)
        else:
            wire.send(data)

    def _take_all(self) -> None:
        """Until nothing comes any more."""
        before = None
        while before != (before := [read_own(wire.bus.counters) for wire in self._wires]):
            self._take(100_000_000)

    def _take(self, passed_ns: int) -> None:
        self._clock.now_ns += passed_ns
        self._flow.run(self._loop_fd, 0.05)

    def _happen(self) -> None:
        number = self._script.number(len(self._lines))
        line, wire = self._lines[number], self._wires[number]
        what = self._script.number(6)
        if what == 0:
            wire.break_off()
        elif what == 1 and line.connection.lost.is_set():
            self._open(line)
        elif what == 2:
            value, mask = (int.from_bytes(self._script.bytes(4), "little") for _ in range(2))
            self._stack.enter_context(line.link.follow(Match(value & mask, mask)))
        elif what == 3:
            self._generation.update_bus_states()
        elif what == 4 and isinstance(line.bus, SocketCanBus):  # the computer's clock was set
            step_ns = int.from_bytes(self._script.bytes(6), "little", signed=True) >> self._script.number(40)
            line.bus._can.offset_ns += step_ns
        else:
            self._generation.path.publish_if_due(self._clock.now_ns)

    def _not_wanted(self) -> None:
        raise AssertionError("C can read all of these buses")

    def _fail(self, error: BaseException) -> None:
        raise error
