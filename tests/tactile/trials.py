"""Trials of a rule for baselines: each a kind of world, many seeds at once, with what has to hold in it.

All seeds of a trial are patches side by side, so that one frame of the rule serves all of them::

    for trial in TRIALS:
        print(trial.name, run(trial, lambda module, patch: Baseline(module, patch), seeds=20, rate_hz=20))
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from skinware.tactile.baseline import Baseline, Calm

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

MODULES, TAXELS = 5, 60
"""Modules and taxels of a seed, which is one patch."""
_ROWS = 100
_START_S = 6.0
"""The rest is measured until then."""
_CENTRE = 5
"""The taxel of a module that a finger presses; the others feel it by their distance."""


class Rule(Protocol):
    """Calms frames, as a :class:`Baseline` does."""

    def update(
        self, time_ns: int, values: npt.ArrayLike, usable: npt.ArrayLike | None = None, *, jumped: None = None
    ) -> Calm: ...


@dataclass
class Skin:
    """Signals of all seeds of a trial, (m, seeds, 60) at m times, before rounding and clipping.

    Attributes:
        seeds: number of seeds.
        rate_hz: of the frames.
        random: of all that is random.
        noise: standard deviation, counts.
        drift_per_min: common drift, counts a minute.
        spread: standard deviation of how strongly each taxel follows what is common.
        idle, maximum, step: of the values: at rest, at the end of the range, between two.
        loads: each adds (m, seeds, 60) to the truth at (m,) times.
        common: each adds (m, seeds) to what all taxels of a seed follow.
        apart: each adds (m, seeds, 60) that is no load.
        remainder: share of a load that stays for a while after it.
        answer: the response of a taxel to a load.
        lost: share of the values that do not arrive.
        sign: -1: values fall with load.
    """

    seeds: int
    rate_hz: float
    random: np.random.Generator
    noise: float = 0.8
    drift_per_min: float = 0.0
    spread: float = 0.3
    idle: float = 15.0
    maximum: float = 255.0
    step: float = 1.0
    loads: list[Callable[[Floats], Floats]] = field(default_factory=list)
    common: list[Callable[[Floats], Floats]] = field(default_factory=list)
    apart: list[Callable[[Floats], Floats]] = field(default_factory=list)
    remainder: float = 0.0
    answer: Callable[[Floats], Floats] = lambda load: load
    lost: float = 0.0
    sign: float = 1.0
    follows: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.follows = np.clip(1 + self.spread * self.random.standard_normal((self.seeds, TAXELS)), 0.1, 3)
        self._used = np.zeros((self.seeds, TAXELS))

    def blocks(
        self, until_s: float
    ) -> Iterator[tuple[Floats, npt.NDArray[np.float32], npt.NDArray[np.float32], Flags]]:
        """Yield times (m,), values, truth and usable (m, seeds * 60)."""
        total = round(until_s * self.rate_hz)
        for first in range(0, total, _ROWS):
            time_s = np.arange(first, min(first + _ROWS, total)) / self.rate_hz
            shape = len(time_s), self.seeds, TAXELS
            load = sum((add(time_s) for add in self.loads), np.zeros(shape))
            truth = self.answer(load)
            common = sum((add(time_s) for add in self.common), self.drift_per_min / 60 * time_s[:, None])
            signal = self.sign * truth + common[..., None] * self.follows
            signal += self.noise * self.random.standard_normal(shape, np.float32)
            for add in self.apart:
                signal += add(time_s)
            if self.remainder:
                signal += self._remains(truth)
            shown = self.step * np.rint((signal + self.idle) / self.step) if self.step else signal + self.idle
            values = np.clip(shown, 0 if self.step else -np.inf, self.maximum).astype(np.float32)
            usable = self.random.random(shape) >= self.lost if self.lost else np.ones(shape, bool)
            yield (
                time_s,
                values.reshape(len(time_s), -1),
                truth.reshape(len(time_s), -1).astype(np.float32),
                usable.reshape(len(time_s), -1),
            )

    def _remains(self, truth: Floats) -> Floats:
        left = np.zeros_like(truth)
        gain = 1 - np.exp(-1 / (40 * self.rate_hz))
        for row, load in enumerate(truth):
            self._used += gain * (load - self._used)
            left[row] = self.remainder * np.maximum(self._used - load, 0)
        return left

    def press(self, module: int, times_s: npt.ArrayLike, force: npt.ArrayLike) -> None:
        """Press the middle of a module of each seed with a force (k,) at times (k,); neighbours feel some of it."""
        row, column = np.divmod(np.arange(12), 4)
        away2 = (row - _CENTRE // 4) ** 2 + (column - _CENTRE % 4) ** 2
        bell = np.exp(-0.5 * away2 * (6.5 / 4) ** 2)
        bell[bell < 0.01] = 0
        shape = np.zeros(TAXELS)
        shape[12 * module : 12 * module + 12] = bell
        times, forces = np.asarray(times_s, float), np.asarray(force, float)
        self.loads.append(lambda t: np.interp(t, times, forces)[:, None, None] * shape)

    def grasp(self, share: float, force: float, until_s: float, begin_s: float = 20.0) -> None:
        """Load a share of the taxels of each seed, in whole neighbourhoods, for 5 s every 8 s."""
        taxels = np.zeros((self.seeds, TAXELS))
        taxels[:, : round(share * TAXELS)] = force * np.clip(
            1 + 0.2 * self.random.standard_normal((self.seeds, round(share * TAXELS))), 0.5, 2
        )

        def load(t: Floats) -> Floats:
            of = (t - begin_s) % 8.0
            full = np.interp(of, [0, 0.2, 4.8, 5.0], [0, 1, 1, 0], right=0.0) * ((t >= begin_s) & (t < until_s))
            grip: Floats = full[:, None, None] * taxels
            return grip

        self.loads.append(load)


@dataclass(frozen=True)
class Trial:
    """A kind of world.

    Attributes:
        name: what happens.
        until_s: how long.
        make: prepares the skin.
        false: most of the idle time that may be shown as touched; the time of ``quiet`` does not count.
        held: (name, taxel, begin, end): touched for at least 99 % of that time, by that taxel of each seed.
        within: most by which the shown value of those may be wrong, as a share; None: not judged.
        over_s: from then on nothing is touched.
        quiet: (begin, end) of a time that is not judged for false contacts.
    """

    name: str
    until_s: float
    make: Callable[[Skin], object]
    false: float = 0.005
    held: tuple[tuple[str, int, float, float], ...] = ()
    on: float = 0.99
    within: float | None = None
    over_s: float | None = None
    quiet: tuple[float, float] = (0.0, 0.0)
    how: dict[str, Any] = field(default_factory=dict)
    rule: dict[str, Any] = field(default_factory=dict)
    alone: bool = False


@dataclass
class Result:
    """Result of a trial: the worst seed of each mark, and the mean of ``false``."""

    false: Floats
    on: dict[str, Floats]
    value: dict[str, Floats]
    left: Floats

    def misses(self, trial: Trial) -> dict[str, float]:
        """Return the lines that do not hold, with the worst figure of each (the mean over the seeds for ``false``)."""
        found = {"false": float(self.false.mean())} if self.false.mean() > trial.false else {}
        found |= {f"on {name}": float(of.min()) for name, of in self.on.items() if of.min() < trial.on}
        if trial.within is not None:
            wrong = {name: np.abs(of - 1) for name, of in self.value.items()}
            found |= {f"value {name}": float(of.max()) for name, of in wrong.items() if not of.max() <= trial.within}
        if self.left.any():
            found["left"] = float(self.left.mean())
        return found

    def __str__(self) -> str:
        texts = [f"false {100 * self.false.mean():.3f} % (worst {100 * self.false.max():.2f})"]
        texts += [
            f"{name}: on {100 * of.min():.1f} %, value {self.value[name].min():.2f} to {self.value[name].max():.2f}"
            for name, of in self.on.items()
        ]
        texts.append(f"left over in {100 * self.left.mean():.0f} %")
        return "; ".join(texts)


class _Judge:
    """Follows a rule through one trial."""

    def __init__(self, trial: Trial, skin: Skin) -> None:
        self.trial = trial
        self._seeds, self._rate_hz = skin.seeds, skin.rate_hz
        self._false, self._idle = np.zeros(skin.seeds), np.zeros(skin.seeds)
        names = [name for name, *_ in trial.held]
        self._on = {name: np.zeros(skin.seeds) for name in names}
        self._frames = dict.fromkeys(names, 0)
        self._shown: dict[str, list[npt.NDArray[np.float32]]] = {name: [] for name in names}
        self._true: dict[str, list[npt.NDArray[np.float32]]] = {name: [] for name in names}
        self._left = np.zeros(skin.seeds, bool)

    def see(
        self, time_s: Floats, touched: Flags, value: npt.NDArray[np.float32], truth: npt.NDArray[np.float32]
    ) -> None:
        """Take m frames: (m,) times, the rest (m, seeds * 60)."""
        trial, shape = self.trial, (len(time_s), self._seeds, TAXELS)
        touched, value, truth = touched.reshape(shape), value.reshape(shape), truth.reshape(shape)
        counts = (time_s >= _START_S) & (time_s < trial.until_s)
        counts &= ~((time_s >= trial.quiet[0]) & (time_s < trial.quiet[1]))
        is_idle = (np.abs(truth) < 0.3) & counts[:, None, None]
        self._idle += is_idle.sum(axis=(0, 2))
        self._false += (touched & is_idle).sum(axis=(0, 2))
        for name, column, begin_s, end_s in trial.held:
            rows = (time_s >= begin_s) & (time_s < end_s)
            self._on[name] += touched[rows, :, column].sum(axis=0)
            self._frames[name] += int(rows.sum())
            self._shown[name] += list(value[rows, :, column])
            self._true[name] += list(truth[rows, :, column])
        if trial.over_s is not None:
            self._left |= touched[(time_s >= trial.over_s) & (time_s < trial.until_s)].any(axis=(0, 2))

    def result(self) -> Result:
        """Return the result of the rule."""
        ten_s = round(10 * self._rate_hz)
        error = {}
        for name in self._on:
            of, to = np.array(self._shown[name]), np.array(self._true[name])
            begins = range(0, max(len(of) - ten_s, 1), ten_s)
            ratio = np.array([of[k : k + ten_s].mean(axis=0) / to[k : k + ten_s].mean(axis=0) for k in begins])
            error[name] = ratio[np.abs(ratio - 1).argmax(axis=0), np.arange(self._seeds)]
        on = {name: of / self._frames[name] for name, of in self._on.items()}
        return Result(self._false / self._idle, on, error, self._left)


def run(
    trials: Sequence[Trial], rule: Callable[..., Rule] = Baseline, seeds: int = 20, rate_hz: float = 20.0, seed: int = 1
) -> list[Result]:
    """Let a rule see trials side by side, each seed of each trial as a patch; those of one run have one ``rule``."""
    skins = []
    for number, trial in enumerate(trials):
        skin = Skin(seeds, rate_hz, np.random.default_rng([seed, number]), **trial.how)
        trial.make(skin)
        skins.append(skin)
    judges = [_Judge(trial, skin) for trial, skin in zip(trials, skins, strict=True)]
    taxel = np.arange(len(trials) * seeds * TAXELS)
    baseline = rule(taxel // (TAXELS // MODULES), taxel // TAXELS, **trials[0].rule)
    until_s = max(trial.until_s for trial in trials)
    for blocks in zip(*(skin.blocks(until_s) for skin in skins), strict=True):
        time_s = blocks[0][0]
        values, truth, usable = (np.concatenate([block[k] for block in blocks], axis=1) for k in (1, 2, 3))
        touched, value = np.zeros(values.shape, bool), np.zeros(values.shape, np.float32)
        for row, at_s in enumerate(time_s):
            calm = baseline.update(1_000_000_000 + round(at_s * 1e9), values[row], usable[row])
            touched[row], value[row] = calm.touched, calm.value
        for number, judge in enumerate(judges):
            columns = slice(number * seeds * TAXELS, (number + 1) * seeds * TAXELS)
            judge.see(time_s, touched[:, columns], value[:, columns], truth[:, columns])
    return [judge.result() for judge in judges]


def _loosened(skin: Skin, held_s: float, force: float) -> None:
    for module, share in enumerate((0.1, 0.2, 0.3, 0.5)):
        at = 120 + np.array([0, 0.2, held_s, held_s + 0.3, held_s + 600, held_s + 600.2])
        skin.press(module, at, [0, force, force, share * force, share * force, 0])


def _loosen(held_s: float, drift: float, force: float) -> Trial:
    begin = 120 + held_s + 1
    held = tuple((f"{s} %", 12 * m + _CENTRE, begin, begin + 598) for m, s in enumerate((10, 20, 30, 50)))
    return Trial(
        f"loosened after {held_s:g} s, {force:g} counts, {drift:g}/min",
        120 + held_s + 630,
        lambda skin: _loosened(skin, held_s, force),
        held=held,
        within=0.2,
        over_s=120 + held_s + 605,
        how={"drift_per_min": drift},
    )


def _grasps(share: float, drift: float, **how: float) -> Trial:
    return Trial(
        f"grasps on {100 * share:g} %, {drift:g}/min{''.join(f', {k} {v}' for k, v in how.items())}",
        1840,
        lambda skin: skin.grasp(share, 25, 1820),
        over_s=1826,
        how={"drift_per_min": drift, **how},
        held=(("grasp", 3, 20.4, 24.4), ("late", 3, 1500.4, 1504.4)),
        on=0.95,
    )


def _wave(counts: float, period_s: float) -> Callable[[Skin], None]:
    def make(skin: Skin) -> None:
        phase = skin.random.uniform(0, 2 * np.pi, skin.seeds)
        skin.common.append(lambda t: counts * np.sin(2 * np.pi * t[:, None] / period_s + phase))
        skin.press(1, [30, 30.2, 330, 330.2], [0, 25, 25, 0])

    return make


def _sine(counts: float, period_s: float) -> Trial:
    return Trial(
        f"common sine of {counts:g} counts at {period_s:g} s",
        420,
        _wave(counts, period_s),
        held=(("hold", 12 + _CENTRE, 31, 329),),
        over_s=335 if counts < 20 else None,
        how={"drift_per_min": 0.5, "idle": 40.0},
    )


def _cup(skin: Skin) -> None:
    """A cup on ten taxels for 5 minutes that warms them and those around; it cools down after that."""
    for begin_s in (60.0, 800.0):
        at = begin_s + np.array([0, 0.5, 300, 300.5])
        load, warm = np.zeros(TAXELS), np.zeros(TAXELS)
        load[12:22], warm[12:22], warm[6:12], warm[22:30] = 40, 8, 3, 3

        def press(t: Floats, at: Floats = at, load: Floats = load) -> Floats:
            pressed: Floats = np.interp(t, at, [0, 1, 1, 0])[:, None, None] * load
            return pressed

        def heat(t: Floats, begin_s: float = begin_s, warm: Floats = warm) -> Floats:
            up = np.where(t < begin_s, 0, 1 - np.exp(-np.maximum(np.minimum(t - begin_s, 300.0), 0) / 90))
            now = up * np.exp(-np.maximum(t - begin_s - 300, 0) / 90)
            got: Floats = now[:, None, None] * warm
            return got

        skin.loads.append(press)
        skin.apart.append(heat)


def _humidity(skin: Skin) -> None:
    """Twelve counts in 2 minutes, with gains that are others than those of the temperature."""
    other = np.clip(1 + 0.3 * skin.random.standard_normal((skin.seeds, TAXELS)), 0.1, 3)
    skin.apart.append(lambda t: np.interp(t, [100, 220, 500, 700], [0, 12, 12, 0])[:, None, None] * other)
    skin.press(1, [150, 150.2, 450, 450.2], [0, 25, 25, 0])


def _spikes(skin: Skin) -> None:
    """One frame in two hundred, on every taxel by itself."""

    def spikes(t: Floats) -> Floats:
        return np.where(skin.random.random((len(t), skin.seeds, TAXELS)) < 0.005, 60.0, 0.0)

    skin.apart.append(spikes)
    skin.press(1, [30, 30.2, 250, 250.2], [0, 25, 25, 0])


def _held(skin: Skin) -> None:
    skin.press(1, [30, 30.2, 250, 250.2], [0, 25, 25, 0])


def _module_steps(skin: Skin) -> None:
    """A board moves its own baseline by 3 to 8 counts, up or down, every minute."""
    steps = skin.random.uniform(3, 8, (20, skin.seeds)) * skin.random.choice([-1, 1], (20, skin.seeds))
    module = skin.random.integers(0, MODULES, (20, skin.seeds))
    moved = (steps[..., None] * (module[..., None] == np.arange(TAXELS) // 12)).cumsum(axis=0)
    moved = np.concatenate([np.zeros((1, skin.seeds, TAXELS)), moved])
    skin.apart.append(lambda t: moved[np.clip((t // 60).astype(int), 0, 20)])


def _covered(skin: Skin) -> None:
    load = np.zeros(TAXELS)
    load[:24] = 40
    skin.loads.append(lambda t: np.interp(t, [40, 40.2], [1, 0])[:, None, None] * load)
    skin.press(1, [60, 60.2, 120, 120.2], [0, 25, 25, 0])


def _sitting(share: float) -> Callable[[Skin], None]:
    """Two hours on a seat."""

    def make(skin: Skin) -> None:
        load = np.zeros(TAXELS)
        load[: round(share * TAXELS)] = 60
        skin.loads.append(lambda t: np.interp(t, [60, 61, 7200, 7201], [0, 1, 1, 0])[:, None, None] * load)

    return make


def _levels(skin: Skin) -> None:
    """Taxels with few levels, pressed again and again, some for long."""
    load = np.zeros(TAXELS)
    load[[5, 17, 18]] = skin.maximum
    skin.loads.append(
        lambda t: (
            (np.interp((t - 20) % 10, [0, 0.05, 6, 6.05], [0, 1, 1, 0], right=0.0) * ((t > 20) & (t < 180)))[
                :, None, None
            ]
            * load
        )
    )
    skin.press(3, [20, 20.05, 300, 300.05], [0, skin.maximum, skin.maximum, 0])


def _taps(force: float) -> Callable[[Skin], None]:
    def make(skin: Skin) -> None:
        skin.press(
            1,
            np.ravel([[30 + 10 * k, 30.1 + 10 * k, 34.9 + 10 * k, 35 + 10 * k] for k in range(30)]),
            [0, force, force, 0] * 30,
        )

    return make


def _log(load: Floats) -> Floats:
    """A response that is steep at first and saturates."""
    answer: Floats = 40 * np.log1p(load / 10)
    return answer


TRIALS: tuple[Trial, ...] = (
    *(_loosen(held, drift, 100) for held in (1, 10, 60, 600, 1800) for drift in (0.5, 3.0)),
    *(_grasps(share, drift) for share in (0.3, 0.6, 0.8, 1.0) for drift in (0.5, 3.0)),
    _grasps(0.6, 3.0, remainder=0.2),
    *(_sine(counts, period) for counts in (1, 4, 10) for period in (0.1, 0.33, 1, 5, 20, 100)),
    Trial("warm cup", 1500, _cup, how={"drift_per_min": 0.5}, held=(("cup", 15, 62, 359),)),
    Trial("humidity", 800, _humidity, held=(("hold", 12 + _CENTRE, 151, 449),), over_s=456, how={"drift_per_min": 0.5}),
    Trial("spikes", 300, _spikes, held=(("hold", 12 + _CENTRE, 31, 249),), how={"drift_per_min": 0.5}),
    Trial(
        "30 % lost",
        300,
        _held,
        held=(("hold", 12 + _CENTRE, 31, 249),),
        over_s=255,
        how={"lost": 0.3, "drift_per_min": 3.0},
    ),
    Trial("steps of a module", 1200, _module_steps),
    Trial(
        "covered at the start",
        200,
        _covered,
        held=(("press", 12 + _CENTRE, 61, 119),),
        over_s=123,
        how={"drift_per_min": 3.0},
        quiet=(0, 42),
    ),
    Trial(
        "two hours on half a patch",
        7260,
        _sitting(0.5),
        held=(("seat", 10, 62, 7199),),
        over_s=7206,
        how={"drift_per_min": 0.5},
    ),
    Trial(
        "two hours on a whole patch",
        7260,
        _sitting(1.0),
        held=(("seat", 10, 62, 7199),),
        over_s=7206,
        how={"drift_per_min": 0.25, "idle": 40.0},
    ),
    Trial(
        "binary",
        330,
        _levels,
        held=(("hold", 41, 21, 299),),
        over_s=303,
        how={"noise": 0.0, "spread": 0.0, "idle": 0.0, "maximum": 1.0},
        alone=True,
    ),
    Trial(
        "three levels",
        330,
        _levels,
        held=(("hold", 41, 21, 299),),
        over_s=303,
        how={"noise": 0.05, "spread": 0.0, "idle": 0.0, "maximum": 2.0},
        alone=True,
    ),
    Trial(
        "three counts",
        360,
        _taps(3.0),
        held=(("press", 12 + _CENTRE, 120.4, 124.8), ("later", 12 + _CENTRE, 310.4, 314.8)),
        on=0.95,
        how={"noise": 0.35, "drift_per_min": 0.5},
    ),
    Trial(
        "logarithmic",
        420,
        _wave(1, 60),
        held=(("hold", 12 + _CENTRE, 31, 329),),
        over_s=335,
        how={"answer": _log, "drift_per_min": 0.5},
    ),
    Trial(
        "saturating",
        420,
        _wave(1, 60),
        held=(("hold", 12 + _CENTRE, 31, 329),),
        over_s=335,
        how={"maximum": 30.0, "drift_per_min": 0.5},
    ),
)
