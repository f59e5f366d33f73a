"""What a service hands out: whole frames, every loss counted, and waits that end."""

from __future__ import annotations

import os
import signal
import threading
import time

import numpy as np
import pytest

from skinware import Column, Namespace, Sample, ServiceReader, ServiceWriter, native
from skinware.errors import Overrun, Paused, ServiceError, ServiceTimeout, StructureChanged
from skinware.memory import file_layout, ring_reader, segments
from skinware.memory import ring as ring_module
from skinware.memory.ring_reader import RingReader
from skinware.memory.ring_writer import RingWriter
from skinware.memory.schema import Schema
from skinware.realtime import now_ns
from skinware.service._ownership import take_name
from skinware_drivers.testing.waiting import wait_until
from tests.core.services import SMALL, publish

# -- coherency ----------------------------------------------------------------------------------------------------


def test_a_column_that_there_is_not_is_refused_with_those_that_there_are() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        writer.begin()
        writer.commit(now_ns())
        with pytest.raises(KeyError, match="no column 'velocity'; there are values"):
            reader.read().column("velocity")


def test_a_slot_that_is_being_filled_is_never_handed_out() -> None:
    with ServiceWriter("x", SMALL, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        publish(writer, 2)
        writer.begin()["values"][:256] = 3
        assert set(reader.read().column("values").tolist()) == {2}
        assert reader._ring.copy(1) is None
        writer.commit(1)


def test_a_view_says_when_it_was_overwritten() -> None:
    with ServiceWriter("x", SMALL, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        view = reader.view()
        frame = view.__enter__()
        assert frame.valid
        assert not frame.column("values").flags.writeable
        publish(writer, 2)
        assert frame.valid
        writer.begin()
        assert not frame.valid
        with pytest.raises(Overrun, match="sample 1 of 'x' was overwritten while it was viewed"):
            view.__exit__(None, None, None)
        assert reader.statistics.overruns == 1


def test_what_goes_wrong_during_a_view_is_told_as_it_is() -> None:
    def look(reader: ServiceReader[Sample], writer: ServiceWriter) -> None:
        with reader.view() as frame:
            publish(writer, 2)
            publish(writer, 3)
            frame.column("colour")

    with ServiceWriter("x", SMALL, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        with pytest.raises(KeyError, match="no column 'colour'"):
            look(reader, writer)


def test_other_processors_get_fences(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ring_module, "fence", native.core().quick.skinware_native_fence)
    monkeypatch.setattr(ring_reader, "fence", native.core().quick.skinware_native_fence)
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 7)
        with reader.view() as sample:
            assert sample.column("values")[0] == 7


# -- losses -------------------------------------------------------------------------------------------------------


def test_the_age_of_a_sample_is_that_of_its_data(monkeypatch: pytest.MonkeyPatch) -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        writer.begin()
        writer.commit(1_000)
        monkeypatch.setattr(ring_module, "now_ns", lambda: 1_700)
        assert reader.read().age_ns == 700


def test_losses_are_counted_exactly() -> None:
    with ServiceWriter("x", SMALL, slots=4) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        assert reader.read().sequence == 1
        for value in range(2, 12):
            publish(writer, value)
        frame = reader.read()
        assert (frame.sequence, reader.statistics.frames, reader.missed) == (11, 2, 9)
        assert reader.read().sequence == 11
        assert reader.missed == 9


def test_in_order_gives_every_frame_while_it_keeps_up_and_counts_the_rest() -> None:
    with ServiceWriter("x", SMALL, slots=4) as writer, ServiceReader[Sample]("x") as reader:
        frames = reader.in_order(timeout_s=5)
        publish(writer, 1)
        assert next(frames).sequence == 1
        for value in (2, 3, 4):
            publish(writer, value)
        assert [next(frames).sequence for _ in range(3)] == [2, 3, 4]
        assert reader.missed == 0
        for value in range(5, 21):
            publish(writer, value)
        assert next(frames).sequence == 18  # the oldest that cannot be overwritten next
        assert reader.missed == 13


def test_the_first_view_after_a_restart_shows_the_new_life() -> None:
    with ServiceWriter("a", SMALL) as writer:
        publish(writer, 1)
        reader = ServiceReader[Sample]("a")
        with reader.view() as frame:
            assert frame.column("values")[0] == 1
    with ServiceWriter("a", SMALL) as writer, reader:
        publish(writer, 2)
        with reader.view() as frame:
            assert frame.position == (writer.generation, 1)
            assert frame.column("values")[0] == 2


def test_losses_over_a_restart_are_counted() -> None:
    writer = ServiceWriter("x", SMALL)
    publish(writer, 1)
    with ServiceReader[Sample]("x") as reader:
        frame = reader.read()
        publish(writer, 2)
        writer.close()
        with ServiceWriter("x", SMALL) as again:
            publish(again, 3)
            publish(again, 4)
            newer = reader.read(newer_than=frame)
            assert newer.generation != frame.generation
            assert reader.missed == 2


# -- waiting ------------------------------------------------------------------------------------------------------


def test_readers_wake_on_publication_from_any_thread() -> None:
    with ServiceWriter("x", SMALL) as writer:
        publish(writer, 1)
        seen: list[int] = []

        def follow() -> None:
            with ServiceReader[Sample]("x") as reader:
                for frame in reader.samples(timeout_s=30):
                    seen.append(frame.sequence)
                    if frame.sequence >= 3:
                        return

        threads = [threading.Thread(target=follow) for _ in range(3)]
        for thread in threads:
            thread.start()
        wait_until(lambda: len(seen) >= 3)
        publish(writer, 2)
        publish(writer, 3)
        for thread in threads:
            thread.join(30)
        assert seen.count(3) == 3


def test_a_signal_ends_a_wait() -> None:
    class Alarm(Exception):
        pass

    def ring(_number: int, _frame: object) -> None:
        raise Alarm

    def wait_until_it_rings(reader: ServiceReader[Sample]) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        reader.read(newer_than=reader.read(), timeout_s=60)

    before = signal.signal(signal.SIGALRM, ring)
    try:
        with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
            publish(writer, 1)
            with pytest.raises(Alarm):
                wait_until_it_rings(reader)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_a_frame_that_is_still_to_come_is_waited_for() -> None:
    """Also past those that are published while the reader sleeps."""
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        got: list[int] = []
        wanted = writer.generation, 30
        thread = threading.Thread(target=lambda: got.append(reader.read(newer_than=wanted, timeout_s=60).sequence))
        thread.start()

        def published_until_got() -> bool:
            publish(writer, 2)
            return bool(got)

        wait_until(published_until_got)
        thread.join()
        assert got[0] > 30


def test_a_timeout_is_not_early() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        with pytest.raises(ServiceTimeout, match="published nothing so far"):
            reader.read(timeout_s=0.05)
        publish(writer, 1)
        begin = time.monotonic()
        with pytest.raises(ServiceTimeout):
            reader.read(newer_than=reader.read(), timeout_s=0.15)
        assert time.monotonic() - begin >= 0.15


def test_a_periodic_writer_publishes_until_closed() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        for count, columns in enumerate(writer.periodic(200)):
            columns["values"][:] = count
            if count == 5:
                writer.close()
                break
        assert reader.read().sequence == 5  # the sixth was not committed: the loop was left first


def test_a_writer_that_is_closed_in_its_loop_ends_the_loop() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        for columns in writer.periodic(200):
            columns["values"][:] = 1
            if writer.sequence == 3:
                writer.close()
        assert reader.read().sequence == 3


def test_ring_positions_survive_wrap_around(namespace: Namespace) -> None:
    namespace.create()
    lock = take_name(namespace, "x")
    schema = Schema.of(SMALL, "")
    segment = segments.create(namespace, "x", schema, {}, slots=2, kind="data", period_ns=0, published_before=0)
    writer = RingWriter(segment)
    segments.publish(segment, namespace, "x")
    reader = RingReader(segments.attach(namespace, "x"), Sample)
    writer._half_words[file_layout.WAKE_WORD_OFFSET // 4] = 0xFFFF_FFFF
    writer.begin()["values"][:] = 1
    assert writer.commit(5) == 1
    assert reader.wake_count == 0
    frame = reader.copy()
    assert frame is not None
    assert (frame.sequence, frame.acquired_ns) == (1, 5)
    namespace.ring_path("x").unlink()
    for descriptor in (lock, segment.descriptor, reader.segment.descriptor):
        descriptor.close()


def test_a_periodic_reader_is_told_of_another_structure() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish_one(writer)
        frames = reader.samples(200, timeout_s=10)
        assert next(frames).sequence == 1
        writer.restructure({"values": ("<u2", 9)})
        publish_one(writer)
        with pytest.raises(StructureChanged, match=r"call reattach\(\)"):
            for _ in frames:
                pass
        assert reader.read().stale  # the old one stays readable
        reader.reattach()
        assert len(reader.read().column("values")) == 9


def publish_one(writer: ServiceWriter) -> None:
    writer.begin()
    writer.commit(now_ns())


def test_requests_reach_a_writer_with_another_structure() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish_one(writer)
        reader.read()
        writer.restructure({"values": ("<u2", 9)})
        writer.request_server()
        pending = reader.ask("acquire")
        (request,) = writer.requests(10.0)
        publish_one(writer)
        request.reply(position=writer.position)
        assert pending.result(10.0).sequence == 1


def test_a_pause_in_the_middle_of_a_frame_does_not_publish_it() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        writer.request_server()

        def resume_once_the_loop_has_come_round() -> None:
            with ServiceReader[Sample]("x") as other, pytest.raises(Paused):
                other.request(timeout_s=60)  # the loop hears it after the frame that was paused
            writer.resume()

        resuming = threading.Thread(target=resume_once_the_loop_has_come_round)
        for count, _ in enumerate(writer.periodic(500)):
            if count == 1:
                writer.pause()
                resuming.start()
            if count == 2:
                break
        resuming.join(30)
        assert writer.sequence == 1  # the first; the second was paused, the third is not yet published
        assert reader.read().sequence == 1


def test_a_namespace_by_name_and_a_dtype_by_code() -> None:
    name = os.environ["SKINWARE_NAMESPACE"]
    with (
        ServiceWriter("x", {"values": Column("<f8", 7)}, namespace=name) as writer,  # type: ignore[arg-type]
        ServiceReader[Sample]("x", namespace=name) as reader,
    ):
        publish_one(writer)
        assert reader.read().column("values").dtype == np.float64


def test_commit_without_begin_is_refused() -> None:
    with ServiceWriter("x", SMALL) as writer:
        with pytest.raises(ServiceError, match="commit without begin"):
            writer.commit(1)
        publish_one(writer)
        with pytest.raises(ServiceError, match="would publish an old sample"):
            writer.commit(1)
        assert writer.sequence == 1


def test_a_loop_may_restructure_its_service() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        sizes = []
        for count, columns in enumerate(writer.periodic(500)):
            sizes.append(len(columns["values"]))
            if count == 1:
                writer.restructure({"values": ("<u8", 9)})
            if count == 3:
                break
        assert sizes == [512, 512, 9, 9]
        assert writer.sequence == 1  # of the new generation: the third; the second was of the old one
        reader.reattach()
        assert len(reader.read().column("values")) == 9
