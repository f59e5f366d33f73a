"""The machine: CAN interfaces, serial ports, permissions, memory, processors, and packets that it dropped."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.text import count_text, plural, words
from skinware_drivers.doctor.evidence import Counted, Evidence
from skinware_drivers.doctor.rules import RULES, Finding, Looked, Note, NotLooked, Severity
from skinware_drivers.finding.interfaces import CanInterface
from skinware_drivers.finding.ports import SerialPort
from skinware_drivers.finding.running import RunningDriver, driver_on

_LEAST_FREE = 0.05
"""Share of memory or shared memory: with less, a driver that starts may find no room."""
_GIB = 1 << 30


def check_interfaces(evidence: Evidence) -> Iterator[Note]:
    if not evidence.is_live:
        yield NotLooked("interfaces", "a recording does not contain them", ("skin-doctor",))
        return
    if not evidence.kernel_has_can:
        why = "this kernel has no CAN, or it is not loaded"
        yield NotLooked("CAN interfaces", why, ("sudo modprobe can-raw",))
    elif not evidence.interfaces:
        yield Looked("CAN interfaces", "none is plugged in")
    for one, counted in evidence.interfaces:
        yield Looked(one.name, _interface_as_seen(one, counted))
        yield from _interface(one, evidence.running)
        grown = counted.grown
        went = grown.get("rx_packets", 0) + grown.get("tx_packets", 0)
        for counter, rule in RULES["drop"].items():
            if count := grown.get(counter, 0):
                in_words = f"{words(counter)} {count_text(count)} in {evidence.seconds:.1f} s, {plural(went, 'frame')}"
                yield rule.found(one.name, in_words, interface=one.name)
    if not evidence.ports:
        yield Looked("serial ports", "none is plugged in")
    for port in evidence.ports:
        yield Looked(port.path, _port_as_seen(port, evidence))
        if port.usb is not None and driver_on(port.path, evidence.running) is None:  # built-in ones are always there
            if not port.may_open:
                rule = RULES["port"]["of-group" if port.group else "without-group"]
                names = {} if port.in_group else {"group": port.group}
                yield rule.found(port.path, f"{port.name}, group {port.group or 'none'}; {port.advice()[0]}", **names)
            for user in port.users:
                seen = f"{port.name}; {user.program}, pid {user.pid}"
                yield RULES["port"]["taken"].found(port.path, seen, pid=user.pid)


def _interface_as_seen(one: CanInterface, counted: Counted) -> str:
    parts = ["up" if one.up else "down", one.kind]
    if one.bit_rate:
        parts.append(f"{one.bit_rate / 1000:g} kbit/s")
    elif one.kind == "can":
        parts.append("no bit rate known")
    parts += [one.state.lower()] if one.state else []
    parts += [f"restart-ms {one.restart_ms}"] if one.restart_ms is not None else []
    parts.append(f"queue {one.queue_length}")
    parts += [f"{words(name)} {count_text(count)}" for name, count in counted.total.items() if count]
    return ", ".join(parts)


def _interface(one: CanInterface, running: tuple[RunningDriver, ...]) -> Iterator[Finding]:
    owner = driver_on(one.name, running)
    rate = f"{one.bit_rate / 1000:g} kbit/s" if one.bit_rate else "no bit rate"
    facts = ", ".join([one.carrier or "unknown state", *([one.state.lower()] if one.state else []), rate])
    severity = Severity.ERROR if owner is not None or one.state == "BUS-OFF" else Severity.NOTE
    for advice in one.advice():
        why, _, commands = advice.partition(": sudo ")
        yield Finding(
            severity,
            f"the interface is {why}" if why == "down" else why,
            one.name,
            f"{facts}{f'; {owner} uses it' if owner else '; no driver uses it'}",
            "bring it up" if why == "down" else "repair the bus",
            tuple(f"sudo {command}" for command in commands.split("; sudo ")) if commands else (),
            "troubleshooting.md#a-bus-has-a-problem",
        )


def _port_as_seen(port: SerialPort, evidence: Evidence) -> str:
    parts = [port.name, *([f"kernel driver {port.driver}"] if port.driver else [])]
    parts.append("may be opened" if port.may_open else f"may not be opened (group {port.group or 'none'})")
    if port.usb is not None:
        parts.append(f"also {port.links[0]}" if port.links else "no fixed name (udev)")
    if port.latency_ms is not None:
        parts.append(f"latency timer {port.latency_ms} ms")
    owner = driver_on(port.path, evidence.running)
    if owner is not None:
        parts.append(f"{owner} runs on it")
    else:
        parts += [f"{user.program} (pid {user.pid}) has it open" for user in port.users]
        if not port.users and not port.users_known:
            parts.append("whether a program of another user has it open is unknown")
    return ", ".join(parts)


def check_permissions(evidence: Evidence) -> Iterator[Note]:
    if not evidence.is_live:
        yield NotLooked("permissions", "a recording does not contain them", ("skin-doctor",))
        return
    machine = evidence.machine
    yield Looked("/dev/shm", machine.shared_problem or "may be written")
    if machine.shared_problem:
        yield RULES["machine"]["cannot-publish"].found("/dev/shm", machine.shared_problem)
    if (one := evidence.files) is not None and one.problem:
        yield RULES["machine"]["namespace"].found(f"namespace {one.name}", one.problem, path=one.path)
    elif one is not None:
        yield Looked(f"namespace {one.name}", f"{one.path} may be read")
    priority = f"up to {machine.realtime_priority}" if machine.realtime_priority else "none"
    yield Looked("real-time priority", f"{priority} without further rights (skin-driver --realtime)")
    locked = machine.locked_memory_bytes
    yield Looked("locked memory", "unlimited" if locked < 0 else f"up to {locked // 1024} KiB")
    yield Looked("groups", ", ".join(machine.groups) or "none that has a name")


def check_machine(evidence: Evidence) -> Iterator[Note]:
    machine = evidence.machine
    if evidence.recording is not None:
        yield Looked("recorded by", evidence.recording.recorded_by or "unknown")
    versions = ", ".join(f"{name} {number}" for name, number in machine.versions.items())
    yield Looked("versions here", f"{versions}; {machine.kernel}")
    if not evidence.is_live:
        return
    governor = f", governor {', '.join(machine.governors)}" if machine.governors else ""
    yield Looked("processors", f"{machine.cpus}, load {machine.load:.1f}{governor}")
    if not machine.governors:
        yield NotLooked("CPU governor", "the kernel shows none (a virtual machine, a container)")
    for what, free, total in (
        ("memory", machine.memory_available_bytes, machine.memory_bytes),
        ("shared memory", machine.shared_free_bytes, machine.shared_bytes),
    ):
        if total:
            seen = f"{free / _GIB:.1f} of {total / _GIB:.1f} GiB free"
            yield Looked(what, seen)
            if free < _LEAST_FREE * total:
                yield RULES["machine"][what].found("this machine", seen)
    dropped, what = machine.softnet_dropped, "packets dropped before any socket"
    if dropped is None:
        yield NotLooked(what, "the kernel does not count them: no /proc/net/softnet_stat")
        return
    yield Looked(what, f"{dropped} in these {evidence.seconds:.0f} s")
    if dropped:
        backlog = machine.limits.get("net.core.netdev_max_backlog")
        seen = f"{plural(dropped, 'packet')}, CAN frames perhaps among them; net.core.netdev_max_backlog is {backlog}"
        yield RULES["machine"]["packets"].found("this machine", seen)
