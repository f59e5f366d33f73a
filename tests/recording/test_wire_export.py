"""What was recorded of wires, read by programs of others: python-can, and a strict reader of pcapng."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import can
import pytest

import skinware.recording
from skinware.cli._command import exit_status
from skinware.cli.convert import command as convert
from skinware.errors import BadRecording
from skinware.recording import Recording
from skinware.recording.mcap_writing import McapFile, OpenChunk
from skinware.recording.topics import Channels
from skinware.recording.wire import Chosen, export_candump, export_pcapng
from skinware.wire import SERIAL, SERIAL_HEADER, SOCKETCAN
from skinware_drivers.bus import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from skinware_drivers.wire_tap import WireTap

_PUBLISHED_NS = 50_000_000
MONOTONIC_NS, EPOCH_NS = 1_000_000_000_000, 1_700_000_000_123_456_789


class Sent(NamedTuple):
    """What is on a wire, ns after the beginning."""

    at_ns: int
    identifier: int
    payload: bytes
    flags: int = 0
    is_sent: bool = False


ON_CAN0 = [
    Sent(0, 0x473, b"\x40\xf0"),
    Sent(1_000_000, 0x321, b"ask", is_sent=True),
    Sent(2_000_999, EXTENDED_FLAG | 0x1234567, bytes(range(8))),
    Sent(3_000_000, REMOTE_FLAG | 0x123, b""),
    Sent(4_000_000, ERROR_FLAG | 0x80, bytes(8)),
    Sent(5_000_000, 0x100, bytes(range(12)), flags=1),
    Sent(6_000_000, 0x101, b"", flags=2 | 4),
]
ON_VCAN1 = [Sent(500_000, 0x7FF, b"\1"), Sent(5_500_000, 0x7FE, b"\2")]


def write_recording(path: Path, fill: Callable[[dict[tuple[str, str], WireTap]], None]) -> None:
    """A recording of taps, made by hand; what is kept counts from the beginning."""
    taps: dict[tuple[str, str], WireTap] = {}
    fill(taps)
    file, channels, chunk = McapFile(path), Channels(), OpenChunk()
    chunk.add(*channels.of_all("/skin/clock"), 0, EPOCH_NS, b"{}")
    for (driver, bus), tap in taps.items():
        for number, batch in enumerate(tap.fetch()):
            head = struct.pack("<QQqQ", 1, number, MONOTONIC_NS + _PUBLISHED_NS, tap.missed)
            chunk.add(*channels.of_wire(driver, bus), number, EPOCH_NS + _PUBLISHED_NS, head + bytes(batch))
    file.add(chunk.close())
    file.finish()


def keep(taps: dict[tuple[str, str], WireTap], driver: str, bus: str, frames: list[Sent]) -> None:
    tap = taps.setdefault((driver, bus), WireTap())
    tap.open()
    for frame in frames:
        at_ns = MONOTONIC_NS + frame.at_ns
        tap.keep_frame(at_ns, frame.identifier, frame.payload, flags=frame.flags, is_sent=frame.is_sent)


def two_buses(taps: dict[tuple[str, str], WireTap]) -> None:
    keep(taps, "torso", "can0?buffer=100000", ON_CAN0[:1] + ON_CAN0[2:] + ON_CAN0[1:2])  # sent ones come late
    keep(taps, "torso", "socketcan:vcan1", ON_VCAN1)


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Callable[..., Recording]]:
    opened: list[Recording] = []

    def make(fill: Callable[[dict[tuple[str, str], WireTap]], None]) -> Recording:
        path = tmp_path / f"{len(opened)}.mcap"
        write_recording(path, fill)
        opened.append(skinware.recording.open(path))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


def expected_order() -> list[tuple[str, Sent]]:
    both = [("can0", sent) for sent in ON_CAN0] + [("vcan1", sent) for sent in ON_VCAN1]
    return sorted(both, key=lambda one: one[1].at_ns)


def test_python_can_reads_the_log(recording: Callable[..., Recording], tmp_path: Path) -> None:
    log = tmp_path / "wire.log"
    told = export_candump(recording(two_buses), log)
    assert (dict(told.counts), told.notes) == ({"can0": 7, "vcan1": 2}, [])
    messages = list(can.CanutilsLogReader(log))
    assert len(messages) == 9
    for message, (channel, sent) in zip(messages, expected_order(), strict=True):
        assert abs(message.timestamp - (EPOCH_NS + sent.at_ns) / 1e9) < 2e-6
        if sent.identifier & ERROR_FLAG:
            assert message.is_error_frame
            continue
        assert (message.channel, message.is_rx) == (channel, not sent.is_sent)
        assert message.arbitration_id == sent.identifier & 0x1FFF_FFFF
        assert message.is_extended_id == bool(sent.identifier & EXTENDED_FLAG)
        assert message.is_remote_frame == bool(sent.identifier & REMOTE_FLAG)
        assert message.is_fd == (len(sent.payload) > 8 or bool(sent.flags & 4))
        assert message.bitrate_switch == bool(sent.flags & 1)
        assert message.error_state_indicator == bool(sent.flags & 2)
        assert bytes(message.data) == sent.payload


def test_the_log_is_candumps(recording: Callable[..., Recording], tmp_path: Path) -> None:
    log = tmp_path / "wire.log"
    export_candump(recording(two_buses), log)
    assert log.read_text().splitlines()[:4] == [
        "(1700000000.123456) can0 473#40F0 R",
        "(1700000000.123956) vcan1 7FF#01 R",
        "(1700000000.124456) can0 321#61736B T",
        "(1700000000.125457) can0 01234567#0001020304050607 R",
    ]
    assert "(1700000000.127456) can0 20000080#0000000000000000 R" in log.read_text()
    assert "(1700000000.126456) can0 123#R R" in log.read_text()


def test_part_of_the_time(recording: Callable[..., Recording], tmp_path: Path) -> None:
    told = export_candump(recording(two_buses), tmp_path / "wire.log", Chosen(start_s=0.0018, end_s=0.0045))
    assert dict(told.counts) == {"can0": 3}


def blocks(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Blocks of a little-endian pcapng file, with everything checked that its draft says of them."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        assert size % 4 == 0
        assert size >= 12
        assert struct.unpack_from("<I", data, at + size - 4)[0] == size
        yield kind, data[at + 8 : at + size - 4]
        at += size
    assert at == len(data)


def options(data: bytes) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    at = 0
    while at < len(data):
        code, length = struct.unpack_from("<HH", data, at)
        if code == 0:
            assert length == 0
            assert at + 4 == len(data)
            return found
        found[code] = data[at + 4 : at + 4 + length]
        at += 4 + -(-length // 4) * 4
    assert not found
    return found


class Packet(NamedTuple):
    interface: str
    link_type: int
    time_ns: int
    direction: int
    data: bytes


def read_pcapng(path: Path) -> list[Packet]:
    (kind, section), *rest = blocks(path.read_bytes())
    assert (kind, section[:16]) == (0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    interfaces: list[tuple[str, int]] = []
    packets = []
    for kind, body in rest:
        if kind == 1:
            link_type, reserved, longest = struct.unpack_from("<HHI", body)
            told = options(body[8:])
            assert (reserved, longest, told[9]) == (0, 0, b"\x09")
            interfaces.append((told[2].decode(), link_type))
        else:
            assert kind == 6
            number, high, low, caught, length = struct.unpack_from("<IIIII", body)
            assert caught == length
            data, rest_of_it = body[20 : 20 + caught], body[20 + -(-caught // 4) * 4 :]
            (flags,) = struct.unpack("<I", options(rest_of_it)[2])
            name, link_type = interfaces[number]
            packets.append(Packet(name, link_type, high << 32 | low, flags, data))
    return packets


def test_a_strict_reader_reads_pcapng(recording: Callable[..., Recording], tmp_path: Path) -> None:
    path = tmp_path / "wire.pcapng"
    told = export_pcapng(recording(two_buses), path)
    assert dict(told.counts) == {"can0": 7, "vcan1": 2}
    for packet, (channel, sent) in zip(read_pcapng(path), expected_order(), strict=True):
        assert (packet.interface, packet.link_type) == (channel, SOCKETCAN)
        assert packet.time_ns == EPOCH_NS + sent.at_ns
        assert packet.direction == (2 if sent.is_sent else 1)
        identifier, length, flags, reserved = struct.unpack_from(">IBBH", packet.data)
        is_fd = len(sent.payload) > 8 or bool(sent.flags & 4)
        assert (identifier, length, reserved) == (sent.identifier, len(sent.payload), 0)
        assert flags == sent.flags | (4 if is_fd else 0)
        assert packet.data[8:] == sent.payload


def one_line(taps: dict[tuple[str, str], WireTap]) -> None:
    tap = taps.setdefault(("hand", "/dev/ttyUSB0"), WireTap())
    tap.open()
    tap.keep_bytes(MONOTONIC_NS, b"hello")
    tap.keep_bytes(MONOTONIC_NS + 5, b"you", is_sent=True)


def test_serial_lines_are_in_pcapng_and_not_in_candump(recording: Callable[..., Recording], tmp_path: Path) -> None:
    path = tmp_path / "wire.pcapng"
    opened = recording(one_line)
    export_pcapng(opened, path)
    first, second = read_pcapng(path)
    assert first == Packet("ttyUSB0", SERIAL, EPOCH_NS, 1, SERIAL_HEADER.pack(1, 0, 0) + b"hello")
    assert second == Packet("ttyUSB0", SERIAL, EPOCH_NS + 5, 2, SERIAL_HEADER.pack(1, 1, 0) + b"you")
    with pytest.raises(BadRecording, match="no frame of a CAN bus was recorded"):
        export_candump(opened, tmp_path / "wire.log")
    assert not (tmp_path / "wire.log").exists()

    def both(taps: dict[tuple[str, str], WireTap]) -> None:
        one_line(taps)
        two_buses(taps)

    told = export_candump(recording(both), tmp_path / "wire.log")
    assert told.notes == ["/dev/ttyUSB0 of hand left out: the format has no serial lines"]


def test_two_drivers_on_one_bus_are_told_apart(recording: Callable[..., Recording], tmp_path: Path) -> None:
    def fill(taps: dict[tuple[str, str], WireTap]) -> None:
        for driver in ("a", "b"):
            keep(taps, driver, "can0", ON_VCAN1)

    assert dict(export_candump(recording(fill), tmp_path / "wire.log").counts) == {"can0": 2, "can0_2": 2}


@pytest.mark.thorough
def test_what_is_cut_or_missed_is_told(recording: Callable[..., Recording], tmp_path: Path) -> None:
    def fill(taps: dict[tuple[str, str], WireTap]) -> None:
        keep(taps, "torso", "can0", [Sent(0, 0x100, bytes(8), flags=0x84)])
        for _ in range(60_000):
            taps["torso", "can0"].keep_frame(MONOTONIC_NS, 0x123, b"abc")

    told = export_candump(recording(fill), tmp_path / "wire.log")
    missed = 60_001 - told.counts["can0"]
    assert missed > 0
    assert told.notes == [
        f"can0 of torso: {missed} missed while it was recorded",
        "1 CAN FD frames without their end: their driver knows none that are so long",
    ]


def test_refusals(recording: Callable[..., Recording], tmp_path: Path) -> None:
    nothing = recording(lambda taps: None)
    for export in (export_candump, export_pcapng):
        with pytest.raises(BadRecording, match="no wire was recorded: skin-record --wire records"):
            export(nothing, tmp_path / "x")
        assert not (tmp_path / "x").exists()
        (tmp_path / "there").write_text("mine")
        with pytest.raises(FileExistsError):
            export(recording(two_buses), tmp_path / "there")
        assert (tmp_path / "there").read_text() == "mine"


def test_skin_convert_writes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    def both(taps: dict[tuple[str, str], WireTap]) -> None:
        one_line(taps)
        two_buses(taps)

    write_recording(Path("walk.mcap"), both)
    assert exit_status(convert, ["walk.mcap", "--to", "candump"]) == 0
    out, err = capsys.readouterr()
    assert out == "walk.log: 7 frames of can0, 2 frames of vcan1\n"
    assert err == "skin-convert: /dev/ttyUSB0 of hand left out: the format has no serial lines\n"
    assert len(list(can.CanutilsLogReader("walk.log"))) == 9
    assert exit_status(convert, ["walk.mcap", "hand", "--to", "pcapng"]) == 0
    assert [packet.interface for packet in read_pcapng(Path("walk.pcapng"))] == ["ttyUSB0"] * 2
    for arguments, words in {
        ("--to", "pcapng"): "walk.pcapng: exists already",
        ("nobody", "--to", "candump", "-o", "x"): "no wire of 'nobody' in it; there are: hand, torso",
        ("--type", "pressure", "--to", "candump", "-o", "x"): "select drivers, not sensors",
    }.items():
        assert exit_status(convert, ["walk.mcap", *arguments]) in (1, 2)
        assert words in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["walk.log", "walk.mcap", "walk.pcapng"]
