"""Serial ports as sysfs, /dev and /proc show them."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pytest

from skinware_drivers.finding.ports import SerialPort, User, serial_ports
from skinware_drivers.serial.ports import group_that_may
from tests.finding.fakes import FakeMachine

FTDI = {"manufacturer": "FTDI", "product": "FT232R USB UART"}


@pytest.fixture
def fake(tmp_path: Path) -> FakeMachine:
    return FakeMachine(tmp_path)


def test_identity_driver_and_latency_of_an_ftdi_adapter(fake: FakeMachine) -> None:
    path = fake.add_usb_port("ttyUSB0", "ftdi_sio", "0403", "6001", "A50285BI", **FTDI)
    (port,) = serial_ports(fake.machine)
    assert (port.path, port.driver, port.name, port.latency_ms) == (str(path), "ftdi_sio", "FTDI FT232R USB UART", 16)
    assert port.usb is not None
    assert (port.usb.vendor_id, port.usb.product_id, port.usb.serial_number) == ("0403", "6001", "A50285BI")
    assert (port.usb.place, port.usb.interface) == ("1-1.2", "00")
    assert "for up to 16 ms" in port.advice()[-1]


def test_a_microcontroller_without_serial_number(fake: FakeMachine) -> None:
    fake.add_usb_port("ttyACM0", "cdc_acm", "1a86", "7523", place="3-2")
    (port,) = serial_ports(fake.machine)
    assert port.usb is not None
    assert (port.usb.serial_number, port.usb.place, port.name) == ("", "3-2", "USB serial device")
    assert port.latency_ms is None


def test_ports_come_by_number_and_those_without_hardware_not_at_all(fake: FakeMachine) -> None:
    for number in (10, 2):
        fake.add_usb_port(f"ttyUSB{number}", "ftdi_sio", "0403", "6001", str(number), place=f"1-{number}")
    fake.add_uart("ttyS0", kind=4)
    fake.add_uart("ttyS1", kind=0)
    (fake.root / "sys/class/tty/tty0").mkdir()
    found = serial_ports(fake.machine)
    assert [Path(port.path).name for port in found] == ["ttyS0", "ttyUSB2", "ttyUSB10"]
    assert found[0].usb is None
    assert (found[0].name, found[0].driver) == ("built-in port", "serial")


def test_a_port_that_was_unplugged_meanwhile_is_left_out(fake: FakeMachine) -> None:
    fake.add_usb_port("ttyUSB0", "ftdi_sio", "0403", "6001").unlink()
    assert serial_ports(fake.machine) == []


def test_links_that_stay_are_told(fake: FakeMachine) -> None:
    path = fake.add_usb_port("ttyUSB0", "ftdi_sio", "0403", "6001", "A5")
    expected = []
    for name in ("skin/A5", "serial/by-id/usb-FTDI_A5-if00-port0", "serial/by-path/pci-0:1.2"):
        link = fake.machine.dev / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(path)
        expected.append(str(link))
    (fake.machine.dev / "skin/other").symlink_to("/dev/null")
    (port,) = serial_ports(fake.machine)
    assert list(port.links) == expected


def test_who_has_a_port_open_is_told_as_far_as_it_is_known(fake: FakeMachine, monkeypatch: pytest.MonkeyPatch) -> None:
    path = fake.add_usb_port("ttyUSB0", "ftdi_sio", "0403", "6001", "A5")
    fake.add_process(41, "screen", Path("/dev/null"), path)
    fake.add_process(42, "bash", Path("/dev/pts/0"))
    fake.add_process(os.getpid(), "python", path)
    (port,) = serial_ports(fake.machine)
    assert (port.users, port.users_known) == ((User(41, "screen"),), True)
    (fake.root / "proc/43").mkdir()  # one that ended: it has no descriptors any more
    assert serial_ports(fake.machine)[0].users_known

    real = os.readlink

    def refuse(path: Path) -> str:
        if "fd" in Path(path).parts:
            raise PermissionError
        return real(path)

    with monkeypatch.context() as patched:
        patched.setattr(os, "readlink", refuse)
        (port,) = serial_ports(fake.machine)
    assert (port.users, port.users_known) == ((), False)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"may_open": True}, ""),
        ({"may_open": False, "group": "dialout"}, "sudo usermod -aG dialout $USER"),
        ({"may_open": False, "group": "dialout", "in_group": True}, "log out and in again, you are in group dialout"),
        ({"may_open": False}, "skin-find --udev"),
    ],
)
def test_missing_rights_come_with_what_to_do(given: dict[str, object], words: str) -> None:
    port = SerialPort("/dev/ttyUSB0", "cdc_acm", None, (), may_open=True, group="", in_group=False)
    advice = dataclasses.replace(port, **given).advice()  # type: ignore[arg-type]
    assert len(advice) == bool(words)
    assert words in "".join(advice)


def test_the_group_is_one_whose_members_may_read_and_write(fake: FakeMachine, monkeypatch: pytest.MonkeyPatch) -> None:
    path = fake.add_usb_port("ttyUSB0", "ftdi_sio", "0403", "6001", "A5")
    info = list(path.stat())
    cases = [(0o660, 5, True), (0o640, 5, False), (0o660, 0, False)]
    for mode, group, is_group in cases:
        info[0], info[5] = 0o020000 | mode, group
        assert (group_that_may(os.stat_result(info)) is not None) == is_group
