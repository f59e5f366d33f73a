"""Taxels on the bodies of a scene: their places, and the tactile sensors of MuJoCo that feel there.

MuJoCo turns the vertices of a mesh into its principal axes, but a tactile sensor takes them as if they were in the
frame of its geom. The places are therefore written into the compiled model, over those of a mesh that only counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.geometry import GeometryGroup, read_geometry
from skinware.tactile.testing import arm
from skinware_drivers.virtual.physics.binding import Bound, ModuleBinding

ArrayF = npt.NDArray[np.float64]

_FEWEST_VERTICES = 4
_FAR_M = 1e3
"""Where vertices are that feel nothing."""
_CHANNELS = 12
_FELT = (0, 1, 2, 3, 4, 5, 7, 8, 9, 11)
"""Channels of a triangle that feel pressure."""
_CLOSEST_M = 0.1
"""Height above a grid from which it is projected onto the body."""
_LONE_REACH_M = 0.005


@dataclass(frozen=True, eq=False)
class BoundTaxels:
    """n taxels on one body.

    Attributes:
        binding: where they come from.
        geoms: (k,) numbers of its geoms that touch others.
        position_m: (n, 3) in the frame of the body, m.
        axes: (n, 3, 3) x, y and outward normal of each, in the same frame, as rows.
        reach_m: distance from a contact to the nearest taxel from which they do not feel it, m.
    """

    binding: ModuleBinding
    body: int
    geoms: npt.NDArray[np.int64]
    position_m: ArrayF
    axes: ArrayF
    reach_m: float

    @property
    def name(self) -> str:
        return self.binding.name or self.binding.body

    def group(self, type_name: str, uid: npt.NDArray[np.integer[Any]]) -> GeometryGroup:
        return GeometryGroup(
            type=type_name,
            frame=self.binding.body,
            uid=tuple(uid.tolist()),
            position_m=tuple(map(tuple, self.position_m.tolist())),
            normal=tuple(map(tuple, self.axes[:, 2].tolist())),
            name=self.name,
        )


def place(model: Any, module: ModuleBinding, bound: Bound) -> BoundTaxels:
    name = module.name or module.body
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, module.body)
    if body < 0:
        raise ConfigurationError(f"{bound.file}: module {name!r}: {bound.scene} has no body {module.body!r}")
    geoms = np.flatnonzero((model.geom_bodyid == body) & ((model.geom_contype | model.geom_conaffinity) != 0))
    if not len(geoms):
        raise ConfigurationError(f"{bound.file}: module {name!r}: nothing can touch the body {module.body!r}")
    if module.geometry:
        geometry = read_geometry(bound.file.parent / module.geometry)
        first, last = module.uid
        rows = np.flatnonzero((geometry.frame == module.body) & (geometry.uid >= first) & (geometry.uid <= last))
        rows = rows[np.argsort(geometry.uid[rows])]
        position_m, normal = geometry.position_m[rows], np.nan_to_num(geometry.normal[rows], nan=0.0)
    elif module.arm_board is not None:
        surface = arm([module.arm_board], pads=True)
        position_m, normal = surface.position_m.copy(), surface.normal
        position_m[~np.isin(np.arange(len(position_m)) % _CHANNELS, _FELT)] = _FAR_M  # pads, which feel warmth
    else:
        position_m, normal = _projected(model, geoms, module, f"{bound.file}: module {name!r}")
    if not len(position_m):
        raise ConfigurationError(f"{bound.file}: module {name!r}: {module.geometry} has none of its taxels")
    axes = np.empty((len(position_m), 3, 3))
    x = np.array(module.x) / np.linalg.norm(module.x)
    for row, outward in enumerate(normal):
        third = outward if outward.any() else np.cross(module.x, module.y)
        third = third / np.linalg.norm(third)
        along = x - third * (x @ third)
        if np.linalg.norm(along) < 1e-3:  # x is the normal
            along = np.cross(module.y, third)
        along /= np.linalg.norm(along)
        axes[row] = along, np.cross(third, along), third
    return BoundTaxels(module, body, geoms, position_m, axes, module.reach_m or _reach(position_m))


def add_sensors(spec: Any, taxels: list[BoundTaxels]) -> None:
    for number, module in enumerate(taxels):
        step = np.arange(max(_FEWEST_VERTICES, len(module.position_m)))
        spiral = np.column_stack([np.cos(step), np.sin(step), 0.1 * step])
        for geom in module.geoms.tolist():
            name, touched = f"taxels {number} on {geom}", spec.geoms[geom]
            touched.name = touched.name or f"touched {geom}"
            spec.add_mesh(
                name=name,
                uservert=spiral.ravel(),
                userface=np.column_stack([step[:-2], step[1:-1], step[2:]]).ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            )
            spec.add_sensor(
                name=name,
                type=mujoco.mjtSensor.mjSENS_TACTILE,
                objtype=mujoco.mjtObj.mjOBJ_MESH,
                objname=name,
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname=touched.name,
            )


def place_sensors(model: Any, taxels: list[BoundTaxels]) -> list[list[int]]:
    """Write the places of all taxels into the sensors of a compiled scene.

    Returns:
        Where the values of each sensor of each module begin.
    """
    found: list[list[int]] = []
    for number, module in enumerate(taxels):
        found.append([])
        for geom in module.geoms.tolist():
            name = f"taxels {number} on {geom}"
            mesh = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MESH, name)
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            rotation = _rotation(model.geom_quat[geom])
            rows = slice(first, first + len(module.position_m))
            model.mesh_vert[first : first + count] = _FAR_M
            model.mesh_vert[rows] = (module.position_m - model.geom_pos[geom]) @ rotation
            model.mesh_normal[rows] = module.axes[:, 2] @ rotation
            sensor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
            found[-1].append(int(model.sensor_adr[sensor]))
    return found


def _rotation(quaternion: ArrayF) -> ArrayF:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _projected(model: Any, geoms: npt.NDArray[np.int64], module: ModuleBinding, where: str) -> tuple[ArrayF, ArrayF]:
    """Return (n, 3) places and normals of a grid that is let down onto the body's geoms."""
    across, along = (np.array(axis) / np.linalg.norm(axis) for axis in (module.x, module.y))
    up = np.cross(across, along)
    row, column = np.divmod(np.arange((module.rows or 1) * module.columns), module.columns)
    pitch_x, pitch_y = module.pitch_m
    flat = np.outer((column - (module.columns - 1) / 2) * pitch_x, across)
    flat += np.outer((row - ((module.rows or 1) - 1) / 2) * pitch_y, along) + module.at_m
    position_m, normal = np.empty_like(flat), np.empty_like(flat)
    data = mujoco.MjData(model)
    for number, point in enumerate(flat):
        best = np.inf
        for geom in geoms.tolist():
            turned = _rotation(model.geom_quat[geom]).ravel()
            data.geom_xpos[geom], data.geom_xmat[geom] = model.geom_pos[geom], turned
            outward = np.zeros(3)
            ray = point + _CLOSEST_M * up, -up
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                distance = mujoco.mj_rayMesh(model, data, geom, *ray, outward)
            else:
                kind = model.geom_type[geom]
                distance = mujoco.mju_rayGeom(model.geom_pos[geom], turned, model.geom_size[geom], *ray, kind, outward)
            if 0 <= distance < best:
                best = distance
                position_m[number], normal[number] = ray[0] + distance * ray[1], outward
        if best == np.inf:
            at = np.round(point * 1e3, 1).tolist()
            raise ConfigurationError(f"{where}: taxel {number} at {at} mm is not above the body {module.body!r}")
    return position_m, normal


def _reach(position_m: ArrayF) -> float:
    """Return one and a half of the largest distance between a taxel and its nearest one, m."""
    if len(position_m) == 1:
        return _LONE_REACH_M
    distance = np.linalg.norm(position_m[:, np.newaxis] - position_m, axis=2)
    np.fill_diagonal(distance, np.inf)
    return 1.5 * float(distance.min(axis=1).max())
