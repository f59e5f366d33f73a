"""Test that C does with the frames and bytes of a device what numpy does, bit by bit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from typing import Literal
from unittest.mock import patch

import pytest

from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters, FramerCounters
from skinware_drivers.serial import bus
from skinware_drivers.serial.delimited import Delimited
from skinware_drivers.serial.framing import Framing
from skinware_drivers.serial.packets import Packet
from skinware_drivers.serial.stream import NativeStream, PythonStream, Stream
from skinware_drivers.testing import conformance
from skinware_drivers.testing.comparison import until_fresh
from skinware_drivers.testing.rig import Running, Suite, play
from skinware_drivers.testing.torn_tests import FrameLog
from skinware_drivers.testing.waiting import defect, require
from skinware_drivers.testing.wire import Stumbling
from skinware_drivers.virtual.hand_clock import HandClock
from tests.specification.both_paths import Pair, hand_clock
from tests.specification.framers import InPython
from tests.specification.one_path import Publishing


class BothStreams(Stream):
    """A stream whose frames are found twice. What it gives is what Python finds.

    Args:
        in_c: what C is to find the same with; its counters are its own.
        framing: what is on the line.
        payload_size: of bodies, at most.
        counters: of the bus.

    Attributes:
        difference: what they differ in, as it was raised; empty if they do not.
    """

    def __init__(self, in_c: NativeStream, framing: Framing, payload_size: int, counters: BusCounters) -> None:
        super().__init__(counters)
        self._python, self._native = PythonStream(framing, payload_size, counters), in_c
        self.difference = ""

    @property
    def is_behind(self) -> bool:
        return self._python.is_behind or self._native.is_behind

    @property
    def pending(self) -> int:
        return self._python.pending

    def rest(self) -> list[tuple[bytes, int]]:
        self._compare("holds back", self._python.rest(), self._native.rest())
        return self._python.rest()

    def begin(self, rest: Sequence[tuple[bytes, int]]) -> None:
        self._python.begin(rest)
        self._native.begin(rest)

    def add(self, chunk: bytes, time_ns: int) -> None:
        self._python.add(chunk, time_ns)
        self._native.add(chunk, time_ns)

    def fill(self, batch: FrameBatch, ordinal: int) -> int:
        other, first = deepcopy(batch), batch.stop
        taken = self._python.fill(batch, ordinal)
        found = self._native.fill(other, ordinal)
        rows = slice(first, batch.stop)
        self._compare("finds", (taken, batch.stop), (found, other.stop))
        for name in ("wire", "time_ns", "bus"):
            own, of_c = getattr(batch, name)[rows], getattr(other, name)[rows]
            if own.tobytes() != of_c.tobytes():
                self._compare(name, own.tolist(), of_c.tolist())
        if not self.is_behind:
            self._compare("counts", _counted(self.counters), _counted(self._native.counters))
            self._compare("holds back", self._python.pending, self._native.pending)
        return taken

    def take_damaged(self) -> bytes:
        if self._native.is_behind:
            return b""
        damaged = self._python.take_damaged()
        self._compare("keeps as a sample", damaged, self._native.take_damaged())
        return damaged

    def _compare(self, what: str, of_python: object, of_c: object) -> None:
        if of_python != of_c:
            self.difference = f"{what}: Python {of_python}, C {of_c}"
            defect(self.difference)


def _counted(counters: BusCounters) -> tuple[int | FramerCounters, ...]:
    """What streams count; the rest is the bus'."""
    return counters.frames, counters.errors, counters.refused, counters.framing


@contextmanager
def both_streams() -> Iterator[None]:
    """As long as the ``with`` lasts, lines that are opened find frames in both ways, where C can.

    What differs is raised where it is found, in the driver, and here again.
    """
    streams = list[Stream]()

    def stream_of(framing: Framing, payload_size: int, counters: BusCounters) -> Stream:
        streams.append(made(framing, payload_size, counters))
        return streams[-1]

    with patch.object(bus, "stream_of", stream_of):
        try:
            yield
        finally:
            for stream in streams:
                if isinstance(stream, BothStreams) and stream.difference:
                    defect(stream.difference)


def made(
    framing: Framing,
    payload_size: int,
    counters: BusCounters,
    kind: type[NativeStream] = NativeStream,
) -> Stream:
    """Both streams, or that of Python alone.

    Args:
        framing: what is on the line.
        payload_size: of bodies, at most.
        counters: of the bus.
        kind: of the stream in C.
    """
    if not isinstance(framing, Packet | Delimited):
        return PythonStream(framing, payload_size, counters)
    in_c = kind(framing, payload_size, deepcopy(counters))
    return BothStreams(in_c, InPython(framing), payload_size, counters)


Trouble = Literal["nothing", "lost", "truncated", "repeated", "garbage", "stumbling", "restart"]
_PERIODS = 40
_BETWEEN_DAMAGES = 4
_FRAMES_OF_A_BURST = 4


class PathTests(Suite):
    """The two data paths side by side."""

    @pytest.mark.parametrize("trouble", ["nothing", "lost", "truncated", "repeated", "garbage", "stumbling", "restart"])
    def test_both_data_paths_do_the_same(self, trouble: Trouble) -> None:
        """What the devices send, with something wrong: numpy and C publish, count and remember the same.

        If they do not, that is a fault of Skinware's.
        """
        with both_streams():
            heard, rig = self._hear(trouble)
        require(heard.takes, "the devices sent nothing")
        adapter = rig.adapter
        with (
            hand_clock(heard.takes[0].now_ns) as clock,
            Pair(
                clock,
                [adapter.layout],
                heard.tables,
                [adapter.period_s],
                Publishing(adapter.period_s, adapter.by_cycle),
                rows=max(len(take.wire) for take in heard.takes),
                watch=adapter.watch,
                payload_size=adapter.payload_size,
            ) as pair,
        ):
            for take in heard.takes:
                pair.pass_to(take.now_ns)
                pair.feed_rows(take.wire, take.time_ns)
            pair.pass_to(clock.now_ns + 4 * rig.period_ns)
            require(pair.frames, "nothing was published")

    def _hear(self, trouble: Trouble) -> tuple[FrameLog, Running]:
        """What a running driver receives while something is wrong."""

        async def scenario(clock: HandClock) -> tuple[FrameLog, Running]:
            async with self.running(clock) as rig:
                await until_fresh(rig)
                heard = FrameLog(rig)
                if trouble == "stumbling":
                    rig.wire.stumbling = Stumbling(rig.period_ns, _FRAMES_OF_A_BURST)
                elif trouble == "restart":
                    await rig.sleep(4 * rig.adapter.period_s)
                    rig.devices.restart(rig.numbers[0], clock.now_ns)
                elif trouble != "nothing":
                    rig.wire.fault, rig.wire.every_ns = trouble, _BETWEEN_DAMAGES * rig.period_ns
                await rig.sleep(_PERIODS * rig.adapter.period_s)
                return heard, rig

        return play(scenario)


class DriverConformance(PathTests, conformance.DriverConformance):
    """The suite for drivers, and the comparison of both paths."""
