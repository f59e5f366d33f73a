"""Modbus servers of somebody else's making (pymodbus), over TCP and over a line of two pseudo terminals."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import select
import threading
import tty
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pymodbus import FramerType
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from skinware_drivers.testing.waiting import PATIENCE_S
from tests.streams.peers import LOCAL, free_port

Action = Callable[..., Coroutine[None, None, Any]]


def device(unit: int, first: int, values: Sequence[int], action: Action | None = None) -> SimDevice:
    """A unit with 16-bit registers from an address on."""
    registers = SimData(first, values=list(values), datatype=DataType.REGISTERS)
    return SimDevice(id=unit, simdata=[registers], action=action)


class _Server:
    def __init__(self, make: Callable[[], Any]) -> None:
        self._make = make
        self._ready, self._loop = threading.Event(), asyncio.new_event_loop()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._ready.wait(PATIENCE_S)
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        async def serve() -> None:
            self._server = self._make()
            await self._server.serve_forever(background=True)
            self._end = asyncio.Event()
            self._ready.set()
            await self._end.wait()
            await self._server.shutdown()
            for _ in range(5):  # the server leaves tasks behind, and makes some of them later
                await asyncio.sleep(0.01)
                others = asyncio.all_tasks() - {asyncio.current_task()}
                for task in others:
                    task.cancel()
                await asyncio.gather(*others, return_exceptions=True)

        try:
            self._loop.run_until_complete(serve())
        except BaseException as error:  # noqa: BLE001
            self._failure = error
            self._ready.set()
        finally:
            self._loop.close()

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        gc.collect()  # what the server has not awaited is told here, and in no later test


@contextmanager
def tcp_server(*devices: SimDevice, port: int = 0) -> Iterator[str]:
    """Yields its bus name."""
    port = port or free_port()
    server = _Server(lambda: ModbusTcpServer(list(devices), address=(LOCAL, port)))
    try:
        yield f"modbus:tcp://{LOCAL}:{port}"
    finally:
        server.stop()


class Line:
    """A serial line: two ports that hear each other, and a third that hears both.

    Attributes:
        one, other, tap: their paths.
        from_tap: what the third has sent: nobody hears it.
        disturb: what becomes of bytes that the other sends.
    """

    def __init__(self, ends: Sequence[tuple[int, int]]) -> None:
        self.disturb: Callable[[bytes], bytes] = bytes
        self.one, self.other, self.tap = (os.ttyname(slave) for _, slave in ends)
        self.from_tap = b""


@contextmanager
def line() -> Iterator[Line]:
    ends = [os.openpty(), os.openpty(), os.openpty()]
    made = Line(ends)
    for master, slave in ends:
        tty.setraw(slave)
        os.set_blocking(master, False)
    stop = os.eventfd(0)
    one, other, tap = (master for master, _ in ends)
    hearers = {one: (other, tap), other: (one, tap), tap: ()}

    def carry() -> None:
        while True:
            ready, _, _ = select.select([*hearers, stop], [], [])
            if stop in ready:
                return
            for fd in ready:
                data = os.read(fd, 4096)
                made.from_tap += data if fd == tap else b""
                data = made.disturb(data) if fd == other else data
                for hearer in hearers[fd]:
                    with contextlib.suppress(BlockingIOError):
                        os.write(hearer, data)

    thread = threading.Thread(target=carry, daemon=True)
    thread.start()
    try:
        yield made
    finally:
        os.eventfd_write(stop, 1)
        thread.join(PATIENCE_S)
        for fd in (*(fd for end in ends for fd in end), stop):
            os.close(fd)


@contextmanager
def rtu_server(*devices: SimDevice, baudrate: int = 115_200) -> Iterator[str]:
    """Yields its bus name."""
    with line() as between, rtu_server_on(between.other, *devices, baudrate=baudrate):
        yield f"modbus:{between.one}?baudrate={baudrate}"


@contextmanager
def rtu_server_on(port: str, *devices: SimDevice, baudrate: int = 115_200) -> Iterator[None]:
    server = _Server(lambda: ModbusSerialServer(list(devices), framer=FramerType.RTU, port=port, baudrate=baudrate))
    try:
        yield
    finally:
        server.stop()
