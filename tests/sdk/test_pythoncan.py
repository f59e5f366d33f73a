"""Interfaces that are reached through python-can: what they lose is noticed, and to listen is to be silent."""

from __future__ import annotations

import os
import pty
import select
import signal
import socket
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import can
import pytest
from can.interfaces.virtual import VirtualBus

from skinware.errors import BusNotAvailable, BusSendError
from skinware.status import BusReason
from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch
from skinware_drivers.can import pythoncan
from skinware_drivers.can.pythoncan import PythonCanBus, _MessageQueue
from skinware_drivers.counters import BusCounters
from skinware_drivers.testing.waiting import wait_until
from tests.commands import running
from tests.streams.peers import free_port


class Unplugged:
    """An adapter that delivers some messages, and is unplugged right after them."""

    def __init__(self, messages: int) -> None:
        self._left = messages

    def recv(self, _timeout: float) -> can.Message:
        if self._left:
            self._left -= 1
            return can.Message(arbitration_id=0x473, data=b"\x40" + bytes(7), is_extended_id=False)
        raise can.CanOperationError("adapter unplugged")

    def shutdown(self) -> None:
        """Nothing is left to shut down."""


@pytest.mark.parametrize(("messages", "rows"), [(0, 64), (3, 64), (3, 3), (64, 8)])
@pytest.mark.parametrize("by", ["receive", "check"])
def test_an_adapter_that_is_unplugged_after_its_last_messages_is_noticed(
    monkeypatch: pytest.MonkeyPatch, messages: int, rows: int, by: str
) -> None:
    adapter = Unplugged(messages)
    monkeypatch.setattr(can, "Bus", lambda **_: adapter)
    bus = PythonCanBus("slcan", "/dev/ttyACM0")
    bus.open()
    taken = bus._messages
    assert taken is not None
    wait_until(lambda: taken.failure is not None)  # messages and failure wait together
    received = 0
    with select.epoll() as epoll:
        epoll.register(bus.fileno(), select.EPOLLIN)
        with pytest.raises(BusNotAvailable, match="adapter unplugged") as raised:  # noqa: PT012
            while epoll.poll(30):
                received += bus.receive(FrameBatch(rows), 0)
                if by == "check" and received == messages:
                    bus.check()
    assert received == messages
    assert raised.value.reason == BusReason.FAILED
    bus.close()


class Stumbling:
    """An adapter whose library cannot take every second message."""

    def __init__(self) -> None:
        self.calls = 0

    def recv(self, _timeout: float) -> can.Message:
        self.calls += 1
        if self.calls % 2:
            raise ValueError("invalid data length code: 51")
        return can.Message(arbitration_id=0x473, data=bytes(8), is_extended_id=False)

    def shutdown(self) -> None:
        """Nothing is left to shut down."""


def test_a_message_that_the_library_cannot_take_costs_itself_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can, "Bus", lambda **_: Stumbling())
    bus = PythonCanBus("slcan", "/dev/ttyACM0")
    bus.open()
    received = 0
    while received < 200:
        received += bus.receive(FrameBatch(64), 0)
    assert bus.counters.refused >= received
    bus.close()


def heard_by(bus: PythonCanBus, count: int) -> list[int]:
    """Identifiers of the next frames, of at least so many."""
    batch = FrameBatch(64)

    def take() -> bool:
        bus.receive(batch, 0)
        return len(batch) >= count

    wait_until(take)
    identifiers: list[int] = batch.wire["identifier"][batch.start : batch.stop].tolist()
    return identifiers


def test_a_bus_that_hears_itself_shows_only_what_others_send() -> None:
    options = {"port": str(free_port(socket.SOCK_DGRAM)), "hop_limit": "0"}
    driver, device = (PythonCanBus("udp_multicast", "239.74.163.2", dict(options)) for _ in range(2))
    driver.open()
    device.open()
    for _ in range(3):
        driver.send(0x210, b"start")
    assert heard_by(device, 3) == [0x210] * 3
    device.send(0x210, b"start")  # the same once more, from another
    device.send(0x310, b"data")
    assert heard_by(driver, 2) == [0x210, 0x310]
    driver.close()
    device.close()


@contextmanager
def adapter_on_a_pty() -> Iterator[tuple[int, str]]:
    """The device's end, and the path of a port."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    try:
        yield ours, os.ttyname(theirs)
    finally:
        os.close(ours)
        os.close(theirs)


@pytest.mark.parametrize(("listen_only", "command"), [(True, b"L\r"), (False, b"O\r")])
def test_an_slcan_adapter_is_told_to_only_listen(listen_only: bool, command: bytes) -> None:
    """Opened the usual way it acknowledges every frame that it hears: it takes part in the bus."""
    with adapter_on_a_pty() as (device, path):
        bus = PythonCanBus("slcan", path, {"bitrate": "1000000", "sleep_after_open": "0"}, listen_only=listen_only)
        bus.open()
        told = bytearray()

        def is_open() -> bool:
            while select.select([device], [], [], 0)[0]:
                told.extend(os.read(device, 4096))
            return told.endswith((b"L\r", b"O\r"))

        wait_until(is_open)
        assert told.endswith(command)
        assert bus.note == ""
        bus.close()


def test_an_interface_that_cannot_only_listen_says_so() -> None:
    assert "acknowledges" in PythonCanBus("gs_usb", "0", listen_only=True).note
    assert PythonCanBus("gs_usb", "0").note == ""
    assert PythonCanBus("udp_multicast", "239.74.163.2", listen_only=True).note == ""


class Hanging:
    """An interface whose library does not return from one of its calls until it is told to.

    Attributes:
        told: lets it return.
        shut_down: set once that has been done.
    """

    def __init__(self, hangs_in: str) -> None:
        self.told, self.shut_down = threading.Event(), threading.Event()
        self._hangs_in = hangs_in

    def recv(self, _timeout: float) -> can.Message:
        if self._hangs_in == "recv":
            self.told.wait()
        return can.Message(arbitration_id=0x473, data=bytes(8), is_extended_id=False)

    def shutdown(self) -> None:
        if self._hangs_in == "shutdown":
            self.told.wait()
        self.shut_down.set()


@pytest.mark.parametrize("hangs_in", ["recv", "shutdown"])
def test_an_interface_that_hangs_holds_nobody_up(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, hangs_in: str
) -> None:
    hanging, good = Hanging(hangs_in), Hanging("nothing")
    opened = iter((hanging, good))
    monkeypatch.setattr(can, "Bus", lambda **_: next(opened))
    bus = PythonCanBus("slcan", "/dev/ttyACM0")
    bus.open()
    bus.close()
    assert not hanging.shut_down.is_set()
    assert [record.getMessage() for record in caplog.records] == [
        "bus slcan:/dev/ttyACM0: its interface hangs while it is closed, and is left to itself"
    ]
    assert bus.fileno() == -1
    bus.open()  # the next one has nothing to do with it
    wait_until(lambda: bus.receive(FrameBatch(10), 0) > 0)
    bus.close()
    assert good.shut_down.is_set()
    threads = threading.active_count()
    hanging.told.set()
    assert hanging.shut_down.wait(30)
    wait_until(lambda: threading.active_count() < threads)
    assert len(caplog.records) == 1


def test_an_identifier_that_is_not_sent_is_named_as_candump_writes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise can.CanOperationError("no buffer space")

    bus = PythonCanBus("virtual", "test-names")
    bus.open()
    monkeypatch.setattr(VirtualBus, "send", refuse)
    with pytest.raises(BusSendError, match=r"^bus test-names: frame 18DA00F1 not sent \(no buffer space\)$"):
        bus.send(EXTENDED_FLAG | 0x18DA00F1, b"")
    with pytest.raises(BusSendError, match=r"frame 0F1 not sent"):
        bus.send(0xF1, b"")
    bus.close()


HANGING = """
import sys
import threading

import can

from skinware_drivers.can.roboskin import RoboskinDriver


def hang(**_):
    print("opening", file=sys.stderr, flush=True)
    threading.Event().wait()


can.Bus = hang


class MySkin(RoboskinDriver):
    pass
"""


@pytest.mark.thorough
def test_a_driver_ends_though_the_library_of_its_only_bus_hangs(tmp_path: Path) -> None:
    file = tmp_path / "my_skin.py"
    file.write_text(HANGING)
    with running("skin-driver", "--driver", str(file), "--bus", "slcan:/dev/ttyACM0") as driver:
        wait_until(lambda: "opening" in driver.errors)
        assert driver.stop(signal.SIGTERM)["event"] == "stopped"
    assert driver.process.returncode == 0
    assert driver.errors.splitlines() == [
        "opening",
        "skin-driver: bus slcan:/dev/ttyACM0: its interface is still being opened, and is left to itself",
    ]


def test_the_kernels_time_of_arrival_counts_not_that_of_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two frames are read late, and then the other clock is set forward and back: times never go back, or ahead."""
    second = 1_000_000_000
    now, wall = [5 * second], [100 * second]
    monkeypatch.setattr(pythoncan, "now_ns", lambda: now[0])
    monkeypatch.setattr(time, "time_ns", lambda: wall[0])
    monkeypatch.setattr(_MessageQueue, "_work", lambda _: None)
    stamped, other = (
        _MessageQueue(cast("can.BusABC", None), "", BusCounters(), by_kernel) for by_kernel in (True, False)
    )

    def age(messages: _MessageQueue, wall_s: float) -> int:
        return now[0] - messages._arrival_ns(can.Message(timestamp=wall_s))

    now[0] += second
    wall[0] += second
    assert [age(stamped, 100.5), age(stamped, 100.75), age(other, 100.5)] == [second // 2, second // 4, 0]
    wall[0] += 3600 * second
    assert age(stamped, 101) == second // 4
    wall[0] -= 7200 * second
    assert age(stamped, 101) == 0
    for messages in (stamped, other):
        messages.close()
        os.close(messages.fd)
