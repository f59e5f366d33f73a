"""Buses of drivers: faults, losses, load, and other senders on them."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.text import age_text, count_text, plural, words
from skinware_drivers.doctor.evidence import BusSeen, Change, Evidence
from skinware_drivers.doctor.finding import (
    Finding,
    Looked,
    Note,
    NotLooked,
    Rule,
    Severity,
    brief,
    loss_in_words,
    names_of_bus,
)
from skinware_drivers.doctor.machine import circumstances
from skinware_drivers.finding.running import same_bus
from skinware_drivers.running.news import FULL, HIGH_LOAD

_ERROR, _WARNING, _NOTE = Severity.ERROR, Severity.WARNING, Severity.NOTE
_PROBLEM, _MISSING = "troubleshooting.md#a-bus-has-a-problem", "troubleshooting.md#data-is-missing"
_COMES_AND_GOES = "troubleshooting.md#a-bus-comes-and-goes"
_FIND = ("skin-find {name}",)
_FLAPS = 4
"""Changes of state that are no accident."""
_AWAY = ("silent", "down", "gone")
_UNKNOWN_SHARE = 0.05
"""Share of frames with unknown identifiers that is worth a note."""

REASONS = {
    "interface-down": Rule(
        _WARNING,
        "its interface is down",
        "bring it up; a controller needs its bit rate first. The driver continues by itself",
        ("sudo ip link set {channel} type can bitrate 1000000", "sudo ip link set {channel} up"),
        _PROBLEM,
    ),
    "interface-gone": Rule(
        _WARNING,
        "its interface is gone: unplugged, or its kernel driver was unloaded",
        "plug it in, configure it and bring it up, under the same name",
        ("skin-find",),
        _PROBLEM,
    ),
    "refused": Rule(
        _WARNING, "the driver's account may not open it", "see who may and who has it open", _FIND, _PROBLEM
    ),
    "failed": Rule(
        _WARNING,
        "its adapter or port failed",
        "check cable and power, and other programs on the port",
        _FIND,
        _PROBLEM,
    ),
    "bus-off": Rule(
        _WARNING,
        "bus-off: its controller met too many errors while sending",
        "repair the wiring (short circuit, termination, bit rate), then let it restart by itself",
        (
            "sudo ip link set {channel} down",
            "sudo ip link set {channel} type can restart-ms 100",
            "sudo ip link set {channel} up",
        ),
        _PROBLEM,
    ),
    "nothing-heard": Rule(
        _WARNING,
        "nothing is heard on it",
        "check power and bit rate of the boards, and the cable; see what is on the wire",
        _FIND,
        _PROBLEM,
    ),
    "error-passive": Rule(
        _WARNING,
        "error-passive: many errors on the wire",
        "check termination (60 ohm, power off), bit rate, stubs, and that another node is on the wire",
        ("ip -details -statistics link show {channel}",),
        _PROBLEM,
    ),
    "error-warning": Rule(
        _WARNING,
        "error-warning: more errors on the wire than there should be",
        "check termination (60 ohm, power off), bit rate and stubs",
        ("ip -details -statistics link show {channel}",),
        _PROBLEM,
    ),
    "no-acknowledgement": Rule(
        _WARNING,
        "no node acknowledges the frames that are sent",
        "check power, cable and bit rate: no other node is awake on the wire",
        ("ip -details link show {channel}",),
        _PROBLEM,
    ),
    "bus-errors": Rule(
        _WARNING,
        "broken frames are heard on it",
        "check bit rate (or baud rate), sample point and termination",
        _FIND,
        _PROBLEM,
    ),
    "overflow": Rule(
        _WARNING,
        "its controller lost frames: the machine fetched them too late",
        "connect fewer devices to that USB hub, or relieve the processor that handles its interrupts",
        see=_PROBLEM,
    ),
    "set-aside": Rule(
        _WARNING, "the driver's own code failed on it", "send the driver's log to its author", see=_PROBLEM
    ),
}
"""By the reason that the driver gives. Errors while the bus is not live."""
STATES = {
    "silent": REASONS["nothing-heard"],
    "down": REASONS["interface-down"],
    "gone": REASONS["interface-gone"],
    "connecting": Rule(
        _WARNING, "it is not open yet", "wait; if that does not help, see who has it open", _FIND, _PROBLEM
    ),
}
"""By the state of the bus, if the driver gives no reason."""
CAME_BACK = Rule(
    _WARNING,
    "it was away, and came back",
    "check plug, cable and power",
    ("journalctl -k | tail",),
    _COMES_AND_GOES,
)
FLAPPING = Rule(
    _WARNING,
    "it comes and goes",
    "check plug, cable and power of the adapter",
    ("journalctl -k | tail",),
    _COMES_AND_GOES,
)
FULL_WIRE = Rule(
    _WARNING,
    "the wire is nearly full",
    "connect fewer boards to it, start the driver with a longer period, and see what else sends",
    _FIND,
    _MISSING,
)
FOREIGN = Rule(
    _NOTE,
    "other devices, or boards that are not configured, send on it",
    "harmless in itself; if a board is missing, see whose frames these are",
    _FIND,
    _MISSING,
)
SHARED = Rule(
    _WARNING,
    "two drivers are on one bus",
    "stop one of them, or start it so that it sends nothing",
    ("skin-driver --bus {name} --listen-only",),
    "troubleshooting.md#two-computers-or-two-programs-on-one-bus",
)
LOSSES = {
    "dropped": Rule(
        _ERROR,
        "frames were dropped before the driver took them",
        "enlarge the receive buffer, and start the driver with more processor time: --realtime fifo:50",
        ("sudo sysctl net.core.rmem_max=8388608",),
        _MISSING,
    ),
    "overflows": Rule(
        _ERROR,
        "its controller's own memory overflowed",
        "connect fewer devices to that USB hub, or relieve the processor that handles its interrupts",
        see=_MISSING,
        unit="overflow",
    ),
    "bus_offs": Rule(
        _ERROR,
        "its controller went bus-off",
        "repair the wiring; check termination and bit rate",
        see=_PROBLEM,
        unit="time",
    ),
    "errors": Rule(
        _WARNING,
        "frames were damaged on the wire",
        "check termination, bit rate (baud rate), cable and power",
        _FIND,
        _PROBLEM,
        unit="error",
    ),
    "checksum_errors": Rule(
        _WARNING, "frames had a wrong checksum", "check the cable and the baud rate", _FIND, _MISSING
    ),
    "bad_length": Rule(
        _WARNING,
        "frames had another length than the driver expects",
        "check the driver's options: other firmware, or another kind of board",
        ("skin-driver --help",),
        _MISSING,
    ),
    "bad_content": Rule(
        _WARNING,
        "frames had contents that the driver does not know",
        "check the driver's options: other firmware, or another kind of board",
        ("skin-info {driver}",),
        _MISSING,
    ),
    "refused": Rule(
        _WARNING,
        "the driver's layout has no place for some frames",
        "look for a foreign device, or one that was set to CAN FD",
        ("skin-dump --raw {name} -T 2",),
        _MISSING,
    ),
    "send_failures": Rule(
        _WARNING,
        "the interface did not take frames to send",
        "check that another node acknowledges; give the interface a longer queue",
        ("sudo ip link set {channel} txqueuelen 100",),
        _MISSING,
    ),
    "polls_missed": Rule(
        _WARNING,
        "devices could not be polled in time",
        "give the driver more processor time, or poll less often",
        see=_MISSING,
        unit="poll",
    ),
    "polls_unanswered": Rule(
        _WARNING, "devices did not answer", "check their power and cable", _FIND, _MISSING, unit="poll"
    ),
    "polls_late": Rule(
        _WARNING,
        "answers of devices came after their timeout",
        "the device works, but is slower than the driver expects: the driver's log says by how much its timeout_s is"
        " too short",
        see=_MISSING,
        unit="answer",
    ),
    "updates_skipped": Rule(
        _WARNING,
        "more updates came at once than the ring has slots",
        "start the driver with more slots (--slots 64) and more processor time (--realtime fifo:50)",
        see=_MISSING,
        unit="update",
    ),
    "before_boot": Rule(
        _WARNING,
        "frames were stamped before the machine was started",
        "the clock that stamps them was set: nothing, if it ends",
        see=_MISSING,
    ),
}
"""By counter of the bus. Notes once the loss is over."""
_OF_A_BUSY_MACHINE = ("dropped", "polls_missed", "updates_skipped")


def check(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        for bus in driver.buses:
            yield Looked(f"{driver.name}: {brief(bus.name)}", _as_seen(bus))
            where = f"driver {driver.name}, bus {brief(bus.name)}"
            names = {"driver": driver.name, **names_of_bus(bus.name)}
            if driver.life != "dead":
                yield from _state(bus, where, names, evidence)
                if bus.load is not None and bus.load > HIGH_LOAD:
                    waiting = f"load {100 * bus.load:.0f} %: frames with high identifiers wait, or never come"
                    yield FULL_WIRE.found(where, waiting, _ERROR if bus.load > FULL else None, **names)
            late = bus.counted.grown.get("polls_late", 0)
            for name, rule in LOSSES.items():
                if name == "polls_unanswered" and 0 < bus.counted.grown.get(name, 0) <= late:
                    continue  # the answers came after all: the devices are slow, not silent
                loss = loss_in_words(bus.counted, name, rule.unit, evidence)
                if loss is not None:
                    of = f" of {plural(bus.counted.grown.get('frames', 0), 'frame')}" if loss.is_going_on else ""
                    why = f"; {circumstances(evidence, driver)}" if name in _OF_A_BUSY_MACHINE else ""
                    severity = None if loss.is_going_on else _NOTE
                    yield rule.found(where, f"{loss.text}{of}{loss.hours}{why}", severity, **names)
            unknown, known = (bus.counted.grown.get(name, 0) for name in ("unknown", "frames"))
            if unknown and unknown > _UNKNOWN_SHARE * (unknown + known):
                samples = [one.removeprefix("unknown: ") for one in bus.samples if one.startswith("unknown: ")]
                such_as = f", such as {samples[0]}" if samples else ""
                yield FOREIGN.found(where, f"{plural(unknown, 'frame')} of unknown identifiers{such_as}", **names)
    if evidence.is_live:
        yield from _shared(evidence)
        unknown_loads = [brief(bus.name) for driver in evidence.drivers for bus in driver.buses if bus.load is None]
        if unknown_loads:
            why = "no bit rate is known (vcan, serial port, python-can), or filters leave frames out"
            yield NotLooked(f"load of {', '.join(unknown_loads)}", why)


def _as_seen(bus: BusSeen) -> str:
    parts = [bus.state, *([bus.reason] if bus.reason else [])]
    if bus.load is not None:
        parts.append(f"load {100 * bus.load:.0f} %")
    total = bus.counted.total
    parts.append(plural(total.get("frames", 0), "frame"))
    parts += [f"{words(name)} {count_text(total[name])}" for name in LOSSES if total.get(name)]
    return ", ".join(parts)


def _state(bus: BusSeen, where: str, names: dict[str, str], evidence: Evidence) -> Iterator[Finding]:
    is_away = bus.state != "live"
    rule = REASONS.get(bus.reason) or (STATES.get(bus.state) if is_away else None)
    if rule is not None:
        since = f" for {age_text(bus.since_s * 1e9)}" if bus.since_s else ""
        port = ""
        for one in evidence.ports:
            if same_bus(one.path, bus.name):
                rights = [] if one.may_open else [f"this account may not open {one.path} (group {one.group or 'none'})"]
                users = [f"{user.program} (pid {user.pid}) has it open" for user in one.users]
                port = f"; {'; '.join([*rights, *users]) or f'{one.path} is plugged in'}"
        severity = _ERROR if is_away else _WARNING
        yield rule.found(where, f"{_state_text(bus.state, bus.reason)}{since}{port}", severity, **names)
    if len(bus.changes) > _FLAPS:
        times = ", ".join(f"{one.state} at {one.time_s:.1f} s" for one in bus.changes[1:_FLAPS])
        span = age_text(evidence.seconds * 1e9)
        yield FLAPPING.found(where, f"{plural(len(bus.changes) - 1, 'change')} in {span}: {times} ...")
    elif not is_away and (absences := _absences(bus, evidence.seconds)):
        first, away_s = absences[0][0], sum(seconds for _, seconds in absences)
        state = _state_text(first.state, first.reason)
        yield CAME_BACK.found(where, f"{state} from {first.time_s:.1f} s on; {age_text(away_s * 1e9)} in all")


def _state_text(state: str, reason: str) -> str:
    return f"{state}, {reason}" if reason else state


def _absences(bus: BusSeen, end_s: float) -> list[tuple[Change, float]]:
    """Return when the bus went away, and for how many seconds; one that is silent at first has just been opened."""
    ends = [*(change.time_s for change in bus.changes[1:]), end_s]
    return [
        (change, end - change.time_s)
        for number, (change, end) in enumerate(zip(bus.changes, ends, strict=True))
        if change.state in _AWAY and (number or change.state != "silent")
    ]


def _shared(evidence: Evidence) -> Iterator[Finding]:
    """Find buses that two running drivers have, each pair of drivers once."""
    found: set[frozenset[tuple[str, str]]] = set()
    running = {(one.namespace, one.name) for one in evidence.running}
    for driver in evidence.drivers:
        own = (driver.namespace, driver.name)
        for bus in driver.buses if own in running else ():
            for other in evidence.running:
                pair = frozenset({own, (other.namespace, other.name)})
                if len(pair) < 2 or pair in found or other.bus_named(bus.name) is None:
                    continue
                found.add(pair)
                yield SHARED.found(
                    f"driver {driver.name}, bus {brief(bus.name)}",
                    f"{other} has it too; this one has sent {plural(bus.counted.total.get('sent', 0), 'frame')}",
                    **names_of_bus(bus.name),
                )
