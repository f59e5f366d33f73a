"""A socket that stands in for CAN: its datagrams carry frames, and the kernel stamps, buffers and drops them."""

from __future__ import annotations

import errno
import socket
import struct
import time

from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.socketcan import SocketCanBus

SO_RCVBUFFORCE = 33
SO_TIMESTAMPNS = 35


class ChoosySocket(socket.socket):
    """A socket that knows how its buffer was asked for, and may refuse force."""

    allowed = False

    def setsockopt(self, level: int, option: int, value: int) -> None:  # type: ignore[override]
        """Set an option."""
        if option == SO_RCVBUFFORCE and not self.allowed:
            raise PermissionError(errno.EPERM, "Operation not permitted")
        super().setsockopt(level, option, value)


class Cable:
    """A socket to receive from, and one that sends to it."""

    def __init__(self) -> None:
        self.end = ChoosySocket(socket.AF_INET, socket.SOCK_DGRAM)
        self.end.bind(("127.0.0.1", 0))
        self.out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.out.connect(self.end.getsockname())
        self.end.connect(self.out.getsockname())

    def put(self, identifier: int, payload: bytes = bytes(8)) -> None:
        self.out.send(struct.pack("=IB3x8s", identifier, len(payload), payload))

    def put_ten(self) -> tuple[int, int]:
        """Send ten frames; when, by CLOCK_MONOTONIC: before the first and after the last, ns."""
        before_ns = time.monotonic_ns()
        for _ in range(10):
            self.put(0x123)
        return before_ns, time.monotonic_ns()

    def close(self) -> None:
        self.end.close()
        self.out.close()


def drain(bus: SocketCanBus, batch: FrameBatch, ordinal: int = 0) -> None:
    while bus.receive(batch, ordinal):
        pass


def pass_ms(duration_ms: int) -> None:
    """Let time pass, so that moments before and after can be told apart."""
    time.sleep(duration_ms / 1e3)
