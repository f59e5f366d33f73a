"""A small skin on CAN interfaces: one frame a bus, sent by a thread here, decoded by a driver in another."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from skinware.sensor_types import PRESSURE
from skinware_drivers.adapter import NoOptions
from skinware_drivers.bus import Bus
from skinware_drivers.can.adapter import CanAdapter
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.layout import Frame, Identifier, Layout, Values
from skinware_drivers.runner import Runner

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


class Driver:
    """A running driver of tips; ``do`` runs something in its loop."""

    def __init__(self, buses: Sequence[Bus], **options: Any) -> None:
        self.buses = buses
        self.ready = threading.Event()
        self.failure: BaseException | None = None
        self.runner: Runner | None = None
        self._options = options
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        async def run() -> None:
            self._loop = asyncio.get_running_loop()
            lines = [(bus.channel, Tip(NoOptions()), bus) for bus in self.buses]
            self.runner = Runner("tip", lines, name="tip", slots=64, on_ready=self.ready.set, **self._options)
            await self.runner.run()

        try:
            asyncio.run(run())
        except BaseException as error:  # noqa: BLE001  (shown to the test, which fails on it)
            self.failure = error
            self.ready.set()

    def start(self) -> None:
        self._thread.start()
        assert self.ready.wait(60)
        if self.failure is not None:
            raise self.failure

    def stop(self) -> None:
        assert self._loop is not None
        assert self.runner is not None
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self.runner.stop)
        self._thread.join(60)
        assert not self._thread.is_alive(), "the driver did not stop"
        if self.failure is not None:
            raise self.failure

    def do(self, action: Callable[[], object]) -> None:
        done = threading.Event()
        assert self._loop is not None
        self._loop.call_soon_threadsafe(action)
        self._loop.call_soon_threadsafe(done.set)
        assert done.wait(60)

    def status(self) -> dict[str, Any]:
        assert self.runner is not None
        return self.runner.status()


@contextmanager
def skin(*interfaces: str, options: dict[str, str] | None = None, **more: Any) -> Iterator[tuple[Driver, Tips]]:
    """A driver on these interfaces, with a tip on each."""
    driver = Driver([SocketCanBus(name, options) for name in interfaces], **more)
    with Tips(interfaces) as tips:
        driver.start()
        try:
            yield driver, tips
        finally:
            driver.stop()
