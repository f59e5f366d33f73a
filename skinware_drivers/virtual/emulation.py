"""Carry the frames of emulated hardware over a bus in real time, and let programs press it."""

from __future__ import annotations

import contextlib
import select
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

import msgspec
import numpy as np

from skinware.errors import BusNotAvailable, BusSendError
from skinware.memory.namespace import Namespace
from skinware.memory.schema import Column
from skinware.realtime import NS_PER_S
from skinware.service import ServiceWriter
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.virtual.hardware import (
    EmulatedHardware,
    PlacedHardware,
    Pressing,
    WireFrame,
    due_frames,
    put_away,
)

_STATUS_NS = 1_000_000_000
_RETRY_NS = 2_000_000
"""Pause before a frame that a full queue refused is sent again."""
_GIVE_UP_NS = 500_000_000
"""Age at which a refused frame is dropped: newer ones are worth more."""
_FIRST_BACKOFF_NS, _LONGEST_BACKOFF_NS = 100_000_000, 2_000_000_000
"""Pauses between attempts to open a bus that went down."""


Report = Callable[..., None]
"""Receives the events of an emulation: ready, status, bus_down, bus_up, stopped; with facts as keywords."""


class Stop(Protocol):
    stopped: bool

    def fileno(self) -> int:
        """Return a descriptor that is readable when ``stopped`` may have changed."""


class Emulation:
    """Emulated hardware on a bus.

    Frames go out at the time they are due; those due together go out together. No frame is dropped silently: a frame
    that a full queue refuses is sent again until half a second after it was due, and then counted as a send failure.
    Frames of a time when the bus was down or this process stopped are counted as ``unheard``.

    Args:
        bus: not opened yet.
        hardware: not powered up yet.
        clock: CLOCK_MONOTONIC ns.
        poll: waits until a descriptor is readable, or for a time: ``(descriptors, timeout_s)``.
    """

    def __init__(
        self,
        bus: Bus,
        hardware: EmulatedHardware,
        report: Report,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        poll: Callable[[list[int], float | None], None] | None = None,
        pressing: PressingService | None = None,
    ) -> None:
        self._bus, self._hardware, self._report = bus, hardware, report
        self._clock, self._poll = clock, poll or wait_readable
        self._pressing = pressing
        self._outbox: deque[WireFrame] = deque()
        self._batch = FrameBatch(256, bus.payload_size)
        self._open = False
        self._backoff_ns = _FIRST_BACKOFF_NS
        self.send_failures: int = 0
        """Number of dropped frames."""
        self._latest_ns = 0

    def run(
        self,
        stop: Stop,
        *,
        bus_name: str,
        driver: str,
        options: msgspec.Struct,
        duration_s: float | None = None,
    ) -> None:
        self._bus.open()
        self._open = True
        start_ns = self._clock()
        self._hardware.skip(start_ns)
        facts = {"driver": driver, "bus": bus_name, "note": self._bus.note, "options": msgspec.to_builtins(options)}
        self._report("ready", **facts)
        end_ns = None if duration_s is None else start_ns + round(duration_s * 1e9)
        status_ns = start_ns + _STATUS_NS
        try:
            while not stop.stopped:
                now_ns = self._clock()
                if end_ns is not None and now_ns >= end_ns:
                    break
                if now_ns >= status_ns:
                    self._report("status", **self._totals())
                    status_ns += _STATUS_NS * (1 + (now_ns - status_ns) // _STATUS_NS)
                next_ns = self._step(now_ns)
                pressing_ns = None if self._pressing is None else self._pressing.step(now_ns)
                moments = [moment for moment in (next_ns, pressing_ns, end_ns, status_ns) if moment is not None]
                descriptors = [stop.fileno(), self._bus.fileno()] if self._open else [stop.fileno()]
                if self._pressing is not None:
                    descriptors.append(self._pressing.fileno())
                self._poll(descriptors, max(0, min(moments) - self._clock()) / 1e9)
        finally:
            self._bus.close()
            put_away(self._hardware)
        self._report("stopped", **self._totals())

    def _step(self, now_ns: int) -> int | None:
        if not self._open:
            try:
                self._bus.open()
            except BusNotAvailable:
                self._backoff_ns = min(2 * self._backoff_ns, _LONGEST_BACKOFF_NS)
                return now_ns + self._backoff_ns
            self._open = True
            self._hardware.skip(now_ns)
            self._report("bus_up")
            return now_ns
        try:
            while self._bus.receive(self._batch, 0):
                for row in self._batch.wire[self._batch.start : self._batch.stop]:
                    payload = row["payload"][: row["length"]].tobytes()
                    self._hardware.receive(int(row["identifier"]), payload, now_ns)
                self._batch.clear()
            return self._send(now_ns)
        except BusNotAvailable as error:
            self._open = False
            self._bus.close()
            self.send_failures += len(self._outbox)
            self._outbox.clear()
            self._backoff_ns = _FIRST_BACKOFF_NS
            self._report("bus_down", reason=str(error))
            return now_ns + self._backoff_ns

    def _send(self, now_ns: int) -> int | None:
        self._outbox += due_frames(self._hardware, now_ns)[0]
        if self._outbox:
            self._latest_ns = max(self._latest_ns, self._clock() - self._outbox[0].time_ns)
        while self._outbox:
            try:
                self._bus.send(self._outbox[0].identifier, self._outbox[0].payload)
            except BusSendError:
                while self._outbox and now_ns - self._outbox[0].time_ns >= _GIVE_UP_NS:
                    self._outbox.popleft()
                    self.send_failures += 1
                return now_ns + _RETRY_NS
            self._outbox.popleft()
        return self._hardware.next_due_ns()

    def _totals(self) -> dict[str, int]:
        """Return the counts, and how late a frame was at most since the last call, in whole ms."""
        late_ms, self._latest_ns = round(self._latest_ns / 1e6), 0
        return {**self._hardware.totals(), "send_failures": self.send_failures, "late_ms": late_ms}


def wait_readable(descriptors: list[int], timeout_s: float | None) -> None:
    """Wait to the microsecond: ``poll`` would round up to a millisecond."""
    with contextlib.suppress(InterruptedError):
        select.select(descriptors, [], [], timeout_s)


_RATE_HZ = 50
_MOST = 16


class PressingService:
    """Publish the presses on the skin at 50 Hz, and take new ones by the operation ``press``.

    Args:
        bus_name: of the emulation, for the replies.
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
            time_ns = time.monotonic_ns()  # later than the requests
            found = self._hardware.pressing(time_ns)[:_MOST]
            columns = self._writer.begin(from_last=True)
            columns["count"][0] = len(found)
            for row, (point_m, force_n) in enumerate(found):
                columns["point_m"][row], columns["force_n"][row] = point_m, force_n
            self._writer.commit(time_ns)
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
        return {self._bus_name: self._hardware.press(pressing, time.monotonic_ns())}

    def close(self) -> None:
        self._writer.close()
