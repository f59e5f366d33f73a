"""The writer's end of requests: a socket beside the ring that never waits for a peer."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from skinware.errors import NamespaceError
from skinware.memory.locks import ForkGuard
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.service.messages import (
    ACQUIRE,
    CANCEL,
    ENCODING_ERRORS,
    MAX_PACKET,
    OPERATIONS,
    TO_ALL,
    Answer,
    Ask,
    decode,
    decode_arguments,
    receive,
)
from skinware.text import nearest_name

_MAX_PEERS = 64
_MAX_PEERS_OF_A_STRANGER = 16
_MAX_OPEN_OF_A_PEER = 64
_IDLE_NS = 10 * NS_PER_S
"""A program that asks for nothing for so long makes room for another; its client connects again when it asks."""
_MAX_BYTES_OF_A_STRANGER = 1 << 12
_MAX_PARTS_OF_A_STRANGER = 128
MOST_TURN_NS = 1_000_000
"""The longest turn; one of a fast writer is a tenth of its period."""
_TURN_BYTES = 1 << 16
_CREDENTIALS = struct.Struct("iII")  # struct ucred: pid, uid, gid


@dataclass(eq=False, slots=True)
class _Peer:
    connection: socket.socket
    user: int
    is_stranger: bool
    heard_ns: int
    open: dict[int, Request] = field(default_factory=dict)


class Request:
    """A request that waits for its answer: call ``reply`` or ``fail`` once.

    Attributes:
        operation: what is asked for.
        arguments: by name.
        cancelled: the answer is no longer wanted.
    """

    def __init__(self, server: RequestServer, peer: _Peer, ask: Ask) -> None:
        self.operation: str = ask.operation
        self.arguments: dict[str, Any] = {}
        self.cancelled = False
        self._server = server
        self._peer = peer
        self._id = ask.id

    def reply(self, result: Any = None, position: tuple[int, int] = (0, 0)) -> None:
        """Answer it.

        Args:
            result: anything that JSON can hold.
            position: (generation, sequence) of the sample that goes with it.
        """
        try:
            encoded = msgspec.json.encode(result)
        except ENCODING_ERRORS as error:
            self.fail(f"its result cannot be sent: {error}")
        else:
            self._send(Answer(self._id, *position, result=msgspec.Raw(encoded)))

    def fail(self, error: str, why: str = "failed") -> None:
        """Answer that it went wrong (``failed``), or is not done at all (``refused``, ``paused``)."""
        error = error.encode(errors="backslashreplace").decode()  # a file name in it may be no text
        self._send(Answer(self._id, error=error, why=why))  # type: ignore[arg-type]

    def _send(self, answer: Answer) -> None:
        self._server.answer(self._peer, self._id, None if self.cancelled else answer)


class RequestServer(ForkGuard):
    """Takes requests for one service. Nothing here blocks; a peer that does not read its answers is dropped.

    What it does in one turn is bounded in time and in bytes, whatever the peers send: the writer's own work goes on.
    Packets of other users than the writer's are small: what one costs, it costs before anybody can look at a clock.

    Args:
        operations: descriptions of the operations that the service declares.

    Attributes:
        paused: requests are refused, but those of ``while_paused``.
        while_paused: names of operations that are carried out also then.
        why_no_others: part of the answer to a request for an operation that is not declared; may be empty.
        turn_ns: how long one turn may take; at most one packet is begun before it is over and ends after it.

    Raises:
        NamespaceError: the socket cannot be made.
    """

    def __init__(self, namespace: Namespace, name: str, operations: Mapping[str, str]) -> None:
        self.operations: dict[str, str] = dict(operations)
        self.paused = False
        self.while_paused: Collection[str] = ()
        self.why_no_others = ""
        self.turn_ns = MOST_TURN_NS
        self._path = namespace.socket_path(name)
        self._inode = 0
        self._peers: dict[int, _Peer] = {}
        self._epoll = select.epoll()
        self._hears_of_peers = True
        self._bytes_left = 0  # of this turn
        self._listener = self._listen()
        super().__init__()

    def fit_into(self, period_ns: int) -> None:
        """Keep turns short enough for a writer of this period."""
        self.turn_ns = min(MOST_TURN_NS, period_ns // 10)

    def keep(self) -> None:
        """Make the socket's file again if somebody removed it, and let peers in that could not be let in before."""
        try:
            is_there = os.lstat(self._path).st_ino == self._inode
        except OSError:
            is_there = False
        if not is_there:
            removed, self._listener = self._listener, self._listen()  # connections stay
            self._epoll.unregister(removed)
            removed.close()
        elif not self._hears_of_peers:
            self._epoll.modify(self._listener, select.EPOLLIN)
        self._hears_of_peers = True

    def _listen(self) -> socket.socket:
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        temporary = self._path.with_name(f".{self._path.name}")
        try:
            with short_path(temporary) as path:
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(path)
                listener.bind(path)
                os.chmod(path, 0o660)
                listener.listen(_MAX_PEERS)
            os.rename(temporary, self._path)
            self._inode = os.lstat(self._path).st_ino
            self._epoll.register(listener, select.EPOLLIN)
        except OSError as error:
            listener.close()
            raise NamespaceError(f"cannot make the request socket {self._path}: {error.strerror}") from None
        return listener

    def fileno(self) -> int:
        """Readable when ``take`` has something to do; -1 once closed."""
        return -1 if self._epoll.closed else self._epoll.fileno()

    def take(self, timeout_s: float = 0.0, *, at_most: int | None = None) -> list[Request]:
        """Return the requests that have arrived, as many as fit into one turn; wait for the first."""
        found: list[Request] = []
        wait_until_ns = now_ns() + round(timeout_s * NS_PER_S)
        self._bytes_left, end_ns = _TURN_BYTES, 0
        while not self._epoll.closed and len(found) != at_most:
            wait_s = 0.0 if found else max(0, wait_until_ns - now_ns()) / NS_PER_S
            events = self._epoll.poll(wait_s, 1)  # one at a time: every peer is heard before any is heard again
            if not events:
                break
            end_ns = end_ns or now_ns() + self.turn_ns
            fd = events[0][0]
            if fd == self._listener.fileno():
                self._accept()
            elif fd in self._peers:
                request = self._hear(self._peers[fd])
                if request is not None:
                    found.append(request)
            time_ns = now_ns()
            if (self._bytes_left <= 0 or time_ns >= end_ns) and (found or time_ns >= wait_until_ns):
                break
        return [request for request in found if not request.cancelled]

    def answer(self, peer: _Peer, number: int, answer: Answer | None) -> None:
        """Send an answer, once; None: it is not wanted."""
        if peer.open.pop(number, None) is None or answer is None:
            return
        packet = msgspec.json.encode(answer)
        if len(packet) > MAX_PACKET:
            text = f"the answer takes {len(packet)} bytes; at most {MAX_PACKET}"
            packet = msgspec.json.encode(Answer(number, error=text, why="failed"))
        try:
            peer.connection.send(packet, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:
            self._drop(peer)

    def close(self) -> None:
        """Take no more requests; the hang-up ends those that wait. Idempotent."""
        if not self._epoll.closed:
            with contextlib.suppress(FileNotFoundError):
                if os.lstat(self._path).st_ino == self._inode:  # not the socket of somebody who came after us
                    self._path.unlink()
        self.abandon()

    def abandon(self) -> None:
        """See :class:`skinware.memory.locks.ForkGuard`."""
        for peer in self._peers.values():
            peer.connection.close()
        self._peers = {}
        self._listener.close()
        self._epoll.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except BlockingIOError:
            return  # it has hung up already
        except OSError:  # no descriptors or no memory: asked again and again, it would only cost time
            self._hears_of_peers = False
            self._epoll.modify(self._listener, 0)
            return
        user = _user_of(connection)
        stranger = user != os.geteuid()
        connection.setblocking(False)
        if full := self._is_full_for(user, stranger):
            with contextlib.suppress(OSError):
                connection.send(msgspec.json.encode(Answer(TO_ALL, error=full, why="refused")), socket.MSG_NOSIGNAL)
            connection.close()
            return
        self._peers[connection.fileno()] = _Peer(connection, user, stranger, now_ns())
        self._epoll.register(connection, select.EPOLLIN)

    def _is_full_for(self, user: int, stranger: bool) -> str:
        """Why one more program cannot be connected; empty if it can, where the one that is idle longest makes room."""
        others, most = list(self._peers.values()), _MAX_PEERS
        if stranger and len(others) < most:
            others, most = [peer for peer in others if peer.user == user], _MAX_PEERS_OF_A_STRANGER
        if len(others) < most:
            return ""
        idle = [peer for peer in others if not peer.open and now_ns() - peer.heard_ns >= _IDLE_NS]
        if not idle:
            return f"{most} programs are connected to it, and each has asked for something lately"
        self._drop(min(idle, key=lambda peer: peer.heard_ns))
        return ""

    def _hear(self, peer: _Peer) -> Request | None:
        try:
            packet = receive(peer.connection)
        except BlockingIOError:
            return None
        peer.heard_ns = now_ns()
        self._bytes_left -= len(packet)
        ask = decode(packet, Ask)
        if ask is None:
            self._drop(peer)
            return None
        if ask.operation == CANCEL:
            if ask.id in peer.open:
                peer.open[ask.id].cancelled = True
                self.answer(peer, ask.id, Answer(ask.id, error="cancelled", why="cancelled"))
            return None
        is_too_much = len(peer.open) >= _MAX_OPEN_OF_A_PEER
        request = peer.open[ask.id] = Request(self, peer, ask)
        if ask.operation == OPERATIONS:
            request.reply(self.operations)
        elif self.paused and ask.operation not in self.while_paused:
            request.fail("the service is paused", "paused")
        elif is_too_much:
            request.fail(f"{_MAX_OPEN_OF_A_PEER} requests wait already", "refused")
        elif ask.operation == ACQUIRE:
            return request
        elif ask.operation not in self.operations:
            why = f" ({self.why_no_others})" if self.why_no_others else ""
            request.fail(
                f"no operation {ask.operation!r}{why}{nearest_name(ask.operation, self.operations)}", "refused"
            )
        elif peer.is_stranger and (why := _too_costly(ask.arguments)):
            request.fail(f"{ask.operation}: {why}", "refused")
        elif (arguments := decode_arguments(ask.arguments)) is None:
            self._drop(peer)
        else:
            request.arguments = arguments
            return request
        return None

    def _drop(self, peer: _Peer) -> None:
        fd = peer.connection.fileno()
        if self._peers.pop(fd, None) is None:
            return
        for request in peer.open.values():
            request.cancelled = True
        peer.open.clear()
        self._epoll.unregister(fd)
        peer.connection.close()


def _too_costly(arguments: msgspec.Raw) -> str:
    """Why arguments are not decoded for another user; empty if they are.

    Python's garbage collector wakes up after some 700 new lists and objects, and may then take milliseconds.
    """
    text = bytes(arguments)
    if len(text) > _MAX_BYTES_OF_A_STRANGER:
        return f"arguments of {len(text)} bytes; at most {_MAX_BYTES_OF_A_STRANGER} from other users than the writer's"
    parts = text.count(b"[") + text.count(b"{")
    if parts > _MAX_PARTS_OF_A_STRANGER:
        return f"arguments with {parts} brackets; at most {_MAX_PARTS_OF_A_STRANGER} from other users than the writer's"
    return ""


def _user_of(peer: socket.socket) -> int:
    credentials = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    user: int = _CREDENTIALS.unpack(credentials)[1]
    return user


@contextlib.contextmanager
def short_path(path: os.PathLike[str]) -> Iterator[str]:
    """Return a name for a path that fits into a socket address, whose 107 bytes are soon full: by its open folder."""
    folder, name = os.path.split(os.fspath(path))
    fd = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{fd}/{name}"
    finally:
        os.close(fd)
