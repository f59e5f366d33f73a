"""Connect emulated devices with the driver under test: values that are felt, and faults on the wire."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.testing.waiting import defect
from skinware_drivers.virtual.bus import BUSES, EmulatedBus
from skinware_drivers.virtual.hand_clock import HandClock
from skinware_drivers.virtual.hardware import EmulatedHardware, WireFrame

_LONGEST_HOLD = 2.5
_BETWEEN = 6
_LOSES_ONLY = 0.3


class Stumbling:
    """A sender that loses up to two bursts of frames, stands still and catches up; all chance comes from one seed."""

    def __init__(self, period_ns: int, frames: int) -> None:
        self._period_ns = period_ns
        self._frames = frames
        self._random = random.Random(4)
        self._held: list[WireFrame] = []
        self._next_ns = 0
        self._until_ns = 0
        self._skip = self._lose = 0
        self.stumbles = 0

    @property
    def due_ns(self) -> int | None:
        """Return the time at which it continues; None: it does not stand still."""
        return self._until_ns if self._held else None

    def pass_on(self, frames: list[WireFrame], now_ns: int) -> list[WireFrame]:
        self._next_ns = self._next_ns or now_ns + self._pause_ns()
        for frame in frames:
            if frame.time_ns >= self._next_ns:
                self.stumbles += 1
                if self._random.random() > _LOSES_ONLY:
                    self._until_ns = frame.time_ns + round(self._random.uniform(0, _LONGEST_HOLD) * self._period_ns)
                self._skip = self._random.randrange(self._frames)
                near = self._random.choice((-1, 0, 0, 0, 1))
                lose = self._frames * self._random.choice((0, 1, 1, 2)) + near
                self._lose = max(1, min(2 * self._frames, lose))
                self._next_ns = max(frame.time_ns, self._until_ns) + self._pause_ns()
            if self._skip:
                self._skip -= 1
            elif self._lose:
                self._lose -= 1
                continue
            self._held.append(frame)
        if now_ns < self._until_ns:
            return []
        passed, self._held = self._held, []
        return [frame._replace(time_ns=max(frame.time_ns, self._until_ns)) for frame in passed]

    def _pause_ns(self) -> int:
        return round(_BETWEEN * self._period_ns * self._random.uniform(0.8, 1.6))


Fault = Literal["lost", "repeated", "truncated", "garbage", "noise"]
"""The fate of a frame: lost, sent twice, cut short, replaced by random bytes, or preceded by them (serial lines)."""
Values = npt.NDArray[np.int64]
Pattern = Callable[[int, int, int], Values]
"""(number of the device, number of its burst, number of values) -> values that its sensors feel."""
_FOREIGN_NS = 3_000_000


@dataclass(frozen=True)
class Burst:
    """One sample of all sensors of a device, as the protocol can send it, and when it was taken at the latest."""

    time_ns: int
    values: Values


class Truth:
    """The source of an emulator's values, which keeps them.

    Args:
        n_felt: number of values that each device feels.
        shown: returns the values that the protocol can send for values that were felt.

    Attributes:
        remember: keep the bursts.
    """

    def __init__(
        self, clock: HandClock, n_felt: int, pattern: Pattern, shown: Callable[[Sequence[int]], Sequence[int]]
    ) -> None:
        self.pattern = pattern
        self.n_felt = n_felt
        self.n_values: int = len(shown([0] * n_felt))
        self.bursts: dict[int, list[Burst]] = {}
        self.remember = True
        self._clock = clock
        self._shown = shown

    @property
    def most_bursts(self) -> int:
        return max(len(bursts) for bursts in self.bursts.values())

    def __call__(self, number: int, cycle: int) -> Sequence[int]:
        felt: list[int] = self.pattern(number, cycle, self.n_felt).tolist()
        if self.remember:
            burst = Burst(self._clock.now_ns, np.array(self._shown(felt)))
            self.bursts.setdefault(number, []).append(burst)
        return felt


@dataclass
class Interference:
    """Devices behind a wire with faults.

    Attributes:
        fault: of some frames; None: none.
        every_ns: mean time between two faults.
        silent: nothing passes in either direction.
        foreign: identifiers of frames of other devices beside the data.
        damages: frames that had a fault, as it left them.
        keep: returns whether a frame passes.
        stumbling: holds frames back and loses some in a row; None: nothing does.
        sent: frames that the driver sent to the devices.
        remember: keep ``sent``.
        identifiers: of the frames that passed, with their numbers.
    """

    hardware: EmulatedHardware
    fault: Fault | None = None
    every_ns: int = 0
    silent: bool = False
    foreign: Sequence[int] = ()
    keep: Callable[[int, bytes], bool] = lambda _identifier, _payload: True
    stumbling: Stumbling | None = None
    damages: list[WireFrame] = field(default_factory=list)
    frames: int = 0
    foreign_sent: int = 0
    sent: list[tuple[int, bytes]] = field(default_factory=list)
    remember: bool = True
    identifiers: dict[int, int] = field(default_factory=dict)
    _random: random.Random = field(default_factory=lambda: random.Random(1))
    _next_ns: int = 0
    _next_foreign_ns: int = 0

    @property
    def datagrams(self) -> bool:
        return bool(getattr(self.hardware, "datagrams", False))

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        if self.remember:
            self.sent.append((identifier, payload))
        if not self.silent:
            self.hardware.receive(identifier, payload, now_ns)

    def next_due_ns(self) -> int | None:
        moments = [self.hardware.next_due_ns(), self.stumbling.due_ns if self.stumbling is not None else None]
        if self.foreign:
            moments.append(self._next_foreign_ns)
        return min((moment for moment in moments if moment is not None), default=None)

    def emit(self, now_ns: int) -> list[WireFrame]:
        frames = [frame for frame in self.hardware.emit(now_ns) if self.keep(frame.identifier, frame.payload)]
        if self.silent:
            return []
        if self.stumbling is not None:
            frames = self.stumbling.pass_on(frames, now_ns)
        if self.fault is not None:
            frames = [damaged for frame in frames for damaged in self._damage(frame)]
        if self.foreign:
            others = []
            while self._next_foreign_ns <= now_ns:
                payload = self._random.randbytes(self._random.randrange(9))
                others.append(WireFrame(self._next_foreign_ns, self._random.choice(self.foreign), payload))
                self._next_foreign_ns += round(_FOREIGN_NS * self._random.uniform(0.3, 1.7))
            self.foreign_sent += len(others)
            frames = sorted([*frames, *others], key=lambda frame: frame.time_ns)
        for frame in frames:
            self.identifiers[frame.identifier] = self.identifiers.get(frame.identifier, 0) + 1
        self.frames += len(frames)
        return frames

    def skip(self, now_ns: int) -> int:
        """Let the devices run without a listener."""
        self._next_foreign_ns = now_ns
        return self.hardware.skip(now_ns)

    def totals(self) -> dict[str, int]:
        return self.hardware.totals()

    def _damage(self, frame: WireFrame) -> list[WireFrame]:
        if frame.time_ns < self._next_ns or not frame.payload:
            return [frame]
        if not self._next_ns:  # the first time, only decide when
            self._next_ns = frame.time_ns + self._pause_ns()
            return [frame]
        self._next_ns = frame.time_ns + self._pause_ns()
        payload, times = frame.payload, 1
        if self.fault == "lost":
            times = 0
        elif self.fault == "repeated":
            times = 2
        elif self.fault == "truncated":
            payload = payload[: self._random.randrange(len(payload))]
        elif self.fault == "noise":
            payload = self._random.randbytes(1 + self._random.randrange(8)) + payload
        else:
            payload = self._random.randbytes(len(payload))
        damaged = WireFrame(frame.time_ns, frame.identifier, payload)
        self.damages.append(damaged)
        return [damaged] * times

    def _pause_ns(self) -> int:
        return round(self.every_ns * self._random.uniform(0.6, 1.4))


def make_bus(adapter: AnyAdapter, hardware: EmulatedHardware, clock: HandClock, *, listen_only: bool) -> EmulatedBus:
    kind = BUSES.get(adapter.medium)
    if kind is None:
        return defect(f"{type(adapter).__name__}: there is no emulated bus of the medium {adapter.medium!r}")
    return kind(
        "emulated",
        payload_size=adapter.payload_size,
        listen_only=listen_only,
        hardware=hardware,
        clock=clock,
    )


def foreign_identifiers(own: Collection[int]) -> list[int]:
    """Return identifiers of 11 and 29 bits that no device uses."""
    others = [i for i in range(0x7FF) if i not in own]
    extended = [EXTENDED_FLAG | 0x1234_0000 | i for i in (1, 0x710)]
    return random.Random(2).sample(others, min(40, len(others))) + [i for i in extended if i not in own]
