"""Follow the tracks of contacts, each by itself: what ``skinware/native/tracks.c`` does, in numpy."""

from __future__ import annotations

import numpy as np

from skinware.realtime import NS_PER_S
from skinware.tactile.arrays import Doubles, Whole
from skinware.tactile.tracking import ContactKind, TrackingSettings
from skinware.tactile.tracks import LONGEST_GUESS_S, Tracks

ACCELERATION_M_S2, MANOEUVRE_S, SURPRISE, SHORTEST_S = 0.5, 0.1, 3.0, 1e-3
CALM, NARROWEST_PITCHES = 3.0, 0.35


def expected_at(tracks: Tracks, time_ns: int) -> Tracks:
    """The tracks as they are expected at a time: places and spreads go on with the velocities."""
    expected = tracks.copy()
    passed_s = np.clip((time_ns - tracks["seen_ns"]) / NS_PER_S, 0, LONGEST_GUESS_S)
    pace = tracks["pace"]
    expected["place"] += passed_s[:, None] * pace
    change = (ACCELERATION_M_S2 + np.sqrt((pace**2).sum(axis=1)) / MANOEUVRE_S) * passed_s
    _, both, variance = tracks["spread"].T
    expected["spread"][:, 0] += passed_s * (2 * both + passed_s * (variance + change**2 / 4))
    expected["spread"][:, 1] += passed_s * (variance + change**2 / 2)
    expected["spread"][:, 2] += change**2
    return expected


def correct(tracks: Tracks, rows: Whole, time_ns: int) -> None:
    """Take in where tracks were found, instead of where they were expected."""
    now = tracks if len(rows) == len(tracks) else tracks[rows]
    passed_s = np.maximum((time_ns - now["seen_ns"]) / NS_PER_S, SHORTEST_S)
    miss = now["found"] - now["place"]
    variance, both, pace = now["spread"].T
    is_new = np.isinf(variance)
    variance = np.where(is_new, 1.0, variance)  # m2: nothing is known
    squares = (miss**2).sum(axis=1)
    surprise = np.where((squares > SURPRISE**2 * (variance + now["noise"])) & ~now["jumps"], squares, 0.0)
    variance, both, pace = variance + surprise, both + surprise / passed_s, pace + surprise / passed_s**2
    gain = variance / (variance + now["noise"])
    pull = np.where(now["jumps"], 0.0, both / (variance + now["noise"]))
    now["place"] += gain[:, None] * miss
    now["pace"] += pull[:, None] * np.nan_to_num(miss)
    pace += surprise / passed_s**2 - pull * both  # what changed once changes again
    now["spread"] = np.column_stack([gain * now["noise"], both * (1 - gain), pace])
    if now is not tracks:
        tracks[rows] = now


def move(tracks: Tracks, before: Tracks, velocity_s: float) -> None:
    """Update the velocities that are published; they stay where contacts merge or split, as their centres jump."""
    known = np.arange(len(before))
    passed_s = (tracks["seen_ns"][known] - before["seen_ns"]) / NS_PER_S
    moved = (tracks["home"][known] >= 0) & (passed_s > 0) & (tracks["frame"][known] == before["frame"])
    moved &= (tracks["shared"][known] == before["shared"]) & ~tracks["jumps"][known]
    known, passed_s = known[moved], passed_s[moved]
    velocity = (tracks["found"][known] - before["found"][known]) / passed_s[:, None]
    tracks["steps"][known] += 1
    weight = np.maximum(-np.expm1(-passed_s / velocity_s), 1 / tracks["steps"][known])[:, None]
    was = np.nan_to_num(tracks["velocity"][known])
    tracks["velocity"][known] = was + weight * (velocity - was)


def judge(tracks: Tracks, before: Tracks, time_ns: int, settings: TrackingSettings, pitch_m: float) -> None:
    """Update what is smoothed, and the kinds."""
    here = np.flatnonzero(tracks["home"] >= 0)
    now = tracks if len(here) == len(tracks) else tracks[here]
    passed_s = np.zeros(len(here))
    known = here < len(before)
    passed_s[known] = np.maximum(time_ns - before["seen_ns"][here[known]], 0) / NS_PER_S
    is_new = ~known
    weight = np.where(is_new, 1.0, -np.expm1(-passed_s / settings.velocity_s))
    found: Doubles = now["now"]
    height: Doubles = now["height"]
    load: Doubles = now["load"]
    peak: Doubles = now["peak"]
    width: Doubles = now["width"]
    motion: Doubles = now["motion"]
    frames: Whole = now["frames"]
    alone = np.maximum(weight, 1 / np.maximum(frames, 1)) * ~now["shared"]
    calm = -np.expm1(-passed_s / (CALM * settings.velocity_s))[:, None]
    load += weight * (found - load)
    peak += alone * (height - peak)
    measured = pitch_m * np.sqrt(found / (2 * np.pi * np.maximum(height, 1e-9)))
    width += alone * (np.maximum(measured, NARROWEST_PITCHES * pitch_m) - width)
    motion += calm * (np.nan_to_num(now["velocity"]) - motion)
    is_steady = abs(found - load) <= settings.steady * load
    slowest = np.where(now["kind"] == ContactKind.SLIDING, settings.sliding_m_s / 2, settings.sliding_m_s)
    is_sliding = is_steady & (np.linalg.norm(motion, axis=1) >= slowest)
    is_old = time_ns - now["born_ns"] >= settings.touch_s * NS_PER_S
    now["kind"] = np.where(is_old, np.where(is_sliding, ContactKind.SLIDING, ContactKind.HOLD), ContactKind.TOUCH)
    if now is not tracks:
        tracks[here] = now
