"""Fail a test in words, at once or after waiting in real time for a condition, without a fixed sleep."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import NoReturn

import numpy as np
import pytest

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ServiceTimeout
from skinware.samples import sample_report, sample_text
from skinware.status import Status

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


def wait_until(condition: Callable[[], bool], deadline_s: float = 30.0) -> None:
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
