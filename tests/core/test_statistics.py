"""What writers and readers tell of themselves, for everybody to see."""

from __future__ import annotations

import gc
import threading
import time
from functools import partial

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.memory import ring
from skinware.memory.announcement import living_readers
from skinware.memory.ring import slot_headers_of
from skinware.memory.statistics import BUCKETS, Histogram, Spread, bucket_of
from skinware.realtime import now_ns
from skinware_drivers.testing.waiting import wait_until
from tests.core.services import publish
from tests.core.workers import kill, running

SMALL = {"values": ("<i8", 4)}
MS = 1_000_000


def test_buckets_double() -> None:
    assert [bucket_of(value) for value in (-5, 0, 1, 2, 3, 4, 1023, 1024)] == [0, 0, 1, 2, 2, 3, 10, 11]
    assert bucket_of(1 << 60) == BUCKETS - 1


def test_a_histogram_gives_bounds() -> None:
    histogram = Histogram()
    assert histogram.quantile_ns(0.5) is None
    for value in [10] * 90 + [1000] * 10:
        histogram.add(value)
    assert histogram.total == 100
    assert histogram.quantile_ns(0.5) == histogram.quantile_ns(0.9) == 15
    assert histogram.quantile_ns(0.91) == histogram.quantile_ns(1.0) == 1023


def test_a_spread_has_extremes_and_a_mean() -> None:
    spread = Spread()
    assert spread.mean_ns == 0.0
    for value in (5, 3, 10):
        spread.add(value)
    assert (spread.count, spread.best_ns, spread.worst_ns, spread.mean_ns) == (3, 3, 10, 6.0)


def test_a_writer_tells_how_long_it_takes_and_how_old_its_data_is() -> None:
    old_ns = now_ns() // 2  # half as old as this machine's uptime
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        assert reader.writer_statistics.wall == Spread()
        for pause_s, age_ns in ((0.0, 0), (0.02, old_ns), (0.0, old_ns)):
            writer.begin()
            time.sleep(pause_s)
            writer.commit(now_ns() - age_ns)
        told = reader.writer_statistics
        assert told.published == told.wall.count == told.cpu.count == told.age.total == 3
        assert told.wall.worst_ns >= 20 * MS > told.wall.best_ns > 0
        assert told.wall.total_ns >= told.wall.best_ns + told.wall.worst_ns
        assert told.cpu.worst_ns < told.wall.worst_ns  # it slept
        assert sum(told.age.counts[bucket_of(old_ns) :]) == 2


def test_a_periodic_writer_tells_how_late_its_periods_begin() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        for count, _ in enumerate(writer.periodic(100)):
            if count == 3:
                time.sleep(0.1)  # misses about nine periods
            if count == 6:
                break
        told = reader.writer_statistics
        assert told.lateness.total == 7
        assert told.missed_periods == writer.missed_periods >= 5


def test_thousands_of_dead_readers_hide_no_living_one(namespace: Namespace) -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        reader.read()
        for number in range(3000):
            (namespace.readers_path / f"a.1.{number:08x}").touch()
        assert [seen.service for seen in living_readers(namespace)] == ["x"]
        assert len(list(namespace.reader_files())) == 1


def test_readers_that_are_dropped_leave_nothing(namespace: Namespace) -> None:
    with ServiceWriter("x", SMALL) as writer:
        publish(writer, 1)
        for _ in range(20):
            ServiceReader[Sample]("x").read()
        gc.collect()
        assert list(namespace.reader_files()) == []


def test_a_reader_tells_what_its_loop_does(namespace: Namespace) -> None:
    stop = threading.Event()

    def publish() -> None:
        with ServiceWriter("x", SMALL) as writer:
            while not stop.is_set():
                writer.begin()
                writer.commit(now_ns())
                time.sleep(0.002)

    thread = threading.Thread(target=publish)
    thread.start()
    with ServiceReader[Sample]("x", timeout_s=60.0) as reader:
        for count, frame in enumerate(reader):
            if count == 2:
                time.sleep(0.03)
                wait_until(partial(_lags, reader, frame))
            if count == 20:
                break
        told = reader.statistics
        assert (told.frames, told.kind) == (21, "asap")
        assert told.missed > 0
        assert told.age.total == told.wall.count == 20  # the last one is still being looked at
        assert told.wall.worst_ns >= 30 * MS > told.wall.best_ns
        assert told.cpu.count >= 19
        for count, _ in enumerate(reader.samples(200)):
            if count == 5:
                break
        assert told.kind == "periodic 200 Hz"
        assert told.lateness.total == 6
        # everybody sees it, as it was a quarter of a second ago at the latest
        (seen,) = living_readers(namespace)
        assert (seen.service, seen.program) == ("x", told.program)
        wait_until(lambda: _seen(namespace, reader) >= 27)
        (seen,) = living_readers(namespace)
        assert seen.age.total == sum(seen.age.counts) > 0
        assert seen.missed > 0
    stop.set()
    thread.join()


def _lags(reader: ServiceReader[Sample], frame: Sample) -> bool:
    """Whether the next frame will be lost."""
    generation, sequence = reader.newest_position or frame.position
    return generation == frame.generation and sequence >= frame.sequence + 2


def _seen(namespace: Namespace, reader: ServiceReader[Sample]) -> int:
    reader.read()
    return next(record.frames for record in living_readers(namespace))


def _read_for_ever() -> None:
    with ServiceReader[Sample]("x", timeout_s=30.0) as reader:
        for _ in reader.samples(50):
            pass


@pytest.mark.usefixtures("process_server")
def test_a_killed_reader_vanishes_by_itself(namespace: Namespace) -> None:
    with ServiceWriter("x", SMALL) as writer:
        writer.begin()
        writer.commit(now_ns())
        with running(_read_for_ever) as process:
            wait_until(lambda: [r.pid for r in living_readers(namespace)] == [process.pid])
            kill(process)
            assert list(living_readers(namespace)) == []
    with ServiceWriter("x", SMALL):  # sweeps its file away
        assert list(namespace.reader_files()) == []


def test_overruns_are_counted() -> None:
    from skinware.errors import Overrun

    with ServiceWriter("x", SMALL, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        writer.begin()
        writer.commit(now_ns())
        reader.read()
        slot_headers_of(writer._ring.segment)[1][0] = 0  # as if the writer had come past each time
        with pytest.raises(Overrun, match="64 times in a row"):
            reader.read()
        assert reader.statistics.overruns == 1


@pytest.mark.parametrize(
    ("published_ms", "acquired_ms", "rate_hz"),
    [
        (20, 20, 50.0),
        (1, 1, 1000.0),  # it is that fast
        (0.05, 20, 50.0),  # what has waited is published at once
        (0.05, 0, 20_000.0),  # nobody tells when the data came
        (1, 1.5, 1000.0),
        (100, 20, 10.0),  # slower than its data
    ],
)
def test_a_rate_is_that_of_the_data_where_it_was_held_up(
    published_ms: float, acquired_ms: float, rate_hz: float
) -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        for number in range(20):
            writer.begin()
            sequence = writer.commit(round((5 + number * acquired_ms) * MS))
            words = slot_headers_of(writer._ring.segment)[sequence % writer._ring.segment.layout.slot_count]
            words[ring.PUBLISHED] = round((100 + number * published_ms) * MS)
        assert reader.rate_hz() == pytest.approx(rate_hz)


@pytest.mark.thorough
def test_a_rate_after_a_pause_of_the_device() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        for number in range(20):
            writer.begin()
            writer.commit(round((5 + number * 20 + 10_000 * (number > 16)) * MS))
        assert reader.rate_hz() == pytest.approx(50.0)
