"""Run the doctor until it finds a fault that a test made."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from skinware import Namespace
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.finding import Finding
from skinware_drivers.doctor.looking import look
from skinware_drivers.testing.waiting import wait_until

SHORT_S = 0.4
_RUNS = 12


def looked(seconds: float = SHORT_S) -> Evidence:
    """Return the evidence of the namespace of this test."""
    return look(Namespace(), seconds)


def found(seconds: float = SHORT_S) -> tuple[Finding, ...]:
    """Return the findings."""
    return examine(looked(seconds)).findings


def found_until(is_there: Callable[[Finding], bool], seconds: float = SHORT_S) -> Finding:
    """The finding that a test waits for."""
    findings: list[Finding] = []

    def look_again() -> bool:
        findings[:] = [finding for finding in found(seconds) if is_there(finding)]
        return bool(findings)

    wait_until(look_again)
    return findings[0]


def nothing_found(run_and_look: Callable[[], Sequence[Finding]]) -> None:
    """Nothing is found in one of some runs; where other programs want all processors, the findings may name that."""
    for _ in range(_RUNS):
        if not (findings := run_and_look()):
            return
    assert any("machine load" in finding.evidence for finding in findings), findings
    assert os.getloadavg()[0] > (os.cpu_count() or 1), findings


def of(area: str, words: str) -> Callable[[Finding], bool]:
    """Return a test of a finding: its area, and words in its text."""
    return lambda finding: finding.area == area and words in finding.what
