"""All checks, one after the other, and what they found, the worst first."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from skinware._printable import printable
from skinware_drivers.doctor import bridges, buses, files, interfaces, machine, patches, permissions, taxels, timing
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, NotLooked

CHECKS: tuple[Callable[[Evidence], Iterator[Note]], ...] = (
    interfaces.check,
    permissions.check,
    bridges.check,
    buses.check,
    patches.check,
    timing.check,
    taxels.check,
    files.check,
    machine.check,
)
"""By the way that data takes."""

_OF_ANY_TIME = ("skin-recover", "skin-driver", "skin-calibrate", "skin-doctor", "pip ")

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
    fits = _is_of_any_time if evidence.recording is not None else bool
    notes: list[Note] = [_clean(note, fits) for check in CHECKS for note in check(evidence)]
    findings = sorted(_of(Finding, notes), key=lambda finding: -finding.severity)  # stable: the order stays
    return Examination(tuple(findings), tuple(_of(Looked, notes)), tuple(_of(NotLooked, notes)))


def _clean(note: Note, fits: Callable[[str], bool]) -> Note:
    """With texts that may be printed (names come from files and devices), and commands that fit."""
    texts: dict[str, Any] = {name: printable(value) for name, value in vars(note).items() if isinstance(value, str)}
    if not isinstance(note, Looked):
        texts["commands"] = tuple(printable(command) for command in note.commands if fits(command))
    return replace(note, **texts)


def _is_of_any_time(command: str) -> bool:
    """Whether a command helps who has only a recording; what is in it may be long over."""
    return command.startswith(_OF_ANY_TIME)


def _of(kind: type[_NoteT], notes: list[Note]) -> list[_NoteT]:
    return [note for note in notes if isinstance(note, kind)]


__all__ = ["CHECKS", "Examination", "examine"]
