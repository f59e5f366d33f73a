"""Reading a service until it shows what is waited for."""

from __future__ import annotations

from collections.abc import Callable

from skinware.memory.ring import SampleT
from skinware.service import ServiceReader
from skinware_drivers.testing.waiting import wait_until


def read_until(reader: ServiceReader[SampleT], condition: Callable[[SampleT], bool]) -> SampleT:
    """The first of the newest frames that fulfils a condition."""
    found: list[SampleT] = []

    def look() -> bool:
        frame = reader.read(timeout_s=10)
        if condition(frame):
            found.append(frame)
        return bool(found)

    wait_until(look)
    return found[0]
