"""Read position files of skinGui: the places of a body part's taxels, and its channels that are not taxels.

Source: robotology/icub-main app/skinGui/conf/positions. Lines ``name FRAME``, ``spatial_sampling taxel|triangle``,
``taxel2Repr (...)``, then ``[calibration]`` and per channel ``x y z nx ny nz``, in metres in the frame of the link. In
``taxel2Repr``, -1 stands for a channel that is not a taxel, -2 for a thermal pad (some files write -1 for both).

In some files ``taxel2Repr`` is shorter than the list of places: beyond its end, a channel with a place is a taxel. Some
have no normals (0 0 0), or normals of another length than 1; their places are used.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

from skinware.errors import ConfigurationError
from skinware.geometry import Triple
from skinware_drivers.can.roboskin_options import CHANNELS
from skinware_drivers.icub.xml_tree import Notes, number, read_bytes

_CALIBRATION = "[calibration]"
_REPRESENTATIVES = re.compile(r"taxel2Repr\s*\(([^()]*)\)")
_MOST_TAXELS = 1 << 16
_FARTHEST_M = 10.0
_DIGITS = 6

Pose = tuple[Triple, Triple | None]
"""Place, and normal of length 1 if it is known."""


@dataclass(frozen=True)
class Positions:
    """A position file.

    Attributes:
        frame: the link with the coordinate frame of the numbers.
        tactile: by channel, whether it is a taxel.
        poses: by channel, in metres; None: the file has no place.
    """

    path: Path
    frame: str
    tactile: tuple[bool, ...]
    poses: tuple[Pose | None, ...]

    def non_tactile(self, first: int) -> tuple[int, ...]:
        """Return the channels that are not taxels, of the triangle that begins at channel ``first``."""
        return tuple(k for k, tactile in enumerate(self.tactile[first : first + CHANNELS]) if not tactile)


def is_positions(text: str) -> bool:
    return _CALIBRATION in text and "taxel2Repr" in text


def read_text(path: Path) -> str:
    """Read a text file; bytes that are not UTF-8 are kept as signs."""
    return read_bytes(path).decode("utf-8", "replace")


def read_positions(path: Path, notes: Notes) -> Positions:
    """Read a position file; note oddities."""
    text = read_text(path)
    head, mark, body = text.partition(_CALIBRATION)
    found = _REPRESENTATIVES.search(head)
    if not mark or found is None:
        raise ConfigurationError(f"{path}: not a position file: it has no taxel2Repr (...) before [calibration]")
    words = found[1].replace(",", " ").split()
    if len(words) > _MOST_TAXELS:
        raise ConfigurationError(f"{path}: taxel2Repr has {len(words)} numbers, more than a skin has taxels")
    try:
        representatives = [number(word) for word in words]
    except ValueError as error:
        raise ConfigurationError(f"{path}: taxel2Repr: {error}") from None
    fields = {}
    for line_number, line in enumerate(_REPRESENTATIVES.sub("", head).splitlines(), 1):
        key, _, value = line.strip().partition(" ") if " " in line.strip() else line.strip().partition("\t")
        if key in ("name", "spatial_sampling"):
            fields[key] = value.strip()
        elif key:
            notes.add("unknown", path, "not understood", line=line_number, element=line.strip()[:60])
    if fields.get("spatial_sampling", "taxel") != "taxel":
        text = "the file asks for one place per triangle; its places, one per channel, are kept"
        notes.add("info", path, text, element=f"spatial_sampling {fields['spatial_sampling']}")
    if not fields.get("name"):
        notes.add("missing", path, "no frame is named, so the axes of these numbers are unknown", element="name")
    poses = _poses(body, head.count("\n"), path, notes)
    return _fit(path, fields.get("name", ""), representatives, poses, notes)


def _poses(body: str, line_before: int, path: Path, notes: Notes) -> list[Pose | None]:
    poses: list[Pose | None] = []
    for line_number, line in enumerate(body.splitlines(), line_before + 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if len(poses) >= _MOST_TAXELS:
            raise ConfigurationError(f"{path}: more lines than a skin has taxels")
        pose, why = _pose(line)
        if why:
            notes.add("unknown", path, why, line=line_number, element=line.strip()[:60])
        poses.append(pose)
    return poses


def _pose(line: str) -> tuple[Pose | None, str]:
    words = line.replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return None, "not six numbers; no place"
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        return None, "not six numbers; no place"
    x, y, z, *normal = numbers
    if max(map(abs, (x, y, z))) > _FARTHEST_M:
        return None, f"farther than {_FARTHEST_M:g} m from the link: not in metres? no place"
    if not any(numbers):
        return None, ""
    length = math.hypot(*normal)
    if not 0 < length < math.inf:
        return ((x, y, z), None), ""
    nx, ny, nz = (round(component / length, _DIGITS) for component in normal)
    return ((x, y, z), (nx, ny, nz)), ""


def _fit(path: Path, frame: str, representatives: list[int], poses: list[Pose | None], notes: Notes) -> Positions:
    count = max(len(representatives), len(poses)) // CHANNELS * CHANNELS
    if not count:
        raise ConfigurationError(f"{path}: no whole triangle in taxel2Repr and [calibration]")
    for what, rest in (("taxel2Repr", representatives[count:]), ("[calibration]", poses[count:])):
        if rest:
            notes.add("odd", path, f"{len(rest)} entries after the last whole triangle; left out", element=what)
    poses = [*poses[:count], *[None] * (count - len(poses))]
    tactile = [representative >= 0 for representative in representatives[:count]]
    tactile += [pose is not None for pose in poses[len(tactile) :]]
    normals = [pose[1] for pose in poses if pose is not None]
    if None in normals:
        notes.add("info", path, f"{normals.count(None)} of {len(normals)} places have no normal")
    return Positions(path, frame, tuple(tactile), tuple(poses))
