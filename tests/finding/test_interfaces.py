"""CAN interfaces as sysfs and the kernel's answers show them."""

from __future__ import annotations

import errno
import socket
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pytest

from skinware_drivers.can.controller import Controller
from skinware_drivers.finding.interfaces import CanInterface, can_interfaces, kernel_has_can
from tests.finding.fakes import CONTROLLER, add_interface


def test_a_controller_with_its_bit_rate_and_counters(tmp_path: Path) -> None:
    add_interface(tmp_path, "can0", driver="kvaser_pci", mtu=72)
    add_interface(tmp_path, "eth0", type=1)
    (found,) = can_interfaces(tmp_path, lambda _name: ("can", replace(CONTROLLER, data_bit_rate=5_000_000)))
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


def test_interfaces_that_the_kernel_says_little_of(tmp_path: Path) -> None:
    add_interface(tmp_path, "can0", driver="gs_usb", flags=0x1002, operstate="down")
    add_interface(tmp_path, "can1", driver="peak_usb")
    add_interface(tmp_path, "can2", driver="mcp251x")
    for name in ("slcan0", "vcan0"):
        add_interface(tmp_path, name)
    known = {"can0": ("", Controller(500_000, 3, 0)), "can1": ("can", Controller(0, 99)), "vcan0": ("vcan", None)}
    can0, can1, can2, slcan0, vcan0 = can_interfaces(tmp_path, lambda name: known.get(name, ("", None)))
    assert (can0.kind, can0.up, can0.bit_rate, can0.state, can0.restart_ms) == ("can", False, 500_000, "BUS-OFF", 0)
    assert (can1.kind, can1.bit_rate, can1.state) == ("can", None, "")
    assert (can0.sample_point, can0.data_bit_rate, can0.controller_errors) == (None, None, {})
    assert [(one.kind, one.state, one.restart_ms) for one in (can2, slcan0)] == [
        ("can", "", None),
        ("virtual", "", None),
    ]
    assert (vcan0.kind, vcan0.up, vcan0.driver, vcan0.is_fd) == ("vcan", True, "", False)


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
    assert can_interfaces(tmp_path) == []


@pytest.mark.parametrize(("number", "has_can"), [(errno.EAFNOSUPPORT, False), (errno.EPERM, True)])
def test_a_kernel_without_can_is_told_from_missing_rights(
    monkeypatch: pytest.MonkeyPatch, number: int, has_can: bool
) -> None:
    def refuse(*_: object) -> NoReturn:
        raise OSError(number, "no")

    monkeypatch.setattr(socket, "socket", refuse)
    assert kernel_has_can() is has_can
