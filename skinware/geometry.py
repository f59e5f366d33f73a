"""Where sensors are: a file of its own beside a driver, keyed by (type, uid), in metres.

The file is TOML. Sensors stand in groups that share a type and a frame::

    format = "skinware-geometry"
    version = 1

    [[group]]
    name = "torso, board 7, triangle 5"     # for people
    type = "pressure"
    frame = "chest"                         # whose axes the numbers are in
    radius_m = 0.002                        # of each sensor; may be left out
    confidence = 0.95                       # that a sensor is within half a pitch of its place; may be left out
    uid = [0x70500, 0x70501]
    position_m = [[0.01, 0.02, 0.03], [0.01, 0.03, 0.03]]
    normal = [[0.0, 0.0, 1.0], [nan, nan, nan]]     # outwards, of length 1; nan: not known; may be left out

``uid`` are those of the driver's structure. A sensor that the file does not have has no known place.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from skinware._columns import column, texts, within
from skinware.errors import ConfigurationError, StructureError
from skinware.toml_text import Keys, TomlText

FORMAT, VERSION = "skinware-geometry", 1

_LENGTH_TOLERANCE = 0.02
"""Largest deviation of a normal's length from 1: files give few digits."""
_LONGEST_NAME = 64
"""Longest name of a coordinate frame, bytes."""


class Sensors(Protocol):
    """Sensors in an order: a :class:`skinware.Structure`."""

    @property
    def sensor_uid(self) -> npt.NDArray[np.uint64]: ...

    def index(self, type_name: str, /) -> slice | npt.NDArray[np.int64]: ...


Triple = tuple[float, float, float]


class GeometryGroup(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Sensors of one type in one frame.

    Attributes:
        frame: name of the coordinate frame of the numbers.
        uid: of each sensor.
        position_m: of each sensor, m.
        normal: of each sensor, of length 1, outwards; NaN where it is not known, None if no normal is known.
        radius_m: of each of them, m; None if it is not known.
        confidence: 0 to 1, the part of them that is within half a pitch of its place, as estimated from
            measurements; None: not estimated.
    """

    type: str
    frame: str
    uid: tuple[Annotated[int, msgspec.Meta(ge=0)], ...]
    position_m: tuple[Triple, ...]
    normal: tuple[Triple, ...] | None = None
    radius_m: Annotated[float, msgspec.Meta(gt=0)] | None = None
    name: str = ""
    confidence: Annotated[float, msgspec.Meta(ge=0, le=1)] | None = None

    def __post_init__(self) -> None:
        if len(self.frame.encode()) > _LONGEST_NAME:
            raise ValueError(f"frame {self.frame!r} is longer than {_LONGEST_NAME} bytes")
        for what, rows in (("position_m", self.position_m), ("normal", self.normal)):
            if rows is None:
                continue
            if len(rows) != len(self.uid):
                raise ValueError(f"{len(self.uid)} uid, but {len(rows)} {what}")
            numbers = np.array(rows).reshape(-1, 3)
            good = np.isfinite(numbers).all(axis=1)
            if what == "normal":
                good |= np.isnan(numbers).all(axis=1)
            if not good.all():
                raise ValueError(f"{what}: a number is not finite")
        if self.normal:
            length = np.linalg.norm(np.array(self.normal), axis=1)
            wrong = np.flatnonzero(abs(length - 1) > _LENGTH_TOLERANCE)
            if len(wrong):
                row = int(wrong[0])
                raise ValueError(f"normal {row} has the length {length[row]:.3g}, not 1")


class _GeometryFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    version: int
    group: tuple[GeometryGroup, ...] = ()


@dataclass(frozen=True)
class Geometry:
    """Positions of n sensors.

    Attributes:
        type_name: (n,) str, name of each sensor's type.
        uid: (n,) uint64.
        frame: (n,) str, name of the coordinate frame; empty where the position is not known.
        position_m: (n, 3) float64, m; NaN where it is not known.
        normal: (n, 3) float64 of length 1; NaN where it is not known.
        radius_m: (n,) float64, m; NaN where it is not known.
        confidence: (n,) float64, that of the group of each in a file; NaN where it has none. Drivers do not publish it.
    """

    type_name: npt.NDArray[Any]
    uid: npt.NDArray[np.uint64]
    frame: npt.NDArray[Any]
    position_m: npt.NDArray[np.float64]
    normal: npt.NDArray[np.float64]
    radius_m: npt.NDArray[np.float64]
    confidence: npt.NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.uid)

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(n,) bool: the place is known."""
        known: npt.NDArray[np.bool_] = np.isfinite(self.position_m[:, 0])
        return known

    def of(self, structure: Sensors, type_name: str) -> Geometry:
        """Return the places of a skin's sensors of one type, in the order of ``structure.index(type_name)``.

        Raises:
            StructureError: the skin has no such type.
        """
        uid = structure.sensor_uid[structure.index(type_name)]
        return self.at([type_name] * len(uid), uid)

    def at(self, type_name: Sequence[str], uid: npt.NDArray[np.uint64]) -> Geometry:
        """Return the places of n sensors; not known where this geometry does not have them."""
        rows = {pair: row for row, pair in enumerate(zip(self.type_name.tolist(), self.uid.tolist(), strict=True))}
        found = np.array([rows.get(pair, -1) for pair in zip(type_name, uid.tolist(), strict=True)], np.int64)
        known, places = found >= 0, _empty(len(found))
        places.type_name[:], places.uid[:] = type_name, uid
        for name in ("position_m", "normal", "radius_m", "confidence", "frame"):
            getattr(places, name)[known] = getattr(self, name)[found[known]]
        return places

    def __getitem__(self, rows: slice | npt.NDArray[Any]) -> Geometry:
        return Geometry(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Geometry]) -> Geometry:
        """One after the other."""
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names)) if parts else _empty(0)

    @classmethod
    def unknown(cls, type_name: Sequence[str], uid: npt.NDArray[np.uint64]) -> Geometry:
        """Return the geometry of sensors whose places are not known."""
        return _empty(0).at(type_name, uid)

    def to_groups(self) -> list[GeometryGroup]:
        """Return the sensors with known places, for a file: a group for each type, frame, radius and confidence."""
        rows_of: dict[tuple[str, str, float | None, float | None], list[int]] = {}
        for row in np.flatnonzero(self.known).tolist():
            radius_m, confidence = (
                None if np.isnan(of[row]) else float(of[row]) for of in (self.radius_m, self.confidence)
            )
            rows_of.setdefault((self.type_name[row], self.frame[row], radius_m, confidence), []).append(row)
        return [
            GeometryGroup(
                type=type_name,
                frame=frame,
                uid=tuple(self.uid[rows].tolist()),
                position_m=_triples(self.position_m[rows]),
                normal=None if np.isnan(self.normal[rows]).all() else _triples(self.normal[rows]),
                radius_m=radius_m,
                confidence=confidence,
            )
            for (type_name, frame, radius_m, confidence), rows in rows_of.items()
        ]

    def to_columns(self) -> dict[str, npt.NDArray[np.generic]]:
        """As named columns, for a driver's file.

        Raises:
            StructureError: a frame's name is longer than 64 bytes.
        """
        frames, frame = np.unique(self.frame.astype(str), return_inverse=True)
        return {
            "sensor_position_m": self.position_m.astype("<f8").reshape(-1),
            "sensor_normal": self.normal.astype("<f8").reshape(-1),
            "sensor_radius_m": self.radius_m.astype("<f8"),
            "sensor_frame": frame.astype("<u4"),
            "frame_name": column("frame_name", frames, f"|S{_LONGEST_NAME}"),
        }

    @classmethod
    def from_columns(cls, columns: Mapping[str, npt.NDArray[Any]], type_name: Sequence[str]) -> Geometry | None:
        """Rebuild it from ``to_columns``' columns and ``sensor_uid``; None where there are none.

        Raises:
            StructureError: a column is missing, or has a wrong dtype or length.
        """
        if "sensor_position_m" not in columns:
            return None
        n = len(type_name)
        for name, code, count in (
            *((name, "<f8", 3 * n) for name in ("sensor_position_m", "sensor_normal")),
            ("sensor_radius_m", "<f8", n),
            ("sensor_frame", "<u4", n),
        ):
            if name not in columns or columns[name].dtype != np.dtype(code) or len(columns[name]) != count:
                raise StructureError(f"structure column {name!r} is missing or not {count} of {code}")
        frames = np.array(texts(columns["frame_name"]), object) if "frame_name" in columns else np.zeros(0, object)
        within("sensor", "frame", columns["sensor_frame"], len(frames))
        return cls(
            type_name=np.array(type_name, object),
            uid=np.array(columns["sensor_uid"]),
            frame=frames[columns["sensor_frame"]],
            position_m=np.array(columns["sensor_position_m"]).reshape(n, 3),
            normal=np.array(columns["sensor_normal"]).reshape(n, 3),
            radius_m=np.array(columns["sensor_radius_m"]),
            confidence=np.full(n, np.nan),
        )


def read_geometry(path: str | Path) -> Geometry:
    """Read a geometry file.

    Raises:
        ConfigurationError: not there, not TOML, not of this format, or a value that is wrong; the message says where.
    """
    return geometry_of(TomlText(Path(path)))


def geometry_of(text: TomlText) -> Geometry:
    """Return the contents of a geometry file.

    Raises:
        ConfigurationError: as for :func:`read_geometry`.
    """
    return _joined(text.of_format("geometry file", FORMAT, VERSION, _GeometryFile).group, text.place)


def geometry_to_toml(groups: Sequence[GeometryGroup], comment: str = "") -> str:
    lines = [*(f"# {line}".rstrip() for line in comment.splitlines()), f'format = "{FORMAT}"', f"version = {VERSION}"]
    for group in groups:
        lines += ["", "[[group]]"]
        for key in ("name", "type", "frame"):
            if text := getattr(group, key):  # JSON escapes as TOML does, but for DEL
                lines.append(f"{key} = {msgspec.json.encode(text).decode()}".replace("\x7f", "\\u007f"))
        for key in ("radius_m", "confidence"):
            if getattr(group, key) is not None:
                lines.append(f"{key} = {getattr(group, key)!r}")
        lines.append(f"uid = [{', '.join(f'{uid:#x}' for uid in group.uid)}]")
        for key in ("position_m", "normal"):
            rows = getattr(group, key)
            if rows is not None:
                lines.append(f"{key} = [")
                lines += [f"  [{', '.join(repr(float(number)) for number in row)}]," for row in rows]
                lines.append("]")
    return "\n".join(lines) + "\n"


def _joined(groups: Sequence[GeometryGroup], place: Callable[[Keys], str]) -> Geometry:
    geometry = _empty(sum(len(group.uid) for group in groups))
    known: dict[tuple[str, int], str] = {}
    row = 0
    for number, group in enumerate(groups):
        name = group.name or f"group {number + 1}"
        for uid in group.uid:
            why = ""
            if uid >= 1 << 64:
                why = f"uid {uid:#x} has more than 64 bits"
            elif (group.type, uid) in known:
                why = f"{group.type} sensor {uid:#x} is also in {known[group.type, uid]}"
            if why:
                raise ConfigurationError(f"{place(('group', number, 'uid'))}: {name}: {why}")
            known[group.type, uid] = name
        rows = slice(row, row + len(group.uid))
        geometry.type_name[rows], geometry.frame[rows] = group.type, group.frame
        geometry.uid[rows] = np.array(group.uid, np.uint64)
        geometry.position_m[rows] = np.array(group.position_m).reshape(-1, 3)
        if group.normal:
            normal = np.array(group.normal)
            geometry.normal[rows] = normal / np.linalg.norm(normal, axis=1)[:, None]
        if group.radius_m is not None:
            geometry.radius_m[rows] = group.radius_m
        if group.confidence is not None:
            geometry.confidence[rows] = group.confidence
        row = rows.stop
    return geometry


def _empty(n: int) -> Geometry:
    nowhere = np.full((n, 3), np.nan)
    return Geometry(
        type_name=np.full(n, "", object),
        uid=np.zeros(n, np.uint64),
        frame=np.full(n, "", object),
        position_m=nowhere.copy(),
        normal=nowhere,
        radius_m=np.full(n, np.nan),
        confidence=np.full(n, np.nan),
    )


def _triples(rows: npt.NDArray[np.float64]) -> tuple[Triple, ...]:
    return tuple((x, y, z) for x, y, z in rows.tolist())
