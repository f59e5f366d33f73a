"""Contacts beside the drivers that are looked at: found, told as lines and as JSON, and where they are in a picture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from skinware.cli._format import NO_VALUE, age_text, figure_text, plural
from skinware.cli._heat_map import Arrangement, Label
from skinware.errors import (
    BadServiceFile,
    ConfigurationError,
    Overrun,
    ServiceNotFound,
    ServiceTimeout,
    StructureError,
)
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.structure import Structure
from skinware.tactile.contacts import Contact
from skinware.tactile.contacts_service import ContactsFrame, ContactsReader

_LONGEST_PLACE = 22
TITLES = f"{'id':>4}  {'kind':<7}  {'at':<{_LONGEST_PLACE}} {'x, y, z in m':<20} {'load':>6} {'mm/s':>5} {'age':>6}"
"""Over the lines of :func:`line_of`."""


class TouchedPlace(NamedTuple):
    """A contact, and where it is on the skin.

    Attributes:
        contact: it.
        unit: of its load.
        sensor: position in a frame of the driver of the taxel nearest to its centre; of one of its taxels, where
            places are not known.
        module: name of the module of that taxel.
    """

    contact: Contact
    unit: str
    sensor: int
    module: str


class LiveContacts:
    """The services of contacts in a namespace, followed live.

    Args:
        namespace: where to look.
    """

    def __init__(self, namespace: Namespace) -> None:
        self._namespace = namespace
        self._readers: dict[str, ContactsReader] = {}

    def look(self, names: Iterable[str]) -> None:
        """Look for services of contacts that are new, and for those that went.

        Args:
            names: of the services that there are now; those of drivers may be missing.
        """
        there = set(names)
        for name in self._readers.keys() - there:
            self._drop(name)
        for name in sorted(there - self._readers.keys()):
            try:
                self._readers[name] = ContactsReader(name, namespace=self._namespace)
            except (BadServiceFile, ConfigurationError, ServiceNotFound):
                continue  # another kind of service, or just gone

    def of(self, driver: str) -> ContactsFrame | None:
        """The newest contacts of a driver; None where no service tells any."""
        for name, reader in sorted(self._readers.items()):
            if reader.source.driver == driver:
                return self._newest(name, reader)
        return None

    def close(self) -> None:
        """Detach from all services. Idempotent."""
        for name in list(self._readers):
            self._drop(name)

    def _newest(self, name: str, reader: ContactsReader) -> ContactsFrame | None:
        try:
            reader.refresh()
            if reader.structure_changed:
                reader.reattach()
            frame = reader.read(timeout_s=0.0)
        except (ServiceTimeout, Overrun):
            return None  # nothing published yet
        except (ServiceNotFound, BadServiceFile):
            self._drop(name)
            return None
        return None if frame.stale else frame

    def _drop(self, name: str) -> None:
        self._readers.pop(name).close()


def places_of(frame: ContactsFrame | None, structure: Structure) -> list[TouchedPlace]:
    """Where the contacts are, the oldest first; none if they are of other sensors than those of the driver.

    Args:
        frame: the contacts; None: there are none.
        structure: of their driver now.
    """
    if frame is None:
        return []
    source = frame.source
    try:
        sensors = np.arange(structure.n_sensors)[structure.index(source.type_name)]
    except StructureError:
        return []
    if not np.array_equal(structure.sensor_uid[sensors], source.uid):
        return []
    found = []
    for contact in frame:
        of_contact = sensors[contact.taxels]
        sensor = int(of_contact[_nearest(contact, of_contact, structure)])
        found.append(
            TouchedPlace(contact, source.unit, sensor, structure.module_names[structure.sensor_module[sensor]])
        )
    return found


def _nearest(contact: Contact, sensors: np.ndarray[Any, Any], structure: Structure) -> int:
    """Which of the contact's sensors is nearest to its centre; the first where nobody knows."""
    if structure.geometry is None:
        return 0
    away_m = np.linalg.norm(structure.geometry.position_m[sensors] - contact.cop_m, axis=1)
    return int(np.nan_to_num(away_m, nan=np.inf).argmin())


def line_of(place: TouchedPlace) -> str:
    """One contact on a line of 78 columns, under ``TITLES``."""
    contact, module = place.contact, place.module
    if len(module) > _LONGEST_PLACE:
        module = f"{module[: _LONGEST_PLACE - 3]}..."
    return (
        f"{contact.id:>4}  {contact.kind.name.lower():<7}  {module:<{_LONGEST_PLACE}} {_at_text(contact):<20}"
        f" {figure_text(contact.load):>6} {_speed_text(contact):>5} {age_text(contact.age_s * NS_PER_S):>6}"
    )


def lines_of(places: Sequence[TouchedPlace], most: int) -> list[str]:
    """Titles and contacts on at most so many lines, the last of which tells how many there was no room for."""
    lines = [line_of(place) for place in places]
    if len(lines) < max(most, 1):
        return [TITLES, *lines]
    shown = max(0, most - 2)
    return [TITLES, *lines[:shown], f"{'and ' * (shown > 0)}{len(lines) - shown} more"]


def plain_text(place: TouchedPlace) -> str:
    """One contact on one line, for pipes."""
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
    """One contact as JSON prints it."""
    contact = place.contact
    return {
        "id": contact.id,
        "kind": contact.kind.name.lower(),
        "module": place.module,
        "frame": contact.frame,
        "cop_m": _rounded(contact.cop_m),
        "velocity_m_s": _rounded(contact.velocity_m_s),
        "load": round(contact.load, 3),
        "unit": place.unit,
        "force_n": contact.force_n,
        "taxels": contact.n,
        "age_s": round(contact.age_s, 3),
    }


def labels_of(places: Sequence[TouchedPlace], arrangement: Arrangement) -> dict[int, list[Label]]:
    """The identities of contacts as labels of a picture, by line, each over its nearest sensor.

    Args:
        places: the contacts; those elsewhere than in the picture have no label.
        arrangement: of the picture.
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


def _rounded(values: np.ndarray[Any, Any]) -> list[float]:
    return [round(value, 6) for value in values.tolist()]
