"""Health of taxels: which are stuck, noisy, clipped, dead or weak, by what they showed while people used them.

::

    baseline, health = Baseline(module, patch), Health(module, geometry)
    for time_ns, values in ...:
        calm = baseline.update(time_ns, values)
        health.update(time_ns, values, calm)
    report = health.report()
    for taxel in np.flatnonzero(report.faulty):
        print(taxel, report.evidence(taxel, "counts"))

A taxel that nobody touches cannot be told from one that feels nothing, unless what lies on both sides of it is touched:
a thing that presses two taxels presses those between them, and of contacts that fall off to their edges as a bell does,
a taxel in the middle shows at least the geometric mean of both. That is what each taxel should show (its *due*). Taxels
at a corner lie between no two others; only a wipe test finds out whether they feel anything.
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
from skinware.tactile.calm import Calm
from skinware.tactile.health_report import COLUMNS, HealthKind, HealthReport
from skinware.tactile.neighbours import NONE, Pairs, Table, neighbours
from skinware.tactile.resting import Noise

_APART_S = 1.0
"""Touches of a taxel with less time between them are one."""
_MODULE_APART_S = 5.0
"""The same of a whole module, of which fingers touch one part after the other."""
_KEPT = 0.95
"""Of what was seen before, with each touch: a taxel that was mended is good again after some."""
_CLEAR = 8.0
"""Times the noise: a touch that is no flicker."""
_HARD = 0.25
"""Of what a taxel usually shows at most: what stays for a while after a touch is no other touch."""
_LEAST_NOISE = 0.5
"""Of a step: no taxel counts as quieter than that."""
_MOST_AT_ONCE = 2048
"""Of more touched taxels only a part is looked at in a frame, in the next frame another one."""
_FEWEST_AROUND = 3
"""A taxel is compared with its neighbours if at least so many of them were touched as well."""
_USUAL = 0.1
"""If typical taxels are at an end of the range for more than this share of the time, that is where they rest."""

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


class HealthSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a taxel is called faulty. Times are in seconds, whatever the rate.

    Attributes:
        stuck_s: without any change for so long, while its module was touched.
        touches: so many separate touches are needed to call it stuck or dead, and twice as many to call it weak.
        noisy: so many times the median noise of all.
        noise_s: so long noise is measured at a time.
        clipped: at an end of the range for more than this share of that time.
        dead: it shows less than this share of its due.
        weak: its share is less than this part of what the shares of its neighbours are (their median).

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
        limits: what values can be, from and to; infinite where there is no end.

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
        self._neighbours: Table = np.zeros((n, 0), np.int32) if geometry is None else neighbours(geometry)
        self._pairs = None if geometry is None else Pairs(geometry, self._neighbours)
        self._begun_ns: int | None = None
        self._now_s = 0.0
        self._frames = 0
        self._seen = np.zeros(n, bool)
        self._touched = np.zeros(n, bool)
        self._value: Floats = np.full(n, np.nan, np.float32)
        self._changed_s = np.zeros(n)
        self._peak: Floats = np.zeros(n, np.float32)
        self._usual: Floats = np.zeros(n, np.float32)
        n_modules = int(self._module.max(initial=-1)) + 1
        self._module_touched_s = np.full((n_modules, self.settings.touches), -math.inf)
        self._due, self._shown = np.zeros(n), np.zeros(n)
        self._hardest_due, self._hardest_shown = np.zeros(n), np.zeros(n)
        self._touches = np.zeros(n, np.int64)
        self._weighed_s = np.full(n, -math.inf)
        self._noise = Noise(n, self.settings.noise_s)
        self._clear = _CLEAR * self._least_noise

    @classmethod
    def of(cls, structure: Structure, type_name: str, settings: HealthSettings | None = None) -> Self:
        """For the sensors of a type of one driver, in the order of ``structure.index(type_name)``.

        Raises:
            StructureError: no such type here.
            ConfigurationError: neighbours cannot be found from the places.
        """
        sensor_type = structure.type(type_name)
        return cls(
            structure.module_of(type_name),
            None if structure.geometry is None else structure.geometry[structure.index(type_name)],
            settings,
            resolution=0.0 if structure.dtype.kind == "f" else abs(sensor_type.scale),
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
        self._frames += 1
        self._measure(given, calm)
        self._note_changes(given, calm.usable, self._now_s - before_s)
        touched = calm.touched & calm.usable
        self._note_touches(touched, calm.value)
        if self._pairs is not None:
            hard = touched & (calm.value > np.maximum(self._clear, _HARD * self._usual))
            self._weigh(self._pairs, given, calm.baseline, hard, calm.usable)

    def report(self) -> HealthReport:
        """What is known now; meant for once a second or so."""
        shown = self._share_shown()
        shown_around = self._share_around(shown)
        typical = max(self._typical_noise(), self._least_noise)
        noise = self._noise.deviation
        noise_times = noise / np.float32(typical or math.nan)
        still_s = np.where(self._seen, self._now_s - self._changed_s, math.nan)
        weak, dead = shown < self.settings.weak * shown_around, shown < self.settings.dead
        is_end = self._is_at_end(self._value) & (not self._rests_at_end())
        stuck = self._stuck(still_s, dead)
        kind = np.zeros(len(still_s), np.uint8)
        for name, where in (
            (HealthKind.NEVER_TOUCHED, self._seen & (self._peak <= _CLEAR * np.fmax(noise, typical))),
            (HealthKind.WEAK, weak & (self._touches >= 2 * self.settings.touches)),
            (HealthKind.DEAD, dead),
            (HealthKind.NOISY, noise_times > self.settings.noisy),
            (HealthKind.STUCK, stuck),
            (HealthKind.CLIPPED, is_end & (stuck | (self._noise.at_end > self.settings.clipped))),
        ):
            kind[where] = name
        arrays: dict[str, npt.NDArray[np.generic]] = {
            "kind": kind,
            "value": self._value,
            "still_s": still_s,
            "peak": self._peak,
            "noise": noise,
            "noise_times": noise_times,
            "clipped": self._noise.at_end,
            "touches": self._touches,
            "shown": shown,
            "shown_around": shown_around,
        }
        return HealthReport(**{name: arrays[name].astype(dtype) for name, (dtype, _) in COLUMNS.items()})

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """What is known, by name: arrays (n, ...), copies; times are how long ago, s."""
        return {name: array.copy() for name, array in self._known().items()} | {
            "still_s": self._now_s - self._changed_s,
            "module_touched_s": (self._now_s - self._module_touched_s)[self._module],
        }

    def restore(self, state: Mapping[str, npt.NDArray[Any]], rows: npt.NDArray[np.integer]) -> None:
        """Go on with what was known of taxels before.

        Args:
            state: of ``state``, of m taxels.
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
        self._changed_s[here] = self._now_s - state["still_s"][then]
        np.maximum.at(self._module_touched_s, self._module[here], self._now_s - state["module_touched_s"][then])
        self._clear = _CLEAR * max(self._typical_noise(), self._least_noise)

    def _known(self) -> dict[str, npt.NDArray[Any]]:
        of_touches = {"due": self._due, "shown": self._shown, "touches": self._touches}
        of_values = {"value": self._value, "peak": self._peak, "usual": self._usual}
        return of_touches | of_values | {"noise": self._noise.deviation, "at_end": self._noise.at_end}

    # -- steps of one frame -------------------------------------------------------------------------------------

    def _note_changes(self, given: Floats, usable: Flags, passed_s: float) -> None:
        """Since when each value has been what it is; time without data does not count."""
        changed = usable & (given != self._value)
        np.copyto(self._changed_s, self._now_s, where=changed)
        if not usable.all():
            self._changed_s += passed_s * ~usable
        np.copyto(self._value, given, where=changed)
        self._seen |= usable

    def _note_touches(self, touched: Flags, value: Floats) -> None:
        """How hard each taxel was touched, and when its module was."""
        active = np.flatnonzero(touched)
        begun = active[~self._touched[active]]
        self._touched = touched
        self._usual[begun] *= _KEPT
        for most in (self._peak, self._usual):
            most[active] = np.maximum(most[active], value[active])
        if len(begun):
            module = np.unique(self._module[begun])
            last = self._module_touched_s[module]
            module, last = (of[self._now_s - last[:, -1] >= _MODULE_APART_S] for of in (module, last))
            self._module_touched_s[module] = np.column_stack([last[:, 1:], np.full(len(module), self._now_s)])

    def _weigh(self, pairs: Pairs, given: Floats, baseline: Floats, touched: Flags, usable: Flags) -> None:
        active = np.flatnonzero(touched)
        step = len(active) // _MOST_AT_ONCE + 1
        middle, one, other = pairs.around(active[self._frames % step :: step], touched)
        if not len(middle):
            return
        self._end_touches(np.unique(middle[self._now_s - self._weighed_s[middle] >= _APART_S]))
        self._weighed_s[middle] = self._now_s
        shown, left, right = (np.maximum(given[taxel] - baseline[taxel], 0) for taxel in (middle, one, other))
        due = np.sqrt(left * right)
        harder = np.flatnonzero(usable[middle] & (due > self._hardest_due[middle]))
        harder = harder[np.argsort(due[harder], kind="stable")]  # of several pairs round a taxel the hardest stays
        self._hardest_due[middle[harder]], self._hardest_shown[middle[harder]] = due[harder], shown[harder]

    def _end_touches(self, taxels: npt.NDArray[np.int64]) -> None:
        """Add up what these showed in their last touch, and begin another one."""
        due, shown = self._hardest_due[taxels], self._hardest_shown[taxels]
        self._due[taxels] = _KEPT * self._due[taxels] + due * due
        self._shown[taxels] = _KEPT * self._shown[taxels] + due * shown
        self._touches[taxels] += due > 0
        self._hardest_due[taxels] = 0

    def _measure(self, given: Floats, calm: Calm) -> None:
        """Noise, and time at an end of the range; both while not touched."""
        low = given < calm.baseline - np.fmax(np.float32(_CLEAR) * calm.noise, np.float32(self._clear))
        if self._noise.add(self._now_s, given - self._value, self._is_at_end(given), low, calm):
            self._clear = _CLEAR * max(self._typical_noise(), self._least_noise)

    # -- judging ------------------------------------------------------------------------------------------------

    def _typical_noise(self) -> float:
        known = self._noise.deviation[np.isfinite(self._noise.deviation)]
        return float(np.median(known)) if len(known) else 0.0

    def _is_at_end(self, values: Floats) -> Flags:
        least, most = self._limits
        at_end: Flags = (values <= least) | (values >= most)
        return at_end

    def _rests_at_end(self) -> bool:
        """Whether an end of the range is where untouched taxels are, as with hardware that cuts off its own noise."""
        known = self._noise.at_end[np.isfinite(self._noise.at_end)]
        return bool(len(known)) and float(np.median(known)) > _USUAL

    def _stuck(self, still_s: npt.NDArray[np.float64], dead: Flags) -> Flags:
        """Which have not changed for long, although something happened, and now nothing holds them."""
        long = still_s >= self.settings.stuck_s
        found = np.zeros(len(long), bool)
        if not long.any():
            return found
        rustles = float(np.median(still_s[self._seen])) < self.settings.stuck_s / 2
        rows = np.flatnonzero(long & (dead | rustles))
        module = self._module[rows]
        touched_since = self._module_touched_s[module, 0] > self._changed_s[rows]
        in_module = np.bincount(self._module[self._touched], minlength=len(self._module_touched_s))
        is_held = self._touched[rows] & (in_module[module] > 1)
        found[rows] = touched_since & ~is_held
        return found

    def _share_shown(self) -> npt.NDArray[np.float64]:
        """(n,) what each taxel showed of its due; NaN before there were touches enough."""
        known = (self._touches >= self.settings.touches) & (self._due > 0)
        shown: npt.NDArray[np.float64] = np.where(known, self._shown, math.nan) / np.where(known, self._due, 1)
        return shown

    def _share_around(self, shown: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(n,) the median of the shares of the neighbours, where it may be far above a taxel's own; else NaN."""
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
