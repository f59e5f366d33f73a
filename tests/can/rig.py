"""A small skin on CAN interfaces: one frame a bus, sent by a thread here, decoded by a driver in another."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from skinware.sensor_types import PRESSURE
from skinware_drivers.can import CanAdapter
from skinware_drivers.can.controller import is_missing
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.options import NoOptions
from skinware_drivers.testing.driving import Driving, driving_lines

TIP_IDENTIFIER = 0x473
PERIOD_S = 0.05


class Tip(CanAdapter[NoOptions]):
    """Eight taxels in one frame."""

    types = (PRESSURE.measured(unit="counts", maximum=255),)
    dtype = np.uint8
    patches = (Patch("tip", [Module(taxels(8))]),)
    layout = Layout([Frame("all", [Identifier(TIP_IDENTIFIER)], length=(8,), values=Values(0, "u1", 8))])
    period_s = PERIOD_S


def can_frame(identifier: int, payload: bytes) -> bytes:
    return struct.pack("=IB3x8s", identifier, len(payload), payload)


def sender(interface: str) -> socket.socket:
    if is_missing(interface):  # to bind to it would start modprobe, for which all of the lab waits
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        sock.bind((interface,))
    except OSError:
        sock.close()
        raise
    return sock


class Tips:
    """Sends every tip's frame, eight times the same rising number, as long as its interface can be sent to."""

    def __init__(self, interfaces: Sequence[str]) -> None:
        self._interfaces = list(interfaces)
        self._sockets: dict[str, socket.socket] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self.silent: set[str] = set()

    def __enter__(self) -> Tips:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        for sock in self._sockets.values():
            sock.close()

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(PERIOD_S):
            number = (number + 1) % 256
            for name in self._interfaces:
                if name not in self.silent:
                    self._send(name, can_frame(TIP_IDENTIFIER, bytes([number]) * 8))

    def _send(self, name: str, frame: bytes) -> None:
        try:
            if name not in self._sockets:
                self._sockets[name] = sender(name)
            self._sockets[name].send(frame)
        except OSError:
            with contextlib.suppress(KeyError):
                self._sockets.pop(name).close()


@contextmanager
def skin(*interfaces: str, options: dict[str, str] | None = None) -> Iterator[tuple[Driving, Tips]]:
    """A driver on these interfaces, with a tip on each."""
    lines = [(Tip(NoOptions()), SocketCanBus(name, options)) for name in interfaces]
    with Tips(interfaces) as tips, driving_lines(lines, "tip", bus_names=interfaces) as driver:
        yield driver, tips
