"""Devices on pseudo terminals, and drivers of them that run in a thread."""

from __future__ import annotations

import os
import select
import tempfile
import threading
import tty
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from skinware.sensor_types import PRESSURE
from skinware_drivers.bus import FrameBatch
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Identifier, Match
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.options import NoOptions
from skinware_drivers.running.runner import Runner
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.checksums import CRC16_XMODEM
from skinware_drivers.serial.delimited import COBS, Delimited
from skinware_drivers.serial.framing import Field, Framing
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.testing.waiting import wait_until

FRAMING = Delimited(COBS, maximum_body=64, checksum=CRC16_XMODEM, identifier=Field(0))
DATA, ASK, ANSWER = 1, 0x10, 0x11
N_TAXELS = 12


class Line:
    """A device at the end of a pseudo terminal.

    Attributes:
        path: what a driver opens: a link, since another test may get the number of a terminal that went away.
    """

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self._folder = tempfile.TemporaryDirectory()
        self.path = f"{self._folder.name}/port"
        os.symlink(os.ttyname(slave), self.path)
        self._slave = slave  # kept open until a driver has it, or nothing could be written
        os.set_blocking(self.master, False)

    def write(self, data: bytes) -> None:
        """Send all of it."""
        while data:
            select.select([], [self.master], [], 30)
            data = data[os.write(self.master, data) :]

    def read(self, size: int = 65536) -> bytes:
        """What the driver has sent, after waiting for something."""
        ready, _, _ = select.select([self.master], [], [], 30)
        assert ready, "the driver sends nothing"
        return os.read(self.master, size)

    def unplug(self) -> None:
        """Go away."""
        self._folder.cleanup()
        for fd in (self.master, self._slave):
            if fd >= 0:
                os.close(fd)
        self.master = self._slave = -1


@contextmanager
def line() -> Iterator[Line]:
    device = Line()
    try:
        yield device
    finally:
        device.unplug()


@contextmanager
def opened(path: str, framing: Framing = FRAMING, **more: Any) -> Iterator[SerialBus]:
    """An open bus on a port."""
    bus = SerialBus(path, more.pop("options", None), payload_size=64, **more)
    bus.use(framing)
    with closing(bus):
        bus.open()
        yield bus


def is_readable(bus: SerialBus, timeout_s: float = 0.0) -> bool:
    return bool(select.select([bus.fileno()], [], [], timeout_s)[0])


def receive(bus: SerialBus, count: int, capacity: int = 4096) -> list[tuple[int, bytes, int]]:
    """(identifier, payload, time_ns) of the next frames."""
    batch = FrameBatch(capacity, 64)
    found: list[tuple[int, bytes, int]] = []

    def take() -> bool:
        if is_readable(bus, 0.05):
            batch.clear()
            bus.receive(batch, 3)
            assert (batch.bus[batch.start : batch.stop] == 3).all()
            for row, time_ns in zip(batch.wire[: batch.stop], batch.time_ns[: batch.stop].tolist(), strict=True):
                found.append((int(row["identifier"]), row["payload"][: row["length"]].tobytes(), time_ns))
        return len(found) >= count

    wait_until(take)
    return found


def data_frame(value: int) -> bytes:
    """A frame of taxels that all have one value."""
    return FRAMING.encode(DATA, np.full(N_TAXELS, value, "<u2").tobytes())


class FingertipDriver(SerialAdapter[NoOptions]):
    """A fingertip that tells its number when it is asked, and then sends frames."""

    framing = FRAMING
    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    layout = Layout([Frame("taxels", [Identifier(DATA)], [2 * N_TAXELS], Values(0, "<u2", N_TAXELS))])
    period_s = 0.01

    async def describe(self, link: Link) -> Sequence[Patch]:
        reply = await link.request(ASK, b"who", Match(ANSWER, prefix=b"I am "), timeout_s=0.2)
        return [Patch(reply.payload[5:].decode(), [Module(taxels(N_TAXELS))])]


class Device(threading.Thread):
    """Answers, and sends frames with a value that counts up, until it is stopped."""

    def __init__(self, where: Line, name: str = "tip1", flood: bytes = b"") -> None:
        super().__init__(daemon=True)
        self._line = where
        self._says = b"I am " + name.encode()
        self._flood = flood
        self.ending = threading.Event()
        self.value = 0

    def run(self) -> None:
        heard = b""
        while not self.ending.wait(0 if self._flood else 0.005):
            try:
                if select.select([self._line.master], [], [], 0)[0]:
                    heard += os.read(self._line.master, 4096)
                if FRAMING.encode(ASK, b"who") in heard:
                    heard = b""
                    os.write(self._line.master, FRAMING.encode(ANSWER, self._says))
                self.value += 1
                os.write(self._line.master, self._flood or data_frame(self.value & 0xFFFF))
            except BlockingIOError:
                self.ending.wait(0.001)


@contextmanager
def device(where: Line, name: str = "tip1", flood: bytes = b"") -> Iterator[Device]:
    running = Device(where, name, flood)
    running.start()
    try:
        yield running
    finally:
        running.ending.set()
        running.join(30)
        assert not running.is_alive()


@contextmanager
def driving(*ports: str) -> Iterator[Runner]:
    """A driver of some ports, in a thread."""
    lines = [(FingertipDriver(NoOptions()), SerialBus(port, payload_size=64)) for port in ports]
    names = [f"line{number}" for number in range(len(ports))]
    with driving_lines(lines, "fingertip", wait=False, bus_names=names) as running:
        wait_until(lambda: running.runner is not None)
        assert running.runner is not None
        yield running.runner


class Usb:
    """USB serial ports as the system lists them; ``plug`` and ``unplug`` change it."""

    def __init__(self) -> None:
        self.ports: list[Any] = []

    def plug(self, path: str | Path, serial_number: str = "", vid: int = 0x0483, pid: int = 0x5700) -> None:
        from serial.tools.list_ports_common import ListPortInfo

        port = ListPortInfo(str(path), skip_link_detection=True)
        port.serial_number, port.vid, port.pid, port.description = serial_number, vid, pid, "skin"
        self.ports.append(port)
