"""Act on a touch within two samples: python reflex.py [NAMESPACE [JOINTS]].

Prints each event, the age of its sample before and after the action, and the sample's time, CLOCK_MONOTONIC.

JOINTS is the service of the hand's joints, in the default namespace, which stops at the request ``hold``: that of a
simulated hand (``skin-emulate --world mujoco:gripper``), or one that the program of your hand publishes.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import Any

from skinware.realtime import Profile, now_ns
from skinware.service import ServiceReader
from skinware.tactile import ContactsReader, EventKind


def act(joints: ServiceReader[Any] | None) -> None:
    """Stop the hand, or let go: whatever must not wait. Take it back at WITHDRAWN."""
    if joints is not None:
        joints.call("hold")


def main() -> None:
    """Entry point."""
    namespace = sys.argv[1] if len(sys.argv) > 1 else "calm"
    Profile.fifo(42).apply()  # ahead of driver and skin-calm; refused without the right, with a warning
    with ExitStack() as stack:
        contacts = stack.enter_context(ContactsReader(namespace=namespace, timeout_s=10))
        joints = stack.enter_context(ServiceReader(sys.argv[2], timeout_s=10)) if len(sys.argv) > 2 else None
        begun = set()
        for event in contacts.events():
            age_us = (now_ns() - event.acquired_ns) / 1000
            if event.kind in (EventKind.ONSET, EventKind.CONFIRMED) and event.contact.id not in begun:
                begun.add(event.contact.id)
                act(joints)
            elif event.kind in (EventKind.WITHDRAWN, EventKind.ENDED):
                begun.discard(event.contact.id)
            acted_us = (now_ns() - event.acquired_ns) / 1000
            times = f"{age_us:.0f} us {acted_us:.0f} us {event.acquired_ns} ns"
            print(event.kind.name.lower(), event.contact.id, times, flush=True)


if __name__ == "__main__":
    main()
