"""Devices at the other end of a connection, and frames of buses."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from skinware.errors import BusNotAvailable
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.registry import make_bus
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.framing import Framing
from skinware_drivers.testing.waiting import wait_until
from tests.serial.lines import FRAMING

LOCAL = "127.0.0.1"
ReadT = TypeVar("ReadT")


class Server:
    """A device that waits to be called.

    Attributes:
        port: at which.
    """

    def __init__(self, port: int = 0) -> None:
        self._listener = socket.create_server((LOCAL, port))
        self._listener.settimeout(30)
        self.port: int = self._listener.getsockname()[1]
        self._callers: list[socket.socket] = []

    def answer(self) -> socket.socket:
        """The next caller."""
        caller, _ = self._listener.accept()
        caller.settimeout(30)
        self._callers.append(caller)
        return caller

    def hear(self, size: int) -> bytes:
        """What the caller sends."""
        data = b""
        while len(data) < size and (more := self._callers[-1].recv(size - len(data))):
            data += more
        return data

    def close(self) -> None:
        for each in (self._listener, *self._callers):
            each.close()


@contextmanager
def server(port: int = 0) -> Iterator[Server]:
    with contextlib.closing(Server(port)) as one:
        yield one


@contextmanager
def opened(name: str, framing: Framing = FRAMING, **more: Any) -> Iterator[SerialBus]:
    """An open bus."""
    bus = make_bus(name, payload_size=64, **more)
    assert isinstance(bus, SerialBus)
    bus.use(framing)
    bus.open()
    try:
        yield bus
    finally:
        bus.close()


def received(bus: Bus, batch: FrameBatch, read: Callable[[FrameBatch], list[ReadT]], count: int) -> list[ReadT]:
    """What is read from the frames of a bus, when it is so many at least."""

    def enough() -> bool:
        bus.receive(batch, 0)
        return len(read(batch)) >= count

    wait_until(enough)
    return read(batch)


def why_lost(bus: Bus, batch: FrameBatch) -> str:
    """Receive until the connection is no more: why."""
    found: list[str] = []

    def lost() -> bool:
        try:
            bus.receive(batch, 0)
        except BusNotAvailable as error:
            found.append(str(error))
        return bool(found)

    wait_until(lost)
    return found[0]


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    with socket.socket(type=kind) as probe:
        probe.bind((LOCAL, 0))
        return int(probe.getsockname()[1])
