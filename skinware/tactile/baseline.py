"""Baselines that hold: what a taxel would read if nothing touched it, while the hardware drifts and contacts last.

::

    baseline = Baseline.of(reader.structure, "pressure")
    for frame in reader.in_order():
        calm = baseline.take(frame)
        print(calm.value[calm.touched])     # 0 = no touch, in the type's unit

The rule, per taxel, with times from the frames and never from a nominal rate: a level above its own baseline and noise
is a touch, with hysteresis. What is common to a patch and slow is drift, which taxels in contact have too: each has
learned how strongly it follows. Taxels near a contact, and for some seconds after it, keep their own baselines. When
most of a contact's load goes at once, it is over, and what is left is taken for drift if drift can have made it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.calm import BaselineSettings, Calm
from skinware.tactile.drift import Drift, Sag
from skinware.tactile.resting import RestingMeasurement
from skinware.tactile.touches import Touches

UNUSABLE = Status.NEVER_SEEN | Status.STALE | Status.MASKED | Status.NOT_CONNECTED
"""Taxels with one of these bits say nothing about a baseline."""
SIGNED_TYPES = ("shear_", "force_x", "force_y", "magnetic_field_", "acceleration_", "angular_rate_")
"""Beginnings of the names of types that a touch may move to both sides."""

_STEPS = 3
"""Of raw values, that a touch must have at least."""
_OFF_TO_ON = 0.6
"""Of the least thresholds."""
_MOVED_SHARE = 0.05
"""Of the taxels may move while the rest is measured; of more, those that move have to wait."""
_AWAY_S = 600.0
"""After so long without data a baseline is worth nothing."""

_QUIET_TO_TYPICAL = 0.25
"""No taxel is taken to be quieter than the typical one by more than this."""
_EPSILON, _TINY = 1e-6, 1e-12
"""Of values without steps and without noise, such as those of a program."""

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


class Baseline:
    """Follows the baselines of the n taxels of one sensor type of one driver.

    Nothing is touched before the rest was measured, for some seconds, however many taxels are covered meanwhile. If
    more than 5 % of them move, those that rest begin, and each of the others when it has rested for as long. ``tare``
    ends that at once. A taxel that sends later, or again after 10 minutes, is measured when it does.

    Args:
        module: (n,) int, the module of each: what sags and settles together.
        patch: (n,) int, the patch of each: what drifts together.
        settings: default: those of the class.
        resolution: the step of the values; 0 if they have none.
        signed: a touch may move a value to both sides.
        neighbours: (n, k) int, the taxels near each, filled with -1: they are held with it, instead of its module.

    Attributes:
        type_name: the type, where it was made for one.
        refused_share: of the taxels is not ready yet, because they move; 0: none has to wait.
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
        self._patch = np.asarray(patch, np.intp)
        self._resolution, self._signed = resolution, signed
        self._settings = settings or BaselineSettings()
        n = len(self._patch)
        self.type_name: str = ""
        self.refused_share: float = 0.0
        self._touches = Touches(np.asarray(module, np.intp), neighbours)
        self._drift = Drift(self._patch)
        self._sag = Sag(np.asarray(module, np.intp), self._patch)
        self._measurement: RestingMeasurement | None = None
        self._all_held = False
        self._time_ns: int | None = None
        self._ready = np.zeros(n, bool)
        self._seen = np.zeros(n, bool)
        self._base: Floats = np.full(n, np.nan, np.float32)
        self._noise: Floats = np.full(n, np.nan, np.float32)
        self._last: Floats = np.full(n, np.nan, np.float32)
        self._smooth: Floats = np.full(n, np.nan, np.float32)
        self._below_s: Floats = np.zeros(n, np.float32)
        self._away_s: Floats = np.zeros(n, np.float32)
        self._forced = np.zeros(n, bool)
        self._is_ending = np.zeros(n, bool)
        self._suspect = np.zeros(n, bool)
        self._set_thresholds()

    @classmethod
    def of(
        cls,
        structure: Structure,
        type_name: str,
        settings: BaselineSettings | None = None,
        *,
        neighbours: npt.NDArray[np.integer] | None = None,
    ) -> Self:
        """One for the sensors of a type, in the order of ``structure.index(type_name)``.

        Args:
            structure: of the driver.
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
            resolution=0.0 if structure.dtype.kind == "f" else abs(structure.type(type_name).scale),
            signed=type_name.startswith(SIGNED_TYPES),
            neighbours=neighbours,
        )
        baseline.type_name = type_name
        return baseline

    @property
    def ready(self) -> Flags:
        """(n,) bool, whose rest is known; a copy."""
        return self._ready.copy()

    @property
    def settings(self) -> BaselineSettings:
        """The parameters; new ones hold from the next frame on."""
        return self._settings

    @settings.setter
    def settings(self, settings: BaselineSettings) -> None:
        self._settings = settings
        self._set_thresholds()

    def hold(self, on: bool) -> None:
        """Leave all baselines as they are, but for common drift, until told otherwise."""
        self._all_held = on

    def tare(self, patch: int | None = None) -> int:
        """Take the present values for the rest, touched or not.

        Args:
            patch: only of this one.

        Returns:
            How many taxels that are.

        Raises:
            ConfigurationError: no value has come yet; or these values have no steps, and their noise is not known yet.
        """
        taxels = self._seen.copy()
        if patch is not None:
            taxels &= self._patch == patch
        if not taxels.any():
            raise ConfigurationError("nothing to tare: no value has come yet")
        if self._minimum_on == 0 and not self._ready[taxels].all():
            raise ConfigurationError("the noise is not known yet: wait until it is measured, or set minimum_on")
        self._touches.forget(taxels)
        self._begin_at(np.flatnonzero(taxels), self._smooth[taxels], self._noise[taxels])
        self._forced |= taxels
        return int(taxels.sum())

    def take(self, frame: DriverSnapshot) -> Calm:
        """The next frame of the driver.

        Raises:
            StructureError: it has no such sensors.
        """
        status = frame.status_of(self.type_name)
        suspect = (status & Status.SUSPECT) != 0
        jumped = suspect & ~self._suspect
        self._suspect = suspect
        return self.update(frame.acquired_ns, frame.physical(self.type_name), (status & UNUSABLE) == 0, jumped=jumped)

    def update(
        self,
        time_ns: int,
        values: npt.ArrayLike,
        usable: npt.ArrayLike | None = None,
        *,
        jumped: npt.ArrayLike | None = None,
    ) -> Calm:
        """The next frame, as arrays.

        Args:
            time_ns: of the frame, CLOCK_MONOTONIC or any other clock that goes forwards.
            values: (n,) in the unit of the type, more = more pressure; NaN where nothing is known.
            usable: (n,) bool, which values are of this frame; default: all. The others keep their state, and have no
                influence on anything.
            jumped: (n,) bool, where the hardware moved its own baseline just before this frame; default: nowhere.
        """
        given = np.asarray(values, np.float32)
        usable = np.isfinite(given) if usable is None else np.isfinite(given) & usable
        before_ns = time_ns if self._time_ns is None else self._time_ns
        self._time_ns = max(time_ns, before_ns)
        passed_s = (self._time_ns - before_ns) / NS_PER_S
        self._note_absence(usable, passed_s)
        now = self._smoothed(given, usable, passed_s, None if jumped is None else np.asarray(jumped, bool))
        if not self._ready.all() and (usable & ~self._ready).any():
            self._measure(time_ns, now, usable)
        live = usable & self._ready
        deviation = np.where(live, self._smooth - self._base, np.float32(0))
        held = self._follow_touches(deviation, live, passed_s)
        free = live & ~held
        self._recover(deviation, free, passed_s)
        self._base += self._drift.step(
            deviation,
            live,
            free,
            passed_s=passed_s,
            tau_s=self._settings.tau_s,
            common_tau_s=self._settings.common_tau_s,
            limit=self._on,
        )
        self._sag.sink(-self._drift.alone)
        above = now - self._base
        touched = self._touches.touched & ~self._ending(above)
        value = np.where(touched, above if self._signed else np.maximum(above, 0), np.float32(0))
        forced, self._forced = self._forced, np.zeros(len(live), bool)
        return Calm(value, touched, held, self._base.copy(), self._noise.copy(), forced, live)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """All that was learned, by name: arrays (n,), copies."""
        return {name: array.copy() for name, array in self._learned().items()}

    def restore(self, state: Mapping[str, npt.NDArray[Any]], rows: npt.NDArray[np.integer]) -> int:
        """Go on with what another baseline had learned, contacts included.

        Args:
            state: of ``state``, of m taxels.
            rows: (n,) where each taxel stands there; -1: nowhere.

        Returns:
            How many taxels are ready now.

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
        self._set_thresholds()
        return int(here.sum())

    def _learned(self) -> dict[str, npt.NDArray[Any]]:
        own = {"ready": self._ready, "base": self._base, "noise": self._noise}
        touches, drift = self._touches, self._drift
        of_touches = {name: getattr(touches, name) for name in ("touched", "level", "contact_s", "sunk", "settling_s")}
        of_drift = {name: getattr(drift, name) for name in ("factor", "own", "common", "product", "square", "lag")}
        return own | of_touches | of_drift

    # -- steps of one frame -------------------------------------------------------------------------------------

    def _note_absence(self, usable: Flags, passed_s: float) -> None:
        """Forget taxels that come back after so long that their baselines are worth nothing."""
        self._away_s += np.float32(passed_s)
        lost = usable & (self._away_s > _AWAY_S)
        if lost.any():
            self._touches.forget(lost)
            self._ready &= ~lost
            self._seen &= ~lost
            self._base[lost] = np.nan
        self._away_s[usable] = 0

    def _smoothed(self, given: Floats, usable: Flags, passed_s: float, jumped: Flags | None) -> Floats:
        """Take the values in; (n,) what they are now, the last known where they are not usable."""
        now = np.where(usable, given, self._last)
        if not self._seen.all():
            new = usable & ~self._seen
            self._smooth[new] = now[new]
            self._seen |= new
        if jumped is not None and jumped.any():
            step = np.where(jumped & usable & self._ready, now - self._last, np.float32(0))
            self._forced |= step != 0
            self._base += step
            self._smooth += step
        share = -math.expm1(-passed_s / self._settings.smooth_s) if self._settings.smooth_s else 1.0
        self._smooth += np.where(usable, now - self._smooth, np.float32(0)) * np.float32(share)
        if not self._signed:  # the end of a touch shows soon, however firm it was
            np.minimum(self._smooth, now + self._on, out=self._smooth, where=usable)
        self._last = now
        return now

    def _measure(self, time_ns: int, now: Floats, usable: Flags) -> None:
        """Measure the rest of those whose it is not known; where many move, they have to wait until they rest."""
        if self._measurement is None:
            self._measurement = RestingMeasurement(len(now), self._settings.calibrate_s)
        if not self._measurement.add(time_ns, now, usable & ~self._ready):
            return
        taxels = np.flatnonzero(~self._ready)
        rest = self._measurement.result(taxels)
        threshold = np.maximum(self._minimum_on, self._settings.on_sigma * rest.noise)
        measured = np.isfinite(rest.level)
        moving = measured & (rest.range > threshold)
        refused = int(moving.sum()) > max(1, _MOVED_SHARE * measured.sum())
        self.refused_share = int(moving.sum()) / int(self._seen.sum()) if refused else 0.0
        begins = measured & ~moving if refused else measured
        if not refused:
            self._measurement = None  # whoever sends later begins anew
        self._begin_at(taxels[begins], rest.level[begins], rest.noise[begins])

    def _follow_touches(self, deviation: Floats, live: Flags, passed_s: float) -> Flags:
        load = np.abs(deviation) if self._signed else deviation
        if not self._signed:
            up = self._sag.come_back(deviation, self._touches.touched & live, self._off, passed_s)
            self._base += up
            deviation -= up
        self._touches.judge(load, live, self._on, self._off)
        if not self._all_held:
            over = self._touches.over(load, live, self._on, passed_s, self._settings)
            self._put(over, deviation)
        held = self._touches.hold(live, passed_s, self._settings.settle_s)
        return np.ones_like(held) if self._all_held else held

    def _ending(self, above: Floats) -> Flags:
        """(n,) whose values say that their touch is over, though it does not show yet where they are smoothed."""
        load, smooth = (np.abs(of) if self._signed else of for of in (above, self._smooth - self._base))
        ending = load < np.where(self._is_ending, self._off, np.minimum(self._off, smooth / 2))
        self._is_ending = ending & self._touches.touched
        return self._is_ending

    def _recover(self, deviation: Floats, free: Flags, passed_s: float) -> None:
        """Baselines that were learned under a load, which is gone now."""
        if self._signed:
            return
        below = free & (deviation < -self._on)
        self._below_s = np.where(below, self._below_s + np.float32(passed_s), np.float32(0))
        recovers = self._below_s >= max(self._settings.recover_s, 1e-9)
        if recovers.any():
            self._sag.sink(np.where(recovers, -deviation, np.float32(0)))
            self._put(np.flatnonzero(recovers), deviation)

    def _put(self, taxels: npt.NDArray[np.intp], deviation: Floats) -> None:
        if len(taxels):
            self._base[taxels] = self._smooth[taxels]
            self._forced[taxels] = True
            self._below_s[taxels] = 0
            deviation[taxels] = 0

    def _begin_at(self, taxels: npt.NDArray[np.intp], level: Floats, noise: Floats) -> None:
        """The rest of k taxels is known: (k,) their level and noise."""
        self._base[taxels] = level
        self._noise[taxels] = noise
        self._ready[taxels] = True
        if self._ready.all():
            self._measurement = None
        self._set_thresholds()

    def _set_thresholds(self) -> None:
        settings = self._settings
        self._minimum_on = _STEPS * self._resolution if settings.minimum_on is None else settings.minimum_on
        known = self._noise[self._ready]
        typical = float(np.nanmedian(known)) if np.isfinite(known).any() else 0.0
        least = np.maximum(self._resolution / math.sqrt(12), _QUIET_TO_TYPICAL * typical)
        noise = np.fmax(self._noise, np.fmax(least, _EPSILON * np.abs(self._base)))
        self._on: Floats = np.fmax(self._minimum_on, settings.on_sigma * noise + _TINY).astype(np.float32)
        self._off: Floats = np.fmax(_OFF_TO_ON * self._minimum_on, settings.off_sigma * noise).astype(np.float32)
