"""Files: what killed programs left in shared memory, and recordings that are cut, damaged or incomplete."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from skinware.text import age_text, count_text, plural
from skinware_drivers.doctor.evidence import Evidence, NamespaceSeen, RecordingSeen
from skinware_drivers.doctor.finding import Finding, Looked, Note, Severity

AREA = "files"
_PROGRAMS, _RECORD = "reference/faults.md#programs", "how-to/record.md#after-a-crash"
_MIB = 1 << 20
_MOST_COMMANDS = 3
_FORGOTTEN_S = 600.0
"""Another namespace in which nothing lives and nothing happens for so long."""


def check(evidence: Evidence) -> Iterator[Note]:
    others = [one for one in evidence.namespaces if not one.is_ours and not one.problem]
    for namespace in evidence.namespaces:
        if namespace.is_ours and not namespace.problem:
            told = f"{plural(len(namespace.living), 'service')} alive, {len(namespace.dead)} dead"
            yield Looked(AREA, f"namespace {namespace.name}", told)
        if namespace.is_ours:
            yield from _damaged(namespace)
    if others:
        living, dead = sum(len(one.living) for one in others), sum(len(one.dead) for one in others)
        told = f"{plural(living, 'service')} alive, {dead} dead"
        yield Looked(AREA, plural(len(others), "other namespace"), told)
    yield from _left(evidence)
    yield from _forgotten(evidence)
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


def _left(evidence: Evidence) -> Iterator[Finding]:
    """What killed programs left in the namespace that was asked for; its drivers are told as killed ones already."""
    drivers = {driver.name for driver in evidence.drivers}
    for namespace in evidence.namespaces:
        dead = [name for name in namespace.dead if name not in drivers]
        if namespace.is_ours and dead:
            yield Finding(
                Severity.NOTE,
                AREA,
                f"{plural(len(dead), 'file')} of killed programs {'are' if len(dead) > 1 else 'is'} left",
                f"namespace {namespace.name}",
                f"{', '.join(dead)}: {namespace.bytes_of_dead / _MIB:.1f} MiB of shared memory",
                "start them again, or remove those that are not needed any more",
                tuple(f"rm {namespace.path}/{name}.ring" for name in dead[:_MOST_COMMANDS]),
                _PROGRAMS,
            )


def _forgotten(evidence: Evidence) -> Iterator[Finding]:
    found = [
        one
        for one in evidence.namespaces
        if not one.is_ours and one.dead and not one.living and one.idle_s > _FORGOTTEN_S
    ]
    if found:
        size = sum(one.bytes_of_dead for one in found) / _MIB
        told = [f"{one.name} (untouched for {age_text(one.idle_s * 1e9)})" for one in found[:_MOST_COMMANDS]]
        yield Finding(
            Severity.NOTE,
            AREA,
            f"{plural(len(found), 'namespace')} of killed programs {'are' if len(found) > 1 else 'is'} left",
            ", ".join(told) + (" ..." if len(found) > len(told) else ""),
            f"{sum(len(one.dead) for one in found)} services, none alive: {size:.1f} MiB of shared memory",
            "they harm nothing while shared memory is left; if one is yours, see what it holds before you remove it",
            tuple(f"skin-info --namespace {one.name}" for one in found[:_MOST_COMMANDS]),
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
            (f"skin-recover {shlex.quote(recording.name)}",),
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
            (f"skin-recover {shlex.quote(recording.name)}",),
            _RECORD,
        )
    if recording.lost:
        yield Finding(
            Severity.ERROR,
            AREA,
            "the recorder lost frames",
            recording.name,
            f"{plural(recording.lost, 'frame')} published meanwhile are not in it",
            "record on a machine that is less busy, or start the driver with more slots: --slots 64",
            see="how-to/record.md",
        )
    for jump in recording.clock_sets:
        yield Finding(
            Severity.NOTE,
            AREA,
            "the wall clock was set, or the machine slept",
            f"{recording.name} at {age_text(jump.time_s * 1e9)}",
            f"by {jump.by_s:+.2f} s",
            "times of data and of the file are of another clock and go on as before; only publish_time jumps there",
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
