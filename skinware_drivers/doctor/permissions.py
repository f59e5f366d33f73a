"""What this account may do: the namespace in /dev/shm, real-time scheduling, locked memory, groups."""

from __future__ import annotations

from collections.abc import Iterator

from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, NotLooked, Severity

AREA = "permissions"
_SERVICES, _REALTIME = "how-to/services-and-permissions.md", "how-to/realtime.md"


def check(evidence: Evidence) -> Iterator[Note]:
    if not evidence.is_live:
        yield NotLooked(AREA, "permissions", "a recording does not tell of them", ("skin-doctor",))
        return
    machine = evidence.machine
    yield Looked(AREA, "/dev/shm", machine.shared_problem or "may be written")
    if machine.shared_problem:
        yield Finding(
            Severity.ERROR,
            AREA,
            "no driver can publish here",
            "/dev/shm",
            machine.shared_problem,
            "a container needs it: docker run --shm-size 256m, or mount it",
            ("ls -ld /dev/shm", "findmnt /dev/shm"),
            _SERVICES,
        )
    for one in evidence.namespaces:
        if one.is_ours and one.problem:
            yield Finding(
                Severity.ERROR,
                AREA,
                "the namespace cannot be read",
                f"namespace {one.name}",
                one.problem,
                "as the message says",
                (f"ls -ld {one.path}",),
                _SERVICES,
            )
        elif one.is_ours:
            yield Looked(AREA, f"namespace {one.name}", f"{one.path} may be read")
        elif one.problem:
            yield NotLooked(AREA, f"namespace {one.name}", one.problem)
    priority = f"up to {machine.realtime_priority}" if machine.realtime_priority else "none"
    yield Looked(AREA, "real-time priority", f"{priority} without further rights (skin-driver --realtime)")
    locked = machine.locked_memory_bytes
    yield Looked(AREA, "locked memory", "unlimited" if locked < 0 else f"up to {locked // 1024} KiB")
    yield Looked(AREA, "groups", ", ".join(machine.groups) or "none that has a name")
