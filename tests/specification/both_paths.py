"""The two data paths side by side, numpy and C: both get the same, and everything that they have is compared.

What differs by nature is left out: when the ring says that a frame was published, and the ring's own statistics. What
they differ in otherwise is a fault of Skinware's, and not of the driver whose frames show it.
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware.memory.namespace import Namespace
from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Layout
from skinware_drivers.polling import Watch
from skinware_drivers.testing.waiting import require
from skinware_drivers.virtual.hand_clock import HandClock, package_on
from tests.specification.one_path import Marking, NativeWay, NumpyWay, Publishing, Way


class Pair:
    """Both paths, on the same clock. Every method does the same with both, and compares them.

    Args:
        clock: what both take for the time; the package has to be on it (:func:`skinware_drivers.virtual.hand_clock.
            package_on`).
        layouts: of each bus.
        tables: the skin.
        periods_s: of each bus.
        publishing: how.
        rows: frames of a batch, at the most.
        watch: makes what looks at updates.
        namespace: where both publish.
        payload_size: of the batch's rows; 0: what the layouts need.

    Attributes:
        frames: published so far.
    """

    def __init__(
        self,
        clock: HandClock,
        layouts: Sequence[Layout | None],
        tables: SkinTables,
        periods_s: Sequence[float],
        publishing: Publishing | None = None,
        *,
        rows: int = 1024,
        watch: Callable[[SkinTables], Watch] = Marking,
        namespace: Namespace | str | None = None,
        payload_size: int = 0,
    ) -> None:
        more = layouts, tables, periods_s, publishing or Publishing(), rows, watch, namespace, payload_size
        self.clock = clock
        self.numpy = NumpyWay("numpy", *more)
        self.native = NativeWay("native", *more)
        self.frames = 0
        self._read_ns = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for way in self._both:
            way.close()

    @property
    def _both(self) -> tuple[Way, Way]:
        return self.numpy, self.native

    def feed(self, frames: Sequence[tuple[int, int, int, bytes]], interrupted: Sequence[int] = ()) -> None:
        """A batch of (bus, time_ns, identifier, payload) each."""

        def take(way: Way) -> None:
            way.empty()
            for frame in frames:
                way.batch.append(*frame)
            way.digest(interrupted)

        self.do(take)

    def feed_rows(self, wire: npt.NDArray[np.void], time_ns: npt.NDArray[np.int64]) -> None:
        def take(way: Way) -> None:
            way.empty()
            rows = slice(way.batch.stop, way.batch.stop + len(wire))
            way.batch.wire[rows], way.batch.time_ns[rows], way.batch.bus[rows] = wire, time_ns, 0
            way.batch.stop = rows.stop
            way.digest(())

        self.do(take)

    def pass_to(self, time_ns: int) -> None:
        """Let time pass; what is due before then is published when it is."""
        while self.deadline_ns < time_ns:
            self.clock.now_ns = max(self.clock.now_ns, self.deadline_ns)
            self.publish_if_due()
        self.clock.now_ns = max(self.clock.now_ns, time_ns)

    def publish_if_due(self, unread_ns: int = 0) -> None:
        """Publish if the time has come, and all that arrived was taken until so long ago."""
        self._read_ns = max(self._read_ns, self.clock.now_ns - unread_ns)
        self.do(lambda way: way.publish_if_due(self._read_ns))

    @property
    def deadline_ns(self) -> int:
        """When something has to be published at the latest, CLOCK_MONOTONIC ns."""
        return self.numpy.publisher.deadline_ns

    def do(self, action: Callable[[Way], object]) -> None:
        before = self.numpy.publisher.writer.sequence
        told: list[list[str]] = []
        for way in self._both:
            with _listening() as lines:
                action(way)
            told.append(sorted(lines))
        require(told[0] == told[1], f"numpy logs {told[0]}, C {told[1]}")
        newest = self.numpy.publisher.writer.sequence
        sequence = self.native.publisher.writer.sequence
        require(sequence == newest, f"numpy has published {newest} frames, C {sequence}")
        for sequence in range(before + 1, newest + 1):
            _compare(self.numpy.frame(sequence), self.native.frame(sequence), f"frame {sequence}, ")
        _compare(self.numpy.arrays(), self.native.arrays())
        self.frames = newest


def _compare(expected: Mapping[str, object], found: Mapping[str, object], where: str = "") -> None:
    wrong = []
    for name, value in expected.items():
        other = found[name]
        if isinstance(value, np.ndarray) and isinstance(other, np.ndarray):
            is_same = value.dtype == other.dtype and value.shape == other.shape and value.tobytes() == other.tobytes()
            if not is_same and value.dtype.kind == "f" and np.array_equal(value, other, equal_nan=True):
                where += "only bits of NaN or signs of 0 differ: "
        else:
            is_same = value == other
        if not is_same:
            wrong.append(f"{where}{name}: numpy has\n{value!r}\nC has\n{other!r}")
    require(not wrong, "\n".join(wrong))


class _Lines(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


@contextmanager
def _listening() -> Iterator[list[str]]:
    log, handler = logging.getLogger("skinware.driver"), _Lines()
    log.addHandler(handler)
    try:
        yield handler.lines
    finally:
        log.removeHandler(handler)


@contextmanager
def hand_clock(begin_ns: int = 0) -> Iterator[HandClock]:
    clock = HandClock()
    clock.now_ns = max(clock.now_ns, begin_ns)
    with package_on(clock):
        yield clock


def require_same(
    layout: Layout, tables: SkinTables, period_s: float, payload_size: int, frames: Sequence[tuple[int, int, bytes]]
) -> None:
    """Fail the test unless both paths make the same of frames that come one by one.

    Args:
        layout: of the only bus.
        tables: the skin.
        period_s: nominal time between two updates of a module.
        payload_size: of the batch's rows.
        frames: (time_ns, identifier, payload) of each.
    """
    namespace = Namespace(f"both-paths-{os.getpid()}-{secrets.token_hex(4)}")
    publishing = Publishing(period_s)
    more: dict[str, Any] = {"rows": 1, "namespace": namespace, "payload_size": payload_size}
    try:
        with hand_clock() as clock, Pair(clock, [layout], tables, [period_s], publishing, **more) as pair:
            for time_ns, identifier, payload in frames:
                pair.feed([(0, time_ns, identifier, payload)])
    finally:
        shutil.rmtree(namespace.path, ignore_errors=True)
