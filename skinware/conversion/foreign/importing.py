"""Read foreign data by a map as the tables of a recording, which every format can be written from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.conversion.foreign.mapping import UNITS_NS, MappedDriver, read_map
from skinware.conversion.foreign.source import ColumnSource, Rows
from skinware.conversion.tables import COLUMNS, Block, Table
from skinware.driver_service import recorded_head
from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.status import BusState, PatchState, Status
from skinware.transfer.generation import Generation

_BEGIN_NS = NS_PER_S
"""CLOCK_MONOTONIC of the first row: 0 means never."""


class ImportedTable(Table):
    """A table of foreign data as a driver, whose samples its source counts."""

    def __init__(self, driver: MappedDriver, source: ImportedSource) -> None:
        period_ns = round(NS_PER_S / driver.map.rate_hz) if driver.map.rate_hz else 0
        head = recorded_head(driver.map.name, driver.structure, driver_type="imported", period_ns=period_ns)
        super().__init__(driver.map.name, driver.map.name, [Generation(head, driver.map.name)])
        self.driver, self._source = driver, source

    def times(self) -> Iterator[npt.NDArray[np.int64]]:
        """Yield the times of the rows, ns on the axis of the source, a few at a time."""
        driver = self.driver.map
        names = [driver.time or self.driver.picks[0].column]
        yield from (times for times, _ in self._timed(self._source.columns.blocks(driver.table, names)))

    def blocks(self, names: Collection[str]) -> Iterator[Block]:  # noqa: ARG002, all are as cheap as some
        source, structure = self._source, self.driver.structure
        held = _Held(structure.n_sensors)
        done = 0
        columns = dict.fromkeys([pick.column for pick in self.driver.picks])
        needed = [*columns, *([self.driver.map.time] if self.driver.map.time else [])]
        for times_ns, rows in self._timed(source.columns.blocks(self.driver.map.table, needed)):
            source.work()
            raw = [rows[pick.column].reshape(len(times_ns), -1)[:, pick.numbers] for pick in self.driver.picks]
            values, status = held.fill(np.concatenate(raw, axis=1, dtype=np.float64))
            own_ns = times_ns - source.begin_ns + _BEGIN_NS
            shape = len(times_ns), 1
            yield {
                "frames/time_ns": times_ns + source.shift_ns,
                "frames/generation": np.full(shape[0], self.origin.generation, np.uint64),
                "frames/sequence": np.arange(done + 1, done + 1 + shape[0], dtype=np.uint64),
                "frames/acquired_ns": own_ns,
                "frames/published_ns": own_ns,
                "frames/flags": np.zeros(shape[0], np.uint64),
                COLUMNS + "values": self._converted(values, done),
                COLUMNS + "status": status,
                COLUMNS + "module_time_ns": np.tile(own_ns[:, None], (1, structure.n_modules)),
                COLUMNS + "patch_state": np.full((shape[0], structure.n_patches), PatchState.LIVE, np.uint8),
                COLUMNS + "bus_state": np.full(shape, BusState.LIVE, np.uint8),
            }
            done += shape[0]
            source.frames[self.name] = done
            source.missing[self.name] = held.missing

    def _timed(self, blocks: Iterator[Rows]) -> Iterator[tuple[npt.NDArray[np.int64], Rows]]:
        driver, done, last_ns = self.driver.map, 0, -(1 << 62)
        for rows in blocks:
            if driver.time:
                times = rows[driver.time].ravel()
                unit_ns = UNITS_NS[driver.time_unit]
                wrong = np.flatnonzero(~(np.abs(times * unit_ns) < 2.0**62))
                if len(wrong):
                    raise self._wrong(
                        done + int(wrong[0]), f"{driver.time} {times[wrong[0]]} {driver.time_unit} is no time"
                    )
                is_whole = times.dtype.kind in "iu"
                times_ns = (
                    times.astype(np.int64) * round(unit_ns) if is_whole else np.rint(times * unit_ns).astype(np.int64)
                )
            else:
                count = len(next(iter(rows.values())))
                times_ns = np.rint(np.arange(done, done + count) * (NS_PER_S / driver.rate_hz)).astype(np.int64)
            back = np.flatnonzero(np.diff(times_ns, prepend=last_ns) < 0)
            if len(back):
                by_s = (int(times_ns[back[0] - 1] if back[0] else last_ns) - int(times_ns[back[0]])) / NS_PER_S
                why = f"{driver.time} goes back by {by_s:g} s: cut the file there, or sort its rows"
                raise self._wrong(done + int(back[0]), why)
            done += len(times_ns)
            last_ns = int(times_ns[-1]) if len(times_ns) else last_ns
            yield times_ns, rows

    def _converted(self, values: npt.NDArray[np.float64], done: int) -> npt.NDArray[Any]:
        dtype = self.driver.structure.dtype
        if dtype.kind == "f":
            is_good = ~(np.abs(values) > np.finfo(dtype).max) | np.isinf(values)
        else:
            limits = np.iinfo(dtype)
            is_good = (values == np.rint(values)) & (values >= limits.min) & (values <= limits.max)
        if not is_good.all():
            row, place = (int(each[0]) for each in np.nonzero(~is_good))
            names = [pick.column for pick in self.driver.picks for _ in pick.numbers]
            why = f"{values[row, place]:g} in {names[place]} is no {dtype}: say another dtype in the map"
            raise self._wrong(done + row, why)
        return values.astype(dtype)

    def _wrong(self, row: int, what: str) -> ConfigurationError:
        table = f", {self.driver.map.table}" if self.driver.map.table else ""
        return ConfigurationError(f"{self._source.path}{table}, row {row + 1}: {what}")


class _Held:
    """The last values of n sensors, which stay where a value is missing.

    Attributes:
        missing: values that were missing so far.
    """

    def __init__(self, n: int) -> None:
        self._last, self._seen = np.zeros(n), np.zeros(n, bool)
        self.missing = 0

    def fill(self, raw: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]:
        """Return values and status, both (m, n), of values that are NaN where they are missing."""
        is_missing = np.isnan(raw)
        status = np.zeros(raw.shape, np.uint8)
        if is_missing.any() and len(raw):
            self.missing += int(is_missing.sum())
            rows = np.maximum.accumulate(np.where(is_missing, -1, np.arange(len(raw))[:, None]), axis=0)
            known = (rows >= 0) | self._seen
            status[is_missing] = np.where(known, Status.STALE, Status.NEVER_SEEN)[is_missing]
            raw = np.where(rows >= 0, np.take_along_axis(raw, np.maximum(rows, 0), axis=0), self._last)
            self._seen = known[-1]
        elif len(raw):
            self._seen[:] = True
        if len(raw):
            self._last = raw[-1]
        return raw, status


class ImportedSource:
    """Foreign data as the source of a conversion; see :class:`skinware.conversion.tables.TableSource`.

    Args:
        columns: the data; closed with this source.
        map_path: of the map; see :mod:`skinware.conversion.foreign.mapping`.
        report: called now and then with the part that is done, 0 to 1.
        is_stopped: called now and then; True ends the conversion with :class:`KeyboardInterrupt`.

    Attributes:
        begin_ns: time of the first row of all tables, on the axis of the data.
        shift_ns: the axis of the recording minus that of the data: 0, unless times are negative.
        frames, missing: rows, and missing values, of each table so far.

    Raises:
        ConfigurationError: the map is wrong or does not fit, or the data are damaged.
        OSError: a file cannot be read.
    """

    def __init__(
        self,
        columns: ColumnSource,
        map_path: Path,
        report: Callable[[float], object] = lambda _: None,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.path, self.columns = columns.path, columns
        self._report, self._is_stopped = report, is_stopped
        self.frames: Counter[str] = Counter()
        self.missing: Counter[str] = Counter()
        tables = [ImportedTable(driver, self) for driver in read_map(map_path, columns)]
        firsts = [int(first[0]) for table in tables if len(first := next(table.times(), np.zeros(0, np.int64)))]
        self.tables: Sequence[Table] = tables
        self.begin_ns = min(firsts, default=0)
        self.shift_ns = max(0, -self.begin_ns)
        self.start_ns: int = self.begin_ns + self.shift_ns

    def work(self) -> None:
        """Report how much is done, and end if that is wanted."""
        if self._is_stopped():
            raise KeyboardInterrupt
        self._report(self.columns.share)

    @property
    def events(self) -> list[dict[str, Any]]:
        """A mark at the beginning of each episode of a dataset."""
        found = []
        for time_s, text in self.columns.marks:
            time_ns = round(time_s * NS_PER_S)
            own_ns, log_ns = time_ns - self.begin_ns + _BEGIN_NS, time_ns + self.shift_ns
            found.append({"event": "mark", "service": "", "text": text, "time_ns": own_ns, "log_time_ns": log_ns})
        return found

    @property
    def clock(self) -> list[dict[str, Any]]:
        own_ns = {"monotonic_ns": _BEGIN_NS, "boottime_ns": _BEGIN_NS, "realtime_ns": self.start_ns, "boot": ""}
        return [own_ns | {"log_time_ns": self.start_ns}]

    @property
    def problems(self) -> list[str]:
        found = [
            f"{count} missing values of {name} keep the value before, with the status STALE"
            for name, count in self.missing.items()
            if count
        ]
        return [f"{self.path}: {each}" for each in [*self.columns.problems, *found]]

    def close(self) -> None:
        self.columns.close()
