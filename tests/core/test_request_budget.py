"""What requests may cost a writer: a bounded time and number of bytes a turn, whoever asks and whatever is sent."""

from __future__ import annotations

import contextlib
import os
import resource
import select
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import RequestRefused
from skinware.service import RequestServer, _server
from skinware.service._server import MOST_TURN_NS
from skinware.service.messages import decode_arguments
from tests.core.services import SMALL, connect


def echo(value: object) -> object:
    """Say it again."""
    return value


@contextlib.contextmanager
def serving(peers: int = 0) -> Iterator[tuple[ServiceWriter, RequestServer, list[socket.socket]]]:
    """A writer, its server, and so many connections that were let in."""
    with contextlib.ExitStack() as stack:
        writer = stack.enter_context(ServiceWriter("x", SMALL, operations={"echo": echo}))
        server = writer.request_server()
        made = [stack.enter_context(connect()) for _ in range(peers)]
        while len(server._peers) < peers:
            assert server.take() == []
        yield writer, server, made


def ask(peer: socket.socket, number: int, value: object = 0) -> None:
    peer.send(msgspec.json.encode({"id": number, "operation": "echo", "arguments": {"value": value}}))


def test_a_turn_ends_with_its_time_and_every_peer_is_heard_before_any_is_heard_again() -> None:
    with serving(3) as (_, server, peers):
        for peer, name in zip(peers, "abc", strict=True):
            for number in range(4):
                ask(peer, number, name)
        server.turn_ns = 0  # over as soon as it has begun
        turns = [server.take() for _ in range(12)]
        assert [len(turn) for turn in turns] == [1] * 12
        heard = [turn[0].arguments["value"] for turn in turns]
        assert all(set(heard[i : i + 3]) == set("abc") for i in range(0, 12, 3))
        assert server.take() == []


def test_a_turn_ends_with_its_bytes() -> None:
    with serving(3) as (_, server, peers):
        server.turn_ns = 10**12
        for peer in peers:
            for number in range(2):
                ask(peer, number, "x" * 30_000)
        assert [len(server.take()) for _ in range(2)] == [3, 3]  # 65,536 bytes are in the third packet


def test_one_connection_is_let_in_at_a_time() -> None:
    with serving() as (_, server, _), contextlib.ExitStack() as stack:
        server.turn_ns = 0
        for _ in range(20):
            stack.enter_context(connect())
        for number in range(1, 21):
            assert server.take() == []
            assert len(server._peers) == number


def test_the_turns_of_a_fast_writer_are_a_tenth_of_its_period(namespace: Namespace) -> None:
    for rate_hz, turn_ns in ((1000, 100_000), (10, MOST_TURN_NS)):
        with ServiceWriter("y", SMALL) as writer:
            for _ in writer.periodic(rate_hz):
                assert writer.request_server().turn_ns == turn_ns
                writer.stop()
        with ServiceWriter("y", SMALL, rate_hz=rate_hz) as writer:
            assert writer.request_server().turn_ns == turn_ns


def test_operations_take_no_longer_than_a_turn_together() -> None:
    """However many wait: a period of the writer has room for one that lasts, not for all."""
    done: list[object] = []

    def last(value: object) -> None:
        time.sleep(0.002)
        done.append(value)

    with serving(3) as (writer, server, peers):
        writer._operations["echo"] = last
        for peer in peers:
            for number in range(4):
                ask(peer, number, number)
        server.turn_ns = 1_000_000
        assert writer.answer_requests() == []
        assert len(done) == 1


def test_a_peer_has_so_many_requests_waiting_and_no_more() -> None:
    with serving(1) as (_, server, (peer,)):
        server.turn_ns = 10**12
        for number in range(70):
            ask(peer, number)
        waiting = server.take()
        assert len(waiting) == 64
        refused = [msgspec.json.decode(peer.recv(1000)) for _ in range(6)]
        assert {(answer["why"], answer["error"]) for answer in refused} == {("refused", "64 requests wait already")}
        waiting[0].reply()
        ask(peer, 99)
        assert len(server.take()) == 1


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("x" * 5000, "arguments of 5012 bytes; at most 4096"),
        ([[]] * 200, "arguments with 202 brackets; at most 128"),
        ([{}] * 200, "arguments with 202 brackets; at most 128"),
        ("x" * 4000, ""),
        ([[]] * 100, ""),
        ([1.5] * 900, ""),
    ],
)
def test_another_users_arguments_must_be_cheap_to_decode(
    value: Any, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Decoding cannot be interrupted, and thousands of new lists wake the garbage collector."""
    monkeypatch.setattr(_server, "_user_of", lambda _: os.geteuid() + 1)
    with serving() as (writer, _, _), ServiceReader[Sample]("x") as reader:
        pending = reader.ask("echo", value=value)
        found = writer.requests(1.0)
        if words:
            assert found == []
            with pytest.raises(RequestRefused, match=f"echo: {words} from other users than the writer's"):
                pending.result(5.0)
        else:
            (request,) = found
            assert request.arguments == {"value": value}


def test_no_number_takes_long_to_decode() -> None:
    """The decoder's own way takes ten times as long before msgspec 0.23: 1 ms for 4096 bytes."""
    numbers = [2.2250738585072011e-308, 4.9e-324, 1.2345678901234567e-300] * 50
    texts, arguments = [str(number) for number in numbers], msgspec.Raw(msgspec.json.encode({"value": numbers}))

    def fastest_ns(work: Callable[[], object], result: object) -> int:
        passed = []
        for _ in range(50):
            begin_ns = time.perf_counter_ns()
            assert work() == result
            passed.append(time.perf_counter_ns() - begin_ns)
        return min(passed)

    alone_ns = fastest_ns(lambda: [float(text) for text in texts], numbers)
    assert fastest_ns(lambda: decode_arguments(arguments), {"value": numbers}) < 3 * alone_ns


def test_without_descriptors_nobody_is_let_in_and_nothing_spins() -> None:
    with serving() as (writer, server, _), ServiceReader[Sample]("x", announce=False) as reader:
        pending = reader.ask("echo", value=7)  # connected, and waits to be let in
        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        free = os.open("/dev/null", os.O_RDONLY)
        os.close(free)
        resource.setrlimit(resource.RLIMIT_NOFILE, (free, limits[1]))
        try:
            assert server.take() == []
            waiting = select.poll()
            waiting.register(server.fileno(), select.POLLIN)
            assert waiting.poll(0) == []  # an event loop would come round again and again
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        writer._next_file_check_ns = 0  # now instead of within a second
        (request,) = writer.requests(5.0)
        request.reply(request.arguments["value"])
        assert pending.result(5.0).result == 7
