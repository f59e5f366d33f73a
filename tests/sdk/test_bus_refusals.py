"""A bus that cannot be used is told in one clear line with exit code 1, whatever the reason."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import pty
import re
import socket
import struct
import termios
import tty
from collections.abc import Iterator

import can
import pytest

from skinware.cli._command import exit_status
from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware.status import BusReason
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can import socketcan
from skinware_drivers.can.pythoncan import PythonCanBus
from skinware_drivers.cli.driver import command
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.waiting import wait_until

IFF_UP = 1
CAN_RAW = 101
CAN_RAW_ERR_FILTER = 2


class CanSocket(socket.socket):
    """What a CAN socket would do, on a system with or without CAN."""

    refuse_socket = 0
    refuse_bind = 0
    can_options: list[tuple[int, int]]

    def __init__(self) -> None:
        if self.refuse_socket:
            raise OSError(self.refuse_socket, errno.errorcode[self.refuse_socket])
        self.can_options = []
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)

    def setsockopt(self, level: int, option: int, value: int) -> None:  # type: ignore[override]
        """Set an option."""
        if level == CAN_RAW:
            self.can_options.append((option, value))
        else:
            super().setsockopt(level, option, value)

    def bind(self, _address: object) -> None:
        """Bind to an interface."""
        if self.refuse_bind:
            raise OSError(self.refuse_bind, errno.errorcode[self.refuse_bind])


@pytest.fixture
def interface_flags(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """CAN sockets that obey ``CanSocket``'s attributes, on an interface with these flags."""
    flags = [IFF_UP]
    real = socket.socket

    def make(family: int = -1, *more: int, **named: int) -> socket.socket:
        return CanSocket() if family == socket.AF_CAN else real(family, *more, **named)

    for name in ("AF_CAN", "CAN_RAW"):
        monkeypatch.setattr(socket, name, getattr(socket, name, 29), raising=False)
    monkeypatch.setattr(socket, "socket", make)
    monkeypatch.setattr(socketcan, "is_missing", lambda _interface: False)
    monkeypatch.setattr(fcntl, "ioctl", lambda *_: struct.pack("16sH14x", b"can0", flags[0]))
    return flags


@pytest.mark.parametrize(
    ("attribute", "number", "words"),
    [
        ("refuse_socket", errno.EAFNOSUPPORT, "this kernel has no CAN: load it (sudo modprobe can-raw)"),
        ("refuse_socket", errno.EPERM, "bus can0: cannot open a CAN socket"),
        ("refuse_bind", errno.ENODEV, "there is no CAN interface 'can0'; CAN interfaces here: "),
        ("refuse_bind", errno.EACCES, "bus can0: not permitted (EACCES); ask for access"),
        ("refuse_bind", errno.EPERM, "bus can0: not permitted (EPERM); ask for access"),
        ("refuse_bind", errno.EINVAL, "bus can0: cannot be opened (EINVAL)"),
    ],
)
def test_a_can_interface_that_cannot_be_opened(
    monkeypatch: pytest.MonkeyPatch,
    interface_flags: list[int],
    capsys: pytest.CaptureFixture[str],
    attribute: str,
    number: int,
    words: str,
) -> None:
    assert interface_flags == [IFF_UP]
    monkeypatch.setattr(CanSocket, attribute, number)
    assert exit_status(command, ["--bus", "can0"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"skin-driver: {words}")


def test_a_can_interface_that_is_down(interface_flags: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    interface_flags[0] = 0
    assert exit_status(command, ["--bus", "can0"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "skin-driver: bus can0 is down; bring it up: ip link set can0 up"


def test_error_frames_are_asked_for(interface_flags: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    assert interface_flags == [IFF_UP]
    opened: list[CanSocket] = []
    bus = socketcan.SocketCanBus("can0")
    monkeypatch.setattr(bus, "adopt", opened.append)
    bus.open()
    with opened[0] as sock:
        assert (CAN_RAW_ERR_FILTER, 0x1FFF_FFFF) in sock.can_options


def test_a_port_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command, ["--bus", "slcan:/dev/no-such-port"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("skin-driver: bus slcan:/dev/no-such-port cannot be opened: ")


# Interfaces of python-can


def test_frames_of_python_can_are_sorted_out_and_counted() -> None:
    bus = PythonCanBus("virtual", "test-sorting")
    bus.open()
    with can.Bus(interface="virtual", channel="test-sorting") as other:
        for message in (
            can.Message(arbitration_id=0x473, data=b"\x40", is_extended_id=False),
            can.Message(arbitration_id=0x473, is_error_frame=True),
            can.Message(arbitration_id=0x473, is_remote_frame=True, is_extended_id=False),
            can.Message(arbitration_id=0x473, data=bytes(12), is_fd=True, is_extended_id=False),
            can.Message(arbitration_id=0x473, data=b"\x41", is_extended_id=True),
        ):
            other.send(message)
        batch = FrameBatch(10)
        wait_until(lambda: bus.receive(batch, 2) > -1 and len(batch) == 2)
        assert batch.wire["identifier"][:2].tolist() == [0x473, 0x8000_0473]
        assert batch.wire["payload"][:2, 0].tolist() == [0x40, 0x41]
        assert batch.bus[:2].tolist() == [2, 2]
        assert (bus.counters.frames, bus.counters.errors, bus.counters.refused) == (2, 1, 2)
        bus.send(0x207, b"\x07\x00")
        heard = other.recv(30)
        assert heard is not None
        assert (heard.arbitration_id, heard.is_extended_id, bytes(heard.data)) == (0x207, False, b"\x07\x00")
    bus.close()
    bus.close()


def test_a_listener_of_python_can_puts_nothing_on_the_wire() -> None:
    bus = PythonCanBus("virtual", "test-listening", listen_only=True)
    bus.open()
    with can.Bus(interface="virtual", channel="test-listening") as other:
        with pytest.raises(BusSendError, match="listen only"):
            bus.send(0x207, b"\x07\x00")
        assert other.recv(0) is None
    assert bus.counters.sent == 0
    bus.close()


def test_an_interface_of_python_can_that_fails_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_self: object, timeout: float | None = None) -> None:
        raise can.CanOperationError("unplugged")

    bus = PythonCanBus("virtual", "test-failing")
    monkeypatch.setattr(can.BusABC, "recv", fail)
    bus.open()
    with pytest.raises(BusNotAvailable, match="bus virtual:test-failing failed: unplugged"):
        wait_until(lambda: bus.receive(FrameBatch(10), 0) > 0)
    bus.close()


class Sick(can.BusABC):
    """An interface whose adapter was pulled out: everything raises whatever its library likes."""

    failing = False

    def __init__(self, channel: str, **_options: object) -> None:
        if self.failing:
            raise ValueError("no such adapter")
        super().__init__(channel)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.failing:
            raise AttributeError("'NoneType' object has no attribute 'read'")
        return None, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Refuse."""
        raise KeyError(msg.arbitration_id, timeout)

    def shutdown(self) -> None:
        """Refuse."""
        super().shutdown()
        raise termios.error(5, "Input/output error")


def test_whatever_an_interface_of_python_can_raises_the_bus_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can, "Bus", lambda **options: Sick(options["channel"]))
    bus = PythonCanBus("sick", "1")
    bus.open()
    with pytest.raises(BusSendError, match="519"):
        bus.send(0x207, b"")
    monkeypatch.setattr(Sick, "failing", True)
    with pytest.raises(BusNotAvailable, match="NoneType") as caught:
        wait_until(lambda: bus.receive(FrameBatch(10), 0) > 0)
    assert caught.value.reason == BusReason.FAILED
    bus.close()
    with pytest.raises(BusNotAvailable, match="no such adapter"):  # at first it would have been a wrong option
        bus.open()
    with pytest.raises(ConfigurationError, match="no such adapter"):
        PythonCanBus("sick", "2").open()


@pytest.fixture
def adapter_port() -> Iterator[tuple[int, str]]:
    """An slcan adapter's end of a pty, and the path of the other."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    yield ours, os.ttyname(theirs)
    for descriptor in (ours, theirs):
        with contextlib.suppress(OSError):
            os.close(descriptor)


def failure(bus: PythonCanBus) -> BusNotAvailable:
    with pytest.raises(BusNotAvailable, match="failed: ") as caught:
        wait_until(lambda: bus.receive(FrameBatch(10), 0) > 0)
    bus.close()
    return caught.value


def test_an_slcan_adapter_that_sends_garbage_and_is_unplugged(adapter_port: tuple[int, str]) -> None:
    ours, path = adapter_port
    bus = PythonCanBus("slcan", path, {"sleep_after_open": "0"})
    bus.open()
    os.write(ours, b"\xff\x00garbage\r")
    batch = FrameBatch(10)
    wait_until(lambda: bus.receive(batch, 0) == 0 and bus.counters.refused == 1)
    os.write(ours, b"t4730\r" * 60)  # python-can keeps the garbage, and cannot take any of them
    assert failure(bus).reason == BusReason.FAILED
    bus.open()
    batch = FrameBatch(10)
    os.write(ours, b"t47384000102030405060\r")
    wait_until(lambda: bus.receive(batch, 0) >= 0 and len(batch) > 0)
    assert batch.wire["identifier"][0] == 0x473
    os.close(ours)
    assert failure(bus).reason == BusReason.FAILED
    with pytest.raises(BusNotAvailable):
        bus.open()


@pytest.mark.parametrize("name", ["can0", "can+virtual:x", "serial:/dev/ttyX", "virtual:xela", "virtual:anyskin"])
def test_every_bus_refuses_to_send_in_the_same_words(name: str) -> None:
    closed, listening = make_bus(name), make_bus(name, listen_only=True)
    with pytest.raises(BusSendError, match=f"^{re.escape(closed.name)} is not open$"):
        closed.send(1, b"")
    with pytest.raises(BusSendError, match=f"^{re.escape(closed.name)} is opened to listen only$"):
        listening.send(1, b"")
