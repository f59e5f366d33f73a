"""The machine and what is installed on it: versions, compiled code, memory, processors, packets that it dropped."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.text import plural
from skinware_drivers.doctor.evidence import DriverSeen, Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, NotLooked, Severity

AREA = "machine"
_LEAST_FREE = 0.05
"""Of shared memory or memory: with less a driver that starts may find no room."""
_SLOW_GOVERNORS = ("powersave", "conservative", "userspace")
_GIB = 1 << 30


def check(evidence: Evidence) -> Iterator[Note]:
    machine = evidence.machine
    versions = ", ".join(f"{name} {number}" for name, number in machine.versions.items())
    if evidence.recording is not None:
        yield Looked(AREA, "recorded by", evidence.recording.recorded_by or "the file does not tell")
    yield Looked(AREA, "versions here", f"{versions}; {machine.kernel}")
    if evidence.is_live:
        yield from _processors(evidence)
        yield from _memory(evidence)
        yield from _packets(evidence)


def circumstances(evidence: Evidence, driver: DriverSeen) -> str:
    """What on this machine may keep a driver from its work, in words; figures even where they are harmless."""
    if not evidence.is_live:
        return "nothing is known of the machine that recorded"
    machine = evidence.machine
    parts = [f"machine load {machine.load:.1f} on {plural(machine.cpus, 'processor')}"]
    if driver.scheduling:
        parts.append(f"the driver has {driver.scheduling}")
    slow = [name for name in machine.governors if name in _SLOW_GOVERNORS]
    if slow:
        parts.append(f"CPU governor {', '.join(slow)}")
    return ", ".join(parts)


def _processors(evidence: Evidence) -> Iterator[Note]:
    machine = evidence.machine
    governor = f", governor {', '.join(machine.governors)}" if machine.governors else ""
    yield Looked(AREA, "processors", f"{machine.cpus}, load {machine.load:.1f}{governor}")
    if not machine.governors:
        yield NotLooked(
            AREA, "CPU governor", "this machine has none, or does not tell (a virtual machine, a container)"
        )


def _memory(evidence: Evidence) -> Iterator[Note]:
    machine = evidence.machine
    for what, free, total, remedy in (
        ("memory", machine.memory_available_bytes, machine.memory_bytes, ("free -h",)),
        ("shared memory", machine.shared_free_bytes, machine.shared_bytes, ("du -sh /dev/shm/skinware.*",)),
    ):
        if not total:
            continue
        told = f"{free / _GIB:.1f} of {total / _GIB:.1f} GiB free"
        yield Looked(AREA, what, told)
        if free < _LEAST_FREE * total:
            yield Finding(
                Severity.WARNING,
                AREA,
                f"{what} is nearly full",
                "this machine",
                told,
                "end what is not needed; a driver that starts may find no room",
                remedy,
            )


def _packets(evidence: Evidence) -> Iterator[Note]:
    dropped = evidence.machine.softnet_dropped
    if dropped is None:
        yield NotLooked(
            AREA, "packets dropped before any socket", "the kernel does not tell: no /proc/net/softnet_stat"
        )
        return
    yield Looked(AREA, "packets dropped before any socket", f"{dropped} in these {evidence.seconds:.0f} s")
    if dropped:
        backlog = evidence.machine.limits.get("net.core.netdev_max_backlog")
        yield Finding(
            Severity.WARNING,
            AREA,
            "network packets were dropped before any socket saw them",
            "this machine",
            f"{plural(dropped, 'packet')}, CAN frames perhaps among them; net.core.netdev_max_backlog is {backlog}",
            "give them more room",
            ("sudo sysctl net.core.netdev_max_backlog=10000",),
            "troubleshooting.md#data-is-missing",
        )
