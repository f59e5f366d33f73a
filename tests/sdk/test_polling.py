"""Devices that only answer are asked at absolute deadlines."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from skinware import BusState, DriverReader
from skinware.errors import BusSendError, ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware_drivers.adapter import NoOptions
from skinware_drivers.can.adapter import CanAdapter
from skinware_drivers.counters import BusCounters
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.layout import Frame, Identifier, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.polling import Poll, Poller
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.hardware import WireFrame
from tests.sdk.driving import TroubledBus, driving_lines, read_until

MS = 1_000_000
ASK = Poll(0x100, b"\x01", 0.02)


class Answering(CanAdapter[NoOptions]):
    """A sensor that says how often it was asked."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    patches = (Patch("patch", [Module(taxels(1))]),)
    layout = Layout([Frame("answer", [Identifier(0x101)], (2,), Values(0, "<u2", 1))])
    polls = (ASK,)


class Device:
    """Answers at once; notes when it was asked."""

    def __init__(self) -> None:
        self.asked_ns: list[int] = []
        self._answers: list[WireFrame] = []

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        if (identifier, payload) == (0x100, b"\x01"):
            self.asked_ns.append(now_ns)
            self._answers.append(WireFrame(now_ns, 0x101, len(self.asked_ns).to_bytes(2, "little")))

    def next_due_ns(self) -> int | None:
        return self._answers[0].time_ns if self._answers else None

    def emit(self, now_ns: int) -> list[WireFrame]:
        answers, self._answers = self._answers, []
        return answers

    def skip(self, now_ns: int) -> int:
        return len(self.emit(now_ns))

    def totals(self) -> dict[str, int]:
        return {}


def bus_with(device: Device, *, listen_only: bool = False) -> TroubledBus:
    return TroubledBus.with_hardware(device, listen_only=listen_only)


def test_answers_to_polls_are_published_one_by_one_at_absolute_deadlines() -> None:
    device = Device()
    with driving_lines([(Answering(NoOptions()), bus_with(device))], "answering") as running:
        with DriverReader("answering") as reader:
            fresh = (frame for frame in reader.in_order(timeout_s=30) if not frame.status.any())
            values = [int(next(fresh).values[0]) for _ in range(20)]
        asked_ns = device.asked_ns.copy()
        missed = running.status()["buses"][0]["polls_missed"]  # by then, and perhaps a few since
    assert all(b - a in (0, 1) for a, b in pairwise(values))
    # no drift: polls lie on one grid of 20 ms, but for how late each was sent; what it lacks was counted
    deadlines = [(asked - asked_ns[0]) / (20 * MS) for asked in asked_ns]
    assert max(round(d) for d in deadlines) <= len(deadlines) - 1 + missed + 1


def test_a_listener_asks_nothing() -> None:
    device = Device()
    bus = bus_with(device, listen_only=True)
    with driving_lines([(Answering(NoOptions()), bus)], "answering", listen_only=True):
        pass
    assert device.asked_ns == []
    assert bus.counters.sent == bus.counters.send_failures == 0


def test_polls_stop_with_a_lost_bus_and_go_on_when_it_is_back() -> None:
    device = Device()
    bus = bus_with(device)
    with driving_lines([(Answering(NoOptions()), bus)], "answering") as running, DriverReader("answering") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(bus.go_down)
        read_until(reader, lambda f: f.bus_state[0] == BusState.DOWN)
        asked, failures = len(device.asked_ns), bus.counters.polls_missed
        wait_until(lambda: len(bus.opened_at_s) >= 3)  # it tried twice to open it: some periods have passed
        assert (len(device.asked_ns), bus.counters.polls_missed) == (asked, failures)
        bus.down = False
        read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE and not f.status.any())
        wait_until(lambda: len(device.asked_ns) > asked + 3)


class FullBus:
    """Takes a frame only now and then."""

    listen_only = False
    channel = "full"
    medium = "can"

    def __init__(self, taken: Sequence[bool]) -> None:
        self.taken = iter(taken)
        self.identifiers: list[int] = []

    @property
    def sent(self) -> int:
        return len(self.identifiers)

    def send(self, identifier: int, payload: bytes) -> None:
        if not next(self.taken, False):
            raise BusSendError("queue full")
        self.identifiers.append(identifier)


def test_a_bus_that_takes_nothing_is_not_flooded_and_every_miss_is_counted() -> None:
    bus, counters = FullBus([True]), BusCounters()
    poller = Poller(Link(bus), counters)  # type: ignore[arg-type]
    polls = [replace(ASK, period_s=0.01)]
    asyncio.run(
        asyncio.wait_for(poller.run(lambda: polls if counters.polls_missed < 5 else [], lambda: False), timeout=30)
    )
    assert bus.sent == 1


def test_other_polls_are_taken_up_while_running() -> None:
    bus = FullBus([True] * 100)
    poller = Poller(Link(bus), BusCounters())  # type: ignore[arg-type]
    first, second = replace(ASK, period_s=0.005), replace(ASK, identifier=0x102, period_s=0.001)

    def polls() -> list[Poll]:
        if bus.sent < 3:
            return [first]
        return [second] if bus.sent < 6 else []

    asyncio.run(asyncio.wait_for(poller.run(polls, lambda: False), timeout=30))
    assert bus.identifiers == [0x100] * 3 + [0x102] * 3


def test_a_period_of_zero_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="poll 100 every 0 s: give more than 0"):
        Poll(0x100, b"", 0)
