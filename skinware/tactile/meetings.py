"""Separate the contacts of one blob, and decide which is which after they were too near each other for that."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skinware.realtime import NS_PER_S
from skinware.tactile.arrays import Doubles
from skinware.tactile.tracks import LONGEST_GUESS_S, Tracks, assign

_STEPS = 4
_SMALL = 1e-9
_LOG_PEAK = 0.3  # spread of the logarithm of a peak from sample to sample
_MISFIT = 0.1  # share of the largest value by which a response may differ from a bell
_LEAST_VALUE = 1e-3  # share of the expected height: without any load (of a provisional touch) a fit has no solution
_CLOSE_WIDTHS, _CLOSE_PITCHES, _CLOSE_WAYS = 1.3, 1.2, 1.5
"""Two contacts meet when they come nearer than so many widths, pitches, or shares of their way in a sample."""
_APART = 1.15  # they have met when they are this many times as far apart
_GOES_ON = 3.0  # log of the odds that two contacts kept on their ways, before anything else is known
_REST_S, _REST = 0.1, 0.5
"""Seconds after which two have come to rest that are nearer each other than this share of their way."""
_WANDER = 0.1  # share of its way by which a contact leaves its lane
_LOG_RATIO = 0.3  # spread of the logarithm of the ratio of two peaks, of contacts wider than a pitch
_MOST_OF_LOAD = 2.0  # the most that a comparison of loads counts, as a log of odds
_MOST_PAIRS = 16  # pairs that meet in a sample; more of them are noise
_SETS_OFF_M_S, _FROM_PITCHES = 0.2, 1.5
"""m/s, and pitches: a new contact at least so fast that comes from so near where one has just gone is the same."""
_EXCHANGED = ("id", "born_ns", "frames", "kind", "load", "peak", "width")
"""Fields that belong to an identity, and not to a place."""


def fit_bells(value: Doubles, position: Doubles, tracks: Tracks) -> tuple[Doubles, Doubles, Doubles]:
    """Fit a bell of known width for each of k tracks to the values of a blob, by Gauss-Newton steps.

    The steps begin where the tracks are expected, and again where they were last found if that fits poorly; the better
    fit counts. No bell is more than its width beyond the taxels.

    Args:
        value, position: (a,) of its taxels, and (a, 3) m, their places.
        tracks: (k,) as they are expected, but for ``found``.

    Returns:
        (k, 3) m, their centres, (k,) m2, the variances of these along the skin, and (k,) their heights.
    """
    place, peak, width = tracks["place"], tracks["height"], tracks["width"]
    k = len(place)
    log_peak = np.log(np.maximum(peak, _SMALL))
    expected = np.column_stack([place, log_peak])
    prior = np.column_stack([np.tile(1 / tracks["spread"][:, :1], 3), np.full(k, _LOG_PEAK**-2)]).ravel()
    precision: float = (_MISFIT * max(value.max(), _LEAST_VALUE * peak.max(), _SMALL)) ** -2
    most = np.column_stack([np.tile(width[:, None], 3), np.ones(k)])
    best = np.inf
    for start in (place, tracks["found"]):
        unknown = np.column_stack([start, log_peak])
        for step in range(_STEPS + 1):
            near = position[((position - unknown[:, None, :3]) ** 2).sum(axis=2).argmin(axis=1)]
            beside = unknown[:, :3] - near
            reach = np.minimum(1, width / np.maximum(np.linalg.norm(beside, axis=1), _SMALL))
            unknown[:, :3] = near + reach[:, None] * beside
            away = position[None] - unknown[:, None, :3]
            bells = np.exp(unknown[:, 3, None] - (away**2).sum(axis=2) / (2 * width[:, None] ** 2))
            miss, change = value - bells.sum(axis=0), (unknown - expected).ravel()
            slope = np.concatenate([bells[..., None] * away / width[:, None, None] ** 2, bells[..., None]], axis=2)
            slope = slope.transpose(1, 0, 2).reshape(len(value), 4 * k)
            information = precision * slope.T @ slope
            information[np.arange(4 * k), np.arange(4 * k)] += prior
            if step < _STEPS:
                pull = precision * slope.T @ miss - prior * change
                unknown = unknown + np.clip(np.linalg.solve(information, pull).reshape(k, 4), -most, most)
        misfit = precision * float(miss @ miss)
        cost = misfit + float(prior @ change**2)
        if cost < best:
            best, fitted, known = cost, unknown, information
        if misfit < len(value):
            break
    covariance = np.linalg.inv(known).reshape(k, 4, k, 4)
    of_place = covariance[np.arange(k), :3, np.arange(k), :3]
    along_skin = np.asarray(np.linalg.eigvalsh(of_place)[:, :2].mean(axis=1), np.float64)  # across it, nothing is seen
    return fitted[:, :3], along_skin, np.exp(fitted[:, 3])


class _Meeting(NamedTuple):
    """Two contacts just before they came too near each other."""

    began_ns: int
    apart: Doubles  # (3,) m from one to the other, across their way
    way: Doubles  # (3,) direction of their relative motion
    duration_s: float  # how long it takes them to pass each other
    variance_m2: float
    drift_m2_s2: float
    log_ratio: float  # logarithm of the ratio of their peaks
    pace: Doubles  # (2, 3) m/s, their velocities
    along_m: float  # from one to the other, along their way


class Meetings:
    """Decides which contact is which after two have met.

    That they went on, as their velocities said, is more likely than that they turned round, unless they came to rest.
    Against it speak their lanes, the part of their distance that lies across their relative motion, and their loads.
    """

    def __init__(self, pitch_m: float) -> None:
        self._pitch_m = pitch_m
        self._open: dict[tuple[int, int], _Meeting] = {}

    def begin(self, tracks: Tracks, expected: Doubles, time_ns: int) -> None:
        """Note the pairs of tracks that come too near each other, on their way to where they are expected."""
        rows = np.flatnonzero((tracks["id"] > 0) & np.isfinite(tracks["place"][:, 0]))
        if len(rows) < 2:
            return
        place, width = tracks["place"][rows], tracks["width"][rows]
        way = expected[rows] - place
        between = place[:, None] - place
        least_m = np.maximum(_CLOSE_WIDTHS / 2 * width, _CLOSE_PITCHES / 2 * self._pitch_m)
        least_m += (1 + _CLOSE_WAYS) * np.sqrt((way**2).sum(axis=1))
        near = np.einsum("ijk,ijk->ij", between, between) < (least_m[:, None] + least_m) ** 2
        one, other = np.nonzero(np.triu(near, 1))
        if not len(one):
            return
        apart, moves = between[one, other], way[one] - way[other]
        squares = (moves**2).sum(axis=1)
        when = np.clip(-(apart * moves).sum(axis=1) / np.maximum(squares, 1e-12), 0, 1)
        nearest = apart + when[:, None] * moves
        close_m = np.maximum(self._close_m(width[one], width[other]), _CLOSE_WAYS * np.sqrt(squares))
        is_close = (nearest**2).sum(axis=1) < close_m**2
        is_close &= tracks["frame"][rows][one] == tracks["frame"][rows][other]
        pairs = np.flatnonzero(is_close).tolist()
        for pair in pairs if len(pairs) <= _MOST_PAIRS else []:
            self._note(tracks[rows[one[pair]]], tracks[rows[other[pair]]], float(close_m[pair]), time_ns)

    def _close_m(self, width: Doubles, of_other: Doubles) -> Doubles:
        return np.maximum(_CLOSE_WIDTHS * (width + of_other) / 2, _CLOSE_PITCHES * self._pitch_m)

    def _note(self, one: np.void, other: np.void, close_m: float, time_ns: int) -> None:
        pair = int(one["key"]), int(other["key"])
        if pair in self._open:
            return
        speed = one["pace"] - other["pace"]
        drift = float(one["spread"][2] + other["spread"][2])
        size = float(np.linalg.norm(speed))
        way = speed / size if size**2 > 4 * drift else np.zeros(3)
        apart = one["place"] - other["place"]
        self._open[pair] = _Meeting(
            time_ns,
            apart - way * (apart @ way),
            way,
            2 * close_m / max(size, 1e-3),
            float(one["spread"][0] + other["spread"][0]),
            drift,
            float(np.log(max(one["peak"], _SMALL) / max(other["peak"], _SMALL))),
            np.array([one["pace"], other["pace"]]),
            float(apart @ way),
        )

    def end(self, tracks: Tracks, time_ns: int) -> None:
        """Exchange the identities of tracks that turn out to have turned round, when they are apart again."""
        if not self._open:
            return
        row_of = {int(key): row for row, key in enumerate(tracks["key"].tolist())}
        for pair, meeting in list(self._open.items()):
            one, other = row_of.get(pair[0]), row_of.get(pair[1])
            if one is None or other is None:
                del self._open[pair]
                continue
            is_one_blob = (
                tracks["home"][one] == tracks["home"][other]
            )  # the fit may wander, and only one identity shows
            if is_one_blob or (tracks["seen_ns"][[one, other]] != time_ns).any():
                continue
            apart = tracks["found"][one] - tracks["found"][other]
            width = tracks["width"]
            if np.linalg.norm(apart) < _APART * self._close_m(width[one : one + 1], width[other : other + 1])[0]:
                continue
            passed_s = (time_ns - meeting.began_ns) / NS_PER_S
            way_m = np.linalg.norm(meeting.pace[0] - meeting.pace[1]) * passed_s - abs(meeting.along_m)
            rested = passed_s > _REST_S and abs(apart @ meeting.way) < _REST * way_m
            del self._open[pair]
            if self._turned(meeting, apart, tracks[[one, other]], passed_s, rested=rested):
                for name in _EXCHANGED:
                    tracks[name][[one, other]] = tracks[name][[other, one]]
                if not rested:
                    tracks["pace"][[one, other]] = meeting.pace  # as if they had exchanged their velocities

    def _turned(self, meeting: _Meeting, apart: Doubles, pair: Tracks, passed_s: float, *, rested: bool) -> bool:
        """Whether the two are rather those that turned round."""
        drift_m2 = meeting.drift_m2_s2 * min(passed_s, meeting.duration_s) ** 2 / 4
        variance_m2 = meeting.variance_m2 + drift_m2 + float(pair["noise"].sum()) + (_WANDER * self._pitch_m) ** 2
        across = apart - meeting.way * (apart @ meeting.way)
        has_passed = (apart @ meeting.way) * meeting.along_m < 0
        odds = -_GOES_ON if rested and has_passed else _GOES_ON
        if meeting.way.any():
            odds += 2 * float(across @ meeting.apart) / variance_m2
        narrow = np.clip(self._pitch_m / pair["width"].min(), 1, 3)
        ratio = float(np.log(max(pair["height"][0], _SMALL) / max(pair["height"][1], _SMALL)))
        of_load = 2 * meeting.log_ratio * ratio / (_LOG_RATIO * narrow) ** 2
        return odds + float(np.clip(of_load, -_MOST_OF_LOAD, _MOST_OF_LOAD)) < 0


def resume(tracks: Tracks, frames: int, pitch_m: float) -> None:
    """Give a contact that begins at speed the identity of one that has just gone where it comes from, in place."""
    new = np.flatnonzero((tracks["home"] >= 0) & (tracks["id"] == 0) & (tracks["frames"] == frames))
    gone = np.flatnonzero((tracks["home"] < 0) & (tracks["id"] > 0))
    if not 0 < len(new) * len(gone) <= _MOST_PAIRS:
        return
    pace, away = tracks["pace"][new][:, None], tracks["found"][new][:, None] - tracks["found"][gone]
    speed = (pace**2).sum(axis=2)
    since_s = np.clip((away * pace).sum(axis=2) / np.maximum(speed, 1e-12), 0, LONGEST_GUESS_S)
    miss_m = np.linalg.norm(away - since_s[..., None] * pace, axis=2)
    close_m = _FROM_PITCHES * pitch_m
    could = (speed > _SETS_OFF_M_S**2) & (tracks["frame"][new][:, None] == tracks["frame"][gone])
    one, other = assign(np.where(could, close_m - miss_m, 0.0))
    for name in _EXCHANGED:
        tracks[name][new[one]] = tracks[name][gone[other]]
    tracks["id"][gone[other]] = 0
