"""Looks at what a test has broken, until that is found."""

from __future__ import annotations

from collections.abc import Callable

from skinware import Namespace
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.finding import Finding
from skinware_drivers.doctor.looking import look
from skinware_drivers.testing.waiting import wait_until

SHORT_S = 0.4


def looked(seconds: float = SHORT_S) -> Evidence:
    """What is seen of the namespace of this test."""
    return look(Namespace(), seconds)


def found(seconds: float = SHORT_S) -> tuple[Finding, ...]:
    """What is found in it."""
    return examine(looked(seconds)).findings


def found_until(is_there: Callable[[Finding], bool], seconds: float = SHORT_S) -> Finding:
    """The finding that a test waits for."""
    findings: list[Finding] = []

    def look_again() -> bool:
        findings[:] = [finding for finding in found(seconds) if is_there(finding)]
        return bool(findings)

    wait_until(look_again)
    return findings[0]


def of(area: str, words: str) -> Callable[[Finding], bool]:
    """Whether a finding is of an area and has some words in what it says."""
    return lambda finding: finding.area == area and words in finding.what
