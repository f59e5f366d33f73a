"""The parts of a ring on which no frame shows: figures to the nanosecond, takes of several rings, and sleeps."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable
from typing import Self

import pytest

from skinware import Sample, ServiceReader, ServiceWriter
from skinware.memory import file_layout, ring_reader
from skinware.memory.ring import slot_headers_of
from skinware.memory.ring_reader import NEWER, NEWEST, NEXT, RingReader, Take
from skinware.memory.ring_writer import RingWriter
from skinware.memory.statistics import BUCKETS, bucket_of
from skinware.realtime import NS_PER_S, now_ns
from tests.core.services import SMALL, at_0, publish

MS = 1_000_000
HOUR_NS = 3600 * NS_PER_S


# -- the writer ----------------------------------------------------------------------------------------------------


def test_the_age_of_every_sample_is_counted_in_its_bucket() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        expected = [0] * BUCKETS
        for age_ns in (-NS_PER_S // 10, 0, 1000, 100_000, 10 * MS, NS_PER_S, 3 * NS_PER_S, 10 * NS_PER_S):
            writer.begin()
            writer.commit(now_ns() - age_ns)
            sample = reader.read()
            expected[bucket_of(sample.published_ns - sample.acquired_ns)] += 1
        assert reader.writer_statistics.age.counts == expected
        assert expected[0] == 1
        assert expected[-1] >= 2


def test_a_stamp_of_more_than_a_fifth_of_a_second_ahead_is_counted() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        expected = 0
        for ahead_ms in (-300, 0, 150, 199, 201, 250, 10_000):
            writer.begin()
            writer.commit(now_ns() + ahead_ms * MS)
            sample = reader.read()
            expected += sample.acquired_ns - sample.published_ns > 200 * MS
            assert reader.writer_statistics.ahead == expected
        assert expected >= 1


def test_the_extremes_and_the_sum_of_what_a_writer_takes() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        state = writer._ring._state
        for hours in (3, 1, 4, 2):
            writer.begin()
            state.begun_ns -= hours * HOUR_NS
            state.cpu_ns -= hours * HOUR_NS
            writer.commit(1)
        told = reader.writer_statistics
        for spread in (told.wall, told.cpu):
            assert [spread.count, *(ns // HOUR_NS for ns in (spread.best_ns, spread.worst_ns, spread.total_ns))] == [
                4,
                1,
                4,
                10,
            ]


def test_what_another_thread_took_is_not_counted() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        writer.begin()
        writer._ring._state.cpu_ns += HOUR_NS  # of another thread
        writer.commit(1)
        told = reader.writer_statistics.cpu
        assert (told.count, told.best_ns, told.worst_ns, told.total_ns) == (1, 0, 0, 0)


def test_a_slot_holds_an_old_sample_until_it_is_filled() -> None:
    with ServiceWriter("x", SMALL, slots=4) as writer, ServiceReader[Sample]("x") as reader:
        assert set(writer.begin(from_last=True)["values"].tolist()) == {0}  # there is no last one
        for value in range(1, 6):
            publish(writer, value)
        assert set(writer.begin()["values"].tolist()) == {2}
        assert set(writer.begin(from_last=True)["values"].tolist()) == {5}
        sample = reader.read()
        publish(writer, 6)
        assert set(writer.begin(contents=sample.slot)["values"].tolist()) == {5}
        assert writer.commit(now_ns()) == 7
        sample = reader.read()
        assert (sample.sequence, set(sample.column("values").tolist())) == (7, {5})


def test_the_contents_of_another_service_are_taken_over_before_anything_was_published() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader, ServiceWriter("y", SMALL) as other:
        publish(writer, 7)
        assert set(other.begin(contents=reader.read().slot)["values"].tolist()) == {7}


def test_the_latest_time_and_all_flags_are_published_as_they_are() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        for acquired_ns, flags in (((1 << 63) - 1, 0), (0, (1 << 64) - 1)):
            writer.begin()
            writer.commit(acquired_ns, flags)
            sample = reader.read()
            assert (sample.acquired_ns, sample.flags) == (acquired_ns, flags)


def test_every_change_of_the_state_changes_the_wake_word() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        for change in (writer.pause, writer.resume, writer.close):
            before = reader._ring.wake_count
            change()
            assert reader._ring.wake_count != before


def test_a_writer_whose_descriptor_is_0_writes() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        with at_0(writer._ring.segment.descriptor):
            publish(writer, 2)
            assert reader.alive
            assert reader.read().position == writer.position
            assert writer.sequence == 2


# -- what one look takes of several rings --------------------------------------------------------------------------


class Two:
    """Two services that have published one sample each, and a take of both that has taken these."""

    def __init__(self) -> None:
        self.writers = [ServiceWriter(name, SMALL, slots=4) for name in "ab"]
        for writer, value in zip(self.writers, (10, 20), strict=True):
            publish(writer, value)
        self.readers = [ServiceReader[Sample](name) for name in "ab"]
        self.take = Take([reader._ring for reader in self.readers], is_loop=False)
        self.resume()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for reader in self.readers:
            reader.close()
        for writer in self.writers:
            writer.close()

    def resume(self) -> None:
        """The newest of both has been taken."""
        for reader in self.readers:
            reader._ring.resume_turns(reader._ring.latest, now_ns() + HOUR_NS, None)

    def next(self, wanted: int, timeout_ns: int = 0) -> list[tuple[str, int, int]] | None:
        """Sequence and value of both samples; None if Python has something to do."""
        samples = self.take.next(wanted, timeout_ns)
        if samples is None:
            return None
        assert not any(sample.stale for sample in samples)
        return [
            (name, sample.sequence, int(sample.column("values")[511]))
            for name, sample in zip("ab", samples, strict=bool(samples))
        ]


def test_news_of_any_ring_are_taken_with_the_newest_of_all() -> None:
    with Two() as two:
        assert two.next(NEWER) == []
        assert two.next(NEWEST) == two.next(NEWEST) == [("a", 1, 10), ("b", 1, 20)]
        publish(two.writers[1], 21)
        assert two.next(NEWER) == [("a", 1, 10), ("b", 2, 21)]
        assert two.next(NEWER) == []
        publish(two.writers[0], 11)
        publish(two.writers[0], 12)
        assert two.next(NEWER) == [("a", 3, 12), ("b", 2, 21)]
        a, b = (reader._ring.settle_turns() for reader in two.readers)
        assert a is not None
        assert b is not None
        assert (a.frames, a.missed, a.last, len(a.over)) == (4, 1, 3, 4)
        assert (b.frames, b.missed, b.last, len(b.over)) == (4, 0, 2, 4)
        assert all(turn.taken_ns == turn.ended_ns > 0 == turn.cpu_ns for turn in a.over + b.over)


def test_the_next_of_every_ring_is_taken_where_each_has_one() -> None:
    with Two() as two:
        for value in (1, 2):
            for writer in two.writers:
                publish(writer, value)
        assert two.next(NEXT) == [("a", 2, 1), ("b", 2, 1)]
        assert two.next(NEXT) == [("a", 3, 2), ("b", 3, 2)]
        publish(two.writers[1], 3)
        assert two.next(NEXT) is None  # and nothing was taken
        publish(two.writers[0], 3)
        assert two.next(NEXT) == [("a", 4, 3), ("b", 4, 3)]


def nothing_was_taken(ring: RingReader[Sample], _: RingWriter) -> None:
    ring.state_in_c.last = 0


def a_turn_is_not_over(ring: RingReader[Sample], _: RingWriter) -> None:
    ring.state_in_c.taken_ns = 1


def the_newest_is_overwritten_each_time(_: RingReader[Sample], writer: RingWriter) -> None:
    slot_headers_of(writer.segment)[writer.sequence % 4][0] = 0


def the_generation_was_superseded(_: RingReader[Sample], writer: RingWriter) -> None:
    writer.set_state(file_layout.STATE_SUPERSEDED)


def the_service_was_closed(_: RingReader[Sample], writer: RingWriter) -> None:
    writer.set_state(file_layout.STATE_CLOSED)


def the_writer_was_killed(_: RingReader[Sample], writer: RingWriter) -> None:
    writer.segment.descriptor.close()  # with which its lock goes


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize(
    "happen",
    [
        nothing_was_taken,
        a_turn_is_not_over,
        the_newest_is_overwritten_each_time,
        the_generation_was_superseded,
        the_service_was_closed,
        the_writer_was_killed,
    ],
)
def test_whatever_else_happens_in_any_ring_is_left_to_python(
    which: int, happen: Callable[[RingReader[Sample], RingWriter], None]
) -> None:
    with Two() as two:
        assert two.next(NEWEST) is not None
        happen(two.readers[which]._ring, two.writers[which]._ring)
        two.take.state_in_c.asked_ns = 0  # a while ago
        assert two.next(NEWEST) is None
        for reader in two.readers:
            turns = reader._ring.settle_turns()
            assert turns is not None
            assert turns.frames == 1


def test_a_pause_of_a_writer_is_left_to_nobody() -> None:
    with Two() as two:
        two.writers[1]._ring.set_state(file_layout.STATE_PAUSED)
        assert two.next(NEWEST) == [("a", 1, 10), ("b", 1, 20)]


def test_a_wait_for_several_rings_ends_without_news() -> None:
    with Two() as two:
        for timeout_ns in (1, MS, 10 * MS):
            assert two.next(NEWER, timeout_ns) == []


def test_a_wait_that_the_kernel_refuses_is_left_to_python() -> None:
    with Two() as two:
        two.take.state_in_c.count = 0  # of which it refuses to take care
        assert two.next(NEWER, MS) is None


def test_every_wake_of_any_ring_ends_a_wait_and_none_is_left_to_python() -> None:
    """Also one that comes before the sleep has begun. Another process wakes, which needs no interpreter lock."""
    with Two() as two:
        ring = two.readers[1]._ring
        child = os.fork()
        if child == 0:
            while True:
                two.writers[1]._ring.wake()
        try:
            begun, calls = ring.wake_count, 0
            while ring.wake_count - begun < 200_000:
                assert two.next(NEWER, HOUR_NS) == []
                calls += 1
        finally:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        assert calls > 50  # a wait that no wake ends takes 50 ms


def test_a_signal_ends_a_sleep_and_leaves_nothing_to_python() -> None:
    before = signal.signal(signal.SIGALRM, lambda *_: None)
    try:
        with Two() as two:
            for _ in range(5):
                signal.setitimer(signal.ITIMER_REAL, 0.005)
                assert two.next(NEWER, HOUR_NS) == []
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def sleeps() -> int:
    """How often this thread has slept so far."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw


@pytest.mark.parametrize("is_loop", [False, True])
def test_a_wait_sleeps_and_a_look_does_not(is_loop: bool) -> None:
    with Two() as two:
        take = Take([two.readers[0]._ring], is_loop=True) if is_loop else two.take
        take.state_in_c.until_ns = now_ns() + HOUR_NS
        begun = sleeps()
        assert take.next(NEWER, 5 * MS) == ()
        assert sleeps() > begun
        piece = take.free()
        take.state_in_c.timeout_ns = HOUR_NS
        begun = sleeps()
        assert ring_reader._take_now(take._state_at, piece.in_c) == 0
        publish(two.writers[0], 3)
        assert ring_reader._take_next(take._state_at, piece.in_c) == 1
        assert sleeps() == begun
