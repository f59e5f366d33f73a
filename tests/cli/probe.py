"""Press an emulated skin point by point and publish the points, as a robot does for a calibration.

::

    probe = Probe("roboskin", noise_m=0.001)
    probe.press(points_m)
    probe.run(stopping)     # in a thread; publishes the service "probe": skin-calibrate touch --poses probe
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import Column, ServiceReader, ServiceWriter

_COLUMNS = {
    "point_m": Column(np.dtype("<f8"), (3,), "m", "the point of the probe, in the frame of the skin; NaN on its way"),
    "presses": Column(np.dtype("<u4"), (1,), "", "presses so far"),
}
_OPERATION = "press"
_ASK_S = 5.0
_NOWHERE = np.full(3, np.nan)


class Probe:
    """Presses a driver or emulator that has the operation ``press``.

    Args:
        skin: name of the driver or emulator.
        name: name of the service of its points.
        namespace: of both; default: the one of ``SKINWARE_NAMESPACE``.
        noise_m: standard deviation of the error of each published point in each axis.
        force_n: force of a press.
        radius_m: radius of the probe.
        press_s: how long each press lasts.
        pause_s: from the end of a press to the next.
        rate_hz: rate of the service.
        seed: seed of the noise.

    Attributes:
        presses: number of presses so far.
    """

    def __init__(
        self,
        skin: str,
        *,
        name: str = "probe",
        namespace: Namespace | str | None = None,
        noise_m: float = 0.0,
        force_n: float = 3.0,
        radius_m: float = 0.001,
        press_s: float = 0.5,
        pause_s: float = 0.1,
        rate_hz: float = 50.0,
        seed: int = 1,
    ) -> None:
        self._skin, self._name, self._namespace = skin, name, namespace
        self._how: dict[str, Any] = {"force_n": force_n, "radius_m": radius_m, "seconds": press_s}
        self._press_s, self._pause_s, self._rate_hz, self._noise_m = press_s, pause_s, rate_hz, noise_m
        self._random = np.random.default_rng(seed)
        self._to_press: deque[list[float]] = deque()
        self.presses = 0

    def press(self, points_m: npt.ArrayLike) -> None:
        """Press (m, 3) points, m, after those given before; may be called from any thread."""
        self._to_press.extend(np.asarray(points_m, np.float64).reshape(-1, 3).tolist())

    def run(self, stopping: threading.Event) -> None:
        """Press and publish until ``stopping`` is set.

        Raises:
            ServiceNotFound: there is no such driver or emulator.
            RequestError: it cannot be pressed there.
        """
        with (
            ServiceReader(self._skin, namespace=self._namespace) as skin,
            ServiceWriter(self._name, _COLUMNS, namespace=self._namespace, rate_hz=self._rate_hz) as writer,
        ):
            shown, begun_ns, asked = _NOWHERE, 0, None
            for columns in writer.periodic(self._rate_hz):
                since_s = (now_ns() - begun_ns) / NS_PER_S
                if since_s >= self._press_s:
                    shown = _NOWHERE
                if since_s >= self._press_s + self._pause_s and self._to_press:
                    if asked is not None:
                        asked.result(timeout_s=_ASK_S)
                    point = self._to_press.popleft()
                    asked, begun_ns = skin.ask(_OPERATION, at_m=point, **self._how), now_ns()
                    shown = np.array(point) + self._random.normal(0, self._noise_m, 3)
                    self.presses += 1
                columns["point_m"][:], columns["presses"][:] = shown, self.presses
                if stopping.is_set():
                    break
