"""What goes over the wires of drivers is recorded as it was, on all kinds of buses, and costs nothing otherwise."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

import skinware.recording
from skinware import Namespace, ServiceWriter
from skinware.conversion import convert
from skinware.memory.announcement import is_wished
from skinware.memory.segments import living_inode
from skinware.recording import WireTrack
from skinware.recording.files import recover
from skinware.recording.mcap_writing import McapFile, OpenChunk
from skinware.recording.topics import Channels
from skinware.wire import COLUMNS, IS_CUT, IS_FD, KIND, WISH, service_name
from skinware_drivers.bus import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, Bus, FrameBatch
from skinware_drivers.can import CanAdapter
from skinware_drivers.can.pythoncan import PythonCanBus
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Frame as FrameKind
from skinware_drivers.layout import Layout, Values
from skinware_drivers.native.structs import Source
from skinware_drivers.options import NoOptions
from skinware_drivers.testing.driving import Driving, driving_lines, emulated_skin
from skinware_drivers.testing.waiting import wait_until
from tests.can.rig import TIP_IDENTIFIER, Tip
from tests.recording.rig import has, recording
from tests.sdk.cable import Cable
from tests.sdk.test_flow import EndOfCable

Frame = tuple[bool, int, int, bytes]
"""is_sent, identifier, flags, payload."""

EVERYTHING = [
    (struct.pack("=IB3x8s", TIP_IDENTIFIER, 8, b"ABCDEFGH"), (False, TIP_IDENTIFIER, 0, b"ABCDEFGH")),
    (struct.pack("=IB3x8s", 0x7FF, 2, b"ab"), (False, 0x7FF, 0, b"ab")),
    (
        struct.pack("=IB3x8s", EXTENDED_FLAG | 0x1234567, 1, b"x"),
        (False, EXTENDED_FLAG | 0x1234567, 0, b"x"),
    ),
    (struct.pack("=IB3x8s", REMOTE_FLAG | 0x123, 0, b""), (False, REMOTE_FLAG | 0x123, 0, b"")),
    (struct.pack("=IB3x8s", ERROR_FLAG | 4, 8, b"\0\4" + bytes(6)), (False, ERROR_FLAG | 4, 0, b"\0\4" + bytes(6))),
    (struct.pack("=IBB2x64s", 0x100, 12, 1, b"abcdefghijkl"), (False, 0x100, 1 | IS_FD | IS_CUT, b"abcdefgh")),
    (struct.pack("=IBB2x64s", 0x101, 3, 0, b"abc"), (False, 0x101, IS_FD, b"abc")),
]
"""What is sent, and how a driver of frames of 8 bytes records it."""


class ForPython(EndOfCable):
    """A bus that C cannot read."""

    def hand_over(self, batch: FrameBatch, source: Source) -> bool:
        return False


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "skin.mcap"


@pytest.fixture
def spare() -> Iterator[Cable]:
    cable = Cable()
    yield cable
    cable.close()


def frames_of(wire: WireTrack) -> list[Frame]:
    return [
        (bool(row["is_sent"]), int(row["identifier"]), int(row["flags"]), bytes(row["payload"][: row["length"]]))
        for row in wire.frames()
    ]


def batches_lost(opened: skinware.recording.Recording, driver: str) -> int:
    """How many batches of a driver's wires the recorder missed."""
    events = [event for event in opened.events if event["service"] == service_name(driver)]
    return sum(event.get("count", 0) for event in events if event["event"] == "missed")


@contextmanager
def tip_on(bus: Bus, **options: Any) -> Iterator[Driving]:
    with driving_lines([(Tip(NoOptions()), bus)], "tip", bus_names=["can0"], **options) as driver:
        yield driver


def is_recorded(recorder: Any, least: int = 1, topic: str = "/wire/tip/can0") -> None:
    wait_until(lambda: recorder.messages.get(topic, 0) >= least)


@pytest.mark.parametrize("way", [EndOfCable, ForPython])
def test_a_can_bus_is_recorded_with_everything_on_it(path: Path, cable: Cable, way: type[EndOfCable]) -> None:
    with recording(path, with_wires=True) as recorder, tip_on(way(cable.end), wait=False) as driver:
        before_ns = time.time_ns()
        wait_until(lambda: driver.runner is not None)  # its thread makes it
        line = driver.runner.lines[0]  # type: ignore[union-attr]
        for sent in range(1, 201):
            for data, _ in EVERYTHING:
                cable.out.send(data)
            if sent % 20 == 0:  # no more than the socket has room for, at 1,280 bytes a frame
                wait_until(lambda n=sent: line.bus.counters.frames + line.bus.counters.refused == n * 6)  # type: ignore[misc]
        wait_until(driver.ready.is_set)
        driver.do(lambda: line.bus.send(0x321, b"sent"))
        after_ns = time.time_ns()
        is_recorded(recorder, 2)
    with skinware.recording.open(path) as opened:
        assert (opened.services, opened.problems) == (("tip",), [])
        assert not batches_lost(opened, "tip")
        (wire,) = opened.wires
        assert (wire.driver, wire.bus, wire.missed) == ("tip", "can0", 0)
        assert frames_of(wire) == [expected for _ in range(200) for _, expected in EVERYTHING] + [
            (True, 0x321, 0, b"sent")
        ]
        frames = wire.frames()
        assert (np.diff(frames["time_ns"]) >= 0).all()
        assert before_ns - 1_000_000 <= frames["epoch_ns"][0]
        assert frames["epoch_ns"][-1] <= after_ns + 1_000_000
        notes = convert(path, None, "npz").notes
        assert notes == [f"{path}: wires are left out: convert them to candump or pcapng"]
        # the times of the frames are those by which the driver decoded them
        series = opened["tip"].read(["module_time_ns"])
        assert set(series.column("module_time_ns").ravel().tolist()) - {0} <= set(frames["time_ns"].tolist())


class FdTip(CanAdapter[NoOptions]):
    """Tip, with CAN FD frames of 12 bytes."""

    types, dtype, patches, period_s = Tip.types, Tip.dtype, Tip.patches, Tip.period_s
    layout = Layout([FrameKind("all", [Identifier(TIP_IDENTIFIER)], length=(12,), values=Values(4, "u1", 8))])


@pytest.mark.parametrize("way", [EndOfCable, ForPython])
def test_frames_of_a_can_fd_bus_are_recorded_as_far_as_their_driver_knows_them(
    path: Path, cable: Cable, way: type[EndOfCable]
) -> None:
    bus = way(cable.end)
    bus.payload_size = FdTip.layout.payload_size
    driver = driving_lines([(FdTip(NoOptions()), bus)], "tip", bus_names=["can0"], wait=False)
    long, short = bytes(range(64)), bytes(range(12))
    with recording(path, with_wires=True) as recorder, driver:
        cable.out.send(struct.pack("=IBB2x64s", 0x100, 64, 3, long))  # what it leaves behind is in no later frame
        cable.out.send(struct.pack("=IBB2x64s", TIP_IDENTIFIER, 12, 1, short))
        cable.out.send(struct.pack("=IBB2x64s", 0x101, 2, 0, b"ab"))
        cable.put(0x102, b"abc")
        is_recorded(recorder)
        wait_until(lambda: bus.counters.frames == 3)
    with skinware.recording.open(path) as opened:
        (wire,) = opened.wires
        frames = wire.frames()
        assert frames_of(wire) == [
            (False, 0x100, 3 | IS_FD | IS_CUT, long[:16]),
            (False, TIP_IDENTIFIER, 1 | IS_FD, short),
            (False, 0x101, IS_FD, b"ab"),
            (False, 0x102, 0, b"abc"),
        ]
        assert all(not row["payload"][row["length"] :].any() for row in frames)


def test_part_of_the_time(path: Path, cable: Cable) -> None:
    with recording(path, with_wires=True) as recorder, tip_on(EndOfCable(cable.end), wait=False):
        for number in range(100):
            cable.put(TIP_IDENTIFIER, bytes([number]) * 8)
            time.sleep(0.01)
        is_recorded(recorder, 3)
    with skinware.recording.open(path) as opened:
        (wire,) = opened.wires
        everything = wire.frames()
        at_s = (everything["epoch_ns"] - opened.start_ns) / 1e9
        start_s, end_s = at_s[29:31].mean(), at_s[59:61].mean()
        assert np.array_equal(wire.frames(start_s=start_s, end_s=end_s), everything[30:60])


def test_the_bytes_of_a_serial_line_are_recorded_as_they_were_read(path: Path) -> None:
    with (
        recording(path, with_wires=True) as recorder,
        emulated_skin("agni") as skin,
    ):
        wait_until(lambda: skin.reader.read().sequence > 30)
        is_recorded(recorder, 3, "/wire/skin/bus0")
    framing = skin.bus.counters.framing
    with skinware.recording.open(path) as opened:
        (wire,) = opened.wires
        received = [piece for piece in wire.pieces() if not piece.is_sent]
        data = b"".join(piece.data for piece in received)
        assert len(data) == framing.bytes_in - wire.missed
        assert wire.missed == 0
        assert len(wire.frames()) == 0
        times = np.concatenate([piece.time_ns for piece in received])
        assert (np.diff(times) >= 0).all()
        series = opened["skin"].read(["module_time_ns"])
        assert set(series.column("module_time_ns").ravel().tolist()) - {0} <= set(times.tolist())


@pytest.mark.parametrize("driver", ["roboskin", "openpatch"])
def test_what_driver_and_devices_say_at_first_is_recorded(path: Path, driver: str) -> None:
    with recording(path, with_wires=True) as recorder, emulated_skin(driver) as skin:
        wait_until(lambda: skin.reader.read().sequence > 3)
        is_recorded(recorder, 2, "/wire/skin/bus0")
    with skinware.recording.open(path) as opened:
        first = next(iter(opened.wires[0].pieces()))
        assert first.is_sent  # the driver asks first
        assert first.time_ns[0] < int(opened["skin"].read([]).acquired_ns[0])


def test_every_python_can_interface_is_recorded(path: Path) -> None:
    with can.Bus(interface="virtual", channel="wire") as other:
        bus = PythonCanBus("virtual", "wire", payload_size=8)
        with recording(path, with_wires=True) as recorder, tip_on(bus, wait=False):
            wait_until(lambda: bus.fileno() >= 0)
            other.send(can.Message(arbitration_id=TIP_IDENTIFIER, is_extended_id=False, data=b"ABCDEFGH"))
            other.send(can.Message(arbitration_id=0x18DA00F1, is_extended_id=True, data=b"x"))
            other.send(can.Message(arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=0))
            other.send(can.Message(is_error_frame=True, arbitration_id=4, is_extended_id=False, data=bytes(8)))
            other.send(
                can.Message(
                    arbitration_id=0x100, is_extended_id=False, is_fd=True, bitrate_switch=True, data=b"abcdefghijkl"
                )
            )
            wait_until(lambda: bus.counters.frames == 2)
            wait_until(lambda: bus.counters.errors == 1)
            is_recorded(recorder)
    with skinware.recording.open(path) as opened:
        assert frames_of(opened.wires[0]) == [
            (False, TIP_IDENTIFIER, 0, b"ABCDEFGH"),
            (False, EXTENDED_FLAG | 0x18DA00F1, 0, b"x"),
            (False, REMOTE_FLAG | 0x123, 0, b""),
            (False, ERROR_FLAG | 4, 0, bytes(8)),
            (False, 0x100, 1 | IS_FD, b"abcdefghijkl"),
        ]


def test_nobody_is_told_of_a_wire_that_nobody_asked_for(path: Path, cable: Cable, namespace: Namespace) -> None:
    bus = EndOfCable(cable.end)
    with recording(path) as recorder, tip_on(bus, wait=False):
        wait_until(lambda: not bus.tap.is_open)  # the first moments are kept, in case somebody asks
        cable.put(TIP_IDENTIFIER)
        has(recorder, "tip")
        assert namespace.services() == ["tip"]
    with skinware.recording.open(path) as opened:
        assert opened.wires == ()


def test_who_did_not_ask_does_not_record_it_either(tmp_path: Path, cable: Cable, namespace: Namespace) -> None:
    other, path = tmp_path / "other.mcap", tmp_path / "skin.mcap"
    bus = EndOfCable(cable.end)
    with tip_on(bus, wait=False) as driver:
        wait_until(lambda: not bus.tap.is_open)
        with recording(path, with_wires=True) as recorder:
            wait_until(lambda: bus.tap.is_open)
            with recording(other) as without:
                cable.put(TIP_IDENTIFIER)
                is_recorded(recorder)
                has(without, "tip")
                wait_until(lambda: without.messages.get("/skin/tip/frame", 0) > 0)
        assert not is_wished(namespace, WISH)
        wait_until(lambda: not bus.tap.is_open)
        driver.wait()
        wait_until(lambda: namespace.services() == ["tip"] or living_inode(namespace, service_name("tip")) is None)
    with skinware.recording.open(other) as opened:
        assert (opened.services, opened.wires) == (("tip",), ())
    with skinware.recording.open(path) as opened:
        assert [len(wire.frames()) for wire in opened.wires] == [1]


def test_the_wire_of_a_driver_is_recorded_with_it_and_no_other(path: Path, cable: Cable, spare: Cable) -> None:
    with (
        recording(path, with_wires=True, names=["tip"]) as recorder,
        tip_on(EndOfCable(cable.end), wait=False),
        driving_lines([(Tip(NoOptions()), EndOfCable(spare.end))], "other", wait=False),
    ):
        for one in (cable, spare):
            one.put(TIP_IDENTIFIER)
        is_recorded(recorder)
        wait_until(lambda: recorder.messages.get("/skin/tip/frame", 0) > 0)
    with skinware.recording.open(path) as opened:
        assert (opened.services, [wire.driver for wire in opened.wires]) == (("tip",), ["tip"])


def test_frames_that_had_no_room_are_counted_in_the_file(path: Path, namespace: Namespace) -> None:
    namespace.create()
    with recording(path, with_wires=True) as recorder:
        static = {"driver": np.array([b"tip"]), "bus_name": np.array([b"can0"])}
        with ServiceWriter(service_name("tip"), COLUMNS, static, kind=KIND) as writer:
            for lost in (0, 3, 7):
                columns = writer.begin()
                for name, value in {"bus": 0, "used": 0, "missed": lost}.items():
                    columns[name][()] = value
                writer.commit(time.monotonic_ns())
            is_recorded(recorder, 3)
    with skinware.recording.open(path) as opened:
        assert opened.wires[0].missed == 7


@pytest.mark.parametrize("static", [{}, {"driver": np.array([b"\xff"]), "bus_name": np.array([b"can0"])}])
def test_a_service_that_only_says_that_it_is_a_wire_harms_nobody(
    path: Path, namespace: Namespace, static: dict[str, Any]
) -> None:
    namespace.create()
    with recording(path, with_wires=True) as recorder:
        with ServiceWriter("odd", {"number": ("<i8", ())}, static, kind=KIND) as writer:
            writer.begin()["number"][()] = 1
            writer.commit(time.monotonic_ns())
            has(recorder, "odd")
        with ServiceWriter("good", {"number": ("<i8", ())}) as writer:
            writer.begin()["number"][()] = 2
            writer.commit(time.monotonic_ns())
            wait_until(lambda: recorder.messages.get("/skin/good/frame", 0) == 1)


def test_damaged_messages_are_told_and_never_raise(path: Path) -> None:
    generator = np.random.default_rng(3)
    file, channels = McapFile(path), Channels()
    channel, schema = channels.of_wire("tip", "can0")
    clock, clock_schema = channels.of_all("/skin/clock")
    chunk = OpenChunk()
    chunk.add(clock, clock_schema, 0, 1, b"{}")
    for number in range(200):
        chunk.add(channel, schema, number, 1 + number, generator.bytes(int(generator.integers(0, 300))))
    file.add(chunk.close())
    file.finish()
    with skinware.recording.open(path) as opened:
        (wire,) = opened.wires
        assert len(wire.frames()) == 0
        assert wire.missed >= 0
        assert sorted(opened.problems) == [
            "wire of can0: a message has a time that no clock has",
            "wire of can0: a message is shorter than its header",
            "wire of can0: damaged frames or bytes left out",
        ]


def test_a_recovered_recording_has_its_wires(path: Path, tmp_path: Path, cable: Cable) -> None:
    with recording(path, with_wires=True) as recorder, tip_on(EndOfCable(cable.end), wait=False):
        for _ in range(30):
            cable.put(TIP_IDENTIFIER)
            time.sleep(0.02)
        is_recorded(recorder, 5)
    with skinware.recording.open(path) as opened:
        frames = opened.wires[0].frames()
    assert len(frames) == 30
    path.write_bytes(path.read_bytes()[:-100])
    recover(path, tmp_path / "whole.mcap")
    with skinware.recording.open(tmp_path / "whole.mcap") as opened:
        assert opened.is_whole
        assert np.array_equal(opened.wires[0].frames(), frames)


def test_a_fifo_in_the_place_of_a_wish_holds_up_nobody(namespace: Namespace) -> None:
    namespace.create()
    os.mkfifo(namespace.readers_path / f"{WISH}.1.2")
    assert not is_wished(namespace, WISH)
    (namespace.readers_path / f"{WISH}.1.2").unlink()
