"""What the short way from a wake-up to the frame in hand must still keep."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.memory import futex
from skinware.memory.announcement import living_readers
from skinware_drivers.testing.waiting import wait_until

COLUMNS = {"values": ("<u2", 8), "times": ("<i8", 3)}


def publish(writer: ServiceWriter, value: int, flags: int = 0) -> None:
    columns = writer.begin()
    columns["values"][:] = value
    columns["times"][:] = value, value + 1, value + 2
    writer.commit(1000 + value, flags)


def test_a_copy_is_the_readers_own_and_a_view_cannot_be_written() -> None:
    with ServiceWriter("x", COLUMNS, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 7, flags=5)
        copy = reader.read()
        with reader.view() as view:
            with pytest.raises(ValueError, match="read-only"):
                view.column("values")[0] = 1
        copy.column("values")[0] = 1
        assert reader.read().column("values").tolist() == [7] * 8
        for value in (8, 9):
            publish(writer, value)
        assert copy.column("values").tolist() == [1, *[7] * 7]
        assert copy.column("times").tolist() == [7, 8, 9]
        assert (copy.sequence, copy.acquired_ns, copy.flags, copy.valid) == (1, 1007, 5, True)
        assert not view.valid


def test_every_slot_is_read_from_its_own_place() -> None:
    with ServiceWriter("x", COLUMNS, slots=5) as writer, ServiceReader[Sample]("x") as reader:
        frames = reader.in_order(timeout_s=5)
        for value in range(1, 12):
            publish(writer, value)
            frame = next(frames)
            assert (frame.sequence, frame.acquired_ns) == (value, 1000 + value)
            assert frame.column("values").tolist() == [value] * 8
            assert frame.column("times").tolist() == [value, value + 1, value + 2]


def test_a_frame_that_was_waited_for_is_not_stale_and_the_next_read_tells_of_a_death() -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        first = reader.read()
        taken: list[Sample] = []
        thread = threading.Thread(target=lambda: taken.append(reader.read(newer_than=first, timeout_s=30)))
        thread.start()
        time.sleep(0.02)  # most likely it sleeps by now; the test holds either way
        publish(writer, 2)
        thread.join()
        assert taken[0].sequence == 2
        assert not taken[0].stale
        writer.close()
        assert reader.read().stale


def test_an_announcement_tells_the_age_of_a_frame(namespace: Namespace) -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:

        def told() -> bool:
            writer.begin()
            writer.commit(time.monotonic_ns() - 2_000_000)
            reader.read()
            (record,) = living_readers(namespace)
            return record.frames > 2 and 2 <= record.age_ms < 1000

        wait_until(told)


def test_a_futex_word_that_cannot_be_is_refused_at_once() -> None:
    with pytest.raises(OSError, match="Invalid argument"):
        futex.Word(np.zeros(8, np.uint8), 1)


def test_a_futex_wait_ends_by_another_value_or_a_wake_up() -> None:
    memory = np.array([5], np.uint32)
    word = futex.Word(memory.view(np.uint8), 0)
    word.wait(4, 30_000_000_000)  # differs: returns at once
    woken = threading.Event()

    def sleep() -> None:
        while memory[0] == 5:
            word.wait(5, 30_000_000_000)
        woken.set()

    thread = threading.Thread(target=sleep)
    thread.start()
    time.sleep(0.02)
    memory[0] = 6
    futex.Word(memory.view(np.uint8), 0).wake_all()
    thread.join(20)
    assert woken.is_set()


@pytest.mark.parametrize("announce", [True, False])
def test_every_turn_is_counted_although_it_is_added_up_later(announce: bool) -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x", announce=announce) as reader:
        frames = reader.in_order(timeout_s=5)
        for value in range(1, 21):
            publish(writer, value)
            assert next(frames).sequence == value
            assert reader.statistics.frames == value
            assert reader.statistics.age.total == value - 1  # the one in hand is counted when its turn ends
        assert reader.statistics.wall.count == 19
        assert reader.statistics.cpu.count == 18
