"""The list of ``skin-top``: a row per driver, bus and patch, and the same as plain lines and JSON. Pure functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.state import (
    DEAD,
    LIVE,
    SILENT,
    STARTING,
    WITHOUT_NEWS,
    SkinHealth,
    bus_reason_name,
    bus_state_name,
    patch_ages_ns,
    patch_state_name,
    rate_now_hz,
    status_now,
)
from skinware.structure import Structure
from skinware.text import NO_VALUE, age_text, count_text, plural, rate_text, state_shown

COLUMNS = ("driver, bus, patch", "state", "rate", "age", "fresh", "lost", "orphans", "other counters")
"""Titles of the cells of a row."""

_NOT_AMONG_OTHERS = ("lost", "orphans", "bytes_in", "frame_bytes", "idle_bytes")
"""Counters that have columns of their own, and those that grow while all is well: the chosen row shows them."""

DRIVER, BUS, PATCH = "driver", "bus", "patch"


class RowKey(NamedTuple):
    """What a row is about; the same thing keeps its key when drivers come and go."""

    driver: str
    kind: str
    """``driver``, ``bus`` or ``patch``."""
    number: int
    """Which bus or patch of the driver; 0 for the driver itself."""


class Row(NamedTuple):
    """One row of the list."""

    key: RowKey
    cells: tuple[str, ...]
    """One text per column."""
    state: str
    """The state's name, which gives the row its colour."""
    counters: dict[str, int]
    """Every counter that the driver publishes for this row, by name."""


def rows_of(
    reader: DriverReader,
    frame: DriverSnapshot | None,
    health: SkinHealth,
    patch_rates_hz: Sequence[float | None] = (),
) -> list[Row]:
    """The driver, then each of its buses with its patches below it.

    Args:
        reader: of the driver.
        frame: its newest.
        health: the driver in a few figures.
        patch_rates_hz: updates per second of each patch, where they are known.
    """
    name, n_fresh = health.name, health.statuses.get("fresh", 0)
    shown = health.life if frame is None else state_shown(health.life, n_fresh, health.sensors)
    first = Row(
        RowKey(name, DRIVER, 0),
        (
            name,
            shown,
            rate_text(health.rate_hz),
            age_text(health.age_ns),
            f"{n_fresh}/{health.sensors}",
            count_text(health.counters.get("lost")),
            count_text(health.counters.get("orphans")),
            "",
        ),
        shown,
        health.counters,
    )
    if frame is None:
        return [first]
    structure = frame.structure
    rates = patch_rates_hz if len(patch_rates_hz) == structure.n_patches else [None] * structure.n_patches
    patches = _patch_rows(reader, frame, health.life, rates)
    was = "was " if health.life in WITHOUT_NEWS else ""
    rows = [first]
    for bus, counters in enumerate(reader.bus_counters(frame)):
        state = bus_state_name(int(frame.bus_state[bus]))
        reason = bus_reason_name(int(frame.bus_reason[bus]))
        lost, others = count_text(counters.get("lost")), counters_text(counters, besides=_NOT_AMONG_OTHERS)
        told = f"{reason.replace('_', '-')}  {others}".rstrip() if reason else others
        cells = (f"  {structure.buses[bus]}", was + state, "", "", "", lost, "", told)
        rows.append(Row(RowKey(name, BUS, bus), cells, was + state, counters))
        rows += [patches[patch] for patch in np.flatnonzero(structure.patch_bus == bus).tolist()]
    return rows


def _patch_rows(reader: DriverReader, frame: DriverSnapshot, life: str, rates_hz: Sequence[float | None]) -> list[Row]:
    structure, status = frame.structure, status_now(life, frame)
    was = "was " if life in WITHOUT_NEWS else ""
    total = np.bincount(structure.sensor_patch, minlength=structure.n_patches).tolist()
    fresh = np.bincount(structure.sensor_patch[status == 0], minlength=structure.n_patches).tolist()
    ages_ns = patch_ages_ns(frame)
    rows = []
    for patch, counters in enumerate(reader.patch_counters(frame)):
        state = state_shown(was + patch_state_name(int(frame.patch_state[patch])), fresh[patch], total[patch])
        cells = (
            f"    {structure.patch_name[patch].decode()}",
            state,
            "" if rates_hz[patch] is None else rate_text(rate_now_hz(life, rates_hz[patch])),
            age_text(ages_ns[patch]),
            f"{fresh[patch]}/{total[patch]}",
            "",
            count_text(counters.get("orphans")),
            counters_text(counters, besides=_NOT_AMONG_OTHERS),
        )
        rows.append(Row(RowKey(reader.name, PATCH, patch), cells, state, counters))
    return rows


def patches_of(key: RowKey, frame: DriverSnapshot) -> list[int]:
    """The patches that a row stands for: its own, those of its bus, or all of its driver."""
    structure = frame.structure
    if key.kind == PATCH:
        return [key.number] if key.number < structure.n_patches else []
    if key.kind == BUS:
        found: list[int] = np.flatnonzero(structure.patch_bus == key.number).tolist()
        return found
    return list(range(structure.n_patches))


def title_of(key: RowKey, structure: Structure, patches: list[int], type_name: str, sensors: int) -> str:
    """What is drawn, in words.

    Args:
        key: the row.
        structure: of its driver now, which may have changed since the list was made.
        patches: what ``patches_of`` said.
        type_name: the type of sensors that are drawn.
        sensors: how many there are.
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


def counters_text(counters: dict[str, int], *, besides: tuple[str, ...] = ()) -> str:
    """The counters that are not 0, in the driver's own words; those in ``besides`` are left out."""
    return "  ".join(
        f"{name.replace('_', ' ')} {count_text(count)}"
        for name, count in counters.items()
        if count and name not in besides
    )


def plain_line(health: SkinHealth) -> str:
    if health.life == STARTING:
        return f"{health.name}  starting, no frame yet  sensors {health.sensors}"
    life = {
        LIVE: "? Hz" if health.rate_hz is None else rate_text(health.rate_hz),
        DEAD: "DEAD, this is its last frame",
        SILENT: "SILENT, its process publishes nothing",
    }.get(health.life, health.life)
    statuses = [
        f"{name.replace('_', ' ')} {count}"
        for name, count in health.statuses.items()
        if count or name in ("fresh", "stale")
    ]
    patches = ", ".join(f"{count} {state}" for state, count in health.patches.items()) or NO_VALUE
    losses = [f"{name} {health.counters[name]}" for name in ("lost", "orphans") if name in health.counters]
    age = f"age {age_text(health.age_ns)}"
    sensors = f"sensors {health.sensors} ({', '.join(statuses)})"
    return "  ".join([health.name, life, age, sensors, f"patches {patches}", *losses])


def as_data(health: SkinHealth, contacts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        "driver": health.name,
        "state": health.life,
        "rate_hz": None if health.rate_hz is None else round(health.rate_hz, 3),
        "age_ms": None if health.age_ns is None else round(health.age_ns / 1e6, 3),
        "sensors": health.sensors,
        "status": health.statuses,
        "patches": health.patches,
        "counters": health.counters,
        "contacts": list(contacts),
    }
