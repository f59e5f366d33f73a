"""How well a rule tells touches from drift: many worlds of ``bench_world`` at once, judged against their truth.

All rules see the same frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from skinware.tactile.baseline import Baseline, BaselineSettings
from skinware.tactile.testing import Cover, Gesture, Push, Stroke, World, grid
from tests.tactile.bench import BENCH_S, bench_world
from tests.tactile.peers import CapSense, ICub, Judged, QTouch, Rule, TareOnce

Drift = Literal["slow", "fast"]
Floats = npt.NDArray[np.float64]

TAXELS = 120
"""Of a world."""
CENTRE = {"hold": 1 * 12 + 5, "slow": 3 * 12 + 6, "weak": 4 * 12 + 5}
SAGGING = tuple(5 * 12 + taxel for taxel in (0, 2, 3, 7, 8, 10, 11))
"""More than 9 mm from the firm press, which pulls the cover away from them."""
_START_S = 6.0
_UNSEEN = 0.5
"""A load below half a step is none."""
_GOOD_WITHIN = 6.0
"""Counts: so near its values a baseline is good: a load of 12 is seen."""


class Worlds:
    """Many bench worlds at once, each a patch with its own draws of noise, drift, wave and phase.

    Args:
        rate_hz: of the frames.
        count: of each drift.
        drifts: which; the worlds of one stand together.
        seed: of all.
    """

    def __init__(self, rate_hz: float, count: int, drifts: Sequence[Drift] = ("slow", "fast"), seed: int = 1) -> None:
        self.rate_hz, self.count, self.drifts = rate_hz, count, tuple(drifts)
        self._worlds = [_many(drift, rate_hz, count, seed) for drift in drifts]
        n_worlds = count * len(drifts)
        self.module = np.arange(n_worlds * TAXELS) // 12
        self.patch = np.arange(n_worlds * TAXELS) // TAXELS
        self.taps = [gesture for gesture in bench_world("slow", rate_hz).gestures if gesture.name == "tap"]
        self.surface = bench_world("slow", rate_hz).surface

    def blocks(self, until_s: float) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[Any], npt.NDArray[Any]]]:
        """Times (m,), values and truth (m, n) of some frames after the other."""
        for blocks in zip(*(world.blocks(until_s) for world in self._worlds), strict=True):
            values, truth = (np.concatenate([getattr(b, name) for b in blocks], axis=1) for name in ("values", "truth"))
            yield blocks[0].time_ns, values, truth


class Ours:
    """The rule of :class:`Baseline`, where each world is a patch."""

    def __init__(self, worlds: Worlds, settings: BaselineSettings | None = None) -> None:
        self.baseline = Baseline(worlds.module, worlds.patch, settings)

    def __call__(self, time_ns: int, values: npt.NDArray[np.generic]) -> Judged:
        calm = self.baseline.update(time_ns, values)
        return calm.touched, values.astype(np.float32) - np.nan_to_num(calm.baseline)


def peers(rate_hz: float) -> dict[str, Rule]:
    """The rules of others; those of the iCub at the rate of its frames."""
    return {
        "tare once": TareOnce(rate_hz),
        "iCub, code": ICub.by_default(rate_hz),
        "iCub, shipped": ICub.as_shipped(rate_hz),
        "CapSense": CapSense(),
        "QTouch": QTouch(rate_hz),
    }


@dataclass
class Marks:
    """What a rule is worth in each of s worlds.

    Attributes:
        false: (s,) share of the time in which idle taxels were shown as touched.
        taps: (s,) share of the taps that were seen.
        hold_on: (s,) share of the ten minutes in which the held taxel was shown as touched.
        hold_value: (s,) what was shown of it at the end, as a share of the truth.
        off_s: (s,) how long after the release anything in the module was shown as touched.
        slow: (s,) share of the slow press, once it is whole, in which it was shown.
        weak: (s,) share of the weak touch in which it was shown.
        covered_s: (s,) how long the baselines of the covered module were wrong after it was uncovered.
        sag_s: (s,) how long taxels that only sagged were shown as touched.
    """

    false: Floats
    taps: Floats
    hold_on: Floats
    hold_value: Floats
    off_s: Floats
    slow: Floats
    weak: Floats
    covered_s: Floats
    sag_s: Floats

    def of(self, worlds: slice) -> Marks:
        """Those of some worlds."""
        return Marks(**{field.name: getattr(self, field.name)[worlds] for field in fields(self)})


def judge(rules: Mapping[str, Rule], worlds: Worlds, until_s: float = BENCH_S) -> dict[tuple[str, Drift], Marks]:
    """Let rules see the same worlds, and judge them: by rule and drift.

    Args:
        rules: by name; each sees every frame once.
        worlds: what they see.
        until_s: how long.
    """
    judges = {name: _Judge(worlds) for name in rules}
    begin_ns: int | None = None
    for time_ns, values, truth in worlds.blocks(until_s):
        begin_ns = int(time_ns[0]) if begin_ns is None else begin_ns
        for name, rule in rules.items():
            touched = np.zeros(values.shape, bool)
            above = np.zeros(values.shape, np.float32)
            for row, frame in enumerate(values):
                touched[row], above[row] = rule(int(time_ns[row]), frame)
            judges[name].see((time_ns - begin_ns) / 1e9, touched, above, truth)
    count = worlds.count
    parts = {drift: slice(number * count, (number + 1) * count) for number, drift in enumerate(worlds.drifts)}
    return {(name, drift): judges[name].marks().of(part) for name in rules for drift, part in parts.items()}


def _many(drift: Drift, rate_hz: float, count: int, seed: int) -> World:
    """Bench worlds as the patches of one."""
    one = bench_world(drift, rate_hz)
    many = World(
        grid(modules=10 * count, patches=count),
        seed=seed,
        rate_hz=rate_hz,
        drift_per_min=one.drift_per_min,
        wave=one.wave,
        response=one.response,
    )
    for number in range(count):
        way = many.surface.position_m[number * TAXELS] - one.surface.position_m[0]
        many.gestures += [_moved(gesture, way, number * TAXELS) for gesture in one.gestures]
    return many


class _Judge:
    """Follows one rule through all worlds."""

    def __init__(self, worlds: Worlds) -> None:
        self._count = worlds.count * len(worlds.drifts)
        self._period_s = 1 / worlds.rate_hz
        self._taps = [tap.begin_s for tap in worlds.taps]
        self._tap_taxel = [int(np.argmin(tap.least_distances_m(worlds.surface))) for tap in worlds.taps]
        self._seen = np.zeros((len(self._taps), self._count), bool)
        self._false, self._idle = np.zeros(self._count), np.zeros(self._count)
        self._shown = {name: np.zeros((2, self._count)) for name in CENTRE}
        self._end_value: list[npt.NDArray[np.float32]] = []
        self._off_s, self._covered_s, self._sag_s = (np.zeros(self._count) for _ in range(3))

    def see(
        self,
        time_s: Floats,
        touched: npt.NDArray[np.bool_],
        above: npt.NDArray[np.float32],
        truth: npt.NDArray[np.float32],
    ) -> None:
        """A block of frames: (m,) times and (m, s x 120) of the rest."""
        shape = len(time_s), self._count, TAXELS
        touched, above, truth = touched.reshape(shape), above.reshape(shape), truth.reshape(shape)
        begun = time_s >= _START_S
        idle = (truth < _UNSEEN) & begun[:, np.newaxis, np.newaxis]
        self._idle += idle.sum(axis=(0, 2))
        self._false += (touched & idle).sum(axis=(0, 2))
        for number, (begin_s, taxel) in enumerate(zip(self._taps, self._tap_taxel, strict=True)):
            self._seen[number] |= touched[_between(time_s, begin_s, begin_s + 0.4), :, taxel].any(axis=0)
        for name, begin_s, end_s in (("hold", 121, 720), ("slow", 360, 420), ("weak", 801, 1100)):
            rows = _between(time_s, begin_s, end_s)
            self._shown[name] += touched[rows, :, CENTRE[name]].sum(axis=0), np.full(self._count, rows.sum())
        rows = _between(time_s, 700, 719)
        self._end_value += list((above * touched)[rows, :, CENTRE["hold"]])
        after = touched[:, :, 12:24].any(axis=2) & (time_s >= 720)[:, np.newaxis]
        self._off_s = np.maximum(self._off_s, _last(time_s - 720, after))
        wrong = (np.abs(above[:, :, :12]) > _GOOD_WITHIN) | touched[:, :, :12]
        wrong = wrong.any(axis=2) & _between(time_s, 60, 160)[:, np.newaxis]
        self._covered_s = np.maximum(self._covered_s, _last(time_s - 60, wrong))
        self._sag_s += touched[:, :, SAGGING][begun].any(axis=2).sum(axis=0) * self._period_s

    def marks(self) -> Marks:
        """What it is worth."""
        shown = {name: of / np.maximum(total, 1) for name, (of, total) in self._shown.items()}
        return Marks(
            false=self._false / self._idle,
            taps=self._seen.mean(axis=0),
            hold_on=shown["hold"],
            hold_value=np.mean(self._end_value, axis=0) / 25,
            off_s=self._off_s,
            slow=shown["slow"],
            weak=shown["weak"],
            covered_s=self._covered_s,
            sag_s=self._sag_s,
        )


def _between(time_s: Floats, begin_s: float, end_s: float) -> npt.NDArray[np.bool_]:
    inside: npt.NDArray[np.bool_] = (time_s >= begin_s) & (time_s < end_s)
    return inside


def _last(time_s: Floats, of: npt.NDArray[np.bool_]) -> Floats:
    """(s,) the last time of (m,) at which (m, s) was true; 0 if never."""
    latest: Floats = np.where(of, time_s[:, np.newaxis], 0).max(axis=0)
    return latest


def _moved(gesture: Gesture, way_m: Floats, taxels: int) -> Gesture:
    """The same in another world."""
    if isinstance(gesture, Push):
        x, y, z = (np.array(gesture.at_m) + way_m).tolist()
        return replace(gesture, at_m=(x, y, z))
    if isinstance(gesture, Stroke):
        return replace(gesture, path_m=tuple((x, y, z) for x, y, z in (np.array(gesture.path_m) + way_m).tolist()))
    assert isinstance(gesture, Cover)
    return replace(gesture, taxels=tuple(taxel + taxels for taxel in gesture.taxels))
