"""Our receive path on real CAN sockets."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable

import numpy as np
import pytest

from skinware.errors import BusNotAvailable, BusSendError
from skinware_drivers.bus import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, FrameBatch
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.testing.waiting import wait_until
from tests.can.conftest import ip

pytestmark = pytest.mark.can


def sender(interface: str) -> socket.socket:
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.bind((interface,))
    return sock


def can_frame(identifier: int, payload: bytes) -> bytes:
    return struct.pack("=IB3x8s", identifier, len(payload), payload)


def receive(bus: SocketCanBus, batch: FrameBatch, count: int) -> None:
    def enough() -> bool:
        bus.receive(batch, 3)
        return len(batch) >= count

    wait_until(enough)


@pytest.mark.quick
def test_frames_arrive_whole_in_order_and_stamped(vcan: Callable[[], str]) -> None:
    bus = SocketCanBus(vcan())
    bus.open()
    batch = FrameBatch(1000)
    before = time.monotonic_ns()
    with sender(bus.channel) as out:
        for number in range(600):
            out.send(can_frame(number, bytes([number % 256]) * (number % 9)))
    receive(bus, batch, 600)
    after = time.monotonic_ns()
    wire = batch.wire[:600]
    assert wire["identifier"].tolist() == list(range(600))
    assert wire["length"].tolist() == [number % 9 for number in range(600)]
    assert wire["payload"][8].tolist() == [8] * 8
    assert set(batch.bus[:600].tolist()) == {3}
    stamps = batch.time_ns[:600]
    assert before <= stamps.min()
    assert stamps.max() <= after
    assert np.all(np.diff(stamps) >= 0)
    assert (bus.counters.frames, bus.counters.dropped) == (600, 0)
    bus.close()
    bus.close()


def test_fd_frames_and_29_bits_go_both_ways(vcan: Callable[[], str]) -> None:
    interface = vcan()
    ours, theirs = (SocketCanBus(interface, {"bitrate_switch": on}, payload_size=64) for on in ("on", "off"))
    ours.open()
    theirs.open()
    batch = FrameBatch(20, 64)
    sent = [(EXTENDED_FLAG | 0x18A5_C801, bytes(range(64))), (0x123, bytes(range(9))), (0x124, b"classic")]
    for identifier, payload in sent:
        ours.send(identifier, payload)
    receive(theirs, batch, 3)
    wire = batch.wire[:3]
    assert wire["identifier"].tolist() == [identifier for identifier, _ in sent]
    assert wire["length"].tolist() == [64, 12, 7]  # CAN FD has no nine bytes
    assert [row["payload"][: row["length"]].tobytes() for row in wire] == [
        sent[0][1],
        sent[1][1] + bytes(3),
        b"classic",
    ]
    assert [int(flags) & 1 for flags in wire["flags"]] == [1, 1, 0]  # bit rate switch
    batch.clear()
    theirs.send(0x125, bytes(20))
    receive(ours, batch, 1)
    assert (int(batch.wire["length"][0]), int(batch.wire["flags"][0]) & 1) == (20, 0)
    with pytest.raises(BusSendError, match="65 bytes of payload; CAN FD carries 64"):
        ours.send(0x123, bytes(65))
    ours.close()
    theirs.close()


@pytest.mark.parametrize("length", [8, 12, 16, 20, 24, 32, 48, 64])
def test_a_layout_of_every_fd_length_is_received(vcan: Callable[[], str], length: int) -> None:
    layout = Layout((Frame("all", (Identifier(0x123),), (length,), Values(0, "u1", length)),))
    interface = vcan()
    bus, out = (SocketCanBus(interface, payload_size=layout.payload_size) for _ in range(2))
    bus.open()
    out.open()
    batch = FrameBatch.for_buses(1, layout.payload_size)
    out.send(0x123, bytes(range(length)))
    receive(bus, batch, 1)
    assert batch.wire["length"][0] == length
    assert batch.wire["payload"][0][:length].tobytes() == bytes(range(length))
    assert bus.counters.refused == 0
    bus.close()
    out.close()


@pytest.mark.quick
def test_drops_are_counted_exactly(vcan: Callable[[], str]) -> None:
    bus = SocketCanBus(vcan(), {"buffer": "40000"})
    bus.open()
    assert 40_000 <= bus.granted_buffer < 1 << 20
    with sender(bus.channel) as out:
        for _ in range(2000):
            out.send(can_frame(0x123, bytes(8)))
    batch = FrameBatch(3000)
    while bus.receive(batch, 0):
        pass
    assert bus.counters.dropped > 0
    assert bus.counters.frames + bus.counters.dropped == 2000
    bus.close()


def test_error_and_remote_frames_are_counted_and_kept_out(vcan: Callable[[], str]) -> None:
    bus = SocketCanBus(vcan())
    bus.open()
    with sender(bus.channel) as out:
        out.send(can_frame(0x111, b"\x01"))
        out.send(can_frame(ERROR_FLAG | 0x40, bytes(8)))
        out.send(can_frame(REMOTE_FLAG | 0x123, b""))
        out.send(can_frame(0x222, b"\x02"))
    batch = FrameBatch(100)
    receive(bus, batch, 2)
    assert batch.wire["identifier"][:2].tolist() == [0x111, 0x222]
    assert (bus.counters.errors, bus.counters.refused) == (1, 1)
    bus.close()


def test_own_frames_do_not_come_back_and_listeners_send_none(vcan: Callable[[], str]) -> None:
    name = vcan()
    bus, listener = SocketCanBus(name), SocketCanBus(name, listen_only=True)
    bus.open()
    listener.open()
    bus.send(0x207, b"\x07\x00")
    batch = FrameBatch(10)
    receive(listener, batch, 1)
    assert batch.wire["payload"][0, :2].tolist() == [7, 0]
    assert bus.receive(FrameBatch(10), 0) == 0
    with pytest.raises(BusSendError, match="listen only"):
        listener.send(0x207, b"")
    bus.close()
    listener.close()


def test_down_and_gone_are_told_apart(vcan: Callable[[], str]) -> None:
    bus = SocketCanBus(vcan())
    bus.open()
    ip("link", "set", bus.channel, "down")
    with pytest.raises(BusNotAvailable, match="went down") as caught:
        wait_until(lambda: bus.receive(FrameBatch(10), 0) > 0)
    assert caught.value.is_down
    bus.close()
    with pytest.raises(BusNotAvailable, match="ip link set"):
        bus.open()
    ip("link", "set", bus.channel, "up")
    bus.open()
    ip("link", "del", bus.channel)
    with pytest.raises(BusNotAvailable) as caught:
        wait_until(lambda: bus.receive(FrameBatch(10), 0) > 0)
    bus.close()
    with pytest.raises(BusNotAvailable, match="there is no CAN interface"):
        bus.open()
