"""What ``skin-top`` draws of the chosen row: keeps scales and levels from frame to frame. No terminal needed."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from rich.text import Text

from skinware.cli._health import status_now
from skinware.cli._heat_map import Arrangement, arrange, codes_of, levels_of, marks_of
from skinware.cli._painting import marks_text, scale_text
from skinware.cli._top_rows import RowKey, patches_of, title_of
from skinware.driver_service import DriverFrame
from skinware.sensor_types import SensorType
from skinware.status import Status
from skinware.structure import Structure

_NAMED_STATUSES = {bit: str(bit.name).lower().replace("_", " ") for bit in Status}


class Picture:
    """The sensors of one type below one row of the list, drawn into a given room.

    Args:
        type_name: the type to draw where there is one of this name; otherwise each driver's first.

    Attributes:
        by_range: colours span the type's range where it has one; otherwise what was seen so far.
        arrangement: where sensors are; None before the first ``draw``.
        pixels: (2 * lines, columns) uint8, codes of the pixels last drawn.
        title: what is drawn, in words.
        scale: the colours with their values.
        marks: what the characters mean, with how many sensors have each.
    """

    def __init__(self, type_name: str | None = None) -> None:
        self.by_range = True
        self.arrangement: Arrangement | None = None
        self.pixels: npt.NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self.title = ""
        self.scale = Text()
        self.marks = Text()
        self._wanted = type_name
        self._seen: dict[tuple[str, str], tuple[float, float]] = {}
        self._levels: npt.NDArray[np.uint8] | None = None
        self._made_for: tuple[object, ...] = ()

    def type_in(self, structure: Structure) -> SensorType:
        """The type that is drawn of a skin of this structure."""
        return next((t for t in structure.types if t.name == self._wanted), structure.types[0])

    def next_type(self, structure: Structure) -> None:
        """Go over to the next type of the structure."""
        names = [t.name for t in structure.types]
        self._wanted = names[(names.index(self.type_in(structure).name) + 1) % len(names)]

    def other_scale(self) -> None:
        """Change between the type's range and the values seen from now on."""
        self.by_range = not self.by_range
        self._seen.clear()
        self._levels = None

    def draw(self, key: RowKey, frame: DriverFrame, width: int, height: int, life: str) -> None:
        """Draw a frame: sets all attributes but ``by_range``.

        Args:
            key: which row.
            frame: the frame of its driver.
            width: columns to draw in.
            height: lines to draw in.
            life: what the driver is doing; where nothing newer comes, no sensor is fresh.
        """
        sensor_type = self.type_in(frame.structure)
        made_for = (key, frame.structure, sensor_type, width, height)
        if self.arrangement is None or made_for != self._made_for:
            patches = patches_of(key, frame)
            self.arrangement = arrange(frame.structure, patches, sensor_type.name, width, height)
            self._made_for, self._levels = made_for, None
            self.title = title_of(key, frame.structure, patches, sensor_type.name, len(self.arrangement.sensors))
            if self._wanted not in (None, sensor_type.name):
                self.title += f" (there are no {self._wanted} sensors)"
        sensors = self.arrangement.sensors
        raw = frame.values[sensors].astype(np.float32)
        values = raw * np.float32(sensor_type.scale) + np.float32(sensor_type.offset)
        status = frame.status[sensors]
        low, high = self._limits(key.driver, sensor_type, values[status == 0])
        self._levels = levels_of(values, low, high, self._levels)
        marks = marks_of(status_now(life, status))
        self.pixels = self.arrangement.draw(codes_of(self._levels, marks))
        self.scale, self.marks = scale_text(sensor_type, low, high), marks_text(marks)

    def _limits(self, driver: str, sensor_type: SensorType, fresh: npt.NDArray[np.float32]) -> tuple[float, float]:
        if self.by_range and math.isfinite(sensor_type.minimum) and math.isfinite(sensor_type.maximum):
            return sensor_type.minimum, sensor_type.maximum
        low, high = self._seen.get((driver, sensor_type.name), (math.inf, -math.inf))
        finite = fresh[np.isfinite(fresh)]
        if len(finite):
            low, high = min(low, float(finite.min())), max(high, float(finite.max()))
            self._seen[driver, sensor_type.name] = low, high
        return (low, high) if low <= high else (0.0, 1.0)


def describe_sensor(frame: DriverFrame, position: int) -> str:
    """One sensor in words: where it is, its value, and what is wrong with it."""
    structure = frame.structure
    sensor_type = next(t for t in structure.types if t.id == structure.sensor_type[position])
    raw = frame.values[position].item()
    value = f"{sensor_type.offset + sensor_type.scale * raw:.5g} {sensor_type.unit}".strip()
    status = int(frame.status[position])
    states = ", ".join(name for bit, name in _NAMED_STATUSES.items() if status & bit) or "fresh"
    return (
        f"{sensor_type.name} sensor {position}: {value} (raw {raw:g}), {states}; module"
        f" {structure.sensor_module[position]}, uid {int(structure.sensor_uid[position]):#x}"
    )
