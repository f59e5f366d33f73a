"""Taxels: their status, their health, and places that cannot be right."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from skinware.tactile.calibration.checking import check_file
from skinware.text import count_text, plural, words
from skinware_drivers.doctor.evidence import DriverSeen, Evidence
from skinware_drivers.doctor.finding import Looked, Note, NotLooked
from skinware_drivers.doctor.rules import RULES, has_operation

_MOST_NAMES = 3
_MOST_LINES = 6
_STROKES = (
    "skin-calibrate topology -o skin.toml --driver {driver}",
    "skin-calibrate check skin.toml --driver {driver}",
)


def check(evidence: Evidence) -> Iterator[Note]:
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
    by_strokes = tuple(command.format(driver=driver.name) for command in _STROKES)
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
