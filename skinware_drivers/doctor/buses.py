"""Buses of drivers: why one is not in order, what was lost on it, how full it is, and who else sends on it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from skinware.text import age_text, count_text, plural
from skinware_drivers.doctor.evidence import BusSeen, Change, DriverSeen, Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, NotLooked, Severity, brief, lost_text, typed
from skinware_drivers.doctor.machine import circumstances
from skinware_drivers.finding.ports import SerialPort
from skinware_drivers.finding.running import same_bus
from skinware_drivers.running.news import FULL, HIGH_LOAD

AREA = "buses"
_PROBLEM, _MISSING = "troubleshooting.md#a-bus-has-a-problem", "troubleshooting.md#data-is-missing"
_TWO = "troubleshooting.md#two-computers-or-two-programs-on-one-bus"
_FLAPS = 4
"""Changes of state that are no accident."""
_AWAY = ("silent", "down", "gone")
_UNKNOWN_SHARE = 0.05
"""Of a bus' frames that no patch of the driver sends."""


class _Advice(NamedTuple):
    what: str
    action: str
    commands: tuple[str, ...] = ()


_BY_REASON = {
    "interface-down": _Advice(
        "its interface is down",
        "bring it up; a controller needs its bit rate first. The driver continues by itself",
        ("sudo ip link set {channel} type can bitrate 1000000", "sudo ip link set {channel} up"),
    ),
    "interface-gone": _Advice(
        "its interface is gone: unplugged, or its kernel driver was unloaded",
        "plug it in, configure it and bring it up, under the same name",
        ("skin-find",),
    ),
    "refused": _Advice(
        "the driver's account may not open it", "see who may and who has it open", ("skin-find {name}",)
    ),
    "failed": _Advice(
        "its adapter or port failed", "check cable and power, and other programs on the port", ("skin-find {name}",)
    ),
    "bus-off": _Advice(
        "bus-off: its controller met too many errors in sending",
        "repair the wiring (short circuit, termination, bit rate), then let it restart by itself",
        (
            "sudo ip link set {channel} down",
            "sudo ip link set {channel} type can restart-ms 100",
            "sudo ip link set {channel} up",
        ),
    ),
    "nothing-heard": _Advice(
        "nothing is heard on it",
        "check power and bit rate of the boards, and the cable; see what is on the wire",
        ("skin-find {name}",),
    ),
    "error-passive": _Advice(
        "error-passive: many errors on the wire",
        "check termination (60 ohm, power off), bit rate, stubs, and that another node is on the wire",
        ("ip -details -statistics link show {channel}",),
    ),
    "error-warning": _Advice(
        "error-warning: more errors on the wire than there should be",
        "check termination (60 ohm, power off), bit rate and stubs",
        ("ip -details -statistics link show {channel}",),
    ),
    "no-acknowledgement": _Advice(
        "no node acknowledges what is sent",
        "check power, cable and bit rate: no other node is awake on the wire",
        ("ip -details link show {channel}",),
    ),
    "bus-errors": _Advice(
        "broken frames are heard on it",
        "check bit rate (or baud rate), sample point and termination",
        ("skin-find {name}",),
    ),
    "overflow": _Advice(
        "its controller lost frames: the machine fetched them too late",
        "connect fewer devices to that USB hub, or relieve the processor that handles its interrupts",
    ),
    "set-aside": _Advice("the driver's own code failed on it", "send the driver's log to its author"),
}
_BY_STATE = {
    "silent": _BY_REASON["nothing-heard"],
    "down": _BY_REASON["interface-down"],
    "gone": _BY_REASON["interface-gone"],
    "connecting": _Advice("it is not open yet", "wait; if it stays so, see who has it", ("skin-find {name}",)),
}


class _Loss(NamedTuple):
    severity: Severity
    what: str
    action: str
    commands: tuple[str, ...] = ()
    unit: str = "frame"


_LOSSES = {
    "lost": _Loss(
        Severity.ERROR,
        "frames were dropped before the driver took them",
        "enlarge the receive buffer, and start the driver with more processor time: --realtime fifo:50",
        ("sudo sysctl net.core.rmem_max=8388608",),
    ),
    "overflows": _Loss(
        Severity.ERROR,
        "its controller's own memory overflowed",
        "connect fewer devices to that USB hub, or relieve the processor that handles its interrupts",
        unit="overflow",
    ),
    "bus_offs": _Loss(
        Severity.ERROR, "its controller went bus-off", "repair the wiring; check termination and bit rate", unit="time"
    ),
    "errors": _Loss(
        Severity.WARNING,
        "frames were damaged on the wire",
        "check termination, bit rate (baud rate), cable and power",
        ("skin-find {name}",),
        unit="error",
    ),
    "checksum_errors": _Loss(
        Severity.WARNING, "frames had a wrong checksum", "check the cable and the baud rate", ("skin-find {name}",)
    ),
    "bad_length": _Loss(
        Severity.WARNING,
        "frames had another length than the driver expects",
        "check the driver's options: other firmware, or another kind of board",
        ("skin-driver --help",),
    ),
    "bad_content": _Loss(
        Severity.WARNING,
        "frames had contents that the driver does not know",
        "check the driver's options: other firmware, or another kind of board",
        ("skin-info {driver}",),
    ),
    "refused": _Loss(
        Severity.WARNING,
        "frames came that the driver's layout has no place for",
        "look for a foreign device, or one that was set to CAN FD",
        ("skin-dump --raw {name} -T 2",),
    ),
    "send_failures": _Loss(
        Severity.WARNING,
        "the interface did not take frames to send",
        "check that another node acknowledges; give the interface a longer queue",
        ("sudo ip link set {channel} txqueuelen 100",),
    ),
    "polls_missed": _Loss(
        Severity.WARNING,
        "devices could not be asked in time",
        "give the driver more processor time, or ask more seldom",
        unit="poll",
    ),
    "polls_unanswered": _Loss(
        Severity.WARNING, "devices did not answer", "check their power and cable", ("skin-find {name}",), unit="poll"
    ),
    "polls_late": _Loss(
        Severity.WARNING,
        "answers of devices came after their timeout",
        "the device lives, but is slower than the driver expects: the driver's log says by how much its timeout_s is"
        " too short",
        unit="answer",
    ),
    "updates_skipped": _Loss(
        Severity.WARNING,
        "more updates came at once than the ring has slots",
        "start the driver with more slots (--slots 64) and more processor time (--realtime fifo:50)",
        unit="update",
    ),
    "before_boot": _Loss(
        Severity.WARNING,
        "frames were stamped before the machine was started",
        "the clock that stamps them was set: nothing, if it ends",
    ),
}


def check(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        for bus in driver.buses:
            yield Looked(AREA, f"{driver.name}: {brief(bus.name)}", _as_seen(bus))
            if driver.life != "dead":
                yield from _state(bus, driver, evidence)
                yield from _load(bus, driver)
            yield from _losses(bus, driver, evidence)
            yield from _foreign(bus, driver)
    if evidence.is_live:
        yield from _shared(evidence)
        unknown = [bus.name for driver in evidence.drivers for bus in driver.buses if bus.load is None]
        if unknown:
            why = "no bit rate is known (vcan, serial port, python-can), or filters leave frames out"
            yield NotLooked(AREA, f"load of {', '.join(map(brief, unknown))}", why)


def _as_seen(bus: BusSeen) -> str:
    parts = [bus.state, *([bus.reason] if bus.reason else [])]
    if bus.load is not None:
        parts.append(f"load {100 * bus.load:.0f} %")
    total = bus.counted.total
    parts.append(plural(total.get("frames", 0), "frame"))
    parts += [f"{name.replace('_', ' ')} {count_text(total[name])}" for name in _LOSSES if total.get(name)]
    return ", ".join(parts)


def _state(bus: BusSeen, driver: DriverSeen, evidence: Evidence) -> Iterator[Finding]:
    where = f"driver {driver.name}, bus {brief(bus.name)}"
    is_away = bus.state != "live"
    advice = _BY_REASON.get(bus.reason) or (_BY_STATE.get(bus.state) if is_away else None)
    if advice is not None:
        since = f" for {age_text(bus.since_s * 1e9)}" if bus.since_s else ""
        told = f"{bus.state}{', ' + bus.reason if bus.reason else ''}{since}"
        port = _port(bus.name, evidence)
        yield Finding(
            Severity.ERROR if is_away else Severity.WARNING,
            AREA,
            advice.what,
            where,
            f"{told}{'; ' + _port_text(port) if port else ''}",
            advice.action,
            typed(advice.commands, bus.name, driver.name),
            _PROBLEM,
        )
    away_s = _away_s(bus, evidence.seconds)
    if not is_away and away_s and len(bus.changes) <= _FLAPS:
        one = _absences(bus)[0]
        yield Finding(
            Severity.WARNING,
            AREA,
            "it was away, and came back",
            where,
            f"{one.state}{', ' + one.reason if one.reason else ''} from {one.time_s:.1f} s on; {_span(away_s)} in all",
            "check plug, cable and power",
            typed(("journalctl -k | tail",), bus.name, driver.name),
            "troubleshooting.md#a-bus-comes-and-goes",
        )
    if len(bus.changes) > _FLAPS:
        told = ", ".join(f"{one.state} at {one.time_s:.1f} s" for one in bus.changes[1:_FLAPS])
        yield Finding(
            Severity.WARNING,
            AREA,
            "it comes and goes",
            where,
            f"{plural(len(bus.changes) - 1, 'change')} in {_span(evidence.seconds)}: {told} ...",
            "check plug, cable and power of the adapter",
            ("journalctl -k | tail",),
            "troubleshooting.md#a-bus-comes-and-goes",
        )


def _away_s(bus: BusSeen, end_s: float) -> float:
    ends = [*(change.time_s for change in bus.changes[1:]), end_s]
    return sum(end - one.time_s for one, end in zip(bus.changes, ends, strict=True) if one in _absences(bus))


def _absences(bus: BusSeen) -> list[Change]:
    """When it went; a bus that is silent at first has only just been opened."""
    return [one for one in bus.changes if one.state in _AWAY and not (one is bus.changes[0] and one.state == "silent")]


def _load(bus: BusSeen, driver: DriverSeen) -> Iterator[Finding]:
    if bus.load is None or bus.load <= HIGH_LOAD:
        return
    yield Finding(
        Severity.ERROR if bus.load > FULL else Severity.WARNING,
        AREA,
        "the wire is nearly full",
        f"driver {driver.name}, bus {brief(bus.name)}",
        f"load {100 * bus.load:.0f} %: frames with high identifiers wait, or never come",
        "connect fewer boards to it, start the driver with a longer period, and see what else sends",
        typed(("skin-find {name}",), bus.name),
        _MISSING,
    )


def _losses(bus: BusSeen, driver: DriverSeen, evidence: Evidence) -> Iterator[Finding]:
    for name, loss in _LOSSES.items():
        told = lost_text(bus.counted, name, loss.unit, evidence)
        if told is None:
            continue
        of = f" of {plural(bus.counted.grown.get('frames', 0), 'frame')}" if told.is_going_on else ""
        why = f"; {circumstances(evidence, driver)}" if name in ("lost", "polls_missed", "updates_skipped") else ""
        yield Finding(
            loss.severity if told.is_going_on else Severity.NOTE,
            AREA,
            loss.what,
            f"driver {driver.name}, bus {brief(bus.name)}",
            f"{told.text}{of}{told.hours}{why}",
            loss.action,
            typed(loss.commands, bus.name, driver.name),
            _MISSING if name not in ("bus_offs", "errors") else _PROBLEM,
        )


def _foreign(bus: BusSeen, driver: DriverSeen) -> Iterator[Finding]:
    grown = bus.counted.grown
    unknown, known = grown.get("unknown", 0), grown.get("frames", 0)
    if not unknown or unknown <= _UNKNOWN_SHARE * (unknown + known):
        return
    samples = [one.removeprefix("unknown: ") for one in bus.samples if one.startswith("unknown: ")]
    yield Finding(
        Severity.NOTE,
        AREA,
        "other devices, or boards that are not configured, send on it",
        f"driver {driver.name}, bus {brief(bus.name)}",
        f"{plural(unknown, 'frame')} of unknown identifiers{', such as ' + samples[0] if samples else ''}",
        "harmless in itself; if a board is missing, see whose frames these are",
        typed(("skin-find {name}",), bus.name),
        _MISSING,
    )


def _shared(evidence: Evidence) -> Iterator[Finding]:
    told: set[frozenset[tuple[str, str]]] = set()
    have_buses = {(one.namespace, one.name) for one in evidence.running}
    for driver in [one for one in evidence.drivers if (one.namespace, one.name) in have_buses]:
        for bus in driver.buses:
            for other in evidence.running:
                both = frozenset({(driver.namespace, driver.name), (other.namespace, other.name)})
                if len(both) < 2 or both in told or not any(same_bus(bus.name, own) for own in other.buses):
                    continue
                told.add(both)
                yield Finding(
                    Severity.WARNING,
                    AREA,
                    "two drivers are on one bus",
                    f"driver {driver.name}, bus {brief(bus.name)}",
                    f"{other} has it too; this one has sent {plural(bus.counted.total.get('sent', 0), 'frame')}",
                    "stop one of them, or start it so that it sends nothing",
                    typed(("skin-driver --bus {name} --listen-only",), bus.name),
                    _TWO,
                )


def _port(bus_name: str, evidence: Evidence) -> SerialPort | None:
    return next((port for port in evidence.ports if same_bus(port.path, bus_name)), None)


def _port_text(port: SerialPort) -> str:
    parts = [] if port.may_open else [f"this account may not open {port.path} (group {port.group or 'none'})"]
    parts += [f"{user.program} (pid {user.pid}) has it open" for user in port.users]
    return "; ".join(parts) or f"{port.path} is there"


def _span(seconds: float) -> str:
    return age_text(seconds * 1e9)
