"""Small services that tests of this folder make."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from skinware import DriverWriter, Namespace, ServiceWriter
from skinware.memory.locks import Descriptor
from skinware.service import Writer
from skinware.service._server import short_path

SMALL = {"values": ("<u8", 512)}


def publish(writer: ServiceWriter | DriverWriter, value: int) -> None:
    """A frame whose every value is this."""
    writer.begin()["values"][:] = value
    writer.commit(time.monotonic_ns())


def kill(writer: Writer) -> None:
    """Leave a writer as the kernel leaves a killed one: its files stay, its locks go."""
    writer._ring.segment.descriptor.close()
    writer._name_lock.close()


def connect() -> socket.socket:
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with short_path(Namespace().socket_path("x")) as path:
        peer.connect(path)
    peer.setblocking(False)
    return peer


@contextmanager
def at_0(descriptor: Descriptor) -> Iterator[None]:
    """The descriptor is 0, as in a program without a standard input."""
    before, descriptor_before = os.dup(0), descriptor.fd
    os.dup2(descriptor.fd, 0, inheritable=False)
    descriptor.fd = 0
    try:
        yield
    finally:
        descriptor.fd = descriptor_before
        os.dup2(before, 0)
        os.close(before)


def add(a: float, b: float) -> float:
    """The sum of two numbers.

    More about it.
    """
    return a + b


def fail() -> None:
    """Goes wrong."""
    raise RuntimeError("the motor is hot")


def no_json() -> object:
    """Returns what cannot be sent."""
    return object()


def too_much() -> str:
    """Returns more than a packet holds."""
    return "x" * 100_000


OPERATIONS: dict[str, Callable[..., object]] = {"add": add, "fail": fail, "no_json": no_json, "too_much": too_much}


@contextmanager
def on_request(**options: Any) -> Iterator[ServiceWriter]:
    """A sporadic writer in a thread: every frame holds its own number."""
    writer = ServiceWriter("x", SMALL, operations=OPERATIONS, **options)
    writer.request_server()

    def work() -> None:
        for columns in writer.on_request():
            columns["values"][:] = writer.sequence + 1

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield writer
    finally:
        writer.stop()
        thread.join()
        writer.close()
