"""One emulated device, and the options that every emulator has."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from skinware_drivers.options import Options
from skinware_drivers.virtual.wire import Transmission

Probability = Annotated[float, Meta(ge=0, le=1)]
Seconds = Annotated[float, Meta(ge=0)]
Count = Annotated[int, Meta(ge=0)]

DATA = "data"
"""The timer of a device's bursts."""


class EmulatorOptions(Options, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Touch and faults; an emulator adds options for its devices.

    Raises:
        ConfigurationError: an option is out of its limits.
    """

    pattern: Annotated[
        Literal["touch", "idle", "cycle"],
        Meta(description="input: a wandering press, nothing, or each burst's number in every value"),
    ] = "touch"
    calm_s: Annotated[Seconds, Meta(description="seconds without touch at the begin")] = 0.0
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
