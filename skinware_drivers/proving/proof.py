"""The verdicts of a proof, and its files."""

from __future__ import annotations

import contextlib
import enum
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from skinware.errors import ConfigurationError
from skinware.text import printable
from skinware_drivers.doctor.report import Secrets, scrubbed


class Verdict(enum.StrEnum):
    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    """The person left it out."""
    UNKNOWN = "not judged"


@dataclass(frozen=True)
class Check:
    """A check of a module or bus, or of the whole device if ``where`` is empty."""

    what: str
    where: str
    verdict: Verdict
    seen: str


@dataclass
class Proof:
    """All checks of a device, and facts about it, the driver and this machine's programs."""

    driver: str
    driver_type: str
    about: dict[str, str]
    checks: list[Check] = field(default_factory=list)

    def add(self, what: str, where: str, verdict: Verdict | bool, seen: str) -> None:
        if isinstance(verdict, bool):
            verdict = Verdict.PASSED if verdict else Verdict.FAILED
        self.checks.append(Check(what, where, verdict, seen))

    @property
    def counts(self) -> dict[str, int]:
        counted = Counter(check.verdict for check in self.checks)
        return {verdict.value: counted[verdict] for verdict in Verdict}

    @property
    def is_proven(self) -> bool:
        """Return whether no check failed, and a press of a person passed."""
        touched = any(check.verdict is Verdict.PASSED and check.what == "right module" for check in self.checks)
        return touched and not self.counts["failed"]

    def as_data(self) -> dict[str, Any]:
        """Return the data for JSON, without secrets."""
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
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.counts.items() if count)
        lines = [f"# Driver {self.driver_type or self.driver}: {'proven' if self.is_proven else 'not proven'}", ""]
        lines += [f"By `skin-prove`: {counts}.", ""]
        lines += [f"* {name}: {text}" for name, text in self.about.items()]
        lines += ["", "| | what | where | seen |", "|---|---|---|---|"]
        for check in self.checks:
            cells = (check.verdict.value, check.what, check.where, check.seen)
            lines.append(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |")
        return scrubbed("\n".join(map(printable, lines)) + "\n", Secrets.of_this_machine())


class ProofFiles:
    """The files of a proof: a report, the same as JSON, and a capture, whose result is empty before its end."""

    def __init__(self, stem: Path) -> None:
        self.report, self.data, self.capture = self._all = [
            stem.with_name(f"{stem.name}.{ending}") for ending in ("md", "json", "mcap")
        ]
        self.captured: dict[str, Any] = {}

    @property
    def written(self) -> list[str]:
        return [str(path) for path in self._all if path.exists()]

    def refuse_old(self) -> None:
        """Raise a ``ConfigurationError`` if the folder is missing, or a file exists already."""
        if not self.capture.parent.is_dir():
            raise ConfigurationError(f"-o {self.capture.with_suffix('')}: there is no folder {self.capture.parent}")
        if self.written:
            raise ConfigurationError(f"{self.written[0]}: exists already: give another name (-o), or remove it")

    def capture_text(self, *, is_whole: bool) -> str:
        beginning = "from the first byte on" if is_whole else "without the frames before skin-prove began"
        text = f"{self.capture.name}, {beginning}"
        if self.captured.get("missed"):
            text += f"; {self.captured['missed']} frames missed"
        return text + (f"; ended early: {self.captured['problem']}" if self.captured.get("problem") else "")

    def write(self, proof: Proof) -> OSError | None:
        """Write the report and the same as JSON; return an error, so that the proof can be shown first."""
        data = msgspec.json.format(msgspec.json.encode(proof.as_data()))
        wrong = None
        for path, content in ((self.report, proof.as_markdown().encode()), (self.data, data + b"\n")):
            try:
                path.write_bytes(content)
            except OSError as error:
                with contextlib.suppress(OSError):
                    path.unlink()  # an incomplete file
                wrong = wrong or OSError(error.errno, error.strerror, str(path))
        return wrong
