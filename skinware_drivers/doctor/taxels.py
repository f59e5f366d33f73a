"""Taxels: what their hardware says of them, what their values show, and places that cannot be."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from skinware.tactile.calibration.checking import SHARED, UNKNOWN, check_file
from skinware.text import count_text, plural
from skinware_drivers.doctor.evidence import DriverSeen, Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, NotLooked, Severity, has_operation

AREA = "taxels"
_STATUS, _HEALTH, _CALIBRATION = "explanation/status.md", "tactile/health.md", "tactile/calibration.md"
_MOST_NAMES = 3
_MOST_LINES = 6


class _Meaning(NamedTuple):
    severity: Severity
    what: str
    action: str


_BY_STATUS = {
    "not_connected": _Meaning(
        Severity.ERROR,
        "are not connected",
        "plug their module in; if there is none, leave it out of the driver's options",
    ),
    "no_ack": _Meaning(
        Severity.ERROR, "do not answer the microcontroller", "check the flat cable and plug of their module"
    ),
    "out_of_range": _Meaning(
        Severity.NOTE,
        "are beyond the range",
        "a very hard press, or broken taxels: see whether it stays when nothing touches them",
    ),
    "suspect": _Meaning(
        Severity.WARNING,
        "are doubtful since an event, such as a baseline that moved by itself",
        "take their baseline again while nothing touches them",
    ),
    "unhealthy": _Meaning(Severity.WARNING, "are called unhealthy by skin-calm", "see why"),
}


def check(evidence: Evidence) -> Iterator[Note]:
    for driver in evidence.drivers:
        told = ", ".join(f"{count_text(n)} {name.replace('_', ' ')}" for name, n in driver.statuses.items() if n)
        untouched = f"; {_only_zero(len(driver.dark))}: {_dark_names(driver)}" if _is_idle(driver) else ""
        yield Looked(
            AREA,
            f"driver {driver.name}",
            f"{plural(driver.structure.n_sensors, 'sensor')}: {told or 'no data'}{untouched}",
        )
        yield from _statuses(driver)
        yield from _dark(driver)
        yield from _lines(driver)
        yield from _health(driver)
        yield from _places(driver)


def _statuses(driver: DriverSeen) -> Iterator[Finding]:
    for name, meaning in _BY_STATUS.items():
        count = driver.statuses.get(name, 0) - (sum(driver.dark.values()) if name == "suspect" else 0)
        if count <= 0:
            continue
        named = driver.affected.get(name, ())
        more = " ..." if count > len(named) else ""
        can_rebaseline = has_operation(driver.driver_type, "rebaseline")
        command = {
            "suspect": f"skin-config {driver.name} rebaseline" if can_rebaseline else f"skin-info {driver.name}",
            "unhealthy": f"skin-info {driver.name} --health",
        }.get(name, "skin-top")
        yield Finding(
            meaning.severity,
            AREA,
            f"{plural(count, 'sensor')} {meaning.what if count > 1 else _singular(meaning.what)}",
            f"driver {driver.name}",
            f"status {name.replace('_', ' ')}: {'; '.join(named)}{more}",
            meaning.action,
            (command,),
            _STATUS if name != "unhealthy" else _HEALTH,
        )


def _dark(driver: DriverSeen) -> Iterator[Finding]:
    if driver.dark and not _is_idle(driver):
        yield Finding(
            Severity.WARNING,
            AREA,
            _only_zero(len(driver.dark)),
            f"driver {driver.name}",
            _dark_names(driver),
            "touch each once: those that go on with 0 are dead or switched off; look at their cables and plugs",
            ("skin-top",),
            _STATUS,
        )


def _is_idle(driver: DriverSeen) -> bool:
    """Whether modules that sent nothing but 0 are good all the same: nothing may have touched them."""
    return bool(driver.dark) and not any(driver.dark.values())


def _only_zero(count: int) -> str:
    return f"{plural(count, 'module')} {'has' if count == 1 else 'have'} sent nothing but 0 so far"


def _dark_names(driver: DriverSeen) -> str:
    return f"{'; '.join(list(driver.dark)[:_MOST_LINES])}{' ...' if len(driver.dark) > _MOST_LINES else ''}"


def _lines(driver: DriverSeen) -> Iterator[Finding]:
    if driver.lines:
        yield Finding(
            Severity.ERROR,
            AREA,
            "a matrix tells nothing good in whole rows or columns",
            f"driver {driver.name}",
            f"{'; '.join(driver.lines[:_MOST_LINES])}{' ...' if len(driver.lines) > _MOST_LINES else ''}",
            "a broken wire or a loose plug rather than so many broken taxels: look at the cables of these lines",
            ("skin-top",),
            _STATUS,
        )


def _singular(what: str) -> str:
    for several, one in (("are ", "is "), ("do ", "does "), ("have ", "has ")):
        if what.startswith(several):
            return one + what.removeprefix(several)
    return what


def _health(driver: DriverSeen) -> Iterator[Note]:
    seen = driver.health
    if seen is None:
        yield NotLooked(AREA, f"health of {driver.name}", "no frame to judge by")
        return
    if seen.judged:
        yield Looked(AREA, f"health of {driver.name}", f"{plural(seen.judged, 'taxel')}, judged by {seen.source}")
    kinds = Counter(fault.kind for fault in seen.faults)
    for kind, count in kinds.items():
        some = [fault for fault in seen.faults if fault.kind == kind][:_MOST_NAMES]
        told = "; ".join(f"{fault.name}: {fault.evidence}" for fault in some)
        yield Finding(
            Severity.WARNING,
            AREA,
            f"{plural(count, 'taxel')} {'is' if count == 1 else 'are'} {kind}",
            f"driver {driver.name}",
            f"{told}{' ...' if count > len(some) else ''} (judged by {seen.source})",
            "touch them and see what they show; heed them no more if they are broken",
            (f"skin-wipe {driver.name}", f"skin-info {driver.name} --health"),
            _HEALTH,
        )
    for what, why in seen.missing.items():
        is_last = what == list(seen.missing)[-1]
        commands = (f"skin-calm {driver.name}", f"skin-wipe {driver.name}") if is_last else ()
        yield NotLooked(AREA, f"{what} of {driver.name}", why, commands)


def _places(driver: DriverSeen) -> Iterator[Note]:
    structure = driver.structure
    swapped = f"exchanged or mirrored modules of {driver.name}"
    by_strokes = tuple(
        f"skin-calibrate {command} --driver {driver.name}" for command in ("topology -o skin.toml", "check skin.toml")
    )
    if structure.geometry is None:
        yield NotLooked(AREA, swapped, "the driver publishes no places of its sensors", by_strokes)
        return
    counts: Counter[str] = Counter()
    modules: dict[str, set[str]] = {}
    for sensor_type in structure.types:
        index = structure.index(sensor_type.name)
        geometry = structure.geometry[index]
        if not geometry.known.any():
            continue  # temperatures, say, whose places nobody needs
        for finding in check_file(geometry, structure.module_of(sensor_type.name)):
            counts[finding.kind] += len(finding.taxels)
            modules.setdefault(finding.kind, set()).update(structure.module_names[row] for row in finding.modules)
    yield Looked(AREA, f"places of {driver.name}", f"{int(np.count_nonzero(structure.geometry.known))} known")
    for kind, what in ((SHARED, "are at places of others"), (UNKNOWN, "have no place")):
        if counts[kind]:
            names = sorted(modules[kind])
            yield Finding(
                Severity.WARNING if kind == SHARED else Severity.NOTE,
                AREA,
                f"{plural(counts[kind], 'sensor')} {what if counts[kind] > 1 else _singular(what)}",
                f"driver {driver.name}",
                f"modules {', '.join(names[:_MOST_NAMES])}{' ...' if len(names) > _MOST_NAMES else ''}",
                "correct the geometry, or measure it by touch",
                by_strokes,
                _CALIBRATION,
            )
    yield NotLooked(AREA, swapped, "only strokes over the skin tell", by_strokes)
