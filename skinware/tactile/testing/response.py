"""Simulate how a skin answers a force, and its faults."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from skinware.errors import ConfigurationError
from skinware.status import Status
from skinware.tactile.arrays import Doubles, Flags, Whole

_FAR = 5.0  # widths beyond which nothing is felt


@dataclass(frozen=True)
class Response:
    """The answer of taxels at a distance from a force.

    Attributes:
        width_m: of the bell, m: its standard deviation.
        sag: share of the load by which the cover is pulled down at ``sag_radius_m`` from a contact.
        sag_radius_m: where it sags most, m.
        creep: share of a load by which the value grows under it.
        remainder: share of a load that stays for a while after it.
        creep_s: time constant of both.

    Raises:
        ConfigurationError: a width, radius or time constant that is not above 0.
    """

    width_m: float = 0.004
    sag: float = 0.0
    sag_radius_m: float = 0.012
    creep: float = 0.0
    remainder: float = 0.0
    creep_s: float = 40.0

    def __post_init__(self) -> None:
        for name in ("width_m", "sag_radius_m", "creep_s"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"{name} {getattr(self, name)}: give more than 0")

    @property
    def reach_m(self) -> float:
        """Distance from a contact beyond which nothing changes, m."""
        return _FAR * self.width_m if self.sag == 0 else max(_FAR * self.width_m, 4 * self.sag_radius_m)

    def bell(self, distance_m: Doubles) -> Doubles:
        """Return the share of the force that is felt as load, at distances; 0 at NaN."""
        near = distance_m <= _FAR * self.width_m
        load: Doubles = np.where(near, np.exp(-0.5 * (np.where(near, distance_m, 0) / self.width_m) ** 2), 0.0)
        return load

    def ring(self, distance_m: Doubles) -> Doubles:
        """Return the share of the force that is missing round it, at distances; 0 at NaN."""
        squared = np.where(distance_m <= 4 * self.sag_radius_m, distance_m / self.sag_radius_m, 0) ** 2
        missing: Doubles = self.sag * squared * np.exp(1 - squared)
        return missing

    def slowly(self, load: Doubles, crept: Doubles, period_s: float) -> Doubles:
        """Return (m, k) what creep and remainder add to a block of (m, k) loads, one each ``period_s``.

        ``crept``, (k,) the load that the material is used to, is updated.
        """
        gain = 1 - np.exp(-period_s / self.creep_s)
        used_to = np.empty_like(load)
        for row, now in enumerate(load):
            crept += gain * (now - crept)
            used_to[row] = crept
        return self.creep * np.minimum(used_to, load) + self.remainder * np.maximum(used_to - load, 0)


@dataclass(frozen=True)
class Missing:
    """Taxels without data for a while: their status meanwhile, and a value; None: the last one (0 before the first)."""

    taxels: Whole
    begin_s: float
    end_s: float
    status: Status
    value: float | None


@dataclass(frozen=True)
class Jump:
    """A board that moves its baseline by counts, and is ``SUSPECT`` for a while; 0: its driver notices nothing."""

    taxels: Whole
    counts: float
    at_s: float
    suspect_s: float


@dataclass
class Faults:
    """All faults of a world of n taxels.

    Attributes:
        feels: (n,) bool, False: the taxel feels no load.
        noise: (n,) factor on its noise.
        stuck: (n,) the value that a taxel always shows; NaN: it is not stuck.
        source: (n,) the taxel whose data arrives in each one's place.
        missing, jumps: gaps and jumps.
    """

    feels: Flags
    noise: Doubles
    stuck: Doubles
    source: Whole
    missing: list[Missing] = field(default_factory=list)
    jumps: list[Jump] = field(default_factory=list)

    @classmethod
    def none(cls, n: int) -> Faults:
        return cls(np.ones(n, bool), np.ones(n), np.full(n, np.nan), np.arange(n))

    def jumped(self, time_s: Doubles, patch: Whole) -> tuple[Doubles | None, Flags | None]:
        """Return (m, n) how jumps change the values, and (m, n) which are suspect; None if there is no jump yet.

        Acquisitions are at (m, n_patches) times; ``patch`` is (n,), of the taxels.
        """
        if not any(time_s[-1].max() >= jump.at_s for jump in self.jumps):
            return None, None
        added, suspect = np.zeros((len(time_s), len(patch))), np.zeros((len(time_s), len(patch)), bool)
        for jump in self.jumps:
            at_s = time_s[:, patch[jump.taxels]]
            added[:, jump.taxels] += jump.counts * (at_s >= jump.at_s)
            suspect[:, jump.taxels] |= (at_s >= jump.at_s) & (at_s < jump.at_s + jump.suspect_s)
        return added, suspect
