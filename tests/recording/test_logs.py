"""Logs of CAN buses by other programs, as buses of drivers: every frame, and the values that a driver had live."""

from __future__ import annotations

import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from can.io import ASCWriter, BLFWriter, CanutilsLogWriter

import skinware.recording
from skinware.errors import ConfigurationError
from skinware.recording import Series
from skinware.recording.wire import export_pcapng
from skinware.status import Status
from skinware.wire import ERROR, EXTENDED, IS_FD, REMOTE, WireItem
from skinware_drivers.bus import FrameBatch
from skinware_drivers.cli.capturing import only_listened
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.hand_clock import HandClock
from skinware_drivers.virtual.logs import LogFile
from skinware_drivers.virtual.recorded import replayed_bus
from tests.recording.rig import recording
from tests.recording.test_wire_replay import OPTIONS, record

US = 1000
EPOCH_NS = 1_700_000_000_123_456_000
WRITERS: dict[str, type[Any]] = {"log": CanutilsLogWriter, "asc": ASCWriter, "blf": BLFWriter}


def frames(n: int, *, fd: bool = False) -> list[WireItem]:
    """Frames of all kinds: 11 and 29 bits, received and sent, remote, empty, CAN FD."""
    numbers = np.random.default_rng(3)
    found = []
    for number in range(n):
        data = numbers.bytes((0, 1, 8, 8, 5)[number % 5])
        identifier, flags = 0x100 + number % 0x600, 0
        if number % 3 == 1:
            identifier = EXTENDED | (0x18DA0000 + number)
        if number % 7 == 3:
            identifier, data = identifier | REMOTE, b""
        elif fd and number % 4 == 2:
            data, flags = numbers.bytes(64), IS_FD | 1
        time_ns = EPOCH_NS + number * 1250 * US
        found.append(WireItem(time_ns, time_ns, number % 4 == 0, identifier, flags, data))
    return found


def message(item: WireItem, channel: object) -> can.Message:
    identifier = item.identifier or 0
    return can.Message(
        timestamp=item.epoch_ns / 1e9,
        arbitration_id=identifier & 0x1FFFFFFF,
        is_extended_id=bool(identifier & EXTENDED),
        is_remote_frame=bool(identifier & REMOTE),
        is_error_frame=bool(identifier & ERROR),
        is_rx=not item.is_sent,
        is_fd=bool(item.flags & IS_FD),
        bitrate_switch=bool(item.flags & 1),
        data=item.data,
        channel=channel,  # type: ignore[arg-type]
    )


def write(path: Path, items: list[WireItem], channel: object = 0) -> None:
    """Write a log with a writer of python-can, or as pcap."""
    if path.suffix == ".pcap":
        write_pcap(path, items)
        return
    with WRITERS[path.suffix[1:]](path) as writer:
        for item in items:
            writer.on_message_received(message(item, channel))


def write_pcap(path: Path, items: list[WireItem], order: str = "<", magic: int = 0xA1B23C4D, link: int = 227) -> None:
    """As https://www.ietf.org/archive/id/draft-ietf-opsawg-pcap has it; frames as LINKTYPE_CAN_SOCKETCAN says."""
    parts = [struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 65535, link)]
    unit = 1 if magic == 0xA1B23C4D else 1000
    for item in items:
        data = struct.pack(">IBBH", item.identifier or 0, len(item.data), item.flags, 0) + item.data
        seconds, fraction = divmod(item.epoch_ns, 10**9)
        parts.append(struct.pack(f"{order}IIII", seconds, fraction // unit, len(data), len(data)) + data)
    path.write_bytes(b"".join(parts))


def read(path: Path) -> list[WireItem]:
    (wire,) = LogFile(str(path)).wires
    return list(wire.items())


def require_same(found: list[WireItem], items: list[WireItem], *, directed: bool, absolute: bool = True) -> None:
    assert len(found) == len(items)
    for one, other in zip(found, items, strict=True):
        assert (one.identifier, one.data) == (other.identifier, other.data)
        assert one.flags & (IS_FD | 1) == other.flags
        assert one.is_sent == (directed and other.is_sent)
        moved = 0 if absolute else items[0].time_ns - found[0].time_ns
        assert abs(one.time_ns + moved - other.time_ns) <= US


@pytest.mark.parametrize("suffix", ["log", "asc", "blf", "pcap"])
def test_every_frame_is_read(tmp_path: Path, suffix: str) -> None:
    items = frames(50, fd=suffix != "asc")  # its writer has other lengths for CAN FD
    path = tmp_path / f"can.{suffix}"
    write(path, items)
    require_same(read(path), items, directed=suffix != "pcap", absolute=suffix in ("log", "pcap"))


@pytest.mark.parametrize(("order", "magic"), [(">", 0xA1B2C3D4), ("<", 0xA1B2C3D4), (">", 0xA1B23C4D)])
def test_pcap_of_other_machines(tmp_path: Path, order: str, magic: int) -> None:
    items = frames(20, fd=True)
    write_pcap(tmp_path / "can.pcap", items, order, magic)
    require_same(read(tmp_path / "can.pcap"), items, directed=False)
    (tmp_path / "eth.pcap").write_bytes(b"")
    write_pcap(tmp_path / "eth.pcap", items, order, magic, link=1)
    with pytest.raises(ConfigurationError, match=r"link type 1, not of CAN \(227\)"):
        read(tmp_path / "eth.pcap")


def test_pcapng_in_big_endian_with_units_and_names(tmp_path: Path) -> None:
    def block(kind: int, body: bytes) -> bytes:
        return struct.pack(">II", kind, 12 + len(body)) + body + struct.pack(">I", 12 + len(body))

    name, unit = struct.pack(">HH5s3x", 2, 5, b"vcan7"), struct.pack(">HHB3x", 9, 1, 0x80 | 20)  # 2**-20 s
    items = frames(20)
    parts = [block(0x0A0D0D0A, struct.pack(">IHHq", 0x1A2B3C4D, 1, 0, -1)), block(5, bytes(12))]
    parts += [block(1, struct.pack(">HHI", 227, 0, 0) + name + unit), block(1, struct.pack(">HHI", 227, 0, 0))]
    for item in items:
        data = struct.pack(">IBBH", item.identifier or 0, len(item.data), 0, 0) + item.data
        units = item.epoch_ns * 2**20 // 10**9
        flags = struct.pack(">HHI", 2, 4, 2 if item.is_sent else 1)
        head = struct.pack(">IIIII", 0, units >> 32, units & 0xFFFFFFFF, len(data), len(data))
        parts.append(block(6, head + data + bytes(-len(data) % 4) + flags))
    path = tmp_path / "can.pcapng"
    path.write_bytes(b"".join(parts))
    (wire,) = LogFile(str(path)).wires
    assert wire.bus == "vcan7"
    require_same(list(wire.items()), items, directed=True)
    path.write_bytes(b"".join(parts)[:-9])
    assert len(read(path)) == 19


def test_buses_of_a_log(tmp_path: Path) -> None:
    path = tmp_path / "two.log"
    lines = [f"({number}.000000) can{number % 2} {0x100 + number:03X}#0{number}" for number in range(8)]
    path.write_text("\n".join(lines) + "\n(8.0) can0 20000004#0000000000000000\n")  # and an error frame
    with pytest.raises(ConfigurationError, match="which bus\\? there are: bus=can0, bus=can1"):
        replayed_bus(str(path))
    assert replayed_bus(str(path), {"bus": "can1"}).name == f"bus replay:{path} (can1)"
    first, second = LogFile(str(path)).wires
    assert [item.data[0] for item in first.items()] == [0, 2, 4, 6]
    assert [item.data[0] for item in second.items(start_s=2, end_s=7)] == [3, 5]
    assert only_listened([f"file:{path}?bus=can0"])
    path.write_text("(1.0) can0 123#00 T\n(1.1) can0 124#00 R\n")
    assert not only_listened([f"file:{path}"])


DAMAGED: list[tuple[str, bytes, str]] = [
    ("no.log", b"hello\n", "no log of a CAN bus"),
    ("empty.log", b"", "no log of a CAN bus"),
    ("hex.log", b"\n(1.1) can0 123#0G\n", "hex.log, line 2: damaged"),
    ("none.asc", b"date Mon\nbase hex  timestamps absolute\n", "no frame of a CAN bus in it"),
    ("bad.blf", b"LOGG" + bytes(60), "bad.blf, byte"),
    (
        "cut.pcap",
        struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, 227) + bytes(5),
        "byte 29: cut off in a packet",
    ),
    ("bad.pcapng", struct.pack("<III", 0x0A0D0D0A, 28, 0x1A2B3C4D) + bytes(16) + bytes(12), "byte 28: damaged"),
]


@pytest.mark.parametrize(("name", "contents", "words"), DAMAGED, ids=[name for name, _, _ in DAMAGED])
def test_damaged_and_foreign_logs_get_a_clear_line(tmp_path: Path, name: str, contents: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(contents)
    with pytest.raises(ConfigurationError) as error:
        replayed_bus(str(tmp_path / name))
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("before", [1, 10_100])
def test_a_log_that_is_damaged_later_ends_there(tmp_path: Path, caplog: pytest.LogCaptureFixture, before: int) -> None:
    path = tmp_path / "late.log"
    path.write_text("".join(f"({n / 1000:.6f}) can0 123#00\n" for n in range(before)) + "(11.0) can0 \n(12) can0 1#\n")
    (wire,) = LogFile(str(path)).wires
    assert len(list(wire.items())) == before
    assert [record.message.partition(": damaged")[0] for record in caplog.records] == [f"{path}, line {before + 1}"]


@pytest.mark.parametrize("before", ["(1.1) can0 123#1122", "date Mon\nbase hex\n 1.1 1  123  Rx   d 2 11 22"])
def test_a_frame_that_is_cut_off_is_none(tmp_path: Path, caplog: pytest.LogCaptureFixture, before: str) -> None:
    """Its data would be half of those that were on the bus."""
    path, last = tmp_path / "cut", before.splitlines()[-1].replace("d 2", "d 1")
    path.write_text(f"{before}\n{last[:-2].rstrip()}")
    (wire,) = LogFile(str(path)).wires
    assert [item.data.hex() for item in wire.items()] == ["1122"]
    assert "cut off: it has no line feed" in caplog.text


def test_a_log_at_full_speed_is_read_completely(tmp_path: Path) -> None:
    """50,000 frames of 1 s without a clock that goes, and with one that jumps between two reads."""
    n = 50_000
    path = tmp_path / "long.log"
    path.write_text("".join(f"({1 + at / 50_000:.6f}) can0 {at % 0x700:03X}#{at:08X}\n" for at in range(n)))
    for jump_ns in (0, 10**10):
        clock = HandClock()
        bus = replayed_bus(str(path), {"speed": "max"}, listen_only=True, clock=clock)
        bus.open()
        batch = FrameBatch.for_buses(1, 8)
        found: list[int] = []
        while len(found) < n and bus.receive(batch, 0):
            rows = batch.wire[batch.start : batch.stop]
            found += rows["payload"][:, :4].copy().view(">u4")[:, 0].tolist()
            assert (batch.time_ns[batch.start : batch.stop] <= clock.now_ns).all()
            batch.clear()
            clock.pass_to(clock.now_ns + jump_ns)
        assert found == list(range(n))
        assert bus.counters.dropped == 0
        bus.close()


def test_a_driver_reads_all_of_a_log_at_full_speed(tmp_path: Path) -> None:
    n, path = 20_000, tmp_path / "xela.log"
    path.write_text("".join(f"({1 + at / 1000:.6f}) can0 {0x101 + at % 4:03X}#{at:016X}\n" for at in range(n)))
    kind = load_driver("xela")
    bus = make_bus(f"file:{path}?speed=max", listen_only=True)
    with driving_lines([(kind(kind.Options()), bus)], "skin", listen_only=True):
        wait_until(lambda: bus.counters.frames == n)
        assert bus.counters.dropped == 0


def exported(capture: Path, path: Path) -> None:
    """Write what was received on the only bus of a capture as a log, without what the driver sent."""
    with skinware.recording.open(capture) as opened:
        if path.suffix == ".pcapng":
            export_pcapng(opened, path)
        else:
            write(path, [item for item in opened.wires[0].items() if not item.is_sent])


def changes(series: Series) -> list[list[int]]:
    """The values of each sensor, whenever they were others; without those before it was seen."""
    values, status = series.column("values"), series.column("status")
    found = []
    for row, seen in zip(values.T.tolist(), (status & Status.NEVER_SEEN == 0).T.tolist(), strict=True):
        known = [value for value, is_known in zip(row, seen, strict=True) if is_known]
        found.append([value for place, value in enumerate(known) if not place or value != known[place - 1]])
    return found


def are_in(found: list[int], live: list[int]) -> bool:
    """Whether all are there, in this order."""
    rest = iter(live)
    return all(one in rest for one in found)


KNOWN: dict[str, dict[str, Any]] = {**OPTIONS, "roboskin": {"boards": (7, 8, 9, 10)}}
"""Options of drivers that would learn from the first frames which devices there are."""


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("driver", "suffix", "speed"),
    [
        *((driver, suffix, 1) for driver in ("cyskin_cpm", "roboskin") for suffix in ("log", "asc", "blf", "pcap")),
        ("linkerhand", "pcapng", 1),
        ("roboskin", "pcapng", 1),
    ],
)
def test_drivers_decode_logs_to_the_live_values(tmp_path: Path, driver: str, suffix: str, speed: float) -> None:
    """Those that ask their devices need a log that has what they sent; others listen."""
    kind, options, listens = load_driver(driver), KNOWN.get(driver, {}), suffix != "pcapng"
    capture, log, again = (tmp_path / name for name in ("live.mcap", f"can.{suffix}", "again.mcap"))
    adapter = kind(kind.Options(**options))
    bus = make_bus("virtual", payload_size=adapter.payload_size, driver=driver)
    live = record(capture, adapter, bus, 80, updates=12)
    exported(capture, log)
    bus = make_bus(f"file:{log}?speed={speed}", payload_size=adapter.payload_size, listen_only=listens)
    lines = [(kind(kind.Options(**options)), bus)]
    with recording(again) as recorder, driving_lines(lines, "skin", listen_only=listens):
        wait_until(lambda: recorder.messages.get("/skin/skin/frame", 0) >= 30)
    with skinware.recording.open(again) as opened:
        series = opened["skin"].read()
    assert series.structure.sensor_uid.tolist() == live.structure.sensor_uid.tolist()
    decoded = changes(series)
    assert all(map(are_in, decoded, changes(live)))
    assert max(map(len, decoded)) > 5


@pytest.mark.skipif(shutil.which("log2asc") is None, reason="can-utils are not installed")
def test_logs_of_can_utils(tmp_path: Path) -> None:
    items = frames(30)
    write(tmp_path / "can.log", items, "can0")
    subprocess.run(["log2asc", "-I", "can.log", "-O", "can.asc", "can0"], cwd=tmp_path, check=True)
    is_directed = " Tx " in (tmp_path / "can.asc").read_text()  # by versions that know directions
    require_same(read(tmp_path / "can.asc"), items, directed=is_directed, absolute=False)
    subprocess.run(["asc2log", "-I", "can.asc", "-O", "again.log"], cwd=tmp_path, check=True)
    require_same(read(tmp_path / "again.log"), items, directed=is_directed, absolute=False)
