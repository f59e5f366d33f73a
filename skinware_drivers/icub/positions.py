"""Position files of skinGui: where the taxels of a body part are, and which of its channels are none.

Source: robotology/icub-main app/skinGui/conf/positions. Lines ``name FRAME``, ``spatial_sampling taxel|triangle``,
``taxel2Repr (...)``, then ``[calibration]`` and per channel ``x y z nx ny nz``, in metres in the frame of the link. In
``taxel2Repr``, -1 stands for a channel that is no taxel, -2 for a thermal pad (some files write -1 for both).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

from skinware.errors import ConfigurationError
from skinware_drivers.can.roboskin_options import CHANNELS
from skinware_drivers.icub.notes import Notes
from skinware_drivers.icub.values import number
from skinware_drivers.icub.xml_tree import read_bytes

_CALIBRATION = "[calibration]"
_REPRESENTATIVES = re.compile(r"taxel2Repr\s*\(([^()]*)\)")
_MOST_TAXELS = 1 << 16
_FARTHEST_M = 10.0
_LENGTH_TOLERANCE = 0.02

Pose = tuple[float, float, float, float, float, float]
_NOWHERE: Pose = (0.0,) * 6


@dataclass(frozen=True)
class Positions:
    """One file.

    Attributes:
        path: of it.
        frame: the link in whose frame the numbers are.
        tactile: by channel, whether it is a taxel.
        poses: by channel, x y z in metres and the normal; None where the file has none.
    """

    path: Path
    frame: str
    tactile: tuple[bool, ...]
    poses: tuple[Pose | None, ...]

    def non_tactile(self, first: int) -> tuple[int, ...]:
        """Channels that are no taxels, of the triangle whose channels begin at ``first``."""
        return tuple(k for k, tactile in enumerate(self.tactile[first : first + CHANNELS]) if not tactile)


def is_positions(text: str) -> bool:
    """Whether a text looks like a position file."""
    return _CALIBRATION in text and "taxel2Repr" in text


def read_text(path: Path) -> str:
    """A text file; bytes that are no UTF-8 are kept as signs.

    Raises:
        ConfigurationError: it cannot be read.
    """
    return read_bytes(path).decode("utf-8", "replace")


def read_positions(path: Path, notes: Notes) -> Positions:
    """Read a file; what is odd about it is noted.

    Raises:
        ConfigurationError: it is no position file.
    """
    text = read_text(path)
    head, mark, body = text.partition(_CALIBRATION)
    found = _REPRESENTATIVES.search(head)
    if not mark or found is None:
        raise ConfigurationError(f"{path}: no file of positions: it has no taxel2Repr (...) before [calibration]")
    representatives = _representatives(found[1], path)
    fields = {}
    for line_number, line in enumerate(_REPRESENTATIVES.sub("", head).splitlines(), 1):
        key, _, value = line.strip().partition(" ") if " " in line.strip() else line.strip().partition("\t")
        if key in ("name", "spatial_sampling"):
            fields[key] = value.strip()
        elif key:
            notes.add("unknown", path, "not understood", line=line_number, element=line.strip()[:60])
    if fields.get("spatial_sampling", "taxel") != "taxel":
        text = "the file wants one place per triangle; its lines, one per channel, are taken as they are"
        notes.add("odd", path, text, element=f"spatial_sampling {fields['spatial_sampling']}")
    if not fields.get("name"):
        notes.add("missing", path, "no frame: the numbers are in a frame that has no name", element="name")
    poses = _poses(body, head.count("\n"), path, notes)
    return _fit(path, fields.get("name", ""), representatives, poses, notes)


def _representatives(text: str, path: Path) -> list[int]:
    words = text.replace(",", " ").split()
    if len(words) > _MOST_TAXELS:
        raise ConfigurationError(f"{path}: taxel2Repr has {len(words)} numbers, more than a skin has taxels")
    try:
        return [number(word) for word in words]
    except ValueError as error:
        raise ConfigurationError(f"{path}: taxel2Repr: {error}") from None


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
        poses.append(None if pose == _NOWHERE else pose)
    return poses


def _pose(line: str) -> tuple[Pose | None, str]:
    """The numbers of a line, or why they are none."""
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
    pose: Pose = (x, y, z, *normal)  # type: ignore[assignment]
    if pose != _NOWHERE and abs(math.hypot(*normal) - 1) > _LENGTH_TOLERANCE:
        return None, "the normal does not have the length 1; no place"
    return pose, ""


def _fit(path: Path, frame: str, representatives: list[int], poses: list[Pose | None], notes: Notes) -> Positions:
    """Both lists at one length, which is a whole number of triangles."""
    count = min(len(representatives), len(poses)) // CHANNELS * CHANNELS
    for what, rest, says_something in (
        ("taxel2Repr", representatives[count:], any(r >= 0 for r in representatives[count:])),
        ("[calibration]", poses[count:], any(pose is not None for pose in poses[count:])),
    ):
        if rest:
            text = f"{len(rest)} entries more than the {count} that both have; they are left out"
            level = "odd" if says_something else "unused"
            notes.add("odd" if level == "odd" else "unused", path, text, element=what)
    if not count:
        raise ConfigurationError(f"{path}: no whole triangle: taxel2Repr and [calibration] do not fit each other")
    return Positions(path, frame, tuple(r >= 0 for r in representatives[:count]), tuple(poses[:count]))


__all__ = ["Positions", "is_positions", "read_positions", "read_text"]
