"""Write what skin-top lists: a row for each driver, bus and patch, and the same as plain lines and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from skinware.state import DEAD, LIVE, SILENT, STARTING, DriverReport
from skinware.structure import Structure
from skinware.text import NO_VALUE, age_text, count_text, counters_text, plural, rate_text, state_shown, words

COLUMNS = ("driver, bus, patch", "state", "rate", "age", "fresh", "dropped", "orphans", "other counters")
"""Titles of the cells of a row."""

_NOT_AMONG_OTHERS = ("dropped", "orphans", "bytes_in", "frame_bytes", "idle_bytes")
"""Counters with a column of their own, and counters that grow while all is well: the chosen row shows them."""

DRIVER, BUS, PATCH = "driver", "bus", "patch"


class RowKey(NamedTuple):
    """The driver, bus or patch of a row; it stays the same when drivers come and go."""

    driver: str
    kind: str
    """``driver``, ``bus`` or ``patch``."""
    number: int
    """Index of the bus or patch in its driver; 0 for the driver itself."""


class ListRow(NamedTuple):
    key: RowKey
    cells: tuple[str, ...]
    """One text for each column."""
    state: str
    """Name of the state, which gives the row its colour."""
    counters: dict[str, int]
    """Every counter that the driver publishes for this row, by name."""


def rows_of(report: DriverReport) -> list[ListRow]:
    """Return the row of a driver, then those of its buses, each followed by its patches."""
    name, counters = report.name, report.counters
    state = report.life if report.age_ns is None else state_shown(report.life, report.fresh, report.sensors)
    cells = (
        name,
        state,
        rate_text(report.rate_hz),
        age_text(report.age_ns),
        f"{report.fresh}/{report.sensors}",
        count_text(counters.get("dropped")),
        count_text(counters.get("orphans")),
        "",
    )
    rows = [ListRow(RowKey(name, DRIVER, 0), cells, state, counters)]
    for at, bus in enumerate(report.buses):
        state, dropped = report.last(bus.state), count_text(bus.counters.get("dropped"))
        reason = "" if bus.reason is None else bus.reason.replace("_", "-")
        others = f"{reason}  {counters_text(bus.counters, besides=_NOT_AMONG_OTHERS)}".strip()
        rows.append(
            ListRow(
                RowKey(name, BUS, at), (f"  {bus.name}", state, "", "", "", dropped, "", others), state, bus.counters
            )
        )
        for number, patch in enumerate(report.patches):
            if patch.bus != at:
                continue
            state = state_shown(report.last(patch.state), patch.fresh, patch.sensors)
            cells = (
                f"    {patch.name}",
                state,
                "" if patch.rate_hz is None else rate_text(patch.rate_hz),
                age_text(patch.age_ns),
                f"{patch.fresh}/{patch.sensors}",
                "",
                count_text(patch.counters.get("orphans")),
                counters_text(patch.counters, besides=_NOT_AMONG_OTHERS),
            )
            rows.append(ListRow(RowKey(name, PATCH, number), cells, state, patch.counters))
    return rows


def patches_of(key: RowKey, structure: Structure) -> list[int]:
    """Return the patches of a row: its own, those of its bus, or all of its driver."""
    if key.kind == PATCH:
        return [key.number] if key.number < structure.n_patches else []
    if key.kind == BUS:
        found: list[int] = np.flatnonzero(structure.patch_bus == key.number).tolist()
        return found
    return list(range(structure.n_patches))


def title_of(key: RowKey, structure: Structure, patches: list[int], type_name: str, sensors: int) -> str:
    """Return the title of a picture.

    Args:
        structure: of its driver now, which may have changed since the list was made.
        patches: that :func:`patches_of` returned.
    """
    if not patches:
        return "no patches here"
    drawn = plural(sensors, f"{type_name} sensor")
    if key.kind == PATCH:
        kinds = structure.module_kind[structure.module_patch == key.number]
        kind = kinds[0].decode() if len(kinds) and (kinds == kinds[0]).all() else ""
        modules = plural(len(kinds), kind if kind.isalpha() else "module")
        return f"{structure.patch_names[key.number]}: {modules}, {drawn}"
    name = structure.buses[key.number] if key.kind == BUS else key.driver
    return f"{name}: {plural(len(patches), 'patch', 'patches')}, {drawn}"


def plain_line(report: DriverReport) -> str:
    if report.life == STARTING:
        return f"{report.name}  starting, no frame yet  sensors {report.sensors}"
    life = {
        LIVE: "? Hz" if report.rate_hz is None else rate_text(report.rate_hz),
        DEAD: "DEAD, this is its last frame",
        SILENT: "SILENT, its process publishes nothing",
    }.get(report.life, report.life)
    statuses = [
        f"{words(name)} {count}" for name, count in report.statuses.items() if count or name in ("fresh", "stale")
    ]
    patches = ", ".join(f"{count} {state}" for state, count in report.patch_states.items()) or NO_VALUE
    counters = report.counters
    losses = [f"{name} {counters[name]}" for name in ("dropped", "orphans") if name in counters]
    age = f"age {age_text(report.age_ns)}"
    sensors = f"sensors {report.sensors} ({', '.join(statuses)})"
    return "  ".join([report.name, life, age, sensors, f"patches {patches}", *losses])


def as_data(report: DriverReport, contacts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        "driver": report.name,
        "state": report.life,
        "rate_hz": None if report.rate_hz is None else round(report.rate_hz, 3),
        "age_ms": None if report.age_ns is None else round(report.age_ns / 1e6, 3),
        "sensors": report.sensors,
        "status": report.statuses,
        "patches": report.patch_states,
        "counters": report.counters,
        "contacts": list(contacts),
    }
