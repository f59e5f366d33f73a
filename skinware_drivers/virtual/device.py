"""One emulated device, the options that every emulator has, and the wire that carries what devices send."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from skinware_drivers.options import Options
from skinware_drivers.virtual.hardware import Event, EventLog, WireFrame

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
    return (identifier & 0x7FF) << 19


class ForeignTraffic:
    """Other devices, which send at random moments, ``rate_hz`` frames a second on average.

    Args:
        rate_hz: more than 0.
        counts: totals, of which ``foreign`` is counted.
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


Probability = Annotated[float, Meta(ge=0, le=1)]
Seconds = Annotated[float, Meta(ge=0)]
Count = Annotated[int, Meta(ge=0)]

DATA = "data"
"""The timer of a device's bursts."""


class EmulatorOptions(Options, frozen=True):
    """Touch and faults; an emulator adds options for its devices."""

    pattern: Annotated[
        Literal["touch", "idle", "cycle"],
        Meta(description="input: a finger that presses here and there, nothing, or each burst's number in every value"),
    ] = "touch"
    calm_s: Annotated[Seconds, Meta(description="seconds without touch at the start")] = 0.0
    seed: Annotated[Count, Meta(description="seed of the touch and of the random faults")] = 0
    streaming: Annotated[bool, Meta(description="send from power-up, as if a host had started the devices")] = False

    world: Annotated[
        str, Meta(description="physics that presses the devices, instead of the pattern touch: mujoco:SCENE.xml")
    ] = ""
    world_speed: Annotated[
        float, Meta(gt=0, le=1000, description="seconds of the physics in a second of the devices")
    ] = 1.0
    world_services: Annotated[bool, Meta(description="publish the services truth and joints of the physics")] = True

    lose: Annotated[Probability, Meta(description="probability that a data frame is lost")] = 0.0
    repeat: Annotated[Probability, Meta(description="probability that a data frame is sent twice")] = 0.0
    truncate: Annotated[Probability, Meta(description="probability that a data frame is cut short")] = 0.0
    corrupt: Annotated[Probability, Meta(description="probability that a data frame contains random bytes")] = 0.0
    jitter_us: Annotated[Count, Meta(description="longest random delay of a burst, in microseconds")] = 0
    foreign_hz: Annotated[
        float, Meta(ge=0, le=10_000, description="frames per second from other devices on the bus")
    ] = 0.0
    silence: Annotated[
        tuple[str, ...], Meta(description="kinds of frames that the devices stop sending, after silence_after_s")
    ] = ()
    silence_after_s: Annotated[Seconds, Meta(description="seconds from power-up to that silence")] = 2.0
    dead: Annotated[tuple[int, ...], Meta(description="devices that die, after dead_after_s")] = ()
    dead_after_s: Annotated[Seconds, Meta(description="seconds from power-up to their death")] = 2.0
    restart: Annotated[
        tuple[int, ...], Meta(description="devices that lose power for a moment, after restart_after_s")
    ] = ()
    restart_after_s: Annotated[Seconds, Meta(description="seconds from power-up to the restart")] = 2.0
    boot_s: Annotated[Seconds, Meta(description="seconds for which a restarted device ignores commands")] = 0.5


class Device:
    """One emulated device.

    Attributes:
        number: its name in the emulator's options.
        queue: frames that wait for the wire.
        memory: settings by commands; gone after a restart.
        cycle: bursts sent since the first power-up; the number of the next one.
        alive: it has power.
        ready_ns: since when it can hear and send, after it last got power.
        streams_from_ns: when it began to send by itself; None: it does not.
        sampled_ns: when the values of its last burst were felt.
        random: source of the faults of its frames.
    """

    def __init__(self, number: int, queue: deque[Transmission], now_ns: int, seed: int) -> None:
        self.number = number
        self.queue = queue
        self.memory: dict[str, Any] = {}
        self.cycle: int = 0
        self.alive = True
        self.ready_ns = now_ns
        self.streams_from_ns: int | None = None
        self.sampled_ns = now_ns
        self.random = np.random.default_rng([seed, number, 1])
        self._timers: dict[str, tuple[int, int]] = {}  # name -> next, period

    def every(self, name: str, period_ns: int, first_ns: int) -> None:
        """Start a timer that calls ``on_timer`` of the emulator with ``name``, first at ``first_ns``."""
        self._timers[name] = first_ns, period_ns

    def stop(self, name: str) -> None:
        """Stop a timer. Idempotent."""
        self._timers.pop(name, None)

    def runs(self, name: str) -> bool:
        """Return whether a timer runs."""
        return name in self._timers

    def clear(self) -> None:
        """Forget everything, as without power."""
        self.memory = {}
        self._timers = {}
        self.streams_from_ns = None

    def next_event_ns(self) -> int | None:
        """Return the time at which a timer is due."""
        return min((next_ns for next_ns, _ in self._timers.values()), default=None)

    def due(self, now_ns: int) -> Iterator[tuple[str, int]]:
        """Yield name and time of each timer that is due; it then runs on."""
        for name, (next_ns, period_ns) in list(self._timers.items()):
            if next_ns <= now_ns and name in self._timers:
                self._timers[name] = next_ns + period_ns, period_ns
                yield name, next_ns

    def skip_to(self, now_ns: int) -> Iterator[tuple[str, int]]:
        """Leave out what is due before ``now_ns``; yield how often that would have been, by the name of the timer."""
        for name, (next_ns, period_ns) in self._timers.items():
            times = max(0, -((next_ns - now_ns) // period_ns))
            self._timers[name] = next_ns + times * period_ns, period_ns
            yield name, times
