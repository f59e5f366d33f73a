"""Follow contacts from frame to frame: identities that last through gaps, splits and crossings."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from skinware.realtime import NS_PER_S
from skinware.tactile.arrays import Arrays, Doubles, Flags, Whole
from skinware.tactile.meetings import Meetings, fit_bells, resume
from skinware.tactile.tracks import TRACK, TouchedBlobs, Tracks, assign, correct, expected_at, judge, move

_STRONG, _WEAK, _LEFT, _NEAR = 5.0, 1.5, 0.3, 0.1
"""Gains of a pair that shares half of the smaller one's taxels, any, is what was left behind, or is near: one of the
first two outweighs two of the next."""
_REST = 0.2  # share of its load below which a contact may be what a faster one left behind
_PREFERENCE = 0.2
"""Gain of the oldest track, and of the largest contact. All pairs of a track have it, so it only decides which is left
out: the younger identity where contacts merge, the smaller part where one splits."""
_CLOSENESS = 0.001
"""Gain of a pair that shares all taxels: it decides between pairs of the same kind, never against a preference."""
_NEARNESS, _PRESENCE = 0.4, 0.2
"""Gains of a contact just where it was expected, and of one that was there in the last frame. They count where no
taxels are shared, or the contact is so fast that shared taxels mean nothing."""
_DOUBT = 0.5  # share of its expected way by which a contact may miss the expected place
_NOISE_PITCHES = 0.3  # pitches: standard deviation of the centre of a contact of one taxel
_NEW_M_S, _MOST_NEW, _MOST_FAST = 1.0, 8, 32
"""m/s: spread of the velocity of a new contact. Where more begin in a frame, or more are followed, none is fast."""
_MOST_WITHIN, _MOST_TAXELS = 4, 400
"""Tracks that a blob carries at most, and taxels of the largest blob that carries more than one."""
_FAINT = 0.25  # a track in a blob has gone if less than this share of its peak is left, and its load is missing
_PARTS_M_S = 2.0  # speed at which a contact of a blob may set off
_PITCH_M = 0.0065  # m: pitch of taxels whose places are not known
_REACH_PITCHES, _GATE = 2.3, 2.5
"""Pitches, or standard deviations of the expected place, by which a contact may miss it without sharing a taxel. 2.3 is
a bit more than the second ring of neighbours."""
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
        frames: in how many frames it must be clear, by 4 times the uncertainty of a value, before it is a contact.
        patience_s: how long an identity is kept while its contact is gone, s.
        pitch_m: pitch of the taxels, m; None: that of their places. A contact may be 2.3 pitches from its expected
            place; one expected to move farther than a pitch in a frame is judged by its place first.
        velocity_s: time constant of the velocity, and of the steady load, s.
        touch_s: how long a contact is a touch, and after which it needs not be clear, s.
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


_NOTHING = {
    **{name: np.zeros(0, np.int64) for name in ("id", "kind")},
    "age_s": np.zeros(0),
    "velocity_m_s": np.zeros((0, 3)),
    "provisional": np.zeros(0, bool),
}


class Tracker:
    """Gives contacts their identities, frame by frame. A blob in which contacts have merged carries the tracks of all.

    Args:
        position_m: (n, 3) m, places of the taxels.
        pitch_m: of the taxels, m; NaN if it is not known.
        settings: default: those of the class.

    Attributes:
        track_of: (n,) int64, the track that each taxel was last in; -1: none.
    """

    def __init__(self, position_m: Doubles, pitch_m: float, settings: TrackingSettings | None = None) -> None:
        self._settings = settings = settings or TrackingSettings()
        self._position_m = position_m
        self._pitch_m = settings.pitch_m or (pitch_m if pitch_m > 0 else _PITCH_M)
        names = ("velocity_s", "touch_s", "sliding_m_s", "steady")
        self._judged_by = np.array([*(getattr(settings, name) for name in names), self._pitch_m])
        self._tracks: Tracks = np.zeros(0, TRACK)
        self.track_of: Whole = np.full(len(position_m), -1, np.int64)
        self._taxels = np.zeros(0, np.int64)  # that have a track
        self._meetings = Meetings(self._pitch_m)
        self._last_id = self._last_key = 0
        self._time_ns: int | None = None

    def rests(self, time_ns: int) -> bool:
        """Take a frame without blobs, if no contact is followed; return whether that is so."""
        if len(self._tracks):
            return False
        self._time_ns = time_ns
        return True

    def follow(self, blobs: TouchedBlobs, time_ns: int) -> Arrays:
        """Return the history of the m blobs of the next frame, by name: arrays (m, ...).

        ``id`` counts from 1 on, and repeats only after 2**32; 0: not a contact yet. ``velocity_m_s`` is (m, 3), NaN
        where the centre is not known; a ``provisional`` contact was never touched for sure.
        """
        self._forget(time_ns)
        before, size = self._tracks, np.bincount(blobs.blob, minlength=len(blobs.load))
        if not len(before) and not len(size):
            return _NOTHING
        expected = expected_at(before, time_ns)
        track = self.track_of[blobs.taxels]
        pair = track[track >= 0] * len(size) + blobs.blob[track >= 0]
        shared = np.bincount(pair, minlength=len(before) * len(size)).reshape(len(before), len(size))
        overlap = shared / np.maximum(np.minimum(before["size"][:, None], size), 1)  # as a share of the smaller one
        home = self._homes(overlap, expected, blobs, size, time_ns)
        self._meetings.begin(before, expected["place"], time_ns)
        is_joined = overlap >= 0.5
        expected["jumps"] = is_joined.sum(axis=1) > 1
        expected["jumps"][home >= 0] |= is_joined.sum(axis=0)[home[home >= 0]] > 1
        expected["home"] = home
        tracks = self._with_new(expected, blobs, time_ns)
        in_blob = np.bincount(tracks["home"] + 1)
        tracks["shared"] = (tracks["home"] >= 0) & (in_blob[tracks["home"] + 1] > 1)
        self._find(tracks, blobs, size, time_ns)
        move(tracks, before, self._settings.velocity_s)
        judge(tracks, before, time_ns, self._judged_by)
        self._meetings.end(tracks, time_ns)
        resume(tracks, self._settings.frames, self._pitch_m)
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
            self.track_of[self._taxels] = number[self.track_of[self._taxels]]

    def _homes(self, overlap: Doubles, expected: Tracks, blobs: TouchedBlobs, size: Whole, time_ns: int) -> Whole:
        """(tracks,) the blob of each; -1: it has gone."""
        tracks, touching = self._tracks, overlap > 0
        way_m = np.sqrt(((expected["place"] - tracks["place"]) ** 2).sum(axis=1))
        by_place = (way_m > self._pitch_m) | tracks["shared"]
        if not by_place.any() and (touching.sum(axis=1) == 1).all() and (touching.sum(axis=0) == 1).all():
            only: Whole = touching.argmax(axis=1)
            return only  # nothing begins, ends or merges
        home = np.full(len(tracks), -1)
        known, found = assign(self._gains(overlap, expected, blobs, way_m, by_place))
        home[known] = found
        self._join(home, overlap, expected, blobs, size)
        self._part(home, expected, blobs, time_ns)
        return home

    def _gains(
        self, overlap: Doubles, expected: Tracks, blobs: TouchedBlobs, way_m: Doubles, by_place: Flags
    ) -> Doubles:
        """(tracks, m): the gain of each pair; 0: they cannot be the same."""
        tracks = self._tracks
        away = expected["place"][:, None] - blobs.cop_m
        squares = np.einsum("ijk,ijk->ij", away, away)
        reach_m = _DOUBT * np.nan_to_num(way_m) + _REACH_PITCHES * self._pitch_m
        if len(tracks) <= _MOST_FAST:
            reach_m = np.fmax(reach_m, _DOUBT * way_m + _GATE * np.sqrt(expected["spread"][:, 0]))
        misses = squares / (reach_m**2)[:, None]
        is_near = (misses <= 1) & (tracks["frame"][:, None] == blobs.frame)
        is_sharing = (overlap > 0) & ~(by_place & is_near.any(axis=1))[:, None]
        is_rest = blobs.load < _REST * tracks["load"][:, None]
        sharing = np.where(is_rest, _LEFT, np.where(overlap >= 0.5, _STRONG, _WEAK)) + _CLOSENESS * overlap
        sharing += _PREFERENCE * (1 - _rank(tracks["born_ns"])[:, None] + _rank(blobs.load))
        near = _NEAR + _NEARNESS * (1 - misses) + _PRESENCE * (tracks["gone_ns"] == 0)[:, None]
        return np.where(is_sharing, sharing, np.where(is_near, near, 0.0))

    def _join(self, home: Whole, overlap: Doubles, expected: Tracks, blobs: TouchedBlobs, size: Whole) -> None:
        """Put tracks that found no blob of their own into that of another."""
        lost = np.flatnonzero((home < 0) & (expected["id"] > 0) & np.isfinite(expected["place"][:, 0]))
        if not len(lost) or not len(size) or len(lost) > _MOST_NEW:
            return
        before, within = self._tracks, np.bincount(home[home >= 0], minlength=len(size))
        position = self._position_m[blobs.taxels]
        for track in lost.tolist():
            squares = ((position - expected["place"][track]) ** 2).sum(axis=1)
            nearest = int(squares.argmin())
            blob = int(blobs.blob[nearest])
            if squares[nearest] > self._pitch_m**2:
                blob = int(overlap[track].argmax())
                if overlap[track, blob] < 0.5:
                    mates = home[before["shared"] & before["shared"][track] & (before["home"] == before["home"][track])]
                    mates = mates[mates >= 0]
                    if not len(mates):
                        continue
                    blob = int(mates[0])
            if (
                blobs.frame[blob] == expected["frame"][track]
                and within[blob] < _MOST_WITHIN
                and size[blob] <= _MOST_TAXELS
            ):
                home[track] = blob
                within[blob] += 1

    def _part(self, home: Whole, expected: Tracks, blobs: TouchedBlobs, time_ns: int) -> None:
        """Give blobs without a track one of those whose blob has too little load for all of them."""
        carried = np.bincount(home + 1, minlength=len(blobs.load) + 1)[1:]
        for blob in np.flatnonzero(carried > 1).tolist():
            rows = np.flatnonzero((home == blob) & self._tracks["shared"])
            rows = rows[self._lacks(expected[rows], blobs.load[blob])]
            new = np.flatnonzero((carried == 0) & (blobs.frame == blobs.frame[blob]))
            if not len(rows) or not len(new):
                continue
            stays, goes = (
                ((expected["place"][rows, None] - blobs.cop_m[there]) ** 2).sum(axis=2) for there in ([blob], new)
            )
            passed_s = (time_ns - expected["seen_ns"][rows]) / NS_PER_S
            reach_m = _REACH_PITCHES * self._pitch_m + _PARTS_M_S * passed_s
            away_m = np.linalg.norm(expected["found"][rows, None] - blobs.cop_m[new], axis=2)
            could = away_m <= reach_m[:, None]
            if could.any():
                one, other = np.unravel_index(np.where(could, goes - stays, np.inf).argmin(), could.shape)
                home[rows[one]] = new[other]
                carried[new[other]] = 1

    def _lacks(self, tracks: Tracks, load: float) -> Flags:
        """Whether each track of a blob has rather gone: its load is too small for all, as they were alone."""
        alone = 2 * np.pi * tracks["peak"] * (tracks["width"] / self._pitch_m) ** 2
        lacks: Flags = load < alone.sum() - alone / 2
        return lacks

    def _with_new(self, tracks: Tracks, blobs: TouchedBlobs, time_ns: int) -> Tracks:
        """The tracks, and new ones of the blobs that have none."""
        has_track = np.zeros(len(blobs.load), bool)
        has_track[tracks["home"][tracks["home"] >= 0]] = True
        if has_track.all():
            return tracks
        new = np.flatnonzero(~has_track)
        begun = np.zeros(len(new), TRACK)
        begun["key"] = self._last_key + 1 + np.arange(len(new))
        self._last_key += len(new)
        begun["home"], begun["born_ns"], begun["frame"] = new, time_ns, blobs.frame[new]
        begun["place"], begun["kind"] = blobs.cop_m[new], int(ContactKind.TOUCH)
        begun["velocity"] = np.where(np.isnan(blobs.cop_m[new]), np.nan, 0.0)
        begun["spread"] = np.inf, 0.0, (_NEW_M_S if len(new) <= _MOST_NEW else 0.0) ** 2
        return np.concatenate([tracks, begun])

    def _find(self, tracks: Tracks, blobs: TouchedBlobs, size: Whole, time_ns: int) -> None:
        """Measure where each track is in this frame, and correct what was expected of it."""
        pitch_m = self._pitch_m
        home: Whole = tracks["home"]  # a view: tracks that are given up below are -1 here, too
        alone = np.flatnonzero((home >= 0) & ~tracks["shared"])
        blob = home[alone]
        tracks["found"][alone], tracks["noise"][alone] = blobs.cop_m[blob], (_NOISE_PITCHES * pitch_m) ** 2 / size[blob]
        tracks["now"][alone], tracks["height"][alone] = blobs.load[blob], blobs.peak[blob]
        elsewhere = alone[tracks["frame"][alone] != blobs.frame[blob]]
        tracks["place"][elsewhere], tracks["pace"][elsewhere] = tracks["found"][elsewhere], 0.0
        tracks["frame"][alone], tracks["size"][alone] = blobs.frame[blob], size[blob]
        jumping = alone[tracks["jumps"][alone]]
        tracks["place"][jumping] = tracks["found"][jumping]
        correct(tracks, alone, time_ns)
        for one in set(home[tracks["shared"]].tolist()):
            self._tell_apart(tracks, np.flatnonzero(home == one), blobs, time_ns)
        here = np.flatnonzero(home >= 0)
        tracks["seen_ns"][here], tracks["gone_ns"][here] = time_ns, 0
        tracks["frames"][here] += blobs.frames[home[here]]
        tracks["sure"][here] |= blobs.is_sure[home[here]]

    def _tell_apart(self, tracks: Tracks, rows: Whole, blobs: TouchedBlobs, time_ns: int) -> None:
        """Find the tracks that share a blob, each with its own bell."""
        within = np.flatnonzero(blobs.blob == tracks["home"][rows[0]])
        position_m = self._position_m[blobs.taxels[within]]
        place, variance_m2, peak = fit_bells(blobs.value[within], position_m, tracks[rows])
        tracks["found"][rows], tracks["noise"][rows], tracks["height"][rows] = place, variance_m2, peak
        share = peak * tracks["width"][rows] ** 2
        tracks["now"][rows] = blobs.load[tracks["home"][rows[0]]] * share / share.sum()
        tracks["size"][rows] = np.maximum(1, np.round(len(within) * share / share.sum()))
        tracks["jumps"][rows] = False
        correct(tracks, rows, time_ns)
        is_faint = self._lacks(tracks[rows], blobs.load[tracks["home"][rows[0]]])
        is_faint &= peak < _FAINT * tracks["peak"][rows]
        is_faint[peak.argmax()] = False
        tracks["home"][rows[is_faint]] = -1

    def _keep(self, tracks: Tracks, blobs: TouchedBlobs, time_ns: int) -> None:
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
        track = self.track_of[self._taxels]
        left = self._taxels[(track >= 0) & is_gone[track]] if len(is_gone) else self._taxels[:0]
        left_by = self.track_of[left]
        self.track_of[self._taxels] = -1
        self.track_of[left] = left_by
        self.track_of[blobs.taxels] = of_taxel
        self._taxels = np.concatenate([left, blobs.taxels])
        self._tracks = tracks

    def _tracked(self, tracks: Tracks, time_ns: int) -> Arrays:
        """The oldest track of each blob, and the mean of their velocities."""
        here = np.flatnonzero(tracks["home"] >= 0)
        here = here[np.lexsort([tracks["key"][here], tracks["born_ns"][here], tracks["home"][here]])]
        home = tracks["home"][here]
        first = here[np.diff(home, prepend=-1) > 0]
        age_s = (time_ns - tracks["born_ns"][first]) / NS_PER_S
        is_known = (tracks["frames"][first] >= self._settings.frames) | (age_s >= self._settings.touch_s)
        new = first[(tracks["id"][first] == 0) & is_known]
        tracks["id"][new] = (self._last_id + np.arange(len(new))) % _LAST_ID + 1
        self._last_id = (self._last_id + len(new) - 1) % _LAST_ID + 1 if len(new) else self._last_id
        velocity = tracks["velocity"][first]
        for blob in set(home[1:][np.diff(home) == 0].tolist()):
            rows = here[home == blob]
            weight = np.maximum(tracks["now"][rows], 1e-9)
            velocity[blob] = weight @ tracks["velocity"][rows] / weight.sum()
        return {
            "id": tracks["id"][first],
            "age_s": age_s,
            "velocity_m_s": velocity,
            "kind": tracks["kind"][first],
            "provisional": ~tracks["sure"][first],
        }


def _rank(numbers: Doubles | Whole) -> Doubles:
    """0 for the smallest to 1 for the largest."""
    rank = np.empty(len(numbers))
    rank[np.argsort(numbers, kind="stable")] = np.arange(len(numbers)) / max(len(numbers) - 1, 1)
    return rank
