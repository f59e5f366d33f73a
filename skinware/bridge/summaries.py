"""How a robot is, in one small message a second."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from skinware.bridge.giving import Stream
from skinware.bridge.link import Sender
from skinware.bridge.messages import DriverSummary, State, Summary, host_name
from skinware.driver_service import counters_of
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusState, PatchState, is_fresh
from skinware.structure import Structure
from skinware.transfer.frames import RecordedDriverFrame
from skinware.transfer.generation import Generation

_MOST_NAMES = 4
"""Names of silent patches in a message; all are counted."""


@dataclass(frozen=True)
class Summarised:
    """A driver that is told of.

    Attributes:
        name: of it.
        state: ``live``, ``paused``, ``closed`` or ``dead``.
        generation: the present one.
        stream: of its frames.
    """

    name: str
    state: State
    generation: Generation
    stream: Stream


class Summaries:
    """Sends how a robot is, for as long as anybody listens.

    Args:
        namespace: that is served.
        send: sends it.
    """

    def __init__(self, namespace: str, send: Sender) -> None:
        self._namespace, self._host, self._send_bytes = namespace, host_name(), send
        self._frames: dict[str, int] = {}
        self._counted_ns = now_ns()
        self._rates_hz: dict[str, float] = {}

    @property
    def is_wanted(self) -> bool:
        return self._send_bytes.is_heard

    def count(self, frames: dict[str, int]) -> None:
        """How many frames of each service there were so far, about once a second."""
        time_ns = now_ns()
        seconds = (time_ns - self._counted_ns) / NS_PER_S
        new = {name: count - self._frames.get(name, 0) for name, count in frames.items()}
        self._rates_hz = {name: round(count / seconds, 1) for name, count in new.items()}
        self._frames, self._counted_ns = frames, time_ns

    def send(self, drivers: Iterable[Summarised], services: int, lost: int) -> None:
        """Send it.

        Args:
            drivers: all there are.
            services: how many others there are.
            lost: frames that the bridge could not take from their rings.
        """
        told = {driver.name: self._of(driver) for driver in drivers}
        self._send_bytes(msgspec.json.encode(Summary(self._namespace, told, services, lost, self._host)))

    def _of(self, driver: Summarised) -> DriverSummary:
        structure = driver.generation.context
        assert isinstance(structure, Structure)  # noqa: S101 - it is a driver
        newest = driver.stream.newest
        is_live = driver.state == "live"
        age_ms, lost, fresh, problems = None, 0, 0, int(not is_live)
        silent: list[str] = []
        if newest is not None and newest.generation == driver.generation.generation:
            frame = RecordedDriverFrame(driver.generation, newest.slot)
            time_ns = now_ns()
            age_ms = round((time_ns - frame.acquired_ns) / 1e6, 3)
            fresh = _fresh(frame, structure, time_ns, is_live)
            names, counts = counters_of(frame, driver.generation.static(), "bus", len(structure.buses))
            lost = int(counts[:, names.index("lost")].sum()) if "lost" in names else 0
            if is_live:
                rows = np.flatnonzero(frame.patch_state != PatchState.LIVE).tolist()
                silent = [structure.patch_names[row] for row in rows]
                problems += len(silent) + int(np.count_nonzero(frame.bus_state != BusState.LIVE))
        return DriverSummary(
            driver.state,
            self._rates_hz.get(driver.name, 0.0),
            age_ms,
            lost,
            structure.n_sensors,
            fresh,
            structure.n_patches,
            tuple(silent[:_MOST_NAMES]),
            len(silent),
            problems,
        )


def _fresh(frame: RecordedDriverFrame, structure: Structure, time_ns: int, is_live: bool) -> int:
    """How many sensors can be trusted now."""
    fresh = is_fresh(
        frame.status,
        frame.sensor_time_ns,
        at_ns=time_ns,
        max_age_ns=structure.age_limits_ns(frame.period_ns),
        alive=is_live,
    )
    return int(np.count_nonzero(fresh))
