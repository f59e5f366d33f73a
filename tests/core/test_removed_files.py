"""Somebody removes files under a writer: whatever it does, they are there again within a second."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Callable, Iterator

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import NamespaceError, Paused, PeerGone, RequestRefused, ServiceNotFound
from skinware_drivers.testing.waiting import wait_until
from tests.core.services import SMALL, publish


def sporadic(writer: ServiceWriter) -> None:
    for columns in writer.on_request():
        columns["values"][:] = 1


def periodic(writer: ServiceWriter) -> None:
    for columns in writer.periodic(100):
        columns["values"][:] = 1


def own_loop(writer: ServiceWriter) -> None:
    while not writer._stopping:
        for request in writer.requests(0.02):
            publish(writer, 1)
            request.reply(position=writer.position)


@contextlib.contextmanager
def running(loop: Callable[[ServiceWriter], None]) -> Iterator[ServiceWriter]:
    writer = ServiceWriter("x", SMALL)
    writer.request_server()
    thread = threading.Thread(target=loop, args=(writer,))
    thread.start()
    try:
        yield writer
    finally:
        writer.stop()
        thread.join()
        writer.close()


def answers() -> bool:
    try:
        with ServiceReader[Sample]("x") as reader:
            return reader.request().sequence > 0
    except Paused:
        return True
    except (ServiceNotFound, RequestRefused, PeerGone):
        return False


@pytest.mark.parametrize("loop", [sporadic, periodic, own_loop])
@pytest.mark.parametrize("paused", [False, True])
@pytest.mark.parametrize("what", ["all", "socket"])
def test_every_kind_of_writer_makes_them_again(
    loop: Callable[[ServiceWriter], None], paused: bool, what: str, namespace: Namespace
) -> None:
    with running(loop) as writer:
        wait_until(answers)
        if paused:
            writer.pause()
        shutil.rmtree(namespace.path) if what == "all" else namespace.socket_path("x").unlink()
        assert not answers()
        writer._next_file_check_ns = 0  # now instead of within a second
        wait_until(answers)
        with ServiceReader[Sample]("x") as reader:
            assert reader.alive
            assert reader.paused == paused


def test_they_are_looked_after_once_a_second_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[int] = []
    with ServiceWriter("x", SMALL) as writer, monkeypatch.context() as patched:
        patched.setattr(ServiceWriter, "_make_removed_files", lambda _: looks.append(1))
        due_ns = writer._next_file_check_ns
        for now in (due_ns - 1, due_ns, due_ns + 1, due_ns + 999_999_999, due_ns + 1_000_000_000):
            patched.setattr("skinware.service._ownership.now_ns", lambda now=now: now)
            writer.keep_files()
    assert len(looks) == 2


def test_files_that_cannot_be_made_again_are_tried_again_and_told_once(
    namespace: Namespace, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object, **__: object) -> None:
        raise NamespaceError("shared memory is full")

    with ServiceWriter("x", SMALL) as writer:
        namespace.ring_path("x").unlink()
        with monkeypatch.context() as patched:
            patched.setattr("skinware.memory.segments.create", full)
            for _ in range(3):
                writer._next_file_check_ns = 0
                publish(writer, 1)
        assert caplog.text.count("shared memory is full; readers cannot find 'x'") == 1
        writer._next_file_check_ns = 0
        publish(writer, 2)
        with ServiceReader[Sample]("x") as reader:
            assert reader.read().column("values")[0] == 2
