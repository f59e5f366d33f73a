"""How drivers are, as ``diagnostic_msgs/DiagnosticArray``, which tools of ROS show."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import IntEnum
from typing import NamedTuple

from skinware.conversion.ros_messages import Cdr
from skinware.realtime import NS_PER_S
from skinware.state import DEAD, LIVE, PAUSED, SILENT, DriverReport, bus_state_name
from skinware.status import BusState
from skinware.views.live import LiveDriver


class Level(IntEnum):
    """How bad it is."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Status(NamedTuple):
    """A ``diagnostic_msgs/DiagnosticStatus``.

    Attributes:
        level: of it.
        name: of what it is about.
        message: what is to be said.
        hardware: which kind.
        values: more, by name.
    """

    level: Level
    name: str
    message: str
    hardware: str
    values: dict[str, str]


_OF_LIFE = {SILENT: Level.STALE, PAUSED: Level.WARN, DEAD: Level.ERROR}
_OF_BUS = {
    bus_state_name(BusState.LIVE): Level.OK,
    bus_state_name(BusState.CONNECTING): Level.WARN,
    bus_state_name(BusState.SILENT): Level.WARN,
}


def statuses(driver: LiveDriver) -> Iterator[Status]:
    report = driver.report()
    words = f"{report.fresh} of {report.sensors} sensors are fresh" if report.life == LIVE else report.life
    kind = driver.reader.driver_type
    yield Status(_level(report), f"skin: {driver.name}", words, kind, _values(report))
    if report.life != LIVE:
        return
    for bus in report.buses:
        words = ": ".join(filter(None, (bus.state, bus.reason)))
        yield Status(_OF_BUS.get(bus.state, Level.ERROR), f"skin: {driver.name}: {bus.name}", words, bus.name, {})


def message(of: Iterable[Status], time_ns: int) -> bytes:
    """The message.

    Args:
        of: all there is to say.
        time_ns: wall clock.
    """
    told = list(of)
    cdr = Cdr().header(time_ns, "").numbers("I", len(told))
    for each in told:
        cdr.numbers("B", each.level).text(each.name).text(each.message).text(each.hardware)
        cdr.numbers("I", len(each.values))
        for key, value in each.values.items():
            cdr.text(key).text(value)
    return cdr.done()


def _level(report: DriverReport) -> Level:
    if report.life != LIVE or report.age_ns is None:
        return _OF_LIFE.get(report.life, Level.WARN)
    return Level.OK if report.fresh == report.sensors else Level.WARN


def _values(report: DriverReport) -> dict[str, str]:
    values = {"state": report.life, "sensors": str(report.sensors)}
    if report.rate_hz is not None:
        values["rate_hz"] = f"{report.rate_hz:.1f}"
    if report.age_ns is not None:
        values["age_ms"] = f"{report.age_ns / NS_PER_S * 1e3:.1f}"
    patches = {f"patches {state}": n for state, n in report.patch_states.items()}
    counts = {**report.statuses, **patches, **report.counters}
    return values | {name: str(count) for name, count in counts.items() if count}
