"""Follow baselines: what each taxel would read if nothing touched it, while the hardware drifts and contacts last.

::

    baseline = Baseline.of(reader.structure, "pressure")
    for frame in reader.in_order():
        calm = baseline.take(frame)
        print(calm.value[calm.touched])     # 0 = no touch, in the type's unit

The rule works per taxel, with times from the frames and never from a nominal rate. A level above a taxel's own baseline
and noise is a touch, with hysteresis. A slow change that a patch has in common is drift, also of taxels in contact:
each has learned how strongly it follows. Taxels near a contact keep their own baselines, and for some seconds after it.
When most of a contact's load goes at once, it is over, and the rest counts as drift if drift can have made it.
:mod:`.rule` has all numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.drift import Drift, Sag
from skinware.tactile.rest import Rest
from skinware.tactile.rule import FORGET_AFTER_S, SIGNED_TYPES, UNUSABLE, BaselineSettings, resolution_of
from skinware.tactile.touches import Thresholds, Touches

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Calm:
    """One frame of n taxels, calmed. The arrays belong to the caller.

    Attributes:
        value: (n,) float32, how far each touched taxel is above its baseline (of types that a touch may move to both
            sides: from it), in the unit of the type; 0 where nothing touches.
        touched: (n,) bool.
        held: (n,) bool, near a contact, or near where one was some seconds ago.
        baseline: (n,) float32, what each taxel would read if nothing touched it; NaN before that is known.
        noise: (n,) float32, standard deviation from frame to frame; NaN before it is known.
        forced: (n,) bool, the baseline was put where the value is, at once.
        usable: (n,) bool, value and baseline are of this frame; others show what was last known, or nothing yet.
    """

    value: Floats
    touched: Flags
    held: Flags
    baseline: Floats
    noise: Floats
    forced: Flags
    usable: Flags


class _Intake:
    """The values of n taxels as they come in.

    Attributes:
        seen: (n,) bool, which taxels have ever had a value.
        last: (n,) float32, the newest value of each.
        smooth: (n,) float32, the same, smoothed over time.
    """

    def __init__(self, n: int) -> None:
        self.seen: Flags = np.zeros(n, bool)
        self.last: Floats = np.full(n, np.nan, np.float32)
        self.smooth: Floats = np.full(n, np.nan, np.float32)
        self._away_s: Floats = np.zeros(n, np.float32)
        self._time_ns: int | None = None

    def pass_time(self, time_ns: int) -> float:
        """Return the seconds since the last frame; 0 if time went backwards."""
        before_ns = time_ns if self._time_ns is None else self._time_ns
        self._time_ns = max(time_ns, before_ns)
        return (self._time_ns - before_ns) / NS_PER_S

    def lost(self, usable: Flags, passed_s: float) -> Flags:
        """Return (n,) the taxels that send again after so long that nothing is known of them any more."""
        self._away_s += np.float32(passed_s)
        lost = usable & (self._away_s > FORGET_AFTER_S)
        self._away_s[usable] = 0
        if lost.any():
            self.seen &= ~lost
        return lost

    def take(self, values: Floats, usable: Flags, jumped: Flags | None, share: float, most: Floats | None) -> Floats:
        """Take a frame in, and return (n,) how far the hardware moved its own baseline just before it.

        Args:
            values: (n,) values of the frame.
            usable: (n,) which of them are of this frame.
            jumped: (n,) where the hardware moved its baseline.
            share: of the way to the newest value that the smoothed value goes.
            most: (n,) by which the smoothed value may be above the newest one at most, or None.
        """
        now = np.where(usable, values, self.last)
        if not self.seen.all():
            new = usable & ~self.seen
            self.smooth[new] = now[new]
            self.seen |= new
        step = np.zeros_like(now)
        if jumped is not None and jumped.any():
            step[jumped] = now[jumped] - self.last[jumped]
            self.smooth += step
        self.smooth += np.where(usable, now - self.smooth, np.float32(0)) * np.float32(share)
        if most is not None:
            np.minimum(self.smooth, now + most, out=self.smooth, where=usable)
        self.last = now
        return step


class Baseline:
    """Follows the baselines of the n taxels of one sensor type of one driver.

    Nothing is touched before the rest was measured, for some seconds, however many taxels are covered meanwhile. If
    more than 5 % of them move, those that rest begin, and each of the others begins when it has rested for as long.
    ``tare`` ends the measurement at once. A taxel that sends later, or again after 10 minutes, is measured then.

    Args:
        module: (n,) int, the module of each taxel: its taxels sag and settle together.
        patch: (n,) int, the patch of each taxel: its taxels drift together.
        settings: default: those of the class.
        resolution: the step of the values; 0 if they have none.
        signed: a touch may move a value to both sides.
        neighbours: (n, k) int, the taxels near each, filled with -1: they are held with it, instead of its module.

    Attributes:
        type_name: the sensor type, where it was made for one.
    """

    def __init__(
        self,
        module: npt.ArrayLike,
        patch: npt.ArrayLike,
        settings: BaselineSettings | None = None,
        *,
        resolution: float = 1.0,
        signed: bool = False,
        neighbours: npt.NDArray[np.integer] | None = None,
    ) -> None:
        module, self._patch = np.asarray(module, np.intp), np.asarray(patch, np.intp)
        n = len(self._patch)
        self.type_name: str = ""
        self._signed = signed
        self._settings = settings or BaselineSettings()
        self._intake = _Intake(n)
        self._rest = Rest(n)
        self._thresholds = Thresholds(n, resolution)
        self._touches = Touches(module, neighbours)
        self._drift = Drift(self._patch)
        self._sag = Sag(module, self._patch)
        self._all_held = False
        self._below_s: Floats = np.zeros(n, np.float32)
        self._forced: Flags = np.zeros(n, bool)
        self._suspect: Flags | None = None
        self._thresholds.set(self._rest, self._settings)

    @classmethod
    def of(
        cls,
        structure: Structure,
        type_name: str,
        settings: BaselineSettings | None = None,
        *,
        neighbours: npt.NDArray[np.integer] | None = None,
    ) -> Self:
        """Make one for the sensors of a type, in the order of ``structure.index(type_name)``.

        Args:
            structure: structure of the driver.
            type_name: which sensors.
            settings: as for the constructor.
            neighbours: as for the constructor.

        Raises:
            StructureError: no such type here.
        """
        baseline = cls(
            structure.module_of(type_name),
            structure.patch_of(type_name),
            settings,
            resolution=resolution_of(structure, type_name),
            signed=type_name.startswith(SIGNED_TYPES),
            neighbours=neighbours,
        )
        baseline.type_name = type_name
        return baseline

    @property
    def ready(self) -> Flags:
        """(n,) bool, which taxels have a baseline; a copy."""
        return self._rest.ready.copy()

    @property
    def refused_share(self) -> float:
        """Share of the taxels that have to wait for a baseline because they move; 0: none has to wait."""
        return self._rest.refused_share

    @property
    def settings(self) -> BaselineSettings:
        """The settings; new ones hold from the next frame on."""
        return self._settings

    @settings.setter
    def settings(self, settings: BaselineSettings) -> None:
        self._settings = settings
        self._thresholds.set(self._rest, settings)

    def hold(self, on: bool) -> None:
        """Leave all baselines as they are, except for common drift, until ``hold(False)``."""
        self._all_held = on

    def tare(self, patch: int | None = None) -> int:
        """Take the present values as the rest, touched or not.

        Args:
            patch: only of this one.

        Returns:
            The number of those taxels.

        Raises:
            ConfigurationError: no value has come yet; or these values have no steps, and their noise is not known yet.
        """
        taxels = self._intake.seen.copy()
        if patch is not None:
            taxels &= self._patch == patch
        if not taxels.any():
            raise ConfigurationError("nothing to tare: no value has come yet")
        if self._thresholds.minimum_on == 0 and not self._rest.ready[taxels].all():
            raise ConfigurationError("the noise is not known yet: wait until it is measured, or set minimum_on")
        self._touches.forget(taxels)
        self._rest.begin_at(np.flatnonzero(taxels), self._intake.smooth[taxels], self._rest.noise[taxels])
        self._thresholds.set(self._rest, self._settings)
        self._forced |= taxels
        return int(taxels.sum())

    def take(self, frame: DriverSnapshot) -> Calm:
        """Calm the next frame of the driver.

        Raises:
            StructureError: it has no such sensors.
        """
        status = frame.status_of(self.type_name)
        before, suspect = self._suspect, (status & Status.SUSPECT) != 0
        self._suspect = suspect
        jumped = None if before is None else suspect & ~before
        return self.update(frame.acquired_ns, frame.physical(self.type_name), (status & UNUSABLE) == 0, jumped=jumped)

    def update(
        self,
        time_ns: int,
        values: npt.ArrayLike,
        usable: npt.ArrayLike | None = None,
        *,
        jumped: npt.ArrayLike | None = None,
    ) -> Calm:
        """Calm the next frame, given as arrays.

        Args:
            time_ns: of the frame, CLOCK_MONOTONIC or any other clock that goes forwards.
            values: (n,) in the unit of the type, more = more pressure; NaN where nothing is known.
            usable: (n,) bool, which values are of this frame; default: all. The others keep their state, and have no
                influence on anything.
            jumped: (n,) bool, where the hardware moved its own baseline just before this frame; default: nowhere.
        """
        given = np.asarray(values, np.float32)
        usable = np.isfinite(given) if usable is None else np.isfinite(given) & usable
        settings, intake, rest = self._settings, self._intake, self._rest
        passed_s = intake.pass_time(time_ns)
        lost = intake.lost(usable, passed_s)
        if lost.any():
            self._touches.forget(lost)
            rest.forget(lost)
        self._take(given, usable, passed_s, None if jumped is None else usable & rest.ready & np.asarray(jumped, bool))
        if not rest.ready.all():
            waiting = usable & ~rest.ready
            minimum_on = self._thresholds.minimum_on
            if waiting.any() and rest.measure(time_ns, intake.last, waiting, intake.seen, minimum_on, settings):
                self._thresholds.set(rest, settings)
        live = usable & rest.ready
        deviation = np.where(live, intake.smooth - rest.level, np.float32(0))
        held = self._follow_touches(deviation, live, passed_s)
        free = live & ~held
        self._recover(deviation, free, passed_s)
        rest.level += self._drift.step(
            deviation,
            live,
            free,
            passed_s=passed_s,
            tau_s=settings.tau_s,
            common_tau_s=settings.common_tau_s,
            limit=self._thresholds.on,
        )
        self._sag.sink(-self._drift.alone)
        above = intake.last - rest.level
        touched = self._touches.shown(self._load(above), self._load(intake.smooth - rest.level), self._thresholds.off)
        value = np.where(touched, above if self._signed else np.maximum(above, 0), np.float32(0))
        forced, self._forced = self._forced, np.zeros(len(live), bool)
        return Calm(value, touched, held, rest.level.copy(), rest.noise.copy(), forced, live)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return all that was learned, by name: arrays (n,), copies."""
        return {name: array.copy() for name, array in self._learned().items()}

    def restore(self, state: Mapping[str, npt.NDArray[Any]], rows: npt.NDArray[np.integer]) -> int:
        """Go on with what another baseline had learned, contacts included.

        Args:
            state: what ``state`` returned, of m taxels.
            rows: (n,) where each taxel stands there; -1: nowhere.

        Returns:
            The number of taxels that are ready now.

        Raises:
            ConfigurationError: that is no such state.
        """
        here = rows >= 0
        m = int(rows.max(initial=-1)) + 1
        learned = self._learned()
        for name, array in learned.items():
            given = state.get(name)
            if given is None or given.dtype != array.dtype or given.ndim != 1 or len(given) < m:
                raise ConfigurationError(f"no state of a baseline: {name} is missing or has a wrong shape or dtype")
        here[here] = state["ready"][rows[here]]
        for name in learned.keys() - {"noise"}:
            here[here] = np.isfinite(state[name][rows[here]])
        for name, array in learned.items():
            array[here] = state[name][rows[here]]
        self._thresholds.set(self._rest, self._settings)
        return int(here.sum())

    def _learned(self) -> dict[str, npt.NDArray[Any]]:
        rest, touches, drift = self._rest, self._touches, self._drift
        own = {"ready": rest.ready, "base": rest.level, "noise": rest.noise}
        of_touches = {name: getattr(touches, name) for name in ("touched", "level", "contact_s", "sunk", "settling_s")}
        of_drift = {name: getattr(drift, name) for name in ("factor", "own", "common", "product", "square", "lag")}
        return own | of_touches | of_drift

    # -- steps of one frame -------------------------------------------------------------------------------------

    def _load(self, deviation: Floats) -> Floats:
        return np.abs(deviation) if self._signed else deviation

    def _take(self, given: Floats, usable: Flags, passed_s: float, jumped: Flags | None) -> None:
        """Take the values in; where the hardware moved its own baseline, this one moves with it."""
        smooth_s = self._settings.smooth_s
        share = -math.expm1(-passed_s / smooth_s) if smooth_s else 1.0
        most = None if self._signed else self._thresholds.on  # the end of a touch shows soon, however firm it was
        moved = self._intake.take(given, usable, jumped, share, most)
        if jumped is not None:
            self._forced |= moved != 0
            self._rest.level += moved

    def _follow_touches(self, deviation: Floats, live: Flags, passed_s: float) -> Flags:
        """Judge touches and their ends; return (n,) the taxels that keep their own baselines."""
        thresholds, settings = self._thresholds, self._settings
        if not self._signed:
            up = self._sag.come_back(deviation, self._touches.touched & live, thresholds.off, passed_s)
            self._rest.level += up
            deviation -= up
        load = self._load(deviation)
        self._touches.judge(load, live, thresholds)
        if not self._all_held:
            self._put(self._touches.over(load, live, thresholds.on, passed_s, settings), deviation)
        held = self._touches.hold(live, passed_s, settings.settle_s)
        return np.ones_like(held) if self._all_held else held

    def _recover(self, deviation: Floats, free: Flags, passed_s: float) -> None:
        """Give new baselines to taxels whose old ones were learned under a load that is gone now."""
        if self._signed:
            return
        below = free & (deviation < -self._thresholds.on)
        self._below_s = np.where(below, self._below_s + np.float32(passed_s), np.float32(0))
        recovers = self._below_s >= max(self._settings.recover_s, 1e-9)
        if recovers.any():
            self._sag.sink(np.where(recovers, -deviation, np.float32(0)))
            self._put(np.flatnonzero(recovers), deviation)

    def _put(self, taxels: npt.NDArray[np.intp], deviation: Floats) -> None:
        """Put the baselines of some taxels where their values are."""
        if len(taxels):
            self._rest.level[taxels] = self._intake.smooth[taxels]
            self._forced[taxels] = True
            self._below_s[taxels] = 0
            deviation[taxels] = 0
