"""Carry emulated CAN frames one at a time, lowest identifier first, beside frames of other devices."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from skinware_drivers.virtual.events import Event
from skinware_drivers.virtual.hardware import EventLog, WireFrame

_EXTENDED_FLAG = 0x8000_0000
_BIT_NS, _NS_PER_S = 1000, 1_000_000_000
"""1 Mbit/s (icub-main:src/libraries/icubmod/canBusSkin/CanBusSkin.cpp)."""

_wire_frame = partial(tuple.__new__, WireFrame)
"""Make a WireFrame of a tuple at a third of the cost."""


def frame_time_ns(identifier: int, length: int) -> int:
    """Return how long a frame occupies the wire at 1 Mbit/s, with an ordinary number of stuff bits (ISO 11898-1).

    A frame of eight bytes with an 11-bit identifier takes 130 us.
    """
    overhead, stuffed = (67, 54) if identifier & _EXTENDED_FLAG else (47, 34)
    return (overhead + 8 * length + (stuffed + 8 * length - 1) // 5) * _BIT_NS


_USUAL_NS = frame_time_ns(0, 8)


@dataclass(slots=True)
class Transmission:
    """Frames that a device hands to its controller together.

    Attributes:
        ready_ns: when the first of them can go.
        identifiers: of each frame.
        payloads: of each frame.
        lost: positions of frames that take their time on the wire without being heard.
        usual: all have 8 bytes and 11-bit identifiers.
        cycle: number of the burst; -1 if this is none.
        sent: frames that have gone.
    """

    ready_ns: int
    identifiers: Sequence[int]
    payloads: Sequence[bytes]
    lost: Collection[int] = ()
    usual: bool = False
    cycle: int = -1
    sent: int = 0

    def __len__(self) -> int:
        return len(self.identifiers) - self.sent


class Wire:
    """The wire that the queues of all devices share.

    Attributes:
        heard: frames that went over the wire and were not fetched yet, oldest first.
        speed: in Mbit/s.
    """

    def __init__(self) -> None:
        self.speed = 1
        self._queues: list[deque[Transmission]] = []
        self.heard: list[WireFrame] = []
        self._free_ns = 0
        self._busy_ns = 0

    @property
    def bit_rate(self) -> int:
        return self.speed * _NS_PER_S // _BIT_NS

    @property
    def bits(self) -> float:
        return self._busy_ns * self.speed / _BIT_NS

    def attach(self) -> deque[Transmission]:
        """Return the queue of a new device."""
        queue: deque[Transmission] = deque()
        self._queues.append(queue)
        return queue

    def next_start_ns(self) -> int | None:
        """Return the time at which the next frame begins; None while none waits."""
        ready_ns = [queue[0].ready_ns for queue in self._queues if queue]
        return max(self._free_ns, min(ready_ns)) if ready_ns else None

    def run(self, until_ns: int) -> None:
        """Send the frames that begin before ``until_ns``, assuming that no more are queued."""
        while True:
            waiting = [queue for queue in self._queues if queue]
            if not waiting:
                return
            start_ns = max(self._free_ns, min([queue[0].ready_ns for queue in waiting]))
            if start_ns >= until_ns:
                return
            contenders = [queue for queue in waiting if queue[0].ready_ns <= start_ns]
            if len(contenders) > 1:
                contenders.sort(key=_next_in_arbitration)
            queue = contenders[0]
            others_ns = [other[0].ready_ns for other in waiting if other is not queue]
            self._send(queue[0], start_ns, min([until_ns, *others_ns]))
            if not queue[0]:
                queue.popleft()

    def _send(self, transmission: Transmission, start_ns: int, until_ns: int) -> None:
        identifiers, payloads, first = transmission.identifiers, transmission.payloads, transmission.sent
        starts: Sequence[int]
        if transmission.usual:
            count = min(len(transmission), max(1, -((start_ns - until_ns) // _USUAL_NS)))
            end_ns = start_ns + count * _USUAL_NS
            starts = range(start_ns, end_ns, _USUAL_NS)
        else:
            starts, end_ns = [], start_ns
            while (not starts or end_ns < until_ns) and len(starts) < len(transmission):
                at = first + len(starts)
                starts.append(end_ns)
                end_ns += frame_time_ns(identifiers[at], len(payloads[at])) // self.speed
        self._busy_ns += end_ns - start_ns
        self._free_ns = end_ns
        transmission.sent = last = first + len(starts)
        frames = list(map(_wire_frame, zip(starts, identifiers[first:last], payloads[first:last], strict=True)))
        if transmission.lost:
            frames = [frame for at, frame in enumerate(frames, first) if at not in transmission.lost]
        self.heard += frames


def _next_in_arbitration(queue: deque[Transmission]) -> int:
    """Return a key that sorts as the wire does: by 11 bits first, then a standard frame before an extended one."""
    transmission = queue[0]
    identifier = transmission.identifiers[transmission.sent]
    if identifier & _EXTENDED_FLAG:
        return (identifier & 0x1FFF_FFFF) << 1 | 1
    return identifier << 19


class ForeignTraffic:
    """Other devices, which send at random moments, ``rate_hz`` frames a second on average.

    Args:
        rate_hz: more than 0.
        counts: totals, of which ``foreign`` is counted.
        now_ns: when the devices begin.
    """

    def __init__(
        self,
        identifiers: Sequence[int],
        rate_hz: float,
        random: np.random.Generator,
        queue: deque[Transmission],
        log: EventLog,
        counts: dict[str, int],
        now_ns: int,
    ) -> None:
        self._random = random
        self._pause_ns = 1e9 / rate_hz
        self._queue, self._log, self._counts = queue, log, counts
        self._identifiers = identifiers
        self.next_event_ns = now_ns
        self._wait()

    def _wait(self) -> None:
        self.next_event_ns += 1 + int(self._random.exponential(self._pause_ns))

    def run(self, now_ns: int) -> None:
        while self.next_event_ns <= now_ns:
            identifier = self._identifiers[int(self._random.integers(len(self._identifiers)))]
            payload = self._random.bytes(int(self._random.integers(0, 8, endpoint=True)))
            self._queue.append(Transmission(self.next_event_ns, [identifier], [payload]))
            self._counts["foreign"] += 1
            self._log.append(Event("foreign_frame", self.next_event_ns, identifier=identifier, length=len(payload)))
            self._wait()

    def skip_to(self, now_ns: int) -> int:
        """Leave out what is due before ``now_ns``; return how many frames that would have been, on average."""
        missed_ns = now_ns - self.next_event_ns
        if missed_ns <= 0:
            return 0
        self.next_event_ns = now_ns
        return 1 + int(missed_ns / self._pause_ns)
