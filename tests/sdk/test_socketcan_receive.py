"""The receive path of SocketCAN without CAN in the kernel: datagrams of another kind of socket carry the frames.

The kernel stamps, buffers and drops them as it does with CAN frames. On real CAN: tests/can/test_socketcan.py.
"""

from __future__ import annotations

import errno
import socket
import struct
import time
from types import SimpleNamespace

import numpy as np
import pytest

from skinware import BusReason
from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware_drivers import native
from skinware_drivers.bus import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, FrameBatch
from skinware_drivers.can import socketcan
from skinware_drivers.can.controller import CONTROLLER_STATES, Controller
from skinware_drivers.can.socketcan import SocketCanBus
from tests.sdk.cable import SO_RCVBUFFORCE, Cable, ChoosySocket, drain

RMEM_MAX = "/proc/sys/net/core/rmem_max"


def test_frames_arrive_whole_in_order_and_as_often_as_they_were_sent(cable: Cable) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    for number in range(700):
        cable.put(number, bytes([number % 256]) * (number % 9))
    batch = FrameBatch(1000)
    drain(bus, batch, ordinal=3)
    wire = batch.wire[: len(batch)]
    assert wire["identifier"].tolist() == list(range(700))
    assert wire["length"].tolist() == [number % 9 for number in range(700)]
    assert wire["payload"][8].tolist() == [8] * 8
    assert set(batch.bus[:700].tolist()) == {3}
    assert (bus.counters.frames, bus.counters.dropped) == (700, 0)


def test_a_full_batch_leaves_the_rest_for_the_next_one(cable: Cable) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    for number in range(25):
        cable.put(number)
    found: list[int] = []
    batch = FrameBatch(10)
    for expected in (10, 10, 5):
        batch.clear()
        drain(bus, batch)
        assert len(batch) == expected
        found += batch.wire["identifier"][:expected].tolist()
    assert found == list(range(25))
    assert bus.counters.frames == 25


# Drops


def test_drops_are_counted_exactly_and_go_on_counting_when_the_bus_is_opened_again(
    cable: Cable, spare_cable: Cable
) -> None:
    bus = SocketCanBus("can0", {"buffer": "20000"})
    bus.adopt(cable.end)
    for _ in range(1000):
        cable.put(0x123)
    batch = FrameBatch(2000)
    drain(bus, batch)
    dropped = bus.counters.dropped
    assert dropped > 0
    assert bus.counters.frames + dropped == 1000
    bus.close()
    bus.adopt(spare_cable.end)
    spare_cable.put(0x123)
    drain(bus, batch)
    assert bus.counters.dropped == dropped
    for _ in range(1000):
        spare_cable.put(0x123)
    drain(bus, batch)
    assert bus.counters.dropped > dropped
    assert bus.counters.frames + bus.counters.dropped == 2001


# The receive buffer


def test_the_buffer_is_enlarged_with_force_where_that_is_allowed(cable: Cable, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []

    def note(_self: object, level: int, option: int, value: int) -> None:
        asked.append((option, value))
        if option != SO_RCVBUFFORCE:
            socket.socket.setsockopt(cable.end, level, option, value)

    monkeypatch.setattr(ChoosySocket, "setsockopt", note)
    SocketCanBus("can0", {"buffer": "100000"}).adopt(cable.end)
    assert asked[0] == (SO_RCVBUFFORCE, 50_000)  # the kernel doubles it
    assert socket.SO_RCVBUF not in dict(asked)


def test_a_smaller_buffer_than_asked_for_is_told_with_both_figures(cable: Cable) -> None:
    with open(RMEM_MAX) as file:
        limit = int(file.read())
    wanted = 4 * limit
    bus = SocketCanBus("can0", {"buffer": str(wanted)})
    assert bus.note == ""
    bus.adopt(cable.end)
    assert bus.granted_buffer == cable.end.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == 2 * limit
    assert f"receive buffer of {2 * limit} bytes granted, {wanted} wanted" in bus.note
    assert "CAP_NET_ADMIN" in bus.note


def test_a_buffer_that_was_granted_needs_no_words(cable: Cable) -> None:
    bus = SocketCanBus("can0", {"buffer": "20000"})
    bus.adopt(cable.end)
    assert bus.granted_buffer == 20_000
    assert bus.note == ""


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ({"buffer": "big"}, "bus can0: option buffer=big: "),
        ({"buffer": "0"}, "bus can0: option buffer=0: "),
        ({"timestamps": "best"}, "bus can0: option timestamps=best: "),
        ({"bufer": "1"}, "bus can0: unknown option 'bufer'; did you mean 'buffer'?"),
    ],
)
def test_options_that_are_wrong_are_refused(query: dict[str, str], words: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        SocketCanBus("can0", query)
    assert str(caught.value).startswith(words)


# What is no data


def test_error_and_remote_frames_are_counted_and_kept_out(cable: Cable) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    batch = FrameBatch(10)
    kinds = [0x111, ERROR_FLAG | 0x40, 0x222, REMOTE_FLAG | 0x123, ERROR_FLAG | 0x4, EXTENDED_FLAG | 0x333]
    for number, identifier in enumerate(kinds):
        cable.put(identifier, bytes([number]))
    drain(bus, batch)
    assert batch.wire["identifier"][: len(batch)].tolist() == [0x111, 0x222, EXTENDED_FLAG | 0x333]
    assert batch.wire["payload"][: len(batch), 0].tolist() == [0, 2, 5]
    assert np.all(batch.time_ns[: len(batch)] > 0)
    assert (bus.counters.frames, bus.counters.errors, bus.counters.refused) == (3, 2, 1)


def test_fd_frames_on_a_classic_layout_are_counted_whatever_their_length(cable: Cable) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    for identifier, length in ((0x111, 64), (0x222, 3), (0x333, 12)):
        cable.out.send(struct.pack("=IBB2x64s", identifier, length, 4, bytes(range(64))))
    cable.put(0x444)
    batch = FrameBatch(10)
    drain(bus, batch)
    assert batch.wire["identifier"][: len(batch)].tolist() == [0x444]
    assert (bus.counters.frames, bus.counters.refused, bus.counters.errors) == (1, 3, 0)


@pytest.mark.parametrize("size", [16, 24, 32, 40, 48, 56, 64])
def test_fd_frames_of_every_length_that_fits_are_received_and_the_others_counted(cable: Cable, size: int) -> None:
    """The kernel hands out CAN FD frames of 72 bytes always, however short their payload."""
    bus = SocketCanBus("can0", payload_size=size)
    bus.adopt(cable.end)
    lengths = [*range(9), 12, 16, 20, 24, 32, 48, 64]
    for length in lengths:
        cable.out.send(struct.pack("=IBB2x", 0x123, length, 4) + bytes(range(length)).ljust(64, b"\xff"))
    cable.put(0x124, b"classic")
    batch = FrameBatch(100, size)
    drain(bus, batch)
    fitting = [length for length in lengths if length <= size]
    wire = batch.wire[: len(batch)]
    assert wire["length"].tolist() == [*fitting, 7]
    assert [row["payload"][: row["length"]].tobytes() for row in wire] == [
        *(bytes(range(length)) for length in fitting),
        b"classic",
    ]
    assert bus.counters.refused == len(lengths) - len(fitting)


def test_fd_frames_are_data_of_a_layout_that_has_some(cable: Cable) -> None:
    bus = SocketCanBus("can0", payload_size=64)
    bus.adopt(cable.end)
    cable.out.send(struct.pack("=IBB2x64s", 0x111, 64, 4, bytes(range(64))))
    cable.put(0x222)
    batch = FrameBatch(10, 64)
    drain(bus, batch)
    assert batch.wire["identifier"][: len(batch)].tolist() == [0x111, 0x222]
    assert batch.wire["payload"][0].tolist() == list(range(64))
    assert bus.counters.refused == 0


PASSIVE, OFF = "0010000000000000", "00" * 8


def test_what_the_controller_says_is_known_and_counted(cable: Cable) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    batch = FrameBatch(10)
    cable.put(0x111)
    cable.put(ERROR_FLAG | 0x4, bytes.fromhex(PASSIVE))
    drain(bus, batch)
    assert bus.reason(time.monotonic_ns()) == BusReason.ERROR_PASSIVE
    cable.put(0x111)
    cable.put(ERROR_FLAG | 0x40, bytes.fromhex(OFF))
    drain(bus, batch)  # data before the error frame says nothing
    assert bus.reason(time.monotonic_ns()) == BusReason.BUS_OFF
    cable.put(0x111)
    drain(bus, batch)
    assert bus.reason(time.monotonic_ns()) == BusReason.NONE
    cable.put(ERROR_FLAG | 0x40, bytes.fromhex(OFF))
    cable.put(0x111)
    drain(bus, batch)
    assert bus.reason(time.monotonic_ns()) == BusReason.NONE
    assert (bus.counters.bus_offs, bus.counters.errors, bus.counters.frames) == (2, 3, 4)


def test_what_no_error_frame_told_is_counted_too(cable: Cable, monkeypatch: pytest.MonkeyPatch) -> None:
    """A controller that was off before the socket was opened, or whose error frame was lost."""
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    state = CONTROLLER_STATES.index(BusReason.BUS_OFF)
    monkeypatch.setattr(socketcan, "read_controller", lambda _: Controller(bit_rate=1_000_000, state=state))
    bus._ask_kernel()
    assert bus.reason(time.monotonic_ns()) == BusReason.BUS_OFF
    assert bus.counters.bus_offs == 1
    bus._ask_kernel()
    assert bus.counters.bus_offs == 1


def test_a_storm_of_error_frames_costs_no_data(cable: Cable) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    batch, seen = FrameBatch(64), []
    for number in range(20):
        for _ in range(100):
            cable.put(ERROR_FLAG | 0x8C, bytes.fromhex("0001040A00000000"))
        cable.put(number)
        while True:
            batch.clear()
            if not bus.receive(batch, 0) and not bus.counters.errors % 100:
                break
            seen += batch.wire["identifier"][: len(batch)].tolist()
    assert seen == list(range(20))
    assert (bus.counters.errors, bus.counters.overflows, bus.counters.dropped) == (2000, 2000, 0)


@pytest.mark.parametrize(
    ("number", "words", "is_down"),
    [(errno.ENETDOWN, "bus can0 went down", True), (errno.ENODEV, "bus can0 vanished", False)],
)
def test_an_interface_that_fails_says_how(
    cable: Cable, monkeypatch: pytest.MonkeyPatch, number: int, words: str, is_down: bool
) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    failing = SimpleNamespace(quick=SimpleNamespace(skinware_can_receive=lambda *_: -number))
    monkeypatch.setattr(native, "library", lambda: failing)
    with pytest.raises(BusNotAvailable, match=words) as caught:
        bus.receive(FrameBatch(10), 0)
    assert caught.value.is_down is is_down


def test_nothing_to_receive_is_no_failure(cable: Cable) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    assert bus.receive(FrameBatch(10), 0) == 0


# Sending


def test_a_listener_puts_nothing_on_the_wire(cable: Cable) -> None:
    listener = SocketCanBus("can0", listen_only=True)
    listener.adopt(cable.end)
    with pytest.raises(BusSendError, match="listen only"):
        listener.send(0x207, b"\x07\x00")
    cable.out.setblocking(False)
    with pytest.raises(BlockingIOError):
        cable.out.recv(16)
    assert listener.counters.sent == 0


def test_a_frame_is_sent_as_the_kernel_wants_it_or_the_failure_is_counted(cable: Cable) -> None:
    bus = SocketCanBus("can0")
    with pytest.raises(BusSendError, match="not open"):
        bus.send(0x207, b"\x07\x00")
    bus.adopt(cable.end)
    bus.send(0x207, b"\x07\x00")
    assert cable.out.recv(100).hex() == "07020000" + "02000000" + "0700000000000000"
    cable.out.close()
    bus.send(0x207, b"\x07\x00")  # brings back that nobody is there any more
    with pytest.raises(BusSendError, match=r"^bus can0: frame 207 not sent"):
        bus.send(0x207, b"\x07\x00")
    bus.send(0x207, b"\x07\x00")
    with pytest.raises(BusSendError, match=r"^bus can0: frame 18DA00F1 not sent"):
        bus.send(EXTENDED_FLAG | 0x18DA00F1, b"")
    assert (bus.counters.sent, bus.counters.send_failures) == (3, 2)
