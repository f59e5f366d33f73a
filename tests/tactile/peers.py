"""The rules by which others tell touches from drift, as their documents state them: what a baseline is compared with.

Each is a callable object that takes the frames of n taxels one by one, more = more pressure, at a steady rate.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Judged = tuple[npt.NDArray[np.bool_], Floats]
"""(n,) which taxels are touched, and (n,) how far they are above their baselines."""


class Rule(Protocol):
    """Tells touches from everything else."""

    def __call__(self, time_ns: int, values: npt.NDArray[np.generic]) -> Judged:
        """Take the next frame.

        Args:
            time_ns: of the frame.
            values: (n,) of the taxels.
        """


class TareOnce:
    """The mean of the first 5 s for ever; a touch is 8 counts above it.

    Args:
        rate_hz: of the frames.
    """

    def __init__(self, rate_hz: float) -> None:
        self._left = round(5 * rate_hz)
        self._frames: list[Floats] = []
        self._base: Floats | None = None

    def __call__(self, time_ns: int, values: npt.NDArray[np.generic]) -> Judged:
        del time_ns
        if self._base is None:
            self._frames.append(values.astype(np.float32))
            if len(self._frames) == self._left:
                self._base = np.mean(np.array(self._frames), axis=0).astype(np.float32)
            return _nothing(len(values))
        above = values.astype(np.float32) - self._base
        return above > 8, above


class ICub:
    """The skin manager of the iCub: baseline and threshold of the first 5 s, a baseline that follows by its threshold.

    Args:
        rate_hz: of the frames.
        add: counts that a touch must have above the threshold of noise.
        gain: of the baseline where nothing touches.
        contact_gain: and where something does.
    """

    def __init__(self, rate_hz: float, *, add: float, gain: float, contact_gain: float) -> None:
        self._left = round(5 * rate_hz)
        self._add, self._gain, self._contact_gain = add, gain, contact_gain
        self._frames: list[Floats] = []
        self._base: Floats | None = None
        self._threshold: Floats = np.ones(0, np.float32)
        self._shown: Floats = np.zeros(0, np.float32)

    @classmethod
    def by_default(cls, rate_hz: float) -> ICub:
        """With the values that its code has."""
        return cls(rate_hz, add=2, gain=0.2, contact_gain=0.0)

    @classmethod
    def as_shipped(cls, rate_hz: float) -> ICub:
        """With the values of the robots' files."""
        return cls(rate_hz, add=8, gain=0.2, contact_gain=0.05)

    def __call__(self, time_ns: int, values: npt.NDArray[np.generic]) -> Judged:
        del time_ns
        if self._base is None:
            self._frames.append(values.astype(np.float32))
            if len(self._frames) == self._left:
                self._base = np.mean(np.array(self._frames), axis=0).astype(np.float32)
                above = np.percentile(np.array(self._frames), 95, axis=0).astype(np.float32) - self._base
                self._threshold, self._shown = np.maximum(above, 1), np.zeros_like(self._base)
            return _nothing(len(values))
        above = np.minimum(values.astype(np.float32) - self._base, 255)
        touched = above > self._threshold + self._add
        gain = np.where(touched, np.float32(self._contact_gain), np.float32(self._gain))
        self._base += np.float32(0.02) * gain * above / self._threshold
        self._shown += (above - self._shown) / 2
        return touched, self._shown.copy()


class CapSense:
    """A baseline that follows within a noise threshold, is held above it, and begins anew after a time below it.

    Args:
        threshold: of touch, counts.
        share: of what is above the baseline, by which it follows in a scan.
        scans_below: after so many it begins anew.
    """

    def __init__(self, threshold: float = 8, *, share: float = 1 / 64, scans_below: int = 20) -> None:
        self._on, self._off, self._noise = threshold, 0.8 * threshold, threshold / 2
        self._share, self._scans_below = np.float32(share), scans_below
        self._base: Floats | None = None
        self._below = np.zeros(0, np.int64)
        self._touched = np.zeros(0, bool)

    def __call__(self, time_ns: int, values: npt.NDArray[np.generic]) -> Judged:
        del time_ns
        now = values.astype(np.float32)
        if self._base is None:
            self._base, self._below = now.copy(), np.zeros(len(now), np.int64)
            self._touched = np.zeros(len(now), bool)
        above = now - self._base
        self._touched = above > np.where(self._touched, self._off, self._on)
        self._base += np.where(np.abs(above) <= self._noise, self._share * above, 0)
        self._below = np.where(above < -self._noise, self._below + 1, 0)
        again = self._below >= self._scans_below
        self._base[again] = now[again]
        return self._touched.copy(), above


class QTouch:
    """A reference that moves by whole counts, slowly towards a touch and faster away; all are held near any touch.

    Args:
        rate_hz: of the frames.
        threshold: of touch, counts.
        max_on_s: after so long a touch is taken for the reference; 0: never.
    """

    def __init__(self, rate_hz: float, threshold: float = 8, *, max_on_s: float = 6) -> None:
        self._on, self._off, self._away = threshold, 0.75 * threshold, 0.5 * threshold
        self._towards_frames, self._away_frames = round(4 * rate_hz), round(rate_hz)
        self._hold_frames, self._max_on = round(4 * rate_hz), round(max_on_s * rate_hz)
        self._held = self._frames = 0
        self._base: Floats | None = None
        self._touched = np.zeros(0, bool)
        self._counts: dict[str, npt.NDArray[np.int64]] = {}

    def __call__(self, time_ns: int, values: npt.NDArray[np.generic]) -> Judged:
        del time_ns
        now = values.astype(np.float32)
        if self._base is None:
            self._base, self._touched = now.copy(), np.zeros(len(now), bool)
            self._counts = {name: np.zeros(len(now), np.int64) for name in ("debounce", "on", "away")}
        above, counts = now - self._base, self._counts
        differs = (above > np.where(self._touched, self._off, self._on)) != self._touched
        counts["debounce"] = np.where(differs, counts["debounce"] + 1, 0)
        self._touched ^= counts["debounce"] >= 4
        counts["on"] = np.where(self._touched, counts["on"] + 1, 0)
        counts["away"] = np.where(above < -self._away, counts["away"] + 1, 0)
        too_long = counts["on"] > self._max_on if self._max_on else np.zeros(len(now), bool)
        again = too_long | (counts["away"] >= 3)
        self._base[again] = now[again]
        self._touched &= ~too_long
        self._held = self._hold_frames if self._touched.any() else max(0, self._held - 1)
        if not self._held:
            self._frames += 1
            if self._frames % self._towards_frames == 0:
                self._base += above >= 1
            if self._frames % self._away_frames == 0:
                self._base -= above <= -1
        return self._touched.copy(), above


def _nothing(n: int) -> Judged:
    return np.zeros(n, bool), np.zeros(n, np.float32)
