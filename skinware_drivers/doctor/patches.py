"""Patches and their taxels: silence, losses, shared addresses; status, health, and places that cannot be right."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from statistics import median

import numpy as np

from skinware.tactile.calibration.checking import check_file
from skinware.text import age_text, count_text, plural, words
from skinware_drivers.doctor.evidence import DriverSeen, Evidence, PatchSeen
from skinware_drivers.doctor.rules import (
    RULES,
    Finding,
    Looked,
    Note,
    NotLooked,
    Severity,
    brief,
    has_operation,
    loss_seen,
    names_of_bus,
)

_TWICE = 1.6
"""Ratio to the updates of other patches: two boards have one address, or one has another period."""
_NOT_USED = ("unknown", "bad_length", "bad_content", "before_boot")
"""Counters of frames that belong to no update."""
_PAST_SHARE = 1e-3
"""Share of the updates: smaller losses before the look are not worth a note."""
_BROKEN_SHARE = 0.2
"""Least ratio of frames without partners to updates, if two boards send at the same time."""
_ENOUGH_UPDATES = 20
"""Updates of a module from which its rate can be judged."""
_MOST_PATCHES = 5
_FLAPS = 4


def check_patches(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        if not driver.patches:
            continue
        states = [patch.state for patch in driver.patches]
        by_state = ", ".join(f"{count_text(states.count(state))} {state}" for state in sorted(set(states)))
        updates = sum(patch.counted.grown.get("updates", 0) for patch in driver.patches)
        lost = sum(patch.counted.grown.get(name, 0) for patch in driver.patches for name in RULES["patch-loss"])
        counts = f"{plural(updates, 'update')}, {lost} lost or late"
        yield Looked(f"driver {driver.name}", f"{plural(len(states), 'patch', 'patches')}: {by_state}; {counts}")
        for patch in driver.patches:
            if driver.life not in ("dead", "closed") or not evidence.is_live:
                yield from _state(driver, patch)
            times = [one.time_s for one in patch.changes[1:] if one.state in ("stale", "restarted")]
            if times and patch.state == "live":
                shown = ", ".join(f"{time_s:.1f} s" for time_s in times[:_FLAPS])
                more = " ..." if len(times) > _FLAPS else ""
                span = age_text(evidence.seconds * 1e9)
                seen = f"{plural(len(times), 'time')} in {span}: at {shown}{more}"
                yield RULES["patch"]["came-back"].found(_where(driver, patch), seen, **_names(driver, patch))
        yield from _losses(driver, evidence)
        yield from _two_boards(driver, evidence)


def _where(driver: DriverSeen, patch: PatchSeen) -> str:
    return f"driver {driver.name}, bus {brief(patch.bus)}, {patch.name}"


def _names(driver: DriverSeen, patch: PatchSeen) -> dict[str, str]:
    """Return the names for commands: to ask the boards for their versions if the driver can, else to look."""
    if has_operation(driver.driver_type, "versions"):
        return {"patch": patch.name, "configured": driver.name}
    return {"patch": patch.name, "driver": driver.name, **names_of_bus(patch.bus)}


def _state(driver: DriverSeen, patch: PatchSeen) -> Iterator[Finding]:
    where, names = _where(driver, patch), _names(driver, patch)
    others = f"{sum(one.state == 'live' for one in driver.patches)} of {len(driver.patches)} patches are live"
    if patch.age_ns is None or patch.state == "expected":
        seen = f"state {patch.state}, no data of its {plural(patch.sensors, 'sensor')}; {others}"
        yield RULES["patch"]["never-answered"].found(where, seen, **names)
    elif patch.state == "stale":
        yield RULES["patch"]["silent"].found(where, f"newest data {age_text(patch.age_ns)} old; {others}", **names)
    elif patch.state == "restarted":
        yield RULES["patch"]["restarted"].found(where, f"state restarted; {others}", **names)
    elif not patch.fresh and patch.sensors and driver.life == "live":
        seen = f"state live, newest data {age_text(patch.age_ns)} old, 0 of {count_text(patch.sensors)} fresh"
        yield RULES["patch"]["not-fresh"].found(where, seen, patch=patch.name, driver=driver.name)


def _losses(driver: DriverSeen, evidence: Evidence) -> Iterator[Finding]:
    for name, rule in RULES["patch-loss"].items():
        losses = []
        for patch in driver.patches:
            grown, total = patch.counted.grown, patch.counted.total
            beside = f" beside {plural(grown['updates'], 'update')}" if grown.get("updates") else ""
            loss = loss_seen(patch.counted, name, rule.unit, evidence, beside)
            # cycles are always cut when a driver begins to listen
            is_much = total.get(name, 0) > max(patch.modules, _PAST_SHARE * total.get("updates", 0))
            if loss is not None and (loss[0] or is_much):
                losses.append((*loss, patch))
        if not losses:
            continue
        losses.sort(key=lambda one: (one[0], one[2].counted.grown.get(name, 0)), reverse=True)
        shown = [f"{patch.name}: {text}" for _, text, patch in losses[:_MOST_PATCHES]]
        is_going_on, _, worst = losses[0]
        yield rule.found(
            f"driver {driver.name}, {plural(len(losses), 'patch', 'patches')}",
            "; ".join(shown) + (" ..." if len(losses) > len(shown) else ""),
            None if is_going_on else Severity.NOTE,
            driver=driver.name,
            **names_of_bus(worst.bus),
        )


def _two_boards(driver: DriverSeen, evidence: Evidence) -> Iterator[Note]:
    """Find patches that send far more than the others, or than their period allows."""
    enough = {name: count for name, count in _sent(driver).items() if count >= _ENOUGH_UPDATES}
    if not enough:
        if evidence.is_live and driver.life == "live":
            yield NotLooked(
                f"addresses that two boards share ({driver.name})",
                f"too few updates in {evidence.seconds:.1f} s",
                (f"skin-doctor -T {max(10.0, 2 * evidence.seconds):.0f}",),
            )
        return
    of_period = evidence.seconds * 1e9 / driver.timing.period_ns if driver.timing.period_ns else 0.0
    if len(enough) > 2:
        usual = median(enough.values())
    else:  # a driver that was held up reads more than one period's updates from all of them
        usual = max(of_period, min(enough.values()) if len(enough) > 1 else 0.0)
    for patch in driver.patches:
        count = enough.get(patch.name, 0.0)
        grown = patch.counted.grown
        is_broken = grown.get("orphans", 0) > _BROKEN_SHARE * grown.get("updates", 0)
        short_ns, long_ns = (patch.interval.quantile_ns(fraction) or 0 for fraction in (0.3, 0.9))
        # a patch that only has a shorter period has whole updates at even intervals
        if usual and count > _TWICE * usual and (is_broken or long_ns > 2 * short_ns + 1):
            span = age_text(evidence.seconds * 1e9)
            names = names_of_bus(patch.bus) | {"patch": patch.name, "times": f"{count / usual:.1f}"}
            if has_operation(driver.driver_type, "set_address"):
                names["only"] = f"patch={patch.name}"
            seen = f"data of {count:.0f} updates of a module in {span}, {usual:.0f} are due"
            yield RULES["patch"]["two-boards"].found(_where(driver, patch), seen, **names)


def _sent(driver: DriverSeen) -> dict[str, float]:
    """Return the updates of a module that each patch has sent frames for, whether they were completed or not.

    Two boards that send at the same time under one address make about one whole update in each period; all other
    frames have no partners.
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


_MOST_NAMES = 3
_MOST_LINES = 6


def check_taxels(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        where = f"driver {driver.name}"
        statuses = ", ".join(f"{count_text(n)} {words(name)}" for name, n in driver.statuses.items() if n)
        dark = f"{plural(len(driver.dark), 'module')} {_verbs(len(driver.dark))['have']} sent nothing but 0 so far"
        # without suspect sensors, such modules may be good: perhaps nothing has touched them
        untouched = f"; {dark}: {_some(list(driver.dark))}" if driver.dark and not any(driver.dark.values()) else ""
        sensors = plural(driver.structure.n_sensors, "sensor")
        yield Looked(where, f"{sensors}: {statuses or 'no data'}{untouched}")
        can_rebaseline = has_operation(driver.driver_type, "rebaseline")
        names = {"driver": driver.name, "rebaselined" if can_rebaseline else "shown": driver.name}
        for status, rule in RULES["status"].items():
            count = driver.statuses.get(status, 0) - (sum(driver.dark.values()) if status == "suspect" else 0)
            if count > 0:
                some = driver.affected.get(status, ())
                seen = f"status {words(status)}: {'; '.join(some)}{' ...' if count > len(some) else ''}"
                yield rule.found(where, seen, sensors=plural(count, "sensor"), **_verbs(count), **names)
        if any(driver.dark.values()):
            yield RULES["taxel"]["dark"].found(where, _some(list(driver.dark)), modules=dark)
        if driver.lines:
            yield RULES["taxel"]["lines"].found(where, _some(driver.lines))
        yield from _health(driver)
        yield from _places(driver)


def _verbs(count: int) -> dict[str, str]:
    """Return the verbs of a sentence about so many things."""
    return {"are": "is", "do": "does", "have": "has"} if count == 1 else {"are": "are", "do": "do", "have": "have"}


def _some(names: Sequence[str]) -> str:
    return "; ".join(names[:_MOST_LINES]) + (" ..." if len(names) > _MOST_LINES else "")


def _health(driver: DriverSeen) -> Iterator[Note]:
    seen = driver.health
    if seen is None:
        yield NotLooked(f"health of {driver.name}", "no snapshot to judge by")
        return
    if seen.judged:
        yield Looked(f"health of {driver.name}", f"{plural(seen.judged, 'taxel')}, judged by {seen.source}")
    for kind, count in Counter(fault.kind for fault in seen.faults).items():
        some = [fault for fault in seen.faults if fault.kind == kind][:_MOST_NAMES]
        shown = "; ".join(f"{fault.name}: {fault.evidence}" for fault in some)
        yield RULES["taxel"]["faulty"].found(
            f"driver {driver.name}",
            f"{shown}{' ...' if count > len(some) else ''} (judged by {seen.source})",
            taxels=plural(count, "taxel"),
            kind=kind,
            driver=driver.name,
            **_verbs(count),
        )
    for what, why in seen.missing.items():
        is_last = what == list(seen.missing)[-1]
        commands = (f"skin-calm {driver.name}", f"skin-wipe {driver.name}") if is_last else ()
        yield NotLooked(f"{what} of {driver.name}", why, commands)


def _places(driver: DriverSeen) -> Iterator[Note]:
    structure = driver.structure
    swapped = f"exchanged or mirrored modules of {driver.name}"
    by_strokes = RULES["place"]["unknown"].advised(driver=driver.name)
    if structure.geometry is None:
        yield NotLooked(swapped, "the driver publishes no places of its sensors", by_strokes)
        return
    counts: Counter[str] = Counter()
    modules: dict[str, set[str]] = {}
    for sensor_type in structure.types:
        geometry = structure.geometry[structure.index(sensor_type.name)]
        if not geometry.known.any():
            continue  # such as temperatures, whose places are not needed
        for problem in check_file(geometry, structure.module_of(sensor_type.name)):
            counts[problem.kind] += len(problem.taxels)
            modules.setdefault(problem.kind, set()).update(structure.module_names[row] for row in problem.modules)
    yield Looked(f"places of {driver.name}", f"{int(np.count_nonzero(structure.geometry.known))} known")
    for kind, rule in RULES["place"].items():
        if counts[kind]:
            names = sorted(modules[kind])
            seen = f"modules {', '.join(names[:_MOST_NAMES])}{' ...' if len(names) > _MOST_NAMES else ''}"
            count = plural(counts[kind], "sensor")
            yield rule.found(f"driver {driver.name}", seen, driver=driver.name, sensors=count, **_verbs(counts[kind]))
    yield NotLooked(swapped, "only strokes over the skin can show them", by_strokes)
