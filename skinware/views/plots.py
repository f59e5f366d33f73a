"""Take every sample of the taxels, parts and contacts that a viewer plots, in bounded memory."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ServiceError, StructureChanged
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import ServiceReader
from skinware.service._reader import samples_after
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.contacts_service import ContactsReader
from skinware.views.following import Follower, PlotFunction, ShownDriver
from skinware.views.looks import Line
from skinware.views.quantities import WITHOUT_VALUE

Values = npt.NDArray[np.float64]
Sensors = npt.NDArray[np.int64]

_MOST_SAMPLES = 4096
"""Samples of a service that wait for a turn."""
_MOST_BLOCKS = 64
"""Values of earlier choices that wait, at most."""
_LOOK_EVERY_NS = NS_PER_S // 2
_NO_VALUE = np.uint8(WITHOUT_VALUE | Status.STALE)


class _PlotSource(NamedTuple):
    """The service that has the values of a line; ``of`` is ``driver``, ``calm`` or ``contacts``."""

    of: str
    namespace: Namespace
    name: str


class PlotBlock(NamedTuple):
    """(k,) int64 ns, when samples were published, and (k, m) values of m lines, NaN without one.

    ``number`` is that of the viewer's choice, of which ``lines`` are places. Times are those of CLOCK_MONOTONIC; of a
    recording, those since it began. ``begins``: what came before is to be forgotten.
    """

    number: int
    of: str
    lines: list[int]
    time_ns: npt.NDArray[np.int64]
    values: Values
    begins: bool = False


class PlotRows:
    """The values of lines in sample after sample, ``most`` at once; missing samples are a row without values."""

    def __init__(self, most: int | None = None) -> None:
        self.missed = 0
        self.last: tuple[int, int] | None = None
        self._rows: deque[tuple[int, Values]] = deque(maxlen=most)

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, position: tuple[int, int], time_ns: int, values: Values) -> None:
        last, self.last = self.last, position
        if last is not None and position != (last[0], last[1] + 1):
            self.missed += max(1, position[1] - last[1] - 1)
            self._rows.append((time_ns - 1, np.full(len(values), np.nan)))
        self.missed += len(self._rows) == self._rows.maxlen
        self._rows.append((time_ns, values))

    def block(self, number: int, of: str, lines: list[int], *, begins: bool = False) -> PlotBlock:
        rows = list(self._rows)
        self._rows.clear()
        values = np.array([values for _, values in rows], np.float64).reshape(len(rows), len(lines))
        times = np.array([time_ns for time_ns, _ in rows], np.int64)
        return PlotBlock(number, of, lines, times, values, begins)


class _Feed:
    def __init__(self, source: _PlotSource) -> None:
        reader = ContactsReader if source.of == "contacts" else DriverReader
        self.reader: ServiceReader[Any] = reader(source.name, namespace=source.namespace, announce=False)
        self.of, self.number = source.of, 0
        self.lines: dict[int, Line] = {}
        self.rows = PlotRows(_MOST_SAMPLES)
        self._values: Callable[[list[Any]], Values] = lambda samples: np.zeros((len(samples), 0))

    def choose(
        self, number: int, lines: dict[int, Line], driver: ShownDriver, functions: Mapping[str, PlotFunction]
    ) -> None:
        """Take the values of these lines, by their places in a choice, from now on."""
        self.number, self.lines = number, lines
        self._values = values_of(self.of, list(lines.values()), driver, functions)

    def take(self) -> bool:
        """Take the newer samples, and return whether some wait; raise what the reader raises."""
        if self.reader.newest_position in (None, self.rows.last):
            self.reader.refresh()
            if self.reader.structure_changed:
                raise StructureChanged(self.reader.name)
        samples = list(samples_after(self.reader, self.rows.last, in_place=self.of != "function"))
        for sample, values in zip(samples, self._values(samples) if samples else (), strict=True):
            if sample.valid:
                self.rows.add(sample.position, sample.published_ns, values)
        return len(self.rows) > 0

    def block(self) -> PlotBlock:
        return self.rows.block(self.number, self.of, list(self.lines))


class Plots:
    """The lines of one viewer; ``has_news``: values wait for a turn."""

    def __init__(self, follower: Follower) -> None:
        self.has_news = False
        self._number = 0
        self._follower = follower
        self._lines: list[Line] = []
        self._edition = self._look_ns = 0
        self._feeds: dict[_PlotSource, _Feed] = {}
        self._waiting: deque[PlotBlock] = deque(maxlen=_MOST_BLOCKS)

    @property
    def missed(self) -> int:
        """Samples that came since a service is plotted, and were not taken or not sent."""
        return sum(feed.rows.missed for feed in self._feeds.values())

    def choose(self, number: int, lines: list[Line], edition: int) -> None:
        """Send the values of lines of this edition from now on; of new taxels also those of the last seconds."""
        before, self._lines, self._number, self._edition = self._lines, lines, number, edition
        self._find()
        for at, line in enumerate(lines):
            driver = self._follower.get(line.driver)
            if driver is None or line.position is None or line in before:
                continue
            if line.position < driver.structure.n_sensors:
                time_ns, raw = driver.past.series(line.position)
                scale, offset = _units_of(driver.structure, np.array([line.position]))
                self._waiting.append(PlotBlock(number, "driver", [at], time_ns, raw[:, None] * scale + offset))
        self.has_news = bool(self._waiting)

    def take(self) -> None:
        if self._lines and now_ns() >= self._look_ns:
            self._find()
        for source, feed in list(self._feeds.items()):
            try:
                self.has_news |= feed.take()
            except ServiceError:  # it went, or has other sensors: the viewer chooses again when it knows them
                self._feeds.pop(source).reader.close()

    def blocks(self) -> list[PlotBlock]:
        if not self.has_news:
            return []
        waiting, self.has_news = list(self._waiting), False
        self._waiting.clear()
        return waiting + [block for feed in self._feeds.values() if len((block := feed.block()).time_ns)]

    def close(self) -> None:
        for feed in self._feeds.values():
            feed.reader.close()
        self._feeds, self._lines = {}, []

    def _find(self) -> None:
        self._look_ns = now_ns() + _LOOK_EVERY_NS
        if self._follower.edition != self._edition:
            return
        wanted: dict[_PlotSource, tuple[ShownDriver, dict[int, Line]]] = {}
        for at, line in enumerate(self._lines):
            driver = self._follower.get(line.driver)
            source = None if driver is None else self._source_of(driver, line)
            if driver is not None and source is not None:
                wanted.setdefault(source, (driver, {}))[1][at] = line
        for source in self._feeds.keys() - wanted.keys():
            self._feeds.pop(source).reader.close()
        for source, (driver, lines) in wanted.items():
            with contextlib.suppress(ServiceError):  # it is looked for again
                feed = self._feeds.get(source) or self._feeds.setdefault(source, _Feed(source))
                if (self._number, lines) != (feed.number, feed.lines):
                    self._waiting += [block] if len((block := feed.block()).time_ns) else []
                    feed.choose(self._number, lines, driver, self._follower.functions)

    def _source_of(self, driver: ShownDriver, line: Line) -> _PlotSource | None:
        origin = driver.origin
        if line.contact is not None:
            reader = origin.contacts_reader(driver.live.name)
            return None if reader is None else _PlotSource("contacts", reader.namespace, reader.name)
        if line.function is not None:
            is_known = line.function in self._follower.functions
            return _PlotSource("function", origin.namespace, driver.live.name) if is_known else None
        is_calm = driver.newest is not None and driver.newest.calm is not None
        if line.modules and is_calm and origin.calm is not None:
            return _PlotSource("calm", origin.calm, driver.live.name)
        return _PlotSource("driver", origin.namespace, driver.live.name)


def _sensors_of(driver: ShownDriver, line: Line) -> Sensors:
    """Return (k,) positions of the sensors whose sum is a line."""
    structure, quantity = driver.structure, driver.quantity(line.type)
    if line.position is not None:
        return np.array([line.position] if line.position < structure.n_sensors else [], np.int64)
    if quantity is None:
        return np.zeros(0, np.int64)
    return quantity.index[np.isin(quantity.pads.of_sensor[quantity.index], line.modules)]


def _units_of(structure: Structure, sensors: Sensors) -> tuple[Values, Values]:
    by_id = {t.id: (t.scale, t.offset) for t in structure.types}
    units = np.array([by_id[of_type] for of_type in structure.sensor_type[sensors].tolist()]).reshape(-1, 2)
    return units[:, 0], units[:, 1]


def values_of(
    of: str, lines: list[Line], driver: ShownDriver, functions: Mapping[str, PlotFunction]
) -> Callable[[list[Any]], Values]:
    """Return a function of k samples of a driver or of contacts: (k, m) the values of lines."""
    if of == "contacts":
        ids = [line.contact for line in lines]

        def loads(sample: Sample) -> list[float]:
            filled = slice(0, int(sample.column("count")[0]))
            known = dict(zip(sample.column("id")[filled].tolist(), sample.column("load")[filled].tolist(), strict=True))
            return [known.get(contact, np.nan) for contact in ids]

        return lambda samples: np.array([loads(sample) for sample in samples])
    if of == "function":
        names = [line.function or "" for line in lines]
        return lambda frames: np.array([[functions[name](frame) for name in names] for frame in frames])
    return _totals(driver, lines)


def _totals(driver: ShownDriver, lines: list[Line]) -> Callable[[list[DriverSnapshot]], Values]:
    """Return a function of k snapshots: (k, m) sums of the values of each line's sensors; the highest of pressures."""
    of_lines = [_sensors_of(driver, line) for line in lines]
    some = [sensors for sensors in of_lines if len(sensors)]
    has_sensors = np.array([len(sensors) > 0 for sensors in of_lines], bool)
    at = np.concatenate([np.zeros(0, np.int64), *some])
    scale, offset = _units_of(driver.structure, at)
    starts = np.cumsum([0, *map(len, some)])[:-1]
    quantities = [driver.quantity(line.type) for line in lines]
    highest = np.array([one is not None and one.total == "highest" for one in quantities], bool)[has_sensors]
    is_each = len(some) == len(at) == len(lines)  # a sensor each

    def totals(frames: list[DriverSnapshot]) -> Values:
        values: Values = np.array([frame.values[at] for frame in frames]) * scale + offset
        values[np.array([frame.status[at] for frame in frames]) & _NO_VALUE != 0] = np.nan
        if is_each:
            return values
        unknown = np.isnan(values)
        values[unknown] = 0
        sums, most = np.add.reduceat(values, starts, axis=1), np.maximum.reduceat(values, starts, axis=1)
        is_empty = np.logical_and.reduceat(unknown, starts, axis=1)
        found = np.full((len(frames), len(lines)), np.nan)
        found[:, has_sensors] = np.where(is_empty, np.nan, np.where(highest, most, sums))
        return found

    return totals
