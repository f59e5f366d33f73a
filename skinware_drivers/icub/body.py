"""Read position files and drawings of skinGui, and find the places and kinds of a part's triangles.

Source: robotology/icub-main app/skinGui/conf/positions. Lines ``name FRAME``, ``spatial_sampling taxel|triangle``,
``taxel2Repr (...)``, then ``[calibration]`` and per channel ``x y z nx ny nz``, in metres in the frame of the link. In
``taxel2Repr``, -1 stands for a channel that is not a taxel, -2 for a thermal pad (some files write -1 for both).

In some files ``taxel2Repr`` is shorter than the list of places: beyond its end, a channel with a place is a taxel. Some
have no normals (0 0 0), or normals of another length than 1; their places are used.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec.structs

from skinware.errors import ConfigurationError
from skinware.geometry import GeometryGroup, Triple
from skinware.tactile.regions import Region
from skinware_drivers.can.roboskin_layout import CHANNELS, NON_TACTILE, TRIANGLES, runs_text
from skinware_drivers.icub.device import PortRange
from skinware_drivers.icub.part import DevicePart
from skinware_drivers.icub.xml_tree import Notes, read_bytes
from skinware_drivers.icub.xml_tree import number as whole_number

_CALIBRATION = "[calibration]"
_REPRESENTATIVES = re.compile(r"taxel2Repr\s*\(([^()]*)\)")
_MOST_TAXELS = 1 << 16
_FARTHEST_M = 10.0
_DIGITS = 6

Pose = tuple[Triple, Triple | None]
"""Place, and normal of length 1 if it is known."""


@dataclass(frozen=True)
class Positions:
    """A position file: by channel, whether it is a taxel, and its place in the frame of a link; None: it has none."""

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
    text = read_text(path)
    head, mark, body = text.partition(_CALIBRATION)
    found = _REPRESENTATIVES.search(head)
    if not mark or found is None:
        raise ConfigurationError(f"{path}: not a position file: it has no taxel2Repr (...) before [calibration]")
    words = found[1].replace(",", " ").split()
    if len(words) > _MOST_TAXELS:
        raise ConfigurationError(f"{path}: taxel2Repr has {len(words)} numbers, more than a skin has taxels")
    try:
        representatives = [whole_number(word) for word in words]
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


_SENSORS = "[SENSORS]"
Shape = tuple[str, tuple[int, ...]]
"""Kind of a module, and its channels that do not feel touch."""

_KINDS: dict[str, Shape] = {
    "triangle": ("triangle", ()),
    "triangle_10pad": ("triangle", NON_TACTILE["triangle"]),
    **dict.fromkeys(("fingertip", "fingertip2L", "fingertip2R", "fingertip3L", "fingertip3R"), ("fingertip", ())),
}
_PALMS = ("palmL", "palmR")
_TRIANGLES_OF_A_PALM = 4
_MOST_TRIANGLES = 256
_NOT_USED = ("cardid", "CanDeviceName", "CanDeviceNum", "width", "height", "xpos", "ypos")


@dataclass
class Drawing:
    """A drawing of skinGui: kinds of triangles by number (16 a board, as the body part counts); None: unknown."""

    path: Path
    part: str
    shapes: dict[int, Shape | None] = field(default_factory=dict)


def is_drawing(text: str) -> bool:
    return _SENSORS in text and "robotPart" in text


def read_drawing(path: Path, text: str, notes: Notes) -> Drawing:
    drawing = Drawing(path, "")
    in_sensors, unused = False, set[str]()
    for line_number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0] == _SENSORS:
            in_sensors = True
        elif in_sensors:
            why = _take_sensor(drawing, words)
            if why:
                notes.add("unknown", path, why, line=line_number, element=" ".join(words)[:60])
        elif words[0] == "robotPart":
            drawing.part = " ".join(words[1:])
        elif words[0] in _NOT_USED:
            unused.add(words[0])
        else:
            notes.add("unknown", path, "not understood", line=line_number, element=" ".join(words)[:60])
    if drawing.shapes:
        unused.add("x, y, orientation, gain, mirror and layout of each module")
    if unused:
        text = "for the picture on the screen only; not used"
        notes.add("info", path, text, element="; ".join(sorted(unused)))
    return drawing


def _take_sensor(drawing: Drawing, words: list[str]) -> str:
    """Add a module; return why it cannot be used, or an empty text."""
    try:
        triangle = whole_number(words[1])
    except (IndexError, ValueError):
        return "no number of a triangle; left out"
    if not 0 <= triangle < _MOST_TRIANGLES:
        return f"there is no triangle {triangle}; left out"
    if words[0] in _PALMS:
        for each in range(triangle, min(triangle + _TRIANGLES_OF_A_PALM, _MOST_TRIANGLES)):
            drawing.shapes[each] = "palm", NON_TACTILE["palm"]
        return ""
    drawing.shapes[triangle] = _KINDS.get(words[0])
    return "" if words[0] in _KINDS else f"a module of the kind {words[0]!r}, which is not known here"


_OF_A_BOARD = TRIANGLES * CHANNELS
_NO_NORMAL = (math.nan,) * 3

Place = tuple[int, int, int]
"""Patch, board, triangle."""


@dataclass
class Body:
    """The kinds and places of a part's triangles; the uids of places lack the bus.

    ``bare`` triangles have no taxel; ``drawn`` ones are in the drawing of a body part that has no positions.
    """

    shapes: dict[Place, Shape] = field(default_factory=dict)
    bare: set[Place] = field(default_factory=set)
    drawn: dict[str, set[Place]] = field(default_factory=dict)
    groups: dict[Place, list[GeometryGroup]] = field(default_factory=dict)


def on_bus(bus: int, groups: Iterable[GeometryGroup]) -> list[GeometryGroup]:
    """Return places whose uids have no bus yet, with the keys that a driver gives its bus of this number."""
    return [msgspec.structs.replace(group, uid=tuple(bus << 32 | uid for uid in group.uid)) for group in groups]


def read_body(
    part: DevicePart,
    ports: Sequence[PortRange],
    positions: Mapping[str, Positions],
    drawings: Mapping[str, Drawing],
    notes: Notes,
) -> Body:
    body = Body()
    for port in ports:
        channels = triangles_of(part, port, notes)
        if port.name in positions:
            _place(body, port, positions[port.name], channels, notes)
        elif port.name in drawings:
            _draw(body, port, drawings[port.name], channels, notes)
    return body


def triangles_of(part: DevicePart, port: PortRange, notes: Notes) -> dict[int, Place]:
    order = part.host_order
    triangles: dict[int, Place] = {}
    for index in range(port.first, port.last + 1):
        board, rest = divmod(index, _OF_A_BOARD)
        local = port.local_first + index - port.first
        if board >= len(order):
            text = f"goes to {port.last}, but the {len(order)} boards have {len(order) * _OF_A_BOARD} values"
            notes.at(port.element, "odd", text)
            break
        if rest % CHANNELS == 0 and local % CHANNELS == 0:
            triangles[local // CHANNELS] = (*order[board], rest // CHANNELS)
    return triangles


def _place(body: Body, port: PortRange, positions: Positions, triangles: Mapping[int, Place], notes: Notes) -> None:
    all_poses = [positions.poses[first : first + CHANNELS] for first in range(0, len(positions.poses), CHANNELS)]
    lost, without_a_place = 0, []
    for number, poses in enumerate(all_poses):
        place = triangles.get(number)
        shape = _shape(positions.non_tactile(number * CHANNELS))
        if place is None or shape is None:
            lost += sum(pose is not None for pose in poses)
            if place is not None:
                body.bare.add(place)
            continue
        body.shapes[place] = shape
        thermal = set(shape[1])
        groups = body.groups.setdefault(place, [])
        for type_name, of_type in (("pressure", set(range(CHANNELS)) - thermal), ("temperature", thermal)):
            known = {k: pose for k in sorted(of_type) if (pose := poses[k]) is not None}
            normals = [normal for _, normal in known.values()]
            if known:
                groups.append(
                    GeometryGroup(
                        type=type_name,
                        frame=positions.frame,
                        uid=tuple(place[1] << 16 | place[2] << 8 | channel for channel in known),
                        position_m=tuple(position for position, _ in known.values()),
                        normal=tuple(normal or _NO_NORMAL for normal in normals) if any(normals) else None,
                        name=f"{port.name}, board {place[1]}, triangle {place[2]}",
                    )
                )
        if not groups:
            without_a_place.append(place)
    if lost:
        text = f"{lost} places of triangles without a taxel, or that the port {port.name} does not have; left out"
        notes.add("odd", positions.path, text)
    if without_a_place:
        notes.add("info", positions.path, f"taxels without a place: {places_text(without_a_place)}")


def _shape(non_tactile: tuple[int, ...]) -> Shape | None:
    """Return the kind of a triangle by its channels that are not taxels; None: it has no taxel."""
    if len(non_tactile) == CHANNELS:
        return None
    for kind, usual in NON_TACTILE.items():
        if non_tactile == usual:
            return kind, usual
    return ("palm" if len(non_tactile) == 1 else "triangle"), non_tactile


def _draw(body: Body, port: PortRange, drawing: Drawing, triangles: Mapping[int, Place], notes: Notes) -> None:
    outside = [number for number in drawing.shapes if number not in triangles]
    if outside:
        text = f"draws triangles {runs_text(outside)}, which the port {port.name} does not have; left out"
        notes.add("odd", drawing.path, text)
    drawn = body.drawn.setdefault(port.name, set())
    for number, shape in drawing.shapes.items():
        if number not in triangles:
            continue
        place = triangles[number]
        drawn.add(place)
        known = body.shapes.get(place)
        if known is None and shape is not None and place not in body.bare:
            body.shapes[place] = shape
            if shape[0] == "palm":
                text = f"channel 11 of {places_text([place])} is taken to be thermal, as in most palm triangles"
                notes.add("info", drawing.path, text)


def check_drawings(body: Body, triangles: Mapping[str, set[Place]], enabled: set[Place], notes: Notes) -> None:
    """Note triangles that are drawn but off, or on but not drawn."""
    for name, drawn in body.drawn.items():
        on = triangles.get(name, set()) & enabled
        for which, what in ((drawn - on, "drawn, but off"), (on - drawn, "on, but not drawn")):
            if which:
                notes.add("odd", name, f"{what}: {places_text(which)}", element="skinGui's drawing")


def places_text(places: Sequence[Place] | set[Place]) -> str:
    boards: dict[tuple[int, int], list[int]] = {}
    for patch, board, triangle in sorted(places):
        boards.setdefault((patch, board), []).append(triangle)
    return "; ".join(f"patch {p} board {b}: {runs_text(triangles)}" for (p, b), triangles in boards.items())


def regions_of(
    driver: str, places: Mapping[str, set[Place]], enabled: set[Place], patches: Sequence[int]
) -> list[Region]:
    """Return a region for each body part with a triangle that is on; patches are in the order of the driver's buses."""
    boards = Counter(board for _, board in {(patch, board) for patch, board, _ in enabled})
    regions = []
    for name, of_part in places.items():
        on = of_part & enabled
        by_name, by_uid = set[int](), list[int]()
        for patch, board, triangle in sorted(on):
            of_board = {place for place in enabled if place[:2] == (patch, board)}
            if boards[board] == 1 and of_board <= on:
                by_name.add(board)
            else:  # several boards have this name, or the part has not this board
                first = patches.index(patch) << 32 | board << 16 | triangle << 8
                by_uid += range(first, first + CHANNELS)
        if on:
            patch_names = tuple(f"board {board}" for board in sorted(by_name))
            regions.append(Region(name, "pressure", (driver,), tuple(by_uid), patch_names))
    return regions
