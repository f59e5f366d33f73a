"""Follow contacts from frame to frame: identities that last through gaps, splits and crossings."""

from __future__ import annotations

import dataclasses
import enum
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S

Gains = npt.NDArray[np.float64]


def assign(gain: Gains) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Assign rows to columns, each at most once, so that the sum of gains is the largest.

    Args:
        gain: (r, c) gain of each pair; 0 or less: the pair is impossible.

    Returns:
        (p,) int64 rows, in ascending order, and (p,) int64, the column of each.
    """
    possible = gain > 0
    column_of = np.full(len(gain), -1, np.int64)
    is_clear = possible & (possible.sum(axis=1) == 1)[:, None] & (possible.sum(axis=0) == 1)
    row, column = np.nonzero(is_clear)
    column_of[row] = column
    rows = np.flatnonzero(possible.any(axis=1) & (column_of < 0))
    columns = np.flatnonzero((possible & ~is_clear).any(axis=0))
    if len(rows):
        cost = -np.maximum(gain[np.ix_(rows, columns)], 0.0)
        if len(rows) <= len(columns):
            column_of[rows] = columns[_cheapest(cost)]
        else:
            column_of[rows[_cheapest(cost.T)]] = columns
    row = np.flatnonzero(column_of >= 0)
    row = row[possible[row, column_of[row]]]
    return row, column_of[row]


def _cheapest(cost: Gains) -> npt.NDArray[np.int64]:
    """(r,) int64: a column for each of r rows (at most as many as columns), for the smallest sum.

    By shortest augmenting paths: each row joins along the path of exchanges that costs least. ``of_row`` and
    ``of_column`` are the dual prices, ``row_at`` is the row of each column; column 0 stands for the row that joins.
    """
    rows, columns = cost.shape
    of_row, of_column = np.zeros(rows + 1), np.zeros(columns + 1)
    row_at = np.zeros(columns + 1, np.int64)
    for new in range(1, rows + 1):
        row_at[0] = new
        column = 0
        distance = np.full(columns + 1, np.inf)
        before = np.zeros(columns + 1, np.int64)
        is_open = np.ones(columns + 1, bool)
        while column == 0 or row_at[column]:
            is_open[column] = False
            row = row_at[column]
            reached = cost[row - 1] - of_row[row] - of_column[1:]
            shorter = is_open[1:] & (reached < distance[1:])
            distance[1:][shorter] = reached[shorter]
            before[1:][shorter] = column
            column = int(np.where(is_open, distance, np.inf)[1:].argmin()) + 1
            step = distance[column]
            of_row[row_at[~is_open]] += step
            of_column[~is_open] -= step
            distance[is_open] -= step
        while column:
            row_at[column], column = row_at[before[column]], int(before[column])
    found = np.zeros(rows, np.int64)
    taken = np.flatnonzero(row_at[1:])
    found[row_at[1:][taken] - 1] = taken
    return found


Floats = npt.NDArray[np.float64]
Whole = npt.NDArray[np.int64]

_STRONG, _WEAK, _NEAR = 5.0, 1.5, 0.1
"""Gains of a pair that shares half of the smaller one's taxels, any, or is near: one outweighs two of the next."""
_PREFERENCE = 0.2
"""Gain of the oldest track, and of the largest contact. All pairs of a track have it, so it only decides which is left
out: the younger identity where contacts merge, the smaller part where one splits."""
_CLOSENESS = 0.001
"""Gain of a pair that shares all taxels: it decides between pairs of the same kind, never against a preference."""
_NEARNESS, _PRESENCE = 0.4, 0.2
"""Gains of a contact just where it was expected, and of one that was there in the last frame. They count where no
taxels are shared, or the contact is so fast that shared taxels mean nothing."""
_DOUBT = 0.5
"""Share of its expected way by which a contact may miss the expected place."""
_LONGEST_GUESS_S = 0.1
"""Seconds for which a velocity is extrapolated."""
_CALM = 3.0
"""Time constant of the motion that is judged as sliding, in multiples of ``velocity_s``."""
_LAST_ID = (1 << 32) - 1


class ContactKind(enum.IntEnum):
    """The behaviour of a contact."""

    TOUCH = 0
    """It has just begun: a tap, if it ends now."""
    HOLD = 1
    """It rests, or its load changes."""
    SLIDING = 2
    """Its centre moves while its load is steady."""


@dataclass(frozen=True)
class TrackingSettings:
    """Settings of the tracking of contacts.

    Attributes:
        patience_s: how long an identity is kept while its contact is gone, s.
        reach_m: how far a contact may be from its expected place without sharing a taxel, m.
        fast_m: a contact expected to move farther in a frame is judged by its place first, m.
        velocity_s: time constant of the velocity, and of the steady load, s.
        touch_s: how long a contact is a touch, s.
        sliding_m_s: speed from which it is sliding, until it falls below half of it, m/s.
        steady: share by which the load of a sliding contact may differ from its steady load.
    """

    patience_s: float = 0.06
    reach_m: float = 0.015
    fast_m: float = 0.0065
    velocity_s: float = 0.1
    touch_s: float = 0.3
    sliding_m_s: float = 0.005
    steady: float = 0.25


@dataclass(frozen=True, eq=False)
class Places:
    """The places of the m contacts of a frame.

    Attributes:
        taxels: (a,) int64, the taxels of all of them.
        contact: (a,) int64, the contact of each.
        load: (m,) load of each contact.
        frame: (m,) int64, number of its coordinate frame, -1 for none.
        cop_m: (m, 3) m, its centre; NaN if it is not known.
    """

    taxels: Whole
    contact: Whole
    load: Floats
    frame: Whole
    cop_m: Floats


@dataclass(frozen=True, eq=False)
class _Tracks:
    """All identities: those of the newest frame in its order, then those whose contacts are gone."""

    id: Whole
    born_ns: Whole
    gone_ns: Whole
    """When the contact went; 0 while it is there."""
    seen_ns: Whole
    size: Whole
    frame: Whole
    cop_m: Floats
    velocity_m_s: Floats
    steps: Whole
    """Number of moves in the velocity."""
    load: Floats
    """Smoothed."""
    motion_m_s: Floats
    """The velocity, smoothed once more, so that noise does not look like sliding."""
    kind: Whole

    def __getitem__(self, rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> _Tracks:
        return _Tracks(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    def and_then(self, others: _Tracks) -> _Tracks:
        pairs = ((getattr(self, field.name), getattr(others, field.name)) for field in dataclasses.fields(self))
        return _Tracks(*(np.concatenate(pair) for pair in pairs))


class Tracked(NamedTuple):
    """The history of the m contacts of a frame.

    Attributes:
        id: (m,) int64, from 1 on; numbers repeat only after 2**32.
        age_s: (m,) s.
        velocity_m_s: (m, 3) m/s, NaN where the centre is not known.
        kind: (m,) int64, :class:`ContactKind`.
    """

    id: Whole
    age_s: Floats
    velocity_m_s: Floats
    kind: Whole


class Tracker:
    """Gives contacts their identities, frame by frame.

    Args:
        n: number of taxels.
        settings: default: those of the class.
    """

    def __init__(self, n: int, settings: TrackingSettings | None = None) -> None:
        self._settings = settings or TrackingSettings()
        none, nowhere = np.zeros(0, np.int64), np.zeros((0, 3))
        self._tracks = _Tracks(none, none, none, none, none, none, nowhere, nowhere, none, np.zeros(0), nowhere, none)
        self._track_of = np.full(n, -1, np.int64)
        self._last_id = 0
        self._time_ns: int | None = None

    def follow(self, places: Places, time_ns: int) -> Tracked:
        """Return the identities of the contacts of the next frame, and how they move."""
        self._forget(time_ns)
        tracks, size = self._tracks, np.bincount(places.contact, minlength=len(places.load))
        track = self._track_of[places.taxels]
        is_known = track >= 0
        pair = track[is_known] * len(size) + places.contact[is_known]
        shared = np.bincount(pair, minlength=len(tracks.id) * len(size)).reshape(len(tracks.id), len(size))
        overlap = shared / np.maximum(np.minimum(tracks.size[:, None], size), 1)
        passed_s = np.minimum((time_ns - tracks.seen_ns) / NS_PER_S, _LONGEST_GUESS_S)
        expected_m = tracks.velocity_m_s * passed_s[:, None]
        known, found = assign(self._gains(overlap, expected_m, places))
        now = _Tracks(
            id=np.zeros(len(size), np.int64),
            born_ns=np.full(len(size), time_ns),
            gone_ns=np.zeros(len(size), np.int64),
            seen_ns=np.full(len(size), time_ns),
            size=size,
            frame=places.frame,
            cop_m=places.cop_m,
            velocity_m_s=np.where(np.isnan(places.cop_m), np.nan, 0.0),
            steps=np.zeros(len(size), np.int64),
            load=places.load.copy(),
            motion_m_s=np.zeros((len(size), 3)),
            kind=np.full(len(size), int(ContactKind.TOUCH)),
        )
        now.id[found], now.born_ns[found] = tracks.id[known], tracks.born_ns[known]
        for row in np.flatnonzero(now.id == 0).tolist():
            self._last_id = self._last_id % _LAST_ID + 1
            now.id[row] = self._last_id
        is_joined = overlap >= 0.5
        is_whole = (is_joined.sum(axis=1)[known] <= 1) & (is_joined.sum(axis=0)[found] <= 1)
        self._move(now, found, known, is_whole)
        self._judge(now, found, known, places.load, time_ns)
        self._keep(now, places, known, time_ns)
        return Tracked(now.id, (time_ns - now.born_ns) / NS_PER_S, now.velocity_m_s, now.kind)

    def _forget(self, time_ns: int) -> None:
        """Drop the identities whose contacts have been gone for too long."""
        tracks = self._tracks
        period_ns = 0 if self._time_ns is None else max(0, time_ns - self._time_ns)
        self._time_ns = time_ns
        # half a period more: at 50 Hz, 60 ms are three frames, also with jitter
        patience_ns = self._settings.patience_s * NS_PER_S + period_ns / 2
        keep = (tracks.gone_ns == 0) | (time_ns - tracks.gone_ns <= patience_ns)
        if not keep.all():
            number = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)
            self._tracks, self._track_of = tracks[keep], number[self._track_of]

    def _gains(self, overlap: Floats, expected_m: Floats, places: Places) -> Gains:
        """(tracks, m): the gain of each pair; 0: they cannot be the same."""
        tracks, settings = self._tracks, self._settings
        away_m = np.linalg.norm((tracks.cop_m + expected_m)[:, None] - places.cop_m, axis=2)
        way_m = np.nan_to_num(np.linalg.norm(expected_m, axis=1))[:, None]
        reach_m = settings.reach_m + _DOUBT * way_m
        is_near = (away_m <= reach_m) & (tracks.frame[:, None] == places.frame)
        is_fast = way_m > settings.fast_m
        nearness = np.where(is_near, 1 - (away_m / reach_m) ** 2, 0.0)
        is_sharing = (overlap > 0) & ~(is_fast & is_near)
        sharing = np.where(overlap >= 0.5, _STRONG, _WEAK) + _CLOSENESS * overlap
        sharing += _PREFERENCE * (1 - _rank(tracks.born_ns)[:, None] + _rank(places.load))
        near = _NEAR + _NEARNESS * nearness + _PRESENCE * (tracks.gone_ns == 0)[:, None]
        return np.where(is_sharing, sharing, np.where(is_near, near, 0.0))

    def _move(self, now: _Tracks, found: Whole, known: Whole, is_whole: npt.NDArray[np.bool_]) -> None:
        """Update velocities; they stay where contacts merge or split, as their centres jump."""
        tracks = self._tracks
        now.velocity_m_s[found], now.steps[found] = tracks.velocity_m_s[known], tracks.steps[known]
        passed_s = (now.seen_ns[found] - tracks.seen_ns[known]) / NS_PER_S
        moved = is_whole & (passed_s > 0) & (tracks.frame[known] == now.frame[found])
        found, known, passed_s = found[moved], known[moved], passed_s[moved]
        velocity = (now.cop_m[found] - tracks.cop_m[known]) / passed_s[:, None]
        now.steps[found] += 1
        weight = np.maximum(1 - np.exp(-passed_s / self._settings.velocity_s), 1 / now.steps[found])[:, None]
        before = np.nan_to_num(now.velocity_m_s[found])
        now.velocity_m_s[found] = before + weight * (velocity - before)

    def _judge(self, now: _Tracks, found: Whole, known: Whole, load: Floats, time_ns: int) -> None:
        tracks, settings = self._tracks, self._settings
        passed_s = np.maximum(now.seen_ns[found] - tracks.seen_ns[known], 0) / NS_PER_S
        was, motion = tracks.load[known], tracks.motion_m_s[known]
        now.load[found] = was + (load[found] - was) * -np.expm1(-passed_s / settings.velocity_s)
        weight = -np.expm1(-passed_s / (_CALM * settings.velocity_s))[:, None]
        now.motion_m_s[found] = motion + weight * (np.nan_to_num(now.velocity_m_s[found]) - motion)
        is_steady = abs(load - now.load) <= settings.steady * now.load
        slowest = np.full(len(load), settings.sliding_m_s)
        slowest[found[tracks.kind[known] == ContactKind.SLIDING]] /= 2
        is_sliding = is_steady & (np.linalg.norm(now.motion_m_s, axis=1) >= slowest)
        is_old = time_ns - now.born_ns >= settings.touch_s * NS_PER_S
        now.kind[is_old] = np.where(is_sliding, ContactKind.SLIDING, ContactKind.HOLD)[is_old]

    def _keep(self, now: _Tracks, places: Places, known: Whole, time_ns: int) -> None:
        """Remember this frame, and the identities whose contacts are gone."""
        tracks = self._tracks
        is_gone = np.ones(len(tracks.id), bool)
        is_gone[known] = False
        gone = tracks[is_gone]
        gone.gone_ns[gone.gone_ns == 0] = time_ns
        number = np.append(np.where(is_gone, len(now.id) + np.cumsum(is_gone) - 1, -1), -1)
        self._track_of = number[self._track_of]
        self._track_of[places.taxels] = places.contact
        self._tracks = now.and_then(gone)


def _rank(numbers: Floats | Whole) -> Floats:
    """0 for the smallest to 1 for the largest."""
    rank = np.zeros(len(numbers))
    rank[np.argsort(numbers, kind="stable")] = np.linspace(0, 1, len(numbers)) if len(numbers) else 0.0
    return rank
