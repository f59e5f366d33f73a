"""Find the touches of a scene and spread their forces: what ``skinware_drivers/native/touching.c`` does, in numpy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from skinware_drivers.virtual.physics.scene import PhysicsScene, Touching
from skinware_drivers.virtual.physics.taxels import BoundTaxels

ArrayF = npt.NDArray[np.float64]

NEAREST = 4
SAME_WAY = 0.5 + 1e-9


def touches(scene: PhysicsScene) -> list[Touching]:
    """Return the contacts that the modules of a scene feel, each at either of its sides."""
    found = []
    contact, data, model = scene.data.contact, scene.data, scene.model
    for number in range(data.ncon):
        force, frame = np.zeros(6), contact.frame[number].reshape(3, 3)
        mujoco.mj_contactForce(model, data, number, force)
        bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom[number]]
        first, second = (_velocity(scene, body, contact.pos[number]) for body in bodies)
        slip_m_s = float(np.linalg.norm(frame[1:] @ (first - second)))
        for geom, body, sign in zip(contact.geom[number].tolist(), bodies, (-1, 1), strict=True):
            into = data.xmat[body].reshape(3, 3).T
            point_m, normal = into @ (contact.pos[number] - data.xpos[body]), into @ (-sign * frame[0])
            shear_n = into @ (sign * (force[1] * frame[1] + force[2] * frame[2]))
            reaches = [
                (float(distances(module, point_m, normal).min()), at)
                for at, module in enumerate(scene.modules)
                if geom in module.geoms
            ]
            near = [(reach_m, at) for reach_m, at in reaches if reach_m <= scene.modules[at].reach_m]
            if near:
                found.append(Touching(min(near)[1], point_m, normal, float(force[0]), shear_n, slip_m_s))
    return found


def _velocity(scene: PhysicsScene, body: int, place: ArrayF) -> ArrayF:
    turning, moving = scene.data.cvel[body, :3], scene.data.cvel[body, 3:]
    velocity: ArrayF = moving + np.cross(turning, place - scene.data.subtree_com[scene.model.body_rootid[body]])
    return velocity


def distances(taxels: BoundTaxels, point_m: ArrayF, normal: ArrayF) -> ArrayF:
    """Return (n,) distances of taxels from a contact, m; infinite for taxels that face another way."""
    distance: ArrayF = np.linalg.norm(taxels.position_m - point_m, axis=1)
    distance[taxels.axes[:, 2] @ normal < SAME_WAY] = np.inf
    return distance


def depths(scene: PhysicsScene, number: int) -> ArrayF:
    """Return (n,) MuJoCo's own tactile values of a module: depths, m."""
    geoms, n = scene.modules[number].geoms.tolist(), len(scene.modules[number].position_m)
    return np.sum([scene.data.sensor(f"taxels {number} on {geom}").data[:n] for geom in geoms], axis=0)  # type: ignore[no-any-return]


def spread(taxels: BoundTaxels, depth_m: ArrayF, felt: Sequence[Touching]) -> ArrayF:
    """Return (n, 3) forces on taxels, N: shear along x and y, and normal force.

    The force of a contact is spread over the taxels that are nearest to it, in proportion to their depth. Where none
    of them is inside the other body, the nearest few share it.
    """
    distance = np.array([distances(taxels, touch.point_m, touch.normal) for touch in felt])
    nearest, every = distance.argmin(axis=0), np.arange(distance.shape[1])
    weight = np.zeros_like(distance)
    weight[nearest, every] = np.where(np.isfinite(distance[nearest, every]), np.maximum(0.0, depth_m), 0.0)
    for number in np.flatnonzero(weight.sum(axis=1) == 0).tolist():
        rows = np.argsort(distance[number], kind="stable")[:NEAREST]
        weight[number, rows] = 1 / (distance[number, rows] + 1e-6)
    share = (weight / weight.sum(axis=1)[:, np.newaxis]).T
    force_n: ArrayF = np.einsum("nij,nj->ni", taxels.axes, share @ np.array([touch.shear_n for touch in felt]))
    force_n[:, 2] = share @ np.array([touch.normal_n for touch in felt])
    return force_n


def newtons(scene: PhysicsScene) -> list[ArrayF]:
    """Return the forces on the taxels of each module."""
    found: list[Any] = [np.zeros((len(module.position_m), 3)) for module in scene.modules]
    felt = touches(scene)
    for number in {touch.module for touch in felt}:
        of_module = [touch for touch in felt if touch.module == number]
        found[number] = spread(scene.modules[number], depths(scene, number), of_module)
    return found
