"""Run a skin that is pressed, drifts and fails, as arrays: the frames that its driver would publish, and the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from typing import Unpack

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.status import Status
from skinware.tactile.arrays import Bytes, Doubles, Flags, Floats, Whole
from skinware.tactile.baseline import UNUSABLE
from skinware.tactile.testing.gestures import Cover, Faults, Gesture, How, Jump, Missing, Push, Response, Stroke
from skinware.tactile.testing.surface import Surface, Taxels

_START_NS = 1_000_000_000
_ROWS = 2048
_MOST_KNOWN = 1000


@dataclass(frozen=True)
class Block:
    """m frames of n taxels.

    Attributes:
        time_ns: (m,) int64, when each frame's newest data was acquired.
        module_time_ns: (m, n_modules) int64, when each module's data was acquired.
        values: (m, n), pressure-positive, of the world's dtype.
        status: (m, n) uint8, bits of :class:`skinware.Status`.
        truth: (m, n) float32, the load in counts, without drift, noise, sag, creep and faults. It does not clip.
    """

    time_ns: Whole
    module_time_ns: Whole
    values: npt.NDArray[np.generic]
    status: Bytes
    truth: Floats

    @classmethod
    def joined(cls, blocks: Sequence[Block]) -> Block:
        """Join blocks, one after the other; raises ConfigurationError if there is none."""
        if not blocks:
            raise ConfigurationError("no frames: give a later end")
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(block, name) for block in blocks]) for name in names))

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def usable(self) -> Flags:
        """(m, n) bool: there is a value, and it is of this frame."""
        usable: Flags = (self.status & np.uint8(UNUSABLE)) == 0
        return usable

    def __iter__(self) -> Iterator[Sample]:
        usable = self.usable
        for row in range(len(self)):
            yield Sample(
                int(self.time_ns[row]),
                self.module_time_ns[row],
                self.values[row],
                self.status[row],
                usable[row],
                self.truth[row],
            )


@dataclass(frozen=True, slots=True)
class Sample:
    """One frame, a row of a :class:`Block`: its arrays are (n,) and (n_modules,)."""

    time_ns: int
    module_time_ns: Whole
    values: npt.NDArray[np.generic]
    status: Bytes
    usable: Flags
    truth: Floats


@dataclass
class World:
    """A skin and everything that happens to it, from second 0 on. The same settings and seed give the same values.

    Counts are pressure-positive: an idle taxel shows ``idle``, a pressed one more.

    Attributes:
        surface: the taxels.
        seed: of all that is random.
        rate_hz: of the frames.
        jitter: of the time between frames, as a part of it, 0 to 0.9.
        sensitivity: counts at the centre of a contact per unit of force.
        gain_spread: standard deviation of the taxels' gains, around 1.
        response: how the skin answers a force.
        noise: standard deviation, counts.
        drift_per_min: common drift of each patch, counts per minute.
        wave: amplitude of a slow wave of the common drift, counts.
        wave_s: its period.
        drift_spread: standard deviation of how strongly each taxel follows the common drift, around 1.
        walk: each taxel's own random walk, counts after one minute (standard deviation).
        idle: value of an idle taxel.
        minimum, maximum: values are clipped there.
        step: values are whole multiples of it; 0: they are not rounded.
        dtype: of the values.
        gestures: the gestures that press it, in their order.
        faults: its faults.
        gain: (n,) of each taxel.
        follows: (n,) how strongly each taxel follows the common drift.
        wave_phase: (n_patches,) of the slow wave, rad.
        late_s: (n_patches,) how long before a frame's time each patch acquires its data.

    Raises:
        ConfigurationError: a setting makes no sense.
    """

    surface: Surface
    _: KW_ONLY
    seed: int = 1
    rate_hz: float = 50.0
    jitter: float = 0.0
    sensitivity: float = 1.0
    gain_spread: float = 0.0
    response: Response = field(default_factory=Response)
    noise: float = 0.8
    drift_per_min: float = 0.0
    wave: float = 0.0
    wave_s: float = 600.0
    drift_spread: float = 0.3
    walk: float = 0.0
    idle: float = 15.0
    minimum: float = 0.0
    maximum: float = 255.0
    step: float = 1.0
    dtype: npt.DTypeLike = np.uint8
    gestures: list[Gesture] = field(default_factory=list, init=False)
    faults: Faults = field(init=False)
    gain: Doubles = field(init=False)
    follows: Doubles = field(init=False)
    wave_phase: Doubles = field(init=False)
    late_s: Doubles = field(init=False)
    _known_near: dict[tuple[Gesture, float], Flags] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if not len(self.surface):
            raise ConfigurationError("a world needs at least one taxel")
        if not self.rate_hz > 0 or not 0 <= self.jitter <= 0.9 or not self.wave_s > 0 or not self.step >= 0:
            raise ConfigurationError(
                f"rate_hz {self.rate_hz}, jitter {self.jitter}, wave_s {self.wave_s}, step {self.step}:"
                " one of them makes no sense"
            )
        dtype = np.dtype(self.dtype)
        info = np.iinfo(dtype) if dtype.kind in "iu" else np.finfo(dtype)
        if not self.minimum <= self.idle <= self.maximum:
            raise ConfigurationError(f"idle {self.idle} is not between {self.minimum} and {self.maximum}")
        if not info.min <= self.minimum <= self.maximum <= info.max:
            raise ConfigurationError(f"{self.minimum} to {self.maximum}: more than {dtype.name} holds")
        self.faults = Faults.none(len(self.surface))
        random = np.random.default_rng([self.seed, 0])
        self.gain = np.clip(1 + self.gain_spread * random.standard_normal(len(self.surface)), 0.3, 3)
        self.follows = np.clip(1 + self.drift_spread * random.standard_normal(len(self.surface)), 0.1, 3)
        self.wave_phase = random.uniform(0, 2 * np.pi, self.surface.n_patches)
        self.late_s = random.uniform(0, 1 / self.rate_hz, self.surface.n_patches)
        self.late_s[random.integers(self.surface.n_patches)] = 0  # the newest of a frame

    # Gestures

    def push(self, at_m: npt.ArrayLike, force: float, begin_s: float, end_s: float, **how: Unpack[How]) -> Push:
        """Press at one point; ``how``: the other attributes of :class:`.Gesture`."""
        x, y, z = np.asarray(at_m, np.float64).tolist()
        push = Push(at_m=(x, y, z), force=force, begin_s=begin_s, end_s=end_s, **how)
        self.gestures.append(push)
        return push

    def stroke(self, path_m: npt.ArrayLike, force: float, begin_s: float, end_s: float, **how: Unpack[How]) -> Stroke:
        """Press along a line of points (k, 3) at one speed; ``how``: the other attributes of :class:`.Gesture`."""
        path = tuple((x, y, z) for x, y, z in np.asarray(path_m, np.float64).tolist())
        stroke = Stroke(path_m=path, force=force, begin_s=begin_s, end_s=end_s, **how)
        self.gestures.append(stroke)
        return stroke

    def cover(self, taxels: Taxels, force: float, begin_s: float, end_s: float, **how: Unpack[How]) -> Cover:
        """Load some taxels evenly, wherever they are; ``how``: the other attributes of :class:`.Gesture`.

        To have them covered before the first frame, begin before 0.
        """
        numbers = tuple(self.surface.taxels(taxels).tolist())
        cover = Cover(taxels=numbers, force=force, begin_s=begin_s, end_s=end_s, **how)
        self.gestures.append(cover)
        return cover

    def pressing(self, time_s: float) -> list[tuple[Gesture, Doubles, float]]:
        """Return the gestures that press at a time, each with its place (3,) and its force."""
        at = np.array([time_s])
        found = [(gesture, gesture.points_m(at)[0], float(gesture.forces(at)[0])) for gesture in self.gestures]
        return [one for one in found if one[2]]

    # Faults

    def dead(self, taxels: Taxels) -> None:
        """Let taxels feel no load; they still drift and are noisy."""
        self.faults.feels[self.surface.taxels(taxels)] = False

    def stuck(self, taxels: Taxels, value: float) -> None:
        """Let taxels always show one value, between ``minimum`` and ``maximum``."""
        if not self.minimum <= value <= self.maximum:
            raise ConfigurationError(f"stuck at {value}: values are between {self.minimum} and {self.maximum}")
        self.faults.stuck[self.surface.taxels(taxels)] = value

    def noisy(self, taxels: Taxels, factor: float) -> None:
        """Multiply the noise of taxels by ``factor``."""
        self.faults.noise[self.surface.taxels(taxels)] = factor

    def swap(self, first: Taxels, second: Taxels) -> None:
        """Exchange two equal numbers of taxels: their data arrives in each other's place; the truth does not move."""
        one, other = self.surface.taxels(first), self.surface.taxels(second)
        if len(one) != len(other):
            raise ConfigurationError(f"{len(one)} taxels cannot be exchanged with {len(other)}")
        source = self.faults.source
        source[one], source[other] = source[other].copy(), source[one].copy()

    def missing(
        self, taxels: Taxels, begin_s: float, end_s: float, *, status: Status = Status.STALE, value: float | None = None
    ) -> None:
        """Let taxels send nothing for a while. For nothing in the first frame, begin before 0.

        Meanwhile they have a status (``Status(0)``: none), and a value (NaN, if the dtype has it); None: the last one.
        """
        dtype = np.dtype(self.dtype)
        if value is not None and not (dtype.kind == "f" or np.iinfo(dtype).min <= value <= np.iinfo(dtype).max):
            raise ConfigurationError(f"values of {dtype.name} cannot be {value}")
        self.faults.missing.append(Missing(self.surface.taxels(taxels), begin_s, end_s, status, value))

    def jump(self, taxels: Taxels, counts: float, at_s: float, *, suspect_s: float = 0.0) -> None:
        """Move the baseline of taxels, as a board does; for ``suspect_s`` the driver calls them suspect."""
        self.faults.jumps.append(Jump(self.surface.taxels(taxels), counts, at_s, suspect_s))

    # Frames

    def samples(self, until_s: float) -> Iterator[Sample]:
        """Yield every frame from second 0 on; always the same ones."""
        for block in self.blocks(until_s):
            yield from block

    def record(self, until_s: float) -> Block:
        """Return every frame from second 0 on, in one block; raises ConfigurationError if there is none."""
        return Block.joined(list(self.blocks(until_s)))

    def blocks(self, until_s: float, rows: int = _ROWS) -> Iterator[Block]:
        """Yield every frame from second 0 on, in blocks of at most ``rows``; the values do not depend on ``rows``."""
        state = _State(self)
        total = max(int(np.ceil(until_s * self.rate_hz - 1e-9)), 0)
        for first in range(0, total, rows):
            yield state.next_block(first, min(rows, total - first))

    def loads(self, time_s: Doubles) -> tuple[Doubles, Doubles]:
        """Return (m, n) the load of all gestures together, and (m, n) how much is missing as the cover sags, in counts.

        ``time_s`` is (m, n_patches), when each patch acquires its data.
        """
        load = np.zeros((len(time_s), len(self.surface)))
        missing = np.zeros_like(load) if self.response.sag else load[:0]
        first_s, last_s = time_s.min(), time_s.max()
        for gesture in self.gestures:
            if gesture.begin_s > last_s or gesture.end_s < first_s:
                continue
            near = self._near(gesture)
            for patch in np.unique(self.surface.patch[near]).tolist():
                taxels = np.flatnonzero(near & (self.surface.patch == patch))
                rows = slice(*np.searchsorted(time_s[:, patch], [gesture.begin_s, gesture.end_s], "left").tolist())
                felt, sagged = self._felt(gesture, time_s[rows, patch], taxels)
                load[rows, taxels] += felt
                if self.response.sag:
                    missing[rows, taxels] += sagged
        return load, missing

    def felt(self, time_s: Doubles, taxels: Taxels) -> Doubles:
        """Return (m, k) what k taxels feel of all gestures at (m,) times, in counts: the load less the sag.

        It is for programs that make frames with times and noise of their own.
        """
        numbers = self.surface.taxels(taxels)
        total = np.zeros((len(time_s), len(numbers)))
        for gesture in self.gestures:
            near = np.flatnonzero(self._near(gesture)[numbers])
            if len(near) and gesture.forces(time_s).any():
                load, missing = self._felt(gesture, time_s, numbers[near])
                total[:, near] += load - missing
        total *= self.faults.feels[numbers]
        return total

    def _near(self, gesture: Gesture) -> Flags:
        key = gesture, self.response.reach_m
        near = self._known_near.get(key)
        if near is None:
            if len(self._known_near) >= _MOST_KNOWN:
                self._known_near.clear()
            near = self._known_near[key] = gesture.least_distances_m(self.surface) <= self.response.reach_m
        return near

    def _felt(self, gesture: Gesture, time_s: Doubles, taxels: Whole) -> tuple[Doubles, Doubles]:
        force = self.sensitivity * gesture.forces(time_s)[:, np.newaxis] * self.gain[taxels]
        distance = gesture.distances_m(time_s, self.surface, taxels)
        load = force * self.response.bell(distance)
        return load, force * self.response.ring(distance) if self.response.sag else np.zeros_like(load)


class _State:
    """The memory of a run of a world from block to block."""

    def __init__(self, world: World) -> None:
        self._world = world
        n = len(world.surface)
        self._noise = np.random.default_rng([world.seed, 1])
        self._walks = np.random.default_rng([world.seed, 2])
        self._jitter = np.random.default_rng([world.seed, 3])
        self._walked = np.zeros(n)
        self._crept = np.zeros(n)
        self._before: npt.NDArray[np.generic] = np.zeros(n, world.dtype)
        """Values of the last frame: silent taxels keep them."""

    def next_block(self, first: int, rows: int) -> Block:
        world, surface = self._world, self._world.surface
        frame_s = (np.arange(first, first + rows) + world.jitter * (self._jitter.random(rows) - 0.5)) / world.rate_hz
        time_s = frame_s[:, np.newaxis] - world.late_s
        load, missing = world.loads(time_s)
        signal = self._signal(time_s, load)
        if world.response.sag:
            signal -= missing * world.faults.feels
        jumped, suspect = world.faults.jumped(time_s, surface.patch)
        if jumped is not None:
            signal += jumped
        values = self._values(signal)
        status = np.zeros(values.shape, np.uint8)
        if suspect is not None:
            status[suspect] |= np.uint8(Status.SUSPECT)
        time_ns = _START_NS + np.rint(time_s * 1e9).astype(np.int64)
        self._leave_out(time_s, values, status)
        self._before = values[-1].copy()
        of_patch = np.zeros(surface.n_modules, np.int64)
        of_patch[surface.module] = surface.patch
        return Block(time_ns.max(axis=1), time_ns[:, of_patch], values, status, load.astype(np.float32))

    def _signal(self, time_s: Doubles, load: Doubles) -> Doubles:
        world, faults = self._world, self._world.faults
        m, n = load.shape
        signal: Doubles = self._noise.standard_normal((m, n), np.float32) * (world.noise * faults.noise)
        felt = load * faults.feels
        signal += felt
        if world.response.creep or world.response.remainder:
            moved = np.flatnonzero(felt.any(axis=0) | (self._crept > 1e-3))
            crept = self._crept[moved]
            signal[:, moved] += world.response.slowly(felt[:, moved], crept, 1 / world.rate_hz)
            self._crept[:] = 0
            self._crept[moved] = crept
        common = world.drift_per_min / 60 * time_s
        if world.wave:
            phase = world.wave_phase
            common += world.wave * (np.sin(time_s * (2 * np.pi / world.wave_s) + phase) - np.sin(phase))
        signal += common[:, world.surface.patch] * world.follows
        if world.walk:
            steps = self._walks.standard_normal((m, n), np.float32) * (world.walk / np.sqrt(60 * world.rate_hz))
            walked = self._walked + np.cumsum(steps, axis=0, dtype=np.float64)
            self._walked = walked[-1]
            signal += walked
        return signal

    def _values(self, signal: Doubles) -> npt.NDArray[np.generic]:
        world, faults = self._world, self._world.faults
        signal += world.idle
        if world.step:
            np.rint(signal / world.step, out=signal)
            signal *= world.step
        np.clip(signal, world.minimum, world.maximum, out=signal)
        stuck = ~np.isnan(faults.stuck)
        signal[:, stuck] = faults.stuck[stuck]
        values = signal.astype(world.dtype)
        if (faults.source != np.arange(len(faults.source))).any():
            values = values[:, faults.source]
        return values

    def _leave_out(self, time_s: Doubles, values: npt.NDArray[np.generic], status: Bytes) -> None:
        for gap in self._world.faults.missing:
            gone = (time_s >= gap.begin_s) & (time_s < gap.end_s)
            for patch in np.flatnonzero(gone.any(axis=0)).tolist():
                taxels = gap.taxels[self._world.surface.patch[gap.taxels] == patch]
                rows = np.flatnonzero(gone[:, patch])
                first, last = int(rows[0]), int(rows[-1]) + 1
                before = self._before if first == 0 else values[first - 1]
                values[first:last, taxels] = before[taxels] if gap.value is None else gap.value
                status[first:last, taxels] |= np.uint8(gap.status)
