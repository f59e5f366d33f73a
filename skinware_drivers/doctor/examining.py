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
from skinware_drivers.doctor.rules import Finding, Looked, Note, NotLooked

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
    """Run all checks on what was seen; texts become printable, and commands that are of no use are left out."""
    notes: list[Note] = []
    is_elsewhere = evidence.namespace not in ("", Namespace().name)

    def whole(command: str) -> str:
        in_it = is_elsewhere and "--namespace" not in command and command.startswith(_FOLLOWS_NAMESPACE)
        return printable(f"{command} --namespace {shlex.quote(evidence.namespace)}" if in_it else command)

    for area, check in CHECKS.items():
        for note in check(evidence):
            texts: dict[str, Any] = {k: printable(value) for k, value in vars(note).items() if isinstance(value, str)}
            if not isinstance(note, Looked):
                texts["commands"] = tuple(
                    whole(command) for command in note.commands if evidence.is_live or command.startswith(_OF_ANY_TIME)
                )
            notes.append(replace(note, **{**texts, "area": area}))
    return Examination(
        tuple(sorted((note for note in notes if isinstance(note, Finding)), key=lambda one: -one.severity)),
        tuple(note for note in notes if isinstance(note, Looked)),
        tuple(note for note in notes if isinstance(note, NotLooked)),
    )
