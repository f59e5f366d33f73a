"""Keeps a few of the frames of a bus that could not be used, at a bounded cost."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S, now_ns
from skinware.samples import SAMPLE, SAMPLES_OF_A_KIND, Unused

_PAUSE_NS = NS_PER_S // 4


class Samples:
    """Frames of one bus, the newest few of each kind, with different identifiers.

    However many come, at most four a second of each kind are looked at.

    Attributes:
        rows: (SAMPLES,) :data:`skinware.samples.SAMPLE`.
    """

    def __init__(self) -> None:
        self.rows: npt.NDArray[np.void] = np.zeros((len(Unused), SAMPLES_OF_A_KIND), SAMPLE).reshape(-1)
        self.next_ns = [0] * (len(Unused) + 1)
        self._taken = [0] * (len(Unused) + 1)

    def wants(self, why: Unused) -> bool:
        """Whether it is time to look at frames of a kind again."""
        return now_ns() >= self.next_ns[why]

    def take(self, why: Unused, wire: npt.NDArray[Any]) -> None:
        """Keep one of these frames, if it is time to, and one has an identifier that was not kept yet.

        Args:
            why: they were not used.
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
        """Keep one frame that comes alone, if it is time to."""
        if self.wants(why):
            self.next_ns[why] = now_ns() + _PAUSE_NS
            kept = self.rows.reshape(len(Unused), SAMPLES_OF_A_KIND)[why - 1]
            self._keep(kept, why, identifier, len(payload), payload)

    def _keep(self, kept: npt.NDArray[np.void], why: Unused, identifier: int, length: int, payload: bytes) -> None:
        place, self._taken[why] = self._taken[why] % SAMPLES_OF_A_KIND, self._taken[why] + 1
        size = kept["data"].shape[1]
        data = np.frombuffer(payload[: min(length, size)].ljust(size, b"\0"), np.uint8)
        kept[place] = (identifier, min(length, 0xFFFF), why, 0, data)
