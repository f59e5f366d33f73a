"""One emulated device, and the options that every emulator has."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import numpy as np
from msgspec import Meta

from skinware_drivers.options import Options
from skinware_drivers.virtual.wire import Transmitter

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


class Actor(Protocol):
    """Something on the wire that does things by itself."""

    def next_event_ns(self) -> int | None:
        """Return the time at which ``run`` has something to do."""

    def run(self, now_ns: int) -> None:
        """Do what is due: queue frames on the wire."""

    def skip_to(self, now_ns: int) -> int:
        """Leave out what is due before ``now_ns``; return how many frames that would have been."""


class Scheduled(NamedTuple):
    time_ns: int
    action: Callable[[int], object]


class TimerOwner(Protocol):
    """The emulator of a device, as its timers call it."""

    @property
    def options(self) -> EmulatorOptions: ...

    def on_timer(self, device: Device, name: str, time_ns: int) -> None: ...

    def skipped(self, device: Device, name: str, times: int) -> int: ...


class Device:
    """One emulated device.

    Attributes:
        number: its name in the emulator's options.
        stage: the emulator.
        memory: settings by commands; gone after a restart.
        cycle: bursts sent since the first power-up; the number of the next one.
        alive: it has power.
        ready_ns: since when it can hear and send, after it last got power.
        streams_from_ns: when it began to send by itself; None: it does not.
        sampled_ns: when the values of its last burst were felt.
        random: source of the faults of its frames.
    """

    def __init__(self, number: int, stage: TimerOwner, transmitter: Transmitter, now_ns: int) -> None:
        self.number = number
        self.stage = stage
        self.transmitter = transmitter
        self.memory: dict[str, Any] = {}
        self.cycle: int = 0
        self.alive = True
        self.ready_ns = now_ns
        self.streams_from_ns: int | None = None
        self.sampled_ns = now_ns
        self.random = np.random.default_rng([stage.options.seed, number, 1])
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
        """Return the time at which ``run`` has something to do."""
        return min((next_ns for next_ns, _ in self._timers.values()), default=None)

    def run(self, now_ns: int) -> None:
        """Do what is due."""
        for name, (next_ns, period_ns) in list(self._timers.items()):
            if next_ns <= now_ns and name in self._timers:
                self._timers[name] = next_ns + period_ns, period_ns
                self.stage.on_timer(self, name, next_ns)

    def skip_to(self, now_ns: int) -> int:
        """Leave out what is due before ``now_ns``; return how many frames that would have been."""
        skipped = 0
        for name, (next_ns, period_ns) in self._timers.items():
            times = max(0, -((next_ns - now_ns) // period_ns))
            self._timers[name] = next_ns + times * period_ns, period_ns
            skipped += self.stage.skipped(self, name, times)
        return skipped
