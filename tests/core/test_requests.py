"""Requests: each gets its own answer or a clear error in time, whatever the writer does."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from skinware import Frame, Namespace, ServiceReader, ServiceWriter
from skinware.errors import (
    Closed,
    Paused,
    PeerGone,
    RequestCancelled,
    RequestFailed,
    RequestRefused,
    RequestTimeout,
)
from skinware.realtime import now_ns
from skinware.service._server import RequestServer, short_path
from skinware_drivers.testing.waiting import wait_until

SMALL = {"values": ("<i8", 4)}
_context = multiprocessing.get_context("spawn")


def add(a: float, b: float) -> float:
    """The sum of two numbers.

    More about it.
    """
    return a + b


def fail() -> None:
    """Goes wrong."""
    raise RuntimeError("the motor is hot")


def no_json() -> object:
    """Returns what cannot be sent."""
    return object()


def too_much() -> str:
    """Returns more than a packet holds."""
    return "x" * 100_000


OPERATIONS: dict[str, Callable[..., object]] = {"add": add, "fail": fail, "no_json": no_json, "too_much": too_much}


@contextmanager
def on_request(**options: Any) -> Iterator[ServiceWriter]:
    """A sporadic writer in a thread: every frame holds its own number."""
    writer = ServiceWriter("x", SMALL, operations=OPERATIONS, **options)
    writer.request_server()

    def work() -> None:
        for columns in writer.on_request():
            columns["values"][:] = writer.sequence + 1

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield writer
    finally:
        writer.stop()
        thread.join()
        writer.close()


def test_a_frame_on_request() -> None:
    with on_request(), ServiceReader[Frame]("x") as reader:
        for number in (1, 2, 3):
            asked_ns = now_ns()
            frame = reader.request()
            assert frame.column("values").tolist() == [number] * 4
            assert frame.acquired_ns >= asked_ns
        assert reader.statistics.frames == 3


def test_several_requesters_at_once_each_get_their_answer() -> None:
    failures: list[str] = []

    def ask(base: int) -> None:
        with ServiceReader[Frame]("x", announce=False) as reader:
            for i in range(200):
                if reader.call("add", a=base, b=i) != base + i:
                    failures.append(f"{base} + {i}")
                asked_ns = now_ns()
                if reader.request().acquired_ns < asked_ns:
                    failures.append("an old frame")

    with on_request():
        threads = [threading.Thread(target=ask, args=(1000 * i,)) for i in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert failures == []


def test_periodic_writers_answer_too() -> None:
    writer = ServiceWriter("x", SMALL, operations=OPERATIONS)
    writer.request_server()

    def work() -> None:
        for columns in writer.periodic(200):
            columns["values"][:] = writer.sequence + 1

    thread = threading.Thread(target=work)
    thread.start()
    with ServiceReader[Frame]("x") as reader:
        asked_ns = now_ns()
        assert reader.request().acquired_ns >= asked_ns
        assert reader.call("add", a=1, b=2) == 3
    writer.stop()
    thread.join()
    writer.close()


def test_closing_between_two_steps_ends_the_loop_without_an_error() -> None:
    with ServiceWriter("x", SMALL, operations={"close": lambda: writer.close()}) as writer:
        writer.request_server()
        ended = threading.Event()

        def work() -> None:
            for _ in writer.periodic(200):
                pass
            ended.set()

        thread = threading.Thread(target=work)
        thread.start()
        with ServiceReader[Frame]("x") as reader, pytest.raises(PeerGone):
            reader.call("close")
        thread.join()
        assert ended.is_set()


def test_a_service_tells_what_it_can_do() -> None:
    with on_request(), ServiceReader[Frame]("x") as reader:
        assert reader.operations() == {
            "add": "The sum of two numbers.",
            "fail": "Goes wrong.",
            "no_json": "Returns what cannot be sent.",
            "too_much": "Returns more than a packet holds.",
        }


@pytest.mark.parametrize(
    ("operation", "arguments", "error", "words"),
    [
        ("add", {"a": 1}, RequestFailed, "missing 1 required"),
        ("add", {"a": 1, "b": 2, "c": 3}, RequestFailed, "unexpected keyword"),
        ("fail", {}, RequestFailed, "the motor is hot"),
        ("no_json", {}, RequestFailed, "its result cannot be sent"),
        ("too_much", {}, RequestFailed, "at most 65536"),
        ("fly", {}, RequestRefused, "no operation 'fly'; there are: add, fail, no_json, too_much"),
        ("add", {"a": object(), "b": 1}, RequestRefused, "cannot be sent"),
        ("add", {"a": "x" * 100_000, "b": "y"}, RequestRefused, "at most 65536"),
    ],
)
def test_what_goes_wrong_is_told(operation: str, arguments: dict[str, Any], error: type[Exception], words: str) -> None:
    with on_request(), ServiceReader[Frame]("x") as reader:
        with pytest.raises(error, match=words):
            reader.call(operation, **arguments)
        assert reader.call("add", a=1, b=1) == 2  # and the next one works


def test_paused() -> None:
    with on_request() as writer, ServiceReader[Frame]("x") as reader:
        reader.request()
        writer.pause()
        assert writer.paused
        assert reader.paused
        for ask in (reader.request, lambda: reader.call("add", a=1, b=2)):
            with pytest.raises(Paused, match="x: the service is paused"):
                ask()
        with pytest.raises(Paused, match=r"call resume\(\) first"):
            writer.begin()
        writer.resume()
        assert not reader.paused
        assert reader.request().sequence == 2


def test_no_answer_in_time_and_never_an_old_one_for_a_new_request() -> None:
    with ServiceWriter("x", SMALL, operations=OPERATIONS) as writer, ServiceReader[Frame]("x") as reader:
        writer.request_server()
        with pytest.raises(RequestTimeout, match=r"no answer to 'add' within 0\.05 s"):
            reader.call("add", timeout_s=0.05, a=1, b=2)
        late = writer.requests(1.0)
        assert late == []  # it was cancelled before it was seen
        slow = reader.ask("add", a=3, b=4)
        (request,) = writer.requests(1.0)
        with pytest.raises(RequestTimeout):
            slow.result(0.01)
        new = reader.ask("add", a=5, b=6)
        request.reply(7)
        (request,) = writer.requests(1.0)
        assert not new.done()
        request.reply(11)
        assert new.result(5.0).result == 11


def test_cancelled() -> None:
    with ServiceWriter("x", SMALL, operations=OPERATIONS) as writer, ServiceReader[Frame]("x") as reader:
        writer.request_server()
        pending = reader.ask("add", a=1, b=2)
        (request,) = writer.requests(1.0)
        assert not request.cancelled
        pending.cancel()
        assert pending.done()
        with pytest.raises(RequestCancelled, match="'add' was cancelled"):
            pending.result(5.0)
        assert writer.requests(1.0) == []
        assert request.cancelled
        request.reply(3)  # nobody is there to hear it
        again = reader.ask("add", a=2, b=2)
        writer.requests(1.0)[0].reply(4)
        assert again.result(5.0).result == 4


def test_a_service_without_requests_says_so() -> None:
    with (
        ServiceWriter("x", SMALL),
        ServiceReader[Frame]("x") as reader,
        pytest.raises(RequestRefused, match="service 'x' takes no requests"),
    ):
        reader.request()


def test_closed_and_gone(namespace: Namespace) -> None:
    writer = ServiceWriter("x", SMALL, operations=OPERATIONS)
    writer.request_server()
    reader = ServiceReader[Frame]("x")
    pending = reader.ask("add", a=1, b=2)
    writer.close()
    assert not namespace.socket_path("x").exists()
    with pytest.raises(PeerGone, match="died or was restarted; 'add' may not have been done"):
        pending.result(5.0)
    with pytest.raises(PeerGone, match="the writer of 'x' is dead"):
        reader.request()
    with pytest.raises(Closed):
        writer.requests()
    reader.close()
    with pytest.raises(Closed):
        reader.request()


def _serve(ready: Any) -> None:
    writer = ServiceWriter("x", SMALL, operations={"pid": os.getpid, "hang": signal.pause})
    writer.request_server()
    ready.set()
    for columns in writer.on_request():
        columns["values"][:] = os.getpid()


@contextmanager
def served() -> Iterator[Any]:
    ready = _context.Event()
    process = _context.Process(target=_serve, args=(ready,))
    process.start()
    try:
        assert ready.wait(60)
        yield process
    finally:
        process.kill()
        process.join()


def test_a_killed_writer_is_a_clear_error_and_its_successor_answers(namespace: Namespace) -> None:
    with served() as first:
        reader = ServiceReader[Frame]("x")
        assert reader.call("pid") == first.pid
        pending = reader.ask("hang")
        assert not pending.done()
        os.kill(first.pid, signal.SIGKILL)
        with pytest.raises(PeerGone):
            pending.result(10.0)
        first.join()
        with pytest.raises(PeerGone):
            reader.request()
        assert namespace.socket_path("x").exists()
    with served() as second:
        assert reader.call("pid") == second.pid
        assert reader.request().column("values")[0] == second.pid
        reader.close()
    with ServiceWriter("x", SMALL):  # the next start, which takes no requests, clears the dead one's socket away
        assert not namespace.socket_path("x").exists()


def test_a_stopped_writer_times_out() -> None:
    with served() as process, ServiceReader[Frame]("x") as reader:
        reader.request()
        os.kill(process.pid, signal.SIGSTOP)
        with pytest.raises(RequestTimeout, match="busy, hung or stopped"):
            reader.request(timeout_s=0.1)
        os.kill(process.pid, signal.SIGCONT)
        asked_ns = now_ns()
        assert reader.request().acquired_ns >= asked_ns
    ServiceWriter("x", SMALL).close()  # clears away what the killed one left


def test_a_forked_child_keeps_no_connection_open() -> None:
    """Otherwise a child of the writer would hide its death from requesters."""
    with ServiceWriter("x", SMALL, operations=OPERATIONS) as writer, ServiceReader[Frame]("x") as reader:
        writer.request_server()
        pending = reader.ask("add", a=1, b=2)
        (request,) = writer.requests(1.0)
        child = os.fork()
        if child == 0:
            left = [fd for fd in os.listdir("/proc/self/fd") if "socket" in _target(fd)]
            os._exit(len(left))
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        request.reply(3)
        assert pending.result(5.0).result == 3


def _target(fd: str) -> str:
    try:
        return os.readlink(f"/proc/self/fd/{fd}")
    except OSError:
        return ""


@contextmanager
def raw_connection(namespace: Namespace) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        with short_path(namespace.socket_path("x")) as path:
            connection.connect(path)
        connection.settimeout(10.0)
        yield connection


@pytest.mark.parametrize("packet", [b"nonsense", b"{}", b"[1]", b'{"id":"a","operation":"add"}', b"\xff" * 60_000])
def test_nonsense_ends_the_connection_of_the_one_who_sent_it(namespace: Namespace, packet: bytes) -> None:
    with on_request(), ServiceReader[Frame]("x") as reader, raw_connection(namespace) as connection:
        connection.send(packet)
        assert connection.recv(100) == b""
        assert reader.call("add", a=1, b=2) == 3


def test_a_peer_that_reads_no_answers_is_dropped_and_holds_nobody_up(namespace: Namespace) -> None:
    with on_request(), ServiceReader[Frame]("x") as reader, raw_connection(namespace) as connection:
        with pytest.raises((BrokenPipeError, ConnectionResetError)):
            _ask_for_ever(connection)
        assert reader.call("add", a=1, b=2) == 3


def _ask_for_ever(connection: socket.socket) -> None:
    for number in range(1_000_000):
        connection.send(b'{"id":%d,"operation":"operations"}' % number)


def test_too_many_peers(namespace: Namespace) -> None:
    with on_request(), ServiceReader[Frame]("x") as reader:
        assert reader.call("add", a=1, b=2) == 3
        connections = []
        for _ in range(100):
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            connection.settimeout(10.0)
            wait_until(lambda connection=connection: _connected(connection, namespace))  # type: ignore[misc]
            connections.append(connection)
        assert sum(connection.recv(1) == b"" for connection in connections[64:]) == len(connections[64:])
        assert reader.call("add", a=1, b=2) == 3
        for connection in connections:
            connection.close()
        with ServiceReader[Frame]("x") as another:
            wait_until(lambda: _answers(another))


def _connected(connection: socket.socket, namespace: Namespace) -> bool:
    try:
        with short_path(namespace.socket_path("x")) as path:
            connection.connect(path)
    except BlockingIOError:  # those before it have not been let in yet
        return False
    return True


def _answers(reader: ServiceReader[Frame]) -> bool:
    try:
        return bool(reader.call("add", a=1, b=2) == 3)
    except PeerGone:  # the writer has not yet noticed that the others hung up
        return False


def test_the_longest_names_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    place = Namespace("n" * 40 + str(os.getpid()))
    name = "s" * 47
    writer = ServiceWriter(name, SMALL, namespace=place, operations=OPERATIONS)
    try:
        server = writer.request_server()
        assert isinstance(server, RequestServer)
        with ServiceReader[Frame](name, namespace=place) as reader:
            pending = reader.ask("add", a=1, b=2)
            writer.requests(5.0)[0].reply(3)
            assert pending.result(5.0).result == 3
        assert os.stat(place.socket_path(name)).st_mode & 0o777 == 0o660
    finally:
        writer.close()
        place.lock_path(name).unlink()
        place.readers_path.rmdir()
        place.path.rmdir()


def test_a_writer_may_answer_from_its_own_loop() -> None:
    with ServiceWriter("x", SMALL, operations={"tare": lambda: None}) as writer, ServiceReader[Frame]("x") as reader:
        writer.request_server()
        pending = reader.ask("acquire")
        wait_until(lambda: _publish_for(writer))
        answer = pending.result(5.0)
        assert (answer.generation, answer.sequence) == writer.position
        assert np.array_equal(reader.read().column("values"), np.full(4, 9))


def _publish_for(writer: ServiceWriter) -> bool:
    requests = writer.requests(0.1)
    for request in requests:
        writer.begin()["values"][:] = 9
        writer.commit(now_ns())
        request.reply(position=writer.position)
    return bool(requests)
