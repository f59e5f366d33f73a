"""Findings, the rules that they are made from, and the words for losses and buses."""

from __future__ import annotations

import contextlib
import enum
import shlex
from dataclasses import dataclass, field

from skinware.errors import ConfigurationError
from skinware.text import age_text, count_text, plural
from skinware_drivers.bus_names import BusName
from skinware_drivers.doctor.evidence import Counted, Evidence
from skinware_drivers.operations import operations_of
from skinware_drivers.registry import load_driver


class Severity(enum.IntEnum):
    NOTE = 1
    """It costs no data now."""
    WARNING = 2
    """It costs some data or time, did so, or soon may."""
    ERROR = 3
    """Data is missing or wrong."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    Attributes:
        area: such as ``buses``; filled in by :func:`skinware_drivers.doctor.examining.examine`.
        what: the fault in a few words.
        where: the part of the skin or machine.
        evidence: the figures that show it.
        action: what to do, in words.
        commands: what to type.
        see: page and section of the documentation, below ``docs/``.
    """

    severity: Severity
    area: str = field(default="", kw_only=True)
    what: str
    where: str
    evidence: str
    action: str
    commands: tuple[str, ...] = ()
    see: str = "troubleshooting.md"


@dataclass(frozen=True)
class Looked:
    """Something that was examined."""

    area: str = field(default="", kw_only=True)
    what: str
    seen: str


@dataclass(frozen=True)
class NotLooked:
    """Something that could not be examined.

    Attributes:
        area: as in :class:`Finding`.
        commands: what to type to find out.
    """

    area: str = field(default="", kw_only=True)
    what: str
    why: str
    commands: tuple[str, ...] = ()


Note = Finding | Looked | NotLooked


@dataclass(frozen=True)
class Rule:
    """The texts of a kind of finding.

    Attributes:
        severity, action, see: as in :class:`Finding`.
        what: as in :class:`Finding`, with ``{names}`` to fill in.
        commands: as in :class:`Finding`, with ``{names}`` to fill in.
        unit: what the counter of a loss counts, in the singular.
    """

    severity: Severity
    what: str
    action: str
    commands: tuple[str, ...] = ()
    see: str = "troubleshooting.md"
    unit: str = "frame"

    def found(self, where: str, evidence: str, severity: Severity | None = None, /, **names: object) -> Finding:
        """Return a finding of this kind.

        Args:
            severity: instead of the rule's.
            **names: values for ``what`` and, quoted for a shell, for ``commands``. A command is left out if one of its
                names is missing.
        """
        quoted = {name: shlex.quote(str(value)) for name, value in names.items()}
        commands = []
        for command in self.commands:
            with contextlib.suppress(KeyError):
                commands.append(command.format_map(quoted))
        what = self.what.format_map(names)
        return Finding(severity or self.severity, what, where, evidence, self.action, tuple(commands), self.see)


@dataclass(frozen=True)
class Loss:
    """A loss in words.

    Attributes:
        is_going_on: it grew while the doctor looked, or in the recording.
        text: how much: ``3 frames in 3.0 s (12 since the driver was started)``.
        hours: the worst hours of a long recording, as a part of a sentence; else empty.
    """

    is_going_on: bool
    text: str
    hours: str = ""


_MOST_HOURS = 3


def loss_in_words(counted: Counted, name: str, unit: str, evidence: Evidence) -> Loss | None:
    """Return a counter in words; None if it is 0."""
    total, grown, span = counted.total.get(name, 0), counted.grown.get(name, 0), age_text(evidence.seconds * 1e9)
    if not total and not grown:
        return None
    if not grown:
        before = "since the driver was started" if evidence.is_live else "before the recording began"
        return Loss(False, f"{plural(total, unit)} {before}, none in these {span}")
    text = f"{plural(grown, unit)} in {span}"
    if evidence.is_live and total > grown:
        text += f" ({count_text(total)} since the driver was started)"
    worst = sorted(((counts[name], hour) for hour, counts in counted.hours if counts.get(name)), reverse=True)
    if evidence.is_live or evidence.seconds < 3600 or not worst:
        return Loss(True, text)
    hours = ", ".join(f"{count_text(count)} in hour {hour + 1}" for count, hour in worst[:_MOST_HOURS])
    return Loss(True, text, f"; most: {hours}")


def brief(bus_name: str) -> str:
    """Return the name of a bus without its options."""
    return bus_name.partition("?")[0]


def names_of_bus(bus_name: str) -> dict[str, str]:
    """Return what commands may call a bus: ``name``, and ``channel`` for the CAN interface of the kernel.

    Emulated and replayed buses exist in the process of their driver only, so that they have neither.
    """
    interface, channel, options = BusName.of(bus_name).place
    address, _, query = bus_name.partition("?")
    placing = "&".join(part for part in query.split("&") if part.partition("=")[0] in dict(options))
    names = (
        {} if interface in ("virtual", "replay", "file") else {"name": f"{address}?{placing}" if placing else address}
    )
    return names | ({"channel": channel} if interface == "socketcan" else {})


def has_operation(driver_type: str, operation: str) -> bool:
    """Return whether skin-config can do this with drivers of a type; False for a type that is not installed here."""
    try:
        return operation in operations_of(load_driver(driver_type), alone=True)
    except ConfigurationError:
        return False
