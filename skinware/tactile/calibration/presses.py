"""Presses with places: what taxels show while something of a known place rests on them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S

ArrayF = npt.NDArray[np.float64]
ArrayI = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Press:
    """One steady press.

    Attributes:
        pose: (3,) the point that touches, m; or (4, 4) of what carries the finger, homogeneous, m.
        taxel: (k,) the taxels that feel it.
        load: (k,) their loads, above 0.
    """

    pose: ArrayF
    taxel: ArrayI
    load: ArrayF


@dataclass(frozen=True)
class Presses:
    """m presses on a skin of n taxels.

    Attributes:
        n: number of taxels.
        pose: (m, 3) or (m, 4, 4), see :class:`Press`.
        press: (k,) int64, in ascending order: the press of each pair of a press and a taxel that feels it.
        taxel: (k,) int64, its taxel.
        load: (k,) its load, above 0.

    Raises:
        ConfigurationError: the arrays do not fit each other.
    """

    n: int
    pose: ArrayF
    press: ArrayI
    taxel: ArrayI
    load: ArrayF

    def __post_init__(self) -> None:
        if self.pose.ndim not in (2, 3) or self.pose.shape[1:] not in ((3,), (4, 4)):
            raise ConfigurationError(f"poses of presses: give (m, 3) or (m, 4, 4), not {self.pose.shape}")
        if not len(self.press) == len(self.taxel) == len(self.load):
            raise ConfigurationError("press, taxel and load must have one length")
        for name, of, count in (("press", self.press, len(self.pose)), ("taxel", self.taxel, self.n)):
            if len(of) and not 0 <= int(of.min()) <= int(of.max()) < count:
                raise ConfigurationError(f"{name} must count from 0 to {count - 1}")
        if not (np.isfinite(self.pose).all() and np.isfinite(self.load).all() and (self.load > 0).all()):
            raise ConfigurationError("poses must be finite, loads above 0")

    @classmethod
    def none(cls, n: int, pose_shape: tuple[int, ...] = (3,)) -> Self:
        """No press on n taxels yet; ``pose_shape`` is that of their poses."""
        nothing = np.zeros(0, np.int64)
        return cls(n, np.zeros((0, *pose_shape)), nothing, nothing, np.zeros(0))

    @classmethod
    def of_arrays(cls, pose: npt.ArrayLike, load: npt.ArrayLike) -> Self:
        """Those of whole arrays.

        Args:
            pose: (m, 3) or (m, 4, 4).
            load: (m, n), 0 or NaN where a taxel feels nothing.
        """
        loads = np.asarray(load, np.float64)
        if loads.ndim != 2 or len(loads) != len(np.asarray(pose)):
            raise ConfigurationError(f"loads of presses: give a row of each pose, not {loads.shape}")
        press, taxel = np.nonzero(np.nan_to_num(loads) > 0)
        return cls(loads.shape[1], np.asarray(pose, np.float64), press, taxel, loads[press, taxel])

    def with_press(self, press: Press) -> Self:
        """These, and one more."""
        return type(self)(
            self.n,
            np.concatenate([self.pose, press.pose[None]]),
            np.concatenate([self.press, np.full(len(press.taxel), len(self))]),
            np.concatenate([self.taxel, press.taxel]),
            np.concatenate([self.load, press.load]),
        )

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def times_pressed(self) -> ArrayI:
        """(n,) how many presses each taxel has felt at least half as much as the one that felt most of it."""
        most = np.zeros(len(self))
        np.maximum.at(most, self.press, self.load)
        return np.bincount(self.taxel[self.load >= most[self.press] / 2], minlength=self.n)


@dataclass(frozen=True, kw_only=True)
class PressSettings:
    """When something presses steadily.

    Attributes:
        hold_s: for so long.
        steady: meanwhile its load changes by at most this part.
        still_m: and its point moves by at most so much, m.
    """

    hold_s: float = 0.2
    steady: float = 0.3
    still_m: float = 0.002


@dataclass
class PressFinder:
    """Finds presses in frames: one for each time that something comes to rest on the skin.

    Attributes:
        settings: when it presses steadily.
        held: whether something has been found pressing that has not gone or moved on yet.
    """

    settings: PressSettings = field(default_factory=PressSettings)
    held: bool = False
    _window: list[tuple[int, ArrayF, ArrayF]] = field(default_factory=list)
    _found_at_m: ArrayF = field(default_factory=lambda: np.full(3, np.nan))

    def update(self, time_ns: int, load: npt.NDArray[Any], pose: ArrayF | None) -> Press | None:
        """Take a frame; the press that is complete with it.

        Args:
            time_ns: of the frame.
            load: (n,) 0 where nothing touches, NaN where it is not known.
            pose: (3,) or (4, 4), at that time; None or not finite: it is not known.
        """
        loads = np.nan_to_num(np.asarray(load, np.float64), posinf=0.0)
        total = float(loads.sum())
        if pose is None or not np.isfinite(pose).all() or total <= 0:
            self._window.clear()
            self.held = self.held and total > 0
            return None
        settings = self.settings
        if self._window:
            _, first_load, first_pose = self._window[0]
            first = float(first_load.sum())
            is_steady = abs(total - first) <= settings.steady * max(total, first)
            if not is_steady or _moved_m(first_pose, pose) > settings.still_m:
                self._window.clear()
        if self.held and _moved_m(self._found_at_m, pose) > 2 * settings.still_m:
            self.held = False
        self._window.append((time_ns, loads, np.array(pose, np.float64)))
        if self.held or time_ns - self._window[0][0] < settings.hold_s * NS_PER_S:
            if self.held:
                del self._window[:-1]
            return None
        mean = np.mean([each for _, each, _ in self._window], axis=0)
        at = np.mean([each for _, _, each in self._window], axis=0)
        at = self._window[-1][2] if at.ndim == 2 else at  # the mean of rotations is none
        self._window.clear()
        self.held, self._found_at_m = True, at
        taxel = np.flatnonzero(mean > 0)
        return Press(at, taxel, mean[taxel])


def _moved_m(one: ArrayF, other: ArrayF) -> float:
    return float(np.linalg.norm(_origin(other) - _origin(one)))


def _origin(pose: ArrayF) -> ArrayF:
    """(3,) the point, or the origin of a frame."""
    origin: ArrayF = pose if pose.ndim == 1 else pose[:3, 3]
    return origin
