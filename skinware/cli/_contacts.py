"""Write contacts as lines, as JSON, and as labels of a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from skinware.cli._heat_map import Arrangement, Label
from skinware.realtime import NS_PER_S
from skinware.tactile.contacts import Contact
from skinware.text import NO_VALUE, age_text, figure_text, plural
from skinware.views.live import TouchedPlace

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


def plain_text(place: TouchedPlace) -> str:
    contact = place.contact
    return "  ".join(
        [
            f"  contact {contact.id}",
            contact.kind.name.lower(),
            place.module,
            f"at {_at_text(contact).strip()} m",
            f"load {figure_text(contact.load)} {place.unit}".rstrip(),
            plural(contact.n, "taxel"),
            f"{_speed_text(contact)} mm/s",
            f"for {age_text(contact.age_s * NS_PER_S)}",
        ]
    )


def as_data(place: TouchedPlace) -> dict[str, Any]:
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
    """Return the identities of contacts as labels of a picture, by line, each over its nearest sensor.

    Args:
        places: the contacts; contacts outside the picture have no label.
    """
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
