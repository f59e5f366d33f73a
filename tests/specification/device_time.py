"""Device stamps on CLOCK_MONOTONIC, frame by frame: what ``device_time.c`` is compared with."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.layout import Frame

Times = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]

_WINDOW_PARTS, _RECENT_PARTS, _LEAST_SPAN_PARTS = 60, 10, 2
_MOST_DRIFT = 500e-6
_FAR_BEHIND_NS = NS_PER_S


class Point(NamedTuple):
    """The frame of least delay of a part; its stamp and delay count from the clock's origin."""

    part: int
    device_ns: float
    delay_ns: float


class SpecifiedClock:
    """The clock of one device; see ``skinware_drivers.native.device_time.DeviceClock``."""

    def __init__(
        self, unit_s: float, modulo: int = 1 << 32, *, part_ns: int = NS_PER_S, jump_ns: int = NS_PER_S // 20
    ) -> None:
        self._unit_ns = unit_s * NS_PER_S
        self._modulo, self._part_ns, self._jump_ns = modulo, part_ns, jump_ns
        self._points: deque[Point] = deque(maxlen=_WINDOW_PARTS)
        self._origin_ns = self._received_ns = self._ticks = 0
        self._stamp, self._last_ns = -1, -(1 << 63)
        self._drift = self._offset_ns = 0.0
        self.restarts = self.stops = 0
        self._is_still = False

    def known(self) -> dict[str, float]:
        """Return what is known of the clock, by the names in C."""
        found = {name: getattr(self, f"_{name}") for name in ("drift", "offset_ns", "origin_ns", "ticks", "stamp")}
        found |= {"received_ns": self._received_ns, "last_ns": self._last_ns, "n_points": len(self._points)}
        return found | {"restarts": self.restarts, "stops": self.stops, "is_still": self._is_still}

    def convert(self, stamps: npt.ArrayLike, received_ns: npt.ArrayLike) -> Times:
        """Return (n,) int64, CLOCK_MONOTONIC ns: when frames were stamped that were received then."""
        pairs = zip(np.asarray(stamps).tolist(), np.asarray(received_ns).tolist(), strict=True)
        return np.array([self.convert_one(*pair) for pair in pairs], np.int64)

    def convert_one(self, stamp: int, received_ns: int) -> int:
        if self._is_still:
            passed_ns = received_ns - self._received_ns
            if passed_ns >= self._part_ns:  # goes it again?
                self._is_still = 2 * self._step(stamp, received_ns) * self._unit_ns < passed_ns
                self._received_ns, self._stamp = received_ns, stamp if self._is_still else -1
            if self._is_still:
                self._last_ns = received_ns
                return received_ns
        if self._stamp < 0:
            self._begin(stamp, received_ns)
        step = self._step(stamp, received_ns)
        device_ns = (self._ticks + step) * self._unit_ns
        delay_ns = (received_ns - self._origin_ns) - device_ns
        if step < 0 or delay_ns - self._line_ns(device_ns) < -self._jump_ns:
            self.restarts += 1
            self._begin(stamp, received_ns)
            step, device_ns, delay_ns = 0, 0.0, 0.0
        self._learn(Point(received_ns // self._part_ns, device_ns, delay_ns))
        time_ns = self._origin_ns + round(device_ns + self._line_ns(device_ns))
        self._ticks += step
        self._stamp, self._received_ns = stamp, received_ns
        time_ns = min(max(time_ns, self._last_ns), received_ns)
        # the newest whole part shows that the clock stands still
        if len(self._points) > 1 and self._above_ns(self._points[-2]) - self._offset_ns > _FAR_BEHIND_NS:
            self.stops += 1
            self._is_still = True
            time_ns = received_ns
        self._last_ns = time_ns
        return time_ns

    def _step(self, stamp: int, received_ns: int) -> int:
        """Return counts since the stamp before, with as many turns as fit the time that has passed."""
        difference = stamp - self._stamp
        passed = (received_ns - self._received_ns) / self._unit_ns
        return difference + round((passed - difference) / self._modulo) * self._modulo

    def _begin(self, stamp: int, received_ns: int) -> None:
        self._points.clear()
        self._origin_ns, self._received_ns, self._stamp = received_ns, received_ns, stamp
        self._ticks = 0
        self._drift = self._offset_ns = 0.0

    def _line_ns(self, device_ns: float) -> float:
        return self._offset_ns + self._drift * device_ns

    def _above_ns(self, point: Point) -> float:
        return point.delay_ns - self._drift * point.device_ns

    def _learn(self, point: Point) -> None:
        if not self._points or self._points[-1].part != point.part:
            self._points.append(point)
            self._fit_slope()
        elif self._above_ns(point) < self._above_ns(self._points[-1]):
            self._points[-1] = point
        recent = list(self._points)[-_RECENT_PARTS:]
        known = [each for each in recent if each.part > point.part - _WINDOW_PARTS]
        self._offset_ns = min(map(self._above_ns, known))

    def _fit_slope(self) -> None:
        whole = list(self._points)[:-1]  # the best point of the newest part may be yet to come
        if len(whole) < 2 or whole[-1].device_ns - whole[0].device_ns < _LEAST_SPAN_PARTS * self._part_ns:
            return
        hull: list[Point] = []
        total = 0.0
        for point in whole:
            while len(hull) > 1:
                (_, x0, y0), (_, x1, y1) = hull[-2:]
                if (y1 - y0) * (point.device_ns - x0) < (x1 - x0) * (point.delay_ns - y0):
                    break
                hull.pop()
            hull.append(point)
            total += point.device_ns
        middle = total / len(whole)
        right = next((number for number, point in enumerate(hull) if point.device_ns >= middle), len(hull) - 1)
        (_, x0, y0), (_, x1, y1) = hull[right - 1], hull[right]
        self._drift = min(max((y1 - y0) / (x1 - x0), -_MOST_DRIFT), _MOST_DRIFT)


class DeviceStamps:
    """The clocks of all patches.

    Attributes:
        clocks: by patch, of those that have sent a stamp.
    """

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._frames: Sequence[Frame] = decoder.compiled.frames
        self._module_patch = decoder.tables.structure.module_patch.tolist()
        self.clocks: dict[int, SpecifiedClock] = {}

    def apply(self, kind: Bytes, module: Times, payload: Bytes, time_ns: Times) -> None:
        """Replace the times (CLOCK_MONOTONIC ns) at which n frames were received by those at which they were stamped.

        Modules from ``n_modules`` on are none.
        """
        decoder = self._decoder
        for row, (number, entry) in enumerate(zip(kind.tolist(), module.tolist(), strict=True)):
            time = self._frames[number].time if number < len(self._frames) else None
            if time is None or entry >= len(self._module_patch):
                continue
            patch = self._module_patch[entry]
            if not decoder.knows_clock[patch]:
                decoder.knows_clock[patch] = True
                self.clocks[patch] = SpecifiedClock(time.unit_s, time.turn)
            clock = self.clocks[patch]
            stops = clock.stops
            stamp = int(np.ascontiguousarray(payload[row, time.offset : time.end]).view(time.dtype)[0]) % time.turn
            time_ns[row] = clock.convert_one(stamp, int(time_ns[row]))
            decoder.clock_stops[patch] += clock.stops - stops
        decoder.warn()
