"""Act on a touch within two frames: python reflex.py [NAMESPACE]. Prints each event and the age of its frame."""

from __future__ import annotations

import sys

from skinware.realtime import Profile, now_ns
from skinware.tactile import ContactsReader, EventKind


def act(identity: int) -> None:
    """Stop the hand, or let go: whatever must not wait. Take it back at WITHDRAWN."""


def main() -> None:
    """Entry point."""
    namespace = sys.argv[1] if len(sys.argv) > 1 else "calm"
    Profile.fifo(41).apply()  # ahead of the drivers; refused without the right, with a warning
    with ContactsReader(namespace=namespace, timeout_s=10) as contacts:
        for event in contacts.events():
            if event.kind is EventKind.ONSET:
                act(event.contact.id)
            age_us = (now_ns() - event.acquired_ns) / 1000
            print(event.kind.name.lower(), event.contact.id, f"{age_us:.0f} us", flush=True)


if __name__ == "__main__":
    main()
