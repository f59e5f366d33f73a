"""Findings of the doctor, made from the texts of ``rules.toml``, and the words that these are filled in with."""

from __future__ import annotations

import contextlib
import enum
import shlex
import tomllib
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from skinware.errors import ConfigurationError
from skinware.text import age_text, count_text, plural
from skinware_drivers.bus_names import BusName
from skinware_drivers.doctor.evidence import Counted, DriverSeen, Evidence
from skinware_drivers.operations import operations_of
from skinware_drivers.registry import load_driver

_SLOW_GOVERNORS = ("powersave", "conservative", "userspace")


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
    area: str = field(default="", kw_only=True)
    what: str
    seen: str


@dataclass(frozen=True)
class NotLooked:
    area: str = field(default="", kw_only=True)
    what: str
    why: str
    commands: tuple[str, ...] = ()


Note = Finding | Looked | NotLooked


@dataclass(frozen=True)
class Rule:
    """The texts of a kind of finding; ``what`` and ``commands`` have ``{names}`` to fill in."""

    severity: Severity
    what: str
    action: str
    commands: tuple[str, ...] = ()
    see: str = "troubleshooting.md"
    unit: str = "frame"

    def found(self, where: str, evidence: str, severity: Severity | None = None, /, **names: object) -> Finding:
        """Return a finding of this kind; the names are filled in, quoted for a shell in commands."""
        what, commands = self.what.format_map(names), self.advised(**names)
        return Finding(severity or self.severity, what, where, evidence, self.action, commands, self.see)

    def advised(self, **names: object) -> tuple[str, ...]:
        """Return the commands whose names are given, filled in and quoted for a shell."""
        quoted = {name: shlex.quote(str(value)) for name, value in names.items()}
        commands = []
        for command in self.commands:
            with contextlib.suppress(KeyError):
                commands.append(command.format_map(quoted))
        return tuple(commands)


def _read() -> dict[str, dict[str, Rule]]:
    rules: dict[str, dict[str, Rule]] = {}
    for kind, texts in tomllib.loads((files(__package__) / "rules.toml").read_text()).items():
        of_all = {key: value for key, value in texts.items() if not isinstance(value, dict)}
        rules[kind] = {}
        for name, own in texts.items():
            if name not in of_all:
                text: dict[str, Any] = of_all | own
                severity, commands = Severity[text.pop("severity").upper()], tuple(text.pop("commands", ()))
                rules[kind][name] = Rule(severity, commands=commands, **text)
    return rules


RULES = _read()
"""By what they concern, and by name."""


def loss_seen(counted: Counted, name: str, unit: str, evidence: Evidence, beside: str = "") -> tuple[bool, str] | None:
    """Return whether a counter grew while the doctor looked, and its text with what is beside it; None if it is 0."""
    total, grown, span = counted.total.get(name, 0), counted.grown.get(name, 0), age_text(evidence.seconds * 1e9)
    if not total and not grown:
        return None
    if not grown:
        before = "since the driver was started" if evidence.is_live else "before the recording began"
        return False, f"{plural(total, unit)} {before}, none in these {span}{beside}"
    text = f"{plural(grown, unit)} in {span}"
    if evidence.is_live and total > grown:
        text += f" ({count_text(total)} since the driver was started)"
    return True, text + beside


def brief(bus_name: str) -> str:
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


def circumstances(evidence: Evidence, driver: DriverSeen) -> str:
    """Return in words what may keep a driver from its work on this machine, also if it is harmless."""
    if not evidence.is_live:
        return "nothing is known of the machine that recorded"
    machine = evidence.machine
    parts = [f"machine load {machine.load:.1f} on {plural(machine.cpus, 'processor')}"]
    if driver.scheduling:
        parts.append(f"the driver has {driver.scheduling}")
    slow = [name for name in machine.governors if name in _SLOW_GOVERNORS]
    if slow:
        parts.append(f"CPU governor {', '.join(slow)}")
    return ", ".join(parts)
