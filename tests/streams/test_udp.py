"""Devices that send datagrams."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from skinware.driver_service import DriverReader
from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware.wire import read_pieces
from skinware_drivers import Byte, Frame, Layout, Module, NoOptions, Patch, SequenceNumber, Values, taxels
from skinware_drivers.bus import FrameBatch
from skinware_drivers.bus_names import parse_bus_name
from skinware_drivers.registry import make_bus
from skinware_drivers.serial import SerialAdapter, Unframed
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.serial.lines import data_frame, is_readable, receive
from tests.streams.peers import LOCAL, free_port, opened


@contextmanager
def sender() -> Iterator[socket.socket]:
    with socket.socket(type=socket.SOCK_DGRAM) as device:
        device.bind((LOCAL, 0))
        device.settimeout(30)
        yield device


def port_of(bus: SerialBus) -> int:
    return int(bus.note.split()[1])


def take(bus: SerialBus, count: int) -> list[bytes]:
    return [payload for _, payload, _ in receive(bus, count)]


def test_names() -> None:
    assert parse_bus_name("udp://:7000") == ("udp", ":7000", {})
    assert parse_bus_name("udp://10.0.0.2:7000?local=8000") == ("udp", "10.0.0.2:7000", {"local": "8000"})


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("udp://", "which host"),
        ("udp://host", "which port"),
        ("udp://:7000?local=8000", "leave local out"),
        ("udp://host:7000?local=0", "local"),
    ],
)
def test_names_that_are_none(name: str, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        make_bus(name)


def test_what_goes_over_the_wire_is_kept_datagram_by_datagram() -> None:
    with sender() as device, opened("udp://:0", Unframed(64)) as bus:
        bus.tap.open()
        for payload in (b"one", b"two"):
            device.sendto(payload, (LOCAL, port_of(bus)))
        assert take(bus, 2) == [b"one", b"two"]
        bus.send(0, b"three")
        pieces = [piece for batch in bus.tap.fetch() for piece in read_pieces(bytes(batch))[0]]
        assert [(piece.is_sent, piece.data) for piece in pieces] == [(False, b"one"), (False, b"two"), (True, b"three")]


def test_each_datagram_is_a_frame_and_an_empty_one_is_none() -> None:
    with sender() as device, opened("udp://:0", Unframed(64)) as bus:
        here = (LOCAL, port_of(bus))
        for payload in (b"one", b"", b"", b"three"):
            device.sendto(payload, here)
        assert take(bus, 2) == [b"one", b"three"]
        for number in range(200):
            device.sendto(bytes([number]) * 60, here)
        assert take(bus, 200) == [bytes([number]) * 60 for number in range(200)]
        assert not is_readable(bus)


def test_large_datagrams_are_not_joined() -> None:
    with sender() as device, opened("udp://:0", Unframed(4096)) as bus:
        here = (LOCAL, port_of(bus))
        batch = FrameBatch(8, 4096)
        bus.payload_size = 4096
        bus.use(Unframed(4096))
        for letter in b"abc":
            device.sendto(bytes([letter]) * 3000, here)
        wait_until(lambda: is_readable(bus, 0.05) and bus.receive(batch, 0) + len(batch) >= 3)
        assert batch.wire["length"][: batch.stop].tolist() == [3000] * 3


def test_a_framing_finds_frames_that_go_on_in_the_next_datagram() -> None:
    stream = b"".join(map(data_frame, range(20)))
    with sender() as device, opened("udp://:0") as bus:
        for place in range(0, len(stream), 33):
            device.sendto(stream[place : place + 33], (LOCAL, port_of(bus)))
        assert len(take(bus, 20)) == 20
        assert bus.counters.framing.skipped_bytes == 0


def test_a_lost_datagram_costs_the_frames_in_it() -> None:
    with sender() as device, opened("udp://:0") as bus:
        frames = [data_frame(value) for value in range(6)]
        for piece in (frames[0] + frames[1][:9], frames[2][9:] + frames[3], frames[4] + frames[5]):
            device.sendto(piece, (LOCAL, port_of(bus)))
        assert [payload[0] for payload in take(bus, 4)] == [0, 3, 4, 5]
        assert bus.counters.framing.checksum_errors == 1


def test_who_speaks_first_is_the_other_end_and_others_are_counted() -> None:
    with sender() as device, sender() as stranger, opened("udp://:0", Unframed(64)) as bus:
        here = (LOCAL, port_of(bus))
        bus.send(0, b"for nobody yet")
        device.sendto(b"mine", here)
        assert take(bus, 1) == [b"mine"]
        for _ in range(5):
            stranger.sendto(b"his", here)
        device.sendto(b"mine again", here)
        assert take(bus, 1) == [b"mine again"]
        assert bus.counters.refused == 5
        bus.send(0, b"to you")
        assert device.recv(64) == b"to you"


def test_another_end_is_taken_after_a_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware_drivers.streams.udp._SILENT_NS", 0)
    with sender() as device, sender() as again, opened("udp://:0", Unframed(64)) as bus:
        device.sendto(b"one", (LOCAL, port_of(bus)))
        again.sendto(b"two", (LOCAL, port_of(bus)))
        assert take(bus, 2) == [b"one", b"two"]


def test_only_the_named_end_is_heard() -> None:
    local = free_port(socket.SOCK_DGRAM)
    with sender() as device, sender() as stranger:
        name = f"udp://{LOCAL}:{device.getsockname()[1]}?local={local}"
        with opened(name, Unframed(64)) as bus:
            stranger.sendto(b"his", (LOCAL, local))
            bus.send(0, b"hello")
            data, here = device.recvfrom(64)
            assert (data, here) == (b"hello", (LOCAL, local))
            device.sendto(b"mine", here)
            assert take(bus, 1) == [b"mine"]
            assert bus.counters.refused == 1


def test_an_end_that_is_not_there_yet_is_no_error() -> None:
    port = free_port(socket.SOCK_DGRAM)
    with opened(f"udp://{LOCAL}:{port}", Unframed(64)) as bus:
        for _ in range(3):
            bus.send(0, b"anybody?")
        with socket.socket(type=socket.SOCK_DGRAM) as device:
            device.bind((LOCAL, port))
            device.settimeout(30)
            bus.send(0, b"now?")
            data, here = device.recvfrom(64)
            assert data == b"now?"
            device.sendto(b"yes", here)
            assert take(bus, 1) == [b"yes"]


def test_two_buses_cannot_have_one_port() -> None:
    with opened("udp://:0") as bus:
        with pytest.raises(BusNotAvailable, match="this computer"):
            make_bus(f"udp://:{port_of(bus)}").open()


class Numbered(SerialAdapter[NoOptions]):
    """A number, 4 taxels; a datagram each. It takes no patch for silent that a busy machine holds up."""

    framing = Unframed(64)
    types = (PRESSURE.measured(unit="counts"),)
    layout = Layout(
        [Frame("taxels", [Byte(0, 0xA5)], [6], Values(2, "u1", 4), sequence=SequenceNumber(1, "u1"))],
    )
    patches = (Patch("finger", [Module(taxels(4))]),)
    period_s = 1.0


def test_a_driver_counts_datagrams_that_were_lost_or_overtook_each_other(namespace: object) -> None:
    def say(number: int) -> None:
        device.sendto(bytes([0xA5, number % 256]) + np.full(4, number % 256, np.uint8).tobytes(), here)

    port = free_port(socket.SOCK_DGRAM)
    here = (LOCAL, port)
    bus = make_bus(f"udp://:{port}", payload_size=64)
    with sender() as device, contextlib.ExitStack() as stack:
        running = stack.enter_context(driving_lines([(Numbered(NoOptions()), bus)], "finger", wait=False))
        wait_until(lambda: running.runner is not None and running.runner.builder.generation is not None)
        say(1)  # what came before that belongs to nobody
        running.wait()
        for number in (2, 3, 5, 4, 6, 9, 10, 11, 10):  # 7 and 8 never come; the second 10 was sent twice
            say(number)

        expected = {"updates": 8, "sequence_lost": 2, "sequence_back": 2}

        def counted() -> dict[str, int]:
            [patch] = running.status()["patches"]
            return {name: patch[name] for name in expected}

        wait_until(lambda: counted() == expected)  # each is counted by itself, in another thread
        with DriverReader("finger") as reader:
            read_until(reader, lambda frame: frame.values.tolist() == [11] * 4)
