"""Real websocket servers, of the package websockets, in a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from tests.streams.peers import LOCAL

Handler = Callable[[ServerConnection], None]


class WebServer:
    """A server.

    It closes a connection with the code 1011 when its handler fails, and when a caller does not answer pings; so it
    sends none unless a test is about that, and a handler that failed is raised by ``close``.

    Args:
        handler: of each connection; ends with it.
        port: 0: any.
        pinging: ``ping_interval`` and ``ping_timeout``, s.

    Attributes:
        port: at which it listens.
        callers: how often it was called.
    """

    def __init__(self, handler: Handler, port: int = 0, **pinging: float) -> None:
        self.callers = 0
        self._handler = handler
        self._failures: list[Exception] = []
        self._threads: list[threading.Thread] = []
        options: dict[str, Any] = {"ping_interval": None, **pinging}
        self._server = serve(self._handle, LOCAL, port, compression=None, **options)
        self.port: int = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def bus(self) -> str:
        return f"websocket:ws://{LOCAL}:{self.port}"

    def close(self) -> None:
        self._server.shutdown()
        for thread in (self._thread, *self._threads):
            thread.join(30)
        if self._failures:
            raise self._failures[0]

    def _handle(self, connection: ServerConnection) -> None:
        self._threads.append(threading.current_thread())
        self.callers += 1
        try:
            self._handler(connection)
        except ConnectionClosed:  # by a caller that has gone
            raise
        except Exception as error:
            self._failures.append(error)
            raise


@contextmanager
def web_server(handler: Handler, port: int = 0, **pinging: float) -> Iterator[WebServer]:
    """Serves until it is over; see :class:`WebServer`."""
    server = WebServer(handler, port, **pinging)
    try:
        yield server
    finally:
        server.close()


def says(*messages: str | bytes) -> Handler:
    """Sends these, and waits until the caller goes."""

    def handle(connection: ServerConnection) -> None:
        for message in messages:
            connection.send(message)
        for _ in connection:
            pass

    return handle
