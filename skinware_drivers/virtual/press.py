"""The touch of a small device: a finger that wanders over it, presses and lets go, by time and seed alone."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

_PRESS_S, _PAUSE_S, _RAMP_S = 2.6, 1.4, 0.5
_PRESSES, _REST_S = 6, 6.0
"""Presses in a row, and the rest after them, in which a baseline can begin."""
_RADIUS = 0.22
"""Radius of the pressed spot; the device is 1 wide."""


class Press:
    """A wandering press on one device.

    Args:
        seed: of the emulation.
        number: of the device; devices with other numbers feel other presses.
        places: (n, 2) of its sensors, 0 to 1.
    """

    def __init__(self, seed: int, number: int, places: npt.NDArray[np.float64]) -> None:
        random = np.random.default_rng([seed, number, 3])
        self._phase = random.uniform(0, 9)
        self._first_s = random.uniform(0, _PAUSE_S)
        self._places = places

    def strength(self, time_s: float) -> npt.NDArray[np.float64]:
        """Return (n,) strengths, 0 to 1, at a time since the device began to send."""
        since_s = time_s - self._first_s
        in_round_s = since_s % (_PRESSES * (_PRESS_S + _PAUSE_S) + _REST_S)
        is_pressing = since_s > 0 and in_round_s < _PRESSES * (_PRESS_S + _PAUSE_S)
        moment_s = in_round_s % (_PRESS_S + _PAUSE_S)
        ramp = min(max(min(moment_s, _PRESS_S - moment_s) / _RAMP_S, 0.0), 1.0) if is_pressing else 0.0
        at = time_s + self._phase
        centre = 0.5 + 0.4 * np.array([math.sin(0.71 * at), math.sin(0.53 * at + 1)])
        distance2 = ((self._places - centre) ** 2).sum(axis=1)
        strength: npt.NDArray[np.float64] = ramp * np.exp(distance2 * (-0.5 / _RADIUS**2))
        return strength


def on_a_grid(count: int, columns: int, each: int = 1) -> npt.NDArray[np.float64]:
    """Return (count * each, 2) places of sensors in rows, with ``each`` at the same place."""
    number = np.arange(count)
    rows = -(-count // columns)
    places = np.stack([(number % columns + 0.5) / columns, (number // columns + 0.5) / rows], axis=1)
    return np.repeat(places, each, axis=0)
