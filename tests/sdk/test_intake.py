"""What an intake takes, how long it rests then, and the turns of other threads meanwhile."""

from __future__ import annotations

import asyncio
import os
import select
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from skinware import DriverReader
from skinware.realtime import TURN_S, now_ns
from skinware_drivers.bus import FrameBatch
from skinware_drivers.running import data_loop
from skinware_drivers.running.data_loop import Intake
from tests.sdk.driving import driving, emulated

TAKE_NS = 100_000


def line_of(
    fd: int, receive: Callable[[FrameBatch, int], int], *, is_awaiting: bool = False, expects_data: bool = False
) -> Any:
    """Return as much of a line as an intake needs."""
    return SimpleNamespace(
        bus=SimpleNamespace(receive=receive, fileno=lambda: fd, asks=False),
        link=SimpleNamespace(is_awaiting=is_awaiting, expects_data=expects_data),
        condition=SimpleNamespace(heard_ns=0),
        ordinal=0,
    )


def rest_after_a_take(
    monkeypatch: pytest.MonkeyPatch, *, latency_s: float, is_awaiting: bool = False, in_step: bool = False
) -> float:
    """What the loop is asked for after a take of TAKE_NS, s; the clock stands still otherwise."""
    clock_ns = now_ns()
    monkeypatch.setattr(data_loop, "now_ns", lambda: clock_ns)
    read, write = os.pipe()
    epoll = select.epoll()
    rests: list[float] = []

    def receive(batch: FrameBatch, ordinal: int) -> int:
        os.read(read, 1)
        return 0

    def digest(batch: FrameBatch) -> None:
        nonlocal clock_ns
        clock_ns += TAKE_NS

    async def take() -> None:
        loop = asyncio.get_running_loop()
        gather = Intake(epoll, [line], lambda: FrameBatch(64, 8), digest, latency_s)
        gather.start()
        first_rest = loop.create_future()

        def call_later(delay_s: float, call: Any) -> asyncio.TimerHandle:
            rests.append(delay_s)
            first_rest.set_result(None)
            return loop.call_at(loop.time() + 3600, call)

        monkeypatch.setattr(loop, "call_later", call_later)
        os.write(write, b".")
        await first_rest
        gather.stop()

    line = line_of(read, receive, is_awaiting=is_awaiting, expects_data=in_step)
    try:
        epoll.register(read, select.EPOLLIN)
        asyncio.run(take())
    finally:
        epoll.close()
        os.close(read)
        os.close(write)
    (rest_s,) = rests
    return rest_s


def test_the_rest_is_in_proportion_to_what_the_take_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    assert rest_after_a_take(monkeypatch, latency_s=1.0) == pytest.approx(16 * TAKE_NS / 1e9)


def test_while_an_answer_is_waited_for_it_is_shorter(monkeypatch: pytest.MonkeyPatch) -> None:
    assert rest_after_a_take(monkeypatch, latency_s=1.0, is_awaiting=True) == pytest.approx(4 * TAKE_NS / 1e9)
    rest_s = rest_after_a_take(monkeypatch, latency_s=1.0, is_awaiting=True, in_step=True)
    assert rest_s == pytest.approx(TAKE_NS / 1e9)


def test_without_a_rest_it_goes_on_looking(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where it rested before."""

    async def take() -> None:
        loop = asyncio.get_running_loop()
        gather = Intake(epoll, [line], lambda: FrameBatch(64, 8), lambda _batch: None, 1e-9)
        gather.start()

        def call_later(delay_s: float, call: Any) -> asyncio.TimerHandle:
            rests.append(delay_s)
            return loop.call_at(loop.time() + delay_s, call)

        monkeypatch.setattr(loop, "call_later", call_later)
        for latency_s in (1e-9, 1e-9, 0.0, 0.0, 0.0):
            gather.latency_s = latency_s
            os.eventfd_write(fd, 1)
            await taken.acquire()
        gather.stop()

    def receive(_batch: FrameBatch, _ordinal: int) -> int:
        os.eventfd_read(fd)
        taken.release()
        return 0

    fd, taken = os.eventfd(0), asyncio.Semaphore(0)
    rests: list[float] = []
    line = line_of(fd, receive)
    with select.epoll() as epoll:
        epoll.register(fd, select.EPOLLIN)
        asyncio.run(take())
    os.close(fd)
    assert rests == [1e-9, 1e-9]


def test_none_of_its_looks_outlives_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a new generation starts it again while it rests."""
    looks: list[asyncio.TimerHandle] = []

    async def take() -> None:
        loop = asyncio.get_running_loop()
        gather = Intake(epoll, [line], lambda: FrameBatch(64, 8), lambda _batch: None, 1.0)
        rested = asyncio.Event()

        def call_later(_delay_s: float, call: Any) -> asyncio.TimerHandle:
            looks.append(loop.call_at(loop.time() + 3600, call))
            rested.set()
            return looks[-1]

        monkeypatch.setattr(loop, "call_later", call_later)
        for _ in range(2):
            gather.start()
            os.eventfd_write(fd, 1)
            await rested.wait()
            rested.clear()
        gather.stop()

    def receive(_batch: FrameBatch, _ordinal: int) -> int:
        os.eventfd_read(fd)
        return 0

    fd = os.eventfd(0)
    line = line_of(fd, receive)
    with select.epoll() as epoll:
        epoll.register(fd, select.EPOLLIN)
        asyncio.run(take())
    os.close(fd)
    assert [look.cancelled() for look in looks] == [True, True]


def test_a_wake_up_ends_in_time_however_much_waits() -> None:
    """Between two of them come signals, timers and handshakes."""
    clock_ns = now_ns()
    taken = 0

    def receive(batch: FrameBatch, ordinal: int) -> int:
        nonlocal taken
        taken += 1
        batch.stop = batch.limit
        return 64

    def digest(batch: FrameBatch) -> None:
        nonlocal clock_ns
        clock_ns += 15_000_000

    fd = os.eventfd(1)
    bus, condition = SimpleNamespace(receive=receive, fileno=lambda: fd), SimpleNamespace(heard_ns=0)
    line: Any = SimpleNamespace(bus=bus, condition=condition, ordinal=0)
    with select.epoll() as epoll, pytest.MonkeyPatch.context() as patch:
        patch.setattr(data_loop, "now_ns", lambda: clock_ns)
        epoll.register(fd, select.EPOLLIN)
        assert Intake(epoll, [line], lambda: FrameBatch(64, 8), digest, 0.0).take() == "some"
    os.close(fd)
    assert taken == 2


@pytest.mark.parametrize(("first_ns", "first_told_ns"), [(-100, -100 + 63 - 1), (+50, 0)], ids=["late", "early"])
def test_it_says_until_when_all_was_taken(first_ns: int, first_told_ns: int) -> None:
    clock_ns = 1_000_000_000
    waiting = [*range(clock_ns + first_ns, clock_ns + first_ns + 100)]  # stamps; a bus's clock may be ahead

    def receive(batch: FrameBatch, ordinal: int) -> int:
        n = min(batch.free, len(waiting))
        for _ in range(n):
            batch.append(ordinal, waiting.pop(0), 0x100, bytes(8))
        if not waiting:
            os.eventfd_read(fd)
        return n

    def digest(_batch: FrameBatch) -> None:
        nonlocal clock_ns
        told.append(gather.read_until_ns)
        clock_ns += 500  # what comes meanwhile nobody has seen

    fd = os.eventfd(1, os.EFD_NONBLOCK)
    told: list[int] = []
    bus, condition = SimpleNamespace(receive=receive, fileno=lambda: fd), SimpleNamespace(heard_ns=0)
    line: Any = SimpleNamespace(bus=bus, condition=condition, ordinal=0)
    with select.epoll() as epoll, pytest.MonkeyPatch.context() as patch:
        patch.setattr(data_loop, "now_ns", lambda: clock_ns)
        epoll.register(fd, select.EPOLLIN)
        gather = Intake(epoll, [line], lambda: FrameBatch(64, 8), digest, 0.0)
        assert gather.take() == "all"
        assert told == [1_000_000_000 + first_told_ns, 1_000_000_500]
        assert gather.take() == "nothing"
        assert gather.read_until_ns == 1_000_001_000
    os.close(fd)


@pytest.mark.parametrize("latency_s", [1e-4, 1e-3])
def test_it_is_never_longer_than_what_was_asked_for(monkeypatch: pytest.MonkeyPatch, latency_s: float) -> None:
    assert rest_after_a_take(monkeypatch, latency_s=latency_s) == latency_s


def test_a_driver_shortens_the_turns_of_others_while_it_runs() -> None:
    before_s = sys.getswitchinterval()
    with driving(emulated(boards=(7,))), DriverReader("roboskin", timeout_s=30) as reader:
        reader.read(timeout_s=30)
        assert sys.getswitchinterval() == pytest.approx(TURN_S, abs=3e-6)
    assert sys.getswitchinterval() == pytest.approx(before_s, abs=3e-6)
