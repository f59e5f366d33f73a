"""The writer's end of requests: a socket beside the ring that never waits for a peer."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
from collections.abc import Mapping
from typing import Any

import msgspec

from skinware.errors import NamespaceError
from skinware.memory._locks import ForkGuard
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.service.messages import (
    ACQUIRE,
    CANCEL,
    MAX_PACKET,
    OPERATIONS,
    UNSPEAKABLE,
    Answer,
    Ask,
    receive,
)

_MAX_PEERS = 64
_MAX_PEERS_OF_A_STRANGER = 16
_PACKETS_PER_TURN = 32
_TURNS = 8
_CREDENTIALS = struct.Struct("iII")  # struct ucred: pid, uid, gid


class Request:
    """One request that waits for its answer: ``reply`` or ``fail``, once.

    Attributes:
        operation: what is asked for.
        arguments: by name.
        cancelled: nobody waits for the answer any more.
    """

    def __init__(self, server: RequestServer, peer: socket.socket, ask: Ask) -> None:
        self.operation: str = ask.operation
        self.arguments: dict[str, Any] = ask.arguments
        self.cancelled = False
        self._server = server
        self._peer = peer
        self._id = ask.id

    def reply(self, result: Any = None, position: tuple[int, int] = (0, 0)) -> None:
        """Answer it.

        Args:
            result: anything that JSON can hold.
            position: (generation, sequence) of the frame that goes with it.
        """
        try:
            msgspec.json.encode(result)
        except UNSPEAKABLE as error:
            self.fail(f"its result cannot be sent: {error}")
        else:
            self._send(Answer(self._id, *position, result=result))

    def fail(self, error: str, why: str = "failed") -> None:
        """Answer that it went wrong (``failed``), or is not done at all (``refused``, ``paused``)."""
        error = error.encode(errors="backslashreplace").decode()  # a file name in it may be no text
        self._send(Answer(self._id, error=error, why=why))  # type: ignore[arg-type]

    def _send(self, answer: Answer) -> None:
        self._server.answer(self._peer, self._id, None if self.cancelled else answer)


class RequestServer(ForkGuard):
    """Takes requests for one service. Nothing here blocks; a peer that does not read its answers is dropped.

    Args:
        namespace: where the service is.
        name: of the service; the caller owns it.
        operations: descriptions of the operations that the service declares.

    Raises:
        NamespaceError: the socket cannot be made.
    """

    def __init__(self, namespace: Namespace, name: str, operations: Mapping[str, str]) -> None:
        super().__init__()
        self.operations: dict[str, str] = dict(operations)
        self.paused = False
        self._path = namespace.socket_path(name)
        self._inode = 0
        self._peers: dict[int, socket.socket] = {}
        self._users: dict[int, int] = {}  # of the peers
        self._open: dict[tuple[int, int], Request] = {}
        self._epoll = select.epoll()
        self._listener = self._listen()

    def renew(self) -> None:
        """Make the socket's file again, after somebody removed it; connections stay."""
        self._epoll.unregister(self._listener)
        self._listener.close()
        self._listener = self._listen()

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

    def take(self, timeout_s: float = 0.0) -> list[Request]:
        """The requests that have arrived.

        Args:
            timeout_s: longest wait for one.
        """
        found: list[Request] = []
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        for _ in range(_TURNS):  # one to accept, one to hear; then others want their turn, however busy the peers
            if self._epoll.closed:
                break
            events = self._epoll.poll(max(0, deadline_ns - now_ns()) / NS_PER_S)
            share = max(1, _PACKETS_PER_TURN // max(1, len(events)))  # however many ask, the writer's loop goes on
            for fd, _ in events:
                if fd == self._listener.fileno():
                    self._accept()
                elif fd in self._peers:
                    found += self._hear(self._peers[fd], share)
            if found or not events:
                break
        return [request for request in found if not request.cancelled]

    def answer(self, peer: socket.socket, number: int, answer: Answer | None) -> None:
        """Send an answer, once; None: nobody waits for it."""
        if self._open.pop((peer.fileno(), number), None) is None or answer is None:
            return
        packet = msgspec.json.encode(answer)
        if len(packet) > MAX_PACKET:
            text = f"the answer takes {len(packet)} bytes; at most {MAX_PACKET}"
            packet = msgspec.json.encode(Answer(number, error=text, why="failed"))
        try:
            peer.send(packet, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:
            self._drop(peer)

    def close(self) -> None:
        """Take no more requests; those that wait are told by the hang-up. Idempotent."""
        if not self._epoll.closed:
            with contextlib.suppress(FileNotFoundError):
                if os.lstat(self._path).st_ino == self._inode:  # not the socket of somebody who came after us
                    self._path.unlink()
        self.abandon()

    def abandon(self) -> None:
        """See :class:`skinware.memory._locks.ForkGuard`."""
        for peer in self._peers.values():
            peer.close()
        self._peers, self._users, self._open = {}, {}, {}
        self._listener.close()
        self._epoll.close()

    def _accept(self) -> None:
        for _ in range(_MAX_PEERS):
            try:
                peer, _ = self._listener.accept()
            except OSError:
                return
            user = _user_of(peer)
            stranger = user != os.geteuid()
            of_this_user = sum(other == user for other in self._users.values())
            if len(self._peers) >= _MAX_PEERS or (stranger and of_this_user >= _MAX_PEERS_OF_A_STRANGER):
                peer.close()
                continue
            peer.setblocking(False)
            self._peers[peer.fileno()], self._users[peer.fileno()] = peer, user
            self._epoll.register(peer, select.EPOLLIN)

    def _hear(self, peer: socket.socket, limit: int) -> list[Request]:
        found: list[Request] = []
        for _ in range(limit):  # one peer that never stops asking must not hold up the others
            try:
                ask = receive(peer, Ask)
            except BlockingIOError:
                return found
            if ask is None:
                self._drop(peer)
                return found
            request = self._received(peer, ask)
            if request is not None:
                found.append(request)
        return found

    def _received(self, peer: socket.socket, ask: Ask) -> Request | None:
        key = peer.fileno(), ask.id
        if ask.operation == CANCEL:
            if key in self._open:
                self._open[key].cancelled = True
                self.answer(peer, ask.id, Answer(ask.id, error="cancelled", why="cancelled"))
            return None
        request = self._open[key] = Request(self, peer, ask)
        if ask.operation == OPERATIONS:
            request.reply(self.operations)
        elif self.paused:
            request.fail("the service is paused", "paused")
        elif ask.operation != ACQUIRE and ask.operation not in self.operations:
            there_are = ", ".join(self.operations) or "none"
            request.fail(f"no operation {ask.operation!r}; there are: {there_are}", "refused")
        else:
            return request
        return None

    def _drop(self, peer: socket.socket) -> None:
        fd = peer.fileno()
        if self._peers.pop(fd, None) is None:
            return
        del self._users[fd]
        for key in [key for key in self._open if key[0] == fd]:
            self._open.pop(key).cancelled = True
        self._epoll.unregister(fd)
        peer.close()


def _user_of(peer: socket.socket) -> int:
    credentials = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    user: int = _CREDENTIALS.unpack(credentials)[1]
    return user


class short_path:  # noqa: N801
    """A name for a path that fits into a socket address, whose 107 bytes are soon full: by way of its open folder."""

    def __init__(self, path: os.PathLike[str]) -> None:
        folder, self._name = os.path.split(os.fspath(path))
        self._fd = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)

    def __enter__(self) -> str:
        return f"/proc/self/fd/{self._fd}/{self._name}"

    def __exit__(self, *_: object) -> None:
        os.close(self._fd)
