"""All that was seen and found, as one Markdown text to attach to an issue, without secrets."""

from __future__ import annotations

from collections.abc import Iterator

from skinware._printable import printable
from skinware.cli._format import age_text, plural
from skinware_drivers.doctor.evidence import Counted, Counts, DriverSeen, Evidence
from skinware_drivers.doctor.examining import Examination
from skinware_drivers.doctor.finding import Finding
from skinware_drivers.doctor.scrubbing import Secrets, scrubbed


def as_markdown(evidence: Evidence, found: Examination, secrets: Secrets | None = None) -> str:
    """The report.

    Args:
        evidence: what was seen.
        found: what came of it.
        secrets: what must not be in it; default: those of this machine.
    """
    text = "\n".join(map(printable, _lines(evidence, found))) + "\n"
    return scrubbed(text, secrets or Secrets.of_this_machine())


def _lines(evidence: Evidence, found: Examination) -> Iterator[str]:
    yield "# Report of skin-doctor"
    yield ""
    about = "a running skin" if evidence.recording is None else f"the recording {evidence.recording.name}"
    span = age_text(evidence.seconds * 1e9)
    yield f"Of {about}, {span}, {plural(len(evidence.drivers), 'driver')}: {plural(len(found.findings), 'finding')}."
    yield ""
    for number, finding in enumerate(found.findings, 1):
        yield from _finding(number, finding)
    yield "## Looked at"
    yield ""
    yield from _table(("area", "what", "seen"), [(one.area, one.what, one.seen) for one in found.looked])
    yield "## Not looked at"
    yield ""
    yield from _table(("area", "what", "why"), [(one.area, one.what, one.why) for one in found.not_looked])
    for driver in evidence.drivers:
        yield from _driver(driver)


def _finding(number: int, finding: Finding) -> Iterator[str]:
    yield f"## {number}. {finding.severity.name.lower()}: {finding.what}"
    yield ""
    yield f"* area: {finding.area}"
    yield f"* where: {finding.where}"
    yield f"* evidence: {finding.evidence}"
    yield f"* what to do: {finding.action} (docs/{finding.see})"
    yield ""
    if finding.commands:
        yield from ("```console", *finding.commands, "```", "")


def _table(titles: tuple[str, ...], rows: list[tuple[str, ...]]) -> Iterator[str]:
    if not rows:
        yield from ("Nothing.", "")
        return
    yield f"| {' | '.join(titles)} |"
    yield f"|{'---|' * len(titles)}"
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |"
    yield ""


def _driver(driver: DriverSeen) -> Iterator[str]:
    """Counters, which the tables above sum up."""
    yield f"## Counters of driver {driver.name}"
    yield ""
    what = driver.driver_type or "no type told"
    yield f"{what}, data path {driver.data_path}, {plural(driver.frames, 'frame')} seen."
    yield ""
    yield "```text"
    for bus in driver.buses:
        yield f"bus {bus.name}: {_counted(bus.counted)}"
        for sample in bus.samples:
            yield f"    not used, {sample}"
        for change in bus.changes[1:]:
            yield f"    at {change.time_s:.1f} s {change.state} {change.reason}".rstrip()
    for patch in driver.patches:
        fresh = f"{patch.fresh} of {patch.sensors} fresh"
        yield f"patch {patch.name}: {patch.state}, {fresh}, {_counted(patch.counted)}"
        for change in patch.changes[1:]:
            yield f"    at {change.time_s:.1f} s {change.state}"
    yield from ("```", "")


def _counted(counted: Counted) -> str:
    """Counters that are not 0: in all (in the time that was looked at)."""
    told = [f"{name} {count} (+{counted.grown.get(name, 0)})" for name, count in counted.total.items() if count]
    hours = [f"hour {hour + 1}: {_some(counts)}" for hour, counts in counted.hours]
    return ", ".join(told) + (f"; {'; '.join(hours)}" if len(hours) > 1 else "")


def _some(counts: Counts) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items() if count)
