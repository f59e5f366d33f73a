"""``skin-dump --raw`` beside another listener on a real CAN socket."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from skinware.cli._command import exit_status
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.cli.dump import command
from skinware_drivers.testing.waiting import wait_until
from tests.can.conftest import ip

pytestmark = [pytest.mark.can, pytest.mark.timeout(300)]

_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES = 101, 5


def test_everything_on_the_bus_is_read_back_and_nothing_is_taken_from_others(
    vcan: Callable[[], str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    name = vcan()
    ip("link", "set", name, "down")
    ip("link", "set", name, "mtu", "72")
    ip("link", "set", name, "up")
    frames = [
        struct.pack("=IB3x8s", 0x473, 8, b"\x40" + b"\xf0" * 7),
        struct.pack("=IB3x8s", 0x80000000 | 0x1234567, 2, b"\x01\x02"),
        struct.pack("=IBB2x64s", 0x100, 12, 1, bytes(range(12))),
    ]
    other = SocketCanBus(name, payload_size=64)
    other.open()
    over = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as out:
            out.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)
            out.bind((name,))
            while not over.wait(0.01):
                for frame in frames:
                    out.send(frame)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        assert exit_status(command, ["--raw", name, "-n", "6", "--timeout", "60"]) == 0
        batch = FrameBatch(100_000, 64)

        def heard() -> bool:
            other.receive(batch, 0)
            return len(batch) >= 6

        wait_until(heard)
    finally:
        over.set()
        sender.join()
        other.close()
    path = tmp_path / "can.log"
    path.write_text(capsys.readouterr().out)
    with can.LogReader(path) as reader:
        messages = list(reader)
    assert len(messages) == 6
    seen = {(m.arbitration_id, m.is_extended_id, m.is_fd, bytes(m.data), m.channel) for m in messages}
    assert seen == {
        (0x473, False, False, b"\x40" + b"\xf0" * 7, name),
        (0x1234567, True, False, b"\x01\x02", name),
        (0x100, False, True, bytes(range(12)), name),
    }
