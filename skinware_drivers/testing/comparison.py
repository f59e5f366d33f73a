"""Compare the updates that a driver showed with the bursts that its devices sent, and explain the differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.structure import Structure
from skinware_drivers.testing.rig import SHOWN_ANYWAY, Running, is_fresh, sensor_name
from skinware_drivers.testing.waiting import defect, require

Values = npt.NDArray[np.int64]
_LATE_NS = 6_000_000
"""The most by which times of bursts can be late: buses deliver together the frames of 4 ms."""
_LAGS = 3
_ENOUGH = 0.9
_MOST_NAMED = 3
_FEWEST_UPDATES = 3


@dataclass(frozen=True)
class Update:
    """New values of a module in a snapshot, and the number of the burst that they show; None: none."""

    frame: int
    module: int
    burst: int | None


class ShownUpdates:
    """The updates that a driver showed, each with its burst."""

    def __init__(self, rig: Running) -> None:
        self.rig = rig
        require(rig.record.frames, "nothing was published")
        self.structure: Structure = rig.record.frames[-1].structure
        n = rig.truth.n_values
        require(
            self.structure.n_sensors == rig.n_values,
            f"the driver declares {self.structure.n_sensors} sensors, the devices have {rig.n_values}"
            f" ({len(rig.numbers)} with {n} each): is a module missing, or a channel that is no sensor?",
        )
        self._sensors = [np.flatnonzero(self.structure.sensor_module == m) for m in range(self.structure.n_modules)]
        self._device = [int(sensors[0]) // n for sensors in self._sensors]
        for module, sensors in enumerate(self._sensors):
            if int(sensors[-1]) // n != self._device[module]:
                defect(f"module {module} shows sensors of two devices: one device is one patch, in the same order")
        self._felt = [
            np.array([burst.values for burst in rig.truth.bursts.get(number, [])]).reshape(-1, n)
            for number in rig.numbers
        ]
        self._felt_ns = [
            np.array([burst.time_ns for burst in rig.truth.bursts.get(number, [])]) for number in rig.numbers
        ]
        self.updates: list[Update] = [
            update for module in range(self.structure.n_modules) for update in self._of_module(module)
        ]
        self.updates.sort(key=lambda update: update.frame)

    @property
    def wrong(self) -> list[Update]:
        """Return the updates with values that no burst had, or only an old one."""
        return [update for update in self.updates if update.burst is None]

    def bursts_shown(self, module: int) -> list[int]:
        return [u.burst for u in self.updates if u.module == module and u.burst is not None]

    def require_right(self, because: str = "") -> None:
        """Fail unless every update shows a burst of its device, newer than the one before; explain what it shows."""
        wrong = self.wrong
        if not wrong:
            return
        if because:
            update = wrong[0]
            sensors = self._sensors[update.module]
            shown = self.rig.record.frames[update.frame].values[sensors][:8].tolist()
            defect(
                f"{because}: {len(wrong)} updates show values that were never sent together, the first for module"
                f" {update.module}: {shown}; it is shown as fresh"
            )
        self.require_no_shift()
        bad = sorted({int(s) for u in wrong for s in self._wrong_sensors(u)})
        reasons = [f"{sensor_name(self.structure, sensor)}: {self._explain(sensor)}" for sensor in bad[:_MOST_NAMED]]
        more = f"\n... and {len(bad) - _MOST_NAMED} more" if len(bad) > _MOST_NAMED else ""
        defect(
            f"{len(bad)} of {self.structure.n_sensors} sensors show values that they did not feel:\n"
            + "\n".join(reasons)
            + more
        )

    def require_no_shift(self) -> None:
        """Fail if modules show the bursts of other modules; name all of them at once."""
        whose = {module: other for module in range(len(self._sensors)) if (other := self._whose(module)) is not None}
        for step in sorted({other - module for module, other in whose.items()}, key=abs):
            modules = [module for module, other in whose.items() if other - module == step]
            others = [module + step for module in modules]
            defect(
                f"{self._in_words(modules)} received what {self._in_words(others)} sent: the keys are shifted, or the"
                " modules are in another order; look at `patch` and `module` of the frames (`Bits`), and at the keys of"
                " patches and modules"
            )

    def _whose(self, module: int) -> int | None:
        frames = [update.frame for update in self.updates if update.module == module]
        if len(frames) < _FEWEST_UPDATES or self.bursts_shown(module):
            return None
        sensors = self._sensors[module]
        shown = np.array([_as_numbers(self.rig.record.frames[frame].values[sensors]) for frame in frames])
        for other in sorted(range(len(self._sensors)), key=lambda other: abs(other - module)):
            if other == module or len(self._sensors[other]) != len(sensors):
                continue
            device = self._device[other]
            felt = self._felt[device][:, self._sensors[other] - device * self.rig.truth.n_values]
            newest = np.array([self._newest_burst(device, frame) for frame in frames])
            rows = np.maximum(newest[:, None] - np.arange(_LAGS), 0)
            if (felt[rows] == shown[:, None]).all(axis=2).any(axis=1).mean() >= _ENOUGH:
                return other
        return None

    def _in_words(self, modules: Sequence[int]) -> str:
        patches = self.structure.module_patch[[modules[0], modules[-1]]]
        first, last = (bytes(name).decode() for name in self.structure.patch_name[patches])
        if len(modules) == 1:
            return f"module {modules[0]} ({first!r})"
        names = f"{first!r}" if first == last else f"{first!r} to {last!r}"
        return f"modules {modules[0]} to {modules[-1]} ({names})"

    def require_complete(self, spare: Callable[[int], bool] = lambda _time_ns: False, because: str = "") -> None:
        """Fail unless every burst was shown, from the first shown one on, but for those at times to spare."""
        end_ns = self.rig.record.times_ns[-1] - 2 * self.rig.period_ns - _LATE_NS
        for module in range(self.structure.n_modules):
            shown = self.bursts_shown(module)
            name = f"module {module} ({sensor_name(self.structure, int(self._sensors[module][0]))})"
            require(shown, f"{name} was never shown{because}: does a frame of the layout belong to it?")
            times_ns = self._felt_ns[self._device[module]]
            missing = [
                burst
                for burst in range(shown[0], len(times_ns))
                if burst not in set(shown) and times_ns[burst] < end_ns and not spare(int(times_ns[burst]))
            ]
            if missing:
                defect(
                    f"{name}: {len(missing)} of {len(times_ns) - shown[0]} bursts that came through whole were not"
                    f" shown{because}, the first {times_ns[missing[0]] / 1e9 - 5000:.3f} s after power-up; counters:"
                    f" { {k: v for k, v in self.rig.counters().items() if v} }"
                )

    def spoilt(self) -> Callable[[int], bool]:
        """Return a test of a time: whether a burst at this time was perhaps damaged on the wire."""
        damaged_ns = np.array(sorted(damage.time_ns for damage in self.rig.wire.damages))
        reach_ns = self.rig.period_ns + _LATE_NS
        # on a serial line a frame can lose its end, and the next one its beginning
        back_ns = _LATE_NS + (self.rig.period_ns if self.rig.adapter.medium in ("serial", "modbus") else 0)

        def is_spoilt(time_ns: int) -> bool:
            first = np.searchsorted(damaged_ns, time_ns - back_ns - 1)
            return bool(first < len(damaged_ns) and damaged_ns[first] <= time_ns + reach_ns)

        return is_spoilt

    def _of_module(self, module: int) -> list[Update]:
        frames, times_ns = self.rig.record.frames, self.rig.record.times_ns
        sensors, device = self._sensors[module], self._device[module]
        felt, felt_ns = self._felt[device], self._felt_ns[device]
        columns = sensors - device * self.rig.truth.n_values
        found: list[Update] = []
        before_ns, last = 0, -1
        for number, frame in enumerate(frames):
            stamp_ns = int(frame.module_time_ns[module])
            status = frame.status[sensors]
            good = (status & ~np.uint8(SHOWN_ANYWAY)) == 0
            if stamp_ns == before_ns or not good.any():
                continue
            before_ns = stamp_ns
            until = int(np.searchsorted(felt_ns, times_ns[number], side="right"))
            part = felt[last + 1 : until][:, columns[good]]
            match = (part == _as_numbers(frame.values[sensors[good]])).all(axis=1)
            burst = last + 1 + int(match.argmax()) if match.any() else None
            if burst is None and last >= 0 and (felt[last, columns[good]] == frame.values[sensors[good]]).all():
                continue  # the same burst once more: its frames came twice
            last = last if burst is None else burst
            found.append(Update(number, module, burst))
        return found

    # -- explaining ---------------------------------------------------------------------------------------------

    def _wrong_sensors(self, update: Update) -> Values:
        """Return the sensors of an update that differ from the most similar of the last few bursts."""
        sensors, device = self._sensors[update.module], self._device[update.module]
        shown = _as_numbers(self.rig.record.frames[update.frame].values[sensors])
        until = self._newest_burst(device, update.frame)
        rows = self._felt[device][max(0, until - _LAGS + 1) : until + 1]
        if not len(rows):
            return sensors
        different = rows[:, sensors - device * self.rig.truth.n_values] != shown
        wrong: Values = sensors[different[int(different.sum(axis=1).argmin())]]
        return wrong

    def _newest_burst(self, device: int, frame: int) -> int:
        return int(np.searchsorted(self._felt_ns[device], self.rig.record.times_ns[frame], side="right")) - 1

    def _explain(self, sensor: int) -> str:
        structure, n = self.structure, self.rig.truth.n_values
        module = int(structure.sensor_module[sensor])
        device = self._device[module]
        updates = [u for u in self.updates if u.module == module]
        frames = [u.frame for u in updates]
        shown = _as_numbers(np.array([self.rig.record.frames[f].values[sensor] for f in frames]))
        own = sensor - device * n
        bits = int(np.max(self.rig.devices.full_scale)).bit_length()
        newest = np.array([self._newest_burst(device, f) for f in frames])
        for lag in range(_LAGS):
            rows = newest - lag
            usable = rows >= 0
            if not usable.any():
                continue
            felt, seen = self._felt[device][rows[usable]], shown[usable]
            for words, look, change in transforms(bits):
                match = (change(felt) == seen[:, np.newaxis]).mean(axis=0)
                if match[own] >= _ENOUGH:
                    if words:
                        return f"shows {words} — {look}"
                    if lag:
                        older = f"shows what it felt {lag} bursts before the rest of its module"
                        return f"{older} — are frames of two bursts mixed?"
                    return "is right by itself, but other sensors of its module are not of the same burst"
                other = int(match.argmax())
                if match[other] >= _ENOUGH and len(seen) > 2:
                    whose = sensor_name(structure, device * n + other)
                    step = other - own
                    by = f" (off by {step:+d})" if abs(step) <= 2 else ""
                    with_words = f"{words} of " if words else ""
                    look = look or "look at `offset` and `to` of the layout, and at the order of the structure"
                    return f"shows {with_words}what {whose} feels{by} — {look}"
        if len(shown) > 2 and (shown == shown[0]).all():
            return f"always shows {shown[0]} — is it written at all?"
        example = self._felt[device][newest[-1], own]
        return f"shows {shown[-1]} where {example} was felt — look at `offset`, `dtype` and `bits` of the layout"


async def until_fresh(rig: Running) -> DriverSnapshot:
    """Let time pass until every sensor is fresh; explain why if that does not happen."""
    frames, begun_ns = rig.wire.frames, rig.clock.now_ns
    heard_ns: int | None = None
    # from the first data to fresh sensors: a driver repeats its questions within 4 s
    longest_ns = max(5 * NS_PER_S, 30 * rig.period_ns)

    def is_decided(frame: DriverSnapshot) -> bool:
        nonlocal heard_ns
        if heard_ns is None and rig.wire.frames > frames:
            heard_ns = rig.clock.now_ns
        is_late = heard_ns is not None and rig.clock.now_ns > heard_ns + longest_ns
        return is_fresh(frame) or is_late

    try:
        frame = await rig.until(is_decided, "")
        require(is_fresh(frame), "")
    except BaseException:
        _explain_not_fresh(rig, (rig.clock.now_ns - begun_ns) / 1e9)
        raise
    return frame


def _explain_not_fresh(rig: Running, within_s: float) -> None:
    within = f"after {within_s:.1f} s of emulated data"
    if not rig.record.frames:
        if rig.wire.frames:
            defect(f"nothing was published {within}, though the devices sent {rig.wire.frames} frames")
        defect(f"nothing was published {within}: the devices sent no frame; the driver: {rig.sent_in_words()}")
    frame = rig.record.frames[-1]
    if rig.truth.bursts:
        ShownUpdates(rig).require_no_shift()
    else:
        defect(f"the devices sent no data {within}: does `start` start them? It sent: {rig.sent_in_words()}")
    missing = np.flatnonzero(frame.status & ~np.uint8(SHOWN_ANYWAY))
    never = np.flatnonzero(frame.status & np.uint8(Status.NEVER_SEEN))
    named = ", ".join(sensor_name(frame.structure, sensor) for sensor in (never if len(never) else missing)[:3])
    what = "was never seen" if len(never) else "is not fresh"
    count = len(never) if len(never) else len(missing)
    why = "No frame of the layout writes them: is a frame, a module or a channel missing, or two channels `to` one?"
    why = rig.unused_in_words() + why
    defect(f"{within}, {count} of {frame.structure.n_sensors} declared sensors: {what}: {named}.\n{why}")


def _as_numbers(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return values.astype(np.float64 if values.dtype.kind == "f" else np.int64)


def transforms(bits: int) -> list[tuple[str, str, Callable[[Values], Values]]]:
    """Return mistakes of drivers: in words, the advice, and the change of the values."""
    full, whole = (1 << bits) - 1, 8 * -(-bits // 8)
    order = "look at the byte order of the dtype (`<` or `>`)"
    sign = "look at the sign of the dtype (`u` or `i`, `signed`)"
    offset = "look at `offset` of the layout: it is one byte off"

    def swapped(v: Values) -> Values:
        return (v & 0xFF) << 8 | v >> 8 & 0xFF

    def beside(v: Values, step: int) -> Values:
        return np.roll(v, -step, axis=1)

    return [
        ("", "", lambda v: v),
        ("the value with its two bytes swapped", order, swapped),
        ("the value with its two bytes swapped, as signed", order, lambda v: _signed(swapped(v), 16)),
        ("the value with its four bytes reversed", order, lambda v: v.astype(">u4").view("<u4").astype(np.int64)),
        ("the unsigned value as if it were signed", sign, lambda v: _signed(v, bits)),
        ("the unsigned value as if it were signed", sign, lambda v: _signed(v, whole)),
        ("the signed value as if it were unsigned", sign, lambda v: v & full),
        ("the signed value as if it were unsigned", sign, lambda v: v & ((1 << whole) - 1)),
        ("the value upside down", "look at inversions", lambda v: full - v),
        ("only the low byte", "look at the dtype: it is too narrow", lambda v: v & 0xFF),
        ("only the high byte", "look at the dtype: it is too narrow", lambda v: v >> 8),
        ("twice the value", "look at shifts: it is one bit off", lambda v: v << 1 & full),
        ("half the value", "look at shifts: it is one bit off", lambda v: v >> 1),
        ("the value 8 bits too high", "look at shifts and at the dtype", lambda v: v << 8 & 0xFFFF),
        ("the value 4 bits too high", "look at `skip` and `bits`", lambda v: v << 4 & 0xFFFF),
        ("the value 4 bits too low", "look at `skip` and `bits`", lambda v: v >> 4),
        ("bytes of two values", offset, lambda v: (v & 0xFF) << 8 | beside(v, 1) >> 8),
        ("bytes of two values", offset, lambda v: (beside(v, -1) & 0xFF) << 8 | v >> 8),
        ("bytes of two values", offset, lambda v: v >> 8 | (beside(v, 1) & 0xFF) << 8),
        ("bytes of two values", offset, lambda v: beside(v, -1) >> 8 | (v & 0xFF) << 8),
    ]


def _signed(v: Values, bits: int) -> Values:
    return np.where(v >= 1 << (bits - 1), v - (1 << bits), v)
