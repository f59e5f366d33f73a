"""Skins of an iCub that are pressed and stroked, and how near to the truth a calibration comes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.tactile.baseline import Baseline
from skinware.tactile.calibration.placing import Presses
from skinware.tactile.calibration.shapes import Shape, shapes_of
from skinware.tactile.calibration.topology import StrokeSums, Topology, shortest_m
from skinware.tactile.testing import Response, Surface, World
from skinware_drivers.icub.body import read_positions
from skinware_drivers.icub.xml_tree import Notes
from tests.tactile.skins import placed

ArrayF = npt.NDArray[np.float64]
ArrayI = npt.NDArray[np.int64]

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "icub_geometry"
PARTS = {"torso": "torso.txt", "forearm": "left_forearm_V2.txt", "foot": "left_foot.txt"}
"""Of the robot."""
PITCH_M = 0.0065
_CHANNELS, _TRIANGLES = 12, 16
_NOISE, _FORCE, _BELL_M, _GAIN_SPREAD = 1.5, 80.0, 0.004, 0.3
_BESIDE_M = 0.006
_STROKE_S, _REST_S, _RATE_HZ = 1.5, 6.0, 50.0
_SPEED_M_S, _STEP_M = 0.08, 0.004


def part(name: str) -> Surface:
    """The taxels of a part of an iCub, one at each place: modules are triangles, patches are boards."""
    found = read_positions(DATA / PARTS[name], Notes())
    poses = [found.poses[k] if found.tactile[k] else None for k in range(len(found.poses))]
    rows = [(k, pose) for k, pose in enumerate(poses) if pose is not None]
    position = np.array([pose[0] for _, pose in rows])
    normal = np.array([(np.nan,) * 3 if pose[1] is None else pose[1] for _, pose in rows])
    channel = np.array([k for k, _ in rows])
    _, first = np.unique(np.round(position, 5), axis=0, return_index=True)
    first.sort()
    module, patch = (np.unique(channel[first] // size, return_inverse=True)[1] for size in (12, 192))
    return Surface(position[first], normal[first], module.astype(np.int64), patch.astype(np.int64))


def geometry_of(surface: Surface) -> Geometry:
    """As a file has it."""
    return placed(surface.position_m, "part", surface.normal)


def shapes(surface: Surface) -> dict[int, Shape]:
    """Of the modules."""
    return shapes_of(surface.module, [""] * surface.n_modules, surface.position_m, surface.normal)


def tangents(position_m: ArrayF) -> ArrayF:
    """(n, 2, 3) two directions along the skin at each taxel, by its nearest ones."""
    distance = np.linalg.norm(position_m[:, None] - position_m, axis=2)
    near = np.argsort(distance, axis=1)[:, :8]
    around = position_m[near] - position_m[near].mean(axis=1, keepdims=True)
    return np.linalg.svd(around, full_matrices=False)[2][:, :2]


def presses(surface: Surface, seed: int, *, each: int = 5, pose_noise_m: float = 0.001, wrong: float = 0.0) -> Presses:
    """Presses up to 6 mm beside each taxel, with 8 bits, noise of 1.5 counts and gains that spread by 30 %.

    Args:
        surface: that is pressed.
        seed: of all that is random.
        each: presses beside each taxel.
        pose_noise_m: standard deviation in each axis.
        wrong: part of the presses that are said to be at other taxels.
    """
    random = np.random.default_rng(seed)
    position, n = surface.position_m, len(surface)
    taxel = np.repeat(np.arange(n), each)
    radius = _BESIDE_M * np.sqrt(random.random(len(taxel)))
    angle = random.uniform(0, 2 * np.pi, len(taxel))
    beside = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    true = position[taxel] + np.einsum("ij,ijk->ik", beside, tangents(position)[taxel])
    gain = np.clip(1 + _GAIN_SPREAD * random.standard_normal(n), 0.3, 3)
    distance = np.linalg.norm(true[:, None] - position, axis=2)
    load = _FORCE * gain * np.exp(-0.5 * (distance / _BELL_M) ** 2) + _NOISE * random.standard_normal(distance.shape)
    load = np.clip(np.rint(load), 0, 240)
    load[load < 5 * _NOISE] = 0
    said = true + pose_noise_m * random.standard_normal(true.shape)
    is_wrong = random.random(len(said)) < wrong
    said[is_wrong] = position[random.integers(0, n, int(is_wrong.sum()))]
    return Presses.of_arrays(said, load)


@dataclass(frozen=True)
class Tool:
    """Errors of the points of presses, one each 3 s.

    Attributes:
        drift_m: from the first press to the last.
        step_m: of the points after 55 % of the presses.
        scale: of the points about the origin.
        offset_m: of all points.
        lag_s: by which points are old.
        play_m: between points from opposite directions.
    """

    drift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    step_m: float = 0.0
    scale: float = 1.0
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lag_s: float = 0.0
    play_m: float = 0.0


def with_tool(surface: Surface, given: Presses, seed: int, tool: Tool, *, in_order: bool = False) -> Presses:
    """The same presses by such a tool, in any order or (``in_order``) taxel by taxel, from all directions."""
    random, m = np.random.default_rng([seed, 5]), len(given)
    order = np.arange(m) if in_order else random.permutation(m)
    number = np.argsort(order)[given.press]
    rows = np.argsort(number, kind="stable")
    true, time_s = given.pose[order], 3.0 * np.arange(m)
    nearest = np.argmin(np.linalg.norm(true[:, None] - surface.position_m, axis=2), axis=1)
    way = np.einsum("mi,mij->mj", random.standard_normal((m, 2)), tangents(surface.position_m)[nearest])
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    velocity = way * random.uniform(0, 0.008, m)[:, None]
    past = time_s[:, None] / time_s[-1]
    said = tool.scale * true + tool.offset_m + past * tool.drift_m + (past > 0.55) * [tool.step_m, 0, 0]
    said -= tool.lag_s * velocity + tool.play_m / 2 * way
    motion = np.column_stack([time_s, velocity, way])
    return Presses(given.n, said, number[rows], given.taxel[rows], given.load[rows], motion)


def off_m(surface: Surface, position_m: ArrayF) -> ArrayF:
    """(n,) from the true places; NaN where none was found."""
    distance: ArrayF = np.linalg.norm(position_m - surface.position_m, axis=1)
    return distance


def strokes(surface: Surface, seed: int, minutes: float) -> list[ArrayF]:
    """Paths along the skin, one for each 1.5 s: from any taxel in any direction."""
    random = np.random.default_rng([seed, 7])
    along = tangents(surface.position_m)
    paths = []
    for _ in range(int(minutes * 60 / _STROKE_S)):
        at = surface.position_m[random.integers(len(surface))].copy()
        way = random.standard_normal(3)
        path = [at]
        for _ in range(int(_SPEED_M_S * _STROKE_S / _STEP_M)):
            distance = np.linalg.norm(surface.position_m - at, axis=1)
            near = np.argsort(distance)[:6]
            plane = along[near[0]]
            way = plane.T @ (plane @ way)
            way *= _STEP_M / max(float(np.linalg.norm(way)), 1e-12)
            if distance[near[0]] > _BESIDE_M + _STEP_M:
                way = surface.position_m[near[0]] - at  # over the edge: back
            at = at + way
            middle = surface.position_m[near].mean(axis=0)
            normal = np.cross(*plane)
            at = at - normal * (normal @ (at - middle))
            path.append(at)
        paths.append(np.array(path))
    return paths


def stroked(surface: Surface, seed: int, minutes: float = 3.0) -> StrokeSums:
    """A finger strokes the skin for some minutes; its frames go through a baseline."""
    world = World(
        surface, seed=seed, rate_hz=_RATE_HZ, noise=_NOISE, gain_spread=_GAIN_SPREAD, response=Response(width_m=_BELL_M)
    )
    for number, path in enumerate(strokes(surface, seed, minutes)):
        begin_s = _REST_S + number * _STROKE_S
        world.stroke(path, _FORCE, begin_s, begin_s + _STROKE_S)
    baseline = Baseline(surface.module, surface.patch)
    sums = StrokeSums.empty(len(surface))
    for block in world.blocks(_REST_S + minutes * 60):
        calm = [baseline.update(s.time_ns, s.values.astype(np.float32), s.usable).value for s in block]
        sums.add(np.array(calm))
    return sums


@dataclass(frozen=True)
class TopologyMarks:
    """How good a topology is.

    Attributes:
        pieces: how many were found.
        pieces_right: whether they are the true ones, taxel by taxel, of those that are covered.
        precision: the part of the found neighbours that are within 12 mm.
        recall: the part of the taxels within 9 mm of each other that were found as neighbours.
        geodesic: median error of ways along the skin, as a part of them.
        covered: the part of the taxels that are.
    """

    pieces: int
    pieces_right: bool
    precision: float
    recall: float
    geodesic: float
    covered: float


def true_ways_m(surface: Surface, reach_m: float = 0.012) -> ArrayF:
    """(n, n) ways along the skin, over taxels that are within reach of each other; inf between pieces."""
    distance = np.linalg.norm(surface.position_m[:, None] - surface.position_m, axis=2)
    return shortest_m(np.where(distance <= reach_m, distance, np.inf))


def judge(surface: Surface, topology: Topology, ways_m: ArrayF) -> TopologyMarks:
    """Compare with the truth."""
    distance = np.linalg.norm(surface.position_m[:, None] - surface.position_m, axis=2)
    np.fill_diagonal(distance, np.inf)
    one, other = topology.pairs.T
    found = np.zeros(distance.shape, bool)
    found[one, other] = found[other, one] = True
    covered = topology.piece >= 0
    rows = np.flatnonzero(covered)
    mine, truth = topology.geodesics_m(rows), ways_m[np.ix_(rows, rows)]
    same = topology.piece[rows, None] == topology.piece[rows]
    apart = np.triu(np.isfinite(truth) & np.isfinite(mine) & (truth > 0))
    return TopologyMarks(
        topology.n_pieces,
        bool((np.isfinite(truth) == same).all()),
        float((distance[found] <= 0.012).mean()),
        float(found[distance < 0.009].mean()),
        float(np.median(abs(mine[apart] - truth[apart]) / truth[apart])),
        float(covered.mean()),
    )
