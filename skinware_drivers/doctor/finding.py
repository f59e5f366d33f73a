"""What comes of a check: findings, what was looked at, and what could not be."""

from __future__ import annotations

import enum
from dataclasses import dataclass


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
