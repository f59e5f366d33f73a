"""Run the doctor until it finds a fault that a test made."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from skinware import Namespace
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.looking import look
from skinware_drivers.doctor.rules import Finding
from skinware_drivers.testing.waiting import wait_until

SHORT_S = 0.4
_RUNS = 12
_HELD_UP_NS = 100_000_000
"""From such a wait on, the package itself counts silence from zero."""


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
    """Nothing is found; what is found while other programs had the processors says nothing, and is looked for again."""
    for _ in range(_RUNS):
        with Waits() as waits:
            findings = run_and_look()
        if not findings:
            return
        assert waits.total_ns > _HELD_UP_NS, findings


class Waits:
    """Adds up how long threads of this process were ready to run and had no processor, as the kernel counts it."""

    def __init__(self) -> None:
        self.total_ns = 0
        self._known: dict[str, int] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> Waits:
        self._look()
        self.total_ns = 0
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stop.wait(0.02):  # threads end, and their counts with them
            self._look()

    def _look(self) -> None:
        for task in Path("/proc/self/task").iterdir():
            with suppress(OSError):
                waited_ns = int((task / "schedstat").read_text().split()[1])
                self.total_ns += waited_ns - self._known.get(task.name, 0)
                self._known[task.name] = waited_ns


def of(area: str, words: str) -> Callable[[Finding], bool]:
    """Return a test of a finding: its area, and words in its text."""
    return lambda finding: finding.area == area and words in finding.what
