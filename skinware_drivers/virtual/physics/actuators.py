"""The actuators of a scene: moved by the binding's own moves, by commands of programs, or held."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware_drivers.virtual.physics.binding import Bound

_EPSILON_S = 1e-9


def names_of(model: Any, kind: Any, count: int) -> list[str]:
    """Return the names of MuJoCo's objects of a kind; the number of one that has no name."""
    names = [mujoco.mj_id2name(model, kind, number) for number in range(count)]
    return [str(number) if name is None else name for number, name in enumerate(names)]


class Actuators:
    """The targets of a scene's actuators.

    Attributes:
        poses: targets of actuators, by name of the pose.
        commanded_s: time of the scene at the newest command from outside; NaN: there was none.
    """

    def __init__(self, bound: Bound, model: Any, data: Any) -> None:
        self.names: list[str] = names_of(model, mujoco.mjtObj.mjOBJ_ACTUATOR, model.nu)
        self.poses: Mapping[str, Mapping[str, float]] = bound.binding.pose
        self._data = data
        self._moves, self._repeat_s = bound.binding.move, bound.binding.repeat_s
        self._ramps: dict[int, tuple[float, float, float, float]] = {}  # actuator -> begin, end, from, to
        self.reset()
        for name, pose in self.poses.items():
            self.check(pose, f"{bound.file}: pose {name!r}")

    def reset(self) -> None:
        self.commanded_s = math.nan
        self._next_move = self._round = 0
        self._ramps.clear()

    def move(self, targets: Mapping[str, float], seconds: float = 0.0) -> None:
        self.check(targets, "move")
        if not 0 <= seconds <= 3600:
            raise ConfigurationError(f"move: {seconds} s: give 0 to 3600")
        now_s = float(self._data.time)
        for name, target in targets.items():
            actuator = self.names.index(name)
            self._ramps[actuator] = now_s, now_s + seconds, float(self._data.ctrl[actuator]), float(target)

    def hold(self) -> None:
        """Stop every movement: the actuators keep the targets that they have."""
        self._ramps.clear()

    def course(self, steps: int, step_s: float) -> npt.NDArray[np.float64]:
        """Return (n, actuators) the targets of the next steps, at most ``steps``: up to the next move of the scene."""
        self._begin_moves()
        times_s = np.full(steps, step_s)
        times_s[0] = self._data.time
        times_s = np.cumsum(times_s)
        if self._next_move < len(self._moves):
            times_s = times_s[: max(1, int(np.searchsorted(times_s + _EPSILON_S, self._due_s())))]
        targets = np.repeat(self._data.ctrl[np.newaxis], len(times_s), axis=0)
        if self._ramps:
            moving = list(self._ramps)
            begin_s, end_s, start, target = np.array(list(self._ramps.values())).T
            passed = (times_s[:, np.newaxis] - begin_s) / np.maximum(end_s - begin_s, _EPSILON_S)
            share = np.where(times_s[:, np.newaxis] >= end_s, 1.0, passed)
            targets[:, moving] = start + share * (target - start)
            for row in np.flatnonzero(times_s[-1] >= end_s).tolist():
                del self._ramps[moving[row]]
        return targets

    def _due_s(self) -> float:
        return self._moves[self._next_move].at_s + self._round * (self._repeat_s or 0.0)

    def _begin_moves(self) -> None:
        while self._next_move < len(self._moves) and self._data.time + _EPSILON_S >= self._due_s():
            move = self._moves[self._next_move]
            self.move(self.poses[move.pose], move.seconds)
            self._next_move += 1
            if self._next_move == len(self._moves) and self._repeat_s is not None:
                self._next_move = 0
                self._round += 1

    def check(self, targets: Mapping[str, Any], where: str) -> None:
        for name, target in targets.items():
            if name not in self.names:
                raise ConfigurationError(f"{where}: there is no actuator {name!r}; there are {', '.join(self.names)}")
            if isinstance(target, bool) or not isinstance(target, int | float) or not math.isfinite(target):
                raise ConfigurationError(f"{where}: {name}={target!r} is no number")
