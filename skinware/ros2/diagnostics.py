"""How drivers are, as ``diagnostic_msgs/DiagnosticArray``, which tools of ROS show."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import IntEnum
from typing import NamedTuple

from skinware.conversion.ros_messages import Cdr
from skinware.driver_snapshot import DriverSnapshot
from skinware.realtime import NS_PER_S
from skinware.state import DEAD, LIVE, PAUSED, SILENT, SkinHealth, bus_reason_name, bus_state_name
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
_OF_BUS = {int(BusState.LIVE): Level.OK, int(BusState.CONNECTING): Level.WARN, int(BusState.SILENT): Level.WARN}


def statuses(driver: LiveDriver) -> Iterator[Status]:
    health, frame = driver.health(), driver.frame
    yield Status(
        _level(health, frame), f"skin: {driver.name}", _in_words(health), driver.reader.driver_type, _values(health)
    )
    if frame is None or health.life != LIVE:
        return
    for name, state, reason in zip(
        frame.structure.buses, frame.bus_state.tolist(), frame.bus_reason.tolist(), strict=True
    ):
        told = ": ".join(filter(None, (bus_state_name(state), bus_reason_name(reason))))
        yield Status(_OF_BUS.get(state, Level.ERROR), f"skin: {driver.name}: {name}", told, name, {})


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


def _level(health: SkinHealth, frame: DriverSnapshot | None) -> Level:
    if health.life != LIVE or frame is None:
        return _OF_LIFE.get(health.life, Level.WARN)
    return Level.OK if health.statuses["fresh"] == health.sensors else Level.WARN


def _in_words(health: SkinHealth) -> str:
    if health.life != LIVE:
        return health.life
    return f"{health.statuses['fresh']} of {health.sensors} sensors are fresh"


def _values(health: SkinHealth) -> dict[str, str]:
    values = {"state": health.life, "sensors": str(health.sensors)}
    if health.rate_hz is not None:
        values["rate_hz"] = f"{health.rate_hz:.1f}"
    if health.age_ns is not None:
        values["age_ms"] = f"{health.age_ns / NS_PER_S * 1e3:.1f}"
    told = {**health.statuses, **{f"patches {state}": n for state, n in health.patches.items()}, **health.counters}
    return values | {name: str(count) for name, count in told.items() if count}
