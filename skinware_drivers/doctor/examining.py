"""Run all checks, and sort what they find."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from skinware.memory.namespace import Namespace
from skinware.text import printable
from skinware_drivers.doctor import buses, machine, patches, programs
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, NotLooked

CHECKS: dict[str, Callable[[Evidence], Iterator[Note]]] = {
    "interfaces": machine.check_interfaces,
    "permissions": machine.check_permissions,
    "bridges": programs.check_bridges,
    "buses": buses.check,
    "patches": patches.check_patches,
    "timing": programs.check_timing,
    "taxels": patches.check_taxels,
    "files": programs.check_files,
    "machine": machine.check_machine,
}
"""The check of each area, in the order in which data travels."""

_OF_ANY_TIME = ("skin-recover", "skin-driver", "skin-calibrate", "skin-doctor", "pip ")
"""Commands that help with a recording, whose drivers and devices may be gone."""
_FOLLOWS_NAMESPACE = (
    "skin-calibrate", "skin-calm", "skin-config", "skin-doctor", "skin-driver", "skin-info", "skin-top", "skin-wipe"
)  # fmt: skip


@dataclass(frozen=True)
class Examination:
    """The result of all checks: findings, the worst first, then in the order in which data travels."""

    findings: tuple[Finding, ...]
    looked: tuple[Looked, ...]
    not_looked: tuple[NotLooked, ...]


def examine(evidence: Evidence) -> Examination:
    """Run all checks on what was seen."""
    notes = [_finished(note, area, evidence) for area, check in CHECKS.items() for note in check(evidence)]
    return Examination(
        tuple(sorted((note for note in notes if isinstance(note, Finding)), key=lambda one: -one.severity)),
        tuple(note for note in notes if isinstance(note, Looked)),
        tuple(note for note in notes if isinstance(note, NotLooked)),
    )


def _finished(note: Note, area: str, evidence: Evidence) -> Note:
    """Return a note with its area, printable texts, and the commands that are of use.

    Commands reach the namespace that was examined, even if it is not the default here.
    """
    texts: dict[str, Any] = {name: printable(value) for name, value in vars(note).items() if isinstance(value, str)}
    elsewhere = evidence.namespace if evidence.namespace not in ("", Namespace().name) else ""
    if not isinstance(note, Looked):
        commands = []
        for command in note.commands:
            if evidence.is_live or command.startswith(_OF_ANY_TIME):
                if elsewhere and "--namespace" not in command and command.startswith(_FOLLOWS_NAMESPACE):
                    command = f"{command} --namespace {shlex.quote(elsewhere)}"
                commands.append(printable(command))
        texts["commands"] = tuple(commands)
    return replace(note, **{**texts, "area": area})
