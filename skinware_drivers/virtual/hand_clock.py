"""Timers of CLOCK_MONOTONIC (timerfd), and a clock for tests that passes only when nothing is left to do."""

from __future__ import annotations

import asyncio
import ctypes
import os
import selectors
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import skinware.realtime
from skinware.errors import PlatformError
from skinware.memory.futex import Timespec

_CLOCK_MONOTONIC = 1
_TFD_NONBLOCK, _TFD_CLOEXEC = os.O_NONBLOCK, os.O_CLOEXEC
_TFD_TIMER_ABSTIME = 1


class _Itimerspec(ctypes.Structure):
    _fields_ = (("it_interval", Timespec), ("it_value", Timespec))


class MonotonicTimer:
    """An open timer that does not run."""

    def __init__(self) -> None:
        # PyDLL: the calls never block, so they need not let go of the interpreter lock and wait for it again
        libc = ctypes.PyDLL(None, use_errno=True)
        try:
            create, self._settime = libc.timerfd_create, libc.timerfd_settime
        except AttributeError:
            raise PlatformError("this system has no timerfd, which emulated buses need: use Linux") from None
        self._fd: int = create(_CLOCK_MONOTONIC, _TFD_NONBLOCK | _TFD_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), f"timerfd_create: {os.strerror(ctypes.get_errno())}")
        self._spec = _Itimerspec()

    def fileno(self) -> int:
        return self._fd

    def wake_at(self, time_ns: int | None) -> None:
        """Make the descriptor readable at ``time_ns`` (at once if that is past), and not readable before.

        Args:
            time_ns: CLOCK_MONOTONIC ns; None for never.
        """
        value = self._spec.it_value
        value.seconds, value.nanoseconds = (0, 0) if time_ns is None else divmod(max(time_ns, 1), 1_000_000_000)
        if self._settime(self._fd, _TFD_TIMER_ABSTIME, ctypes.byref(self._spec), None) < 0:
            raise OSError(ctypes.get_errno(), f"timerfd_settime: {os.strerror(ctypes.get_errno())}")

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class MonotonicClock:
    def __call__(self) -> int:
        return time.monotonic_ns()

    def timer(self) -> Timer:
        return MonotonicTimer()


REAL_CLOCK = MonotonicClock()

_BEGINNING_NS = 5_000_000_000_000
_TURNS_AT_ONE_MOMENT = 20_000
_NAPS_WITHOUT_TIMER = 40
_NAP_S = 0.05


class NeverEnds(BaseException):
    """A driver blocks, loops without end, or waits for an event that cannot come: such time never passes.

    The message gives the cause and the remedy. It is no :class:`Exception`, so that no code of a driver catches it.
    """


class HandClock:
    """CLOCK_MONOTONIC of a test, ns. A call returns the time.

    Attributes:
        before_passing: called before every jump, when everything of this moment has happened.
    """

    def __init__(self) -> None:
        self.now_ns: int = _BEGINNING_NS
        self.before_passing: list[Callable[[], object]] = []
        self.turns = 0
        self.timers: set[HandTimer] = set()

    def __call__(self) -> int:
        return self.now_ns

    @property
    def now_s(self) -> float:
        """Seconds since the beginning."""
        return (self.now_ns - _BEGINNING_NS) / 1e9

    def timer(self) -> HandTimer:
        timer = HandTimer(self)
        self.timers.add(timer)
        return timer

    def pass_to(self, time_ns: int) -> None:
        for action in self.before_passing:
            action()
        self.now_ns = max(self.now_ns, time_ns)
        for timer in list(self.timers):
            timer.look()


class HandTimer:
    def __init__(self, clock: HandClock) -> None:
        self._clock = clock
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._is_readable = False
        self.due_ns: int | None = None

    def fileno(self) -> int:
        return self._fd

    def wake_at(self, time_ns: int | None) -> None:
        self.due_ns = time_ns
        self.look()

    def look(self) -> None:
        due = self.due_ns is not None and self.due_ns <= self._clock.now_ns
        if due and not self._is_readable:
            os.eventfd_write(self._fd, 1)
        elif self._is_readable and not due:
            os.eventfd_read(self._fd)
        self._is_readable = due

    def close(self) -> None:
        if self._fd >= 0:
            self._clock.timers.discard(self)
            os.close(self._fd)
            self._fd = -1


Timer = MonotonicTimer | HandTimer
"""A descriptor that becomes readable at a moment."""
Clock = MonotonicClock | HandClock
"""CLOCK_MONOTONIC, or the time of a test. A call returns ns."""


class _PassingTime(selectors.EpollSelector):
    def __init__(self, clock: HandClock) -> None:
        super().__init__()
        self._clock = clock
        self._turns_now = 0
        self._naps = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self._clock.turns += 1
        self._turns_now += 1
        if self._turns_now > _TURNS_AT_ONE_MOMENT:
            raise NeverEnds("the driver loops without end and without a wait (await link.sleep)")
        ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0):
            return ready
        now_ns, due_ns = self._clock.now_ns, [timer.due_ns for timer in self._clock.timers]
        moments = [time_ns for time_ns in due_ns if time_ns is not None and time_ns > now_ns]
        if timeout is not None:
            moments.append(now_ns + max(1, round(timeout * 1e9)))
        if not moments:  # only another thread can continue
            self._naps += 1
            if self._naps > _NAPS_WITHOUT_TIMER:
                raise NeverEnds("the driver waits indefinitely: give the wait a timeout")
            return super().select(_NAP_S)
        self._turns_now = self._naps = 0
        self._clock.pass_to(min(moments))
        return super().select(0)


class HandLoop(asyncio.SelectorEventLoop):
    def __init__(self, clock: HandClock) -> None:
        self._hand_clock = clock
        super().__init__(_PassingTime(clock))

    def time(self) -> float:
        return self._hand_clock.now_ns / 1e9


@contextmanager
def package_on(clock: HandClock) -> Iterator[None]:
    """Let ``skinware.realtime.now_ns`` return the time of a clock everywhere, and ``time.sleep`` raise."""
    real_now_ns, real_sleep, thread = skinware.realtime.now_ns, time.sleep, threading.get_ident()
    users = [module for module in sys.modules.values() if vars(module).get("now_ns") is real_now_ns]

    def sleep(seconds: Any) -> None:
        if threading.get_ident() != thread:
            real_sleep(seconds)
            return
        where = traceback.extract_stack(limit=2)[0]
        raise NeverEnds(
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
