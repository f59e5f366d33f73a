"""Requests: each gets its own answer or a clear error in time, whatever the writer does."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from typing import Any

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
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
from skinware.service._server import RequestServer
from skinware_drivers.testing.waiting import wait_until
from tests.core.services import OPERATIONS, SMALL, on_request


def test_a_frame_on_request() -> None:
    with on_request(), ServiceReader[Sample]("x") as reader:
        for number in (1, 2, 3):
            asked_ns = now_ns()
            frame = reader.request()
            assert (frame.column("values") == number).all()
            assert frame.acquired_ns >= asked_ns
        assert reader.statistics.frames == 3


def test_several_requesters_at_once_each_get_their_answer() -> None:
    failures: list[str] = []

    def ask(base: int) -> None:
        with ServiceReader[Sample]("x", announce=False) as reader:
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
    with ServiceReader[Sample]("x") as reader:
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
        with ServiceReader[Sample]("x") as reader, pytest.raises(PeerGone):
            reader.call("close")
        thread.join()
        assert ended.is_set()


def test_a_service_tells_what_it_can_do() -> None:
    with on_request(), ServiceReader[Sample]("x") as reader:
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
    with on_request(), ServiceReader[Sample]("x") as reader:
        with pytest.raises(error, match=words):
            reader.call(operation, **arguments)
        assert reader.call("add", a=1, b=1) == 2  # and the next one works


def test_paused() -> None:
    with on_request() as writer, ServiceReader[Sample]("x") as reader:
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
    with ServiceWriter("x", SMALL, operations=OPERATIONS) as writer, ServiceReader[Sample]("x") as reader:
        writer.request_server()
        with pytest.raises(RequestTimeout, match=r"no answer to 'add' within 0\.05 s"):
            reader.call("add", timeout_s=0.05, a=1, b=2)
        late = writer.requests(1.0)  # on a busy machine it is seen a turn before what takes it back
        writer.requests()
        assert all(request.cancelled for request in late)
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
    with ServiceWriter("x", SMALL, operations=OPERATIONS) as writer, ServiceReader[Sample]("x") as reader:
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
        ServiceReader[Sample]("x") as reader,
        pytest.raises(RequestRefused, match="service 'x' takes no requests"),
    ):
        reader.request()


def test_closed_and_gone(namespace: Namespace) -> None:
    writer = ServiceWriter("x", SMALL, operations=OPERATIONS)
    writer.request_server()
    reader = ServiceReader[Sample]("x")
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


def idle_programs(count: int) -> list[socket.socket]:
    """Connections that ask for nothing."""
    held = []
    for _ in range(count):
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        held.append(connection)
        connection.connect(str(Namespace().socket_path("x")))
    return held


def test_a_full_service_says_so_and_idle_programs_make_room(monkeypatch: pytest.MonkeyPatch) -> None:
    with on_request(), contextlib.ExitStack() as open_connections:
        with ServiceReader[Sample]("x") as reader:
            reader.request()
            for connection in idle_programs(63):
                open_connections.callback(connection.close)
                reader.request()  # the service has seen it
            with ServiceReader[Sample]("x") as late:
                with pytest.raises(RequestRefused, match="64 programs are connected"):
                    late.request()
                monkeypatch.setattr("skinware.service._server._IDLE_NS", 0)
                assert late.request().sequence
            assert reader.request().sequence


def test_the_longest_names_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    place = Namespace("n" * 40 + str(os.getpid()))
    name = "s" * 47
    writer = ServiceWriter(name, SMALL, namespace=place, operations=OPERATIONS)
    try:
        server = writer.request_server()
        assert isinstance(server, RequestServer)
        with ServiceReader[Sample](name, namespace=place) as reader:
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
    with ServiceWriter("x", SMALL, operations={"tare": lambda: None}) as writer, ServiceReader[Sample]("x") as reader:
        writer.request_server()
        pending = reader.ask("acquire")
        wait_until(lambda: _publish_for(writer))
        answer = pending.result(5.0)
        assert (answer.generation, answer.sequence) == writer.position
        assert (reader.read().column("values") == 9).all()


def _publish_for(writer: ServiceWriter) -> bool:
    requests = writer.requests(0.1)
    for request in requests:
        writer.begin()["values"][:] = 9
        writer.commit(now_ns())
        request.reply(position=writer.position)
    return bool(requests)


def test_a_writer_that_closes_after_the_look_at_its_life_is_gone() -> None:
    """It is not one that takes no requests."""
    writer = ServiceWriter("x", SMALL, operations=OPERATIONS)
    writer.request_server()
    with ServiceReader[Sample]("x") as reader, pytest.MonkeyPatch.context() as patched:
        patched.setattr(reader._client, "listen", lambda _: writer.close())  # what is done before connecting
        with pytest.raises(PeerGone, match="the writer of 'x' is dead"):
            reader.ask("add", a=1, b=2)


def test_a_writer_whose_socket_is_withdrawn_counts_as_gone() -> None:
    """Wherever it is in its closing."""
    writer = ServiceWriter("x", SMALL, operations=OPERATIONS)
    server = writer.request_server()
    close = server.close

    def close_and_be_asked() -> None:
        close()
        with pytest.raises(PeerGone, match="the writer of 'x' is dead"):
            reader.ask("add", a=1, b=2)
        found.append(writer.closed)

    found: list[bool] = []
    with ServiceReader[Sample]("x") as reader, pytest.MonkeyPatch.context() as patched:
        patched.setattr(server, "close", close_and_be_asked)
        writer.close()
    assert found == [False]
