"""CAN interfaces as sysfs and iproute2 show them."""

from __future__ import annotations

import errno
import json
import socket
import stat
from pathlib import Path
from typing import NoReturn

import pytest

from skinware_drivers.can.controller import Controller
from skinware_drivers.finding import interfaces
from skinware_drivers.finding.interfaces import CanInterface, ask_iproute2, can_interfaces, kernel_has_can
from tests.finding.fakes import add_interface, ip_link


def test_a_controller_with_its_bit_rate_and_counters(tmp_path: Path) -> None:
    add_interface(tmp_path, "can0", driver="kvaser_pci", mtu=72)
    add_interface(tmp_path, "eth0", type=1)
    (found,) = can_interfaces(tmp_path, {"can0": ip_link("can0", data_bittiming={"bitrate": 5000000})})
    assert (found.name, found.kind, found.driver, found.up, found.is_fd) == ("can0", "can", "kvaser_pci", True, True)
    assert (found.bit_rate, found.data_bit_rate, found.sample_point) == (1_000_000, 5_000_000, 0.75)
    assert (found.state, found.restart_ms, found.queue_length) == ("ERROR-ACTIVE", 100, 10)
    assert (found.statistics["rx_packets"], found.statistics["tx_packets"], found.statistics["rx_errors"]) == (
        1234,
        5,
        2,
    )
    assert found.controller_errors["error_warning"] == 3
    assert found.advice() == []


def test_without_iproute2_the_kernel_is_asked_for_bit_rate_and_state(tmp_path: Path) -> None:
    add_interface(tmp_path, "can0", driver="gs_usb", flags=0x1002, operstate="down")
    add_interface(tmp_path, "can1", driver="peak_usb")
    add_interface(tmp_path, "vcan0")
    known = {"can0": Controller(500_000, 3, 0), "can1": Controller(0, 99)}
    can0, can1, vcan0 = can_interfaces(tmp_path, {}, known.get)
    assert (can0.kind, can0.up, can0.bit_rate, can0.state, can0.restart_ms) == ("can", False, 500_000, "BUS-OFF", 0)
    assert (can1.kind, can1.bit_rate, can1.state) == ("can", None, "")
    assert (vcan0.kind, vcan0.up, vcan0.driver, vcan0.is_fd) == ("virtual", True, "", False)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"up": False},
            ["down: sudo ip link set can0 type can bitrate 1000000 restart-ms 100; sudo ip link set can0 up"],
        ),
        ({"up": False, "bit_rate": 500_000}, ["down: sudo ip link set can0 up"]),
        ({"up": False, "kind": "vcan"}, ["down: sudo ip link set can0 up"]),
        ({"state": "BUS-OFF", "restart_ms": 0}, ["off the bus", "it stays off until"]),
        ({"state": "BUS-OFF", "restart_ms": 100}, ["off the bus"]),
        ({"state": "ERROR-PASSIVE"}, ["many errors on the wire"]),
        ({"state": "ERROR-ACTIVE"}, []),
    ],
)
def test_what_is_wrong_comes_with_what_to_do(given: dict[str, object], words: list[str]) -> None:
    usual = {"kind": "can", "driver": "peak_usb", "up": True, "carrier": "up", "is_fd": False, "queue_length": 10}
    advice = CanInterface("can0", **{**usual, **given}).advice()  # type: ignore[arg-type]
    assert len(advice) == len(words)
    assert all(text.startswith(word) for text, word in zip(advice, words, strict=True))


def test_a_machine_without_network_folders_has_none(tmp_path: Path) -> None:
    assert can_interfaces(tmp_path, {}) == []


def fake_ip(folder: Path, script: str) -> None:
    path = folder / "ip"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


@pytest.mark.parametrize(
    ("script", "links"),
    [
        (f"echo '{json.dumps([ip_link('can0'), {}])}'", ["can0"]),
        ("echo 'Option \"-j\" is unknown' >&2; exit 255", []),
        ("echo 'no JSON'", []),
    ],
)
def test_iproute2_is_believed_if_it_speaks_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, links: list[str]
) -> None:
    fake_ip(tmp_path, script)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    assert list(ask_iproute2()) == links


def test_a_machine_without_iproute2(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(interfaces, "_SYSTEM_PATH", str(tmp_path))
    assert ask_iproute2() == {}


@pytest.mark.parametrize(("number", "has_can"), [(errno.EAFNOSUPPORT, False), (errno.EPERM, True)])
def test_a_kernel_without_can_is_told_from_missing_rights(
    monkeypatch: pytest.MonkeyPatch, number: int, has_can: bool
) -> None:
    def refuse(*_: object) -> NoReturn:
        raise OSError(number, "no")

    monkeypatch.setattr(socket, "socket", refuse)
    assert kernel_has_can() is has_can
