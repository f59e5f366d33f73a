"""Follow baselines: what each taxel would read if nothing touched it, while the hardware drifts and contacts last.

::

    baseline = Baseline.of(reader.structure, "pressure")
    for frame in reader.in_order():
        calm = baseline.take(frame)
        print(calm.value[calm.touched])     # 0 = no touch, in the type's unit

One question decides everything: how much of this could be drift? Each taxel has an offset and knows how uncertain it
is. A value that is above the offset by more than noise and uncertainty explain is a touch. Under a touch the offset is
predicted from what the patch has in common, and its uncertainty grows by the drift that was measured at rest. A touch
lasts until its load is gone, or has fallen to what drift could be. All times are those of the frames.
:mod:`.numbers` has all numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.status import Why
from skinware.tactile.baseline import BaselineSettings, Calm
from tests.specification.baseline.numbers import (
    ALIKE,
    DIP_S,
    EPSILON,
    FEW_LEVELS,
    FORGET_AFTER_S,
    GAP_S,
    HEATS,
    HEATS_ON,
    LOOK_AT_S,
    MANY_TAXELS,
    NEARLY_ALL,
    OFF_TO_ON,
    RESETTLE_S,
    SAG_SHARE,
    STEPS_OF_A_TOUCH,
    TINY,
)
from tests.specification.baseline.offsets import Offsets
from tests.specification.baseline.rest import Rest
from tests.specification.baseline.surroundings import Falls, Surroundings
from tests.specification.baseline.touches import Touches

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]


class _Intake:
    """The values of n taxels as they come in.

    Attributes:
        seen: (n,) bool, which taxels have ever had a value.
        last: (n,) float32, the newest value of each.
        few_levels: whether no value has ever been beyond two steps from 0.
    """

    def __init__(self, n: int, resolution: float) -> None:
        self.seen: Flags = np.zeros(n, bool)
        self.last: Floats = np.full(n, np.nan, np.float32)
        self.few_levels = resolution > 0
        self._most = FEW_LEVELS * resolution
        self._away_s: Floats = np.zeros(n, np.float32)
        self.time_ns = -1

    def pass_time(self, time_ns: int) -> float:
        """Return the seconds since the last frame; 0 if time went backwards."""
        before_ns = time_ns if self.time_ns < 0 else self.time_ns
        self.time_ns = max(time_ns, before_ns)
        return (self.time_ns - before_ns) / NS_PER_S

    def lost(self, usable: Flags, passed_s: float) -> Flags:
        """Return (n,) the taxels that send again after so long that nothing is known of them any more."""
        self._away_s += np.float32(passed_s)
        lost = usable & (self._away_s > FORGET_AFTER_S)
        self._away_s[usable] = 0
        if lost.any():
            self.seen &= ~lost
        return lost

    def take(self, values: Floats, usable: Flags) -> None:
        """Take a frame in."""
        np.copyto(self.last, values, where=usable)
        if not self.seen.all():
            self.seen |= usable
        if self.few_levels:
            self.few_levels = not (usable & (np.abs(values) > self._most)).any()


class SpecifiedBaseline:
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
        limits: least and largest value of the type; a taxel there is saturated.

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
        limits: tuple[float, float] = (-math.inf, math.inf),
    ) -> None:
        module, patch = np.asarray(module, np.intp), np.asarray(patch, np.intp)
        n = len(patch)
        self.type_name: str = ""
        self._settings = settings or BaselineSettings()
        self._resolution, self._limits = resolution, limits
        self._intake = _Intake(n, resolution)
        self._ready: Flags = np.zeros(n, bool)
        self._offsets = Offsets(patch, module)
        self._rest = Rest(self._offsets.patches, self._least_noise2)
        self._touches = Touches(module, patch, signed=signed)
        self._surroundings = Surroundings(module, patch)
        self._falls = Falls(self._surroundings)
        self._all_held = False
        self._fall, self._fell_s = np.zeros((2, self._offsets.patches.n))
        """By how much each patch jumped down of late, and how long ago."""
        self._forced: Flags = np.zeros(n, bool)
        self._at_end: Flags | np.bool_ = np.False_
        self._suspect: Flags | None = None
        self._normal: SpecifiedBaseline | None = None
        self._live, self._off = np.zeros(n, bool), np.zeros(n, np.float32)

    def stand_beside(self, normal: SpecifiedBaseline) -> None:
        """Let the axis along the normal of the same taxels say where these axes, within the skin, bear no load."""
        self._normal = normal

    @property
    def ready(self) -> Flags:
        """(n,) bool, which taxels have a baseline; a copy."""
        return self._ready.copy()

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

    def hold(self, on: bool) -> None:
        """Leave all baselines as they are, except for common drift, until ``hold(False)``."""
        self._all_held = on

    def tare(self, patch: int | None = None) -> int:
        """Take the present values as the rest, touched or not.

        Args:
            patch: only of this one.

        Returns:
            The number of taxels that were tared.

        Raises:
            ConfigurationError: too few values have come yet.
        """
        seen = self._intake.seen.copy()
        if patch is not None:
            seen &= self._offsets.patches.group == patch
        known, level, noise2 = self._rest.now()
        level = np.where(known, level, self._intake.last)
        noise2 = np.where(known, noise2, np.float32(0))
        taxels = seen & (self._ready | (noise2 > 0) | (self._minimum_on > 0))
        if not seen.any():
            raise ConfigurationError("nothing to tare: no value has come yet")
        if not taxels.any():
            raise ConfigurationError("nothing to tare: the noise is known after four values; try again in a moment")
        fresh, rows = np.flatnonzero(taxels & ~self._ready), np.flatnonzero(taxels)
        self._offsets.noise2[fresh] = np.maximum(noise2[fresh], self._least_noise2(level[fresh]))
        self._offsets.noise_s[fresh] = 0
        now = np.where(self._ready, self._offsets.level + self._touches.smooth, level)
        self._ready |= taxels
        self._offsets.put(rows, now[rows])
        self._touches.forget(rows)
        self._surroundings.forget(taxels)
        self._forced |= taxels
        return len(rows)

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
        settings, intake, offsets, touches = self._settings, self._intake, self._offsets, self._touches
        passed_s = intake.pass_time(time_ns)
        lost = intake.lost(usable, passed_s)
        if lost.any():
            self._ready &= ~lost
            offsets.level[lost] = np.nan
            touches.forget(np.flatnonzero(lost))
        if jumped is not None:
            moved = usable & self._ready & np.asarray(jumped, bool)
            offsets.level[moved] += given[moved] - intake.last[moved]
            self._forced |= moved
        intake.take(given, usable)
        if not self._ready.all():
            self._measure(time_ns, usable, passed_s)
        live = self._live = usable & self._ready
        deviation = np.where(live, intake.last - offsets.level - touches.remainders.left, np.float32(0))
        self._at_end = self._find_ends(deviation)
        spread = np.sqrt(offsets.noise2)
        on = np.maximum(self._minimum_on, settings.on_sigma * np.sqrt(offsets.total())).astype(np.float32)
        off = self._off = np.maximum(OFF_TO_ON * self._minimum_on, settings.off_sigma * spread).astype(np.float32)
        if not touches.signed:
            self._jump(deviation, live, off, passed_s)
        free = live & ~touches.touched & touches.remainders.has_settled & ~self._at_end
        if not touches.signed:
            low = touches.smooth < -settings.off_sigma * spread
            free &= ~self._falls.sagging & ~(self._falls.below & low) & (self._falls.lowered <= 0)
        offsets.follow_common(deviation, free, np.where(self._surroundings.held, on * on, np.float32(0)), passed_s)
        touches.follow(deviation, live, on, passed_s, settings.smooth_s)
        rustle = np.float32(touches.noise_share) * off
        most_s = settings.maximum_hold_s or math.inf
        over = touches.judge(deviation, live, on, off, offsets, passed_s, most_s)
        if not self._all_held:
            self._let_go(over, live, on, off, deviation, passed_s)
        self._surroundings.hold(touches, live, passed_s, settings.settle_s)
        if not touches.signed:
            moves = offsets.common.agility * passed_s > offsets.typical
            self._falls.sag(touches.smooth, off, rustle, live & ~touches.touched, offsets.patches, moves, passed_s)
        low = self._recover(deviation, live, on, passed_s)
        if not self._all_held:
            floor: Floats | np.float32 = np.float32(min(passed_s / settings.tau_s, 0.5))
            quick = np.float32(min(passed_s / RESETTLE_S, 0.5))
            floor = np.where(touches.remainders.used > 0, quick, floor)
            settled = touches.remainders.has_settled
            if not touches.signed:
                settled |= touches.smooth < -off  # no touch leaves less than 0
            learns = live & ~touches.touched & ~self._falls.sagging & settled
            learns &= (touches.load(deviation) < on) & ~self._at_end  # a touch that begins is no drift
            load_now = self._surroundings.present[self._surroundings.patch]
            heats = learns & (touches.smooth > np.float32(0.5) * on) & (on < np.float32(HEATS_ON) * load_now)
            heats &= offsets.gain * offsets.gain * offsets.patches.spread(offsets.common.variance) < offsets.noise2
            heats &= not touches.signed
            rises = np.where(heats, np.float32(HEATS) * load_now * np.float32(passed_s), np.float32(0))
            rustles = (np.abs(touches.smooth) < rustle) & (np.abs(deviation) < off)
            learns &= ~self._surroundings.beside | rustles
            calm = learns & (np.abs(touches.smooth) < rustle)
            offsets.learn(deviation, learns, calm, touches.remainders.used <= 0, live, floor, rises, passed_s)
            np.maximum(offsets.noise2, self._least_noise2(offsets.level), out=offsets.noise2)
        if not touches.signed:
            touches.remainders.follow(deviation, touches.smooth, touches.touched, on, passed_s)
        return self._calm(deviation, live, low, off)

    @property
    def _minimum_on(self) -> float:
        given = self._settings.minimum_on
        if given is not None:
            return given
        return self._resolution * (0.5 if self._intake.few_levels else STEPS_OF_A_TOUCH)

    def _find_ends(self, deviation: Floats) -> Flags | np.bool_:
        """Return (n,) which taxels are at an end of their range: they show no drift and no more load.

        At the lower end they show that their offset is not above it.
        """
        least, most = self._limits
        if not math.isfinite(most - least):
            return np.False_
        last = self._intake.last
        at_end: Flags = (last >= most) | ((last <= least) & (self._touches.signed | (deviation > 0)))
        return at_end

    def _least_noise2(self, level: Floats) -> Floats | np.float32:
        rounding = self._resolution * (0.05 if self._intake.few_levels else 1 / math.sqrt(12))
        if rounding:
            return np.float32(rounding**2)
        least: Floats = np.fmax(np.float32(rounding), EPSILON * np.abs(level) + TINY) ** 2
        return least

    def _measure(self, time_ns: int, usable: Flags, passed_s: float) -> None:
        """Measure the taxels that wait for a baseline."""
        waiting, intake = usable & ~self._ready, self._intake
        if not waiting.any():
            return
        found = self._rest.measure(intake.time_ns, intake.last, waiting, intake.seen, self._minimum_on, self._settings)
        if found is None or not len(found.taxels):
            return
        rows, first = found.taxels, not self._ready.any()
        noise2 = np.maximum(found.noise2, self._least_noise2(found.level))
        self._offsets.begin(rows, found.level, noise2, found.gain, found.gain_variance)
        self._ready[rows] = True
        if first:
            patches = self._offsets.patches
            number = np.maximum(patches.sum(self._ready), 1)
            rounding = 3 * patches.sum(np.where(self._ready, self._offsets.noise2, 0)) / number**2
            self._offsets.common.agility[:] = np.maximum(self._rest.moves2 - rounding, 0.01 * rounding) / max(
                passed_s, 1e-3
            )

    def _jump(self, deviation: Floats, live: Flags, off: Floats, passed_s: float) -> None:
        """Move the offsets of patches whose free taxels fell alike and at once, returned, or moved in a gap."""
        offsets, touches, patches = self._offsets, self._touches, self._offsets.patches
        free = live & ~self._at_end & (~touches.touched | (touches.contact_s < np.float32(2 * LOOK_AT_S)))
        number = patches.sum(free)
        most = NEARLY_ALL * number
        self._fell_s += passed_s
        self._fall[self._fell_s > DIP_S] = 0
        may_rise = (self._fall > 0) | (passed_s > GAP_S)
        may = patches.sum(free & (deviation < -off)) >= most
        may |= may_rise & (patches.sum(free & (deviation > off)) >= most)
        may &= number > MANY_TAXELS
        if not may.any():
            return
        free &= may[patches.group]
        jump = patches.median(deviation, free).astype(np.float64)
        before = patches.median(touches.smooth, free).astype(np.float64)
        by = np.broadcast_to(patches.spread(jump), deviation.shape)
        along = free & (np.abs(deviation - by) < np.maximum(np.float32(ALIKE) * np.abs(by), off))
        returns = np.abs(jump - self._fall) < np.float32(ALIKE) * self._fall
        sudden = np.where(jump < 0, np.abs(before) < -0.3 * jump, returns | (passed_s > GAP_S))
        hum2 = self._settings.on_sigma**2 * (offsets.common.variance + offsets.common.agility * passed_s)
        jump[~may | (patches.sum(along) < most) | ~sudden | (jump * jump <= hum2)] = 0
        jumps = jump != 0
        self._fall[jumps] = np.maximum(-jump[jumps], 0)
        self._fell_s[jump < 0] = 0
        moves = live & jumps[patches.group]
        rows, others = np.flatnonzero(moves & along), np.flatnonzero(moves & ~along)
        self._put(rows, deviation[rows], deviation)
        touches.smooth[rows] = 0
        touches.end(rows[touches.touched[rows]])
        offsets.level[others] += by[others]
        deviation[others] -= by[others]
        offsets.variance[others] += np.float32(ALIKE / 3) ** 2 * by[others] * by[others]

    def _let_go(self, over: Rows, live: Flags, on: Floats, off: Floats, deviation: Floats, passed_s: float) -> None:
        """End touches: what is left of them is what the prediction was wrong by."""
        offsets, touches = self._offsets, self._touches
        if len(over):
            left, now = touches.smooth[over], deviation[over]
            left = np.where(np.abs(now) < np.abs(left), now, left)  # the smoothed one may still fall
            firm = touches.peak[over] > 2 * on[over]  # a light one that flickers says nothing of its offset
            firm &= touches.load(left) > 0  # no rest below 0 begins a touch
            offsets.variance[over] += left * left * firm
            too_long = touches.contact_s[over] > (self._settings.maximum_hold_s or math.inf)
            touches.end(over)
            if too_long.any():
                self._put(over[too_long], left[too_long], deviation)
        back = self._falls.back(touches, on, passed_s)
        if len(back):
            self._put(back, touches.smooth[back], deviation)
            touches.end(back)
        stepped, by = touches.module_steps(deviation, live, on, off, offsets, passed_s)
        if len(stepped):
            self._put(stepped, by, deviation)
            offsets.variance[stepped] += (np.float32(ALIKE) * by) ** 2
            touches.smooth[stepped] = deviation[stepped]
            touches.end(stepped[touches.smooth[stepped] < on[stepped]])

    def _recover(self, deviation: Floats, live: Flags, on: Floats, passed_s: float) -> Flags:
        """Give new offsets to taxels whose old ones were learned under a load that is gone now."""
        touches = self._touches
        if touches.signed:
            low = live & touches.touched & self._rests_beside()
            due = np.flatnonzero(self._falls.lasts(low, passed_s, self._settings.recover_s))
        else:
            low = live & (touches.smooth < -on)
            due = self._falls.recovered(low, touches.smooth, passed_s, self._settings.recover_s)
        if len(due) and not self._all_held:
            self._put(due, touches.smooth[due], deviation)
            touches.end(due[touches.touched[due]])
        return low

    def _rests_beside(self) -> Flags | np.bool_:
        """Return (n,) where these axes show more than a pull of the skin, and the axis along the normal rests."""
        normal = self._normal
        if normal is None:
            return np.False_
        pull = SAG_SHARE * normal._surroundings.largest[normal._surroundings.patch]
        more: Flags = np.abs(self._touches.smooth) > np.maximum(normal._off, pull)
        return more & normal._live & ~normal._touches.touched & (normal._touches.smooth < normal._off)

    def _put(self, taxels: Rows, by: Floats, deviation: Floats) -> None:
        """Move the offsets of k taxels at once."""
        offsets, touches = self._offsets, self._touches
        offsets.put(taxels, offsets.level[taxels] + by)
        deviation[taxels] -= by
        touches.smooth[taxels] -= by
        touches.onset[taxels] -= by
        self._forced[taxels] = True

    def _calm(self, deviation: Floats, live: Flags, low: Flags, off: Floats) -> Calm:
        offsets, touches = self._offsets, self._touches
        known = np.where(live, deviation, touches.smooth)
        touched = touches.shown(known, off)
        value = np.where(touched, known if touches.signed else np.maximum(known, 0), np.float32(0))
        why = np.where(touched, np.uint8(Why.HELD), np.uint8(Why.REST))
        why[~self._ready | (offsets.variance > offsets.noise2) & ~touches.touched] = Why.RELEARNING
        why[low] = Why.COVERED
        why[self._falls.returned > 0] = Why.DOUBTED
        why[touches.touched & self._at_end] = Why.SATURATED
        if self._intake.few_levels:
            why[live] = Why.NO_RESOLUTION
        forced, self._forced = self._forced, np.zeros(len(live), bool)
        baseline = offsets.level + touches.remainders.left
        held = np.ones_like(live) if self._all_held else self._surroundings.held.copy()
        return Calm(
            value,
            touched,
            held,
            baseline,
            np.where(self.ready, offsets.uncertainty(), np.float32(np.nan)),
            np.sqrt(offsets.noise2),
            why,
            forced,
            live,
        )

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
        for name in learned:
            here[here] = np.isfinite(state[name][rows[here]])
        for name, array in learned.items():
            array[here] = state[name][rows[here]]
        self._offsets.lose_common()
        return int(here.sum())

    def _learned(self) -> dict[str, npt.NDArray[Any]]:
        offsets, touches = self._offsets, self._touches
        of_offsets = {name: getattr(offsets, name) for name in ("level", "gain", "variance", "cross", "noise2")}
        of_offsets["gain_variance"] = offsets.gain_variance
        of_touches = {name: getattr(touches, name) for name in ("touched", "smooth", "peak", "contact_s")}
        of_touches["used"] = touches.remainders.used
        return {"ready": self._ready} | of_offsets | of_touches
