"""Patches: which never answered, which fell silent, what each lost, and addresses that two of them share."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from statistics import median
from typing import NamedTuple

from skinware.text import age_text, count_text, plural
from skinware_drivers.doctor.evidence import DriverSeen, Evidence, PatchSeen
from skinware_drivers.doctor.finding import (
    Finding,
    Looked,
    Note,
    NotLooked,
    Severity,
    brief,
    has_operation,
    lost_text,
    typed,
)

AREA = "patches"
_FAULTS, _MISSING = "reference/faults.md#patches", "troubleshooting.md#data-is-missing"
_TWICE = 1.6
"""Times as many updates as the other patches have: two boards have one address, or one has another period."""
_NOT_USED = ("unknown", "bad_length", "bad_content", "before_boot")
"""Counters of frames that are of no update."""
_PAST_SHARE = 1e-3
"""Of the updates: what was lost before somebody looked, and is worth a word."""
_BROKEN_SHARE = 0.2
"""Frames without partners beside updates, that two boards make at least when they send at once."""
_ENOUGH_UPDATES = 20
"""Of a module, to tell how often it comes."""
_MOST_PATCHES = 5
_FLAPS = 4
"""Changes of state that are no accident."""


class _Loss(NamedTuple):
    unit: str
    what: str


_LOSSES = {
    "orphans": _Loss("frame", "frames came without their partners, whose update was not shown"),
    "late": _Loss("cycle", "frames of a cycle came too far apart, or out of rhythm"),
    "sequence_lost": _Loss("frame", "numbers are missing in its sequence"),
    "sequence_repeated": _Loss("frame", "numbers came twice in its sequence"),
    "sequence_back": _Loss("time", "numbers went back in its sequence"),
}


def check(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        if not driver.patches:
            continue
        yield Looked(AREA, f"driver {driver.name}", _as_seen(driver))
        if driver.life not in ("dead", "closed") or not evidence.is_live:
            yield from _states(driver)
        yield from _flapping(driver, evidence)
        yield from _losses(driver, evidence)
        yield from _twice(driver, evidence)


def _as_seen(driver: DriverSeen) -> str:
    states = [patch.state for patch in driver.patches]
    by_state = ", ".join(f"{count_text(states.count(state))} {state}" for state in sorted(set(states)))
    updates = sum(patch.counted.grown.get("updates", 0) for patch in driver.patches)
    lost = sum(patch.counted.grown.get(name, 0) for patch in driver.patches for name in _LOSSES)
    return f"{plural(len(states), 'patch', 'patches')}: {by_state}; {plural(updates, 'update')}, {lost} lost or late"


def _states(driver: DriverSeen) -> Iterator[Finding]:
    live = [patch.name for patch in driver.patches if patch.state == "live"]
    others = f"{len(live)} of {len(driver.patches)} patches are live"
    for patch in driver.patches:
        where = f"driver {driver.name}, bus {brief(patch.bus)}, {patch.name}"
        if patch.age_ns is None or patch.state == "expected":
            yield Finding(
                Severity.ERROR,
                AREA,
                f"{patch.name} never answered",
                where,
                f"state {patch.state}, no data of its {plural(patch.sensors, 'sensor')}; {others}",
                "check its power, cable and address, and that the driver's options name the right boards",
                _asking(driver, patch),
                _FAULTS,
            )
        elif patch.state == "stale":
            yield Finding(
                Severity.ERROR,
                AREA,
                f"{patch.name} fell silent",
                where,
                f"newest data {age_text(patch.age_ns)} old; {others}",
                "check its power and cable; the driver keeps asking it, and configures it when it answers",
                _asking(driver, patch),
                _FAULTS,
            )
        elif patch.state == "restarted":
            yield Finding(
                Severity.WARNING,
                AREA,
                f"{patch.name} lost its power and is being configured",
                where,
                f"state restarted; {others}",
                "if it happens again: check its power",
                _asking(driver, patch),
                _FAULTS,
            )
        elif not patch.fresh and patch.sensors and driver.life == "live":
            yield Finding(
                Severity.ERROR,
                AREA,
                f"no sensor of {patch.name} is fresh",
                where,
                f"state live, newest data {age_text(patch.age_ns)} old, 0 of {count_text(patch.sensors)} fresh",
                "see the status of its sensors",
                (f"skin-info {driver.name}",),
                "explanation/status.md",
            )


def _asking(driver: DriverSeen, patch: PatchSeen) -> tuple[str, ...]:
    if has_operation(driver.driver_type, "versions"):
        return (f"skin-config {driver.name} versions",)
    return typed(("skin-info {driver}", "skin-find {name}"), patch.bus, driver.name)


def _flapping(driver: DriverSeen, evidence: Evidence) -> Iterator[Finding]:
    for patch in driver.patches:
        silent = [one.time_s for one in patch.changes[1:] if one.state in ("stale", "restarted")]
        is_over = patch.state == "live"
        if silent and is_over:
            times = ", ".join(f"{time_s:.1f} s" for time_s in silent[:_FLAPS]) + (
                " ..." if len(silent) > _FLAPS else ""
            )
            yield Finding(
                Severity.WARNING,
                AREA,
                f"{patch.name} fell silent and came back",
                f"driver {driver.name}, bus {brief(patch.bus)}, {patch.name}",
                f"{plural(len(silent), 'time')} in {age_text(evidence.seconds * 1e9)}: at {times}",
                "check its plug and power",
                _asking(driver, patch),
                _FAULTS,
            )


def _losses(driver: DriverSeen, evidence: Evidence) -> Iterator[Finding]:
    for name, loss in _LOSSES.items():
        told = [
            (one.is_going_on, patch.counted.grown.get(name, 0), patch, one)
            for patch in driver.patches
            if (one := lost_text(patch.counted, name, loss.unit, evidence)) is not None
            and (one.is_going_on or _matters(patch, name))
        ]
        if not told:
            continue
        told.sort(key=lambda one: one[:2], reverse=True)
        is_going_on, _, worst, _ = told[0]
        shown = [
            f"{patch.name}: {one.text}{_of_updates(patch)}{one.hours}" for _, _, patch, one in told[:_MOST_PATCHES]
        ]
        yield Finding(
            Severity.WARNING if is_going_on else Severity.NOTE,
            AREA,
            loss.what,
            f"driver {driver.name}, {plural(len(told), 'patch', 'patches')}",
            "; ".join(shown) + (" ..." if len(told) > len(shown) else ""),
            "see whether its bus loses frames, is full or is damaged: cable, termination, load",
            typed(("skin-info {driver}", "skin-find {name}"), worst.bus, driver.name),
            _MISSING,
        )


def _matters(patch: PatchSeen, name: str) -> bool:
    """Whether a loss that is over is worth a word: of what is on its way when a driver begins, a part is lost."""
    total = patch.counted.total
    return total.get(name, 0) > max(patch.modules, _PAST_SHARE * total.get("updates", 0))


def _of_updates(patch: PatchSeen) -> str:
    updates = patch.counted.grown.get("updates", 0)
    return f" beside {plural(updates, 'update')}" if updates else ""


def _twice(driver: DriverSeen, evidence: Evidence) -> Iterator[Note]:
    """Patches that send far more than the others, or than their period allows."""
    enough = {name: count for name, count in _sent(driver).items() if count >= _ENOUGH_UPDATES}
    if not enough:
        if evidence.is_live and driver.life == "live":
            yield NotLooked(
                AREA,
                f"addresses that two boards share ({driver.name})",
                f"too few updates in {evidence.seconds:.1f} s to tell",
                (f"skin-doctor --seconds {max(10.0, 2 * evidence.seconds):.0f}",),
            )
        return
    of_period = evidence.seconds * 1e9 / driver.timing.period_ns if driver.timing.period_ns else None
    if len(enough) > 2:
        usual = median(enough.values())
    else:  # after it was held up, a driver gets more than its period's from all
        usual = max(of_period or 0.0, min(enough.values()) if len(enough) > 1 else 0.0)
    for patch in driver.patches:
        count, only = enough.get(patch.name, 0.0), shlex.quote(f"patch={patch.name}")
        can_set = has_operation(driver.driver_type, "set_address")
        set_address = (f"skin-config {{name}} set_address address=9 {only}",) if can_set else ()
        if usual and count > _TWICE * usual and _collides(patch):
            yield Finding(
                Severity.ERROR,
                AREA,
                f"{patch.name} sends {count / usual:.1f} times as much as it should: two boards with one address?",
                f"driver {driver.name}, bus {brief(patch.bus)}, {patch.name}",
                f"data of {count:.0f} updates of a module in {age_text(evidence.seconds * 1e9)}, {usual:.0f} are due",
                "unplug one board and see whether the address still sends; then end the driver, and give that board"
                " another address",
                typed(("skin-find {name}", *set_address), patch.bus),
                "how-to/find-and-set-up.md#configure-boards",
            )


def _collides(patch: PatchSeen) -> bool:
    """Whether its frames come as those of two boards do: they break each other's updates, or come in uneven turns.

    A patch that only has a shorter period than others does neither.
    """
    grown = patch.counted.grown
    short_ns, long_ns = (patch.interval.quantile_ns(fraction) or 0 for fraction in (0.3, 0.9))
    return grown.get("orphans", 0) > _BROKEN_SHARE * grown.get("updates", 0) or long_ns > 2 * short_ns + 1


def _sent(driver: DriverSeen) -> dict[str, float]:
    """Updates of a module that each patch has sent frames for, whether they could be put together or not.

    Of two boards that send at once under one address, a driver puts about one whole update together for each period;
    all other frames have no partners.
    """
    found = {}
    for bus in driver.buses:
        patches = [patch for patch in driver.patches if patch.bus == bus.name and patch.modules]
        grown = [patch.counted.grown for patch in patches]
        updates, orphans = (sum(counts.get(name, 0) for counts in grown) for name in ("updates", "orphans"))
        used = bus.counted.grown.get("frames", 0) - sum(bus.counted.grown.get(name, 0) for name in _NOT_USED)
        frames_of_one = max(1, round((used - orphans) / updates)) if updates else 1
        for patch, counts in zip(patches, grown, strict=True):
            whole = counts.get("updates", 0) + counts.get("orphans", 0) / frames_of_one
            found[patch.name] = whole / patch.modules
    return found
