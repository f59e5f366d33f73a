"""Real websocket servers, of the package websockets, in a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from websockets.sync.server import ServerConnection, serve

from tests.streams.peers import LOCAL

Handler = Callable[[ServerConnection], None]


class WebServer:
    """A server.

    Attributes:
        port: at which it listens.
        callers: how often it was called.
    """

    def __init__(self, handler: Handler, port: int = 0) -> None:
        self.callers = 0
        self._handler = handler
        self._threads: list[threading.Thread] = []
        self._server = serve(self._handle, LOCAL, port, compression=None, ping_interval=None)
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

    def _handle(self, connection: ServerConnection) -> None:
        self._threads.append(threading.current_thread())
        self.callers += 1
        self._handler(connection)


@contextmanager
def web_server(handler: Handler, port: int = 0) -> Iterator[WebServer]:
    """Serves until it is over; handlers should end when their connection does."""
    server = WebServer(handler, port)
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
