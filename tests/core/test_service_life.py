"""How a service begins and ends, and who is there meanwhile."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import Closed, ConfigurationError, ServiceTimeout, StructureChanged
from skinware.memory import file_layout
from skinware.memory.announcement import living_readers
from skinware_drivers.testing.waiting import wait_until
from tests.core.services import SMALL, publish
from tests.core.workers import PATIENCE_S, PROCESSES, kill, running

pytestmark = pytest.mark.usefixtures("process_server", "ring")


def write_until_killed(published: Any, fill_only: bool) -> None:
    writer = ServiceWriter("x", SMALL)
    for value in range(1, 11):
        publish(writer, value)
    if fill_only:
        writer.begin()["values"][:] = 99  # killed in the middle of filling
    published.set()
    while True:
        time.sleep(1)


@contextmanager
def lone_writer(fill_only: bool = False) -> Iterator[Any]:
    """A writer in a process of its own that has published ten frames."""
    published = PROCESSES.Event()
    with running(write_until_killed, published, fill_only) as process:
        assert published.wait(PATIENCE_S)
        yield process


@pytest.mark.parametrize("fill_only", [False, True])
def test_a_killed_writer_is_noticed_and_its_last_frame_stays(fill_only: bool) -> None:
    with lone_writer(fill_only) as process, ServiceReader[Sample]("x") as reader:
        frame = reader.read()
        assert reader.alive
        assert not frame.stale
        kill(process)
        assert not reader.alive
        with pytest.raises(ServiceTimeout, match="dead or was stopped"):
            reader.read(newer_than=frame, timeout_s=0.2)
        last = reader.read()
        assert last.stale
        assert set(last.column("values").tolist()) == {10}
        with ServiceReader[Sample]("x") as late:
            assert late.read().sequence == 10
        with ServiceWriter("x", SMALL) as writer:
            publish(writer, 1)
            assert reader.read(newer_than=last).column("values")[0] == 1
            assert reader.alive


def test_another_structure_is_told_and_old_data_stays_readable() -> None:
    with lone_writer() as process, ServiceReader[Sample]("x") as reader:
        last = reader.read()
        kill(process)
        with ServiceWriter("x", {"values": ("<u8", 3)}) as writer:
            publish(writer, 5)
            with pytest.raises(StructureChanged, match="reattach"):
                reader.read(newer_than=last)
            assert reader.structure_changed
            assert len(reader.read().column("values")) == 512
            reader.reattach()
            assert reader.read(newer_than=last).column("values").tolist() == [5, 5, 5]


def test_a_stopped_process_is_alive_but_silent() -> None:
    with lone_writer() as process, ServiceReader[Sample]("x") as reader:
        os.kill(process.pid, signal.SIGSTOP)
        frame = reader.read()
        with pytest.raises(ServiceTimeout, match="is running, but is silent"):
            reader.read(newer_than=frame, timeout_s=0.1)
        kill(process)
    ServiceWriter("x", SMALL).close()


def test_a_forked_child_neither_writes_nor_keeps_the_writer_alive() -> None:
    writer = ServiceWriter("x", SMALL)
    publish(writer, 1)
    ready, go = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        try:
            writer.begin()
            verdict = b"wrote"
        except Closed:
            verdict = b"refus"
        os.write(ready[1], verdict)
        os.read(go[0], 1)
        os._exit(0)
    try:
        assert os.read(ready[0], 5) == b"refus"
        with ServiceReader[Sample]("x") as reader:
            assert reader.alive
            writer.close()
            assert not reader.alive
        ServiceWriter("x", SMALL).close()
    finally:
        os.write(go[1], b"x")
        os.waitpid(child, 0)
        for fd in (*ready, *go):
            os.close(fd)


@pytest.mark.parametrize("slots", [0, 1, 65])
def test_impossible_slots_are_refused_and_the_name_is_free_again(slots: int, namespace: Namespace) -> None:
    with pytest.raises(ConfigurationError, match=f"slots={slots}: give 2 to 64"):
        ServiceWriter("x", SMALL, slots=slots)
    assert namespace.services() == []
    with ServiceWriter("x", SMALL) as writer:
        assert writer.sequence == 0


@pytest.mark.parametrize(("rate_hz", "slots"), [(None, 8), (0.1, 8), (20, 20), (100, 64), (1000, 64)])
def test_a_ring_holds_a_second_where_nobody_says_otherwise(rate_hz: float | None, slots: int) -> None:
    with ServiceWriter("x", SMALL, rate_hz=rate_hz) as writer:
        assert writer.slots == slots
        writer.restructure(SMALL, rate_hz=12.5)
        assert writer.slots == 13
    with ServiceWriter("x", SMALL, rate_hz=rate_hz, slots=5) as writer:
        writer.restructure(SMALL, rate_hz=12.5)
        assert writer.slots == 5


@pytest.mark.parametrize(("megabytes", "slots"), [(0.1, 64), (0.5, 32), (1, 16), (3, 8), (30, 8)])
def test_a_ring_of_large_frames_holds_less_than_a_second(megabytes: float, slots: int) -> None:
    frame = round(megabytes * 2**20) - 64  # the slot's header
    assert file_layout.plan({}, {"values": ("u1", frame)}, None, 10_000_000).slot_count == slots


def test_a_removed_file_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    with ServiceWriter("x", SMALL) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        frame = reader.read()
        writer.namespace.ring_path("x").unlink()

        def newer() -> bool:
            publish(writer, 2)
            return reader.read().generation != frame.generation

        wait_until(newer)


def test_what_a_killed_creator_left_is_removed(namespace: Namespace) -> None:
    namespace.create()
    (namespace.path / ".x.0123abcd.tmp").write_bytes(b"half")
    (namespace.path / ".xy.0123abcd.tmp").write_bytes(b"not ours")
    with ServiceWriter("x", SMALL):
        assert not (namespace.path / ".x.0123abcd.tmp").exists()
    (namespace.path / ".xy.0123abcd.tmp").unlink()


def test_readers_are_seen_while_they_live(namespace: Namespace) -> None:
    with ServiceWriter("x", SMALL) as writer:
        publish(writer, 1)
        reader = ServiceReader[Sample]("x")
        reader.read()
        (record,) = living_readers(namespace)
        assert (record.service, record.pid) == ("x", os.getpid())
        reader.close()
        assert list(living_readers(namespace)) == []


def test_a_reader_that_was_there_before_the_namespace_is_seen_later(namespace: Namespace) -> None:
    seen = threading.Event()

    def read() -> None:
        with ServiceReader[Sample]("x", timeout_s=30) as reader:
            for _ in reader.samples(timeout_s=30):
                if seen.is_set():
                    return

    thread = threading.Thread(target=read)
    thread.start()
    time.sleep(0.02)  # most likely it waits by now; the test holds either way
    with ServiceWriter("x", SMALL) as writer:

        def announced() -> bool:
            publish(writer, 1)
            return [record.service for record in living_readers(namespace)] == ["x"]

        wait_until(announced)
        for path in namespace.reader_files():
            path.unlink()
        wait_until(announced)  # again
        seen.set()
        publish(writer, 2)
        thread.join(30)


@pytest.mark.parametrize(
    "look", [lambda _: ServiceWriter("x", SMALL).close(), lambda place: list(living_readers(place))]
)
def test_a_dead_readers_announcement_is_removed_by_whoever_looks(
    namespace: Namespace, look: Callable[[Namespace], object]
) -> None:
    with ServiceWriter("y", SMALL) as writer, ServiceReader[Sample]("y") as reader:
        publish(writer, 1)
        reader.read()
        dead = namespace.readers_path / "x.1.deadbeef"
        dead.write_bytes(b"left by a killed reader")
        look(namespace)
        assert not dead.exists()
        assert [record.service for record in living_readers(namespace)] == ["y"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "look", [lambda _: ServiceWriter("x", SMALL).close(), lambda place: list(living_readers(place))]
)
def test_however_many_dead_announcements_delay_nobody(
    namespace: Namespace, look: Callable[[Namespace], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look ends after so many: a program that may announce a reader may put any number there."""
    monkeypatch.setattr("skinware.memory.announcement._MOST_FILES", 1000)
    namespace.create()
    for number in range(2500):
        (namespace.readers_path / f"x.{number}.fake").touch()
    for left in (1500, 500, 0):
        look(namespace)
        assert len(list(namespace.reader_files())) == left
