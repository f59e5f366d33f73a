"""All checks, one after the other, and what they found, the worst first."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from skinware.memory.namespace import Namespace
from skinware.text import printable
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

_FOLLOWS_NAMESPACE = (
    "skin-calibrate", "skin-calm", "skin-config", "skin-doctor", "skin-driver", "skin-info", "skin-top", "skin-wipe"
)  # fmt: skip

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
    notes: list[Note] = [_clean(note, evidence) for check in CHECKS for note in check(evidence)]
    findings = sorted(_of(Finding, notes), key=lambda finding: -finding.severity)  # stable: the order stays
    return Examination(tuple(findings), tuple(_of(Looked, notes)), tuple(_of(NotLooked, notes)))


def _clean(note: Note, evidence: Evidence) -> Note:
    fits = bool if evidence.is_live else _is_of_any_time
    texts: dict[str, Any] = {name: printable(value) for name, value in vars(note).items() if isinstance(value, str)}
    if not isinstance(note, Looked):
        texts["commands"] = tuple(
            printable(_in_namespace(command, evidence.namespace)) for command in note.commands if fits(command)
        )
    return replace(note, **texts)


def _in_namespace(command: str, namespace: str) -> str:
    """A command that reaches the namespace that was looked at, also where that is not the default one here."""
    if not namespace or namespace == Namespace().name or "--namespace" in command:
        return command
    return f"{command} --namespace {shlex.quote(namespace)}" if command.startswith(_FOLLOWS_NAMESPACE) else command


def _is_of_any_time(command: str) -> bool:
    """Whether a command helps who has only a recording; what is in it may be long over."""
    return command.startswith(_OF_ANY_TIME)


def _of(kind: type[_NoteT], notes: list[Note]) -> list[_NoteT]:
    return [note for note in notes if isinstance(note, kind)]
