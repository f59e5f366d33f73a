"""Serial devices behind TCP."""

from __future__ import annotations

import os
import socket
import struct
import threading

import pytest

from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware_drivers.bus import FrameBatch
from skinware_drivers.bus_names import BusName, parse_bus_name
from skinware_drivers.registry import make_bus
from skinware_drivers.serial import bus as serial_bus
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.framing import Unframed
from skinware_drivers.serial.stream import CHUNK, PythonStream
from skinware_drivers.streams.tcp import TcpBus, TcpServerBus
from skinware_drivers.testing.waiting import wait_until
from tests.serial.lines import data_frame, is_readable, receive
from tests.streams.peers import LOCAL, free_port, opened, server


@pytest.fixture(autouse=True, params=["native", "python"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which kind of stream finds frames."""
    if request.param == "python":
        monkeypatch.setattr(serial_bus, "stream_of", PythonStream)


def send_until_refused(bus: SerialBus) -> int:
    """How many bytes it took."""
    for number in range(10_000):
        try:
            bus.send(0, bytes(1 << 15))
        except BusSendError as error:
            assert "takes nothing any more" in str(error)  # noqa: PT017
            return number << 15
    raise AssertionError("it takes everything")


def test_names() -> None:
    assert parse_bus_name("tcp://host:5000?patience_s=9") == ("tcp", "host:5000", {"patience_s": "9"})
    assert parse_bus_name("tcp:host:5000") == ("tcp", "host:5000", {})
    assert parse_bus_name("socket://host:5000").interface == "serial"
    assert BusName.of("tcp://host:5000?patience_s=9").place == BusName.of("tcp:host:5000").place
    assert BusName.of("tcp://host:5000").place != BusName.of("udp://host:5000").place
    assert isinstance(make_bus("tcp://[::1]:5000"), TcpBus)
    assert isinstance(make_bus("tcp://:0", for_devices=True), TcpServerBus)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("tcp://", "which host"),
        ("tcp://:5000", "which host"),
        ("tcp://host", "which port"),
        ("tcp://host:port", "write tcp://HOST:PORT"),
        ("tcp://host:70000", "write tcp://HOST:PORT"),
        ("tcp://::1:5000x", "write tcp://HOST:PORT"),
        ("tcp://me@host:1", "more than host and port"),
        ("tcp://host:1/path", "more than host and port"),
        ("tcp://host:5000?patience=3", "patience_s"),
        ("tcp://host:5000?patience_s=0", "patience_s"),
        ("tcp://host:5000?baudrate=9600", "unknown option"),
    ],
)
def test_names_that_are_none(name: str, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        make_bus(name)


def test_frames_come_byte_by_byte_and_many_at_once() -> None:
    with server() as device, opened(f"tcp://{LOCAL}:{device.port}") as bus:
        line = device.answer()
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        batch = FrameBatch(8, 64)
        for byte in data_frame(7)[:-1]:
            line.sendall(bytes([byte]))
            assert is_readable(bus, 10)
            assert bus.receive(batch, 0) == 0
        line.sendall(data_frame(7)[-1:] + b"".join(map(data_frame, range(100))))
        assert len(receive(bus, 101)) == 101
        assert bus.counters.framing.skipped_bytes == 0


def test_what_is_sent_arrives_and_a_listener_sends_nothing() -> None:
    with server() as device:
        with opened(f"tcp://{LOCAL}:{device.port}", Unframed()) as bus:
            device.answer()
            bus.send(0, b"hello")
            assert device.hear(5) == b"hello"
        with opened(f"tcp://{LOCAL}:{device.port}", listen_only=True) as bus:
            with pytest.raises(BusSendError, match="listen"):
                bus.send(0, b"hello")


@pytest.mark.parametrize("how", ["closed", "reset"])
def test_a_connection_that_ends_is_lost_once_and_opened_again(how: str) -> None:
    with server() as device, opened(f"tcp://{LOCAL}:{device.port}") as bus:
        line = device.answer()
        line.sendall(data_frame(1) + data_frame(2)[:5])
        receive(bus, 1)
        if how == "reset":
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        line.close()
        batch = FrameBatch(8, 64)
        assert is_readable(bus, 10)
        with pytest.raises(BusNotAvailable, match="the connection is lost"):
            wait_until(lambda: bus.receive(batch, 0) == -1)
        bus.close()
        bus.open()
        device.answer().sendall(data_frame(3))
        [(_, payload, _)] = receive(bus, 1)  # the half before is forgotten
        assert payload[:2] == b"\3\0"


def test_nobody_listens() -> None:
    port = free_port()
    with pytest.raises(BusNotAvailable, match="nothing listens at this port"):
        make_bus(f"tcp://{LOCAL}:{port}").open()


def test_a_name_that_is_not_known_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    known = socket.getaddrinfo
    with server() as device:
        bus = make_bus(f"tcp://glove.invalid:{device.port}")

        def late(host: str, *arguments: object, **more: object) -> object:
            if not is_known:
                raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
            return known(LOCAL, *arguments, **more)  # type: ignore[arg-type]

        monkeypatch.setattr(socket, "getaddrinfo", late)
        is_known = False
        with pytest.raises(BusNotAvailable, match=r"glove\.invalid"):
            bus.open()
        is_known = True
        bus.open()
        device.answer()
        bus.close()


def test_another_end_that_vanishes_is_given_up() -> None:
    """The socket of the other end is taken away without a word to us, as if its computer had lost its power."""
    repair, on = 19, 1  # TCP_REPAIR of linux/tcp.h
    with server() as device, opened(f"tcp://{LOCAL}:{device.port}?patience_s=2") as bus:
        line = device.answer()
        try:
            line.setsockopt(socket.IPPROTO_TCP, repair, on)
        except PermissionError:
            pytest.skip("only root may take a connection away")
        line.close()
        assert not is_readable(bus)
        assert is_readable(bus, 20)
        with pytest.raises(BusNotAvailable, match="the connection is lost"):
            bus.receive(FrameBatch(8, 64), 0)


def test_the_kernel_is_told_to_ask_whether_the_other_end_is_there() -> None:
    with server() as device, opened(f"tcp://{LOCAL}:{device.port}?patience_s=8") as bus:
        assert bus._port is not None
        with socket.socket(fileno=os.dup(bus._port.fileno())) as connection:
            assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
            assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == 4
            assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 8000
            assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_a_peer_that_floods_is_read_in_bounded_pieces_and_nothing_is_lost() -> None:
    n_frames = 20_000
    with server() as device, opened(f"tcp://{LOCAL}:{device.port}") as bus:
        line = device.answer()
        flood = threading.Thread(target=line.sendall, args=(data_frame(9) * n_frames,))
        flood.start()
        batch, received = FrameBatch(512, 64), 0
        while received < n_frames:
            assert is_readable(bus, 10)
            batch.clear()
            received += bus.receive(batch, 0)
            assert bus._stream.pending <= CHUNK + 64
        flood.join(30)
        assert bus.counters.frames == received == n_frames
        assert bus.counters.framing.skipped_bytes == 0


def test_a_peer_that_reads_nothing_is_told_and_holds_up_nobody() -> None:
    with server() as device, opened(f"tcp://{LOCAL}:{device.port}", Unframed(1 << 15)) as bus:
        device.answer()
        send_until_refused(bus)
        assert bus.counters.send_failures == 1


# The device's end


def test_a_device_serves_one_caller_at_a_time() -> None:
    with opened(f"tcp://{LOCAL}:0", Unframed(), for_devices=True) as device:
        name = device.note.replace("listens on ", "tcp://")
        device.send(0, b"for nobody")
        batch = FrameBatch(8, 64)
        with opened(name, Unframed()) as first:
            first.send(0, b"one")
            wait_until(lambda: is_readable(device, 0.05) and device.receive(batch, 0) == 1)
            device.send(0, b"answer")
            assert receive(first, 1)[0][1] == b"answer"
            with opened(name, Unframed()) as second:
                wait_until(lambda: device.receive(batch, 0) == 0 and is_readable(second, 0.05))
                with pytest.raises(BusNotAvailable, match="lost"):
                    second.receive(batch, 0)
        with opened(name, Unframed()) as third:
            third.send(0, b"three")
            batch.clear()
            wait_until(lambda: is_readable(device, 0.05) and device.receive(batch, 0) == 1)
            assert batch.wire["payload"][batch.start][:5].tobytes() == b"three"


def test_a_device_goes_on_when_a_slow_caller_reads_again() -> None:
    with opened(f"tcp://{LOCAL}:0", Unframed(1 << 15), for_devices=True) as device:
        name = device.note.replace("listens on ", "tcp://")
        with opened(name, Unframed(64)) as host:
            host.send(0, b"x")
            batch = FrameBatch(4096, 64)
            wait_until(lambda: is_readable(device, 0.05) and device.receive(batch, 0) == 1)
            sent = send_until_refused(device)

            def flows() -> bool:
                batch.clear()
                host.receive(batch, 0)
                batch.clear()
                if is_readable(device):
                    device.receive(batch, 0)
                return host.counters.framing.bytes_in == sent

            wait_until(flows)


def test_a_port_that_is_taken() -> None:
    with server() as other:
        with pytest.raises(BusNotAvailable, match="cannot listen"):
            make_bus(f"tcp://{LOCAL}:{other.port}", for_devices=True).open()
