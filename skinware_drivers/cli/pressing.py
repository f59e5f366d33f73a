"""The service of ``skin-emulate`` by which programs press the emulated skin, and which publishes the presses."""

from __future__ import annotations

import numpy as np

from skinware.memory.namespace import Namespace
from skinware.memory.schema import Column
from skinware.realtime import NS_PER_S
from skinware.realtime import now_ns as clock_ns
from skinware.service import ServiceWriter
from skinware_drivers.virtual.hardware import PlacedHardware, Pressing

_RATE_HZ = 50
_MOST = 16


class PressingService:
    """Publish the presses on the skin at 50 Hz, and take new ones by the operation ``press``.

    Args:
        bus_name: of the emulation, for the replies.

    Raises:
        NameInUse, NamespaceError, ConfigurationError: as for :class:`skinware.ServiceWriter`.
    """

    def __init__(self, name: str, hardware: PlacedHardware, bus_name: str, namespace: Namespace | None = None) -> None:
        self._hardware = hardware
        self._bus_name = bus_name
        self._due_ns = 0
        self._writer = ServiceWriter(
            name,
            {
                "count": Column(np.dtype("<u4"), (1,), "", "number of presses; later rows are old"),
                "point_m": Column(np.dtype("<f8"), (_MOST, 3), "m", "places, in the coordinate frame of the geometry"),
                "force_n": Column(np.dtype("<f8"), (_MOST,), "N", "of each"),
            },
            namespace=namespace,
            rate_hz=_RATE_HZ,
            description="presses on an emulated skin",
            operations={"press": self.press},
        )
        self._writer.request_server()  # takes requests from now on, before the first turn of the loop

    def fileno(self) -> int:
        return self._writer.request_server().fileno()

    def step(self, now_ns: int) -> int:
        """Publish and answer what is due, and return the next time of publishing, CLOCK_MONOTONIC ns."""
        waiting = self._writer.answer_requests()
        if waiting or now_ns >= self._due_ns:
            self._publish(clock_ns())  # later than the requests
            self._due_ns = now_ns + NS_PER_S // _RATE_HZ
        for request in waiting:
            request.reply(position=self._writer.position)
        return self._due_ns

    def press(
        self, at_m: object, force_n: object = 3.0, radius_m: object = 0.006, seconds: object = 1.0
    ) -> dict[str, object]:
        """Press the emulated skin at a place for a while.

        Raises:
            ValueError: the numbers make no sense, or no part of the skin would feel it.
        """
        pressing = Pressing.of(at_m, force_n, radius_m, seconds)
        return {self._bus_name: self._hardware.press(pressing, clock_ns())}

    def close(self) -> None:
        self._writer.close()

    def _publish(self, now_ns: int) -> None:
        found = self._hardware.pressing(now_ns)[:_MOST]
        columns = self._writer.begin(from_last=True)
        columns["count"][0] = len(found)
        for row, (point_m, force_n) in enumerate(found):
            columns["point_m"][row], columns["force_n"][row] = point_m, force_n
        self._writer.commit(now_ns)
