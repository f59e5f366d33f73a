"""Files: what killed programs left in shared memory, and recordings that are cut, damaged or incomplete."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.cli._format import age_text, count_text, plural
from skinware_drivers.doctor.evidence import Evidence, NamespaceSeen, RecordingSeen
from skinware_drivers.doctor.finding import Finding, Looked, Note, Severity

AREA = "files"
_PROGRAMS, _RECORD = "reference/faults.md#programs", "how-to/record.md#after-a-crash"
_MIB = 1 << 20
_FORGOTTEN_S = 600.0
"""Another namespace in which nothing lives and nothing happens for so long."""


def check(evidence: Evidence) -> Iterator[Note]:
    """What is to be said of files."""
    for namespace in evidence.namespaces:
        if not namespace.problem:
            told = f"{plural(len(namespace.living), 'service')} alive, {len(namespace.dead)} dead"
            yield Looked(AREA, f"namespace {namespace.name}", told)
        yield from _damaged(namespace)
        yield from _left(namespace, {driver.name for driver in evidence.drivers} if namespace.is_ours else set())
    if evidence.recording is not None:
        yield from _recording(evidence.recording)


def _damaged(namespace: NamespaceSeen) -> Iterator[Finding]:
    for text in namespace.damaged:
        yield Finding(
            Severity.WARNING,
            AREA,
            "a file cannot be read, and was left alone",
            f"namespace {namespace.name}",
            text,
            "if its writer is not of a newer version of this package, remove the file",
            (f"ls -l {namespace.path}",),
            "reference/errors.md",
        )


def _left(namespace: NamespaceSeen, drivers: set[str]) -> Iterator[Finding]:
    """What nobody uses any more; drivers of the namespace that was asked for are told as killed ones already."""
    dead = [name for name in namespace.dead if name not in drivers]
    is_forgotten = namespace.is_ours or (not namespace.living and namespace.idle_s > _FORGOTTEN_S)
    if not dead or not is_forgotten:
        return
    since = "" if namespace.is_ours else f", untouched for {age_text(namespace.idle_s * 1e9)}"
    yield Finding(
        Severity.NOTE,
        AREA,
        f"{plural(len(dead), 'file')} of killed programs {'are' if len(dead) > 1 else 'is'} left",
        f"namespace {namespace.name}",
        f"{', '.join(dead)}: {namespace.bytes_of_dead / _MIB:.1f} MiB of shared memory{since}",
        "start them again, or remove what nobody needs any more",
        tuple(f"rm {namespace.path}/{name}.ring" for name in dead[:3]),
        _PROGRAMS,
    )


def _recording(recording: RecordingSeen) -> Iterator[Note]:
    whole = "ended in good order" if recording.is_whole else "not ended in good order"
    told = f"{recording.size / _MIB:.1f} MiB, {age_text(recording.duration_s * 1e9)}, {whole}"
    services = f"; services {', '.join(recording.services)}" if recording.services else ""
    yield Looked(AREA, recording.name, told + services)
    if not recording.is_whole:
        yield Finding(
            Severity.WARNING,
            AREA,
            "the recording was cut off",
            recording.name,
            "its index is missing: the recorder was killed, the disk was full, or the end of the file is lost",
            "all but the last 0.3 s can be read; tools of others need a whole file",
            (f"skin-recover {recording.name}",),
            _RECORD,
        )
    for problem in recording.problems:
        yield Finding(
            Severity.ERROR,
            AREA,
            "the recording is damaged",
            recording.name,
            problem,
            "what is damaged is left out of everything; check the disk",
            (f"skin-recover {recording.name}",),
            _RECORD,
        )
    if recording.lost:
        yield Finding(
            Severity.ERROR,
            AREA,
            "the recorder lost frames",
            recording.name,
            f"{plural(recording.lost, 'frame')} published meanwhile are not in it",
            "record on a machine that is less busy, or give the driver more slots",
            ("skin-driver ... --slots 64",),
            "how-to/record.md",
        )
    for jump in recording.clock_sets:
        yield Finding(
            Severity.NOTE,
            AREA,
            "the wall clock was set, or the machine slept",
            f"{recording.name} at {age_text(jump.time_s * 1e9)}",
            f"by {jump.by_s:+.2f} s",
            "times of data are of another clock and are right; the times of the file's messages jump there",
            see="explanation/time.md",
        )
    if recording.boots > 1:
        yield Finding(
            Severity.NOTE,
            AREA,
            "the recording spans starts of the machine",
            recording.name,
            f"{recording.boots} starts, and times of data count from each",
            "compare times within one of them only",
            see="explanation/time.md",
        )
    if recording.events.get("unreadable"):
        yield Finding(
            Severity.WARNING,
            AREA,
            "a service could not be recorded",
            recording.name,
            f"{count_text(recording.events['unreadable'])} events of it",
            "see the events of the recording",
            see="reference/recording.md#events",
        )


__all__ = ["check"]
