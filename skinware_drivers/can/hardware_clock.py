"""A controller's clock on ours, found out from the frames themselves.

A controller stamps a frame when it is on the wire, on a counter of its own: with another zero, and a rate that is wrong
by up to some hundred ppm. The kernel stamps it later, on our clock, and by how much later varies (USB: milliseconds).
So kernel stamp minus controller stamp is the offset of the clocks plus a delay that is never negative: the offset is
the lower edge of these differences, a straight line over some seconds.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

Stamps = npt.NDArray[np.int64]

BLOCK_NS = 250_000_000
"""The smallest difference within this time is one point of the lower edge."""
BLOCKS = 40
LEAST_BLOCKS = 4
"""Before there are so many, the two clocks are taken to run equally fast."""
LARGEST_DRIFT = 1e-3
LARGEST_FALL_NS = 10_000_000
"""No delay is negative: nothing can be below the line by so much, unless the controller's clock was set."""
LONGEST_DELAY_NS = 100_000_000
"""What is further off the line than this means that the controller's clock was set or began anew."""


class HardwareClock:
    """The clock of one controller."""

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        self._points: deque[tuple[int, int]] = deque(maxlen=BLOCKS)  # (hardware stamp, difference) at the lower edge
        self._block_began_ns = 0
        self._lowest: tuple[int, int] | None = None  # point of this block
        self._drift = 0.0
        self._edge = (0, 0)  # a point that the line goes through
        self._last_ns = 0

    def convert(self, hardware: Stamps, software: Stamps) -> Stamps:
        """(n,) int64, CLOCK_MONOTONIC ns: when frames were on the wire.

        Args:
            hardware: (n,) int64, stamps of the controller, ns, in order; 0 where it gave none.
            software: (n,) int64, stamps of the kernel, CLOCK_MONOTONIC ns; kept where nothing better is known.
        """
        known = np.flatnonzero(hardware)
        if not len(known):
            return software
        stamps = software.copy()
        # where the controller's clock goes back or jumps, another life of it begins
        steps, arrived = np.diff(hardware[known]), np.diff(software[known])
        cuts = np.flatnonzero((steps < 0) | (np.abs(arrived - steps) > LONGEST_DELAY_NS)) + 1
        for rows in np.split(known, cuts):
            stamps[rows] = self._convert_one_life(hardware[rows], software[rows])
        return stamps

    def _convert_one_life(self, hardware: Stamps, software: Stamps) -> Stamps:
        difference = software - hardware
        if (self._points or self._lowest is not None) and not self._goes_on(hardware, difference):
            self._forget()
        self._learn(hardware, difference)
        self._last_ns = int(hardware[-1])
        stamps: Stamps = hardware + self._line(hardware)
        np.maximum(stamps, software - LONGEST_DELAY_NS, out=stamps)
        np.minimum(stamps, software, out=stamps)  # it was on the wire before the kernel had it
        return stamps

    def _goes_on(self, hardware: Stamps, difference: Stamps) -> bool:
        """Whether these stamps can be of the clock that is known. One that fits is enough: others may be delayed."""
        if hardware[0] < self._last_ns:
            return False
        above = difference - self._line(hardware)
        return bool(np.abs(above).min() < LONGEST_DELAY_NS and above.min() > -LARGEST_FALL_NS)

    def _line(self, hardware: Stamps) -> Stamps:
        at, offset = self._edge
        line: Stamps = offset + np.rint((hardware - at) * self._drift).astype(np.int64)
        return line

    def _learn(self, hardware: Stamps, difference: Stamps) -> None:
        if not self._points and self._lowest is None:
            self._edge = int(hardware[0]), int(difference[0])
        above = difference - self._line(hardware)
        lowest = int(np.argmin(above))
        point = int(hardware[lowest]), int(difference[lowest])
        if above[lowest] < 0:
            self._edge = point
        if self._lowest is None:
            self._block_began_ns, self._lowest = int(hardware[0]), point
        elif point[1] - self._lowest[1] < (point[0] - self._lowest[0]) * self._drift:
            self._lowest = point
        if int(hardware[-1]) - self._block_began_ns >= BLOCK_NS:
            self._points.append(self._lowest)
            self._lowest = None
            self._fit()

    def _fit(self) -> None:
        """The line along the lower edge: the median of all slopes between points, as low as the lowest point."""
        at = np.array([point[0] for point in self._points], np.int64)
        offset = np.array([point[1] for point in self._points], np.int64)
        x, y = (at - at[-1]).astype(np.float64), (offset - offset[-1]).astype(np.float64)
        first, second = np.triu_indices(len(x), 1)
        apart = x[second] > x[first]
        if np.count_nonzero(apart) >= LEAST_BLOCKS * (LEAST_BLOCKS - 1) // 2:
            slopes = (y[second] - y[first])[apart] / (x[second] - x[first])[apart]
            self._drift = min(max(float(np.median(slopes)), -LARGEST_DRIFT), LARGEST_DRIFT)
        self._edge = int(at[-1]), int(offset[-1] + np.floor((y - x * self._drift).min()))
