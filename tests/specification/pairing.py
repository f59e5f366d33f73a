"""Which frames belong together, in numpy: what ``pairing.c`` is compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.decoding.compiled import NEVER_NS, CompiledCycle, Punctuality
from skinware_drivers.decoding.decoder import read_numbers

Indices = npt.NDArray[np.int64]
Places = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]
Groups = npt.NDArray[np.uint16]
Bytes = npt.NDArray[np.uint8]

_COUNTER_BITS = 32
_COUNTER_MASK = (1 << _COUNTER_BITS) - 1


class Judgement(NamedTuple):
    """How frames come, compared with those of their kind before.

    Attributes:
        soon: (m,) bool: within the maximum age of the one before.
        held_up: (m,) bool: too late for that.
        doubtful: (m,) bool: held up, or after one that was lost.
        spacing_ns: (m,) int64, time since the frame of the same kind before.
    """

    soon: Flags
    held_up: Flags
    doubtful: Flags
    spacing_ns: Indices


def _judge(own: Punctuality, kind: Indices, time_ns: Indices) -> Judgement:
    """Judge frames by their times.

    Two halves of different cycles come within the maximum age of each other only if the first was held up by at least a
    period minus that age. So each frame is judged by the time since the frame of its kind before:

    * within the maximum age: the sender catches up, and two of its cycles fit into that age;
    * about a period: in time, up to the delay that such a half would need;
    * about two or more periods: frames before were lost, or this one was held up;
    * otherwise: this one was held up.

    Frames are a cycle if none comes soon or was held up, and at least one comes in time. (If the order is not given,
    all must come in time: there, the end of a cycle and the beginning of the next look like one.)

    Args:
        kind: (m,) module * members + place in the cycle, of each frame, in order of arrival.
        time_ns: (m,) stamps.
    """
    order = np.argsort(kind, kind="stable")
    kind, time_ns = kind[order], time_ns[order]
    follows = np.flatnonzero(kind[1:] == kind[:-1]) + 1
    before_ns, usual_ns = own.last_ns[kind], own.spacings_ns[kind]
    before_ns[follows] = time_ns[follows - 1]
    spacing_ns = time_ns - before_ns
    spacing_ns[before_ns == NEVER_NS] = own.period_ns
    usual_ns[follows] = spacing_ns[follows - 1]
    soon = spacing_ns <= own.soon_ns
    late = spacing_ns >= 2 * np.maximum(usual_ns, own.period_ns) - own.reach_ns - own.margin_ns
    held_up = late
    if not own.all_as_they_should and late.any():
        beside_ns = np.abs((spacing_ns + own.period_ns // 2) % own.period_ns - own.period_ns // 2)
        held_up = late & (2 * beside_ns >= own.period_ns - own.reach_ns)
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    return Judgement(soon[back], held_up[back], late[back], spacing_ns[back])


@dataclass(frozen=True, slots=True)
class Pairs:
    """The members of a cycle in one batch: whole cycles, orphans, and frames that wait.

    Attributes:
        rows: (n, members) rows of whole cycles, in the order of the members; or all the same row, of an orphan: a
            frame that will never be part of a cycle. In order of arrival of the last row of each.
        whole: (n,) bool, which of them are whole.
        late: first rows of cycles that took too long, or broke the device's rhythm (their rows are orphans too).
        waiting: rows that may become a cycle with what comes next, ascending.
        soon: rows that came too soon after those before them to be distinguished (orphans too).
    """

    rows: Indices
    whole: Flags
    late: Indices
    waiting: Indices
    soon: Indices


class Pairing:
    """Finds the whole cycles, the orphans and the frames that wait in a batch."""

    def __init__(self, cycle: CompiledCycle) -> None:
        self._cycle = cycle
        self._n = len(cycle.members)
        self._places = np.full(256, self._n, np.uint8)
        self._places[cycle.members] = np.arange(self._n)

    def find(
        self, entry: Indices, kind: Bytes, payload: Bytes, time_ns: Indices, is_module: Flags, severed: Flags
    ) -> Pairs:
        """Find the cycles in a batch.

        Args:
            entry: (m,) module of each frame, where ``is_module``.
            kind: (m,) kind of each.
            payload: (m, size) uint8.
            time_ns: (m,) stamps.
            is_module: (m,) bool: the frame is one of a known module.
            severed: (m,) bool: the frame has waited for partners, and it is known that frames were lost since.
        """
        shared = entry
        if self._cycle.counters:
            shared = entry << _COUNTER_BITS
            for number, counter in zip(self._cycle.members, self._cycle.counters, strict=True):
                rows = np.flatnonzero((kind == number) & is_module)
                shared[rows] |= read_numbers(payload[rows], counter) & _COUNTER_MASK
        return self._find(shared, self._cycle.group_of_entry[entry], kind, time_ns, is_module, severed)

    def _find(
        self, shared: Indices, group: Groups, kind: Places, time_ns: Indices, is_module: Flags, severed: Flags
    ) -> Pairs:
        """Find the members of cycles that follow each other without another frame of their group in between.

        Args:
            shared: (m,) equal for the members of a cycle, where ``is_module``: the module; with a counter, the module
                and its number together.
            group: (m,) the patch, or the module, in which frames must follow each other.
            kind: (m,) kind of each frame.
            time_ns: (m,) stamps.
            is_module: (m,) bool: the frame is one of a known module.
            severed: (m,) bool: the frame has waited for partners, and it is known that frames were lost since.
        """
        n, punctuality = self._n, self._cycle.punctuality
        order = np.argsort(group, kind="stable")
        shared, group, time_ns = shared[order], group[order], time_ns[order]
        place = self._places[kind[order]]
        place[~is_module[order]] = n
        is_member = place < n
        place[severed[order]] = n
        out_of_time, doubtful, soon = np.zeros((3, len(place)), bool)
        judged = None
        if punctuality is not None:
            members = np.flatnonzero(place < n)
            kinds = shared[members] * n + place[members]
            judged = _judge(punctuality, kinds, time_ns[members])
            soon[members], doubtful[members] = judged.soon, judged.doubtful
            out_of_time[members] = judged.soon | judged.held_up
        if self._cycle.order == "given":
            begun = self._find_begun(shared, place)
            starts, untrusted = self._trust(np.flatnonzero(begun & (place == n - 1)) - n + 1, out_of_time, doubtful)
        else:
            starts, untrusted = self._find_cycles(shared, place, out_of_time, doubtful)
        in_time = time_ns[starts + n - 1] - time_ns[starts] <= self._cycle.maximum_age_ns
        used = np.zeros(len(order), bool)
        late, starts = np.union1d(starts[~in_time], untrusted), self._apart(starts[in_time])
        windows = starts[:, None] + np.arange(n)
        used[windows] = True
        ends = np.flatnonzero(np.append(group[1:] != group[:-1], True)) if len(group) else np.zeros(0, np.int64)
        if self._cycle.order == "given":
            ends = ends[begun[ends] & (place[ends] < n - 1)]
            waiting = np.concatenate([np.arange(end - int(place[end]), end + 1) for end in ends.tolist()] or [ends])
        else:
            waiting = self._still_hoping(shared, place, ends, used)
        is_orphan = is_member & ~used
        is_orphan[waiting] = False
        late = self._apart(late[is_orphan[late[:, None] + np.arange(n)].all(axis=1)])
        if punctuality is not None and judged is not None:
            is_waiting = np.zeros(len(place), bool)
            is_waiting[waiting] = True
            over = ~is_waiting[members]
            punctuality.last_ns[kinds[over]] = time_ns[members][over]
            punctuality.spacings_ns[kinds[over]] = judged.spacing_ns[over]
        rows = order[windows]
        last = rows[:, -1]
        if self._cycle.order != "given":
            rows = np.take_along_axis(rows, np.argsort(place[windows], axis=1), axis=1)
        orphans = order[is_orphan]
        by_arrival = np.argsort(np.concatenate([last, orphans]), kind="stable")
        rows = np.concatenate([rows, np.repeat(orphans[:, None], n, axis=1)])[by_arrival]
        return Pairs(rows, by_arrival < len(last), order[late], np.sort(order[waiting]), order[soon & is_orphan])

    def _find_begun(self, shared: Indices, place: Places) -> Flags:
        """Return (m,) bool: all members that precede this one in the given order stand right before it."""
        at = np.arange(len(place))
        follows = np.zeros(len(place), bool)
        follows[1:] = (place[1:] == place[:-1] + 1) & (shared[1:] == shared[:-1])
        chain = np.maximum.accumulate(np.where(follows, 0, at))  # where the chain of each begins
        return (place < self._n) & (at - place >= chain)

    def _trust(self, starts: Indices, out_of_time: Flags, doubtful: Flags) -> tuple[Indices, Indices]:
        """Divide cycles, given by their first rows, into trusted ones and those whose frames came out of time."""
        out, doubts = (np.append(0, np.cumsum(flags)) for flags in (out_of_time, doubtful))
        untrusted = out[starts + self._n] > out[starts]
        untrusted |= doubts[starts + self._n] - doubts[starts] == self._n
        return starts[~untrusted], starts[untrusted]

    def _find_cycles(
        self, shared: Indices, place: Places, out_of_time: Flags, doubtful: Flags
    ) -> tuple[Indices, Indices]:
        """Return first rows of runs of n frames that are a whole cycle, if the order is not given; they can overlap.

        Returns:
            Trusted ones, and those whose frames came out of time.
        """
        n = self._n
        m = max(0, len(shared) - n + 1)
        whole = np.ones(m, bool)
        seen = np.zeros(m, np.uint32)
        for j in range(n):
            whole &= shared[j : m + j] == shared[:m]
            seen |= np.left_shift(np.uint32(1), place[j : m + j].astype(np.uint32))
        whole &= seen == (1 << n) - 1
        if self._cycle.order == "ends_with":
            whole &= place[n - 1 : m + n - 1] == n - 1
        return self._trust(np.flatnonzero(whole), out_of_time, doubtful)

    def _apart(self, starts: Indices) -> Indices:
        if len(starts) < 2 or np.diff(starts).min() >= self._n:
            return starts
        chosen: list[int] = []
        for start in starts.tolist():
            if not chosen or start >= chosen[-1] + self._n:
                chosen.append(start)
        return np.array(chosen, np.int64)

    def _still_hoping(self, shared: Indices, place: Places, ends: Indices, used: npt.NDArray[np.bool_]) -> Indices:
        """Return rows at the end of each group that may become a cycle with the next frames, in any order."""
        n = self._n
        ends = ends[(place[ends] < n) & ~used[ends]]
        if not len(ends):
            return np.zeros(0, np.int64)
        keep = np.zeros(len(shared), bool)
        for length in range(n - 1, 0, -1):
            first = ends - length + 1
            fits = first >= 0
            seen = np.zeros(len(ends), np.uint32)
            for j in range(length):
                at = np.maximum(first + j, 0)
                fits &= (shared[at] == shared[ends]) & ~used[at] & (place[at] < n)
                bit = np.left_shift(np.uint32(1), place[at].astype(np.uint32))
                fits &= (seen & bit) == 0
                seen |= bit
            for start in first[fits].tolist():
                keep[start : start + length] = True
            ends = ends[~fits]
        return np.flatnonzero(keep)
