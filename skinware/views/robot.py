"""Read the robot under the skin: the places of its links, and their meshes.

From a file of links::

    format = "skinware-links"
    version = 1

    [[link]]
    frame = "chest"           # name of a coordinate frame of the geometry
    mesh = "chest.stl"        # beside this file; without it the link is only placed
    scale = 0.001             # of the mesh, which is in mm here; default: 1
    xyz = [0.0, 0.0, 1.1]     # m, and rotations about the fixed x, y and z, rad; default: 0
    rpy = [0.0, 0.0, 1.57]

or from a URDF file: its links with all joints at 0, and the STL meshes of their visuals.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import msgspec
import numpy as np

from skinware.errors import ConfigurationError
from skinware.toml_text import TomlText
from skinware.views.scene import Pose

FORMAT, VERSION = "skinware-links", 1
_SUFFIX = ".stl"
Triple = tuple[float, float, float]
_NOWHERE: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Mesh:
    """The mesh of a link; ``pose``: (4, 4) of the mesh in the link's coordinate frame, with its scale."""

    frame: str
    file: Path
    pose: Pose


@dataclass(frozen=True, eq=False)
class Robot:
    """(4, 4) poses of coordinate frames by name, meshes, and for people the parts of the file that are not used."""

    poses: dict[str, Pose] = field(default_factory=dict)
    meshes: tuple[Mesh, ...] = ()
    left_out: tuple[str, ...] = ()


class _Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    frame: str
    mesh: str | None = None
    scale: Annotated[float, msgspec.Meta(gt=0)] = 1.0
    xyz: Triple = _NOWHERE
    rpy: Triple = _NOWHERE


class _RobotFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    version: int
    link: tuple[_Link, ...] = ()


def read_robot(path: Path) -> Robot:
    """Read a file of links, or a URDF file; a ConfigurationError says what is wrong and where."""
    return _from_urdf(path) if path.suffix in (".urdf", ".xml") else _from_toml(path)


def pose_of(xyz: Triple, rpy: Triple) -> Pose:
    """Return (4, 4) from a translation, m, and rotations about the fixed axes x, y and z, rad."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    pose = np.eye(4)
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    pose[:3, 3] = xyz
    return pose


def _from_toml(path: Path) -> Robot:
    text = TomlText(path)
    poses: dict[str, Pose] = {}
    meshes = []
    for number, link in enumerate(text.of_format("file of links", FORMAT, VERSION, _RobotFile).link):
        pose = pose_of(link.xyz, link.rpy)
        place = text.place(("link", number))
        if not np.isfinite(pose).all():
            raise ConfigurationError(f"{place}: a number is not finite")
        if link.frame in poses:
            raise ConfigurationError(f"{place}: frame {link.frame!r} stands here twice")
        poses[link.frame] = pose
        if link.mesh is not None:
            file = path.parent / link.mesh
            if not file.is_file():
                raise ConfigurationError(f"{place}: there is no mesh {file}")
            if file.suffix.lower() != _SUFFIX:
                raise ConfigurationError(f"{place}: {file} is no STL file")
            meshes.append(Mesh(link.frame, file, np.diag([link.scale] * 3 + [1.0])))
    return Robot(poses, tuple(meshes))


def _from_urdf(path: Path) -> Robot:
    try:
        robot = ElementTree.parse(path).getroot()
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from None
    except (ElementTree.ParseError, ValueError) as error:
        raise ConfigurationError(f"{path}: not XML: {error}") from None
    if robot.tag != "robot":
        raise ConfigurationError(f"{path}: no URDF: it is a <{robot.tag}>, not a <robot>")
    try:
        poses = _poses(robot)
        meshes, left_out = _visuals(robot, path)
    except ValueError as error:
        raise ConfigurationError(f"{path}: {error}") from None
    return Robot(poses, tuple(meshes), tuple(left_out))


def _poses(robot: ElementTree.Element) -> dict[str, Pose]:
    above: dict[str, tuple[str, Pose]] = {}
    for joint in robot.iterfind("joint"):
        parent, child = (_name(joint.find(which), "link") for which in ("parent", "child"))
        above[child] = parent, _origin(joint)
    poses: dict[str, Pose] = {}
    for link in robot.iterfind("link"):
        name = _name(link, "name")
        pose, at, seen = np.eye(4), name, {name}
        while at in above:
            at, step = above[at]
            pose = step @ pose
            if at in seen:
                raise ValueError(f"link {name!r} is above itself")
            seen.add(at)
        poses[name] = pose
    return poses


def _visuals(robot: ElementTree.Element, path: Path) -> tuple[list[Mesh], list[str]]:
    meshes, left_out = [], []
    for link in robot.iterfind("link"):
        frame = _name(link, "name")
        for visual in link.iterfind("visual"):
            shape = visual.find("geometry/mesh")
            if shape is None:
                left_out.append(f"{frame}: a visual that is no mesh")
                continue
            name = _name(shape, "filename")
            file = _file(name, path)
            if file is None:
                left_out.append(f"{frame}: {name} is not there")
            elif file.suffix.lower() != _SUFFIX:
                left_out.append(f"{frame}: {name} is no STL file")
            else:
                scale = _triple(shape.get("scale"), (1.0, 1.0, 1.0))
                meshes.append(Mesh(frame, file, _origin(visual) @ np.diag([*scale, 1.0])))
    return meshes, left_out


def _file(name: str, urdf: Path) -> Path | None:
    """Find a file that a URDF names: beside it, or in the package that contains it in one of its folders."""
    scheme, has_scheme, rest = name.partition("://")
    if not has_scheme:
        candidates = [urdf.parent / name]
    elif scheme == "file":
        candidates = [Path(rest)]
    else:
        package, _, inside = rest.partition("/")
        folders = urdf.resolve().parents
        candidates = [folder / inside for folder in folders if folder.name == package]
        candidates += [folder / package / inside for folder in folders]
        candidates += [folder / inside for folder in list(folders)[:2]]
    return next((file for file in candidates if file.is_file()), None)


def _origin(element: ElementTree.Element) -> Pose:
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    return pose_of(_triple(origin.get("xyz"), _NOWHERE), _triple(origin.get("rpy"), _NOWHERE))


def _triple(text: str | None, otherwise: Triple) -> Triple:
    if text is None:
        return otherwise
    numbers = [float(number) for number in text.split()]
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise ValueError(f"{text!r} are not three numbers")
    return numbers[0], numbers[1], numbers[2]


def _name(element: ElementTree.Element | None, attribute: str) -> str:
    name = None if element is None else element.get(attribute)
    if not name:
        what = "a joint" if element is None else f"<{element.tag}>"
        raise ValueError(f"{what} without {attribute!r}")
    return name
