"""Waiting for what is to come, in real time: never a fixed sleep."""

from __future__ import annotations

import time
from collections.abc import Callable

from skinware.driver_service import DriverFrame, DriverReader
from skinware_drivers.testing.defect import defect, require


def wait_until(condition: Callable[[], bool], deadline_s: float = 30.0) -> None:
    """Wait for a condition; fails the test if it does not come true in time."""
    end = time.monotonic() + deadline_s
    while not condition():
        require(time.monotonic() < end, f"not within {deadline_s:g} s: {condition}")
        time.sleep(0.005)


def read_until(reader: DriverReader, condition: Callable[[DriverFrame], bool], frames: int = 1200) -> DriverFrame:
    """The first frame that fulfils a condition; fails the test if none of so many does."""
    for count, frame in enumerate(reader.in_order(timeout_s=30)):
        if condition(frame):
            return frame
        require(count < frames, f"none of {frames} frames fulfils the condition {condition}")
    return defect("the driver ended")


__all__ = ["read_until", "wait_until"]
