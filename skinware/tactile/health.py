"""Judge the health of taxels by what they showed in use, and report it with the evidence.

An untouched taxel looks like one that feels nothing, unless both its sides are touched: a thing that presses two taxels
presses those between them. In a contact that falls off to its edges as a bell does, a taxel in the middle shows at
least the geometric mean of both sides. That is its *due*. Taxels at a corner lie between no two others: only a wipe
test finds out whether they feel anything.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S
from skinware.structure import Structure
from skinware.tactile.arrays import Bytes, Columns, Doubles, Flags, Floats, Whole, check_state
from skinware.tactile.baseline import Calm, resolution_of
from skinware.tactile.health_evidence import Dues, Noise, Use
from skinware.tactile.health_relations import Copies, Dropouts, Twins, median_around
from skinware.tactile.neighbours import Table, neighbours

_CLEAR = 8.0  # times the noise: a touch this high is no flicker
_LEAST_NOISE = 0.5  # steps of the values: no taxel counts as quieter
_ALIKE = 0.9  # correlation with the touches of another taxel, from which a taxel shows them
_SAME = 0.7  # part of another's touches, from which both are shorted
_SQUARES, _OTHER_SQUARES = 0.0003, 0.03
"""Squared difference in parts of the squares: at most that of shorted neighbours, at least that of others."""
_EXCHANGED = 0.5  # share of what is due to another weak taxel, from which a weak taxel is at its place
_OFTEN = 5.0  # times the dropouts of three quarters of the others
_USUAL = 0.1
"""Share of the time: where typical taxels are at an end of the range for longer, that end is where they rest."""


class HealthKind(enum.IntEnum):
    """The judgement of a taxel; where several apply, the highest."""

    GOOD = 0
    """Nothing is known to be wrong."""
    NEVER_TOUCHED = 1
    """Nothing has touched it yet, so nothing is known."""
    WEAK = 2
    """It shows far less of its touches than its neighbours show of theirs."""
    DYING = 3
    """It shows far less of its touches than it did before."""
    DEAD = 4
    """It shows nothing when both its sides are pressed."""
    CROSSTALK = 5
    """It shows a part of the touches of another taxel of its module."""
    NOISY = 6
    """Its noise is far above that of the typical taxel."""
    INTERMITTENT = 7
    """It loses its value again and again for a moment, while its neighbours keep theirs."""
    SWAPPED = 8
    """It shows what presses the place of another taxel: their wires or uids are exchanged."""
    SHORTED = 9
    """It shows the same as another taxel."""
    STUCK = 10
    """Its value does not change, whatever happens around it."""
    CLIPPED = 11
    """It is at an end of the range, untouched: there is no room left for a touch, or for its drift."""


@dataclass(frozen=True, eq=False)
class HealthReport:
    """The health of n taxels, with the evidence: arrays (n,), whose meaning is in :data:`COLUMNS`.

    NaN: not known (yet). ``other`` is the number of a taxel among the n.
    """

    kind: Bytes
    value: Floats
    still_s: Floats
    peak: Floats
    noise: Floats
    noise_times: Floats
    clipped: Floats
    touches: npt.NDArray[np.uint32]
    shown: Floats
    shown_around: Floats
    recent: Floats
    best: Floats
    dropouts: Floats
    other: npt.NDArray[np.int32]
    other_shown: Floats

    @classmethod
    def unknown(cls, n: int) -> Self:
        """Make a report of n taxels about which nothing is known."""
        return cls(**{name: np.full(n, NOTHING[name], dtype) for name, (dtype, *_) in COLUMNS.items()})

    @property
    def faulty(self) -> Flags:
        """(n,) bool: which taxels have a fault."""
        faulty: Flags = self.kind > HealthKind.NEVER_TOUCHED
        return faulty

    def evidence(self, taxel: int, unit: str = "", other: str = "") -> str:
        """Return the reason for the kind of a taxel in words, with its unit and the name of the one that it shows."""
        of = {name: getattr(self, name)[taxel].item() for name in COLUMNS}
        of |= {name: 100 * of[name] for name in _SHARES}
        words = {"unit": f" {unit}".rstrip(), "other": other or f"taxel {of['other']}", "shown": max(of["shown"], 0)}
        return _EVIDENCE.get(HealthKind(of["kind"]), "").format(**of | words)


_SHARES = ("clipped", "shown", "shown_around", "recent", "best", "other_shown")
_OF_DUE = "shows {shown:.0f} % of what presses both its sides"
_OF_OTHER = "shows {other_shown:.0f} % of what presses {other}"
_EVIDENCE = {
    HealthKind.WEAK: _OF_DUE + ", in {touches} touches; its neighbours show {shown_around:.0f} %",
    HealthKind.DYING: "shows {recent:.0f} % of what presses both its sides; it showed {best:.0f} %",
    HealthKind.DEAD: _OF_DUE + ", in {touches} touches",
    HealthKind.CROSSTALK: _OF_OTHER,
    HealthKind.NOISY: "noise {noise:.3g}{unit}, {noise_times:.1f} times that of the others",
    HealthKind.INTERMITTENT: "lost its value about {dropouts:.0f} times in ten minutes, unlike its neighbours",
    HealthKind.SWAPPED: "shows what presses {other}",
    HealthKind.SHORTED: _OF_OTHER,
    HealthKind.STUCK: "at {value:.4g}{unit} for {still_s:.0f} s, while its module was touched",
    HealthKind.CLIPPED: "at {value:.4g}{unit}, an end of the range, for {clipped:.0f} % of the time",
}


COLUMNS: Columns = {
    "kind": ("u1", (), "", ", ".join(f"{kind:d}: {kind.name.lower().replace('_', ' ')}" for kind in HealthKind)),
    "value": ("<f4", (), "", "the newest, in the unit of the type"),
    "still_s": ("<f4", (), "s", "for how long it has not changed"),
    "peak": ("<f4", (), "", "the most that a touch showed, in the unit of the type"),
    "noise": ("<f4", (), "", "standard deviation, in the unit of the type"),
    "noise_times": ("<f4", (), "", "the same in multiples of the typical sensor's"),
    "clipped": ("<f4", (), "", "share of the time at an end of the range"),
    "touches": ("<u4", (), "", "separate touches of both its sides"),
    "shown": ("<f4", (), "", "share of its due that it showed in them"),
    "shown_around": ("<f4", (), "", "share that its neighbours showed; only where that is much more"),
    "recent": ("<f4", (), "", "mean share of its last 10 hard touches"),
    "best": ("<f4", (), "", "largest of these means so far"),
    "dropouts": ("<f4", (), "", "how often it lost its value; half of it is forgotten in ten minutes"),
    "other": ("<i4", (), "", "position of the sensor whose touches it shows; -1: none"),
    "other_shown": ("<f4", (), "", "part of them that it shows"),
}
"""Dtype, shape, unit and meaning, per taxel, of each array of a :class:`HealthReport`."""
NOTHING: dict[str, float] = {name: math.nan if dtype == "<f4" else 0 for name, (dtype, *_) in COLUMNS.items()} | {
    "dropouts": 0,
    "other": -1,
}
"""The value in each array where nothing is known."""


class HealthSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The limits beyond which a taxel counts as faulty. Times are in seconds, whatever the rate.

    Attributes:
        stuck_s: stuck without any change for this long, while its module was touched.
        touches: separate touches that are needed for stuck or dead; for weak, twice as many.
        noisy: this many times the median noise of all.
        noise_s: how long one measurement of noise takes.
        clipped: at an end of the range for more than this share of that time.
        dead: it shows less than this share of its due.
        weak: its share is less than this part of its neighbours' shares (their median).
        dying: its share fell to less than this part of the best that it showed, those of its neighbours (their median)
            set to 1.
        dropouts: intermittent with this many losses of its value, half of them forgotten in ten minutes; and with five
            times as many as three quarters of the others.
        crosstalk: it shows at least this part of the touches of a taxel that is no neighbour.

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
    dying: float = 0.5
    dropouts: float = 5.0
    crosstalk: float = 0.05

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
        self._neighbours: Table = np.zeros((n, 0), np.int32) if geometry is None else neighbours(geometry)
        self._begun_ns: int | None = None
        self._now_s = 0.0
        self._use = Use(self._module, self.settings.touches, limits)
        self._noise = Noise(self._use.arrays["sums"].reshape(3, n), self.settings.noise_s)
        self._dues = Dues(geometry, self._neighbours)
        self._dropouts = Dropouts(self._neighbours)
        self._copies, self._twins = (
            Copies(self._module, self._neighbours, self._use.arrays["total"]),
            Twins(self._neighbours),
        )
        self._clear = _CLEAR * self._least_noise  # a touch above it is clear

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
        """Take the next sample in: when it was, its (n,) values, and what the baseline made of them."""
        given = np.asarray(values, np.float32)
        self._begun_ns = time_ns if self._begun_ns is None else self._begun_ns
        before_s, self._now_s = self._now_s, max(self._now_s, (time_ns - self._begun_ns) / NS_PER_S)
        use = self._use
        has_moved = use.compare(given, calm, self._clear)
        if self._noise.ends(self._now_s):
            self._clear = _CLEAR * self._typical_noise()
            self._dropouts.forget(self.settings.noise_s)
            shown = self._dues.share_shown(self.settings.touches)
            self._dues.exchanges.watch(np.flatnonzero(shown < self.settings.weak))
            use.arrays["misled"][:] = self._related(shown)[0] > 0
        if has_moved:
            self._dropouts.add(self._now_s, use.arrays, calm)
        is_hard, is_plain = use.take(self._now_s, self._now_s - before_s, self._clear)
        above, noise = use.arrays["above"], self._clear / _CLEAR
        self._dues.frames += 1
        if is_hard:
            self._dues.add(self._now_s, above, calm, use.arrays["hard"])
        self._copies.add(self._now_s, noise)
        if is_plain:
            self._twins.add(self._now_s, above, use.arrays["plain"], calm, noise)

    def report(self) -> HealthReport:
        """Judge the taxels; meant for once a second or so."""
        settings, use, dues = self.settings, self._use, self._dues
        shown = dues.share_shown(settings.touches)
        shown_around = median_around(self._neighbours, shown, settings.weak)
        kept = np.where(dues.best > 0, np.minimum(dues.recent, 1), math.nan) / np.fmax(dues.best, 1e-9)
        typical = self._typical_noise()
        noise, at_end = self._noise.deviation, self._noise.at_end
        noise_times = noise / np.float32(typical or math.nan)
        still_s = np.where(use.seen, self._now_s - use.changed_s, math.nan)
        weak, dead = shown < settings.weak * shown_around, shown < settings.dead
        known = at_end[np.isfinite(at_end)]
        rests_at_end = bool(len(known)) and float(np.median(known)) > _USUAL  # hardware that cuts off its own noise
        least, most = self._limits
        is_end = ((use.value <= least) | (use.value >= most)) & (not rests_at_end)
        stuck = self._stuck(still_s, dead)
        shows_other, other, other_shown = self._related(shown)
        often = max(settings.dropouts, _OFTEN * float(np.percentile(self._dropouts.count, 75)))
        kind = np.zeros(len(still_s), np.uint8)
        for name, where in (
            (HealthKind.NEVER_TOUCHED, use.seen & (use.peak <= _CLEAR * np.fmax(noise, typical))),
            (HealthKind.WEAK, weak & (dues.touches >= 2 * settings.touches)),
            (HealthKind.DYING, kept < settings.dying * median_around(self._neighbours, kept, settings.dying)),
            (HealthKind.DEAD, dead),
            (HealthKind.CROSSTALK, shows_other == HealthKind.CROSSTALK),
            (HealthKind.NOISY, noise_times > settings.noisy),
            (HealthKind.INTERMITTENT, self._dropouts.count >= often),
            (HealthKind.SWAPPED, shows_other == HealthKind.SWAPPED),
            (HealthKind.SHORTED, shows_other == HealthKind.SHORTED),
            (HealthKind.STUCK, stuck),
            (HealthKind.CLIPPED, is_end & (stuck | (at_end > settings.clipped))),
        ):
            kind[where] = name
        arrays: dict[str, npt.NDArray[np.generic]] = {
            "kind": kind,
            "value": use.value,
            "still_s": still_s,
            "peak": use.peak,
            "noise": noise,
            "noise_times": noise_times,
            "clipped": at_end,
            "touches": dues.touches,
            "shown": shown,
            "shown_around": shown_around,
            "recent": np.where(dues.hard_touches > 0, dues.recent, math.nan),
            "best": np.where(dues.best > 0, dues.best, math.nan),
            "dropouts": self._dropouts.count,
            "other": other,
            "other_shown": other_shown,
        }
        return HealthReport(**{name: arrays[name].astype(dtype) for name, (dtype, *_) in COLUMNS.items()})

    def _related(self, shown: Doubles) -> tuple[Bytes, Whole, Doubles]:
        """(n,) the fault of taxels that show what presses others, those others, and how much of it they show."""
        settings, n = self.settings, len(shown)
        kind, other, part = np.zeros(n, np.uint8), np.full(n, -1), np.full(n, math.nan)

        def note(of: HealthKind, taxels: Whole, others: Whole, shares: Doubles) -> None:
            kind[taxels], other[taxels], part[taxels] = of, others, shares

        copied, origin, share = self._copies.found(settings.crosstalk, _ALIKE, 2 * settings.touches)
        note(HealthKind.CROSSTALK, copied, origin, share)
        same = share >= _SAME
        note(HealthKind.SHORTED, copied[same], origin[same], share[same])
        same &= ~(shown[copied] < settings.weak)  # otherwise it may be at another place
        note(HealthKind.SHORTED, origin[same], copied[same], share[same])
        taxels, others = self._twins.found(_SQUARES, _OTHER_SQUARES, 2 * settings.touches)
        note(HealthKind.SHORTED, taxels, others, np.ones(len(taxels)))
        taxels, others = self._dues.exchanges.found(_EXCHANGED, settings.touches)
        note(HealthKind.SWAPPED, taxels, others, np.full(len(taxels), math.nan))
        return kind, other, part

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return what is known, by name: arrays (n, ...), copies; times are how long ago, s."""
        return {name: array.copy() for name, array in self._known().items()} | {
            "still_s": self._now_s - self._use.changed_s,
            "module_touched_s": (self._now_s - self._use.module_touched_s)[self._module],
        }

    def restore(self, state: Mapping[str, npt.NDArray[Any]], rows: npt.NDArray[np.integer]) -> None:
        """Go on with the state of m taxels, in which (n,) ``rows`` say where each taxel stands; -1: nowhere.

        Raises:
            ConfigurationError: that is no such state.
        """
        check_state("health", state, self.state(), rows)
        here = rows >= 0
        then = rows[here]
        for name, array in self._known().items():
            array[here] = state[name][then]
        self._use.changed_s[here] = self._now_s - state["still_s"][then]
        touched_s = self._now_s - state["module_touched_s"][then]
        np.maximum.at(self._use.module_touched_s, self._module[here], touched_s)
        self._clear = _CLEAR * self._typical_noise()

    def _known(self) -> dict[str, npt.NDArray[Any]]:
        dues, use, noise = self._dues, self._use, self._noise
        of_touches = {"due": dues.due, "shown": dues.shown, "touches": dues.touches}
        of_shares = {"hard_touches": dues.hard_touches, "recent": dues.recent, "best": dues.best}
        of_values = {"value": use.value, "peak": use.peak, "usual": use.usual}
        return of_touches | of_shares | of_values | {"noise": noise.deviation, "at_end": noise.at_end}

    def _typical_noise(self) -> float:
        known = self._noise.deviation[np.isfinite(self._noise.deviation)]
        return max(float(np.median(known)) if len(known) else 0.0, self._least_noise)

    def _stuck(self, still_s: Doubles, dead: Flags) -> Flags:
        """Whether taxels have not changed for long, although their module was touched, and nothing holds them now."""
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
