"""Follow contacts from frame to frame: identities that last through gaps, splits and crossings."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.tactile.meetings import EXCHANGED, Meetings, Tracks, fit_bells

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
Flags = npt.NDArray[np.bool_]

_STRONG, _WEAK, _LEFT, _NEAR = 5.0, 1.5, 0.3, 0.1
"""Gains of a pair that shares half of the smaller one's taxels, any, is what was left behind, or is near: one of the
first two outweighs two of the next."""
_REST = 0.2
"""Share of its load below which a contact may be what a faster one left behind."""
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
_NOISE_PITCHES = 0.3
"""Pitches: standard deviation of the centre of a contact of one taxel."""
_NEW_M_S, _MOST_NEW, _MOST_FAST = 1.0, 8, 32
"""m/s: spread of the velocity of a new contact. Where more begin in a frame, or more are followed, none is so
fast."""
_ACCELERATION_M_S2, _MANOEUVRE_S = 0.5, 0.1
"""m/s2: spread of the acceleration of a slow contact. That of a fast one changes its velocity in this time, s."""
_MOST_WITHIN, _MOST_TAXELS = 4, 400
"""Tracks that a blob carries at most, and taxels of the largest blob that carries more than one."""
_FAINT = 0.25
"""A track in a blob has gone if less than this share of its peak is left."""
_PITCH_M = 0.0065
"""m: pitch of taxels whose places are not known."""
_REACH_PITCHES, _GATE = 2.3, 2.5
"""Pitches, or standard deviations of the expected place, by which a contact may miss it without sharing a taxel. 2.3 is
a bit more than the second ring of neighbours."""
_SETS_OFF_M_S, _FROM_PITCHES = 0.2, 1.5
"""m/s, and pitches: a new contact at least so fast that comes from so near where one has just gone is the same."""
_SURPRISE = 3.0
"""Standard deviations of a miss that is a change of the velocity."""
_SHORTEST_S = 1e-3
_NARROWEST_PITCHES = 0.35
"""Pitches: width of a contact that only one taxel feels."""
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
        frames: in how many frames it must be seen before it is a contact.
        patience_s: how long an identity is kept while its contact is gone, s.
        pitch_m: pitch of the taxels, m; None: that of their places. A contact may be 2.3 pitches from its expected
            place; one expected to move farther than a pitch in a frame is judged by its place first.
        velocity_s: time constant of the velocity, and of the steady load, s.
        touch_s: how long a contact is a touch, s.
        sliding_m_s: speed from which it is sliding, until it falls below half of it, m/s.
        steady: share by which the load of a sliding contact may differ from its steady load.
    """

    frames: int = 2
    patience_s: float = 0.06
    pitch_m: float | None = None
    velocity_s: float = 0.1
    touch_s: float = 0.3
    sliding_m_s: float = 0.005
    steady: float = 0.25


@dataclass(frozen=True, eq=False)
class Blobs:
    """The m blobs of touched taxels of a frame.

    Attributes:
        taxels: (a,) int64, the taxels of all of them.
        blob: (a,) int64, the blob of each.
        value: (a,) the value of each.
        load, peak: (m,) sum and maximum of the values of each blob.
        frame: (m,) int64, number of its coordinate frame, -1 for none.
        cop_m: (m, 3) m, its centre; NaN if it is not known.
    """

    taxels: Whole
    blob: Whole
    value: Floats
    load: Floats
    peak: Floats
    frame: Whole
    cop_m: Floats


_TRACK = np.dtype(
    [
        ("key", "i8"),  # never given to another track
        ("id", "i8"),  # 0: no contact yet
        ("born_ns", "i8"),
        ("gone_ns", "i8"),  # when it went; 0 while it is there
        ("seen_ns", "i8"),
        ("frames", "i8"),  # in which it was seen
        ("steps", "i8"),  # number of moves in the velocity
        ("size", "i8"),
        ("frame", "i8"),
        ("home", "i8"),  # its blob; -1 if it has gone
        ("kind", "i8"),
        ("place", "f8", 3),  # and velocity, filtered, to expect the next one
        ("pace", "f8", 3),
        ("spread", "f8", 3),  # variances of place, of place and velocity, of velocity
        ("found", "f8", 3),  # where it was in this frame
        ("velocity", "f8", 3),  # as published
        ("motion", "f8", 3),  # the same, smoothed once more, so that noise does not look like sliding
        ("now", "f8"),  # load of this frame
        ("height", "f8"),  # peak of this frame
        ("load", "f8"),  # smoothed
        ("peak", "f8"),  # smoothed
        ("width", "f8"),  # smoothed
        ("shared", "?"),  # its blob has other tracks, too
        ("jumps", "?"),  # its centre may have moved because contacts merged or split
        ("noise", "f8"),  # variance of the place that was found
    ]
)


class Tracked(NamedTuple):
    """The history of the m blobs of a frame.

    Attributes:
        id: (m,) int64, from 1 on; numbers repeat only after 2**32; 0: not a contact yet.
        age_s: (m,) s.
        velocity_m_s: (m, 3) m/s, NaN where the centre is not known.
        kind: (m,) int64, :class:`ContactKind`.
    """

    id: Whole
    age_s: Floats
    velocity_m_s: Floats
    kind: Whole


_NOTHING = Tracked(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64))


class Tracker:
    """Gives contacts their identities, frame by frame.

    A blob in which contacts have merged carries the tracks of all of them.

    Args:
        position_m: (n, 3) m, places of the taxels.
        pitch_m: of the taxels, m; NaN if it is not known.
        settings: default: those of the class.
    """

    def __init__(self, position_m: Floats, pitch_m: float, settings: TrackingSettings | None = None) -> None:
        self._settings = settings = settings or TrackingSettings()
        self._position_m = position_m
        self._pitch_m = settings.pitch_m or (pitch_m if pitch_m > 0 else _PITCH_M)
        self._tracks: Tracks = np.zeros(0, _TRACK)
        self._track_of = np.full(len(position_m), -1, np.int64)
        self._taxels = np.zeros(0, np.int64)  # that have a track
        self._meetings = Meetings(self._pitch_m)
        self._last_id = self._last_key = 0
        self._time_ns: int | None = None

    @property
    def track_of(self) -> Whole:
        """(n,) the track that each taxel was last in; -1: none."""
        return self._track_of

    def follow(self, blobs: Blobs, time_ns: int) -> Tracked:
        """Return the identities of the blobs of the next frame, and how they move."""
        self._forget(time_ns)
        before, size = self._tracks, np.bincount(blobs.blob, minlength=len(blobs.load))
        if not len(before) and not len(size):
            return _NOTHING
        expected = _expected(before, time_ns)
        overlap = self._overlap(blobs, size)
        home = np.full(len(before), -1)
        known, found = assign(self._gains(overlap, expected, blobs))
        home[known] = found
        self._join(home, overlap, expected, blobs, size)
        self._meetings.begin(before, expected["place"], time_ns)
        is_joined = overlap >= 0.5
        expected["jumps"] = is_joined.sum(axis=1) > 1
        expected["jumps"][home >= 0] |= is_joined.sum(axis=0)[home[home >= 0]] > 1
        expected["home"] = home
        tracks = self._with_new(expected, blobs, time_ns)
        tracks["shared"] = _is_shared(tracks["home"])
        self._find(tracks, blobs, size, time_ns)
        self._move(tracks, before)
        self._judge(tracks, before, time_ns)
        self._meetings.end(tracks, time_ns)
        self._resume(tracks)
        self._keep(tracks, blobs, time_ns)
        return self._tracked(tracks, time_ns)

    def _forget(self, time_ns: int) -> None:
        """Drop the identities whose contacts have been gone for too long."""
        tracks = self._tracks
        period_ns = 0 if self._time_ns is None else max(0, time_ns - self._time_ns)
        self._time_ns = time_ns
        # half a period more: at 50 Hz, 60 ms are three frames, also with jitter
        patience_ns = self._settings.patience_s * NS_PER_S + period_ns / 2
        keep = (tracks["gone_ns"] == 0) | (time_ns - tracks["gone_ns"] <= patience_ns)
        if not keep.all():
            number = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)
            self._tracks = tracks[keep]
            self._track_of[self._taxels] = number[self._track_of[self._taxels]]

    def _overlap(self, blobs: Blobs, size: Whole) -> Floats:
        """(tracks, m): shared taxels of each pair, as a share of the smaller one."""
        tracks, track = self._tracks, self._track_of[blobs.taxels]
        is_known = track >= 0
        pair = track[is_known] * len(size) + blobs.blob[is_known]
        shared = np.bincount(pair, minlength=len(tracks) * len(size)).reshape(len(tracks), len(size))
        overlap: Floats = shared / np.maximum(np.minimum(tracks["size"][:, None], size), 1)
        return overlap

    def _gains(self, overlap: Floats, expected: Tracks, blobs: Blobs) -> Gains:
        """(tracks, m): the gain of each pair; 0: they cannot be the same."""
        tracks = self._tracks
        away = expected["place"][:, None] - blobs.cop_m
        squares = np.einsum("ijk,ijk->ij", away, away)
        way_m = np.sqrt(((expected["place"] - tracks["place"]) ** 2).sum(axis=1))
        reach_m = _DOUBT * _known(way_m) + _REACH_PITCHES * self._pitch_m
        if len(tracks) <= _MOST_FAST:
            reach_m = np.fmax(reach_m, _DOUBT * way_m + _GATE * np.sqrt(expected["spread"][:, 0]))
        misses = squares / (reach_m**2)[:, None]
        is_near = (misses <= 1) & (tracks["frame"][:, None] == blobs.frame)
        by_place = (way_m > self._pitch_m) | tracks["shared"]
        is_sharing = (overlap > 0) & ~(by_place & is_near.any(axis=1))[:, None]
        is_rest = blobs.load < _REST * tracks["load"][:, None]
        sharing = np.where(is_rest, _LEFT, np.where(overlap >= 0.5, _STRONG, _WEAK)) + _CLOSENESS * overlap
        sharing += _PREFERENCE * (1 - _rank(tracks["born_ns"])[:, None] + _rank(blobs.load))
        near = _NEAR + _NEARNESS * (1 - misses) + _PRESENCE * (tracks["gone_ns"] == 0)[:, None]
        return np.where(is_sharing, sharing, np.where(is_near, near, 0.0))

    def _join(self, home: Whole, overlap: Floats, expected: Tracks, blobs: Blobs, size: Whole) -> None:
        """Put tracks that found no blob of their own into that of another."""
        lost = np.flatnonzero((home < 0) & (expected["frames"] > 1) & np.isfinite(expected["place"][:, 0]))
        if not len(lost) or not len(size) or len(lost) > _MOST_NEW:
            return
        within = np.bincount(home[home >= 0], minlength=len(size))
        position = self._position_m[blobs.taxels]
        for track in lost.tolist():
            squares = ((position - expected["place"][track]) ** 2).sum(axis=1)
            nearest = int(squares.argmin())
            blob = int(blobs.blob[nearest])
            if squares[nearest] > self._pitch_m**2:
                blob = int(overlap[track].argmax())
                if overlap[track, blob] < 0.5:
                    continue
            if (
                blobs.frame[blob] == expected["frame"][track]
                and within[blob] < _MOST_WITHIN
                and size[blob] <= _MOST_TAXELS
            ):
                home[track] = blob
                within[blob] += 1

    def _with_new(self, tracks: Tracks, blobs: Blobs, time_ns: int) -> Tracks:
        """The tracks, and new ones of the blobs that have none."""
        has_track = np.zeros(len(blobs.load), bool)
        has_track[tracks["home"][tracks["home"] >= 0]] = True
        if has_track.all():
            return tracks
        new = np.flatnonzero(~has_track)
        begun = np.zeros(len(new), _TRACK)
        begun["key"] = self._last_key + 1 + np.arange(len(new))
        self._last_key += len(new)
        begun["home"], begun["born_ns"], begun["frame"] = new, time_ns, blobs.frame[new]
        begun["place"], begun["kind"] = blobs.cop_m[new], int(ContactKind.TOUCH)
        begun["velocity"] = np.where(np.isnan(blobs.cop_m[new]), np.nan, 0.0)
        begun["spread"] = np.inf, 0.0, (_NEW_M_S if len(new) <= _MOST_NEW else 0.0) ** 2
        return np.concatenate([tracks, begun])

    def _find(self, tracks: Tracks, blobs: Blobs, size: Whole, time_ns: int) -> None:
        """Measure where each track is in this frame, and correct what was expected of it."""
        pitch_m, home = self._pitch_m, tracks["home"]
        alone = np.flatnonzero((home >= 0) & ~tracks["shared"])
        blob = home[alone]
        tracks["found"][alone], tracks["noise"][alone] = blobs.cop_m[blob], (_NOISE_PITCHES * pitch_m) ** 2 / size[blob]
        tracks["now"][alone], tracks["height"][alone] = blobs.load[blob], blobs.peak[blob]
        elsewhere = alone[tracks["frame"][alone] != blobs.frame[blob]]
        tracks["place"][elsewhere], tracks["pace"][elsewhere] = tracks["found"][elsewhere], 0.0
        tracks["frame"][alone], tracks["size"][alone] = blobs.frame[blob], size[blob]
        jumping = alone[tracks["jumps"][alone]]
        tracks["place"][jumping] = tracks["found"][jumping]
        _correct(tracks, alone, time_ns)
        for one in set(home[tracks["shared"]].tolist()):
            self._tell_apart(tracks, np.flatnonzero(home == one), blobs, time_ns)
        here = np.flatnonzero(tracks["home"] >= 0)
        tracks["seen_ns"][here], tracks["gone_ns"][here] = time_ns, 0
        tracks["frames"][here] += 1

    def _tell_apart(self, tracks: Tracks, rows: Whole, blobs: Blobs, time_ns: int) -> None:
        """Find the tracks that share a blob, each with its own bell."""
        within = np.flatnonzero(blobs.blob == tracks["home"][rows[0]])
        fitted = fit_bells(
            blobs.value[within],
            self._position_m[blobs.taxels[within]],
            tracks["place"][rows],
            tracks["spread"][rows, 0],
            tracks["height"][rows],
            tracks["width"][rows],
        )
        tracks["found"][rows], tracks["noise"][rows] = fitted.place, fitted.variance_m2
        tracks["height"][rows] = fitted.peak
        share = fitted.peak * tracks["width"][rows] ** 2
        tracks["now"][rows] = blobs.load[tracks["home"][rows[0]]] * share / share.sum()
        tracks["size"][rows] = np.maximum(1, np.round(len(within) * share / share.sum()))
        tracks["jumps"][rows] = False
        _correct(tracks, rows, time_ns)
        is_faint = fitted.peak < _FAINT * tracks["peak"][rows]
        is_faint[fitted.peak.argmax()] = False
        tracks["home"][rows[is_faint]] = -1

    def _move(self, tracks: Tracks, before: Tracks) -> None:
        """Update the velocities that are published; they stay where contacts merge or split, as their centres jump."""
        known = np.arange(len(before))
        passed_s = (tracks["seen_ns"][known] - before["seen_ns"]) / NS_PER_S
        moved = (tracks["home"][known] >= 0) & (passed_s > 0) & (tracks["frame"][known] == before["frame"])
        moved &= (tracks["shared"][known] == before["shared"]) & ~tracks["jumps"][known]
        known, passed_s = known[moved], passed_s[moved]
        velocity = (tracks["found"][known] - before["found"][known]) / passed_s[:, None]
        tracks["steps"][known] += 1
        weight = np.maximum(-np.expm1(-passed_s / self._settings.velocity_s), 1 / tracks["steps"][known])[:, None]
        was = _known(tracks["velocity"][known])
        tracks["velocity"][known] = was + weight * (velocity - was)

    def _judge(self, tracks: Tracks, before: Tracks, time_ns: int) -> None:
        """Update what is smoothed, and the kinds."""
        settings, pitch_m = self._settings, self._pitch_m
        here = np.flatnonzero(tracks["home"] >= 0)
        now = tracks[here]
        passed_s = np.zeros(len(here))
        known = here < len(before)
        passed_s[known] = np.maximum(time_ns - before["seen_ns"][here[known]], 0) / NS_PER_S
        is_new = now["frames"] == 1
        weight = np.where(is_new, 1.0, -np.expm1(-passed_s / settings.velocity_s))
        now["load"] += weight * (now["now"] - now["load"])
        alone = np.maximum(weight, 1 / now["frames"]) * ~now["shared"]
        now["peak"] += alone * (now["height"] - now["peak"])
        width = pitch_m * np.sqrt(now["now"] / (2 * np.pi * np.maximum(now["height"], 1e-9)))
        now["width"] += alone * (np.maximum(width, _NARROWEST_PITCHES * pitch_m) - now["width"])
        calm = -np.expm1(-passed_s / (_CALM * settings.velocity_s))[:, None]
        now["motion"] += calm * (_known(now["velocity"]) - now["motion"])
        is_steady = abs(now["now"] - now["load"]) <= settings.steady * now["load"]
        slowest = np.where(now["kind"] == ContactKind.SLIDING, settings.sliding_m_s / 2, settings.sliding_m_s)
        is_sliding = is_steady & (np.linalg.norm(now["motion"], axis=1) >= slowest)
        is_old = time_ns - now["born_ns"] >= settings.touch_s * NS_PER_S
        now["kind"] = np.where(is_old, np.where(is_sliding, ContactKind.SLIDING, ContactKind.HOLD), ContactKind.TOUCH)
        tracks[here] = now

    def _resume(self, tracks: Tracks) -> None:
        """Give a contact that begins at speed the identity of one that has just gone where it comes from."""
        enough = self._settings.frames
        new = np.flatnonzero((tracks["home"] >= 0) & (tracks["id"] == 0) & (tracks["frames"] == max(enough, 2)))
        gone = np.flatnonzero((tracks["home"] < 0) & (tracks["id"] > 0))
        if not 0 < len(new) * len(gone) <= _MOST_NEW**2:
            return
        pace, away = tracks["pace"][new][:, None], tracks["found"][new][:, None] - tracks["found"][gone]
        speed = (pace**2).sum(axis=2)
        since_s = np.clip((away * pace).sum(axis=2) / np.maximum(speed, 1e-12), 0, _LONGEST_GUESS_S)
        miss_m = np.linalg.norm(away - since_s[..., None] * pace, axis=2)
        close_m = _FROM_PITCHES * self._pitch_m
        could = (speed > _SETS_OFF_M_S**2) & (tracks["frame"][new][:, None] == tracks["frame"][gone])
        one, other = assign(np.where(could, close_m - miss_m, 0.0))
        for name in EXCHANGED:
            tracks[name][new[one]] = tracks[name][gone[other]]
        tracks["id"][gone[other]] = 0

    def _keep(self, tracks: Tracks, blobs: Blobs, time_ns: int) -> None:
        """Remember this frame, and the tracks whose contacts are gone."""
        is_gone = tracks["home"] < 0
        tracks["gone_ns"][is_gone & (tracks["gone_ns"] == 0)] = time_ns
        owner = np.full(len(blobs.load), -1)
        owner[tracks["home"][~is_gone]] = np.flatnonzero(~is_gone)
        of_taxel = owner[blobs.blob]
        shared = np.flatnonzero(tracks["shared"] & ~is_gone)
        if len(shared):
            within = np.flatnonzero(np.isin(blobs.blob, tracks["home"][shared]))
            away = self._position_m[blobs.taxels[within], None] - tracks["place"][shared]
            bell = np.log(tracks["height"][shared]) - (away**2).sum(axis=2) / (2 * tracks["width"][shared] ** 2)
            bell[blobs.blob[within, None] != tracks["home"][shared]] = -np.inf
            of_taxel[within] = shared[bell.argmax(axis=1)]
        track = self._track_of[self._taxels]
        left = self._taxels[(track >= 0) & is_gone[track]] if len(is_gone) else self._taxels[:0]
        left_by = self._track_of[left]
        self._track_of[self._taxels] = -1
        self._track_of[left] = left_by
        self._track_of[blobs.taxels] = of_taxel
        self._taxels = np.concatenate([left, blobs.taxels])
        self._tracks = tracks

    def _tracked(self, tracks: Tracks, time_ns: int) -> Tracked:
        """What is published: the identity of the oldest track of each blob, and the mean of their velocities."""
        here = np.flatnonzero(tracks["home"] >= 0)
        here = here[np.lexsort([tracks["key"][here], tracks["born_ns"][here], tracks["home"][here]])]
        home = tracks["home"][here]
        first = here[np.diff(home, prepend=-1) > 0]
        new = first[(tracks["id"][first] == 0) & (tracks["frames"][first] >= self._settings.frames)]
        tracks["id"][new] = (self._last_id + np.arange(len(new))) % _LAST_ID + 1
        self._last_id = (self._last_id + len(new) - 1) % _LAST_ID + 1 if len(new) else self._last_id
        velocity = tracks["velocity"][first]
        for blob in set(home[1:][np.diff(home) == 0].tolist()):
            rows = here[home == blob]
            velocity[blob] = np.average(tracks["velocity"][rows], axis=0, weights=np.maximum(tracks["now"][rows], 1e-9))
        return Tracked(
            tracks["id"][first], (time_ns - tracks["born_ns"][first]) / NS_PER_S, velocity, tracks["kind"][first]
        )


def _is_shared(home: Whole) -> Flags:
    """(tracks,) which of them share their blob with others."""
    count = np.bincount(home + 1, minlength=1)
    count[0] = 0
    shared: Flags = count[home + 1] > 1
    return shared


def _expected(tracks: Tracks, time_ns: int) -> Tracks:
    """The tracks as they are expected at a time: places and spreads go on with the velocities."""
    expected = tracks.copy()
    passed_s = np.clip((time_ns - tracks["seen_ns"]) / NS_PER_S, 0, _LONGEST_GUESS_S)
    pace = tracks["pace"]
    expected["place"] += passed_s[:, None] * pace
    change = (_ACCELERATION_M_S2 + np.sqrt((pace**2).sum(axis=1)) / _MANOEUVRE_S) * passed_s
    _, both, variance = tracks["spread"].T
    expected["spread"][:, 0] += passed_s * (2 * both + passed_s * (variance + change**2 / 4))
    expected["spread"][:, 1] += passed_s * (variance + change**2 / 2)
    expected["spread"][:, 2] += change**2
    return expected


def _known(numbers: Floats) -> Floats:
    """The numbers, 0 in place of NaN."""
    return np.where(np.isnan(numbers), 0.0, numbers)


def _correct(tracks: Tracks, rows: Whole, time_ns: int) -> None:
    """Take in where tracks were found, instead of where they were expected."""
    now = tracks[rows]
    passed_s = np.maximum((time_ns - now["seen_ns"]) / NS_PER_S, _SHORTEST_S)
    miss = now["found"] - now["place"]
    variance, both, pace = now["spread"].T
    is_new = np.isinf(variance)
    variance = np.where(is_new, 1.0, variance)  # m2: nothing is known
    squares = (miss**2).sum(axis=1)
    surprise = np.where((squares > _SURPRISE**2 * (variance + now["noise"])) & ~now["jumps"], squares, 0.0)
    variance, both, pace = variance + surprise, both + surprise / passed_s, pace + surprise / passed_s**2
    gain = variance / (variance + now["noise"])
    pull = np.where(now["jumps"], 0.0, both / (variance + now["noise"]))
    now["place"] += gain[:, None] * miss
    now["pace"] += pull[:, None] * _known(miss)
    pace += surprise / passed_s**2 - pull * both  # what changed once changes again
    now["spread"] = np.column_stack([gain * now["noise"], both * (1 - gain), pace])
    tracks[rows] = now


def _rank(numbers: Floats | Whole) -> Floats:
    """0 for the smallest to 1 for the largest."""
    rank = np.empty(len(numbers))
    rank[np.argsort(numbers, kind="stable")] = np.arange(len(numbers)) / max(len(numbers) - 1, 1)
    return rank
