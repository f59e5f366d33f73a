"""Serial ports that come and go, are refused, or are found by what they are."""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import termios
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import serial
from serial import serialposix
from serial.tools import list_ports

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.status import BusReason
from skinware_drivers.bus import FrameBatch
from skinware_drivers.serial import ports
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import ThreadedPort
from skinware_drivers.testing.waiting import wait_until
from tests.serial.lines import FRAMING, Usb, data_frame, is_readable, line, opened, receive


@pytest.fixture
def usb(monkeypatch: pytest.MonkeyPatch) -> Usb:
    """The USB ports that the system lists; none at first."""
    system = Usb()
    monkeypatch.setattr(list_ports, "comports", lambda: system.ports)
    return system


def test_an_unplugged_port_says_so_and_can_be_opened_again() -> None:
    with line() as device, opened(device.path) as bus:
        device.write(data_frame(1)[:4])
        receive(bus, 0)
        device.unplug()
        assert is_readable(bus, 10)
        with pytest.raises(BusNotAvailable, match="unplugged"):
            bus.receive(FrameBatch(8, 64), 0)
        bus.close()
        with pytest.raises(BusNotAvailable, match="no serial port"):
            bus.open()
        assert bus.fileno() == -1


def test_a_device_is_found_again_under_another_name(usb: Usb) -> None:
    bus = SerialBus("", {"serial_number": "A7"}, payload_size=64)
    bus.use(FRAMING)
    with pytest.raises(BusNotAvailable, match="serial number A7; there is none at all"):
        bus.open()
    for _ in range(2):
        with line() as other, line() as device:
            usb.ports.clear()
            usb.plug(other.path, "B8")
            usb.plug(device.path, "A7")
            bus.open()
            device.write(data_frame(3))
            assert receive(bus, 1)[0][1][:1] == b"\3"
            device.unplug()
            assert is_readable(bus, 10)
            with pytest.raises(BusNotAvailable):
                bus.receive(FrameBatch(8, 64), 0)
            bus.close()
    usb.ports.clear()
    usb.plug("/dev/ttyACM0", "B8")
    with pytest.raises(BusNotAvailable, match=r"serial number A7; there are: /dev/ttyACM0 \(skin\)"):
        bus.open()


def test_ports_by_vendor_and_product(usb: Usb) -> None:
    with line() as device:
        usb.plug(device.path, "A7", 0x0483, 0x5700)
        usb.plug("/dev/ttyUSB9", "A8", 0x0403, 0x6001)
        bus = SerialBus("", {"vid_pid": "0483:5700"})
        bus.open()
        bus.close()
        usb.plug("/dev/ttyACM7", "A9", 0x0483, 0x5700)
        with pytest.raises(BusNotAvailable, match=r"2 serial ports have VID:PID 0483:5700: .*serial_number=A9"):
            bus.open()
        both = SerialBus("", {"vid_pid": "0483:5700", "serial_number": "A7"})
        assert both.channel == "serial_number=A7&vid_pid=0483:5700"
        both.open()
        both.close()


def test_a_second_program_on_the_port_is_told() -> None:
    with line() as device, opened(device.path):
        other = SerialBus(device.path)
        with pytest.raises(BusNotAvailable, match=f"another program has it open.*fuser -v {device.path}"):
            other.open()
        other.close()
    with line() as device:
        with opened(device.path):
            pass
        with opened(device.path):  # and it is free again afterwards
            pass


@pytest.mark.parametrize(
    ("number", "message", "reason"),
    [
        (errno.EACCES, "permission denied; for good: .* udev rule", BusReason.REFUSED),
        (errno.EBUSY, "another program has it open", BusReason.REFUSED),
        (errno.ENXIO, "no serial port /dev/ttyS9; there is none at all", BusReason.INTERFACE_GONE),
        (errno.EIO, "cannot be opened as a serial port", BusReason.FAILED),
    ],
)
def test_refusals_say_what_to_do(
    number: int, message: str, reason: BusReason, usb: Usb, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: serial.Serial) -> None:
        raise serial.SerialException(number, os.strerror(number))

    monkeypatch.setattr(serial.Serial, "open", refuse)
    with pytest.raises(BusNotAvailable, match=message) as raised:
        SerialBus("/dev/ttyS9").open()
    assert raised.value.reason == reason


@pytest.mark.parametrize(
    ("mode", "group", "words"),
    [
        (0o660, grp.getgrnam("dialout").gr_gid, "sudo usermod -aG dialout $USER, and log in again"),
        (0o600, grp.getgrnam("dialout").gr_gid, "a udev rule (skin-find --udev)"),  # the group may not either
        (0o660, 0, "a udev rule (skin-find --udev)"),  # nobody should be in root's group
        (0o600, 0, "a udev rule (skin-find --udev)"),
    ],
)
def test_nobody_is_told_to_join_the_group_root(
    mode: int, group: int, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: serial.Serial) -> None:
        raise serial.SerialException(errno.EACCES, os.strerror(errno.EACCES))

    info = os.stat_result((0o020000 | mode, 1, 1, 1, 0, group, 0, 0, 0, 0))
    monkeypatch.setattr(serial.Serial, "open", refuse)
    monkeypatch.setattr(ports, "os", SimpleNamespace(**{**vars(os), "stat": lambda _path: info}))
    with pytest.raises(BusNotAvailable) as raised:
        SerialBus("/dev/ttyS9").open()
    assert words in str(raised.value)
    assert "root" not in str(raised.value)


@pytest.mark.parametrize("up", [True, False])
def test_dtr_and_rts_get_their_levels_when_the_port_is_opened(up: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pseudo terminal has no such wires: what pyserial asks the kernel for is looked at."""
    asked: list[tuple[int, int]] = []

    def ioctl(_fd: int, request: int, argument: bytes = b"") -> bytes:
        asked.append((request, int.from_bytes(argument[:4], "little")))
        return argument

    monkeypatch.setattr(serialposix, "fcntl", SimpleNamespace(**{**vars(fcntl), "ioctl": ioctl}))
    level = "yes" if up else "no"
    with line() as device, opened(device.path, options={"dtr": level, "rts": level}):
        wires = {argument: request for request, argument in asked if request in (termios.TIOCMBIS, termios.TIOCMBIC)}
    wanted = termios.TIOCMBIS if up else termios.TIOCMBIC
    assert wires == {termios.TIOCM_DTR: wanted, termios.TIOCM_RTS: wanted}


def test_a_port_can_be_told_not_to_hang_up() -> None:
    with line() as device:
        settings = termios.tcgetattr(device.master)
        settings[2] |= termios.HUPCL
        termios.tcsetattr(device.master, termios.TCSANOW, settings)
        for options, hangs_up in (({}, True), ({"hang_up": "no"}, False), ({}, False)):  # as it was, if not told
            with opened(device.path, options=options):
                pass
            assert bool(termios.tcgetattr(device.master)[2] & termios.HUPCL) == hangs_up
    with pytest.raises(ConfigurationError, match="hang_up=no is for ports of this machine"):
        SerialBus("socket://localhost:1", {"hang_up": "no"}).open()


def test_what_is_no_serial_port(tmp_path: Path, usb: Usb) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(BusNotAvailable, match="cannot be opened as a serial port"):
        SerialBus(str(file)).open()
    with pytest.raises(ConfigurationError, match="invalid URL"):
        SerialBus("nonsense://x").open()
    with pytest.raises(ConfigurationError, match="which serial port"):
        SerialBus("").open()
    with pytest.raises(ConfigurationError, match="not both"):
        SerialBus("/dev/ttyUSB0", {"serial_number": "A7"}).open()
    with pytest.raises(ConfigurationError, match="did you mean 'baudrate'"):
        SerialBus("/dev/ttyUSB0", {"baudrat": "9600"})


class Hanging:
    """A port of pyserial's that does not return from one of its calls until it is told to."""

    in_waiting = 0

    def __init__(self, hangs_in: str) -> None:
        self.told, self.closed = threading.Event(), threading.Event()
        self._hangs_in = hangs_in

    def read(self, _size: int) -> bytes:
        return self._hang("read")

    def write(self, _data: bytes) -> None:
        self._hang("write")

    def close(self) -> None:
        self._hang("close")
        self.closed.set()

    def _hang(self, where: str) -> bytes:
        if where == self._hangs_in:
            self.told.wait()
        return b""


@pytest.mark.parametrize("hangs_in", ["read", "write", "close"])
def test_a_port_that_hangs_holds_nobody_up(hangs_in: str, caplog: pytest.LogCaptureFixture) -> None:
    threads = threading.active_count()
    hanging = Hanging(hangs_in)
    port = ThreadedPort("rfc2217://far:1", hanging)
    port.write(b"something")
    port.close()
    assert [record.getMessage() for record in caplog.records] == [
        "rfc2217://far:1: it hangs while it is closed, and is left to itself"
    ]
    assert threading.active_count() > threads
    port.close()
    hanging.told.set()
    assert hanging.closed.wait(30)
    wait_until(lambda: threading.active_count() == threads)
    assert len(caplog.records) == 1
