"""Findings of the doctor, and what it looked at, or could not."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field


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
