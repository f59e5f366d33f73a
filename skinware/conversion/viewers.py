"""What viewers are shown of several drivers, live or of a recording, not more often than they can show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from skinware.conversion.showing import Message, Showing
from skinware.driver_snapshot import DriverSnapshot
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S
from skinware.structure import Structure
from skinware.transfer.generation import Generation

RATE_HZ = 30.0


@dataclass
class _Driver:
    """One that is shown.

    Attributes:
        generation: that is shown.
        showing: of it.
        due_ns: when the next frame is due, wall clock.
    """

    generation: Generation
    showing: Showing
    due_ns: int = 0


class Viewers:
    """Messages for viewers, beside the frames that they are made of.

    Args:
        json_state: as for :class:`Showing`.
        rate_hz: of each driver, at most.
    """

    def __init__(self, *, json_state: bool = True, rate_hz: float = RATE_HZ) -> None:
        self._json_state, self._period_ns = json_state, round(NS_PER_S / rate_hz)
        self._drivers: dict[str, _Driver] = {}

    def messages(self, service: str, generation: Generation, frame: Sample, time_ns: int) -> Iterator[Message]:
        """What is shown of a frame, if it is time for one.

        Args:
            service: whose frame.
            generation: of it.
            frame: it.
            time_ns: when it was published, wall clock.
        """
        if not isinstance(generation.context, Structure):
            return
        driver = self._drivers.get(service)
        if driver is None or driver.generation is not generation:
            showing = Showing(service, generation.context, json_state=self._json_state)
            driver = self._drivers[service] = _Driver(generation, showing, 0 if driver is None else driver.due_ns)
        if time_ns < driver.due_ns:
            return
        driver.due_ns = max(driver.due_ns + self._period_ns, time_ns + self._period_ns // 2)
        yield from driver.showing.messages(DriverSnapshot(generation, frame.slot), time_ns)
