"""A robot's port as a bus: found, read, lost and found again; what it says wrongly; what piles up."""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware_drivers.bus import FrameBatch
from skinware_drivers.bus_names import BusName
from skinware_drivers.registry import make_bus
from skinware_drivers.streams.yarp_bus import YarpBus
from skinware_drivers.streams.yarp_messages import LENGTH, YarpMessages
from skinware_drivers.testing.waiting import wait_until
from tests.streams.peers import received, why_lost
from tests.yarp.peers import LOCAL, PORT, READING, Answering, Robot, message, robot, until_gone, vector

TWELVE = [float(value) for value in range(12)]


def says(*pieces: bytes) -> Callable[[socket.socket], None]:
    """These, and no more until the reader goes."""

    def speak(caller: socket.socket) -> None:
        for piece in pieces:
            caller.sendall(piece)
        until_gone(caller)

    return speak


@contextmanager
def opened(name: str, length: int = 12) -> Iterator[tuple[YarpBus, FrameBatch]]:
    bus = make_bus(name, payload_size=56)
    assert isinstance(bus, YarpBus)
    bus.use(YarpMessages(length, ((0, 0),)))
    bus.open()
    try:
        yield bus, FrameBatch(5000, 56)
    finally:
        bus.close()


def firsts(batch: FrameBatch) -> list[float]:
    """The first value of each frame that has values."""
    rows = batch.wire[batch.start : batch.stop]
    rows = rows[rows["identifier"] >> 8 != LENGTH]
    return [struct.unpack_from("<f", row["payload"].tobytes(), 4)[0] for row in rows]


def take(bus: YarpBus, batch: FrameBatch, count: int) -> list[float]:
    """So many frames."""
    return received(bus, batch, firsts, count)


def test_a_port_is_found_and_nothing_is_said_but_what_makes_it_speak() -> None:
    with robot(says(vector(TWELVE), vector([5.0] * 12))) as there, opened(there.bus) as (bus, batch):
        assert take(bus, batch, 2) == [0, 5]
        assert there.asked == [b"query " + PORT.encode()]
        assert there.heard == [READING]
        assert bus.name == f"bus {there.bus}"
        with pytest.raises(BusSendError, match="only read"):
            bus.send(0, b"")
    assert there.heard == [READING]


def test_a_port_of_the_configured_name_server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with robot(says(vector(TWELVE))) as there:
        (tmp_path / "yarp.conf").write_text(f"{LOCAL} {there.server.port}\n")
        monkeypatch.setenv("YARP_CONFIG_HOME", str(tmp_path))
        with opened(f"yarp://{PORT}") as (bus, batch):
            assert take(bus, batch, 1) == [0]


def test_why_there_is_no_port() -> None:
    with robot(until_gone) as there:
        del there.ports[PORT]
        with pytest.raises(BusNotAvailable, match=f"knows no port {PORT}: does the robot's program run"):
            make_bus(there.bus).open()
        there.ports[PORT] = ("224.2.1.1", 10001, "mcast")
        with pytest.raises(BusNotAvailable, match="called by mcast"):
            make_bus(there.bus).open()
        with socket.create_server((LOCAL, 0)) as probe:
            nobody = probe.getsockname()[1]
        there.ports[PORT] = (LOCAL, nobody, "tcp")
        with pytest.raises(BusNotAvailable, match="nothing listens at this port"):
            make_bus(there.bus).open()
        bus = there.bus
    with pytest.raises(BusNotAvailable, match=r"name server at .*refused"):
        make_bus(bus).open()


@pytest.mark.parametrize(
    "name", ["yarp://", "yarp:///", "yarp://host", "yarp://host:10000/", "yarp://host:1x/a", "yarp://h/a b"]
)
def test_impossible_names(name: str) -> None:
    with pytest.raises(ConfigurationError, match="bus yarp://"):
        make_bus(name)


def test_what_the_name_of_such_a_bus_means() -> None:
    assert BusName.of("yarp://h:1/x").is_only_asked
    assert (
        BusName.of("yarp://h:1/x?silence_s=0").place
        == BusName.of("yarp://h:1/x").place
        != BusName.of("yarp://h:1/y").place
    )
    with pytest.raises(ConfigurationError, match="silence"):
        make_bus("yarp://h/x?silense_s=3")


def test_a_port_that_hangs_up_is_gone_and_what_it_said_before_counts() -> None:
    def speak(caller: socket.socket) -> None:
        caller.sendall(vector(TWELVE) + vector(TWELVE)[:50])

    with robot(speak) as there, opened(there.bus) as (bus, batch):
        assert "closed by the other end" in why_lost(bus, batch)
        assert firsts(batch) == [0]


def test_a_port_that_begins_anew_elsewhere_is_found_again() -> None:
    with robot(says(vector(TWELVE))) as there, opened(there.bus) as (bus, batch):
        assert take(bus, batch, 1) == [0]
        there.restart_port()
        why_lost(bus, batch)
        bus.close()
        bus.open()
        assert take(bus, batch, 2) == [0, 0]
        assert len(there.asked) == 2


def test_silence_is_not_waited_out() -> None:
    with robot(says(vector(TWELVE))) as there, opened(f"{there.bus}?silence_s=0.05") as (bus, batch):
        take(bus, batch, 1)

        def complains() -> bool:
            try:
                bus.check()
            except BusNotAvailable as error:
                return "no message for 0.05 s" in str(error)
            return False

        wait_until(complains)


@pytest.mark.parametrize(
    "wrong",
    [
        vector(TWELVE[:5]),
        vector(TWELVE * 2),
        message(struct.pack("<iii8s", 256, 1, 5, b"no skin")),
        message(bytes(100)),
        vector([1.0] * 7000),
    ],
)
def test_what_is_wrong_is_counted_and_costs_itself_alone(wrong: bytes) -> None:
    with robot(says(vector(TWELVE), wrong, vector([7.0] * 12))) as there, opened(there.bus) as (bus, batch):
        assert take(bus, batch, 2) == [0, 7]
        framing = bus.counters.framing
        assert framing.refused >= 1
        assert framing.bytes_in == framing.frame_bytes + framing.idle_bytes + framing.skipped_bytes


def test_bytes_that_are_no_messages_need_no_room() -> None:
    over = threading.Event()

    def speak(caller: socket.socket) -> None:
        for _ in range(200):
            caller.sendall(b"YA\n\0" * 16_384)
        caller.sendall(vector([7.0] * 12))
        over.set()
        until_gone(caller)

    with robot(speak) as there, opened(there.bus) as (bus, batch):
        assert take(bus, batch, 1) == [7]
        assert over.is_set()
        assert bus.counters.framing.skipped_bytes >= 1


def test_what_answers_otherwise_is_no_port() -> None:
    def speak(caller: socket.socket) -> None:
        caller.sendall(b"HTTP/1.1 400 Bad Request")
        until_gone(caller)

    with contextlib.closing(Answering(speak)) as other, robot(until_gone) as there:
        there.ports[PORT] = (LOCAL, other.port, "tcp")
        with pytest.raises(BusNotAvailable, match="is no port of YARP"):
            make_bus(there.bus).open()


def test_a_port_that_dies_of_readers_in_text_lives() -> None:
    with robot(says(vector(TWELVE))) as there:
        for _ in range(5):
            with opened(there.bus) as (bus, batch):
                assert take(bus, batch, 1) == [0]
        assert not there.is_dead
        with socket.create_connection((LOCAL, there.port.port)) as reader:
            reader.sendall(b"CONNECT skinware\nr\n")
            assert reader.recv(100) == b""
        assert there.is_dead


def pile_up(there: Robot, bus: YarpBus, count: int) -> None:
    """Have so many messages come that nobody reads: 0, 1, 2 ..."""
    wait_until(lambda: len(there.port.callers) > 0 and len(there.heard) > 0)
    del bus
    for number in range(count):
        there.port.callers[-1].sendall(vector([float(number)] + [250.125] * 11))


def waiting(bus: YarpBus) -> int:
    """Bytes that the kernel has for it."""
    assert bus._port is not None
    return int.from_bytes(fcntl.ioctl(bus._port.fileno(), termios.FIONREAD, bytes(4)), "little")


def test_a_short_pile_is_read_to_its_last_message() -> None:
    with robot(until_gone) as there, opened(there.bus) as (bus, batch):
        pile_up(there, bus, 300)
        assert take(bus, batch, 300) == list(range(300))
        assert bus.counters.dropped == 0


def test_of_a_high_pile_only_the_newest_is_used_and_the_port_never_waits() -> None:
    count = 1500
    with robot(until_gone) as there, opened(there.bus) as (bus, batch):
        pile_up(there, bus, count)  # which did not block, though nobody read
        wait_until(lambda: waiting(bus) > 100_000)
        seen: list[float] = []

        def has_newest() -> bool:
            batch.clear()
            bus.receive(batch, 0)
            seen.extend(firsts(batch))
            return bool(seen) and seen[-1] == count - 1

        wait_until(has_newest)
        assert seen == sorted(seen)
        assert len(seen) < count
        assert bus.counters.dropped == count - len(seen)
        framing = bus.counters.framing
        assert (framing.refused, framing.skipped_bytes) == (0, 0)


def test_many_readers_that_come_and_go_leave_nothing() -> None:
    with robot(says(vector(TWELVE))) as there:
        for _ in range(20):
            with contextlib.suppress(BusNotAvailable), opened(there.bus) as (bus, batch):
                assert take(bus, batch, 1) == [0]
