"""Fail a test in words, at once or after waiting for a condition, in real time or in that of a ``HandClock``."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Coroutine
from typing import Any, NoReturn, TypeVar

import numpy as np
import pytest

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ServiceTimeout
from skinware.status import Status, sample_report, sample_text
from skinware_drivers.virtual.hand_clock import HandClock, HandLoop, NeverEnds, package_on

SLOWER = float(os.environ.get("SKINWARE_TEST_PATIENCE") or (4 if os.environ.get("SKINWARE_CAN_LAB") == "1" else 1))
"""Factor for the waiting times of tests in real time; the CAN lab has an emulated processor."""
PATIENCE_S = 12.0 * SLOWER
"""Longest time to wait for a snapshot, unless a test gives another."""


def defect(what: str) -> NoReturn:
    """Fail the test with a message that names the defect and the place to look at."""
    pytest.fail(what, pytrace=False)


def require(condition: object, what: str) -> None:
    """Fail the test unless a condition holds."""
    if not condition:
        defect(what)


def wait_until(condition: Callable[[], bool], deadline_s: float = 30.0 * SLOWER) -> None:
    """Wait for a condition; fail the test if it does not come true in time."""
    end = time.monotonic() + deadline_s
    while not condition():
        require(time.monotonic() < end, f"not within {deadline_s:g} s: {condition}")
        time.sleep(0.005)


def read_until(
    reader: DriverReader,
    condition: Callable[[DriverSnapshot], bool],
    within_s: float = PATIENCE_S,
) -> DriverSnapshot:
    """Return the first snapshot that fulfils a condition; if none does in time, fail with the state of the last one.

    Args:
        within_s: longest time to wait, s.
    """
    end, last, count = time.monotonic() + within_s, None, 0
    try:
        for frame in reader.in_order(timeout_s=within_s):
            if condition(frame):
                return frame
            last, count = frame, count + 1
            if time.monotonic() > end:
                break
        else:
            return defect("the driver ended")
    except ServiceTimeout:
        pass
    seen = f"; {_in_words(reader, last)}" if last is not None else ""
    return defect(f"none of the {count} frames of {within_s:g} s fulfils the condition {condition}{seen}")


def _in_words(reader: DriverReader, frame: DriverSnapshot) -> str:
    parts = [f"in the last, {np.count_nonzero(frame.status == 0)} of {len(frame.status)} sensors are fresh"]
    parts += [f"{n} {bit.name}" for bit in Status if (n := np.count_nonzero(frame.status & np.uint8(bit)))]
    for bus, counters in enumerate(reader.bus_counters(frame)):
        names = ("errors", "refused", "unknown", "bad_length", "bad_content", "polls_unanswered")
        parts += [f"{name.replace('_', ' ')}: {counters[name]}" for name in names if counters.get(name)]
        samples = [sample_text(sample) for sample in sample_report(frame.bus_samples[bus])]
        parts += [f"for example {', '.join(samples)}"] if samples else []
    return ", ".join(parts)


T = TypeVar("T")

_EXPAND_LOG = logging.getLogger("skinware.driver.expand")
"""Receives the exceptions of a driver's code that the package caught."""
_LOOKS_A_SECOND = 50
_ASLEEP_LOOKS = 40
"""Number of looks in a row at which the loop's thread sleeps in the same turn, from which it is called blocked."""
_LONGEST_TURN_S = 10.0
"""Longest turn of the loop in processor time."""
_EXPLAINED = (pytest.fail.Exception, NeverEnds)
"""Exceptions whose message is the explanation."""


def run_in_its_time(clock: HandClock, main: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Run a coroutine in an event loop of the clock's time, in its own thread.

    The test fails if it raises an exception, blocks, never ends, or leaves a task; the message says which.
    """
    outcome: list[T] = []
    failures: list[BaseException] = []
    unseen: list[str] = []

    def note(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if isinstance(error, _EXPLAINED):
            failures.append(error)
        elif not failures:
            trace = _short_trace(error) if error is not None else str(context["message"])
            unseen.append(f"the driver raised an exception in the event loop, where nothing catches it:\n{trace}")

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
            with package_on(clock), asyncio.Runner(loop_factory=lambda: HandLoop(clock)) as runner:
                outcome.append(runner.run(scenario()))
        except BaseException as error:  # noqa: BLE001  (raised again in the test's own thread)
            failures.append(error)

    thread = threading.Thread(target=work, name="driver under test", daemon=True)  # one that hangs must not hang pytest

    def keep(record: logging.LogRecord) -> bool:
        unseen.append(record.getMessage())
        return True

    _EXPAND_LOG.addFilter(keep)
    try:
        thread.start()
        _watch(thread, clock)
    finally:
        _EXPAND_LOG.removeFilter(keep)
    if unseen:
        defect(unseen[0])
    if failures:
        # only its text: a traceback would keep alive everything that the test must release
        error = failures.pop()
        what = str(error) if isinstance(error, _EXPLAINED) else f"it raised\n{_short_trace(error)}"
        del error
        defect(what)
    return outcome[0]


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
    """Return whether a thread sleeps in the kernel, and the processor time that it has used, s."""
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
