"""Hold findings, and word losses, names of buses and commands for people."""

from __future__ import annotations

import enum
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from skinware.errors import ConfigurationError
from skinware.text import age_text, count_text, plural
from skinware_drivers.bus_names import place_of_bus
from skinware_drivers.doctor.evidence import Counted, Evidence
from skinware_drivers.operations import operations_of
from skinware_drivers.registry import load_driver


class Severity(enum.IntEnum):
    """How bad something is."""

    NOTE = 1
    """It costs no data now."""
    WARNING = 2
    """It costs some data or time, or has, or may soon."""
    ERROR = 3
    """Data is missing or wrong."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    Attributes:
        severity: how bad it is.
        area: the field it belongs to: ``buses``.
        what: in a few words.
        where: which part of the skin or machine.
        evidence: the figures that say so.
        action: what to do, in words.
        commands: what to type for it.
        see: page and section of the documentation, below ``docs/``.
    """

    severity: Severity
    area: str
    what: str
    where: str
    evidence: str
    action: str
    commands: tuple[str, ...] = ()
    see: str = "troubleshooting.md"


@dataclass(frozen=True)
class Looked:
    """Something that was looked at.

    Attributes:
        area: the field it belongs to.
        what: which part of the skin or machine.
        seen: how it is.
    """

    area: str
    what: str
    seen: str


@dataclass(frozen=True)
class NotLooked:
    """Something that could not be looked at.

    Attributes:
        area: the field it belongs to.
        what: it.
        why: the reason.
        commands: what to type to find it out.
    """

    area: str
    what: str
    why: str
    commands: tuple[str, ...] = ()


Note = Finding | Looked | NotLooked


_MOST_HOURS = 3


class Told(NamedTuple):
    """A loss in words.

    Attributes:
        is_going_on: it grew while somebody looked, or in the recording.
        text: how much: ``3 frames in 3.0 s (12 since the driver was started)``.
        hours: the worst hours of a recording, as a part of a sentence; empty without.
    """

    is_going_on: bool
    text: str
    hours: str


def lost_text(counted: Counted, name: str, unit: str, evidence: Evidence) -> Told | None:
    """What is to be said of a counter; None if it is 0.

    Args:
        counted: of a bus or patch.
        name: of the counter.
        unit: what it counts, in the singular.
        evidence: that it is part of.
    """
    total, grown = counted.total.get(name, 0), counted.grown.get(name, 0)
    if not total and not grown:
        return None
    if not grown:
        before = "before the recording began" if not evidence.is_live else "since the driver was started"
        return Told(False, f"{plural(total, unit)} {before}, none in these {_span(evidence)}", "")
    text = f"{plural(grown, unit)} in {_span(evidence)}"
    if evidence.is_live and total > grown:
        text += f" ({count_text(total)} since the driver was started)"
    return Told(True, text, _hours(counted, name, evidence))


def _hours(counted: Counted, name: str, evidence: Evidence) -> str:
    of_hours = [(counts.get(name, 0), hour) for hour, counts in counted.hours]
    worst = sorted((one for one in of_hours if one[0]), reverse=True)[:_MOST_HOURS]
    if evidence.is_live or evidence.seconds < 3600 or not worst:
        return ""
    told = ", ".join(f"{count_text(count)} in hour {hour + 1}" for count, hour in worst)
    return f"; most: {told}"


def _span(evidence: Evidence) -> str:
    return age_text(evidence.seconds * 1e9)


def brief(bus_name: str) -> str:
    """A bus' name without options, which make it long."""
    return bus_name.partition("?")[0]


def _placed(bus_name: str) -> str:
    address, _, query = bus_name.partition("?")
    placing = dict(place_of_bus(bus_name).options)
    kept = "&".join(part for part in query.split("&") if part.partition("=")[0] in placing)
    return f"{address}?{kept}" if kept else address


def typed(commands: Iterable[str], bus_name: str, driver: str = "") -> tuple[str, ...]:
    """Commands about a bus, ready to be typed; without those that it cannot have.

    Args:
        commands: with ``{name}`` for the bus (emulated and replayed ones are in the process of their driver only),
            ``{channel}`` for its CAN interface, and ``{driver}``.
        bus_name: as the driver was told.
        driver: name of the driver.
    """
    interface, channel, _ = place_of_bus(bus_name)
    names = {"driver": shlex.quote(driver)}
    names |= {} if interface in ("virtual", "replay") else {"name": shlex.quote(_placed(bus_name))}
    names |= {"channel": shlex.quote(channel)} if interface == "socketcan" else {}
    return tuple(
        one.format_map(names)
        for one in commands
        if all(f"{{{name}}}" not in one or name in names for name in ("name", "channel"))
    )


def has_operation(driver_type: str, operation: str) -> bool:
    """Whether drivers of a type have an operation for skin-config; False for a type that is not installed here."""
    try:
        return operation in operations_of(load_driver(driver_type), alone=True)
    except ConfigurationError:
        return False
