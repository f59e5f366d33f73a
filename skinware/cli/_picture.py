"""Draw the chosen row of skin-top from snapshot to snapshot, without a terminal: baselines, levels and scales."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from rich.text import Text

from skinware.cli._heat_map import Arrangement, arrange, codes_of, levels_of, marks_of
from skinware.cli._painting import TRUE_COLOURS, Palette, marks_text, scale_text
from skinware.cli._top_rows import RowKey, patches_of, title_of
from skinware.driver_snapshot import DriverSnapshot
from skinware.sensor_types import SensorType
from skinware.skin_layout import SkinLayout
from skinware.state import count_reasons, settling, status_now
from skinware.structure import Structure
from skinware.tactile.regions import Regions
from skinware.text import measure_text, status_text, why_text
from skinware.views.history import DriverRest, Memory
from skinware.views.quantities import types_of

Levels = npt.NDArray[np.uint8]

CHANGE, RANGE, RAW = "change", "range", "raw"
SCALES = (CHANGE, RANGE, RAW)
"""Names of the scales, in the order in which a person goes through them."""
_EVERYTHING = (-math.inf, math.inf)
_THREE_FROM_WIDTH = 76
"""Columns from which the scale has the value of its middle, too."""


def change_levels(
    change: npt.NDArray[np.float32], noise: float, span: float, before: Levels | None = None
) -> tuple[Levels, tuple[float, float, float]]:
    """Return the levels of changes, and the changes at the lowest, the middle and the highest level.

    Levels grow with the square root, so that the lightest touch differs from none, and a light one from a hard one.
    """
    felt = np.sqrt(np.maximum(change - np.float32(noise), 0))
    return levels_of(felt, 0.0, math.sqrt(max(span - noise, 1e-30)), before), (0.0, span / 4, span)


class Picture:
    """The sensors of one type in one row of the list, drawn into a given space.

    Attributes:
        pixels: (2 * lines, columns) uint8, codes of the pixels last drawn.
        marks: the meaning of the characters, with the number of sensors for each.
    """

    def __init__(
        self,
        type_name: str | None = None,
        scale_name: str = CHANGE,
        palette: Palette = TRUE_COLOURS,
        *,
        regions: Regions | None = None,
        region: str | None = None,
    ) -> None:
        self.scale_name = scale_name
        self.regions, self._region = regions, region
        self.arrangement: Arrangement | None = None
        self.pixels: npt.NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self.title = ""
        self.scale = Text()
        self.marks = Text()
        self._wanted = type_name
        self._palette = palette
        self._memories: dict[str, Memory] = {}
        self._layouts: dict[str, SkinLayout] = {}
        self._levels: Levels | None = None
        self._made_for: tuple[object, ...] = ()

    def next_type(self, structure: Structure) -> None:
        names = [t.name for t in types_of(structure)]
        self._wanted = names[(names.index(self.type_in(structure).name) + 1) % len(names)]

    def next_scale(self) -> None:
        self.scale_name = SCALES[(SCALES.index(self.scale_name) + 1) % len(SCALES)]
        self._levels = None

    def next_region(self) -> None:
        """Go on to the next region; after the last one to all sensors."""
        names = [None, *(region.name for region in self.regions or ())]
        self._region = names[(names.index(self._region) + 1) % len(names)]

    def regions_of(self, driver: str, position: int) -> list[str]:
        structure = self._memories[driver].structure
        in_regions = self._in_regions(driver, structure, _type_of(structure, position).name)
        return [name for name, is_inside in in_regions.items() if is_inside[position]]

    def take_baselines(self) -> None:
        """Take the next values for rest."""
        for memory in self._memories.values():
            memory.rest = DriverRest(memory.structure)
        self._levels = None

    def draw(self, key: RowKey, frame: DriverSnapshot, width: int, height: int, life: str) -> None:
        """Draw a snapshot: set ``arrangement``, ``pixels`` and the texts; ``life`` says whether news comes."""
        structure = frame.structure
        sensor_type, physical = self.type_in(structure), frame.physical_values()
        memory = self._memories.get(key.driver)
        if memory is None or memory.structure is not structure:
            memory = self._memories[key.driver] = Memory(structure)
            self._layouts[key.driver] = SkinLayout((key.driver,), (structure,))
        memory.rest.follow(physical, frame.status == 0, frame.published_ns)
        made_for = (key, structure, sensor_type, self._region, width, height)
        if self.arrangement is None or made_for != self._made_for:
            self.arrangement = self._arrange(key, structure, sensor_type.name, width, height)
            self._made_for, self._levels = made_for, None
        sensors = self.arrangement.sensors
        name, self._levels, values = self._scaled(memory, frame, physical, sensors, sensor_type)
        waiting = settling(frame)[sensors]
        marks = marks_of(status_now(life, frame)[sensors], waiting)
        self.pixels = self.arrangement.draw(codes_of(self._levels, marks))
        unit = "" if name == RAW else sensor_type.unit
        values = values if width >= _THREE_FROM_WIDTH else (values[0], values[-1])
        self.scale = Text(f"{name} ", no_wrap=True).append_text(scale_text(values, unit, self._palette))
        reasons = count_reasons(frame.why[sensors][~waiting])
        reasons.pop("rest", None)
        self.marks = marks_text(marks, reasons, self._palette)

    def type_in(self, structure: Structure) -> SensorType:
        types = types_of(structure)
        return next((t for t in types if t.name == self._wanted), types[0])

    def _in_regions(self, driver: str, structure: Structure, type_name: str) -> dict[str, npt.NDArray[np.bool_]]:
        """Return (n_sensors,) bool for each region: the sensors of a type in it."""
        if self.regions is None:
            return {}
        sensors = structure.index(type_name)
        found = self.regions.of(self._layouts[driver], type_name)
        inside = {region.name: np.zeros(structure.n_sensors, bool) for region in self.regions}
        for name, index in found.items():
            inside[name][sensors[index]] = True
        return inside

    def _arrange(self, key: RowKey, structure: Structure, type_name: str, width: int, height: int) -> Arrangement:
        patches, region = patches_of(key, structure), self._region
        smallest = 2 if self._palette.characters else 1
        only = None if region is None else self._in_regions(key.driver, structure, type_name)[region]
        arrangement = arrange(structure, patches, type_name, width, height, smallest=smallest, only=only)
        self.title = title_of(key, structure, patches, type_name, len(arrangement.sensors))
        self.title += "" if region is None else f", in {region}"
        if self._wanted not in (None, type_name):
            self.title += f" (there are no {self._wanted} sensors)"
        return arrangement

    def _scaled(
        self,
        memory: Memory,
        frame: DriverSnapshot,
        physical: npt.NDArray[np.float32],
        sensors: npt.NDArray[np.int64],
        sensor_type: SensorType,
    ) -> tuple[str, Levels, tuple[float, ...]]:
        """Return the name of the scale, (k,) levels of the sensors, and the values that the scale shows."""
        fresh, name = frame.status[sensors] == 0, sensor_type.name
        if self.scale_name != CHANGE:
            in_range = self.scale_name == RANGE
            values = (physical if in_range else frame.values.astype(np.float32))[sensors]
            known = (sensor_type.minimum, sensor_type.maximum) if in_range else _EVERYTHING
            limits = memory.limits((self.scale_name, name), values[fresh], known)
            return self.scale_name, levels_of(values, *limits, self._levels), limits
        noise = memory.rest.noise(name)
        change = memory.rest.change(physical)[sensors]
        span = memory.span((CHANGE, name), change[fresh], noise, frame.published_ns)
        return CHANGE, *change_levels(change, noise, span, self._levels)


def _type_of(structure: Structure, position: int) -> SensorType:
    return next(t for t in structure.types if t.id == structure.sensor_type[position])


def describe_sensor(frame: DriverSnapshot, position: int) -> str:
    """Return a sensor in words: its name, value, status, position and uid."""
    structure, sensor_type = frame.structure, _type_of(frame.structure, position)
    raw = frame.values[position].item()
    value = measure_text(sensor_type.offset + sensor_type.scale * raw, sensor_type.unit, 5)
    return (
        f"{structure.sensor_name(position)}: {sensor_type.name} {value} (raw {raw:g}),"
        f" {', '.join(filter(None, (status_text(int(frame.status[position])), why_text(int(frame.why[position])))))};"
        f" position {position}, uid {int(structure.sensor_uid[position]):#x}"
    )
