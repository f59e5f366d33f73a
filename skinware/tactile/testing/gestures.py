"""Press a simulated skin with gestures, forces over time at places that may move; read them from a stage file.

docs/tactile/world.md has an example of the file, which is TOML.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypedDict

import msgspec
import numpy as np

from skinware.errors import ConfigurationError
from skinware.tactile.arrays import Doubles, Whole
from skinware.tactile.testing.surface import Surface
from skinware.toml_text import TomlText


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
