"""The nominal hand: fingers and a palm of typical lengths, for hands whose makers publish none.

It shows a person which taxels are neighbours, and on which finger they are. It is not measured, and all of it lies in
one plane. Its coordinate frames are ``right_hand_nominal`` and ``left_hand_nominal``, with a number behind for the
second and further buses of a driver: x and y point to the right and up, as a person sees the palm with the fingers up,
and z out of the palm.
"""

from __future__ import annotations

import math
import re
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Side = Literal["right", "left"]
Point = tuple[float, float]

_FRAME = re.compile(r"(right|left)_hand_nominal( \d+)?")
_CORNERS = 48
_CIRCLES_OF_PALM = ((-0.020, -0.052), (0.020, -0.052), (0.0265, -0.014), (-0.0265, -0.014))
_ROUND = 0.02
"""Radius of these circles, around which the palm lies."""
_TOP = 0.4
"""How far a finger's last circle ends behind its end, in half widths, which leaves the rest above its grids."""


class HandPart(NamedTuple):
    """A part of a right hand, m.

    Attributes:
        root, end: of its middle line.
        half_width: the end is as round as it is wide.
    """

    root: Point
    end: Point
    half_width: float

    @property
    def turned_rad(self) -> float:
        """The angle from y to its middle line, about z."""
        return math.atan2(self.root[0] - self.end[0], self.end[1] - self.root[1])


PARTS = {
    "thumb": HandPart((0.038, -0.050), (0.086, 0.030), 0.0115),
    "index": HandPart((0.036, -0.015), (0.036, 0.085), 0.0105),
    "middle": HandPart((0.012, -0.015), (0.012, 0.095), 0.0105),
    "ring": HandPart((-0.012, -0.015), (-0.012, 0.088), 0.0105),
    "little": HandPart((-0.036, -0.015), (-0.036, 0.070), 0.0105),
    "palm": HandPart((0.0, -0.070), (0.0, -0.010), 0.046),
}
FINGERS = tuple(PARTS)[:-1]


def frame_of(side: Side) -> str:
    return f"{side}_hand_nominal"


def side_of(frame: str) -> Side | None:
    """Return the side of the hand whose frame this is; None for any other frame."""
    found = _FRAME.fullmatch(frame)
    return None if found is None else "left" if found[1] == "left" else "right"


def parts_at(position_m: npt.NDArray[np.float64], side: Side) -> npt.NDArray[np.int64]:
    """Return (n,) the numbers in ``PARTS`` of the parts on which places of a hand's frame, (n, 3), are."""
    at = position_m[:, :2] * [1 if side == "right" else -1, 1]
    away = np.empty((len(PARTS), len(at)))
    for number, part in enumerate(PARTS.values()):
        along = np.subtract(part.end, part.root)
        share = np.clip((at - part.root) @ along / (along @ along), 0, 1)
        away[number] = np.linalg.norm(at - part.root - share[:, None] * along, axis=1) / part.half_width
    thumb, fingers = away[0], away[:-1]
    is_on_finger = (thumb < 1) | (at[:, 1] > PARTS["palm"].end[1])
    parts: npt.NDArray[np.int64] = np.where(is_on_finger, fingers.argmin(axis=0), len(FINGERS))
    return parts


def outline(name: str, side: Side) -> npt.NDArray[np.float64]:
    """Return (k, 3) m, the corners of a part, convex and counterclockwise as a person sees the palm."""
    root, end, radius = PARTS[name]
    back = _TOP * radius * np.subtract(root, end) / math.dist(root, end)
    centres = np.array([root, end + back])
    if name == "palm":
        centres, radius = np.array(_CIRCLES_OF_PALM), _ROUND
    angle = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = centres[(centres @ directions.T).argmax(axis=0)] + radius * directions
    flat = np.pad(points, ((0, 0), (0, 1)))
    return flat if side == "right" else (flat * [-1, 1, 1])[::-1].copy()
