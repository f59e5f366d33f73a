"""Files: those of killed programs in shared memory, and recordings that are cut, damaged or incomplete."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from skinware.text import age_text, count_text, plural
from skinware_drivers.doctor.evidence import Evidence, NamespaceSeen, RecordingSeen
from skinware_drivers.doctor.finding import Finding, Looked, Note, Rule, Severity

_PROGRAMS, _RECORD, _TIME = "reference/faults.md#programs", "how-to/record.md#after-a-crash", "explanation/time.md"
_MIB = 1 << 20
_MOST_COMMANDS = 3
_FORGOTTEN_S = 600.0
"""Time after which another namespace without a living writer is called forgotten."""

UNREADABLE_FILE = Rule(
    Severity.WARNING,
    "a file cannot be read, and was left alone",
    "if its writer is not of a newer version of this package, remove the file",
    ("ls -l {path}",),
    "reference/errors.md",
)
LEFT = Rule(
    Severity.NOTE,
    "{files} of killed programs {are} left",
    "start them again, or remove the files that are not needed any more",
    see=_PROGRAMS,
)
FORGOTTEN = Rule(
    Severity.NOTE,
    "{namespaces} of killed programs {are} left",
    "they harm nothing while shared memory is left; if one is yours, see what it holds before you remove it",
    see=_PROGRAMS,
)
CUT = Rule(
    Severity.WARNING,
    "the recording was cut off",
    "all but the last 0.3 s can be read; tools of others need a whole file",
    ("skin-recover {file}",),
    _RECORD,
)
DAMAGED = Rule(
    Severity.ERROR,
    "the recording is damaged",
    "damaged parts are left out of everything; check the disk",
    ("skin-recover {file}",),
    _RECORD,
)
MISSED = Rule(
    Severity.ERROR,
    "the recorder missed samples",
    "record on a machine that is less busy, or start the driver with more slots: --slots 64",
    see="how-to/record.md",
)
CLOCK_SET = Rule(
    Severity.NOTE,
    "the wall clock was set, or the machine slept",
    "times of data and of the file come from another clock and do not jump; only publish_time jumps",
    see=_TIME,
)
RESTARTS = Rule(
    Severity.NOTE,
    "the recording spans starts of the machine",
    "compare times only between two starts",
    see=_TIME,
)
NOT_RECORDED = Rule(
    Severity.WARNING,
    "a service could not be recorded",
    "see the events of the recording",
    see="reference/recording.md#events",
)


def check(evidence: Evidence) -> Iterator[Note]:
    others = [one for one in evidence.namespaces if not one.is_ours and not one.problem]
    for namespace in evidence.namespaces:
        where = f"namespace {namespace.name}"
        if namespace.is_ours and not namespace.problem:
            yield Looked(where, _services([namespace]))
        for error in namespace.damaged if namespace.is_ours else ():
            yield UNREADABLE_FILE.found(where, error, path=namespace.path)
    if others:
        yield Looked(plural(len(others), "other namespace"), _services(others))
    yield from _left(evidence)
    yield from _forgotten(others)
    if evidence.recording is not None:
        yield from _recording(evidence.recording)


def _services(namespaces: list[NamespaceSeen]) -> str:
    living = plural(sum(len(one.living) for one in namespaces), "service")
    return f"{living} alive, {sum(len(one.dead) for one in namespaces)} dead"


def _left(evidence: Evidence) -> Iterator[Finding]:
    """Find files of killed programs in the namespace to examine; killed drivers are another finding."""
    drivers = {driver.name for driver in evidence.drivers}
    for namespace in evidence.namespaces:
        dead = [name for name in namespace.dead if name not in drivers]
        if namespace.is_ours and dead:
            found = LEFT.found(
                f"namespace {namespace.name}",
                f"{', '.join(dead)}: {namespace.bytes_of_dead / _MIB:.1f} MiB of shared memory",
                files=plural(len(dead), "file"),
                are="are" if len(dead) > 1 else "is",
            )
            yield replace(found, commands=tuple(f"rm {namespace.path}/{name}.ring" for name in dead[:_MOST_COMMANDS]))


def _forgotten(others: list[NamespaceSeen]) -> Iterator[Finding]:
    forgotten = [one for one in others if one.dead and not one.living and one.idle_s > _FORGOTTEN_S]
    if forgotten:
        size = sum(one.bytes_of_dead for one in forgotten) / _MIB
        some = forgotten[:_MOST_COMMANDS]
        names = ", ".join(f"{one.name} (untouched for {age_text(one.idle_s * 1e9)})" for one in some)
        found = FORGOTTEN.found(
            names + (" ..." if len(forgotten) > len(some) else ""),
            f"{sum(len(one.dead) for one in forgotten)} services, none alive: {size:.1f} MiB of shared memory",
            namespaces=plural(len(forgotten), "namespace"),
            are="are" if len(forgotten) > 1 else "is",
        )
        yield replace(found, commands=tuple(f"skin-info --namespace {one.name}" for one in some))


def _recording(recording: RecordingSeen) -> Iterator[Note]:
    name = recording.name
    whole = "closed in good order" if recording.is_whole else "not closed in good order"
    services = f"; services {', '.join(recording.services)}" if recording.services else ""
    length = f"{recording.size / _MIB:.1f} MiB, {age_text(recording.duration_s * 1e9)}"
    yield Looked(name, f"{length}, {whole}{services}")
    if not recording.is_whole:
        why = "its index is missing: the recorder was killed, the disk was full, or the end of the file is lost"
        yield CUT.found(name, why, file=name)
    for problem in recording.problems:
        yield DAMAGED.found(name, problem, file=name)
    if recording.missed:
        yield MISSED.found(name, f"{plural(recording.missed, 'sample')} published meanwhile are not in it")
    for jump in recording.clock_sets:
        yield CLOCK_SET.found(f"{name} at {age_text(jump.time_s * 1e9)}", f"by {jump.by_s:+.2f} s")
    if recording.boots > 1:
        yield RESTARTS.found(name, f"{recording.boots} starts, and times of data count from each")
    if recording.events.get("unreadable"):
        yield NOT_RECORDED.found(name, f"{count_text(recording.events['unreadable'])} events of it")
