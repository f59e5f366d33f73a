"""Websockets as buses that are only read, with servers of the package websockets at the other end."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from websockets.protocol import State
from websockets.sync.server import ServerConnection

from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware_drivers.bus import FrameBatch
from skinware_drivers.registry import make_bus
from skinware_drivers.serial.delimited import LINES, Delimited
from skinware_drivers.streams.websocket import WebSocketBus
from skinware_drivers.testing.waiting import wait_until
from tests.streams.peers import LOCAL, free_port, received, server, why_lost
from tests.streams.webservers import Handler, WebServer, says, web_server

TEXT = Delimited(stuffing=LINES, maximum_body=200, trusts_first=True)


@contextmanager
def opened(name: str, rows: int = 100) -> Iterator[tuple[WebSocketBus, FrameBatch]]:
    bus = make_bus(name, payload_size=200)
    assert isinstance(bus, WebSocketBus)
    bus.use(TEXT)
    bus.open()
    try:
        yield bus, FrameBatch(rows, 200)
    finally:
        bus.close()


@contextmanager
def heard(handler: Handler, query: str = "") -> Iterator[tuple[WebSocketBus, FrameBatch, WebServer]]:
    with web_server(handler) as there, opened(there.bus + query) as (bus, batch):
        yield bus, batch, there


def lines(batch: FrameBatch) -> list[bytes]:
    rows = batch.wire[batch.start : batch.stop]
    return [row["payload"].tobytes()[: row["length"]] for row in rows]


def take(bus: WebSocketBus, batch: FrameBatch, count: int) -> list[bytes]:
    """So many frames."""
    return received(bus, batch, lines, count)


def test_each_message_is_a_line_whatever_is_in_it() -> None:
    with heard(says("one", "two\nlines", b"bytes", "")) as (bus, batch, _):
        counters = bus.counters

        def all_heard() -> bool:
            bus.receive(batch, 0)
            return (counters.frames, counters.framing.idle_bytes) == (3, 1)

        wait_until(all_heard)
        assert lines(batch) == [b"one", b"two lines", b"bytes"]
        assert counters.refused == 0


def test_messages_in_fragments_are_put_together() -> None:
    def handle(connection: ServerConnection) -> None:
        connection.send(["a ", "message ", "in pieces"])
        connection.send("another")
        for _ in connection:
            pass

    with heard(handle) as (bus, batch, _):
        assert take(bus, batch, 2) == [b"a message in pieces", b"another"]


def test_more_messages_than_a_batch_holds_stay_and_keep_the_bus_readable() -> None:
    count = 700
    with web_server(says(*(str(number) for number in range(count)))) as there, opened(there.bus, 16) as (bus, batch):
        found: list[bytes] = []

        def enough() -> bool:
            batch.clear()
            bus.receive(batch, 0)
            found.extend(lines(batch))
            return len(found) == count

        wait_until(enough)
        assert found == [str(number).encode() for number in range(count)]


def test_a_message_that_is_too_long_is_left_out_and_counted() -> None:
    counted = threading.Event()

    def handle(connection: ServerConnection) -> None:
        connection.send("x" * 70_000)
        counted.wait(30)
        says("short", "y" * 65_535, "z" * 150)(connection)

    with heard(handle) as (bus, batch, _):
        wait_until(lambda: bus.receive(batch, 0) == 0 and bus.counters.refused == 1)
        counted.set()
        assert take(bus, batch, 2) == [b"short", b"z" * 150]
        assert (bus.counters.refused, bus.counters.framing.refused) == (1, 1), "the second was no frame"


def test_one_that_is_far_too_long_ends_the_connection_with_its_code() -> None:
    with heard(says("x" * (1 << 20) + "x")) as (bus, batch, _):
        assert "1009" in why_lost(bus, batch)
        assert bus.counters.refused == 1


@pytest.mark.parametrize(("code", "reason"), [(1000, ""), (1001, "going home"), (1011, "ill"), (4321, "own")])
def test_a_server_that_closes_is_quoted(code: int, reason: str) -> None:
    def handle(connection: ServerConnection) -> None:
        connection.send("last words")
        connection.close(code, reason)

    with heard(handle) as (bus, batch, there):
        why = why_lost(bus, batch)
        assert f"the server has closed the connection: {code}" in why
        assert reason in why
        assert lines(batch) == [b"last words"]
        bus.close()
        bus.open()
        wait_until(lambda: there.callers == 2)


def test_pings_that_were_answered_too_late_are_told() -> None:
    """By a driver that is held up: the server gives it up."""
    connections: list[ServerConnection] = []

    def handle(connection: ServerConnection) -> None:
        connections.append(connection)
        says("only this")(connection)

    with web_server(handle, ping_interval=0.01, ping_timeout=0.05) as there, opened(there.bus) as (bus, batch):
        wait_until(lambda: bool(connections) and connections[0].state is not State.OPEN)
        why = why_lost(bus, batch)
        assert "the server has closed the connection: 1011 (internal error) keepalive ping timeout" in why
        assert "answered its pings too late" in why
        assert lines(batch) == [b"only this"]
        assert connections[0].keepalive_thread is not None
        connections[0].keepalive_thread.join()  # the server does not wait for it


def test_half_a_message_is_none_and_counted() -> None:
    def handle(connection: ServerConnection) -> None:
        def pieces() -> Iterator[str]:
            yield "half a "
            linger = struct.pack("ii", 1, 0)
            connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            connection.socket.shutdown(socket.SHUT_RDWR)
            yield "message"

        try:
            connection.send("whole")
            connection.send(pieces())
        except Exception:  # noqa: BLE001 - the connection that it has cut itself
            return

    with heard(handle) as (bus, batch, _):
        assert "without a word" in (why := why_lost(bus, batch)) or "lost" in why
        assert lines(batch) == [b"whole"]
        assert bus.counters.refused == 1


def test_a_server_that_says_nothing_any_more_is_called_again() -> None:
    with heard(says("only this"), "?silence_s=0.2") as (bus, batch, _):
        take(bus, batch, 1)

        def silent() -> bool:
            try:
                bus.check()
            except BusNotAvailable as error:
                return "no message for 0.2 s" in str(error)
            return False

        wait_until(silent)
    with heard(says("only this"), "?silence_s=0") as (bus, batch, _):
        take(bus, batch, 1)
        bus.check()


def test_nothing_is_ever_sent_but_answers_to_pings() -> None:
    got: list[str | bytes] = []
    ponged = threading.Event()

    def handle(connection: ServerConnection) -> None:
        connection.ping().wait(30)
        ponged.set()
        got.extend(connection)

    with heard(handle) as (bus, batch, _):
        wait_until(lambda: bus.receive(batch, 0) == 0 and ponged.is_set())
        with pytest.raises(BusSendError, match="only read"):
            bus.send(1, b"x")
        assert bus.counters.send_failures == 1
    assert got == []


def test_who_is_no_websocket_server_is_told() -> None:
    with pytest.raises(BusNotAvailable, match="nothing listens at this port"):
        with opened(f"websocket:ws://{LOCAL}:{free_port()}"):
            pass
    with server() as other:

        def answer() -> None:
            caller = other.answer()
            other.hear(20)
            caller.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")
            caller.shutdown(socket.SHUT_WR)

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(BusNotAvailable, match="no websocket server answers there"):
            with opened(f"websocket:ws://{LOCAL}:{other.port}"):
                pass
        thread.join(30)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("websocket:wss://host:1", "there is no wss"),
        ("websocket:host:1", "write websocket:ws://HOST:PORT"),
        ("websocket:ws://:1", "which host"),
        ("websocket:ws://host:1?patience_s=0", "patience_s"),
        ("websocket:ws://host:1?baudrate=5", "baudrate"),
    ],
)
def test_names_that_are_none(name: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        make_bus(name)
