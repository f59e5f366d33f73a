"""Time that passes only when nothing is left to be done: a driver of minutes runs in a moment, always the same way.

:class:`HandClock` is the time. :func:`run_in_its_time` runs a coroutine in an event loop of that time: timers, sleeps
and the time stamps of the whole package follow it. Whenever the loop would sleep, the clock jumps to the moment at
which the next thing happens. What blocks instead of waiting, or waits for what can never come, is found and named.
"""

from __future__ import annotations

import asyncio
import logging
import os
import selectors
import sys
import threading
import time
import traceback
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import pytest

import skinware.realtime
from skinware_drivers.testing.defect import defect

T = TypeVar("T")

_EXPAND_LOG = logging.getLogger("skinware.driver.expand")
"""Where exceptions are told that the package caught from a driver's code."""
_BEGINNING_NS = 5_000_000_000_000
_TURNS_AT_ONE_MOMENT = 20_000
_NAPS_WITHOUT_TIMER = 40
_NAP_S = 0.05
_LOOKS_A_SECOND = 50
_ASLEEP_LOOKS = 40
"""So often in a row the loop's thread must be found asleep in the same turn to be called blocked."""
_LONGEST_TURN_S = 10.0
"""Of processor time."""


class HandClock:
    """CLOCK_MONOTONIC as a test has it, ns. Called, it tells the time.

    Attributes:
        now_ns: the time.
        before_passing: called before every jump: everything of this moment has happened.
        turns: of the event loop so far.
    """

    def __init__(self) -> None:
        self.now_ns: int = _BEGINNING_NS
        self.before_passing: list[Callable[[], object]] = []
        self.turns = 0
        self._timers: set[HandTimer] = set()

    def __call__(self) -> int:
        """The time."""
        return self.now_ns

    @property
    def now_s(self) -> float:
        """Seconds since the beginning."""
        return (self.now_ns - _BEGINNING_NS) / 1e9

    def timer(self) -> HandTimer:
        """A descriptor that becomes readable at a moment of this clock."""
        timer = HandTimer(self)
        self._timers.add(timer)
        return timer

    def forget(self, timer: HandTimer) -> None:
        """Called by a timer that is closed."""
        self._timers.discard(timer)

    def next_timer_ns(self) -> int | None:
        """When the next of the timers will be due. Those that are due already are their readers' affair."""
        due_ns = [timer.due_ns for timer in self._timers if timer.due_ns is not None and timer.due_ns > self.now_ns]
        return min(due_ns, default=None)

    def pass_to(self, time_ns: int) -> None:
        """Let time pass."""
        for action in self.before_passing:
            action()
        self.now_ns = max(self.now_ns, time_ns)
        for timer in list(self._timers):
            timer.look()


class HandTimer:
    """What :class:`skinware_drivers.virtual.timer.MonotonicTimer` is, for a :class:`HandClock`."""

    def __init__(self, clock: HandClock) -> None:
        self._clock = clock
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._is_readable = False
        self.due_ns: int | None = None

    def fileno(self) -> int:
        """The descriptor; -1 once closed."""
        return self._fd

    def wake_at(self, time_ns: int | None) -> None:
        """Make the descriptor readable at ``time_ns``, and not before."""
        self.due_ns = time_ns
        self.look()

    def look(self) -> None:
        """Whether it is time."""
        due = self.due_ns is not None and self.due_ns <= self._clock.now_ns
        if due and not self._is_readable:
            os.eventfd_write(self._fd, 1)
        elif self._is_readable and not due:
            os.eventfd_read(self._fd)
        self._is_readable = due

    def close(self) -> None:
        """Give the descriptor back. Idempotent."""
        if self._fd >= 0:
            self._clock.forget(self)
            os.close(self._fd)
            self._fd = -1


class _PassingTime(selectors.EpollSelector):
    """Where the event loop would sleep, time passes instead."""

    def __init__(self, clock: HandClock) -> None:
        super().__init__()
        self._clock = clock
        self._turns_now = 0
        self._naps = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """What is ready, after time has passed until something is."""
        self._clock.turns += 1
        self._turns_now += 1
        if self._turns_now > _TURNS_AT_ONE_MOMENT:
            defect("the driver loops without end and without a wait (await link.sleep)")
        ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0):
            return ready
        moments = [] if timeout is None else [self._clock.now_ns + max(1, round(timeout * 1e9))]
        timer_ns = self._clock.next_timer_ns()
        if timer_ns is not None:
            moments.append(timer_ns)
        if not moments:  # only another thread can go on
            self._naps += 1
            if self._naps > _NAPS_WITHOUT_TIMER:
                defect("the driver waits indefinitely: give the wait a timeout")
            return super().select(_NAP_S)
        self._turns_now = self._naps = 0
        self._clock.pass_to(min(moments))
        return super().select(0)


class _Loop(asyncio.SelectorEventLoop):
    def __init__(self, clock: HandClock) -> None:
        self._hand_clock = clock
        super().__init__(_PassingTime(clock))

    def time(self) -> float:
        """As the clock says, s."""
        return self._hand_clock.now_ns / 1e9


@contextmanager
def package_on(clock: HandClock) -> Iterator[None]:
    """Everything that asks ``skinware.realtime.now_ns`` gets the time of a clock; ``time.sleep`` is a defect."""
    real_now_ns, real_sleep, thread = skinware.realtime.now_ns, time.sleep, threading.get_ident()
    users = [module for module in sys.modules.values() if vars(module).get("now_ns") is real_now_ns]

    def sleep(seconds: Any) -> None:
        if threading.get_ident() != thread:
            real_sleep(seconds)
            return
        where = traceback.extract_stack(limit=2)[0]
        defect(
            f"the driver blocks: {where.filename}:{where.lineno}, in {where.name}, calls time.sleep({seconds:g}):"
            " nothing is read from any bus meanwhile; write `await link.sleep(...)`"
        )

    try:
        for module in users:
            vars(module)["now_ns"] = clock
        time.sleep = sleep
        yield
    finally:
        time.sleep = real_sleep
        for module in users:
            vars(module)["now_ns"] = real_now_ns


def run_in_its_time(clock: HandClock, main: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Run a coroutine in an event loop of a clock's time, in a thread of its own, and find what blocks it.

    Raises:
        Failed: it raised something, blocks, never ends, or leaves a task behind; the message says what.
    """
    outcome: list[T] = []
    failures: list[BaseException] = []
    unseen: list[str] = []

    def note(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if isinstance(error, pytest.fail.Exception):
            failures.append(error)
        elif not failures:
            trace = _short_trace(error) if error is not None else str(context["message"])
            unseen.append(f"the driver raised an exception in the event loop, where nobody catches it:\n{trace}")

    async def scenario() -> T:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(note)
        result = await main()
        left = asyncio.all_tasks() - {asyncio.current_task()}
        if left:
            names = ", ".join(sorted(str(getattr(task.get_coro(), "__qualname__", task)) for task in left))
            defect(f"a task was left running at the end: {names}; cancel it in stop, or await it")
        return result

    def work() -> None:
        try:
            with package_on(clock), asyncio.Runner(loop_factory=lambda: _Loop(clock)) as runner:
                outcome.append(runner.run(scenario()))
        except BaseException as error:  # noqa: BLE001  (raised again in the test's own thread)
            failures.append(error)

    thread = threading.Thread(target=work, name="driver under test", daemon=True)  # one that hangs must not hang pytest
    told = _Told(unseen)
    _EXPAND_LOG.addHandler(told)
    try:
        thread.start()
        _watch(thread, clock)
    finally:
        _EXPAND_LOG.removeHandler(told)
    if unseen:
        defect(unseen[0])
    if failures:
        # told anew: the trace of the first would keep everything alive that the test has to look after
        error = failures.pop()
        what = str(error) if isinstance(error, pytest.fail.Exception) else f"it raised\n{_short_trace(error)}"
        del error
        defect(what)
    return outcome[0]


class _Told(logging.Handler):
    """Writes down the messages of a log."""

    def __init__(self, messages: list[str]) -> None:
        super().__init__()
        self._messages = messages

    def emit(self, record: logging.LogRecord) -> None:
        self._messages.append(record.getMessage())


def _watch(thread: threading.Thread, clock: HandClock) -> None:
    """Wait for a thread whose loop should never block."""
    turn, asleep, since_s = -1, 0, 0.0
    while True:
        thread.join(1 / _LOOKS_A_SECOND)
        if not thread.is_alive():
            return
        if clock.turns != turn:
            turn, asleep, since_s = clock.turns, 0, _look_at(thread)[1]
            continue
        is_asleep, used_s = _look_at(thread)
        asleep = asleep + 1 if is_asleep else 0
        if asleep > _ASLEEP_LOOKS:
            defect(f"the driver blocks, nothing is read from any bus meanwhile; it hangs here:\n{_where(thread)}")
        if used_s - since_s > _LONGEST_TURN_S:
            defect(f"the driver loops without end, here:\n{_where(thread)}")


def _look_at(thread: threading.Thread) -> tuple[bool, float]:
    """Whether the kernel says that it waits for something, rather than for a processor; and what it used of one, s."""
    try:
        with open(f"/proc/self/task/{thread.native_id}/stat") as file:
            state, *numbers = file.read().rpartition(")")[2].split()
    except OSError:
        return False, 0.0
    return state == "S", (int(numbers[10]) + int(numbers[11])) / os.sysconf("SC_CLK_TCK")


def _where(thread: threading.Thread) -> str:
    frame = sys._current_frames().get(thread.ident or -1)  # noqa: SLF001 - there is no other way
    return "".join(traceback.format_stack(frame, limit=8)[-4:]) if frame is not None else "(already gone)"


def _short_trace(error: BaseException) -> str:
    return "".join(traceback.format_exception(error)[-5:])


__all__ = ["HandClock", "HandTimer", "package_on", "run_in_its_time"]
