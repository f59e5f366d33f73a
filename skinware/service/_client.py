"""The other end of requests: ask a service for something, and never take an old answer for a new one."""

from __future__ import annotations

import contextlib
import itertools
import select
import socket
from collections.abc import Callable
from typing import Any

import msgspec

from skinware.errors import (
    Paused,
    PeerGone,
    RequestCancelled,
    RequestError,
    RequestFailed,
    RequestRefused,
    RequestTimeout,
)
from skinware.memory.locks import ForkGuard
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns
from skinware.service._server import short_path
from skinware.service.messages import CANCEL, ENCODING_ERRORS, MAX_PACKET, TO_ALL, Answer, Ask, decode, receive

_ERRORS: dict[str, type[Exception]] = {
    "refused": RequestRefused,
    "failed": RequestFailed,
    "paused": Paused,
    "cancelled": RequestCancelled,
}


class PendingRequest:
    """A request that was sent. Use it in one thread at a time.

    Attributes:
        operation: what was asked for.
    """

    def __init__(self, client: RequestClient, connection: socket.socket, number: int, operation: str) -> None:
        self.operation = operation
        self._client = client
        self._connection = connection
        self._id = number
        self._answer: Answer | RequestError | None = None

    def done(self) -> bool:
        """Return whether ``result`` comes at once."""
        self._client.listen(0.0)
        return self._answer is not None

    def result(self, timeout_s: float, is_over: Callable[[], bool] = lambda: False) -> Answer:
        """Wait for the answer, unless ``is_over``: then the request is cancelled.

        Raises:
            RequestTimeout: none came in time; the request is then cancelled.
            Paused, RequestRefused, RequestFailed, RequestCancelled: what the service answered.
            PeerGone: the service died, was closed or restarted meanwhile.
        """
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        answer = self._answer
        while answer is None:
            if is_over():
                self.cancel()
            remaining_ns = deadline_ns - now_ns()
            self._client.listen(max(0, min(remaining_ns, WAIT_SLICE_NS)) / NS_PER_S)
            answer = self._answer
            if answer is None and remaining_ns <= 0:
                self.cancel()
                raise RequestTimeout(
                    f"{self._client.name}: no answer to {self.operation!r} within {timeout_s:g} s;"
                    " its writer is running but does not take requests now (busy, hung or stopped)"
                )
        if isinstance(answer, RequestError):
            raise answer
        if answer.error is not None:
            raise _ERRORS.get(answer.why, RequestFailed)(f"{self._client.name}: {answer.error}")
        return answer

    def cancel(self) -> None:
        """Take it back; what was begun may still be carried out. Nothing happens if it was answered."""
        if self._answer is None:
            self._answer = RequestCancelled(f"{self._client.name}: {self.operation!r} was cancelled")
            self._client.forget(self._connection, self._id)

    def deliver(self, answer: Answer | RequestError) -> None:
        """Called by the client."""
        if self._answer is None:
            self._answer = answer


class RequestClient(ForkGuard):
    """A connection to one service, made when it is first needed and again after the service's return."""

    def __init__(self, namespace: Namespace, name: str) -> None:
        self.name = name
        self._namespace = namespace
        self._connection: socket.socket | None = None
        self._numbers = itertools.count(1)
        self._pending: dict[int, PendingRequest] = {}
        super().__init__()

    def send(self, operation: str, arguments: dict[str, Any]) -> PendingRequest:
        number = next(self._numbers)
        try:
            packet = msgspec.json.encode(Ask(number, operation, msgspec.Raw(msgspec.json.encode(arguments))))
        except ENCODING_ERRORS as error:
            raise RequestRefused(f"{self.name}: the arguments of {operation!r} cannot be sent: {error}") from None
        if len(packet) > MAX_PACKET:
            raise RequestRefused(f"{self.name}: a request of {len(packet)} bytes; at most {MAX_PACKET}")
        self.listen(0.0)  # notices a hang-up
        connection = self._connection or self._connect()
        try:
            connection.send(packet, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except BlockingIOError:
            raise RequestTimeout(f"{self.name}: its writer has not taken the requests before this one") from None
        except OSError:
            with contextlib.suppress(BlockingIOError):
                if refusal := self._refusal(decode(receive(connection), Answer)):
                    self._lose()
                    raise refusal from None
            self._lose()
            raise PeerGone(f"{self.name}: its writer died or was closed") from None
        pending = self._pending[number] = PendingRequest(self, connection, number, operation)
        return pending

    def listen(self, timeout_s: float) -> None:
        """Take the answers that have come, waiting for the first."""
        connection = self._connection
        if connection is None:
            return
        poll = select.poll()
        poll.register(connection, select.POLLIN)
        while poll.poll(timeout_s * 1000):
            timeout_s = 0.0
            try:
                answer = decode(receive(connection), Answer)
            except BlockingIOError:
                return
            if answer is None:
                self._lose()
                return
            if refusal := self._refusal(answer):
                self._lose(refusal)
                return
            pending = self._pending.pop(answer.id, None)  # None: cancelled, or too late
            if pending is not None:
                pending.deliver(answer)

    def forget(self, connection: socket.socket, number: int) -> None:
        if self._pending.pop(number, None) is None or connection is not self._connection:
            return
        try:
            packet = msgspec.json.encode(Ask(number, CANCEL))
            connection.send(packet, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except BlockingIOError:
            pass  # its answer will be dropped
        except OSError:
            self._lose()

    def close(self) -> None:
        self._lose()

    abandon = close

    def _connect(self) -> socket.socket:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
        connection.setblocking(False)
        with contextlib.ExitStack() as on_error:
            on_error.enter_context(connection)
            try:
                with short_path(self._namespace.socket_path(self.name)) as path:
                    connection.connect(path)
            except FileNotFoundError:
                raise RequestRefused(f"service {self.name!r} takes no requests") from None
            except ConnectionRefusedError:
                raise PeerGone(f"the writer of {self.name!r} is dead") from None
            except BlockingIOError:
                raise RequestTimeout(f"{self.name}: too many programs are waiting for its writer") from None
            except PermissionError:
                raise RequestRefused(
                    f"you may not send requests to {self.name!r}: only its owner and the namespace's group may"
                ) from None
            on_error.pop_all()
        self._connection = connection
        return connection

    def _refusal(self, answer: Answer | None) -> RequestRefused | None:
        """Why the service takes nothing from this connection, if it says so."""
        if answer is None or answer.id != TO_ALL:
            return None
        return RequestRefused(f"{self.name}: {answer.error}")

    def _lose(self, why: RequestRefused | None = None) -> None:
        connection, self._connection = self._connection, None
        pending, self._pending = self._pending, {}
        if connection is not None:
            connection.close()
        for request in pending.values():
            request.deliver(
                why
                or PeerGone(
                    f"{self.name}: its writer died or was restarted; {request.operation!r} may not have been done"
                )
            )
