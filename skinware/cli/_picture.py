"""Draw the chosen row of skin-top: baselines, levels and scales from snapshot to snapshot, without a terminal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.text import Text

from skinware.cli._heat_map import FRESH, UNMOVED, Arrangement, arrange, codes_of, levels_of, marks_of
from skinware.cli._painting import TRUE_COLOURS, Palette, marks_text, scale_text
from skinware.cli._top_rows import RowKey, patches_of, title_of
from skinware.driver_snapshot import DriverSnapshot
from skinware.sensor_types import SensorType
from skinware.skin_layout import SkinLayout
from skinware.state import status_now
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.regions import Regions
from skinware.text import figure_text
from skinware.views.quantities import ChangeSpan, Rest, ValueLimits
from skinware.views.wiping import WipeTest

Floats = npt.NDArray[np.float32]
Levels = npt.NDArray[np.uint8]

CHANGE, RANGE, RAW = "change", "range", "raw"
SCALES = (CHANGE, RANGE, RAW)
"""Names of the scales, in the order in which they take turns."""


@dataclass(frozen=True)
class Scaled:
    """What is drawn.

    Attributes:
        levels: (n,) uint8.
        values: what stands for the lowest, the middle (if it is not half of the highest) and the highest level.
    """

    levels: Levels
    values: tuple[float, ...]


class ChangeScale:
    """How far values are from rest: from the noise to the greatest change seen lately, rounded up.

    Levels go with the square root: the lightest touch can be told from none, and a light one from a hard one.
    """

    def __init__(self) -> None:
        self._span = ChangeSpan()

    def draw(
        self, change: Floats, fresh: npt.NDArray[np.bool_], noise: float, time_ns: int, before: Levels | None
    ) -> Scaled:
        """Levels of changes.

        Args:
            change: (n,) physical, 0 or more.
            fresh: (n,) bool; others do not count for the scale.
            noise: up to here nothing is shown.
            time_ns: of the frame: what was seen is forgotten slowly.
            before: the levels drawn so far.
        """
        span = self._span.follow(change[fresh], noise, time_ns)
        felt = np.sqrt(np.maximum(change - np.float32(noise), 0))
        levels = levels_of(felt, 0.0, math.sqrt(max(span - noise, 1e-30)), before)
        return Scaled(levels, (0.0, span / 4, span))


class ValueScale:
    """The values themselves: between two limits where they are known, otherwise between the extremes seen so far."""

    def __init__(self) -> None:
        self._limits = ValueLimits()

    def draw(
        self, values: Floats, fresh: npt.NDArray[np.bool_], limits: tuple[float, float], before: Levels | None
    ) -> Scaled:
        """Levels of values.

        Args:
            values: (n,).
            fresh: (n,) bool; others do not count for the scale.
            limits: what is level 0 and what the highest; infinite where it is not known.
            before: the levels drawn so far.
        """
        low, high = self._limits.follow(values[fresh], limits)
        return Scaled(levels_of(values, low, high, before), (low, high))


_NAMED_STATUSES = {bit: str(bit.name).lower().replace("_", " ") for bit in Status}
_PEAK = "peak"
_EVERYTHING = (-math.inf, math.inf)


class Picture:
    """The sensors of one type below one row of the list, drawn into a given room.

    Args:
        type_name: the type to draw where there is one of this name; otherwise each driver's first.
        scale_name: what the colours mean at first, one of ``SCALES``.
        palette: of the terminal.
        regions: that a person may choose from; None: there are none.
        region: only sensors in this one are drawn at first; None: all.

    Attributes:
        scale_name: what the colours mean: ``change`` from rest, the type's ``range``, ``raw`` counts.
        arrangement: where sensors are; None before the first ``draw``.
        pixels: (2 * lines, columns) uint8, codes of the pixels last drawn.
        title: what is drawn, in words.
        scale: the colours with their values.
        marks: what the characters mean, with how many sensors have each.
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
        self._regions, self._region = regions, region
        self.arrangement: Arrangement | None = None
        self.pixels: npt.NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self.title = ""
        self.scale = Text()
        self.marks = Text()
        self._wanted = type_name
        self._palette = palette
        self._watched: dict[str, _Watched] = {}
        self._wiping = False
        self._unmoved = np.zeros(0, np.int64)
        self._levels: npt.NDArray[np.uint8] | None = None
        self._made_for: tuple[object, ...] = ()

    def type_in(self, structure: Structure) -> SensorType:
        return next((t for t in structure.types if t.name == self._wanted), structure.types[0])

    def next_type(self, structure: Structure) -> None:
        names = [t.name for t in structure.types]
        self._wanted = names[(names.index(self.type_in(structure).name) + 1) % len(names)]

    def next_scale(self) -> None:
        """Go over to the next meaning of the colours."""
        self.scale_name = SCALES[(SCALES.index(self.scale_name) + 1) % len(SCALES)]
        self._levels = None

    def next_region(self) -> None:
        """Go over to the next region; after the last one to all sensors."""
        names = [None, *(region.name for region in self._regions or ())]
        self._region = names[(names.index(self._region) + 1) % len(names)]

    def regions_of(self, driver: str, position: int) -> list[str]:
        """Names of the regions that a sensor is in.

        Args:
            driver: whose, one that was drawn.
            position: of the sensor in a frame.
        """
        watched = self._watched[driver]
        structure = watched.structure
        sensor_type = next(t for t in structure.types if t.id == structure.sensor_type[position])
        names = [region.name for region in self._regions or ()]
        return [name for name in names if self._in_region(name, watched, sensor_type.name)[position]]

    def _in_region(self, name: str, watched: _Watched, type_name: str) -> npt.NDArray[np.bool_]:
        """(n_sensors,) bool: the sensors of a type that are in a region."""
        structure = watched.structure
        found = np.zeros(structure.n_sensors, bool)
        if self._regions is not None:
            of_type = np.arange(structure.n_sensors)[structure.index(type_name)]
            index = self._regions.of(watched.layout, type_name)
            found[of_type[index.get(name, slice(0, 0))]] = True
        return found

    def take_baselines(self) -> None:
        """What comes next is what the sensors read at rest."""
        for watched in self._watched.values():
            watched.rest.begin()
        self._levels = None

    def wipe_test(self) -> None:
        self._wiping = not self._wiping
        for watched in self._watched.values():
            watched.wipe = None
        self._levels = None

    def wipe_text(self, driver: str) -> str | None:
        """How the wipe test goes for what is drawn, for people; None where there is none."""
        watched = self._watched.get(driver)
        if watched is None or watched.wipe is None:
            return None
        count = len(self._unmoved)
        if not count:
            return "wipe test: every sensor has moved"
        first = watched.structure.sensor_name(int(self._unmoved.min()))
        return f"wipe test: {count} never moved (l saves the list): {first}{' ...' * (count > 1)}"

    def save_wipe(self, driver: str, folder: Path) -> Path | None:
        """Save the list of the sensors that never moved; None where no test goes on.

        Raises:
            OSError: it cannot be written.
        """
        watched = self._watched.get(driver)
        if watched is None or watched.wipe is None:
            return None
        name = self.type_in(watched.structure).name
        return watched.wipe.save(folder, driver, name, watched.rest.noise(name))

    def draw(self, key: RowKey, frame: DriverSnapshot, width: int, height: int, life: str) -> None:
        """Draw a frame: sets ``arrangement`` and all that is drawn.

        Args:
            key: which row.
            frame: the frame of its driver.
            width: columns to draw in.
            height: lines to draw in.
            life: what the driver is doing; where nothing newer comes, no sensor is fresh.
        """
        sensor_type, region = self.type_in(frame.structure), self._region
        watched = self._watch(key.driver, frame)
        made_for = (key, frame.structure, sensor_type, region, width, height)
        if self.arrangement is None or made_for != self._made_for:
            patches = patches_of(key, frame)
            smallest = 2 if self._palette.characters else 1
            only = None if region is None else self._in_region(region, watched, sensor_type.name)
            self.arrangement = arrange(
                frame.structure, patches, sensor_type.name, width, height, smallest=smallest, only=only
            )
            self._made_for, self._levels = made_for, None
            self.title = title_of(key, frame.structure, patches, sensor_type.name, len(self.arrangement.sensors))
            self.title += "" if region is None else f", in {region}"
            if self._wanted not in (None, sensor_type.name):
                self.title += f" (there are no {self._wanted} sensors)"
        sensors = self.arrangement.sensors
        name, scaled = self._scaled(watched, frame, sensors, sensor_type)
        self._levels = scaled.levels
        marks = marks_of(status_now(life, frame)[sensors])
        if watched.wipe is not None:
            unmoved = np.isin(sensors, watched.wipe.never_moved(sensor_type.name, watched.rest.noise(sensor_type.name)))
            self._unmoved = sensors[unmoved]
            marks[(marks == FRESH) & unmoved] = UNMOVED
        self.pixels = self.arrangement.draw(codes_of(self._levels, marks))
        unit = "" if name == RAW else sensor_type.unit
        self.scale = Text(f"{name} ", no_wrap=True).append_text(scale_text(scaled.values, unit, self._palette))
        self.marks = marks_text(marks, self._palette)

    def _watch(self, driver: str, frame: DriverSnapshot) -> _Watched:
        watched = self._watched.get(driver)
        if watched is None or watched.structure is not frame.structure:
            watched = self._watched[driver] = _Watched(driver, frame.structure)
        if self._wiping and watched.wipe is None:
            watched.wipe = WipeTest(frame.structure)
        watched.follow(frame)
        return watched

    def _scaled(
        self, watched: _Watched, frame: DriverSnapshot, sensors: npt.NDArray[np.int64], sensor_type: SensorType
    ) -> tuple[str, Scaled]:
        fresh = frame.status[sensors] == 0
        if watched.wipe is None and self.scale_name != CHANGE:
            in_range = self.scale_name == RANGE
            values = watched.physical[sensors] if in_range else frame.values[sensors].astype(np.float32)
            limits = (sensor_type.minimum, sensor_type.maximum) if in_range else _EVERYTHING
            scale = watched.values.setdefault((self.scale_name, sensor_type.name), ValueScale())
            return self.scale_name, scale.draw(values, fresh, limits, self._levels)
        noise = watched.rest.noise(sensor_type.name)
        if watched.wipe is None:
            name, change = CHANGE, watched.rest.change(watched.physical)
        else:
            name, change = _PEAK, watched.wipe.travel()
        change_scale = watched.changes.setdefault((name, sensor_type.name), ChangeScale())
        return name, change_scale.draw(change[sensors], fresh, noise, frame.published_ns, self._levels)


class _Watched:
    """What is kept of a driver from frame to frame."""

    def __init__(self, driver: str, structure: Structure) -> None:
        self.structure = structure
        self.layout = SkinLayout((driver,), (structure,))
        self.rest = Rest(structure)
        self.wipe: WipeTest | None = None
        self.changes: dict[tuple[str, str], ChangeScale] = {}
        self.values: dict[tuple[str, str], ValueScale] = {}
        self.physical: npt.NDArray[np.float32] = np.zeros(structure.n_sensors, np.float32)
        self._scale = np.ones(structure.n_sensors, np.float32)
        self._offset = np.zeros(structure.n_sensors, np.float32)
        for sensor_type in structure.types:
            index = structure.index(sensor_type.name)
            self._scale[index], self._offset[index] = sensor_type.scale, sensor_type.offset

    def follow(self, frame: DriverSnapshot) -> None:
        self.physical = frame.values.astype(np.float32) * self._scale + self._offset
        fresh = frame.status == 0
        self.rest.follow(self.physical, fresh, frame.published_ns)
        if self.wipe is not None:
            self.wipe.follow(self.physical, fresh)


def describe_sensor(frame: DriverSnapshot, position: int) -> str:
    """One sensor in words: which it is, its value, and what is wrong with it."""
    structure = frame.structure
    sensor_type = next(t for t in structure.types if t.id == structure.sensor_type[position])
    raw = frame.values[position].item()
    value = f"{figure_text(sensor_type.offset + sensor_type.scale * raw, 5)} {sensor_type.unit}".strip()
    status = int(frame.status[position])
    states = ", ".join(name for bit, name in _NAMED_STATUSES.items() if status & bit) or "fresh"
    uid = int(structure.sensor_uid[position])
    return (
        f"{structure.sensor_name(position)}: {sensor_type.name} {value} (raw {raw:g}), {states};"
        f" position {position}, uid {uid:#x}"
    )
