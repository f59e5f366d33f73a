"""Keep the snapshots of a driver that runs in the time of a test clock."""

from __future__ import annotations

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ServiceTimeout, StructureChanged
from skinware_drivers.running.runner import Runner
from skinware_drivers.virtual.hand_clock import HandClock


class SnapshotLog:
    """Read every snapshot that a driver publishes, in order, as a user's program does.

    Attributes:
        keep: keep all snapshots; False: only the newest.
    """

    def __init__(self, clock: HandClock) -> None:
        self.frames: list[DriverSnapshot] = []
        self.times_ns: list[int] = []
        self.keep = True
        self.count: int = 0
        self.reader: DriverReader | None = None
        self._clock = clock

    def look(self, runner: Runner) -> None:
        if self.reader is None:
            if runner.builder.writer is None or runner.builder.writer.closed:
                return
            self.reader = DriverReader(runner.identity.name, namespace=runner.identity.namespace)
        last = self.frames[-1].position if self.frames else None
        while self.reader.refresh() not in (None, last):
            try:
                frame = next(self.reader.in_order(timeout_s=0))
            except ServiceTimeout:
                return
            except StructureChanged:
                self.reader.reattach()
                continue
            last = frame.position
            if not self.keep:
                self.frames.clear()
                self.times_ns.clear()
            self.count += 1
            self.frames.append(frame)
            self.times_ns.append(self._clock.now_ns)

    def close(self) -> None:
        if self.reader is not None:
            self.reader.close()
