"""All checks, one after the other, and what they found, the worst first."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from skinware_drivers.doctor import buses, files, interfaces, machine, patches, permissions, taxels, timing
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, NotLooked

CHECKS: tuple[Callable[[Evidence], Iterator[Note]], ...] = (
    interfaces.check,
    permissions.check,
    buses.check,
    patches.check,
    timing.check,
    taxels.check,
    files.check,
    machine.check,
)
"""By the way that data takes."""

_NoteT = TypeVar("_NoteT", Finding, Looked, NotLooked)


@dataclass(frozen=True)
class Examination:
    """What was found.

    Attributes:
        findings: the worst first, else by the way that data takes.
        looked: what was looked at.
        not_looked: what could not be looked at.
    """

    findings: tuple[Finding, ...]
    looked: tuple[Looked, ...]
    not_looked: tuple[NotLooked, ...]


def examine(evidence: Evidence) -> Examination:
    """Run all checks.

    Args:
        evidence: what was seen.
    """
    notes = [note for check in CHECKS for note in check(evidence)]
    findings = sorted(_of(Finding, notes), key=lambda finding: -finding.severity)  # stable: the order stays
    return Examination(tuple(findings), tuple(_of(Looked, notes)), tuple(_of(NotLooked, notes)))


def _of(kind: type[_NoteT], notes: list[Note]) -> list[_NoteT]:
    return [note for note in notes if isinstance(note, kind)]


__all__ = ["CHECKS", "Examination", "examine"]
