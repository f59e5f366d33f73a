"""Count frames and bytes of a bus, and keep a few of the frames that could not be used."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S, now_ns
from skinware.status import SAMPLE, SAMPLES_OF_A_KIND, Unused


@dataclass
class FramerCounters:
    """Counts of the bytes and frames of a serial line.

    ``bytes_in`` is the sum of ``frame_bytes``, ``idle_bytes``, ``skipped_bytes`` and the bytes that are not decided.
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
    """Counts of one bus, kept by the bus itself."""

    frames: int = 0
    """Frames received."""
    dropped: int = 0
    """Frames that the kernel (or the interface's queue) dropped before we could read them."""
    errors: int = 0
    """CAN error frames and similar."""
    refused: int = 0
    """Frames that do not fit this bus' batch (remote frames, FD frames on a classic layout)."""
    sent: int = 0
    """Frames handed to the wire."""
    send_failures: int = 0
    """Sends that the interface refused."""
    polls_missed: int = 0
    """Polls that could not be sent in time."""
    polls_unanswered: int = 0
    """Polls in lock step whose answer did not come in time."""
    polls_late: int = 0
    """Answers to polls in lock step that came after their timeout; what they say is shown all the same."""
    updates_skipped: int = 0
    """Updates of modules that newer ones replaced before they could be published."""
    overflows: int = 0
    """How often the controller reported lost frames."""
    bus_offs: int = 0
    """How often the controller left the wire."""
    framing: FramerCounters = field(default_factory=FramerCounters)
    """Counts of a serial line."""


_OWN = {each.name: each.name for each in fields(BusCounters) if each.name != "framing"} | {
    "bytes_in": "framing.bytes_in",
    "frame_bytes": "framing.frame_bytes",
    "idle_bytes": "framing.idle_bytes",
    "skipped_bytes": "framing.skipped_bytes",
    "checksum_errors": "framing.checksum_errors",
    "bad_form": "framing.refused",
}
OWN_BUS_COUNTERS = tuple(_OWN)
"""Names of the counts of a bus, for people and other programs."""
read_own = attrgetter(*_OWN.values())
"""The counts of a ``BusCounters``, in the order of ``OWN_BUS_COUNTERS``."""


_PAUSE_NS = NS_PER_S // 4


class Samples:
    """The newest few unused frames of one bus, of each reason, with different identifiers.

    At most four frames a second of each reason are looked at.
    """

    def __init__(self) -> None:
        self.rows: npt.NDArray[np.void] = np.zeros((len(Unused), SAMPLES_OF_A_KIND), SAMPLE).reshape(-1)
        self.next_ns = [0] * (len(Unused) + 1)
        self._taken = [0] * (len(Unused) + 1)

    def wants(self, why: Unused) -> bool:
        """Return whether it is time to look at frames with a reason again."""
        return now_ns() >= self.next_ns[why]

    def take(self, why: Unused, wire: npt.NDArray[Any]) -> None:
        """Keep one of these frames if it is time, and one has a new identifier.

        Args:
            wire: (n,) rows of a batch (:func:`skinware_drivers.bus.wire_dtype`).
        """
        if not len(wire) or not self.wants(why):
            return
        self.next_ns[why] = now_ns() + _PAUSE_NS
        kept = self.rows.reshape(len(Unused), SAMPLES_OF_A_KIND)[why - 1]
        known = kept["identifier"][kept["why"] != 0]
        new = np.flatnonzero(~np.isin(wire["identifier"], known))
        if len(new):
            row = wire[new[0]]
            self._keep(kept, why, int(row["identifier"]), int(row["length"]), row["payload"].tobytes())

    def note(self, why: Unused, identifier: int, payload: bytes) -> None:
        """Keep one frame if it is time."""
        if self.wants(why):
            self.next_ns[why] = now_ns() + _PAUSE_NS
            kept = self.rows.reshape(len(Unused), SAMPLES_OF_A_KIND)[why - 1]
            self._keep(kept, why, identifier, len(payload), payload)

    def _keep(self, kept: npt.NDArray[np.void], why: Unused, identifier: int, length: int, payload: bytes) -> None:
        place, self._taken[why] = self._taken[why] % SAMPLES_OF_A_KIND, self._taken[why] + 1
        size = kept["data"].shape[1]
        data = np.frombuffer(payload[: min(length, size)].ljust(size, b"\0"), np.uint8)
        kept[place] = (identifier, min(length, 0xFFFF), why, 0, data)
