"""What a bus counts: frames, and on a serial line the bytes that they were found in."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from operator import attrgetter


@dataclass
class FramerCounters:
    """What was found in a stream of bytes, and what was not.

    ``bytes_in == frame_bytes + idle_bytes + skipped_bytes`` and those that may still become part of a frame.
    """

    bytes_in: int = 0
    """Bytes that were received."""
    frame_bytes: int = 0
    """Bytes of good frames, with everything that belongs to their framing."""
    idle_bytes: int = 0
    """Delimiters between frames that end nothing."""
    skipped_bytes: int = 0
    """Bytes that belong to no good frame."""
    frames: int = 0
    """Good frames."""
    checksum_errors: int = 0
    """Frames whose checksum was wrong, or bytes that looked like the beginning of one."""
    refused: int = 0
    """Frames of a length or form that cannot be, or bytes that looked like the beginning of one."""


@dataclass
class BusCounters:
    """What happened on one bus since it was made, counted by the bus itself."""

    frames: int = 0
    """Frames received."""
    lost: int = 0
    """Frames that the kernel (or the interface's queue) dropped before we could read them."""
    errors: int = 0
    """CAN error frames and their like."""
    refused: int = 0
    """Frames that do not fit this bus' batch (remote frames, FD frames on a classic layout)."""
    sent: int = 0
    """Frames handed to the wire."""
    send_failures: int = 0
    """Sends that the interface refused."""
    polls_missed: int = 0
    """Polls of devices that only answer which could not be sent in time."""
    polls_unanswered: int = 0
    """Polls in lock step whose answer did not come in time."""
    polls_late: int = 0
    """Answers to polls in lock step that came after their timeout; what they say is shown all the same."""
    updates_skipped: int = 0
    """Updates of modules that were never published, as newer ones came before that was possible."""
    overflows: int = 0
    """How often the controller told that it had lost frames."""
    bus_offs: int = 0
    """How often the controller left the wire."""
    framing: FramerCounters = field(default_factory=FramerCounters)
    """Of a serial line."""


_OWN = {each.name: each.name for each in fields(BusCounters) if each.name != "framing"} | {
    "bytes_in": "framing.bytes_in",
    "frame_bytes": "framing.frame_bytes",
    "idle_bytes": "framing.idle_bytes",
    "skipped_bytes": "framing.skipped_bytes",
    "checksum_errors": "framing.checksum_errors",
    "bad_form": "framing.refused",
}
OWN_BUS_COUNTERS = tuple(_OWN)
"""Names of what a bus counts, for people and other programs."""
read_own = attrgetter(*_OWN.values())
"""The counts of a ``BusCounters``, in the order of ``OWN_BUS_COUNTERS``."""
