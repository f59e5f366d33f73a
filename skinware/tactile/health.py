"""Judge the health of taxels, by what they showed in use.

::

    baseline, health = Baseline(module, patch), Health(module, geometry)
    for time_ns, values in ...:
        calm = baseline.update(time_ns, values)
        health.update(time_ns, values, calm)
    report = health.report()
    for taxel in np.flatnonzero(report.faulty):
        print(taxel, report.evidence(taxel, "counts"))

An untouched taxel looks like one that feels nothing, unless both its sides are touched: a thing that presses two taxels
presses those between them. In a contact that falls off to its edges as a bell does, a taxel in the middle shows at
least the geometric mean of both sides. That is its *due*. Taxels at a corner lie between no two others: only a wipe
test finds out whether they feel anything.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Self

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S
from skinware.structure import Structure
from skinware.tactile.baseline import Calm
from skinware.tactile.dues import MOST_PAIRS, Dues, Pairs
from skinware.tactile.echoes import Echoes, Steps
from skinware.tactile.health_evidence import Drops, Noise, Use, Whole
from skinware.tactile.health_report import COLUMNS, HealthKind, HealthReport
from skinware.tactile.neighbours import NONE, Table, neighbours
from skinware.tactile.rule import resolution_of

_CLEAR = 8.0
"""Times the noise: a touch this high is no flicker."""
_HARD = 0.25
"""Share of what a taxel usually shows at most: less is the rest of a touch, and no other touch."""
_LEAST_NOISE = 0.5
"""Steps of the values: no taxel counts as quieter."""
_FEWEST_AROUND = 3
"""Neighbours with a known share that a comparison with neighbours needs."""
_SURE = 5.0
"""Standard errors: a trend is no chance."""
_OWN = 0.4
"""Share of the load at a place: a taxel that shows less of it is not at that place, one that shows more is."""
_AS_ONE = 0.2
_LEVEL = 0.06
"""Share of a step between both sides of two neighbours: if they show less of it, they are one."""
_USUAL = 0.1
"""Share of the time: where typical taxels are at an end of the range for longer, that end is where they rest."""

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


class HealthSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The limits beyond which a taxel counts as faulty. Times are in seconds, whatever the rate.

    Attributes:
        stuck_s: stuck without any change for this long, while its module was touched.
        touches: separate touches that are needed for stuck, dead or intermittent; for weak or shorted, twice as many.
        noisy: this many times the median noise of all.
        noise_s: how long one measurement of noise takes.
        clipped: at an end of the range for more than this share of that time.
        dead: it shows less than this share of its due.
        weak: its share is less than this part of its neighbours' shares (their median).
        lost: dying if it lost this part of its share.

    Raises:
        ConfigurationError: a value that makes no sense; the message says which.
    """

    stuck_s: float = 600.0
    touches: int = 3
    noisy: float = 4.0
    noise_s: float = 10.0
    clipped: float = 0.5
    dead: float = 0.1
    weak: float = 0.25
    lost: float = 0.3

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigurationError(f"{name} = {getattr(self, name)}: give a number above 0")


class Health:
    """Follows the health of the n taxels of one sensor type of one driver, beside their baselines.

    Args:
        module: (n,) int, the module of each taxel.
        geometry: places of the n taxels; None, or NaN in it: not known. Such taxels are never called dead or weak.
        settings: default: those of the class.
        resolution: the step of the values; 0 if they have none.
        limits: the least and the largest possible value; infinite where there is no end.

    Raises:
        ConfigurationError: places of another number of taxels.
    """

    def __init__(
        self,
        module: npt.ArrayLike,
        geometry: Geometry | None = None,
        settings: HealthSettings | None = None,
        *,
        resolution: float = 1.0,
        limits: tuple[float, float] = (-math.inf, math.inf),
    ) -> None:
        self._module = np.asarray(module, np.intp)
        n = len(self._module)
        if geometry is not None and len(geometry) != n:
            raise ConfigurationError(f"health of {n} taxels: the places are of {len(geometry)}")
        self.settings = settings or HealthSettings()
        self._limits = limits
        self._least_noise = _LEAST_NOISE * resolution
        geometry = geometry if geometry is not None else Geometry.unknown([""] * n, np.zeros(n, np.uint64))
        self._neighbours: Table = neighbours(geometry)
        pairs = Pairs(geometry, self._neighbours)
        self._begun_ns: int | None = None
        self._now_s = 0.0
        self._noise = Noise(n, self.settings.noise_s)
        self._use = Use(self._module, self.settings.touches)
        self._dues, self._drops = Dues(pairs), Drops(self._neighbours)
        self._echoes, self._steps = Echoes(pairs.ring), Steps(pairs)
        self._clear = _CLEAR * self._least_noise
        """A touch above it is clear."""

    @classmethod
    def of(cls, structure: Structure, type_name: str, settings: HealthSettings | None = None) -> Self:
        """Make one for the sensors of a type of one driver, in the order of ``structure.index(type_name)``.

        Raises:
            StructureError: no such type here.
            ConfigurationError: neighbours cannot be found from the places.
        """
        sensor_type = structure.type(type_name)
        return cls(
            structure.module_of(type_name),
            None if structure.geometry is None else structure.geometry[structure.index(type_name)],
            settings,
            resolution=resolution_of(structure, type_name),
            limits=(sensor_type.minimum, sensor_type.maximum),
        )

    def update(self, time_ns: int, values: npt.ArrayLike, calm: Calm) -> None:
        """Take the next frame in.

        Args:
            time_ns: of the frame, as for the baseline.
            values: (n,) as for the baseline, in the unit of the type.
            calm: what the baseline made of it.
        """
        given = np.asarray(values, np.float32)
        self._begun_ns = time_ns if self._begun_ns is None else self._begun_ns
        before_s, self._now_s = self._now_s, max(self._now_s, (time_ns - self._begun_ns) / NS_PER_S)
        passed_s = self._now_s - before_s
        far = np.fmax(np.float32(_CLEAR) * calm.noise, np.float32(self._clear))
        low, free = given < calm.baseline - far, calm.usable & ~calm.touched & (given <= calm.baseline + far)
        difference = given - self._use.value
        if self._noise.add(self._now_s, difference, self._is_at_end(given), low, free, calm):
            self._clear = _CLEAR * self._typical_noise()
        self._use.add(self._now_s, passed_s, given, calm)
        self._drops.add(self._now_s, low & (difference < -0.8 * far), low, self._use, self._module)
        hard = self._use.touched & (calm.value > np.maximum(self._clear, _HARD * self._use.usual))
        if hard.any():
            deviation = given - calm.baseline
            due = self._dues.add(self._now_s, deviation, calm.usable, hard)
            self._steps.add(self._now_s, deviation, calm.usable, hard)
            self._echoes.add(self._now_s, deviation, self._use.touched, hard, due, self._clear)

    def report(self) -> HealthReport:
        """Judge the taxels; meant for once a second or so."""
        settings, use, dues = self.settings, self._use, self._dues
        typical, noise, at_end = self._typical_noise(), self._noise.deviation, self._noise.at_end
        noise_times = noise / np.float32(typical or math.nan)
        still_s = np.where(use.seen, self._now_s - use.changed_s, math.nan)
        known = at_end[np.isfinite(at_end)]
        rests_at_end = bool(len(known)) and float(np.median(known)) > _USUAL  # hardware that cuts off its own noise
        is_end = self._is_at_end(use.value) & (not rests_at_end)
        is_clipped, noisy = is_end & (at_end > settings.clipped), noise_times > settings.noisy
        intermittent = (dues.returns >= settings.touches) | (self._drops.count >= settings.touches)
        swapped, shorted, crosstalk, partner, echo = self._confused()
        dues.distrusted = is_clipped | noisy | intermittent | (partner >= 0)
        shown, touches = dues.shown(settings.touches)
        shown_around = self._share_around(shown)
        weak, dead = shown < settings.weak * shown_around, shown < settings.dead
        weak &= touches >= 2 * settings.touches
        lost, error = dues.trend()
        stuck = self._stuck(still_s, dead)
        suspects = ((weak | dead) & ~stuck) | self._echoes.often_alone(settings.touches)
        self._echoes.watch(np.flatnonzero(suspects))
        kind = np.zeros(len(still_s), np.uint8)
        for name, where in (
            (HealthKind.NEVER_TOUCHED, use.seen & (use.peak <= _CLEAR * np.fmax(noise, typical))),
            (HealthKind.WEAK, weak),
            (HealthKind.DYING, (lost > settings.lost) & (lost > _SURE * error)),
            (HealthKind.CROSSTALK, crosstalk),
            (HealthKind.DEAD, dead),
            (HealthKind.SHORTED, shorted),
            (HealthKind.SWAPPED, swapped),
            (HealthKind.NOISY, noisy),
            (HealthKind.STUCK, stuck),
            (HealthKind.CLIPPED, is_clipped | (is_end & stuck)),
            (HealthKind.INTERMITTENT, intermittent),
        ):
            kind[where] = name  # of several, the last
        arrays: dict[str, npt.NDArray[np.generic]] = {
            "kind": kind,
            "value": use.value,
            "still_s": still_s,
            "peak": use.peak,
            "noise": noise,
            "noise_times": noise_times,
            "clipped": at_end,
            "touches": touches,
            "shown": shown,
            "shown_around": shown_around,
            "returns": dues.returns,
            "falls": self._drops.count,
            "lost": lost,
            "partner": partner,
            "echo": echo,
        }
        return HealthReport(**{name: arrays[name].astype(dtype) for name, (dtype, _) in COLUMNS.items()})

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return what is known, by name: arrays (n, ...), copies; times are how long ago, s."""
        return {name: array.copy() for name, array in self._known().items()} | {
            "still_s": self._now_s - self._use.changed_s,
            "module_touched_s": (self._now_s - self._use.module_touched_s)[self._module],
        }

    def restore(self, state: Mapping[str, npt.NDArray[Any]], rows: npt.NDArray[np.integer]) -> None:
        """Go on with what was known of taxels before.

        Args:
            state: what ``state`` returned, of m taxels.
            rows: (n,) where each taxel stands there; -1: nowhere.

        Raises:
            ConfigurationError: that is no such state.
        """
        here, m = rows >= 0, int(rows.max(initial=-1)) + 1
        for name, own in self.state().items():
            given = state.get(name)
            if given is None or given.dtype != own.dtype or given.shape[1:] != own.shape[1:] or len(given) < m:
                raise ConfigurationError(f"no state of health: {name} is missing or has a wrong shape or dtype")
        then = rows[here]
        for name, array in self._known().items():
            array[here] = state[name][then]
        self._use.changed_s[here] = self._now_s - state["still_s"][then]
        touched_s = self._now_s - state["module_touched_s"][then]
        np.maximum.at(self._use.module_touched_s, self._module[here], touched_s)
        self._clear = _CLEAR * self._typical_noise()

    def _known(self) -> dict[str, npt.NDArray[Any]]:
        dues, use, noise = self._dues, self._use, self._noise
        shares = {name: getattr(dues.shares, name).reshape(-1, MOST_PAIRS) for name in ("due", "shown", "touches")}
        of_touches = shares | {"returns": dues.returns, "falls": self._drops.count}
        of_values = {"value": use.value, "peak": use.peak, "usual": use.usual}
        return of_touches | of_values | {"noise": noise.deviation, "at_end": noise.at_end}

    def _confused(self) -> tuple[Flags, Flags, Flags, Whole, npt.NDArray[np.float64]]:
        """(n,) which are swapped, shorted, feel crosstalk; their partners, or -1; and the share of them they show."""
        n, touches = len(self._module), self.settings.touches
        swapped, shorted, crosstalk = (np.zeros(n, bool) for _ in range(3))
        partner, echo = np.full(n, -1, np.int64), np.full(n, math.nan)
        shown = self._dues.shares.share(touches).reshape(-1, MOST_PAIRS)
        dark = np.fmax.reduce(shown, axis=1) < _OWN
        found = self._echoes.found(dark)
        partner[found.taxel], echo[found.taxel] = found.partner, found.share
        is_swapped = dark[found.partner] & (found.share > _OWN)
        beside = ~is_swapped & ~dark[found.taxel]
        is_one = beside & (np.abs(found.alike - 1) < _AS_ONE)
        swapped[found.taxel[is_swapped]] = True
        crosstalk[found.taxel[beside & ~is_one]] = True
        level = self._steps.level(2 * touches, _LEVEL)
        for pairs, kind in (
            (np.column_stack([found.taxel, found.partner])[is_swapped], swapped),
            (np.column_stack([found.taxel, found.partner])[is_one], shorted),
            (level, shorted),
        ):
            kind[pairs] = True
            partner[pairs[:, 0]], partner[pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
        return swapped, shorted, crosstalk, partner, echo

    def _typical_noise(self) -> float:
        known = self._noise.deviation[np.isfinite(self._noise.deviation)]
        return max(float(np.median(known)) if len(known) else 0.0, self._least_noise)

    def _is_at_end(self, values: Floats) -> Flags:
        least, most = self._limits
        at_end: Flags = (values <= least) | (values >= most)
        return at_end

    def _stuck(self, still_s: npt.NDArray[np.float64], dead: Flags) -> Flags:
        """Find taxels that have not changed for long, although their module was touched, and that nothing holds now."""
        long = still_s >= self.settings.stuck_s
        found = np.zeros(len(long), bool)
        if not long.any():
            return found
        use = self._use
        others_change = float(np.median(still_s[use.seen])) < self.settings.stuck_s / 2
        rows = np.flatnonzero(long & (dead | others_change))
        module = self._module[rows]
        touched_since = use.module_touched_s[module, 0] > use.changed_s[rows]
        in_module = np.bincount(self._module[use.touched], minlength=len(use.module_touched_s))
        is_held = use.touched[rows] & (in_module[module] > 1)
        found[rows] = touched_since & ~is_held
        return found

    def _share_around(self, shown: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(n,) the median share of the neighbours, where it may be far above a taxel's own; else NaN."""
        around = np.full(len(shown), math.nan)
        most = np.nanmax(shown) if np.isfinite(shown).any() else 0.0
        rows = np.flatnonzero(shown < self.settings.weak * most)
        if len(rows):
            table = self._neighbours[rows]
            shares = np.sort(np.where(table == NONE, math.nan, shown[table]), axis=1)  # NaN comes last
            count = np.isfinite(shares).sum(axis=1)
            enough = count >= _FEWEST_AROUND
            median = shares[np.arange(len(rows)), np.maximum(count - 1, 0) // 2]
            around[rows[enough]] = median[enough]
        return around
