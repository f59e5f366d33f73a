"""A writer goes over to a new generation while others pause, ask, interrupt, or memory is short."""

from __future__ import annotations

import os
import sys
import threading
import types
from typing import Any

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import NamespaceError, StructureChanged
from skinware.memory import file_layout, ring_writer, segments
from skinware.memory.ring_reader import RingReader
from skinware.service import _attachment, _ownership
from skinware_drivers.testing.waiting import wait_until
from tests.core.services import SMALL, kill, publish
from tests.specification import ring as specification

pytestmark = pytest.mark.usefixtures("ring")

OTHER = {"values": ("<u8", 3)}


def test_a_request_that_is_answered_by_another_structure_says_so() -> None:
    """Not with a frame of the old generation, which was acquired before the request."""
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        reader.read()
        writer.request_server()

        def answer() -> None:
            (request,) = writer.requests(30.0)
            writer.restructure(OTHER)
            publish(writer, 2)
            request.reply(position=writer.position)

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(StructureChanged):
            reader.request(timeout_s=30.0)
        thread.join()
        reader.reattach()
        assert reader.read().column("values").tolist() == [2, 2, 2]


def test_a_request_that_is_answered_by_a_new_generation_gets_its_frame() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        reader.read()
        writer.request_server()

        def answer() -> None:
            (request,) = writer.requests(30.0)
            writer.restructure(SMALL)
            publish(writer, 2)
            request.reply(position=writer.position)

        thread = threading.Thread(target=answer)
        thread.start()
        frame = reader.request(timeout_s=30.0)
        thread.join()
        assert (frame.position, frame.column("values")[0]) == (writer.position, 2)


@pytest.mark.parametrize("paused", [True, False])
def test_pausing_in_the_middle_of_it_holds_for_the_new_one(paused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    publish_file = segments.publish
    threads: list[threading.Thread] = []
    with ServiceWriter("x", SMALL) as writer:
        if not paused:
            writer.pause()

        def in_the_middle(*arguments: Any) -> None:
            thread = threading.Thread(target=writer.pause if paused else writer.resume)
            threads.append(thread)
            thread.start()
            thread.join(0.1)  # it may have to wait for the end of this
            publish_file(*arguments)

        with ServiceReader[Sample]("x") as old, monkeypatch.context() as patched:
            patched.setattr(segments, "publish", in_the_middle)
            writer.restructure(OTHER)
            threads[0].join()
            assert old._ring.state & file_layout.STATE_SUPERSEDED
        with ServiceReader[Sample]("x") as reader:
            assert (writer.paused, reader.paused) == (paused, paused)


def test_pausing_an_old_generation_does_not_hide_that_there_is_a_new_one() -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        writer._ring.set_state(file_layout.STATE_SUPERSEDED)
        writer.pause()
        writer.resume()
        assert reader._ring.state == file_layout.STATE_SUPERSEDED


def test_readers_leave_an_unmarked_generation_of_a_killed_writer(monkeypatch: pytest.MonkeyPatch) -> None:
    writer = ServiceWriter("x", SMALL)
    with ServiceReader[Sample]("x") as reader:
        kill(writer)
        monkeypatch.setattr(segments.Segment, "mark", lambda *_: None)  # its successor is stopped before
        with ServiceWriter("x", SMALL) as successor:
            publish(successor, 2)
            with reader.view() as frame:
                assert frame.column("values")[0] == 2


@pytest.mark.parametrize("where", ["RingWriter", "publish"])
def test_a_failure_before_it_is_there_leaves_the_old_one(
    where: str, namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise MemoryError if where == "RingWriter" else NamespaceError("no")

    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        inode = namespace.ring_path("x").stat().st_ino
        with monkeypatch.context() as patched:
            patched.setattr(*((_ownership, where) if where == "RingWriter" else (segments, where)), fail)
            with pytest.raises((MemoryError, NamespaceError)):
                writer.restructure(OTHER, rate_hz=7)
        publish(writer, 2)
        assert reader.read().column("values")[0] == 2
        assert namespace.ring_path("x").stat().st_ino == inode
        assert not [name for name in os.listdir(namespace.path) if name.endswith(".tmp")]
        writer._next_file_check_ns = 0
        publish(writer, 3)  # which would make it anew with columns that are not there
        assert reader.read().sequence == 3


class Interrupt:
    """Ctrl-C at the n-th line of ``commit``."""

    def __init__(self, lines: int) -> None:
        self.left = lines

    def __call__(self, frame: types.FrameType, _event: str, _argument: object) -> Any:
        files = ring_writer.__file__, specification.__file__
        of_commit = frame.f_code.co_name in ("commit", "_note", "wake") and frame.f_code.co_filename in files
        return self.line if of_commit else None

    def line(self, _frame: types.FrameType, event: str, _argument: object) -> Any:
        self.left -= event == "line"
        if self.left == 0:
            sys.settrace(None)
            raise KeyboardInterrupt
        return self.line


def test_ctrl_c_in_the_middle_of_a_publication_publishes_no_number_twice(ring: str) -> None:
    seen: dict[int, int] = {}
    interrupted = 0
    with ServiceWriter("x", SMALL, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 0)

        def look() -> None:
            frame = reader.read()
            value = int(frame.column("values")[0])
            assert seen.setdefault(frame.sequence, value) == value

        for lines in range(1, 40):
            tracing = Interrupt(lines)
            writer.begin()["values"][:] = 2 * lines
            sys.settrace(tracing)
            try:
                writer._ring.commit(1)
            except KeyboardInterrupt:
                interrupted += 1
            finally:
                sys.settrace(None)
            look()
            writer.begin()["values"][:] = 2 * lines + 1
            look()  # while the next one is being filled
            writer.commit(1)
            look()
            assert reader.read().position == writer.position
    assert interrupted > (10 if ring == "specification" else 4)


def test_a_thread_that_reads_is_not_ended_by_a_writer_that_is_too_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    from skinware import threads
    from skinware.errors import Overrun

    reader_class = vars(_attachment)["RingReader"]
    copy = reader_class.copy
    overruns = iter([True] * 3)

    def sometimes(self: RingReader[Sample], sequence: int | None = None) -> Sample | None:
        if next(overruns, False):
            raise Overrun("too fast")
        frame: Sample | None = copy(self, sequence)
        return frame

    monkeypatch.setattr(reader_class, "copy", sometimes)
    seen: list[int] = []
    with ServiceWriter("x", SMALL) as writer:
        publish(writer, 1)
        reader = ServiceReader[Sample]("x")
        with threads.start_reader(reader, lambda frame: seen.append(frame.sequence)) as worker:
            wait_until(lambda: seen == [1])
            assert worker.error is None
            assert reader.statistics.overruns == 3
