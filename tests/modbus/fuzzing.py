"""One fuzzer's input, run through a Modbus bus of each kind: what ``tools/fuzzing/modbus_lines.py`` does.

An input is a script: what the other end of the line says to each question (a good reply, half of one, a damaged one, an
exception, a reply to another question, any bytes), and how time passes. Two buses hear the same, one in which C asks
while all is well and one that never leaves Python: they ask the same, count the same and have the same in the end.
A listener hears the replies beside their questions.
"""

from __future__ import annotations

import os
import select
import socket
from contextlib import ExitStack
from typing import NamedTuple
from unittest import mock

import numpy as np

from skinware.driver_service import DriverWriter
from skinware.errors import BusNotAvailable
from skinware.sensor_types import PRESSURE
from skinware_drivers import Module, NoOptions, Patch, native, taxels
from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import OWN_BUS_COUNTERS, BusCounters, read_own
from skinware_drivers.decoding.decoder import PATCH_COUNTERS, Decoder
from skinware_drivers.description import assemble
from skinware_drivers.modbus import ModbusAdapter, Registers, wire
from skinware_drivers.modbus.bus import ModbusBus
from skinware_drivers.modbus.master import Listener, Master
from skinware_drivers.modbus.registers import Wanted
from skinware_drivers.modbus.wire import Message
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.generation import Flow, Generation
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS, Publisher
from skinware_drivers.serial.ports import DescriptorPort, Port
from skinware_drivers.virtual.hand_clock import HandClock
from tests.serial.fuzzing import Script

_OTHER_BUS = 2
_MOST_BYTES = 300
_MS = 1_000_000


class Outcome(NamedTuple):
    """What came of an input.

    Attributes:
        heard: bytes.
        frames: of registers.
        in_c: how often C was handed the line.
    """

    heard: int
    frames: int
    in_c: int


class Fingers(ModbusAdapter[NoOptions]):
    """Two units; the blocks of one lie in several reads, and side by side in one."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    period_s = 0.02
    timeout_s = 0.05
    turnaround_s = 0.001
    patches = tuple(
        Patch(
            f"finger {unit}", [Module(taxels(n, first_uid=(unit << 12) + (n << 4)), key=n) for n in (9, 150)], key=unit
        )
        for unit in (1, 2)
    )
    registers = tuple(
        Registers(address, n, unit=unit, patch=unit, module=n)
        for unit in (1, 2)
        for address, n in ((3000, 9), (3012, 150))
    )


class _End(ModbusBus):
    """A bus at the end of a pair of sockets, whatever its name says."""

    def __init__(self, channel: str, clock: HandClock) -> None:
        super().__init__(channel, payload_size=Fingers(NoOptions()).payload_size, clock=clock)
        self.far, self.near = socket.socketpair()
        self.far.setblocking(False)

    def _open_port(self) -> Port:
        return DescriptorPort("line", socket.socket(fileno=os.dup(self.near.fileno())))

    def asked(self) -> bytes:
        """What it has sent since."""
        try:
            return self.far.recv(1 << 16)
        except BlockingIOError:
            return b""

    @property
    def registers(self) -> list[bytes]:
        """What it has of its devices."""
        assert isinstance(self._talk, Master)
        image = self._talk._image
        return [area.registers.tobytes() + area.heard_ns.tobytes() for area in image.areas] + [image.told_ns.tobytes()]


class _InPython:
    """A bus that never leaves Python."""

    in_c = 0

    def __init__(self, channel: str, clock: HandClock, stack: ExitStack) -> None:
        self.bus = _End(channel, clock)
        stack.callback(_close, self.bus)
        self._batch = FrameBatch(64, self.bus.payload_size)
        Fingers(NoOptions()).fit(self.bus)
        with mock.patch.object(native, "library", return_value=None):
            self.bus.open()

    def take(self) -> None:
        self._batch.clear()
        self.bus.receive(self._batch, 0)


class _InC(_InPython):
    """One for which C asks, and Python where it has to."""

    def __init__(self, channel: str, clock: HandClock, stack: ExitStack) -> None:
        self.bus = _End(channel, clock)
        stack.callback(_close, self.bus)
        epoll = stack.enter_context(select.epoll())
        self._loop_fd = os.eventfd(1)  # Python always has something to do: C takes once, and comes back
        stack.callback(os.close, self._loop_fd)
        adapter = Fingers(NoOptions())
        adapter.fit(self.bus)
        line = BusLine("line", 0, adapter, self.bus, epoll)
        line.patches = adapter.patches
        self.bus.open()
        line.connection.opened()
        tables = assemble([("line", adapter.patches)], adapter.types, np.dtype(np.uint16))
        decoder = Decoder([adapter.layout], tables, [adapter.period_s])
        writer = DriverWriter(
            "fingers",
            decoder.tables.structure,
            bus_counters=ALL_BUS_COUNTERS,
            patch_counters=PATCH_COUNTERS,
        )
        stack.callback(writer.close)
        publisher = Publisher(writer, decoder, adapter.watch(tables), adapter.period_s, by_cycle=True)
        self._generation = Generation([line], decoder, adapter.watch(tables), publisher, adapter.period_s)
        self._flow = Flow(self._generation, epoll.fileno(), 0.0, self._fail, self._fail)

    def take(self) -> None:
        if self._flow._run(self._loop_fd, 0.01) == _OTHER_BUS:
            batch = self._generation.empty_batch()
            self.bus.receive(batch, 0)
            self._generation.digest(batch)
        self.in_c += len(self._flow._handed)

    def _fail(self, *told: object) -> None:
        raise AssertionError(told)


def _close(bus: _End) -> None:
    bus.close()
    bus.far.close()
    bus.near.close()


def _counts(bus: ModbusBus) -> dict[str, int]:
    return dict(zip(OWN_BUS_COUNTERS, read_own(bus.counters), strict=True))


def run(clock: HandClock, data: bytes) -> Outcome:
    """Run one input.

    Raises:
        AssertionError: the ways differ, or something was not counted.
    """
    script = Script(data)
    over_tcp = script.number(2) == 1
    channel = "tcp://127.0.0.1:1" if over_tcp else "/dev/line"
    with ExitStack() as stack:
        return _Fuzz(clock, script, [way(channel, clock, stack) for way in (_InPython, _InC)], over_tcp=over_tcp).run()


class _Fuzz:
    """Plays a script."""

    def __init__(self, clock: HandClock, script: Script, ways: list[_InPython], *, over_tcp: bool) -> None:
        self._clock, self._script, self._ways, self._over_tcp = clock, script, ways, over_tcp
        self._heard = 0
        self._question: Message | None = None
        self._before = Message(1, wire.question_to_read(3, 3000, 9))
        self._listening = BusCounters()
        wanted = Wanted(Fingers.registers)
        self._listener = Listener(wanted, self._listening)

    def run(self) -> Outcome:
        is_modbus = True
        while is_modbus and not self._script.is_over:
            self._clock.pass_to(self._clock.now_ns + (0, 0, 0, 1, 5, 30, 60, 300)[self._script.number(8)] * _MS)
            is_modbus = self._take()
            if is_modbus and (said := self._say()):
                self._heard += len(said)
                for way in self._ways:
                    way.bus.far.send(said)
                is_modbus = self._take()
        one, other = self._ways
        framing = one.bus.counters.framing
        assert framing.bytes_in <= self._heard
        assert framing.frame_bytes + framing.skipped_bytes <= framing.bytes_in
        if is_modbus:
            assert framing.bytes_in == self._heard
            counts, others = _counts(one.bus), _counts(other.bus)
            assert counts == others, {key: (n, others[key]) for key, n in counts.items() if n != others[key]}
            assert one.bus.registers == other.bus.registers
        return Outcome(self._heard, one.bus.counters.frames, other.in_c)

    def _take(self) -> bool:
        """Until all is heard; False: it was no Modbus, as both say."""
        was_lost = [self._take_by(way) for way in self._ways]
        assert was_lost[0] == was_lost[1], was_lost
        if was_lost[0]:
            return False
        one, other = (way.bus.asked() for way in self._ways)
        assert one == other, f"asked {one.hex(' ')} and {other.hex(' ')}"
        if one:
            self._listener.heard(one, self._clock.now_ns)
            self._before = self._question or self._before
            self._question = (
                Message(one[6], one[7:12], int.from_bytes(one[:2], "big"))
                if self._over_tcp
                else Message(one[0], one[1:6])
            )
        return True

    def _take_by(self, way: _InPython) -> bool:
        try:
            for _ in range(4):
                way.take()
        except BusNotAvailable:
            return True
        return False

    def _say(self) -> bytes:
        script, asked = self._script, self._question or self._before
        what = script.number(12)
        if what == 11:
            return b""
        if what == 10:
            return script.bytes(script.number(_MOST_BYTES))
        message = self._before if what == 9 else asked
        count = int.from_bytes(message.data[3:5], "big")
        data = bytes([message.data[0], 2 * count]) + (script.bytes(4) * count)[: 2 * count]
        if what == 8:
            data = bytes([message.data[0] | 0x80, script.number(12)])
        reply = message._replace(data=data)
        frame = wire.tcp_frame(reply) if self._over_tcp else wire.rtu_frame(reply)
        if what == 7:
            return frame[: script.number(len(frame))]
        if what == 6:
            place = script.number(len(frame))
            return frame[:place] + bytes([frame[place] ^ 1 << script.number(8)]) + frame[place + 1 :]
        self._listener.heard(frame, self._clock.now_ns)
        return frame + (script.bytes(script.number(20)) if what == 5 else b"")


def listen(script: bytes) -> int:
    """Let a listener hear any bytes; how many it skipped.

    Raises:
        AssertionError: it counted wrongly.
    """
    counters = BusCounters()
    listener = Listener(Wanted(Fingers.registers), counters)
    for begin in range(0, len(script), 60):
        listener.heard(script[begin : begin + 60], begin)
    framing = counters.framing
    assert framing.bytes_in == len(script)
    assert framing.frame_bytes + framing.skipped_bytes <= framing.bytes_in
    return framing.skipped_bytes
