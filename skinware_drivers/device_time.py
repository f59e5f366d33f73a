"""Convert the stamps of a device's own clock to CLOCK_MONOTONIC: when a sample was taken, not when its frame came.

The device may also be the controller of a CAN interface, whose frames are received when the kernel stamps them. A frame
is received some time after it was stamped, never before. The shortest delay varies little, while USB and busy computers
add milliseconds to many frames and half a second to a few. So the line that lies under all points (stamp,
time of receipt), and as close to them as possible, gives the rate of the device's clock, and its offset up to the
shortest delay (S. B. Moon, P. Skelly, D. Towsley, "Estimation and Removal of Clock Skew from Network Delay
Measurements", 1999). Late frames do not move it.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S

Times = npt.NDArray[np.int64]
Floats = npt.NDArray[np.floating[Any]]

_WINDOW_PARTS = 60
"""A shorter window follows changes of temperature faster, a longer one is steadier."""
_MOST_DRIFT = 500e-6
"""Largest rate error of a device's clock, as a fraction."""
_RECENT_PARTS = 10
"""The offset is the least delay of the last parts in which frames came, so that delayed frames are known as late, also
after a pause."""
_LEAST_SPAN_PARTS = 2
"""Before points span this time, the device's clock is assumed to run like CLOCK_MONOTONIC."""
_FAR_BEHIND_NS = NS_PER_S
"""If all stamps of a part lie further in the past, the device's clock stands still: after a delay of the line or of
this machine, frames without delay follow at once."""


class DeviceClock:
    """Brings the stamps of one device onto CLOCK_MONOTONIC.

    The resulting times are never after the time of receipt, and never go back. After a restart (a stamp that goes back,
    or that lies in the future) or a stop (a clock that stands still, or is far too slow), all that is known of the
    clock is discarded. While it stands still, frames get the time of their receipt.

    A gap in the stream, or the delay of a frame, may be as long as half the time in which the stamps wrap around; the
    time of receipt determines how often they have wrapped.

    Args:
        unit_s: seconds per count.
        modulo: the stamps wrap to 0 here.
        part_ns: one point is kept for each part of the window of this length: the one with the least delay.
        jump_ns: a stamp so far in the future shows that the device's clock was set.

    Attributes:
        restarts: how often the device's clock restarted.
        stops: how often it was found to stand still.
        repeated: stamps equal to the one before.
    """

    def __init__(
        self, unit_s: float, modulo: int = 1 << 32, *, part_ns: int = NS_PER_S, jump_ns: int = NS_PER_S // 20
    ) -> None:
        self._unit_ns = unit_s * NS_PER_S
        self._modulo, self._part_ns, self._jump_ns = modulo, part_ns, jump_ns
        self._points: deque[tuple[int, float, float]] = deque(maxlen=_WINDOW_PARTS)
        self._origin_ns = 0
        self._ticks = 0
        self._stamp = -1
        self._received_ns = 0
        self._last_ns = -(1 << 63)
        self.drift: float = 0.0
        """How much slower the device's clock is than CLOCK_MONOTONIC, as a fraction; 0 until it is known."""
        self._offset_ns = 0.0
        self.restarts: int = 0
        self.stops: int = 0
        self.repeated: int = 0

    def convert(self, stamps: npt.ArrayLike, received_ns: npt.ArrayLike) -> Times:
        """Return when frames were stamped.

        Args:
            stamps: (n,) whole numbers as the device sent them, in the order in which they were received.
            received_ns: (n,) int64, CLOCK_MONOTONIC ns, not descending.

        Returns:
            (n,) int64, CLOCK_MONOTONIC ns.
        """
        raw, received = np.asarray(stamps).astype(np.int64), np.asarray(received_ns, np.int64)
        times_ns = received.copy()
        if not len(raw):
            return times_ns
        is_first = self._stamp < 0
        if is_first:
            self._begin(int(raw[0]), int(received[0]))
        # counts since the stamp before, with as many turns as fit the time that has passed
        difference = np.diff(raw, prepend=self._stamp)
        passed = np.diff(received, prepend=self._received_ns) / self._unit_ns
        step = difference + np.rint((passed - difference) / self._modulo).astype(np.int64) * self._modulo
        self.repeated += int((step == 0).sum()) - is_first
        edges = [0, *np.flatnonzero(step < 0).tolist(), len(raw)]
        for number, (start, stop) in enumerate(pairwise(edges)):
            if number:
                self._restart(raw, received, step, start)
            while start < stop:
                start = self._convert_part(raw, received, step, times_ns, start, stop)
        self._stamp, self._received_ns = int(raw[-1]), int(received[-1])
        np.maximum.accumulate(np.maximum(times_ns, self._last_ns), out=times_ns)
        np.minimum(times_ns, received, out=times_ns)
        # the newest whole part shows that the clock stands still
        _, x, y = self._points[-2] if len(self._points) > 1 else (0, 0.0, -math.inf)
        if y - self.drift * x - self._offset_ns > _FAR_BEHIND_NS:
            self.stops += 1
            self._stamp = -1  # the next one restarts the clock
            times_ns = received.copy()
        self._last_ns = int(times_ns[-1])
        return times_ns

    def _begin(self, stamp: int, received_ns: int) -> None:
        self._points.clear()
        self._origin_ns, self._received_ns, self._stamp = received_ns, received_ns, stamp
        self._ticks = 0
        self.drift = self._offset_ns = 0.0

    def _restart(self, raw: Times, received: Times, step: Times, at: int) -> None:
        self.restarts += 1
        self._begin(int(raw[at]), int(received[at]))
        step[at] = 0

    def _convert_part(self, raw: Times, received: Times, step: Times, times_ns: Times, start: int, stop: int) -> int:
        """Convert up to a jump into the future; return where to continue."""
        ticks = self._ticks + np.cumsum(step[start:stop])
        device_ns: Floats = ticks * self._unit_ns
        delay_ns: Floats = (received[start:stop] - self._origin_ns) - device_ns
        future = np.flatnonzero(delay_ns - self._line(device_ns) < -self._jump_ns)
        if len(future):
            stop = start + int(future[0])
            device_ns, delay_ns = device_ns[: int(future[0])], delay_ns[: int(future[0])]
        if stop > start:
            self._learn(received[start:stop], device_ns, delay_ns)
            times_ns[start:stop] = self._origin_ns + np.rint(device_ns + self._line(device_ns)).astype(np.int64)
            self._ticks = int(ticks[stop - start - 1])
        if len(future):
            self._restart(raw, received, step, stop)
        return stop

    def _line(self, device_ns: Floats) -> Floats:
        return self._offset_ns + self.drift * device_ns

    def _learn(self, received: Times, device_ns: Floats, delay_ns: Floats) -> None:
        """Keep the points of least delay, and fit the line under them."""
        above = delay_ns - self.drift * device_ns
        parts = received // self._part_ns
        edges = np.flatnonzero(np.diff(parts, prepend=parts[:1] - 1))
        for start, stop in zip(edges.tolist(), [*edges[1:].tolist(), len(parts)], strict=True):
            best = start + int(np.argmin(above[start:stop]))
            point = int(parts[start]), float(device_ns[best]), float(delay_ns[best])
            if not self._points or self._points[-1][0] != point[0]:
                self._points.append(point)
                self._fit_slope()
            elif above[best] < self._points[-1][2] - self.drift * self._points[-1][1]:
                self._points[-1] = point
        oldest = self._points[-1][0] - _WINDOW_PARTS
        recent = [point for point in list(self._points)[-_RECENT_PARTS:] if point[0] > oldest]
        self._offset_ns = min(y - self.drift * x for _, x, y in recent)

    def _fit_slope(self) -> None:
        whole = list(self._points)[:-1]  # the best point of the newest part may be yet to come
        if len(whole) < 2 or whole[-1][1] - whole[0][1] < _LEAST_SPAN_PARTS * self._part_ns:
            return
        hull: list[tuple[float, float]] = []
        for _, x, y in whole:
            while len(hull) > 1:
                (x0, y0), (x1, y1) = hull[-2:]
                if (y1 - y0) * (x - x0) < (x1 - x0) * (y - y0):
                    break
                hull.pop()  # it lies on or above the line from the one before to this one
            hull.append((x, y))
        middle = sum(x for _, x, _ in whole) / len(whole)
        right = next(number for number, (x, _) in enumerate(hull) if x >= middle)
        (x0, y0), (x1, y1) = hull[right - 1], hull[right]
        slope = (y1 - y0) / (x1 - x0)
        self.drift = min(max(slope, -_MOST_DRIFT), _MOST_DRIFT)
