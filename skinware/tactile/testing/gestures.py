"""What somebody does to a skin: each gesture is a force over time, at a place that may move."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.testing.surface import Surface

ArrayF = npt.NDArray[np.float64]


class How(TypedDict, total=False):
    """The attributes of a :class:`Gesture` that have defaults."""

    rise_s: float
    fall_s: float | None
    radius_m: float
    name: str


@dataclass(frozen=True, kw_only=True)
class Gesture(ABC):
    """Something that presses from ``begin_s`` to ``end_s``.

    Attributes:
        force: at its full; what a taxel shows of it is the world's affair (``World.sensitivity``).
        begin_s: the force is 0 until then.
        end_s: the force is 0 from then on.
        rise_s: the force grows for so long, linearly.
        fall_s: before its end it shrinks for so long; None: as ``rise_s``, where there is time for it.
        radius_m: of the thing that presses: within it the load is even.
        name: for tests that look for it.

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
        """How long it falls."""
        if self.fall_s is not None:
            return self.fall_s
        return max(min(self.rise_s, self.end_s - self.begin_s - self.rise_s), 0.0)

    def forces(self, time_s: ArrayF) -> ArrayF:
        """(m,) the force at m times."""
        points = np.array([self.begin_s, self.begin_s + self.rise_s, self.end_s - self.falls_s, self.end_s])
        full = np.interp(time_s, points, [0.0, 1.0, 1.0, 0.0], left=0.0, right=0.0)
        on = (time_s >= self.begin_s) & (time_s < self.end_s)
        forces: ArrayF = self.force * full * on
        return forces

    @abstractmethod
    def points_m(self, time_s: ArrayF) -> ArrayF:
        """(m, 3) its place at m times, m; NaN if it has none."""

    @abstractmethod
    def distances_m(self, time_s: ArrayF, surface: Surface, taxels: npt.NDArray[np.int64]) -> ArrayF:
        """(m, k) or (1, k): how far k taxels are from the thing that presses, at m times; NaN or inf: nowhere near."""

    @abstractmethod
    def least_distances_m(self, surface: Surface) -> ArrayF:
        """(n,) how near the thing ever comes to each taxel."""


@dataclass(frozen=True, kw_only=True)
class Push(Gesture):
    """A force at one point.

    Attributes:
        at_m: x, y, z, m.
    """

    at_m: tuple[float, float, float]

    def points_m(self, time_s: ArrayF) -> ArrayF:
        return np.broadcast_to(np.array(self.at_m, np.float64), (len(time_s), 3))

    def distances_m(self, time_s: ArrayF, surface: Surface, taxels: npt.NDArray[np.int64]) -> ArrayF:
        del time_s  # it does not move
        return self._beyond(surface.position_m[taxels])[np.newaxis]

    def least_distances_m(self, surface: Surface) -> ArrayF:
        return self._beyond(surface.position_m)

    def _beyond(self, position_m: ArrayF) -> ArrayF:
        distance = np.linalg.norm(position_m - np.array(self.at_m), axis=1)
        beyond: ArrayF = np.maximum(distance - self.radius_m, 0)
        return beyond


@dataclass(frozen=True, kw_only=True)
class Stroke(Gesture):
    """A force that moves along a line of points, at one speed.

    Attributes:
        path_m: at least two points, x, y, z, m.

    Raises:
        ConfigurationError: fewer than two points.
    """

    path_m: tuple[tuple[float, float, float], ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.path_m) < 2:
            raise ConfigurationError("a stroke needs a path of at least two points")

    def points_m(self, time_s: ArrayF) -> ArrayF:
        path, length = self._line()
        return _along(path, length, (time_s - self.begin_s) / (self.end_s - self.begin_s) * length[-1])

    def distances_m(self, time_s: ArrayF, surface: Surface, taxels: npt.NDArray[np.int64]) -> ArrayF:
        away = self.points_m(time_s)[:, np.newaxis] - surface.position_m[taxels]
        distance: ArrayF = np.maximum(np.linalg.norm(away, axis=2) - self.radius_m, 0)
        return distance

    def least_distances_m(self, surface: Surface) -> ArrayF:
        return self._least(surface, self._line()[0])

    def _line(self, *, closed: bool = False) -> tuple[ArrayF, ArrayF]:
        """(k, 3) the points, and (k,) the way to each of them."""
        path = np.array(self.path_m + self.path_m[: int(closed)], np.float64)
        return path, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])

    def _least(self, surface: Surface, path: ArrayF) -> ArrayF:
        least = np.full(len(surface), np.inf)
        for start, way in zip(path, np.diff(path, axis=0), strict=False):
            from_start = surface.position_m - start
            part = np.clip(from_start @ way / max(float(way @ way), 1e-18), 0, 1)
            np.fmin(least, np.linalg.norm(from_start - part[:, np.newaxis] * way, axis=1), out=least)
        nearest: ArrayF = np.maximum(least - self.radius_m, 0)
        return nearest


def _along(path: ArrayF, length: ArrayF, way: ArrayF) -> ArrayF:
    """(m, 3) the places at m ways along a line of points."""
    return np.stack([np.interp(way, length, path[:, axis]) for axis in range(3)], axis=1)


@dataclass(frozen=True, kw_only=True)
class Wander(Stroke):
    """A finger that goes round a closed path, and presses and lets go while it does.

    Attributes:
        speed_m_s: along the path.
        press_s: how long each press lasts, with ``rise_s`` and ``falls_s`` in it.
        pause_s: from the end of a press to the next.
    """

    speed_m_s: float = 0.03
    press_s: float = 2.6
    pause_s: float = 1.4

    def forces(self, time_s: ArrayF) -> ArrayF:
        since_s = time_s - self.begin_s
        moment_s = since_s % (self.press_s + self.pause_s)
        points = np.array([0, self.rise_s, self.press_s - self.falls_s, self.press_s])
        full = np.interp(moment_s, points, [0.0, 1.0, 1.0, 0.0], right=0.0)
        forces: ArrayF = self.force * full * ((since_s >= 0) & (time_s < self.end_s))
        return forces

    def points_m(self, time_s: ArrayF) -> ArrayF:
        path, length = self._line(closed=True)
        return _along(path, length, (time_s - self.begin_s) * self.speed_m_s % length[-1])

    def least_distances_m(self, surface: Surface) -> ArrayF:
        return self._least(surface, self._line(closed=True)[0])


@dataclass(frozen=True, kw_only=True)
class Cover(Gesture):
    """An even load on given taxels, wherever they are: a hand that lies on a module.

    Attributes:
        taxels: their numbers.
    """

    taxels: tuple[int, ...]

    def points_m(self, time_s: ArrayF) -> ArrayF:
        return np.full((len(time_s), 3), np.nan)

    def distances_m(self, time_s: ArrayF, surface: Surface, taxels: npt.NDArray[np.int64]) -> ArrayF:
        del time_s  # it does not move
        return self.least_distances_m(surface)[taxels][np.newaxis]

    def least_distances_m(self, surface: Surface) -> ArrayF:
        distance = np.full(len(surface), np.inf)
        distance[list(self.taxels)] = 0
        return distance
