"""The machine: CAN interfaces, serial ports, permissions, memory, processors, and packets that it dropped."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.text import count_text, plural, words
from skinware_drivers.doctor.evidence import DriverSeen, Evidence, InterfaceSeen
from skinware_drivers.doctor.finding import Finding, Looked, Note, NotLooked, Rule, Severity
from skinware_drivers.finding.interfaces import CanInterface
from skinware_drivers.finding.ports import SerialPort
from skinware_drivers.finding.running import RunningDriver, driver_on

_PROBLEM, _MISSING = "troubleshooting.md#a-bus-has-a-problem", "troubleshooting.md#data-is-missing"
_SERVICES = "how-to/services-and-permissions.md"
_LEAST_FREE = 0.05
"""Share of memory or shared memory: with less, a driver that starts may find no room."""
_SLOW_GOVERNORS = ("powersave", "conservative", "userspace")
_GIB = 1 << 30

_FIXED_NAMES = "how-to/find-and-set-up.md#fixed-names-for-serial-ports"
PORT_OF_GROUP = Rule(
    Severity.WARNING,
    "a serial port may not be opened by this account",
    "join its group, then log out and in again",
    ("sudo usermod -aG {group} $USER",),
    _FIXED_NAMES,
)
PORT_WITHOUT_GROUP = Rule(
    Severity.WARNING,
    "a serial port may not be opened by this account",
    "give it a group or uaccess by a udev rule",
    ("skin-find --udev",),
    _FIXED_NAMES,
)
PORT_TAKEN = Rule(
    Severity.NOTE,
    "another program has a serial port open",
    "a serial port has one owner: end that program to use it with a driver",
    ("ps -p {pid} -o args",),
    _PROBLEM,
)


def _drop(what: str, action: str) -> Rule:
    return Rule(Severity.WARNING, what, action, ("ip -details -statistics link show {interface}",), _MISSING)


DROPS = {
    "rx_dropped": _drop("the kernel dropped frames that it had received", "give the driver more processor time"),
    "rx_over_errors": _drop(
        "the controller lost frames", "the machine fetches them too late: relieve its processor or USB hub"
    ),
    "tx_dropped": _drop(
        "the kernel dropped frames to be sent", "check that another node acknowledges; a longer queue helps"
    ),
    "rx_errors": _drop("broken frames were received", "check termination, bit rate and stubs"),
    "tx_errors": _drop("frames could not be sent", "check termination, bit rate, and that another node is awake"),
    "controller_bus_error": _drop("the controller met errors on the wire", "check termination, bit rate and stubs"),
    "controller_bus_off": _drop("the controller went bus-off", "repair the wiring; check termination and bit rate"),
    "controller_error_passive": _drop("the controller became error-passive", "check termination, bit rate and stubs"),
}
"""By counter of the kernel or the controller."""
CANNOT_PUBLISH = Rule(
    Severity.ERROR,
    "no driver can publish here",
    "a container needs it: docker run --shm-size 256m, or mount it",
    ("ls -ld /dev/shm", "findmnt /dev/shm"),
    _SERVICES,
)
NAMESPACE = Rule(
    Severity.ERROR, "the namespace cannot be read", "do what the message says", ("ls -ld {path}",), _SERVICES
)
_END = "end what is not needed; a driver that starts may find no room"
MEMORY = Rule(Severity.WARNING, "memory is nearly full", _END, ("free -h",))
SHARED_MEMORY = Rule(Severity.WARNING, "shared memory is nearly full", _END, ("du -sh /dev/shm/skinware.*",))
PACKETS = Rule(
    Severity.WARNING,
    "network packets were dropped before any socket received them",
    "give them more room",
    ("sudo sysctl net.core.netdev_max_backlog=10000",),
    _MISSING,
)


def circumstances(evidence: Evidence, driver: DriverSeen) -> str:
    """Return in words what may keep a driver from its work on this machine, also if it is harmless."""
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


# -- interfaces -----------------------------------------------------------------------------------------------------


def check_interfaces(evidence: Evidence) -> Iterator[Note]:
    if not evidence.is_live:
        yield NotLooked("interfaces", "a recording does not contain them", ("skin-doctor",))
        return
    if not evidence.kernel_has_can:
        why = "this kernel has no CAN, or it is not loaded"
        yield NotLooked("CAN interfaces", why, ("sudo modprobe can-raw",))
    elif not evidence.interfaces:
        yield Looked("CAN interfaces", "none is plugged in")
    for one in evidence.interfaces:
        yield Looked(one.interface.name, _interface_as_seen(one))
        yield from _interface(one.interface, evidence.running)
        grown = one.counted.grown
        went = grown.get("rx_packets", 0) + grown.get("tx_packets", 0)
        for counter, rule in DROPS.items():
            if count := grown.get(counter, 0):
                in_words = f"{words(counter)} {count_text(count)} in {evidence.seconds:.1f} s, {plural(went, 'frame')}"
                yield rule.found(one.interface.name, in_words, interface=one.interface.name)
    if not evidence.ports:
        yield Looked("serial ports", "none is plugged in")
    for port in evidence.ports:
        yield Looked(port.path, _port_as_seen(port, evidence))
        if port.usb is not None and driver_on(port.path, evidence.running) is None:  # built-in ones are always there
            yield from _port(port)


def _interface_as_seen(seen: InterfaceSeen) -> str:
    one = seen.interface
    parts = ["up" if one.up else "down", one.kind]
    if one.bit_rate:
        parts.append(f"{one.bit_rate / 1000:g} kbit/s")
    elif one.kind == "can":
        parts.append("no bit rate known")
    parts += [one.state.lower()] if one.state else []
    parts += [f"restart-ms {one.restart_ms}"] if one.restart_ms is not None else []
    parts.append(f"queue {one.queue_length}")
    parts += [f"{words(name)} {count_text(count)}" for name, count in seen.counted.total.items() if count]
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
            _PROBLEM,
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


def _port(port: SerialPort) -> Iterator[Finding]:
    if not port.may_open:
        rule = PORT_OF_GROUP if port.group else PORT_WITHOUT_GROUP
        names = {} if port.in_group else {"group": port.group}
        yield rule.found(port.path, f"{port.name}, group {port.group or 'none'}; {port.advice()[0]}", **names)
    for user in port.users:
        yield PORT_TAKEN.found(port.path, f"{port.name}; {user.program}, pid {user.pid}", pid=user.pid)


# -- permissions ----------------------------------------------------------------------------------------------------


def check_permissions(evidence: Evidence) -> Iterator[Note]:
    if not evidence.is_live:
        yield NotLooked("permissions", "a recording does not contain them", ("skin-doctor",))
        return
    machine = evidence.machine
    yield Looked("/dev/shm", machine.shared_problem or "may be written")
    if machine.shared_problem:
        yield CANNOT_PUBLISH.found("/dev/shm", machine.shared_problem)
    for one in evidence.namespaces:
        if one.is_ours and one.problem:
            yield NAMESPACE.found(f"namespace {one.name}", one.problem, path=one.path)
        elif one.is_ours:
            yield Looked(f"namespace {one.name}", f"{one.path} may be read")
        elif one.problem:
            yield NotLooked(f"namespace {one.name}", one.problem)
    priority = f"up to {machine.realtime_priority}" if machine.realtime_priority else "none"
    yield Looked("real-time priority", f"{priority} without further rights (skin-driver --realtime)")
    locked = machine.locked_memory_bytes
    yield Looked("locked memory", "unlimited" if locked < 0 else f"up to {locked // 1024} KiB")
    yield Looked("groups", ", ".join(machine.groups) or "none that has a name")


# -- processors, memory, packets ------------------------------------------------------------------------------------


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
    for what, free, total, rule in (
        ("memory", machine.memory_available_bytes, machine.memory_bytes, MEMORY),
        ("shared memory", machine.shared_free_bytes, machine.shared_bytes, SHARED_MEMORY),
    ):
        if total:
            seen = f"{free / _GIB:.1f} of {total / _GIB:.1f} GiB free"
            yield Looked(what, seen)
            if free < _LEAST_FREE * total:
                yield rule.found("this machine", seen)
    yield from _packets(evidence)


def _packets(evidence: Evidence) -> Iterator[Note]:
    dropped, what = evidence.machine.softnet_dropped, "packets dropped before any socket"
    if dropped is None:
        yield NotLooked(what, "the kernel does not count them: no /proc/net/softnet_stat")
        return
    yield Looked(what, f"{dropped} in these {evidence.seconds:.0f} s")
    if dropped:
        backlog = evidence.machine.limits.get("net.core.netdev_max_backlog")
        seen = f"{plural(dropped, 'packet')}, CAN frames perhaps among them; net.core.netdev_max_backlog is {backlog}"
        yield PACKETS.found("this machine", seen)
