"""Turn contacts into events: some begin within two samples, before a baseline has confirmed them."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

from skinware.realtime import NS_PER_S

if TYPE_CHECKING:
    from skinware.tactile.contacts import Contact, ContactSet


_GONE_S = 0.08  # seconds after which a contact that is missing has ended: longer than its identity is kept


class EventKind(enum.IntEnum):
    """A moment in the life of a contact."""

    ONSET = 0
    """It has begun, provisionally: nothing but the last samples speak for it."""
    CONFIRMED = 1
    """It is a contact: the baseline agrees. Where it does so at once, this is the first event."""
    WITHDRAWN = 2
    """It was none: it went before it was confirmed."""
    ENDED = 3
    """It is over."""
    SLIPPED = 4
    """It has begun to slip."""


@dataclass(frozen=True, eq=False)
class ContactEvent:
    """An event: its kind, its contact (at the end, as it was last seen), and when the sample of it was acquired, ns."""

    kind: EventKind
    contact: Contact
    acquired_ns: int


class Events:
    """Turns the contacts of samples into events."""

    def __init__(self) -> None:
        self._seen: dict[int, tuple[Contact, int]] = {}

    def of(self, contacts: ContactSet, acquired_ns: int) -> list[ContactEvent]:
        """Return the events since the last sample, by the contacts of the newest, and when that was acquired."""
        found = []
        for contact in contacts:
            before = self._seen.get(contact.id)
            if contact.provisional and before is None:
                found.append(ContactEvent(EventKind.ONSET, contact, acquired_ns))
            elif not contact.provisional and (before is None or before[0].provisional):
                found.append(ContactEvent(EventKind.CONFIRMED, contact, acquired_ns))
            if contact.slips and not (before and before[0].slips):
                found.append(ContactEvent(EventKind.SLIPPED, contact, acquired_ns))
            self._seen[contact.id] = contact, acquired_ns
        for identity, (contact, seen_ns) in list(self._seen.items()):
            if acquired_ns - seen_ns > _GONE_S * NS_PER_S:
                del self._seen[identity]
                kind = EventKind.WITHDRAWN if contact.provisional else EventKind.ENDED
                found.append(ContactEvent(kind, contact, acquired_ns))
        return found
