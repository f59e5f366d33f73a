"""CAN interfaces and serial ports of this machine: whether they work, whether they may be used, and who has them."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.text import count_text, plural
from skinware_drivers.doctor.evidence import Evidence, InterfaceSeen
from skinware_drivers.doctor.finding import Finding, Looked, Note, NotLooked, Severity
from skinware_drivers.finding.interfaces import CanInterface
from skinware_drivers.finding.ports import SerialPort
from skinware_drivers.finding.running import RunningDriver, driver_on

AREA = "interfaces"
_PROBLEM, _MISSING = "troubleshooting.md#a-bus-has-a-problem", "troubleshooting.md#data-is-missing"
_DROPS = {
    "rx_dropped": ("the kernel dropped frames that it had received", "give the driver more processor time"),
    "rx_over_errors": (
        "the controller lost frames",
        "the machine fetches them too late: relieve its processor or USB hub",
    ),
    "tx_dropped": (
        "the kernel dropped frames to be sent",
        "check that another node acknowledges; a longer queue helps",
    ),
    "rx_errors": ("broken frames were received", "check termination, bit rate and stubs"),
    "tx_errors": ("frames could not be sent", "check termination, bit rate, and that another node is awake"),
    "controller_bus_error": ("the controller met errors on the wire", "check termination, bit rate and stubs"),
    "controller_bus_off": ("the controller went bus-off", "repair the wiring; check termination and bit rate"),
    "controller_error_passive": ("the controller became error-passive", "check termination, bit rate and stubs"),
}


def check(evidence: Evidence) -> Iterator[Note]:
    if not evidence.is_live:
        yield NotLooked(AREA, "interfaces", "a recording does not tell of them", ("skin-doctor",))
        return
    if not evidence.kernel_has_can:
        yield NotLooked(
            AREA, "CAN interfaces", "this kernel has no CAN, or it is not loaded", ("sudo modprobe can-raw",)
        )
    elif not evidence.interfaces:
        yield Looked(AREA, "CAN interfaces", "none is plugged in")
    for one in evidence.interfaces:
        yield Looked(AREA, one.interface.name, _as_seen(one))
        yield from _state(one.interface, evidence.running)
        yield from _drops(one, evidence)
    if not evidence.ports:
        yield Looked(AREA, "serial ports", "none is plugged in")
    for port in evidence.ports:
        yield Looked(AREA, port.path, _port_as_seen(port, evidence))
        yield from _port(port, evidence)


def _as_seen(seen: InterfaceSeen) -> str:
    one = seen.interface
    parts = ["up" if one.up else "down", one.kind]
    if one.bit_rate:
        parts.append(f"{one.bit_rate / 1000:g} kbit/s")
    elif one.kind == "can":
        parts.append("no bit rate known")
    parts += [one.state.lower()] if one.state else []
    parts += [f"restart-ms {one.restart_ms}"] if one.restart_ms is not None else []
    parts.append(f"queue {one.queue_length}")
    parts += [f"{name.replace('_', ' ')} {count_text(count)}" for name, count in seen.counted.total.items() if count]
    return ", ".join(parts)


def _state(one: CanInterface, running: tuple[RunningDriver, ...]) -> Iterator[Finding]:
    owner = driver_on(one.name, running)
    for advice in one.advice():
        why, _, commands = advice.partition(": sudo ")
        yield Finding(
            Severity.ERROR if owner is not None or one.state == "BUS-OFF" else Severity.NOTE,
            AREA,
            f"the interface is {why}" if why == "down" else why,
            one.name,
            f"{_facts(one)}{f'; {owner} uses it' if owner else '; no driver uses it'}",
            "bring it up" if why == "down" else "see what follows from it",
            tuple(f"sudo {command}" for command in commands.replace("; sudo ", ";").split(";")) if commands else (),
            _PROBLEM,
        )


def _facts(one: CanInterface) -> str:
    rate = f"{one.bit_rate / 1000:g} kbit/s" if one.bit_rate else "no bit rate"
    return ", ".join([one.carrier or "no state told", *([one.state.lower()] if one.state else []), rate])


def _drops(seen: InterfaceSeen, evidence: Evidence) -> Iterator[Finding]:
    name, grown = seen.interface.name, seen.counted.grown
    went = grown.get("rx_packets", 0) + grown.get("tx_packets", 0)
    for counter, (what, action) in _DROPS.items():
        count = grown.get(counter, 0)
        if count:
            yield Finding(
                Severity.WARNING,
                AREA,
                what,
                name,
                f"{counter.replace('_', ' ')} {count_text(count)} in {evidence.seconds:.1f} s, {plural(went, 'frame')}",
                action,
                (f"ip -details -statistics link show {name}",),
                _MISSING,
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
    parts += [f"{user.program} (pid {user.pid}) has it open" for user in port.users if owner is None]
    if not port.users and not port.users_known and owner is None:
        parts.append("whether a program of another user has it is not known")
    return ", ".join(parts)


def _port(port: SerialPort, evidence: Evidence) -> Iterator[Finding]:
    """Ports on USB only: built-in ones are there whether anything is plugged in or not."""
    if port.usb is None or driver_on(port.path, evidence.running) is not None:
        return
    if not port.may_open:
        why, _, commands = port.advice()[0].partition(": sudo ")
        command = commands.partition(",")[0]
        yield Finding(
            Severity.WARNING,
            AREA,
            "a serial port may not be opened by this account",
            port.path,
            f"{port.name}, group {port.group or 'none'}; {why}",
            "join its group and log in again" if port.group else "give it a group or uaccess by a udev rule",
            (f"sudo {command}",) if command else ("skin-find --udev",),
            "how-to/find-and-set-up.md#fixed-names-for-serial-ports",
        )
    for user in port.users:
        yield Finding(
            Severity.NOTE,
            AREA,
            "another program has a serial port open",
            port.path,
            f"{port.name}; {user.program}, pid {user.pid}",
            "a serial port has one owner: end that program to use it with a driver",
            (f"ps -p {user.pid} -o args",),
            _PROBLEM,
        )
