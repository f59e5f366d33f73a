"""What came of proving a driver: one line per thing that was looked at, as data and as a text to attach to an issue."""

from __future__ import annotations

import enum
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from skinware._printable import printable
from skinware_drivers.doctor.scrubbing import Secrets, scrubbed


class Verdict(enum.StrEnum):
    """How a check went."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    """The person wanted so."""
    UNKNOWN = "not judged"


@dataclass(frozen=True)
class Check:
    """One thing that was looked at.

    Attributes:
        what: it.
        where: module, or bus; empty: all of it.
        verdict: how it went.
        seen: the evidence, in words.
    """

    what: str
    where: str
    verdict: Verdict
    seen: str


@dataclass
class Proof:
    """All of it.

    Attributes:
        driver: name of the driver.
        driver_type: of it.
        about: facts: what is told of the device, the driver and this machine's programs.
        checks: in the order in which they were made.
    """

    driver: str
    driver_type: str
    about: dict[str, str]
    checks: list[Check] = field(default_factory=list)

    def add(self, what: str, where: str, verdict: Verdict | bool, seen: str) -> None:
        """Add a check; True and False are passed and failed."""
        if isinstance(verdict, bool):
            verdict = Verdict.PASSED if verdict else Verdict.FAILED
        self.checks.append(Check(what, where, verdict, seen))

    @property
    def counts(self) -> dict[str, int]:
        counted = Counter(check.verdict for check in self.checks)
        return {verdict.value: counted[verdict] for verdict in Verdict}

    @property
    def is_proven(self) -> bool:
        """Whether nothing failed and something passed that a person did."""
        touched = any(check.verdict is Verdict.PASSED and check.what == "right module" for check in self.checks)
        return touched and not self.counts["failed"]

    def as_data(self) -> dict[str, Any]:
        """For JSON; texts without secrets."""
        secrets = Secrets.of_this_machine()
        checks = [
            {"what": one.what, "where": one.where, "verdict": one.verdict.value, "seen": scrubbed(one.seen, secrets)}
            for one in self.checks
        ]
        about = {name: scrubbed(text, secrets) for name, text in self.about.items()}
        return {
            "driver": self.driver,
            "driver_type": self.driver_type,
            "is_proven": self.is_proven,
            "counts": self.counts,
            "about": about,
            "checks": checks,
        }

    def as_markdown(self) -> str:
        return scrubbed("\n".join(map(printable, self._lines())) + "\n", Secrets.of_this_machine())

    def _lines(self) -> Iterator[str]:
        yield f"# Driver {self.driver_type or self.driver}: {'proven' if self.is_proven else 'not proven'}"
        yield ""
        yield f"By `skin-prove`: {', '.join(f'{count} {verdict}' for verdict, count in self.counts.items() if count)}."
        yield ""
        yield from (f"* {name}: {text}" for name, text in self.about.items())
        yield ""
        yield "| | what | where | seen |"
        yield "|---|---|---|---|"
        for check in self.checks:
            cells = (check.verdict.value, check.what, check.where, check.seen)
            yield f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"
