"""Drawings of skinGui (``.ini``): which triangles a body part has, and what they are; their places are on a screen.

Source: robotology/icub-main app/skinGui/conf/skinGui. Lines ``robotPart NAME``, then ``[SENSORS]`` and per module
``type id x y orientation gain mirror [layout]``; 16 ids per board, in the order of ``cardid``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from skinware.errors import ConfigurationError
from skinware_drivers.can.roboskin_options import NON_TACTILE
from skinware_drivers.icub.notes import Notes
from skinware_drivers.icub.positions import read_text
from skinware_drivers.icub.values import number

_SENSORS = "[SENSORS]"
Shape = tuple[str, tuple[int, ...]]
"""Kind of a module, and its channels that feel no touch."""

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
    """One file.

    Attributes:
        path: of it.
        part: the body part.
        shapes: by triangle (16 per board, in the body part's own count), what it is; None where nobody here knows.
    """

    path: Path
    part: str
    shapes: dict[int, Shape | None] = field(default_factory=dict)


def is_drawing(text: str) -> bool:
    """Whether a text looks like a drawing of skinGui."""
    return _SENSORS in text and "robotPart" in text


def read_drawing(path: Path, notes: Notes) -> Drawing:
    """Read a file; what is not understood is noted.

    Raises:
        ConfigurationError: it is no drawing.
    """
    text = read_text(path)
    if not is_drawing(text):
        raise ConfigurationError(f"{path}: not a drawing of skinGui: it has no robotPart and [SENSORS]")
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
    """Take one module; returns why not, if so."""
    try:
        triangle = number(words[1])
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
