"""What somebody does to a skin, in a file.

::

    format = "skinware-stage"
    version = 1
    repeat_s = 12.0                     # from there it begins again; left out: it happens once

    [[push]]
    at_m = [0.07, 0.0225, 0.0]
    force_n = 3.0
    begin_s = 1.0
    end_s = 4.0

    [[stroke]]
    path_m = [[0.02, 0.0225, 0.0], [0.12, 0.0225, 0.0]]
    force_n = 4.0
    begin_s = 5.0
    end_s = 9.0
    radius_m = 0.006                    # and rise_s, fall_s, name: as of Gesture
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from skinware.errors import ConfigurationError
from skinware.tactile.testing.gestures import Gesture, Push, Stroke
from skinware.toml_text import TomlText

FORMAT, VERSION = "skinware-stage", 1

_Point = tuple[float, float, float]
_FINGER_RADIUS_M = 0.006


class _Act(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    force_n: float
    begin_s: float
    end_s: float
    rise_s: float = 0.05
    fall_s: float | None = None
    radius_m: float = _FINGER_RADIUS_M
    name: str = ""

    def of_gesture(self) -> dict[str, Any]:
        """As arguments of :class:`Gesture`."""
        how = {name: getattr(self, name) for name in ("begin_s", "end_s", "rise_s", "fall_s", "radius_m", "name")}
        return {**how, "force": self.force_n}


class _Push(_Act, frozen=True, forbid_unknown_fields=True, kw_only=True):
    at_m: _Point


class _Stroke(_Act, frozen=True, forbid_unknown_fields=True, kw_only=True):
    path_m: tuple[_Point, ...]


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    version: int
    repeat_s: Annotated[float, msgspec.Meta(gt=0)] | None = None
    push: tuple[_Push, ...] = ()
    stroke: tuple[_Stroke, ...] = ()


@dataclass(frozen=True)
class Play:
    """What somebody does, and when it begins again.

    Attributes:
        gestures: forces in N.
        repeat_s: after that time everything begins again; None: it happens once.
    """

    gestures: tuple[Gesture, ...]
    repeat_s: float | None


def read_stage(path: str | Path) -> Play:
    """Read a stage file.

    Raises:
        ConfigurationError: not there, not TOML, not of this format, or a value that is wrong; the message says where.
    """
    text = TomlText(Path(path))
    file = text.of_format("stage file", FORMAT, VERSION, _File)
    gestures: list[Gesture] = []
    of_kind: dict[str, tuple[_Push | _Stroke, ...]] = {"push": file.push, "stroke": file.stroke}
    for kind, acts in of_kind.items():
        for number, act in enumerate(acts):
            try:
                gestures.append(_gesture(act))
            except ConfigurationError as error:
                raise ConfigurationError(f"{text.place((kind, number))}: {error}") from None
    return Play(tuple(gestures), file.repeat_s)


def _gesture(act: _Push | _Stroke) -> Gesture:
    if isinstance(act, _Push):
        return Push(at_m=act.at_m, **act.of_gesture())
    return Stroke(path_m=act.path_m, **act.of_gesture())
