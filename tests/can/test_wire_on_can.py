"""Wires of real CAN sockets: recorded with the kernel's stamps, exported, and sent on another bus."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np
import pytest

import skinware.recording
from skinware.cli._command import exit_status
from skinware.recording.wire import export_candump
from skinware.wire import IS_CUT, IS_FD
from skinware_drivers.bus import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.cli.replay import command as replay
from skinware_drivers.options import NoOptions
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.testing.waiting import wait_until
from tests.can.conftest import ip
from tests.can.rig import TIP_IDENTIFIER, Tip
from tests.recording.rig import recording
from tests.recording.test_wire_replay import updates_of
from tests.recording.test_wires import frames_of

pytestmark = [pytest.mark.can, pytest.mark.timeout(300)]

_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES = 101, 5
OTHERS = [
    (struct.pack("=IB3x8s", EXTENDED_FLAG | 0x1234567, 2, b"\1\2"), (EXTENDED_FLAG | 0x1234567, 0, b"\1\2")),
    (struct.pack("=IB3x8s", REMOTE_FLAG | 0x123, 0, b""), (REMOTE_FLAG | 0x123, 0, b"")),
    (struct.pack("=IB3x8s", ERROR_FLAG | 4, 8, b"\0\4" + bytes(6)), (ERROR_FLAG | 4, 0, b"\0\4" + bytes(6))),
    (struct.pack("=IBB2x64s", 0x100, 12, 1, bytes(range(12))), (0x100, 1 | IS_FD | IS_CUT, bytes(range(8)))),
    (struct.pack("=IBB2x64s", 0x101, 3, 0, b"abc"), (0x101, IS_FD, b"abc")),
]


@contextmanager
def sender(name: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as out:
        out.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)
        out.bind((name,))
        yield out


def fd_vcan(vcan: Callable[[], str]) -> str:
    name = vcan()
    ip("link", "set", name, "down")
    ip("link", "set", name, "mtu", "72")
    ip("link", "set", name, "up")
    return name


def test_a_wire_is_recorded_and_sent_on_another_bus(vcan: Callable[[], str], tmp_path: Path) -> None:
    name, other, path = fd_vcan(vcan), vcan(), tmp_path / "walk.mcap"
    sent: list[tuple[int, int, bytes]] = []
    with (
        recording(path, with_wires=True) as recorder,
        driving_lines([(Tip(NoOptions()), SocketCanBus(name))], "tip", bus_names=[name], wait=False) as driver,
        sender(name) as out,
    ):
        wait_until(lambda: driver.runner is not None and driver.runner.lines[0].bus.fileno() >= 0)
        line = driver.runner.lines[0]  # type: ignore[union-attr]
        for number in range(24):
            payload = bytes([number]) * 8
            out.send(struct.pack("=IB3x8s", TIP_IDENTIFIER, 8, payload))
            sent.append((TIP_IDENTIFIER, 0, payload))
            if number % 8 == 0:
                for data, expected in OTHERS:
                    out.send(data)
                    sent.append(expected)
            time.sleep(0.02)
        driver.wait()
        driver.do(lambda: line.bus.send(0x321, b"own"))
        wait_until(lambda: line.bus.counters.frames + line.bus.counters.errors + line.bus.counters.refused == len(sent))
        wait_until(lambda: recorder.messages.get("/skin/tip/frame", 0) > 5)
    with skinware.recording.open(path) as opened:
        (wire,) = opened.wires
        frames = frames_of(wire)
        assert [frame[1:] for frame in frames if not frame[0]] == sent
        assert [frame[1:] for frame in frames if frame[0]] == [(0x321, 0, b"own")]
        before = opened["tip"].read()
        times = wire.frames()["time_ns"]
        assert {at_ns for at_ns, _ in updates_of(before)[0]} <= set(times.tolist())
        assert (np.diff(times) > 0).mean() > 0.5  # stamped one by one
        export_candump(opened, tmp_path / "walk.log")
    messages = list(can.CanutilsLogReader(tmp_path / "walk.log"))
    assert len(messages) == len(sent) + 1
    assert {message.channel for message in messages} <= {name, None}
    again = [expected for expected in sent if not expected[0] & (REMOTE_FLAG | ERROR_FLAG)]
    with can.Bus(interface="socketcan", channel=other) as listener:
        assert exit_status(replay, [str(path), "--wire", "--speed", "4", "--bus", other]) == 0
        heard = [listener.recv(10) for _ in again]
    assert [bytes(message.data) for message in heard if message is not None] == [payload for _, _, payload in again]
