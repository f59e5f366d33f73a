"""Requests when one of the two is killed, stopped, forked or talks nonsense; and when there are too many."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import PeerGone, RequestTimeout
from skinware.realtime import now_ns
from skinware.service._server import short_path
from skinware_drivers.testing.waiting import wait_until
from tests.core.services import OPERATIONS, SMALL, on_request
from tests.core.workers import PATIENCE_S, PROCESSES, running

pytestmark = pytest.mark.usefixtures("process_server")


def _serve(ready: Any) -> None:
    writer = ServiceWriter("x", SMALL, operations={"pid": os.getpid, "hang": signal.pause})
    writer.request_server()
    ready.set()
    for columns in writer.on_request():
        columns["values"][:] = os.getpid()


@contextmanager
def served() -> Iterator[Any]:
    ready = PROCESSES.Event()
    with running(_serve, ready) as process:
        assert ready.wait(PATIENCE_S)
        yield process


def test_a_killed_writer_is_a_clear_error_and_its_successor_answers(namespace: Namespace) -> None:
    with served() as first:
        reader = ServiceReader[Sample]("x")
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
    with served() as process, ServiceReader[Sample]("x") as reader:
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
    others = _sockets()  # of libraries, from their import on
    with ServiceWriter("x", SMALL, operations=OPERATIONS) as writer, ServiceReader[Sample]("x") as reader:
        writer.request_server()
        pending = reader.ask("add", a=1, b=2)
        (request,) = writer.requests(1.0)
        assert _sockets() - others
        child = os.fork()
        if child == 0:
            os._exit(len(_sockets() - others))
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        request.reply(3)
        assert pending.result(5.0).result == 3


def _sockets() -> set[str]:
    targets = {_target(fd) for fd in os.listdir("/proc/self/fd")}
    return {target for target in targets if target.startswith("socket:")}


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
    with on_request(), ServiceReader[Sample]("x") as reader, raw_connection(namespace) as connection:
        connection.send(packet)
        assert connection.recv(100) == b""
        assert reader.call("add", a=1, b=2) == 3


def test_a_peer_that_reads_no_answers_is_dropped_and_holds_nobody_up(namespace: Namespace) -> None:
    with on_request(), ServiceReader[Sample]("x") as reader, raw_connection(namespace) as connection:
        with pytest.raises((BrokenPipeError, ConnectionResetError)):
            _ask_for_ever(connection)
        assert reader.call("add", a=1, b=2) == 3


def _ask_for_ever(connection: socket.socket) -> None:
    for number in range(1_000_000):
        connection.send(b'{"id":%d,"operation":"operations"}' % number)


@pytest.mark.thorough
def test_too_many_peers(namespace: Namespace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware.service._server._IDLE_NS", 1 << 62)  # none makes room while the others connect
    with on_request(), ServiceReader[Sample]("x") as reader:
        assert reader.call("add", a=1, b=2) == 3
        connections = []
        for _ in range(100):
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            connection.settimeout(10.0)
            wait_until(lambda connection=connection: _connected(connection, namespace))  # type: ignore[misc]
            connections.append(connection)
        for connection in connections[64:]:
            assert b"64 programs are connected" in connection.recv(1 << 12)
            assert connection.recv(1) == b""
        assert reader.call("add", a=1, b=2) == 3
        for connection in connections:
            connection.close()
        with ServiceReader[Sample]("x") as another:
            wait_until(lambda: _answers(another))


def _connected(connection: socket.socket, namespace: Namespace) -> bool:
    try:
        with short_path(namespace.socket_path("x")) as path:
            connection.connect(path)
    except BlockingIOError:  # those before it have not been let in yet
        return False
    return True


def _answers(reader: ServiceReader[Sample]) -> bool:
    try:
        return bool(reader.call("add", a=1, b=2) == 3)
    except PeerGone:  # the writer has not yet noticed that the others hung up
        return False
