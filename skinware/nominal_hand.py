"""Nominal hands: fingers and a palm of typical lengths, for hands whose makers publish no places of taxels.

They show a person which taxels are neighbours, and on which finger they are. They are not measured, and all of a hand
lies in one plane. Coordinate frames are ``right_hand_nominal`` and ``left_hand_nominal`` for a hand with the
proportions of a human one, ``right_claw_nominal`` and ``left_claw_nominal`` for two fingers opposite to a thumb; with a
number behind for the second and further buses of a driver. x and y point to the right and up, as a person sees the palm
with the fingers up, and z out of the palm.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Side = Literal["right", "left"]
Build = Literal["hand", "claw"]
Point = tuple[float, float]

FINGERS = ("thumb", "index", "middle", "ring", "little")
PARTS = (*FINGERS, "palm")
_FRAME = re.compile(r"(right|left)_(hand|claw)_nominal( \d+)?")
_CORNERS = 48
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


class _Proportions(NamedTuple):
    """The parts of a right hand; its palm is what lies around circles of a radius."""

    parts: dict[str, HandPart]
    circles: tuple[Point, ...]
    radius: float


_HANDS: dict[str, _Proportions] = {
    "hand": _Proportions(
        {
            "thumb": HandPart((0.038, -0.050), (0.086, 0.030), 0.0115),
            "index": HandPart((0.036, -0.015), (0.036, 0.085), 0.0105),
            "middle": HandPart((0.012, -0.015), (0.012, 0.095), 0.0105),
            "ring": HandPart((-0.012, -0.015), (-0.012, 0.088), 0.0105),
            "little": HandPart((-0.036, -0.015), (-0.036, 0.070), 0.0105),
            "palm": HandPart((0.0, -0.070), (0.0, -0.010), 0.046),
        },
        ((-0.020, -0.052), (0.020, -0.052), (0.0265, -0.014), (-0.0265, -0.014)),
        0.02,
    ),
    "claw": _Proportions(
        {
            "thumb": HandPart((0.0, -0.050), (0.0, -0.142), 0.012),
            "index": HandPart((0.0285, -0.010), (0.0285, 0.092), 0.012),
            "middle": HandPart((-0.0285, -0.010), (-0.0285, 0.092), 0.012),
            "palm": HandPart((0.0, -0.060), (0.0, -0.006), 0.0405),
        },
        ((-0.018, -0.042), (0.018, -0.042), (0.0285, -0.012), (-0.0285, -0.012)),
        0.015,
    ),
}


@dataclass(frozen=True)
class NominalHand:
    """A nominal hand; a left one mirrors a right one.

    Attributes:
        build: ``claw``: two fingers, and a thumb in their middle that is drawn as if it were folded down.
    """

    side: Side = "right"
    build: Build = "hand"

    @classmethod
    def in_frame(cls, frame: str) -> NominalHand | None:
        """Return the hand with this coordinate frame; None for any other frame."""
        found = _FRAME.fullmatch(frame)
        if found is None:
            return None
        return cls("left" if found[1] == "left" else "right", "claw" if found[2] == "claw" else "hand")

    @property
    def frame(self) -> str:
        return f"{self.side}_{self.build}_nominal"

    @property
    def parts(self) -> Mapping[str, HandPart]:
        """Its parts, those of a right hand also where it is a left one."""
        return _HANDS[self.build].parts

    def parts_at(self, position_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
        """Return (n,) the numbers in ``PARTS`` of the parts on which places of its frame, (n, 3), are."""
        at = position_m[:, :2] * [1 if self.side == "right" else -1, 1]
        away = np.full((len(PARTS), len(at)), np.inf)
        for name, part in self.parts.items():
            along = np.subtract(part.end, part.root)
            share = np.clip((at - part.root) @ along / (along @ along), 0, 1)
            away[PARTS.index(name)] = np.linalg.norm(at - part.root - share[:, None] * along, axis=1) / part.half_width
        thumb, fingers = away[0], away[:-1]
        is_on_finger = (thumb < 1) | (at[:, 1] > self.parts["palm"].end[1])
        parts: npt.NDArray[np.int64] = np.where(is_on_finger, fingers.argmin(axis=0), len(FINGERS))
        return parts

    def outline(self, name: str) -> npt.NDArray[np.float64]:
        """Return (k, 3) m, the corners of a part, convex and counterclockwise as a person sees the palm."""
        (root, end, radius), shape = self.parts[name], _HANDS[self.build]
        back = _TOP * radius * np.subtract(root, end) / math.dist(root, end)
        centres = np.array([root, end + back])
        if name == "palm":
            centres, radius = np.array(shape.circles), shape.radius
        angle = np.linspace(0, 2 * np.pi, _CORNERS, endpoint=False)
        directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = centres[(centres @ directions.T).argmax(axis=0)] + radius * directions
        flat = np.pad(points, ((0, 0), (0, 1)))
        return flat if self.side == "right" else (flat * [-1, 1, 1])[::-1].copy()
