"""Press a simulated skin with gestures, forces over time at places that may move; read them from a stage file.

How a skin answers is its response; its faults spoil that.

docs/tactile/world.md has an example of the file, which is TOML.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, TypedDict

import msgspec
import numpy as np

from skinware.errors import ConfigurationError
from skinware.status import Status
from skinware.tactile.arrays import Doubles, Flags, Whole
from skinware.tactile.testing.surface import Surface
from skinware.toml_text import TomlText

_FAR = 5.0  # widths beyond which nothing is felt


@dataclass(frozen=True)
class Response:
    """The answer of taxels at a distance from a force.

    Attributes:
        width_m: of the bell, m: its standard deviation.
        sag: share of the load by which the cover is pulled down at ``sag_radius_m`` from a contact.
        sag_radius_m: where it sags most, m.
        creep: share of a load by which the value grows under it.
        remainder: share of a load that stays for a while after it.
        creep_s: time constant of both.

    Raises:
        ConfigurationError: a width, radius or time constant that is not above 0.
    """

    width_m: float = 0.004
    sag: float = 0.0
    sag_radius_m: float = 0.012
    creep: float = 0.0
    remainder: float = 0.0
    creep_s: float = 40.0

    def __post_init__(self) -> None:
        for name in ("width_m", "sag_radius_m", "creep_s"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"{name} {getattr(self, name)}: give more than 0")

    @property
    def reach_m(self) -> float:
        """Distance from a contact beyond which nothing changes, m."""
        return _FAR * self.width_m if self.sag == 0 else max(_FAR * self.width_m, 4 * self.sag_radius_m)

    def bell(self, distance_m: Doubles) -> Doubles:
        """Return the share of the force that is felt as load, at distances; 0 at NaN."""
        near = distance_m <= _FAR * self.width_m
        load: Doubles = np.where(near, np.exp(-0.5 * (np.where(near, distance_m, 0) / self.width_m) ** 2), 0.0)
        return load

    def ring(self, distance_m: Doubles) -> Doubles:
        """Return the share of the force that is missing round it, at distances; 0 at NaN."""
        squared = np.where(distance_m <= 4 * self.sag_radius_m, distance_m / self.sag_radius_m, 0) ** 2
        missing: Doubles = self.sag * squared * np.exp(1 - squared)
        return missing

    def slowly(self, load: Doubles, crept: Doubles, period_s: float) -> Doubles:
        """Return (m, k) what creep and remainder add to a block of (m, k) loads, one each ``period_s``.

        ``crept``, (k,) the load that the material is used to, is updated.
        """
        gain = 1 - np.exp(-period_s / self.creep_s)
        used_to = np.empty_like(load)
        for row, now in enumerate(load):
            crept += gain * (now - crept)
            used_to[row] = crept
        return self.creep * np.minimum(used_to, load) + self.remainder * np.maximum(used_to - load, 0)


@dataclass(frozen=True)
class Missing:
    """Taxels without data for a while: their status meanwhile, and a value; None: the last one (0 before the first)."""

    taxels: Whole
    begin_s: float
    end_s: float
    status: Status
    value: float | None


@dataclass(frozen=True)
class Jump:
    """A board that moves its baseline by counts, and is ``SUSPECT`` for a while; 0: its driver notices nothing."""

    taxels: Whole
    counts: float
    at_s: float
    suspect_s: float


@dataclass
class Faults:
    """All faults of a world of n taxels.

    Attributes:
        feels: (n,) bool, False: the taxel feels no load.
        noise: (n,) factor on its noise.
        stuck: (n,) the value that a taxel always shows; NaN: it is not stuck.
        source: (n,) the taxel whose data arrives in each one's place.
        missing, jumps: gaps and jumps.
    """

    feels: Flags
    noise: Doubles
    stuck: Doubles
    source: Whole
    missing: list[Missing] = field(default_factory=list)
    jumps: list[Jump] = field(default_factory=list)

    @classmethod
    def none(cls, n: int) -> Faults:
        return cls(np.ones(n, bool), np.ones(n), np.full(n, np.nan), np.arange(n))

    def jumped(self, time_s: Doubles, patch: Whole) -> tuple[Doubles | None, Flags | None]:
        """Return (m, n) how jumps change the values, and (m, n) which are suspect; None if there is no jump yet.

        Acquisitions are at (m, n_patches) times; ``patch`` is (n,), of the taxels.
        """
        if not any(time_s[-1].max() >= jump.at_s for jump in self.jumps):
            return None, None
        added, suspect = np.zeros((len(time_s), len(patch))), np.zeros((len(time_s), len(patch)), bool)
        for jump in self.jumps:
            at_s = time_s[:, patch[jump.taxels]]
            added[:, jump.taxels] += jump.counts * (at_s >= jump.at_s)
            suspect[:, jump.taxels] |= (at_s >= jump.at_s) & (at_s < jump.at_s + jump.suspect_s)
        return added, suspect


class How(TypedDict, total=False):
    """The attributes of a :class:`Gesture` that have defaults."""

    rise_s: float
    fall_s: float | None
    radius_m: float
    name: str


@dataclass(frozen=True, kw_only=True)
class Gesture(ABC):
    """A force that presses from ``begin_s`` to ``end_s``.

    Attributes:
        force: at its full; ``World.sensitivity`` says how much of it a taxel shows.
        begin_s: the force is 0 until then.
        end_s: the force is 0 from then on.
        rise_s: the force grows for this long, linearly.
        fall_s: before its end it shrinks for this long; None: as ``rise_s``, where there is time for it.
        radius_m: of the thing that presses: within it the load is even.
        name: for tests that select it.

    Raises:
        ConfigurationError: it ends before it has risen and fallen, or a number is not finite.
    """

    force: float
    begin_s: float
    end_s: float
    rise_s: float = 0.05
    fall_s: float | None = None
    radius_m: float = 0.0
    name: str = ""

    def __post_init__(self) -> None:
        if not np.isfinite([self.force, self.begin_s, self.end_s, self.rise_s, self.falls_s, self.radius_m]).all():
            raise ConfigurationError(f"{self}: a number is not finite")
        if min(self.rise_s, self.falls_s) < 0 or self.rise_s + self.falls_s > self.end_s - self.begin_s + 1e-9:
            raise ConfigurationError(f"{self}: no time to rise and fall")

    @property
    def falls_s(self) -> float:
        """How long it falls, s."""
        if self.fall_s is not None:
            return self.fall_s
        return max(min(self.rise_s, self.end_s - self.begin_s - self.rise_s), 0.0)

    def forces(self, time_s: Doubles) -> Doubles:
        """Return (m,) the force at m times."""
        points = np.array([self.begin_s, self.begin_s + self.rise_s, self.end_s - self.falls_s, self.end_s])
        full = np.interp(time_s, points, [0.0, 1.0, 1.0, 0.0], left=0.0, right=0.0)
        on = (time_s >= self.begin_s) & (time_s < self.end_s)
        forces: Doubles = self.force * full * on
        return forces

    @abstractmethod
    def points_m(self, time_s: Doubles) -> Doubles:
        """Return (m, 3) its place at m times, m; NaN if it has none."""

    def distances_m(self, time_s: Doubles, surface: Surface, taxels: Whole) -> Doubles:  # noqa: ARG002
        """Return (m, k) or (1, k) the distances of k taxels from it at m times, m; NaN or inf: out of reach."""
        return self.least_distances_m(surface)[taxels][np.newaxis]  # it does not move

    @abstractmethod
    def least_distances_m(self, surface: Surface) -> Doubles:
        """Return (n,) how near it ever comes to each taxel, m."""


@dataclass(frozen=True, kw_only=True)
class Push(Gesture):
    """A force at one point, x, y, z, m."""

    at_m: tuple[float, float, float]

    def points_m(self, time_s: Doubles) -> Doubles:
        return np.broadcast_to(np.array(self.at_m, np.float64), (len(time_s), 3))

    def least_distances_m(self, surface: Surface) -> Doubles:
        distance = np.linalg.norm(surface.position_m - np.array(self.at_m), axis=1)
        beyond: Doubles = np.maximum(distance - self.radius_m, 0)
        return beyond


@dataclass(frozen=True, kw_only=True)
class Stroke(Gesture):
    """A force that moves along a line of points, x, y, z, m, at one speed.

    Raises:
        ConfigurationError: fewer than two points.
    """

    path_m: tuple[tuple[float, float, float], ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.path_m) < 2:
            raise ConfigurationError("a stroke needs a path of at least two points")

    def points_m(self, time_s: Doubles) -> Doubles:
        path, length = self._line()
        return _along(path, length, (time_s - self.begin_s) / (self.end_s - self.begin_s) * length[-1])

    def distances_m(self, time_s: Doubles, surface: Surface, taxels: Whole) -> Doubles:
        away = self.points_m(time_s)[:, np.newaxis] - surface.position_m[taxels]
        distance: Doubles = np.maximum(np.linalg.norm(away, axis=2) - self.radius_m, 0)
        return distance

    def least_distances_m(self, surface: Surface) -> Doubles:
        return self._least(surface, self._line()[0])

    def _line(self, *, closed: bool = False) -> tuple[Doubles, Doubles]:
        """(k, 3) the points, and (k,) the length of the line up to each of them."""
        path = np.array(self.path_m + self.path_m[: int(closed)], np.float64)
        return path, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])

    def _least(self, surface: Surface, path: Doubles) -> Doubles:
        least = np.full(len(surface), np.inf)
        for start, way in zip(path, np.diff(path, axis=0), strict=False):
            from_start = surface.position_m - start
            part = np.clip(from_start @ way / max(float(way @ way), 1e-18), 0, 1)
            np.fmin(least, np.linalg.norm(from_start - part[:, np.newaxis] * way, axis=1), out=least)
        nearest: Doubles = np.maximum(least - self.radius_m, 0)
        return nearest


def _along(path: Doubles, length: Doubles, way: Doubles) -> Doubles:
    return np.stack([np.interp(way, length, path[:, axis]) for axis in range(3)], axis=1)


@dataclass(frozen=True, kw_only=True)
class Wander(Stroke):
    """A finger that goes round a closed path, and presses and lets go on its way.

    Attributes:
        speed_m_s: along the path.
        press_s: how long each press lasts, ``rise_s`` and ``falls_s`` included.
        pause_s: from the end of a press to the next.
    """

    speed_m_s: float = 0.03
    press_s: float = 2.6
    pause_s: float = 1.4

    def forces(self, time_s: Doubles) -> Doubles:
        since_s = time_s - self.begin_s
        moment_s = since_s % (self.press_s + self.pause_s)
        points = np.array([0, self.rise_s, self.press_s - self.falls_s, self.press_s])
        full = np.interp(moment_s, points, [0.0, 1.0, 1.0, 0.0], right=0.0)
        forces: Doubles = self.force * full * ((since_s >= 0) & (time_s < self.end_s))
        return forces

    def points_m(self, time_s: Doubles) -> Doubles:
        path, length = self._line(closed=True)
        return _along(path, length, (time_s - self.begin_s) * self.speed_m_s % length[-1])

    def least_distances_m(self, surface: Surface) -> Doubles:
        return self._least(surface, self._line(closed=True)[0])


@dataclass(frozen=True, kw_only=True)
class Cover(Gesture):
    """An even load on given taxels, by their numbers, wherever they are: a hand that lies on a module."""

    taxels: tuple[int, ...]

    def points_m(self, time_s: Doubles) -> Doubles:
        return np.full((len(time_s), 3), np.nan)

    def least_distances_m(self, surface: Surface) -> Doubles:
        distance = np.full(len(surface), np.inf)
        distance[list(self.taxels)] = 0
        return distance


FORMAT, VERSION = "skinware-stage", 1


class _Act(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    force_n: float
    begin_s: float
    end_s: float
    rise_s: float = 0.05
    fall_s: float | None = None
    radius_m: float = 0.006  # a finger
    name: str = ""


class _Push(_Act, frozen=True, forbid_unknown_fields=True, kw_only=True):
    at_m: tuple[float, float, float]


class _Stroke(_Act, frozen=True, forbid_unknown_fields=True, kw_only=True):
    path_m: tuple[tuple[float, float, float], ...]


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    version: int
    repeat_s: Annotated[float, msgspec.Meta(gt=0)] | None = None
    push: tuple[_Push, ...] = ()
    stroke: tuple[_Stroke, ...] = ()


@dataclass(frozen=True)
class Play:
    """The gestures of a stage file, forces in N; everything begins again after ``repeat_s``, None: it happens once."""

    gestures: tuple[Gesture, ...]
    repeat_s: float | None


def read_stage(path: str | Path) -> Play:
    """Read a stage file.

    Raises:
        ConfigurationError: not there, not TOML, not of this format, or a value that is wrong; the message says where.
    """
    text = TomlText(Path(path))
    file = text.of_format("stage file", FORMAT, VERSION, _File)
    gestures: list[Gesture] = []
    kinds: list[tuple[str, type[Gesture], tuple[_Act, ...]]] = [
        ("push", Push, file.push),
        ("stroke", Stroke, file.stroke),
    ]
    for kind, gesture, acts in kinds:
        for number, act in enumerate(acts):
            how = msgspec.structs.asdict(act)
            try:
                gestures.append(gesture(force=how.pop("force_n"), **how))
            except ConfigurationError as error:
                raise ConfigurationError(f"{text.place((kind, number))}: {error}") from None
    return Play(tuple(gestures), file.repeat_s)
