"""What ``commit`` refuses leaves everything as it was; what a device stamps before boot is published all the same."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from skinware import Sample, ServiceReader, ServiceWriter
from skinware.errors import ServiceError
from skinware.realtime import NS_PER_S, now_ns

BAD = [
    pytest.param({"acquired_ns": 1 << 63}, ValueError, id="too wide"),
    pytest.param({"acquired_ns": 1.5}, TypeError, id="not whole"),
    pytest.param({"acquired_ns": None}, TypeError, id="no number"),
    pytest.param({"acquired_ns": 1, "flags": -1}, ValueError, id="negative flags"),
    pytest.param({"acquired_ns": 1, "flags": 1 << 64}, ValueError, id="too many flags"),
    pytest.param({"acquired_ns": -5, "flags": -1}, ValueError, id="before boot, and negative flags"),
]


@contextmanager
def service() -> Iterator[tuple[ServiceWriter, ServiceReader[Sample]]]:
    """Its writer, which has published one frame of ones in a ring of two slots, and a reader."""
    with ServiceWriter("x", {"values": ("<i8", 4)}, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        writer.begin()["values"][:] = 1
        writer.commit(7, flags=3)
        yield writer, reader


@pytest.mark.parametrize(("arguments", "error"), BAD)
def test_a_failed_commit_changes_nothing_and_can_be_made_again(
    arguments: dict[str, int], error: type[Exception]
) -> None:
    with service() as (writer, reader):
        writer.begin()["values"][:] = 2
        before = writer._ring.segment.data.copy()
        with pytest.raises(error):
            writer.commit(**arguments)
        assert np.array_equal(writer._ring.segment.data, before)
        frame = reader.read(timeout_s=0)
        assert (frame.sequence, frame.acquired_ns, frame.flags) == (1, 7, 3)
        assert frame.column("values").tolist() == [1] * 4
        assert writer.commit(8) == 2
        assert reader.read(timeout_s=0).column("values").tolist() == [2] * 4


@pytest.mark.parametrize(("arguments", "error"), BAD)
def test_after_a_failed_commit_a_writer_begins_again(arguments: dict[str, int], error: type[Exception]) -> None:
    with service() as (writer, reader):
        writer.begin()["values"][:] = 2
        with pytest.raises(error):
            writer.commit(**arguments)
        assert writer.begin(from_last=True)["values"].tolist() == [1] * 4
        assert writer.commit(8) == 2
        frame = reader.read(timeout_s=0)
        assert (frame.sequence, frame.acquired_ns, frame.column("values").tolist()) == (2, 8, [1] * 4)
        assert reader.writer_statistics.published == reader.writer_statistics.wall.count == 2


def test_a_stamp_before_boot_counts_as_boot_and_is_counted() -> None:
    with service() as (writer, reader):
        for acquired_ns in (-1, now_ns() - (1 << 63), 0):
            writer.begin()
            writer.commit(acquired_ns)
            assert reader.read(timeout_s=0).acquired_ns == 0
        assert reader.writer_statistics.before_boot == 2


def test_a_stamp_in_the_future_is_kept_and_counted() -> None:
    with service() as (writer, reader):
        for ahead_s in (3600, 0.1, -1):
            writer.begin()
            stamp_ns = now_ns() + round(ahead_s * NS_PER_S)
            writer.commit(stamp_ns)
            assert reader.read(timeout_s=0).acquired_ns == stamp_ns
        assert reader.writer_statistics.ahead == 1


def test_frames_that_are_left_out_are_lost_to_readers_and_the_newest_is_always_there() -> None:
    with ServiceWriter("x", {"values": ("<i8", 4)}, slots=4) as writer, ServiceReader[Sample]("x") as reader:
        frames = reader.in_order(timeout_s=30)
        sequence, lost = 0, 0
        for skip in (0, 1, 2, 0, 3, 4, 0, 5, 1000, 1003, 0):
            more = skip == 3 or skip == 1003  # its slot would be the one of the newest
            before = sequence
            sequence += 1 + skip + more
            lost += skip + more
            writer.begin(skip=skip, from_last=True)["values"][:] = sequence
            if before:
                assert reader.read(timeout_s=0).sequence == before
                assert reader.read(timeout_s=0).column("values").tolist() == [before] * 4
            writer.begin(skip=skip)["values"][:] = sequence  # begun again
            assert writer.commit(sequence) == writer.sequence == sequence
            frame = next(frames)
            assert (frame.sequence, frame.column("values").tolist()) == (sequence, [sequence] * 4)
            assert reader.missed == lost
            with pytest.raises(ServiceError, match="commit without begin"):
                writer.commit(sequence)


def test_a_frame_begun_anew_without_a_gap_has_none() -> None:
    with service() as (writer, reader):
        writer.begin(skip=4)["values"][:] = 2
        writer.begin()["values"][:] = 3
        assert writer.commit(8) == 2
        writer.begin()["values"][:] = 4
        writer.begin(skip=2)["values"][:] = 5
        with pytest.raises(ValueError, match="64 for flags"):
            writer.commit(9, flags=-1)
        assert writer.commit(9) == 5
        assert reader.read(timeout_s=0).column("values").tolist() == [5] * 4
