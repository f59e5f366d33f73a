"""Write what skin-top lists: drivers, buses, patches and contacts, as rows, labels, plain lines and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from skinware.cli._heat_map import Arrangement, Label
from skinware.realtime import NS_PER_S
from skinware.state import DEAD, LIVE, SILENT, STARTING, DriverReport, badness
from skinware.structure import Structure
from skinware.tactile.contacts import Contact
from skinware.text import (
    NO_VALUE,
    age_text,
    count_text,
    counters_text,
    figure_text,
    measure_text,
    plural,
    rate_text,
    words,
)
from skinware.views.live import TouchedPlace

COLUMNS = ("driver, bus, patch", "state", "rate", "age", "fresh", "dropped", "orphans", "other counters")
"""Titles of the cells of a row."""
_AGE = COLUMNS.index("age")

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
    bad: int
    """How bad its state is, which gives the row its colour; see :func:`skinware.state.badness`."""
    is_fresh: bool
    """All its sensors are fresh."""
    counters: dict[str, int]
    """Every counter that the driver publishes for this row, by name."""

    def ageless(self) -> ListRow:
        """Return the row without the age, which changes without news."""
        return self._replace(cells=self.cells[:_AGE] + self.cells[_AGE + 1 :])


def rows_of(report: DriverReport, *, worst_first: bool = True) -> list[ListRow]:
    """Return the row of a driver, then those of its buses, each followed by its patches, in order or worst first."""
    name, counters = report.name, report.counters
    cells = (
        name,
        report.state,
        rate_text(report.rate_hz),
        age_text(report.age_ns),
        f"{report.fresh}/{report.sensors}",
        count_text(counters.get("dropped")),
        count_text(counters.get("orphans")),
        "",
    )
    driver = ListRow(RowKey(name, DRIVER, 0), cells, badness(report.state), report.fresh == report.sensors, counters)
    branches = []
    for at, bus in enumerate(report.buses):
        state, dropped = report.state_of(bus), count_text(bus.counters.get("dropped"))
        reason = "" if bus.reason is None else bus.reason.replace("_", "-")
        others = f"{reason}  {counters_text(bus.counters, besides=_NOT_AMONG_OTHERS)}".strip()
        cells = (f"  {bus.name}", state, "", "", "", dropped, "", others)
        patches = []
        for number, patch in enumerate(report.patches):
            if patch.bus != at:
                continue
            state = report.state_of(patch)
            patch_cells = (
                f"    {patch.name}",
                state,
                "" if patch.rate_hz is None else rate_text(patch.rate_hz),
                age_text(patch.age_ns),
                f"{patch.fresh}/{patch.sensors}",
                "",
                count_text(patch.counters.get("orphans")),
                counters_text(patch.counters, besides=_NOT_AMONG_OTHERS),
            )
            is_fresh = patch.fresh == patch.sensors
            patches.append(ListRow(RowKey(name, PATCH, number), patch_cells, badness(state), is_fresh, patch.counters))
        are_fresh = all(patch.is_fresh for patch in patches)
        row = ListRow(RowKey(name, BUS, at), cells, badness(report.state_of(bus)), are_fresh, bus.counters)
        branches.append([row, *(sorted(patches, key=attrgetter("bad"), reverse=True) if worst_first else patches)])
    if worst_first:
        branches.sort(key=lambda rows: max(row.bad for row in rows), reverse=True)
    return [driver, *(row for rows in branches for row in rows)]


def patches_of(key: RowKey, structure: Structure) -> list[int]:
    """Return the patches of a row: its own, those of its bus, or all of its driver."""
    if key.kind == PATCH:
        return [key.number] if key.number < structure.n_patches else []
    if key.kind == BUS:
        found: list[int] = np.flatnonzero(structure.patch_bus == key.number).tolist()
        return found
    return list(range(structure.n_patches))


def title_of(key: RowKey, structure: Structure, patches: list[int], type_name: str, sensors: int) -> str:
    """Return the title of a picture; the structure may have changed since the list was made."""
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
        return f"{report.name}  starting, no sample yet  sensors {report.sensors}"
    life = {
        LIVE: "? Hz" if report.rate_hz is None else rate_text(report.rate_hz),
        DEAD: "DEAD, this is its last sample",
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


_LONGEST_PLACE = 22
TITLES = f"{'id':>4}  {'kind':<7}  {'at':<{_LONGEST_PLACE}} {'x, y, z in m':<20} {'load':>6} {'mm/s':>5} {'age':>6}"
"""The titles over the lines of :func:`line_of`."""


def line_of(place: TouchedPlace) -> str:
    """Return one contact in a line of 78 columns, under ``TITLES``."""
    contact, module = place.contact, place.module
    if len(module) > _LONGEST_PLACE:
        module = f"{module[: _LONGEST_PLACE - 3]}..."
    return (
        f"{contact.id:>4}  {contact.kind.name.lower():<7}  {module:<{_LONGEST_PLACE}} {_at_text(contact):<20}"
        f" {figure_text(contact.load):>6} {_speed_text(contact):>5} {age_text(contact.age_s * NS_PER_S):>6}"
    )


def lines_of(places: Sequence[TouchedPlace], most: int) -> list[str]:
    """Return titles and contacts in at most this many lines; the last one counts contacts without room."""
    lines = [line_of(place) for place in places]
    if len(lines) < max(most, 1):
        return [TITLES, *lines]
    shown = max(0, most - 2)
    return [TITLES, *lines[:shown], f"{'and ' * (shown > 0)}{len(lines) - shown} more"]


def contact_text(place: TouchedPlace) -> str:
    contact = place.contact
    return "  ".join(
        [
            f"  contact {contact.id}",
            contact.kind.name.lower(),
            place.module,
            f"at {_at_text(contact).strip()} m",
            f"load {measure_text(contact.load, place.unit)}",
            plural(contact.n, "taxel"),
            f"{_speed_text(contact)} mm/s",
            f"for {age_text(contact.age_s * NS_PER_S)}",
        ]
    )


def contact_data(place: TouchedPlace) -> dict[str, Any]:
    contact = place.contact
    return {
        "id": contact.id,
        "kind": contact.kind.name.lower(),
        "module": place.module,
        "frame": contact.frame,
        "cop_m": [round(value, 6) for value in contact.cop_m.tolist()],
        "velocity_m_s": [round(value, 6) for value in contact.velocity_m_s.tolist()],
        "load": round(contact.load, 3),
        "unit": place.unit,
        "force_n": contact.force_n,
        "taxels": contact.n,
        "age_s": round(contact.age_s, 3),
    }


def labels_of(places: Sequence[TouchedPlace], arrangement: Arrangement) -> dict[int, list[Label]]:
    """Return the identities of contacts in a picture as labels, by line, each over its nearest sensor."""
    labels: dict[int, list[Label]] = {}
    for place in places:
        (number,) = np.flatnonzero(arrangement.sensors == place.sensor)[:1].tolist() or (None,)
        if number is None:
            continue
        rows, columns = np.nonzero(arrangement.pixels == number)
        if not len(rows):
            continue
        text = str(place.contact.id)
        middle = round(float(columns.mean()) + 0.5 - len(text) / 2)
        column = max(0, min(middle, arrangement.columns - len(text)))
        labels.setdefault(int(rows.mean()) // 2, []).append(Label(column, text, is_mark=True))
    return labels


def _at_text(contact: Contact) -> str:
    if not np.isfinite(contact.cop_m).all():
        return NO_VALUE
    return " ".join(f"{value:6.3f}" for value in contact.cop_m.tolist())


def _speed_text(contact: Contact) -> str:
    speed = float(np.linalg.norm(contact.velocity_m_s))
    return f"{1e3 * speed:.0f}" if np.isfinite(speed) else NO_VALUE
