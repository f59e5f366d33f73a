"""A serial line as a bus, on pseudo terminals."""

from __future__ import annotations

import contextlib
import socket
import threading
from pathlib import Path

import numpy as np
import pytest
import serial
from serial.rfc2217 import PortManager

from skinware.errors import BusNotAvailable, BusSendError
from skinware.realtime import now_ns
from skinware_drivers.bus import FrameBatch
from skinware_drivers.bus_names import parse_bus_name
from skinware_drivers.counters import BusCounters
from skinware_drivers.registry import make_bus
from skinware_drivers.serial import bus as serial_bus
from skinware_drivers.serial.bus import PtyBus, SerialBus
from skinware_drivers.serial.checksums import CRC16_WEISS
from skinware_drivers.serial.framing import Field, Unframed
from skinware_drivers.serial.framings import Recurring
from skinware_drivers.serial.packets import Length, Packet
from skinware_drivers.serial.stream import PythonStream, stream_of
from skinware_drivers.testing.waiting import wait_until
from tests.serial.lines import ASK, DATA, FRAMING, data_frame, is_readable, line, opened, receive


@pytest.fixture(autouse=True, params=["native", "python"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which kind of stream finds frames."""
    if request.param == "python":
        monkeypatch.setattr(serial_bus, "stream_of", PythonStream)


PACKETS = Packet(
    sync=b"\xaa\xaa\xaa", length=Length(Field(4, 2), 8), maximum=60, checksum=CRC16_WEISS, identifier=Field(3)
)


# Frames


def test_frames_of_one_read_have_its_time_and_their_order() -> None:
    with line() as device, opened(device.path) as bus:
        device.write(b"".join(data_frame(value) for value in range(50)))
        found = receive(bus, 50)
        assert [payload for _, payload, _ in found] == [np.full(12, v, "<u2").tobytes() for v in range(50)]
        assert {identifier for identifier, _, _ in found} == {DATA}
        times = [time_ns for _, _, time_ns in found]
        assert times == sorted(times)
        assert bus.counters.frames == 50
        assert not is_readable(bus)


def test_a_frame_that_trickles_in_has_the_time_of_its_last_byte() -> None:
    with line() as device, opened(device.path) as bus:
        batch = FrameBatch(8, 64)
        frame = data_frame(0x1234)
        for place in range(len(frame) - 1):
            device.write(frame[place : place + 1])
            assert is_readable(bus, 10)
            assert bus.receive(batch, 0) == 0
        before_ns = now_ns()
        device.write(frame[-1:])
        [(_, payload, time_ns)] = receive(bus, 1)
        assert payload == np.full(12, 0x1234, "<u2").tobytes()
        assert time_ns > before_ns


def test_frames_held_back_by_a_false_beginning_have_the_times_at_which_they_came() -> None:
    with line() as device, opened(device.path, PACKETS) as bus:
        batch = FrameBatch(8, 64)
        false_beginning = b"\xaa\xaa\xaa\x01\x30\x00"  # promises 56 bytes
        reads = [now_ns()]
        for part in (false_beginning, PACKETS.encode(1, b"one"), PACKETS.encode(2, b"two")):
            device.write(part)
            assert is_readable(bus, 10)
            assert bus.receive(batch, 0) == 0
            reads.append(now_ns())
        device.write(PACKETS.encode(3, bytes(30)))
        found = receive(bus, 3)
        assert [identifier for identifier, _, _ in found] == [1, 2, 3]
        assert all(begin < f[2] < end for f, begin, end in zip(found, reads[1:], [*reads[2:], now_ns()], strict=True))
        assert (bus.counters.errors, bus.counters.framing.skipped_bytes) == (1, len(false_beginning))


def test_garbage_is_skipped_and_counted() -> None:
    with line() as device, opened(device.path) as bus:
        garbage = bytes(range(1, 256)) * 20
        damaged = bytearray(data_frame(1))
        damaged[5] ^= 0x40
        device.write(garbage + b"\0" + data_frame(1) + bytes(damaged) + data_frame(2))
        found = receive(bus, 2)
        assert [payload[:1] for _, payload, _ in found] == [b"\1", b"\2"]
        assert bus.counters.errors == 2
        assert bus.counters.framing.skipped_bytes == len(garbage) + 1 + len(damaged)


def test_counters_go_on_over_another_framing_and_another_opening() -> None:
    with line() as device:
        with opened(device.path) as bus:
            device.write(data_frame(1) + b"half")
            receive(bus, 1)
            batch = FrameBatch(8, 64)

            def is_read() -> bool:
                if is_readable(bus, 0.05):
                    bus.receive(batch, 0)
                return bus.counters.framing.bytes_in == len(data_frame(1)) + 4

            wait_until(is_read)
            bus.use(PACKETS)
            device.write(PACKETS.encode(1, b"one"))
            receive(bus, 1)
            bus.close()
            bus.open()
            device.write(PACKETS.encode(1, b"two"))
            receive(bus, 1)
        counters = bus.counters.framing
        assert (counters.frames, counters.skipped_bytes) == (3, 4)
        assert counters.bytes_in == counters.frame_bytes + counters.skipped_bytes


def test_more_frames_than_a_batch_holds_stay_and_keep_the_bus_readable() -> None:
    with line() as device, opened(device.path) as bus:
        frames = [FRAMING.encode(1, bytes([number])) for number in range(100)]
        device.write(b"".join(frames))
        found = receive(bus, 100, capacity=7)
        assert [payload for _, payload, _ in found] == [bytes([number]) for number in range(100)]
        assert not is_readable(bus)


def test_bodies_too_long_for_the_batch_are_refused() -> None:
    with line() as device:
        bus = SerialBus(device.path, payload_size=8)
        bus.use(FRAMING)
        bus.open()
        try:
            device.write(FRAMING.encode(1, bytes(9)) + FRAMING.encode(2, bytes(8)))
            batch = FrameBatch(8, 8)
            wait_until(lambda: is_readable(bus, 0.05) and bus.receive(batch, 0) == 1)
            assert batch.wire["identifier"][0] == 2
            assert (bus.counters.frames, bus.counters.refused) == (1, 1)
        finally:
            bus.close()


def test_without_a_framing_bytes_come_as_they_are() -> None:
    with line() as device, opened(device.path, Unframed(64)) as bus:
        device.write(b"hello\r\n")
        assert b"".join(payload for _, payload, _ in receive(bus, 1)) == b"hello\r\n"
        bus.send(0, b"\x1b[c")
        assert device.read() == b"\x1b[c"


# Sending


def test_commands_are_framed_or_not() -> None:
    with line() as device, opened(device.path) as bus:
        bus.send(ASK, b"who")
        assert device.read() == FRAMING.encode(ASK, b"who")
        bus.use(FRAMING, Unframed())
        bus.send(0, b"1")
        assert device.read() == b"1"
        assert bus.counters.sent == 2


def test_what_the_port_does_not_take_follows_in_order_and_there_is_an_end_to_it() -> None:
    with line() as device, opened(device.path, Unframed()) as bus:
        pieces = [b"%07d " % number * 100 for number in range(1000)]
        sent = b""

        def send_all() -> None:
            nonlocal sent
            for piece in pieces:
                bus.send(0, piece)
                sent += piece

        with pytest.raises(BusSendError, match="takes nothing any more"):
            send_all()
        assert bus.counters.send_failures == 1
        got = b""
        batch = FrameBatch(8, 64)
        while len(got) < len(sent):
            got += device.read()
            if is_readable(bus):
                bus.receive(batch, 0)
        assert got == sent
        bus.send(0, b"again")
        assert device.read() == b"again"


def test_what_cannot_be_sent_is_refused() -> None:
    with line() as device, opened(device.path, listen_only=True) as bus:
        with pytest.raises(BusSendError, match="listen only"):
            bus.send(ASK, b"who")
    with line() as device, opened(device.path) as bus:
        with pytest.raises(BusSendError, match="1 to 64"):
            bus.send(ASK, b"")
        with pytest.raises(BusSendError, match="identifier 0x100"):
            bus.send(0x100, b"x")
        bus.close()
        with pytest.raises(BusSendError, match="not open"):
            bus.send(ASK, b"who")


# Names, and pyserial's URLs


@pytest.mark.parametrize(
    ("name", "interface", "channel", "options"),
    [
        ("/dev/ttyUSB0", "serial", "/dev/ttyUSB0", {}),
        ("/dev/ttyUSB0?baudrate=9600", "serial", "/dev/ttyUSB0", {"baudrate": "9600"}),
        ("serial:/dev/ttyUSB0", "serial", "/dev/ttyUSB0", {}),
        ("serial:?serial_number=A7", "serial", "", {"serial_number": "A7"}),
        ("socket://host:4000", "serial", "socket://host:4000", {}),
        ("serial:rfc2217://host:4000", "serial", "rfc2217://host:4000", {}),
        ("/dev/serial/by-id/usb-a:b-if00", "serial", "/dev/serial/by-id/usb-a:b-if00", {}),
        ("./port", "serial", "./port", {}),
        ("ports/left?baudrate=9600", "serial", "ports/left", {"baudrate": "9600"}),
        ("slcan:/dev/ttyACM0", "slcan", "/dev/ttyACM0", {}),
        ("port", "socketcan", "port", {}),
        ("pty", "pty", "", {}),
        ("pty:/tmp/skin", "pty", "/tmp/skin", {}),
    ],
)
def test_names(name: str, interface: str, channel: str, options: dict[str, str]) -> None:
    assert parse_bus_name(name) == (interface, channel, options)


def test_buses_of_names() -> None:
    assert type(make_bus("/dev/ttyUSB0")) is SerialBus
    assert type(make_bus("pty")) is PtyBus


def test_a_socket_as_a_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        with opened(f"socket://127.0.0.1:{server.getsockname()[1]}") as bus:
            peer, _ = server.accept()
            with peer:
                peer.sendall(data_frame(4))
                assert receive(bus, 1)[0][1][:1] == b"\4"
                bus.send(ASK, b"who")
                assert peer.recv(100) == FRAMING.encode(ASK, b"who")
            assert is_readable(bus, 10)
            with pytest.raises(BusNotAvailable, match="went away"):
                bus.receive(FrameBatch(8, 64), 0)
        port = server.getsockname()[1]
    with pytest.raises(BusNotAvailable, match="cannot be opened"):
        SerialBus(f"socket://127.0.0.1:{port}").open()


def test_a_line_without_a_descriptor() -> None:
    with opened("loop://") as bus:
        for value in range(5):
            bus.send(value, bytes(40))
        assert [identifier for identifier, _, _ in receive(bus, 5)] == list(range(5))
        assert not is_readable(bus)


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial 3.5
def test_a_port_of_another_machine() -> None:
    """rfc2217: pyserial's own server, with a port that gives back what it gets."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        ending = threading.Event()

        def serve() -> None:
            peer, _ = server.accept()
            peer.settimeout(0.05)
            with peer, serial.serial_for_url("loop://", timeout=0.01) as port:
                stream = peer.makefile("wb", buffering=0)
                manager = PortManager(port, stream)
                while not ending.is_set():
                    with contextlib.suppress(TimeoutError):
                        data = peer.recv(1024)
                        if not data:
                            break
                        port.write(b"".join(manager.filter(data)))
                    peer.sendall(b"".join(manager.escape(port.read(port.in_waiting or 1))))
                stream.close()

        serving = threading.Thread(target=serve, daemon=True)
        serving.start()
        try:
            with opened(f"rfc2217://127.0.0.1:{server.getsockname()[1]}") as bus:
                bus.send(7, bytes(range(200, 256)))
                assert receive(bus, 1)[0][:2] == (7, bytes(range(200, 256)))
        finally:
            ending.set()
            serving.join(30)
        assert not serving.is_alive()


def test_pyserial_can_spy_on_a_port(capfd: pytest.CaptureFixture[str]) -> None:
    with line() as device, opened(f"spy://{device.path}", options={"color": ""}) as bus:
        device.write(data_frame(5))
        assert receive(bus, 1)[0][1][:1] == b"\5"
        bus.send(ASK, b"who")
        assert device.read() == FRAMING.encode(ASK, b"who")
        device.unplug()

        def gone() -> bool:
            try:
                bus.receive(FrameBatch(8, 64), 0)
            except BusNotAvailable:
                return True
            return False

        wait_until(gone)
    assert "RX" in capfd.readouterr().err


# The device's end


def test_a_pseudo_terminal_for_emulators(tmp_path: Path) -> None:
    link = tmp_path / "skin"
    emulator = PtyBus(str(link), payload_size=64)
    emulator.use(FRAMING)
    emulator.open()
    try:
        assert str(link) in emulator.note
        for _ in range(2):  # programs may come and go
            with opened(str(link)) as bus:
                emulator.send(DATA, b"hello")
                assert receive(bus, 1)[0][:2] == (DATA, b"hello")
                bus.send(ASK, b"who")
                assert receive(emulator, 1)[0][:2] == (ASK, b"who")
        assert not is_readable(emulator)
    finally:
        emulator.close()
    assert not link.is_symlink()


def test_a_link_that_cannot_be_made(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("precious")
    with pytest.raises(BusNotAvailable, match="cannot make the link"):
        PtyBus(str(file)).open()
    assert file.read_text() == "precious"


def test_bytes_that_wait_go_on_to_the_next_framing_with_their_times() -> None:
    """Also more pieces than the next framing has room for."""
    for many in (3, 60):
        old = stream_of(Recurring(b"\xaa\x55", 60, 60), 64, BusCounters())
        for number in range(many):
            old.add(b"\xaa\x55"[number % 2 :][:1], 100 + number)
        rest = old.rest()
        assert rest == [(b"\xaa\x55"[n % 2 :][:1], 100 + n) for n in range(many)]
        new = stream_of(Packet(sync=b"\xaa\x55", length=2), 8, BusCounters())
        new.begin(rest)
        batch = FrameBatch(64)
        assert new.fill(batch, 0) == many // 2
        assert batch.time_ns[batch.stop - 1] == 100 + many // 2 * 2 - 1
