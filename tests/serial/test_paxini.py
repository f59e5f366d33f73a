"""The driver of Paxini's boards: literal bytes of the wire, and the driver on pseudo terminals."""

from __future__ import annotations

import logging
import random
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, DriverSnapshot, PatchState, Status
from skinware.errors import ConfigurationError, RequestFailed, StructureChanged
from skinware_drivers.bus import FrameBatch
from skinware_drivers.description import assemble
from skinware_drivers.serial.framing import Framed
from skinware_drivers.serial.paxini import PaxiniDriver, PaxiniOptions
from skinware_drivers.serial.paxini_converter import ConverterBoard, read, write
from skinware_drivers.serial.paxini_high_speed import STRANGE, UNKNOWN_SLOTS, framing_of, request, version_request
from skinware_drivers.serial.paxini_modules import POINTS_OF_PART, Slot, model_of
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual import Device
from skinware_drivers.virtual.devices.paxini import EmulatedPaxini, EmulatedPaxiniOptions, message
from tests.drivers.fuzzed import paxini
from tests.sdk.driving import read_until, restarted_on_demand
from tests.serial.spoken import Spoken
from tests.specification.decoding import SpecifiedDecoder

# Captured from the maker's program and a sensor
VERSION_OF_3 = bytes.fromhex("55 AA 09 00 03 00 FB D4 17 00 00 64 00 AB")
ALL_OF_3 = bytes.fromhex("55 AA 09 00 03 00 FB F0 03 00 00 7B 00 8C")
ZERO_3 = bytes.fromhex("55 AA 0A 00 03 00 79 03 00 00 00 01 00 01 76")
ZERO_3_DONE = bytes.fromhex("AA 55 0A 00 03 00 79 03 00 00 00 01 00 00 77")
# Computed
TAXELS_OF_1 = bytes.fromhex("55 AA 09 00 01 00 FB 0E 04 00 00 9C 00 4E")
# Of the maker's program for the high-speed board
VERSION = bytes.fromhex("55 AA 00 03 00 00 0F 00 EF")
STREAM_ON = bytes.fromhex("55 AA 00 10 17 00 01 00 01 D8")
CALIBRATE = bytes.fromhex("55 AA 00 17 02 00 01 00 01 E6")
# Computed
STREAM_OFF = bytes.fromhex("55 AA 00 10 17 00 01 00 00 D9")
STREAMED = bytes.fromhex("AA 56 00 0A 00 00 01 00 FF 00 03 00 01 FF 02 F1")

HAND: dict[str, Any] = {"board": "high_speed", "slots": (0, 6, 21), "points": 9}
OTHER_PART = "PAXINI PXSR-STDIP03B-v1.0.5"


def is_fresh(frame: DriverSnapshot) -> bool:
    return not (frame.status & (Status.STALE | Status.NEVER_SEEN)).any()


def is_live(frame: DriverSnapshot) -> bool:
    return bool((frame.patch_state == PatchState.LIVE).all()) and is_fresh(frame)


def following(reader: DriverReader, condition: Callable[[DriverSnapshot], bool]) -> DriverSnapshot:
    """As ``read_until``, also if the structure changes meanwhile."""
    try:
        return read_until(reader, condition)
    except StructureChanged:
        reader.reattach()
        return read_until(reader, condition)


def decoded(adapter: PaxiniDriver, frames: Sequence[Framed]) -> SpecifiedDecoder:
    decoder = SpecifiedDecoder([adapter.layout], assemble([("bus", adapter.patches)], adapter.types, adapter.dtype))
    batch = FrameBatch(100, adapter.payload_size)
    for number, frame in enumerate(frames):
        batch.append(0, 1 + number, frame.identifier, frame.body)
    updates, foreign = decoder.decode(batch)
    decoder.count_unknown(batch, foreign)
    decoder.state.show(updates)
    return decoder


# -- bytes


def test_requests_are_the_published_ones() -> None:
    assert read(3, 6100, 100) == VERSION_OF_3
    assert read(3, 1008, 30 + 3 * 31) == ALL_OF_3
    assert read(1, 1038, 3 * 52) == TAXELS_OF_1
    assert write(3, 3, 1) == ZERO_3
    assert version_request() == VERSION
    assert request(0x10, 0x17, 1, b"\1") == STREAM_ON
    assert request(0x10, 0x17, 1, b"\0") == STREAM_OFF
    assert request(0x17, 0x02, 1, b"\1") == CALIBRATE


def test_a_reply_of_a_sensor() -> None:
    assert ConverterBoard.framing.framer().feed(ZERO_3_DONE) == [Framed(0x0300_0003, ZERO_3_DONE[5:-1], 15)]
    reply = message(bytes.fromhex("AA 55 2B 00 02 00 FB F0 03 00 00 21 00 01 FB 05 C8"), bytes(27), b"\x80\x7f\xff")
    assert len(reply) == 0x2B + 5
    frames = ConverterBoard.framing.framer().feed(reply)
    decoder = decoded(paxini("converter", {2: 1}), frames)
    assert decoder.state.values.tolist() == [-128, 127, 255, -5, 5, 200]
    types = decoder.tables.structure.types
    assert [t.name for t in types] == ["force_x", "force_y", "force_z", "resultant_x", "resultant_y", "resultant_z"]
    assert {(t.unit, t.scale) for t in types} == {("N", 0.1)}
    end = int(Status.OUT_OF_RANGE)
    assert decoder.state.status.tolist() == [end, 0, end, 0, 0, 0]  # the board's status of 1 says nothing


def test_what_is_streamed_is_divided_by_slots() -> None:
    slot = Slot(0, 1)
    frames = framing_of([slot]).framer().feed(STREAMED)
    assert frames == [Framed(0, STREAMED[3:-1], 16)]
    adapter = paxini("high_speed", {0: 1})
    decoder = decoded(adapter, frames)
    assert decoder.state.values.tolist() == [1, -1, 2, 1, -1, 3]
    assert not decoder.state.status.any()
    doubtful = message(STREAMED[:5], b"\4", STREAMED[6:-1])
    decoder = decoded(adapter, framing_of([slot]).framer().feed(doubtful))
    assert decoder.state.status.tolist() == [Status.SUSPECT] * 6
    of_two = framing_of([Slot(3, 1), Slot(20, 0)])
    stream = message(b"\xaa\x56\0", struct.pack("<HB", 16, 0), bytes(range(15)))
    before = b"\x10\0\0"
    assert [frame[:2] for frame in of_two.framer().feed(stream)] == [
        (3, before + bytes(range(9))),
        (20, before + bytes(range(9, 15))),
    ]
    strange = Framed(STRANGE, STREAMED[3:-1], 16)
    assert UNKNOWN_SLOTS.framer().feed(STREAMED) == [strange]
    frames = of_two.framer().feed(STREAMED)
    assert frames == [Framed(3, STREAMED[3:6], 16), strange]
    assert decoded(paxini("high_speed", {3: 1, 20: 0}), frames).state.bus_counters[0, :3].tolist() == [1, 1, 0]


@pytest.mark.parametrize("frame", [ZERO_3_DONE, STREAMED])
def test_no_flipped_bit_makes_a_frame(frame: bytes) -> None:
    framing = ConverterBoard.framing if frame is ZERO_3_DONE else framing_of([Slot(0, 1)])
    for bit in range(8 * len(frame)):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        framer = framing.framer()
        assert framer.feed(bytes(damaged)) == []
        found = framer.feed(frame + bytes(framing.maximum_body + 16))
        assert [one.body for one in found] == [frame[5 if frame is ZERO_3_DONE else 3 : -1]]


def test_models_by_their_number_of_taxels() -> None:
    assert model_of(31) == "S1813-Elite"
    assert model_of(32) == "32 taxels"
    assert len(set(POINTS_OF_PART.values())) == len(POINTS_OF_PART) == 12
    assert not any("taxels" in model_of(points) for points in POINTS_OF_PART.values())
    assert [Slot(n, 1).name for n in (0, 6, 19, 20, 27)] == [
        "thumb near",
        "index tip",
        "little nail",
        "palm 1",
        "palm 8",
    ]


def test_the_emulated_sensor_byte_for_byte() -> None:
    sensor = Spoken(EmulatedPaxini(EmulatedPaxiniOptions(pattern="cycle")))
    version = b"PAXINI PXSR-STDDP03F-v1.0.5"
    head = bytes.fromhex("AA 55 6E 00 03 00 FB D4 17 00 00 64 00 01")
    assert sensor.answers(VERSION_OF_3) == [message(head, version, bytes(73))]
    head = bytes.fromhex("AA 55 85 00 03 00 FB F0 03 00 00 7B 00 01")
    assert sensor.answers(ALL_OF_3) == [message(head, bytes(123))]
    assert sensor.answers(ALL_OF_3) == [message(head, b"\x1f\x1f\x1f", bytes(27), b"\1" * 93)]
    assert sensor.answers(ALL_OF_3[:-1] + b"\0") == sensor.answers(TAXELS_OF_1) == sensor.answers(VERSION) == []
    assert sensor.answers(ZERO_3) == [ZERO_3_DONE]
    assert sensor.answers(ALL_OF_3) == [message(head, bytes(123))]
    wrong = bytes.fromhex("AA 55 0A 00 03 00 7E 05 00 00 00 01 00 02")
    assert sensor.answers(write(3, 5, 1)) == [message(wrong)]


def test_the_emulated_board_byte_for_byte() -> None:
    options = EmulatedPaxiniOptions(pattern="cycle", board="high_speed", slots=(0, 27), points=1, calibrates_s=0.002)
    board = Spoken(EmulatedPaxini(options))
    assert board.answers(VERSION) == [message(b"\xaa\x55\0\3\0\0\x0f\0EMULATED V1.0\0\0")]
    assert board.answers(request(3, 0x13, 1)) == [message(bytes.fromhex("AA 55 00 03 13 00 01 00 08"))]
    assert board.answers(request(3, 0x74, 2)) == [message(bytes.fromhex("AA 55 00 03 74 00 02 00 01 00"))]
    assert board.answers(VERSION_OF_3) == board.answers(VERSION[:-1] + b"\0") == []
    done, *frames = board.answers(STREAM_ON, 40)
    assert done == message(bytes.fromhex("AA 55 00 10 17 00 01 00 00"))
    assert len(frames) in (3, 4)
    for cycle, frame in enumerate(frames):
        of_slot = bytes((cycle, 0, cycle, 0, cycle, 0)) + bytes([cycle] * 3)
        assert frame == message(bytes.fromhex("AA 56 00 13 00 00"), of_slot, of_slot)
    board.answers(STREAM_OFF)
    assert board.answers(b"", 100) == []
    assert board.answers(CALIBRATE, 1) == []
    assert board.answers(b"", 2) == [message(bytes.fromhex("AA 55 00 17 02 00 01 00 00"))]
    assert board.answers(request(0x10, 0x55, 1, b"\0")) == [message(bytes.fromhex("AA 55 00 81 55 00 00 00"))]


# -- sensors behind a converter board


def test_a_converter_board_is_found_and_its_sensors_are_set_to_zero() -> None:
    with emulated_skin(PaxiniDriver, EmulatedPaxini, sensors=(3, 8), pattern="cycle") as skin:
        frame = read_until(skin.reader, is_live)
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"sensor 3", b"sensor 8"]
        assert structure.module_kind.tolist() == [b"S1813-Elite"] * 2
        assert structure.sensor_uid[:3].tolist() == [3 << 16] * 3
        assert frame.physical("force_z").max() <= 12.7
        skin.reader.call("tare", patch="sensor 8")
        frame = read_until(skin.reader, lambda f: not f.values[96 + 2].any() and f.values[2] > 0)
        assert is_fresh(frame)


class Slow(EmulatedPaxini):
    """The version of sensor 3 comes with that of sensor 8."""

    late = b""

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        reply = super().answer(device, command, now_ns)
        if command == VERSION_OF_3 and device.number == 3:
            Slow.late = reply or b""
            return None
        return Slow.late + reply if reply and device.number == 8 and command[7:9] == VERSION_OF_3[7:9] else reply


def test_a_sensor_that_answers_when_others_are_asked_is_found() -> None:
    with emulated_skin(PaxiniDriver, Slow, sensors=(3, 8)) as skin:
        structure = read_until(skin.reader, is_live).structure
        assert structure.patch_name.tolist() == [b"sensor 3", b"sensor 8"]


class Refusing(EmulatedPaxini):
    """Answers with errors once ``refuses`` is set."""

    refuses = False

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        if Refusing.refuses and command[6] != 0xFB:
            return message(b"\xaa\x55\x0a\0", bytes([device.number]), b"\0\x7e\3\0\0\0\1\0\5")
        if Refusing.refuses and command[7:9] == b"\xf0\3":
            return message(b"\xaa\x55\x0a\0", bytes([device.number]), b"\0\x7e\xf0\3\0\0\1\0\5")
        return super().answer(device, command, now_ns)


def test_errors_of_sensors_are_told_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    Refusing.refuses = False
    with (
        caplog.at_level(logging.WARNING, "skinware.driver"),
        emulated_skin(PaxiniDriver, Refusing, driver_options={"sensors": (3,)}) as skin,
    ):
        read_until(skin.reader, is_live)
        Refusing.refuses = True
        frame = read_until(skin.reader, lambda f: f.patch_state[0] != PatchState.LIVE)
        read_until(skin.reader, lambda f: bool((f.status & Status.STALE).all()))
        wait_until(lambda: "answers with function 0x7e, status 5, at 1008" in caplog.text)
        with pytest.raises(RequestFailed, match="sensor 3 answers with function 0x7e, status 5, at 3"):
            skin.reader.call("tare")
        Refusing.refuses = False
        assert frame.structure == read_until(skin.reader, is_live).structure


class Exchanged(EmulatedPaxini):
    """Loses its power, and is another sensor afterwards, once ``now`` is set."""

    now = False

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        if Exchanged.now:
            Exchanged.now = False
            self.restart(device.number, now_ns)
            self._version = OTHER_PART
            return None
        return super().answer(device, command, now_ns)

    def text(self) -> str:
        return getattr(self, "_version", self.options.sensor_version)


def test_another_sensor_in_the_place_of_one_that_fell_silent_is_noticed() -> None:
    Exchanged.now = False
    with emulated_skin(PaxiniDriver, Exchanged, driver_options={"sensors": (3,)}, boot_s=2.0, points=31) as skin:
        assert read_until(skin.reader, is_live).structure.module_kind.tolist() == [b"S1813-Elite"]
        Exchanged.now = True
        frame = following(skin.reader, lambda f: f.structure.module_kind.tolist() == [b"S1610"] and is_live(f))
        assert frame.structure.n_sensors == 3 * 26


def test_a_part_code_that_nobody_knows_needs_the_option_points(caplog: pytest.LogCaptureFixture) -> None:
    with (
        caplog.at_level(logging.WARNING, "skinware.driver"),
        emulated_skin(
            PaxiniDriver, EmulatedPaxini, sensor_version="PAXINI X", driver_options={"points": 4}, points=4
        ) as skin,
    ):
        frame = read_until(skin.reader, is_live)
        assert frame.structure.module_kind.tolist() == [b"4 taxels"]
        assert frame.structure.n_sensors == 15
    with pytest.raises(ConfigurationError, match="points"):
        PaxiniOptions(points=300)
    with pytest.raises(ConfigurationError, match="sensors"):
        PaxiniOptions(sensors=(9,))


# -- a high-speed board


@pytest.mark.parametrize("acknowledge", ["reply", "frame", "nothing"])
def test_a_board_that_still_streams_for_somebody_else(acknowledge: str) -> None:
    """It is known by its stream, nothing is asked for that; and however it acknowledges, it is started."""
    with emulated_skin(
        PaxiniDriver, EmulatedPaxini, streaming=True, acknowledge=acknowledge, pattern="cycle", **HAND
    ) as skin:
        frame = read_until(skin.reader, is_live)
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"hand"]
        assert structure.module_name.tolist() == [b"thumb near", b"index tip", b"palm 2"]
        assert structure.module_kind.tolist() == [b"M2020"] * 3
        assert structure.n_sensors == 3 * 30
        assert structure.geometry is not None
        assert structure.geometry.known.sum() == 3 * 27
        assert len(set(np.delete(frame.values, np.s_[27:30]).tolist())) <= 4  # a burst is whole


def test_a_silent_board_is_found_and_calibrated() -> None:
    with emulated_skin(PaxiniDriver, EmulatedPaxini, pattern="cycle", calibrates_s=0.3, **HAND) as skin:
        before = read_until(skin.reader, lambda f: is_live(f) and int(f.values[0]) > 5)
        skin.reader.call("tare")
        after = read_until(skin.reader, lambda f: is_live(f) and f.acquired_ns > before.acquired_ns and not f.values[2])
        assert after.structure == before.structure


class AsItsText(EmulatedPaxini):
    """It has the numbers of taxels on the palm where the maker's text has them, and may stream fewer kinds of data."""

    n_kinds = 3

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        register = command[4]
        if command[3] == 3 and register == 0x16:
            return message(b"\xaa\x55\0", command[3:8], bytes([self.n_kinds]))
        if command[3] == 3 and 0x58 <= register < 0x68:
            return message(b"\xaa\x55\0", command[3:8], b"\x09\0")
        if command[3] == 3 and register >= 0x68:
            return message(b"\xaa\x55\0\x83", command[4:6], b"\0\0")
        return super().answer(device, command, now_ns)


def test_taxels_of_the_palm_are_found_at_either_register() -> None:
    with emulated_skin(PaxiniDriver, AsItsText, driver_options={"board": "high_speed"}, **HAND) as skin:
        assert read_until(skin.reader, is_live).structure.n_sensors == 3 * 30


def test_a_board_that_streams_one_kind_of_data_is_refused_in_words(caplog: pytest.LogCaptureFixture) -> None:
    class OnlyAtFirst(AsItsText):
        def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
            self.n_kinds = 3 if "alone: write 3" in caplog.text else 1
            return super().answer(device, command, now_ns)

    with emulated_skin(PaxiniDriver, OnlyAtFirst, driver_options={"board": "high_speed"}, **HAND) as skin:
        read_until(skin.reader, is_live)
    assert "streams resultants or taxels alone" in caplog.text


class Changing(EmulatedPaxini):
    """Modules come off once ``left`` says which ones are left; and it may refuse to calibrate."""

    left: tuple[int, ...] = ()
    refuses = False

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        if self.refuses and command[3] == 0x17:
            return message(b"\xaa\x55\0\x17\2\0\1\0\7")
        return super().answer(device, command, now_ns)

    def slots(self) -> Sequence[int]:
        return Changing.left or super().slots()


def test_modules_that_come_off_are_noticed(caplog: pytest.LogCaptureFixture) -> None:
    Changing.left = ()
    with (
        caplog.at_level(logging.WARNING, "skinware.driver"),
        emulated_skin(PaxiniDriver, Changing, driver_options={"board": "high_speed"}, **HAND) as skin,
    ):
        assert read_until(skin.reader, is_live).structure.n_modules == 3
        Changing.left = (0, 21)
        frame = following(skin.reader, lambda f: f.structure.n_modules == 2 and is_live(f))
        assert frame.structure.module_name.tolist() == [b"thumb near", b"palm 2"]
        assert "streams other modules than before" in caplog.text
    Changing.left = ()


def test_a_board_that_refuses_and_one_that_reports_an_error() -> None:
    class RefusingBoard(Changing):
        refuses = True

    with emulated_skin(
        PaxiniDriver, RefusingBoard, driver_options={"board": "high_speed"}, error=9, pattern="cycle", **HAND
    ) as skin:
        frame = read_until(skin.reader, is_live)
        assert (frame.status == Status.SUSPECT).all()
        with pytest.raises(RequestFailed, match="refuses to calibrate with status 7"):
            skin.reader.call("tare")
        read_until(skin.reader, lambda f: is_live(f) and f.acquired_ns > frame.acquired_ns)


def test_it_comes_back_after_a_restart_and_damage_is_not_shown() -> None:
    faults: dict[str, Any] = {"lose": 0.02, "truncate": 0.02, "corrupt": 0.02, "repeat": 0.02}
    devices = restarted_on_demand(EmulatedPaxini)
    with emulated_skin(
        PaxiniDriver, devices, driver_options={"board": "high_speed"}, pattern="cycle", boot_s=0.1, **HAND, **faults
    ) as skin:
        for live in (True, False, True):
            devices.restart_now = not live
            frame = read_until(skin.reader, lambda f, live=live: (f.patch_state[0] == PatchState.LIVE) == live)  # type: ignore[misc]
            taxels = np.concatenate([frame.values[at : at + 27] for at in (0, 30, 60)])
            assert len(set(taxels.tolist())) == 1


class Babbling(EmulatedPaxini):
    """Says frames with right checksums that mean nothing, beside its answers."""

    random = random.Random(5)

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes | None:
        pick, size = self.random.choice, self.random.randrange(40)
        body = self.random.randbytes(size)
        of_sensor = struct.pack("<HBBB", size + 5, device.number, 0, pick((0xFB, 0x7E, 0x79)))
        of_board = struct.pack("<BBHH", 0, pick((0x03, 0x10, 0x83)), 0x7F7F, size)
        streamed = struct.pack("<BH", 0, size)
        for begin, head in ((b"\x55", of_sensor), (b"\x55", of_board), (b"\x56", streamed), (b"\x55", b"")):
            self.say(device, message(b"\xaa", begin, head, body), now_ns)
        return super().answer(device, command, now_ns)


@pytest.mark.parametrize("board", ["converter", "high_speed"])
def test_frames_that_mean_nothing_stop_nothing(board: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "skinware.driver"):
        emulated: dict[str, Any] = {**HAND, "board": board, "sensors": (3,), "sensor_version": OTHER_PART, "points": 25}
        with emulated_skin(
            PaxiniDriver, Babbling, driver_options={"board": board, "sensors": (3,)}, pattern="cycle", **emulated
        ) as skin:
            first = read_until(skin.reader, is_live)
            read_until(skin.reader, lambda f: is_live(f) and f.acquired_ns > first.acquired_ns + 10**9)
        assert "Error" not in caplog.text
