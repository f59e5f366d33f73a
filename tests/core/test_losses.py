"""What a reader has lost is counted exactly, whatever became of the writer in between."""

from __future__ import annotations

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import Overrun, StructureChanged
from skinware.service._reader import Tap
from tests.core.services import kill, publish
from tests.core.workers import seeded

COLUMNS = {"values": ("<u8", 4)}


def test_generations_that_came_and_went_between_two_reads_are_counted() -> None:
    with ServiceWriter("x", COLUMNS) as writer:
        for _ in range(10):
            publish(writer, 0)
        reader = ServiceReader[Sample]("x")
        reader.read()
    for count in (100, 5):
        with ServiceWriter("x", COLUMNS) as writer:
            for _ in range(count):
                publish(writer, 0)
            if count == 5:
                assert reader.read().sequence == 5
    assert reader.missed == 104
    reader.close()


def test_losses_are_exact_over_any_ends_and_restarts(request: pytest.FixtureRequest) -> None:
    """Each frame carries its number among all that were ever published; the reader's own count must agree."""
    dice = seeded(request)
    published = 0
    writer = ServiceWriter("x", COLUMNS)
    publish(writer, published := published + 1)
    with ServiceReader[Sample]("x") as reader:
        taken, first = 1, int(reader.read().column("values")[0])
        for _ in range(300):
            match dice.randrange(6):
                case 0:
                    writer.close()
                    writer = ServiceWriter("x", COLUMNS)
                case 1:
                    kill(writer)
                    writer = ServiceWriter("x", COLUMNS)
                case 2:
                    writer.restructure(COLUMNS)
                case 3:
                    writer.namespace.ring_path("x").unlink()
                    writer._next_file_check_ns = 0
                    writer.keep_files()
                case _:
                    for _ in range(dice.randrange(1, 20)):
                        publish(writer, published := published + 1)
            if dice.random() < 0.5 and reader.refresh() not in (None, reader._last):
                newest = int(reader.read().column("values")[0])
                taken += 1
                assert reader.missed == newest - first + 1 - taken
        writer.close()
    assert taken > 20


def test_frames_of_another_structure_are_counted_too() -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        frame = reader.read()
        for n in (3, 7):
            writer.restructure({"values": ("<u8", n)})
            for _ in range(n):
                publish(writer, n)
        with pytest.raises(StructureChanged):
            reader.read(newer_than=frame)
        reader.reattach()
        assert reader.read().sequence == 7
        assert reader.missed == 3 + 6


def test_the_count_begins_again_when_the_namespace_was_removed(namespace: Namespace) -> None:
    with ServiceWriter("x", COLUMNS) as writer:
        for _ in range(10):
            publish(writer, 0)
        reader = ServiceReader[Sample]("x")
        reader.read()
    namespace.lock_path("x").unlink()
    with ServiceWriter("x", COLUMNS) as writer:
        for _ in range(3):
            publish(writer, 0)
        reader.read()
    assert reader.missed == 2
    reader.close()


def overwritten_while_viewed(reader: ServiceReader[Sample], writer: ServiceWriter) -> None:
    with reader.view() as frame:
        for _ in range(3):
            publish(writer, 2)
        assert not frame.valid


@pytest.mark.parametrize(("with_first", "first"), [(True, 1), (False, 3)])
def test_samples_in_order_begin_with_the_first_or_the_newest(with_first: bool, first: int) -> None:
    with ServiceWriter("x", COLUMNS) as writer, Tap[Sample]("x") as reader:
        for _ in range(3):
            publish(writer, 0)
        reader.begin_in_order(with_first=with_first)
        taken = reader.next_in_order()
        assert taken is not None
        assert (taken.sequence, reader.missed) == (first, 0)


def test_the_sample_nearest_to_a_time_is_read_first_and_the_newest_is_still_to_come() -> None:
    with ServiceWriter("x", COLUMNS) as writer, Tap[Sample]("x") as reader:
        for number in range(3):
            writer.begin()
            writer.commit(1000 + 100 * number)
        assert reader.nearest(1140).acquired_ns == 1100
        assert reader.nearest(0).acquired_ns == 1000
        assert reader.read().acquired_ns == 1200
        assert reader.nearest(1000).acquired_ns == 1000
        assert (reader.last_taken, reader.missed) == ((writer.generation, 3), 0)


def test_a_view_counts_also_where_its_sample_was_read_before() -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        reader.read()
        with reader.view():
            pass
        assert (reader.statistics.frames, reader.missed) == (2, 0)


def test_statistics_have_what_was_read_so_far() -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:
        for number in range(1, 6):
            publish(writer, 0)
            reader.read()
            assert reader.statistics.frames == number


def test_a_view_that_became_invalid_was_not_taken() -> None:
    with ServiceWriter("x", COLUMNS, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        with pytest.raises(Overrun):
            overwritten_while_viewed(reader, writer)
        assert (reader.statistics.frames, reader.missed) == (0, 0)
        with reader.view() as frame:
            assert frame.sequence == 4
        assert (reader.statistics.frames, reader.missed) == (1, 0)
        publish(writer, 3)
        with pytest.raises(Overrun):
            overwritten_while_viewed(reader, writer)
        with reader.view() as frame:
            assert frame.sequence == 8
        assert (reader.statistics.frames, reader.missed) == (2, 3)
        with reader.view():
            publish(writer, 5)
            reader.read()  # counted before the older one's view ends
        assert (reader.statistics.frames, reader.missed) == (3, 3)


def test_a_program_that_was_held_up_catches_up_and_one_that_is_too_slow_gets_the_newest() -> None:
    with ServiceWriter("x", COLUMNS, slots=64) as writer, ServiceReader[Sample]("x") as reader:

        def next_after(count: int) -> int:
            for _ in range(count):
                publish(writer, writer.sequence + 1)
            return reader.read_next().sequence

        assert [next_after(count) for count in (1, 19, *[0] * 18)] == [*range(1, 21)]
        assert [next_after(2) for _ in range(4)] == [21, 22, 26, 28]
        assert (reader.missed, reader.is_too_slow) == (4, True)
