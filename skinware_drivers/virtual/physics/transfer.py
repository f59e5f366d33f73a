"""From newtons to the counts that a device adds to its rest: the elastomer, the sensor and its errors.

Everything follows from the forces, their times and the seed alone, so that a test computes the same.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.tactile.testing import Response

ArrayF = npt.NDArray[np.float64]

_SERIES = 1 << 16
"""Numbers of the noise; each sample has a piece of them, which its time chooses."""
_WORD = (1 << 64) - 1

_NotNegative = Annotated[float, msgspec.Meta(ge=0)]
_Share = Annotated[float, msgspec.Meta(ge=0, lt=1)]
_Time = Annotated[float, msgspec.Meta(gt=0)]


class TransferSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a module answers force, as docs/how-to/simulate.md explains; by default it is linear and has no errors."""

    counts_per_n: _NotNegative = 100.0
    shear_counts_per_n: _NotNegative | None = None
    saturation_n: _NotNegative = 0.0
    gain_spread: _Share = 0.0
    crosstalk: _Share = 0.0
    crosstalk_m: _Time = 0.003
    hysteresis: _Share = 0.0
    creep: _NotNegative = 0.0
    remainder: _NotNegative = 0.0
    creep_s: _Time = 40.0
    noise: _NotNegative = 0.0
    drift: _NotNegative = 0.0
    drift_s: _Time = 300.0
    warmth: float = 0.0
    warming_k: float = 0.0
    warming_s: _Time = 600.0


class Transfer:
    """The answer of one module of n taxels.

    Args:
        position_m: (n, 3) of the taxels.
        seed: of gains, noise and phases; for example (seed, device, module).
    """

    def __init__(self, settings: TransferSettings, position_m: ArrayF, seed: tuple[int, ...]) -> None:
        self._settings, n = settings, len(position_m)
        random = np.random.default_rng([*seed, 11])
        gain = np.maximum(0.0, 1 + settings.gain_spread * random.standard_normal((n, 1)))
        normal, shear = settings.counts_per_n, settings.shear_counts_per_n
        per_n = np.array([normal if shear is None else shear] * 2 + [normal])
        self._per_n: ArrayF = gain * per_n
        self._phase = random.uniform(0, 2 * math.pi, (n, 1))
        self._salt = int(random.integers(1 << 62))
        self._lowest, self._highest = 1 - settings.hysteresis, 1 + settings.hysteresis
        self._spread: ArrayF | None = None
        if settings.crosstalk and n > 1:
            distance = np.linalg.norm(position_m[:, np.newaxis] - position_m, axis=2)
            bell = np.exp(-0.5 * (distance / settings.crosstalk_m) ** 2) * (1 - np.eye(n))
            given = bell.sum(axis=0)
            self._spread = settings.crosstalk * bell / np.where(given > 0, given, 1)
            self._spread += np.diag(1 - settings.crosstalk * (given > 0))
        self._response = Response(creep=settings.creep, remainder=settings.remainder, creep_s=settings.creep_s)
        self._is_slow = settings.creep > 0 or settings.remainder > 0
        self._felt, self._used_to = np.zeros(n), np.zeros(n)
        self._time_s: float | None = None

    def counts(self, force_n: ArrayF, time_s: float) -> ArrayF:
        """Return (n, 3) counts that are added to the rest: x, y, normal.

        Args:
            force_n: (n, 3) forces on the taxels: shear along x and y, and normal force, N.
            time_s: never before that of the last call.
        """
        settings = self._settings
        if self._spread is not None:
            force_n = self._spread @ force_n
        normal = force_n[:, 2]
        self._felt = felt = np.minimum(np.maximum(self._felt, normal * self._lowest), normal * self._highest)
        if self._is_slow:
            period_s = 0.0 if self._time_s is None else time_s - self._time_s
            felt = felt + self._response.slowly(felt[np.newaxis], self._used_to, period_s)[0]
        self._time_s = time_s
        if settings.saturation_n:
            felt = felt / (1 + felt / settings.saturation_n)
        counts: ArrayF = force_n * self._per_n
        counts[:, 2] = felt * self._per_n[:, 2]
        if settings.drift:
            counts += settings.drift * np.sin(2 * math.pi * time_s / settings.drift_s + self._phase)
        if settings.warmth:
            counts += settings.warmth * settings.warming_k * (1 - math.exp(-time_s / settings.warming_s))
        if settings.noise:
            counts += settings.noise * self._noise(round(time_s * 1e9), counts.size).reshape(counts.shape)
        return counts

    def _noise(self, time_ns: int, size: int) -> ArrayF:
        """Return (size,) normal numbers that follow from the time and the seed; a generator for each takes 60 us."""
        mixed = (time_ns ^ self._salt) * 0xBF58476D1CE4E5B9 & _WORD
        mixed = (mixed ^ mixed >> 31) * 0x94D049BB133111EB & _WORD
        series = _series(size)
        first = (mixed ^ mixed >> 29) % (len(series) - size)
        return series[first : first + size]


@cache
def _series(size: int) -> ArrayF:
    return np.random.default_rng(size).standard_normal(_SERIES + size)
