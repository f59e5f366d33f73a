"""Find touches within two frames, before a baseline has confirmed them, and turn contacts into events."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from skinware.realtime import NS_PER_S
from skinware.tactile.arrays import Flags, Floats

if TYPE_CHECKING:
    from skinware.tactile.contacts import Contact, ContactSet


_ABOVE_SIGMA = 5.0  # standard deviations of its noise by which a taxel must be above its baseline
_ENOUGH, _FRAMES = 2, 3  # in how many of the last frames
_GONE_S = 0.08  # seconds after which a contact that is missing has ended: longer than its identity is kept


class Onsets:
    """Finds which of n taxels have risen beyond their own noise in two of the last three frames.

    Nothing is smoothed: a spike of one frame is none, and a touch is found in its second frame, at any rate.
    ``resolution`` is the step of the values, in the unit of the noise; 0 if they have none.
    """

    def __init__(self, n: int, resolution: float = 0.0) -> None:
        self._least = _ENOUGH * resolution
        self._were: list[Flags] = [np.zeros(n, bool) for _ in range(_FRAMES - 1)]

    def update(self, above: Floats, noise: Floats, usable: Flags) -> Flags:
        """Return (n,) bool, which taxels are touched, as far as the newest frames say.

        ``above`` is how far each value is above its baseline, not smoothed, and ``noise`` the standard deviation of
        that, noise and baseline; NaN: not known, so that nothing is found. ``usable`` values are of this frame.
        """
        is_above = usable & (above > np.maximum(_ABOVE_SIGMA * noise, self._least))
        count = np.sum([is_above, *self._were], axis=0, dtype=np.int8)
        self._were = [*self._were[1:], is_above]
        onset: Flags = is_above & (count >= _ENOUGH)
        return onset


class EventKind(enum.IntEnum):
    """A moment in the life of a contact."""

    ONSET = 0
    """It has begun, provisionally: nothing but the last frames speak for it."""
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
    """An event: its kind, its contact (at the end, as it was last seen), and when the frame of it was acquired, ns."""

    kind: EventKind
    contact: Contact
    acquired_ns: int


class Events:
    """Turns the contacts of frames into events."""

    def __init__(self) -> None:
        self._seen: dict[int, tuple[Contact, int]] = {}

    def of(self, contacts: ContactSet, acquired_ns: int) -> list[ContactEvent]:
        """Return the events since the last frame, by the contacts of the newest, and when that was acquired."""
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
