"""Buses of drivers: faults, losses, load, and other senders on them."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.text import age_text, count_text, plural, words
from skinware_drivers.doctor.evidence import BusSeen, Change, Evidence
from skinware_drivers.doctor.rules import (
    RULES,
    Finding,
    Looked,
    Note,
    NotLooked,
    Severity,
    brief,
    circumstances,
    loss_seen,
    names_of_bus,
)
from skinware_drivers.finding.running import same_bus
from skinware_drivers.running.news import FULL, HIGH_LOAD

_FLAPS = 4
"""Changes of state that are no accident."""
_AWAY = ("silent", "down", "gone")
_REASON_OF_STATE = {"silent": "nothing-heard", "down": "interface-down", "gone": "interface-gone"}
"""The usual reason of a state, if the driver gives none."""
_UNKNOWN_SHARE = 0.05
"""Share of frames with unknown identifiers that is worth a note."""
_OF_A_BUSY_MACHINE = ("dropped", "polls_missed", "updates_skipped")


def check(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        for bus in driver.buses:
            grown, total = bus.counted.grown, bus.counted.total
            reason = [bus.reason] if bus.reason else []
            load = [] if bus.load is None else [f"load {100 * bus.load:.0f} %"]
            losses = [f"{words(name)} {count_text(total[name])}" for name in RULES["bus-loss"] if total.get(name)]
            frames = plural(total.get("frames", 0), "frame")
            seen = ", ".join([bus.state, *reason, *load, frames, *losses])
            yield Looked(f"{driver.name}: {brief(bus.name)}", seen)
            where = f"driver {driver.name}, bus {brief(bus.name)}"
            names = {"driver": driver.name, **names_of_bus(bus.name)}
            if driver.life != "dead":
                yield from _state(bus, where, names, evidence)
                if bus.load is not None and bus.load > HIGH_LOAD:
                    waiting = f"load {100 * bus.load:.0f} %: frames with high identifiers wait, or never come"
                    severity = Severity.ERROR if bus.load > FULL else None
                    yield RULES["bus"]["full"].found(where, waiting, severity, **names)
            for name, rule in RULES["bus-loss"].items():
                if name == "polls_unanswered" and 0 < grown.get(name, 0) <= grown.get("polls_late", 0):
                    continue  # the answers came after all: the devices are slow, not silent
                of = f" of {plural(grown.get('frames', 0), 'frame')}" if grown.get(name) else ""
                loss = loss_seen(bus.counted, name, rule.unit, evidence, of)
                if loss is not None:
                    why = f"; {circumstances(evidence, driver)}" if name in _OF_A_BUSY_MACHINE else ""
                    yield rule.found(where, loss[1] + why, None if loss[0] else Severity.NOTE, **names)
            unknown, known = grown.get("unknown", 0), grown.get("frames", 0)
            if unknown and unknown > _UNKNOWN_SHARE * (unknown + known):
                samples = [one.removeprefix("unknown: ") for one in bus.samples if one.startswith("unknown: ")]
                such_as = f", such as {samples[0]}" if samples else ""
                foreign = f"{plural(unknown, 'frame')} of unknown identifiers{such_as}"
                yield RULES["bus"]["foreign"].found(where, foreign, **names)
    if evidence.is_live:
        yield from _shared(evidence)
        unknown_loads = [brief(bus.name) for driver in evidence.drivers for bus in driver.buses if bus.load is None]
        if unknown_loads:
            why = "no bit rate is known (vcan, serial port, python-can), or filters leave frames out"
            yield NotLooked(f"load of {', '.join(unknown_loads)}", why)


def _state(bus: BusSeen, where: str, names: dict[str, str], evidence: Evidence) -> Iterator[Finding]:
    is_away = bus.state != "live"
    rule = RULES["reason"].get(bus.reason)
    if rule is None and is_away:
        rule = RULES["reason"].get(_REASON_OF_STATE.get(bus.state, bus.state))
    if rule is not None:
        since = f" for {age_text(bus.since_s * 1e9)}" if bus.since_s else ""
        port = ""
        for one in evidence.ports:
            if same_bus(one.path, bus.name):
                rights = [] if one.may_open else [f"this account may not open {one.path} (group {one.group or 'none'})"]
                users = [f"{user.program} (pid {user.pid}) has it open" for user in one.users]
                port = f"; {'; '.join([*rights, *users]) or f'{one.path} is plugged in'}"
        severity = Severity.ERROR if is_away else Severity.WARNING
        yield rule.found(where, f"{_state_text(bus.state, bus.reason)}{since}{port}", severity, **names)
    if len(bus.changes) > _FLAPS:
        times = ", ".join(f"{one.state} at {one.time_s:.1f} s" for one in bus.changes[1:_FLAPS])
        span = age_text(evidence.seconds * 1e9)
        seen = f"{plural(len(bus.changes) - 1, 'change')} in {span}: {times} ..."
        yield RULES["bus"]["flapping"].found(where, seen)
    elif not is_away and (absences := _absences(bus, evidence.seconds)):
        first, away_s = absences[0][0], sum(seconds for _, seconds in absences)
        state = _state_text(first.state, first.reason)
        seen = f"{state} from {first.time_s:.1f} s on; {age_text(away_s * 1e9)} in all"
        yield RULES["bus"]["came-back"].found(where, seen)


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
                yield RULES["bus"]["shared"].found(
                    f"driver {driver.name}, bus {brief(bus.name)}",
                    f"{other} has it too; this one has sent {plural(bus.counted.total.get('sent', 0), 'frame')}",
                    **names_of_bus(bus.name),
                )
