"""Publishes a recording again, so that every reader and service works on it as on the drivers that were recorded."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection

from skinware.memory.namespace import Namespace
from skinware.memory.schema import STATIC_NAME
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns
from skinware.recording.frames import RecordedFrame
from skinware.recording.generation import Generation
from skinware.recording.reading import Recording
from skinware.service import ServiceWriter

_TIMES_OF_DRIVERS = ("module_time_ns", "bus_since_ns")
"""Columns with times of CLOCK_MONOTONIC; 0: never, or not known."""
_LATE_NS = 10_000_000


class Replayer:
    """Publishes what was recorded under the same names, with the same tables, and in the same rhythm.

    Times are moved to now: a frame and all times in it by as much as lies between its publication then and now, so that
    ages stay as they were, also at another speed.

    Args:
        recording: what to publish.
        names: of services; None: all.
        namespace: where to publish them.
        speed: 2.0: twice as fast.

    Attributes:
        frames: of each service that were published.
        late: frames that were published more than 10 ms after their time.
        time_s: of the recording, up to which it was published.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        names: Collection[str] | None = None,
        namespace: Namespace | str | None = None,
        speed: float = 1.0,
    ) -> None:
        self._recording, self._names = recording, recording.services if names is None else tuple(names)
        self._namespace = Namespace.of(namespace)
        self._speed = speed
        self._writers: dict[str, ServiceWriter] = {}
        self._generations: dict[str, int] = {}
        self._stopping = False
        self._tell_ns = 0
        self.frames: Counter[str] = Counter()
        self.late: int = 0
        self.time_s: float = 0.0

    def run(self, start_s: float = 0.0, end_s: float | None = None, tell: Callable[[], object] = lambda: None) -> None:
        """Publish it once, until its end or until ``stop``.

        Args:
            start_s: where to begin, s since the recording began.
            end_s: where to end, likewise; default: with the last frame.
            tell: called about once a second.

        Raises:
            NameInUse: a running driver or service has one of the names.
            NamespaceError: the namespace cannot be used, or shared memory is full.
        """
        begin_ns, first_s = now_ns(), None
        for time_s, name, frame in self._recording.moments(self._names, start_s=start_s, end_s=end_s):
            first_s = time_s if first_s is None else first_s
            due_ns = begin_ns + round((time_s - first_s) / self._speed * NS_PER_S)
            if not self._wait(due_ns, tell):
                return
            self.time_s = time_s
            if frame is None:
                self._close(name)
            else:
                self._publish(name, frame)
                self.late += now_ns() - due_ns > _LATE_NS

    @property
    def is_stopped(self) -> bool:
        """Whether ``stop`` was called."""
        return self._stopping

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._stopping = True

    def close(self) -> None:
        """Withdraw what is published. Idempotent."""
        for name in list(self._writers):
            self._close(name)

    def _wait(self, due_ns: int, tell: Callable[[], object]) -> bool:
        """Until a time; False: it is to end."""
        while not self._stopping:
            time_ns = now_ns()
            if time_ns >= self._tell_ns:
                self._tell_ns = time_ns + NS_PER_S
                tell()
            if time_ns >= due_ns:
                return True
            time.sleep(min(due_ns - time_ns, WAIT_SLICE_NS) / NS_PER_S)
        return False

    def _publish(self, name: str, frame: RecordedFrame) -> None:
        generation = self._recording[name].generation(frame.generation)
        writer = self._writer(name, generation)
        shift_ns = now_ns() - frame.published_ns
        for column, into in writer.begin().items():
            into[...] = frame.column(column)
            if generation.is_driver and column in _TIMES_OF_DRIVERS:
                into[into != 0] += shift_ns
        writer.commit(frame.acquired_ns + shift_ns if frame.acquired_ns else 0, frame.flags)
        self.frames[name] += 1

    def _writer(self, name: str, generation: Generation) -> ServiceWriter:
        writer = self._writers.get(name)
        if writer is not None and self._generations[name] == generation.generation:
            return writer
        schema = generation.schema
        static = {table: column for table, column in generation.static().items() if table != STATIC_NAME}
        rate_hz = NS_PER_S / generation.period_ns * self._speed if generation.period_ns else None
        if writer is not None:
            writer.restructure(schema.columns, static, rate_hz=rate_hz)
        else:
            writer = self._writers[name] = ServiceWriter(
                name,
                schema.columns,
                static,
                namespace=self._namespace,
                kind=generation.kind,
                slots=generation.slot_count,
                rate_hz=rate_hz,
                description=schema.description,
            )
        self._generations[name] = generation.generation
        return writer

    def _close(self, name: str) -> None:
        writer = self._writers.pop(name, None)
        if writer is not None:
            writer.close()
