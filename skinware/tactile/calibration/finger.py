"""Place taxels from presses with a finger of unknown length, by the poses of its carrier.

The tip of the finger is at one place in the frame of its carrier, and each module is rigid. The unknowns are the tip (3
numbers) and the pose of each module (6). They follow from least squares over the distance of the tip from the centre of
the taxels that felt a press; soft L1 lowers the weight of bad presses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.arrays import Doubles, Flags
from skinware.tactile.calibration.placing import Placement, Presses, place
from skinware.tactile.calibration.shapes import Pose, Shape, fitted

_SOFT_M = 0.003
_ROUNDS = 60
_LEAST_PRESSES = 8
_WRONG_M = 0.02
_PROGRESS = 1e-6  # share of the cost: a round that gains less is the last
_LEAST_DAMPING, _MOST_DAMPING, _TINY = 1e-9, 1e6, 1e-12


def place_finger(
    presses: Presses, shapes: Mapping[int, Shape], tip_m: npt.ArrayLike = (0, 0, 0), *, offset_m: float = 0.0
) -> Placement:
    """Find the places of the tip and the modules.

    Args:
        presses: with (4, 4) poses of the finger's carrier, in the frame of the skin.
        shapes: shapes of modules, by number; taxels of others are left out.
        tip_m: first guess of the tip.
        offset_m: from the taxels outwards to the tip: the radius of a round one, whose middle it is, and the cover.

    Raises:
        ConfigurationError: presses without poses, too few of them, or no module that enough of them touched; an offset
            without normals.
    """
    if presses.pose.ndim != 3:
        raise ConfigurationError("presses with points do not determine a finger: give (4, 4) poses of its carrier")
    if len(presses) < _LEAST_PRESSES:
        raise ConfigurationError(f"{len(presses)} presses: a finger needs at least {_LEAST_PRESSES}")
    problem = _Problem.of(presses, shapes, np.asarray(tip_m, np.float64))
    problem.solve()
    return problem.placement().beneath(offset_m)


def _points_m(presses: Presses, tip_m: Doubles) -> Doubles:
    points: Doubles = presses.pose[:, :3, :3] @ tip_m + presses.pose[:, :3, 3]
    return points


@dataclass
class _Problem:
    """The search: poses of modules, and the tip."""

    presses: Presses
    shapes: dict[int, Shape]
    tip_m: Doubles
    poses: dict[int, Pose]
    shares: dict[int, Doubles]  # by module, (m, k): the share of each press that its taxels felt
    counting: Flags  # (m,) presses that only modules with poses felt

    @classmethod
    def of(cls, presses: Presses, shapes: Mapping[int, Shape], tip_m: Doubles) -> _Problem:
        guess = place(Presses(presses.n, _points_m(presses, tip_m), presses.press, presses.taxel, presses.load))
        known = guess.known
        weight = np.where(known, 1.0, 0.0)
        poses = {
            number: pose
            for number, shape in shapes.items()
            if (pose := fitted(shape, guess.position_m[shape.taxel], weight[shape.taxel])) is not None
        }
        if not poses:
            raise ConfigurationError("no module of a known shape was touched often enough")
        used = {number: shapes[number] for number in poses}
        total = np.bincount(presses.press, presses.load, len(presses))
        of_shape = np.zeros(presses.n, bool)
        for shape in used.values():
            of_shape[shape.taxel] = True
        felt = np.bincount(presses.press, presses.load * of_shape[presses.taxel], len(presses))
        counting = felt > (1 - 1e-9) * total
        dense = np.zeros((len(presses), presses.n))
        dense[presses.press, presses.taxel] = presses.load / total[presses.press]
        shares = {number: dense[:, shape.taxel] for number, shape in used.items()}
        if counting.sum() < _LEAST_PRESSES:
            raise ConfigurationError("too few presses are on modules of a known shape that were touched often enough")
        return cls(presses, used, tip_m.copy(), poses, shares, counting)

    def residuals(self) -> Doubles:
        """(m, 3) from the centre of the taxels that felt each press to the tip, m."""
        centre = np.zeros((len(self.presses), 3))
        for number, share in self.shares.items():
            centre += share @ self.poses[number].places_m(self.shapes[number])
        return _points_m(self.presses, self.tip_m) - centre

    def cost(self) -> float:
        squares = (self.residuals()[self.counting] ** 2).sum(axis=1)
        return float((np.sqrt(1 + squares / _SOFT_M**2) - 1).sum())

    def solve(self) -> None:
        """Take steps of Levenberg and Marquardt until nothing improves."""
        damping, cost = 1e-3, self.cost()
        for _ in range(_ROUNDS):
            matrix, right = self._normal_equations()
            diagonal = np.diag(np.diag(matrix) + _TINY * np.trace(matrix))
            before, gained = (self.tip_m, dict(self.poses)), 0.0
            while gained <= 0 and damping < _MOST_DAMPING:
                step = np.linalg.solve(matrix + damping * diagonal, right)
                self.tip_m = before[0] + step[:3]
                for (number, pose), (turn, shift) in zip(before[1].items(), step[3:].reshape(-1, 2, 3), strict=True):
                    self.poses[number] = Pose(_rotation(turn) @ pose.rotation, pose.origin_m + shift)
                gained = cost - self.cost()
                damping = damping * 4 if gained <= 0 else max(damping / 5, _LEAST_DAMPING)
            if gained <= 0:
                self.tip_m, self.poses = before
                return
            cost -= gained
            if gained <= _PROGRESS * cost:
                return

    def _normal_equations(self) -> tuple[Doubles, Doubles]:
        """Matrix and right side for a step of the tip and, by module, its turn and shift."""
        rows = self.counting
        residual = self.residuals()[rows]
        weight = 1 / np.sqrt(1 + (residual**2).sum(axis=1) / _SOFT_M**2)
        root = np.sqrt(weight)[:, None]
        blocks = [self.presses.pose[rows, :3, :3]]
        for number, share in self.shares.items():
            shape, pose = self.shapes[number], self.poses[number]
            arms = share[rows] @ (pose.places_m(shape) - pose.origin_m)
            blocks += [_crossing(arms), -share[rows].sum(axis=1)[:, None, None] * np.eye(3)]
        jacobian = np.concatenate(blocks, axis=2) * root[:, None]
        flat = jacobian.reshape(-1, jacobian.shape[2])
        return flat.T @ flat, -flat.T @ (residual * root).reshape(-1)

    def placement(self) -> Placement:
        n = self.presses.n
        position, normal, error = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full(n, np.nan)
        residual = np.linalg.norm(self.residuals(), axis=1)
        residual[~self.counting] = np.inf
        for number, shape in self.shapes.items():
            position[shape.taxel] = self.poses[number].places_m(shape)
            normal[shape.taxel] = self.poses[number].normals(shape)
            share = self.shares[number].sum(axis=1) * (residual < _WRONG_M)
            squares = np.where(np.isfinite(residual), residual, 0) ** 2
            many = max(share.sum() ** 2 / max((share**2).sum(), 1e-12), 1.0)
            error[shape.taxel] = np.sqrt((share * squares).sum() / max(share.sum(), 1e-12) * 2 / many)
        pressed, wrong = self.presses.times_pressed, residual >= _WRONG_M
        return Placement(position, normal, error, pressed, residual, wrong, tip_m=self.tip_m)


def _crossing(arm: Doubles) -> Doubles:
    """(m, 3, 3): the matrix of the cross product with each arm."""
    x, y, z = arm.T
    nothing = np.zeros_like(x)
    rows = [[nothing, -z, y], [z, nothing, -x], [-y, x, nothing]]
    return np.moveaxis(np.array(rows), 2, 0)


def _rotation(turn: Doubles) -> Doubles:
    """(3, 3) of a vector of rotation, rad (Rodrigues)."""
    angle = float(np.linalg.norm(turn))
    if angle < 1e-12:
        return np.eye(3)
    axis = _crossing((turn / angle)[None])[0]
    rotation: Doubles = np.eye(3) + np.sin(angle) * axis + (1 - np.cos(angle)) * axis @ axis
    return rotation
