"""Which frames belong together: the members of a cycle that follow each other, also from one batch to the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware_drivers.layout import Cycle

Indices = npt.NDArray[np.int64]
Places = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]
Groups = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Pairs:
    """What became of the members of a cycle in one batch.

    Attributes:
        rows: (n, members) rows of whole cycles, in the order of the members; or all the same row, of an orphan: a
            frame that will never be part of a cycle. In order of arrival of the last row of each.
        whole: (n,) bool, which of them are whole.
        late: first rows of cycles that took too long (their rows are orphans too).
        waiting: rows that may become a cycle with what comes next, ascending.
    """

    rows: Indices
    whole: Flags
    late: Indices
    waiting: Indices


class Pairing:
    """Finds the cycles of one layout.

    Args:
        cycle: what makes one.
        places: (256,) place in the cycle of each kind of frame; ``n`` = not a member.
    """

    def __init__(self, cycle: Cycle, places: Places) -> None:
        self._n = len(cycle.members)
        self._order: Literal["given", "any", "ends_with"] = cycle.order
        self._maximum_age_ns = round(cycle.maximum_age_s * NS_PER_S)
        self._places = places

    def find(self, module: Indices, group: Groups, kind: Places, time_ns: Indices, is_module: Flags) -> Pairs:
        """Find the members of cycles that follow each other without another frame of their group in between.

        Args:
            module: (m,) module of each frame, where ``is_module``.
            group: (m,) what frames must follow each other in: the patch, or the module.
            kind: (m,) kind of each frame.
            time_ns: (m,) stamps.
            is_module: (m,) bool: the frame is one of a known module.
        """
        n = self._n
        place = self._places[kind]
        place[~is_module] = n
        order = np.argsort(group, kind="stable")
        module, place, group, time_ns = module[order], place[order], group[order], time_ns[order]
        starts = self._find_cycles(module, place)
        in_time = time_ns[starts + n - 1] - time_ns[starts] <= self._maximum_age_ns
        late, starts = starts[~in_time], starts[in_time]
        windows = starts[:, None] + np.arange(n)
        used = np.zeros(len(order), bool)
        used[windows] = True
        waiting = self._still_hoping(module, place, group, used)
        is_orphan = place < n
        is_orphan &= ~used
        is_orphan[waiting] = False
        rows = order[windows]
        last = rows[:, -1]
        if self._order != "given":
            rows = np.take_along_axis(rows, np.argsort(place[windows], axis=1), axis=1)
        orphans = order[is_orphan]
        by_arrival = np.argsort(np.concatenate([last, orphans]), kind="stable")
        rows = np.concatenate([rows, np.repeat(orphans[:, None], n, axis=1)])[by_arrival]
        return Pairs(rows, by_arrival < len(last), order[late], np.sort(order[waiting]))

    def _find_cycles(self, module: Indices, place: Places) -> Indices:
        """First rows of runs of n frames of one module that are a whole cycle; runs do not overlap."""
        n = self._n
        m = max(0, len(module) - n + 1)
        whole = np.ones(m, bool)
        seen = np.zeros(m, np.uint32)
        for j in range(n):
            whole &= module[j : m + j] == module[:m]
            if self._order == "given":
                whole &= place[j : m + j] == j
            else:
                seen |= np.left_shift(np.uint32(1), place[j : m + j].astype(np.uint32))
        if self._order != "given":
            whole &= seen == (1 << n) - 1
        if self._order == "ends_with":
            whole &= place[n - 1 : m + n - 1] == n - 1
        starts = np.flatnonzero(whole)
        if self._order == "any" and len(starts) > 1 and np.diff(starts).min() < n:
            chosen: list[int] = []
            for start in starts.tolist():
                if not chosen or start >= chosen[-1] + n:
                    chosen.append(start)
            starts = np.array(chosen, np.int64)
        return starts

    def _still_hoping(self, module: Indices, place: Places, group: Groups, used: npt.NDArray[np.bool_]) -> Indices:
        """Rows at the end of each group that may become a cycle with what comes next."""
        n = self._n
        if not len(module):
            return np.zeros(0, np.int64)
        ends = np.concatenate([np.flatnonzero(group[1:] != group[:-1]), [len(group) - 1]])
        ends = ends[(place[ends] < n) & ~used[ends]]
        if not len(ends):
            return np.zeros(0, np.int64)
        keep = np.zeros(len(module), bool)
        for length in range(n - 1, 0, -1):
            first = ends - length + 1
            fits = first >= 0
            seen = np.zeros(len(ends), np.uint32)
            for j in range(length):
                at = np.maximum(first + j, 0)
                fits &= (module[at] == module[ends]) & ~used[at] & (place[at] < n)
                if self._order == "given":
                    fits &= place[at] == j
                bit = np.left_shift(np.uint32(1), place[at].astype(np.uint32))
                fits &= (seen & bit) == 0
                seen |= bit
            for start in first[fits].tolist():
                keep[start : start + length] = True
            ends = ends[~fits]
        return np.flatnonzero(keep)
