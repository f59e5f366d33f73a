"""The lab itself: CAN works there as the other tests expect."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
from collections.abc import Callable

import pytest

pytestmark = pytest.mark.can


def open_can(interface: str) -> socket.socket:
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.bind((interface,))
    sock.settimeout(10)
    return sock


@pytest.mark.quick
def test_vcan_carries_a_frame(vcan: Callable[[], str]) -> None:
    name = vcan()
    frame = struct.pack("=IB3x8s", 0x473, 8, bytes.fromhex("40F0F0F0F0F0F0F0"))
    with open_can(name) as sender, open_can(name) as receiver:
        sender.send(frame)
        assert receiver.recv(16) == frame


def test_controllers_carry_frames_at_1_mbit(can_pair: tuple[str, str]) -> None:
    frame = struct.pack("=IB3x8s", 0x207, 2, bytes.fromhex("0700"))
    with open_can(can_pair[0]) as sender, open_can(can_pair[1]) as receiver:
        sender.send(frame)
        assert receiver.recv(16)[:10] == frame[:10]
    shown = subprocess.run(["ip", "-json", "-details", "link", "show", "can0"], check=True, capture_output=True)
    assert json.loads(shown.stdout)[0]["linkinfo"]["info_data"]["bittiming"]["bitrate"] == 1_000_000
