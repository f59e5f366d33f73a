"""A link that is slow: a TCP connection through which only so many bits a second go, each after a delay."""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

_PIECE = 1 << 12
_BUFFER = 1 << 16
"""Bytes in the sockets of the proxy: little waits there, as in the queue of a slow interface."""


class SlowLink:
    """Passes connections on, slowly; both ways share the rate.

    Attributes:
        port: where to connect.
        bits_per_s: how much goes through.
        flows: where it is cleared, nothing goes through, and all waits.
    """

    def __init__(self, to_port: int, bits_per_s: float, delay_s: float) -> None:
        self.bits_per_s, self._delay_s = bits_per_s, delay_s
        self.flows = threading.Event()
        self.flows.set()
        self._to_port = to_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._open: list[socket.socket] = [self._listener]
        self._threads: list[threading.Thread] = []
        self._closed = False
        self._start(self._accept)

    def cut(self) -> None:
        """End all connections."""
        for connection in self._open[1:]:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End all of it."""
        self._closed = True
        self.flows.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self.cut()
        for thread in self._threads:
            thread.join()
        for connection in self._open:
            connection.close()

    def _start(self, work: object, *arguments: object) -> None:
        thread = threading.Thread(target=work, args=arguments)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while not self._closed:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = socket.socket()
            for connection in (near, far):
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
            self._open += [near, far]
            try:
                far.connect(("127.0.0.1", self._to_port))
            except OSError:
                near.close()
                continue
            self._start(self._pump, near, far)
            self._start(self._pump, far, near)

    def _pump(self, source: socket.socket, target: socket.socket) -> None:
        due_s = time.monotonic()
        on_its_way: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
        self._start(self._deliver, on_its_way, source, target)
        data = b"-"
        while data:
            try:
                data = source.recv(_PIECE)
            except OSError:
                data = b""
            due_s = max(due_s, time.monotonic()) + 8 * len(data) / self.bits_per_s
            time.sleep(max(0.0, due_s - time.monotonic()))
            on_its_way.put((time.monotonic() + self._delay_s, data))

    def _deliver(
        self, on_its_way: queue.SimpleQueue[tuple[float, bytes]], source: socket.socket, target: socket.socket
    ) -> None:
        with contextlib.suppress(OSError):
            while True:
                due_s, data = on_its_way.get()
                time.sleep(max(0.0, due_s - time.monotonic()))
                self.flows.wait()
                if not data:
                    break
                target.sendall(data)
        for connection in (source, target):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


@contextmanager
def slow_link(to_port: int, bits_per_s: float, delay_s: float = 0.0) -> Iterator[SlowLink]:
    link = SlowLink(to_port, bits_per_s, delay_s)
    try:
        yield link
    finally:
        link.close()
