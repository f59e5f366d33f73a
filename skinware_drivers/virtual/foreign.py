"""Frames of other devices on the bus: a skin driver has to let them pass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skinware_drivers.virtual import events
from skinware_drivers.virtual.hardware import EventLog
from skinware_drivers.virtual.wire import Transmission, Transmitter


class ForeignTraffic:
    """Devices that send at random moments, ``rate_hz`` frames a second on average.

    Args:
        identifiers: of their frames.
        rate_hz: more than 0.
        random: all chance comes from here.
        transmitter: place on the wire.
        log: takes the events.
        counts: totals, of which ``foreign`` is counted.
        now_ns: when the devices begin.
    """

    def __init__(
        self,
        identifiers: Sequence[int],
        rate_hz: float,
        random: np.random.Generator,
        transmitter: Transmitter,
        log: EventLog,
        counts: dict[str, int],
        now_ns: int,
    ) -> None:
        self._random = random
        self._pause_ns = 1e9 / rate_hz
        self._transmitter, self._log, self._counts = transmitter, log, counts
        self._identifiers = identifiers
        self._next_ns = now_ns
        self._wait()

    def _wait(self) -> None:
        self._next_ns += 1 + int(self._random.exponential(self._pause_ns))

    def next_event_ns(self) -> int:
        return self._next_ns

    def run(self, now_ns: int) -> None:
        while self._next_ns <= now_ns:
            identifier = self._identifiers[int(self._random.integers(len(self._identifiers)))]
            payload = self._random.bytes(int(self._random.integers(0, 8, endpoint=True)))
            self._transmitter.queue.append(Transmission(self._next_ns, [identifier], [payload]))
            self._counts["foreign"] += 1
            self._log.append(events.ForeignFrame(time_ns=self._next_ns, identifier=identifier, length=len(payload)))
            self._wait()

    def skip_to(self, now_ns: int) -> int:
        """Leave out what is due before ``now_ns``; returns how many frames that would have been, on average."""
        missed_ns = now_ns - self._next_ns
        if missed_ns <= 0:
            return 0
        self._next_ns = now_ns
        return 1 + int(missed_ns / self._pause_ns)
