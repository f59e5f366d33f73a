"""Inertial sensors of ROBOSKIN boards. Vectors made from the protocol's description: there is no public dump."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, DriverSnapshot, PatchState, Status
from skinware.errors import ConfigurationError
from skinware_drivers.can.roboskin_layout import RoboskinOptions, SpecialBoards
from skinware_drivers.virtual.hardware import Event
from tests.sdk.driving import commands, driving, emulated, hardware_of, read_until
from tests.sdk.test_roboskin_wire import MS, Rig, halves

ACCELERATION = ("acceleration_x", "acceleration_y", "acceleration_z")
ANGULAR_RATE = ("angular_rate_x", "angular_rate_y", "angular_rate_z")
BOTH = ("accelerometer", "gyroscope")
IMU = ("imu_accelerometer", "imu_magnetometer", "imu_gyroscope")


def physical(rig: Rig, *type_names: str) -> list[float]:
    structure, values = rig.decoder.tables.structure, rig.decoder.state.values
    return [float(structure.physical(values, name)[0]) for name in type_names]


@pytest.mark.parametrize(
    ("scale", "acceleration", "angular_rate"),
    [("mtb3", 9.80665, 250 / 2), ("mtb4", 163.84, 1024)],
)
def test_accelerations_and_rates_as_on_the_wire(scale: str, acceleration: float, angular_rate: float) -> None:
    rig = Rig(inertial=BOTH, inertial_scale=scale)
    assert rig.decoder.tables.structure.dtype == np.int16
    assert rig.feed([(MS, 0x571, bytes.fromhex("0040 0000 00C0")), (MS, 0x570, bytes.fromhex("0040 F0FF 0000"))])
    assert physical(rig, *ACCELERATION) == pytest.approx([acceleration, 0, -acceleration])
    unit = angular_rate / 0x4000
    assert physical(rig, *ANGULAR_RATE) == pytest.approx([np.radians(angular_rate), np.radians(-16 * unit), 0])


def test_an_imu_as_on_the_wire() -> None:
    rig = Rig(inertial=IMU)
    frames = ("01 00 D503 0000 2BFC", "01 01 A000 0000 60FF", "01 02 1000 F0FF 0000")
    rig.feed([(MS, 0x573, bytes.fromhex(frame)) for frame in frames])
    assert physical(rig, *ACCELERATION) == pytest.approx([9.81, 0, -9.81])
    assert physical(rig, *ANGULAR_RATE) == pytest.approx([np.radians(1), -np.radians(1), 0])
    field = [f"magnetic_field_{axis}" for axis in "xyz"]
    assert physical(rig, *field) == pytest.approx([10e-6, 0, -10e-6])
    rig.feed([(2 * MS, 0x573, bytes.fromhex("03 00 000000000000"))])
    assert rig.count("sequence_lost", 1) == 1
    rig.feed([(2 * MS, 0x573, bytes.fromhex("04 05 000000000000")), (2 * MS, 0x574, bytes(8))])
    assert rig.count("unknown") == 2  # linear acceleration, quaternions: not asked for


def test_three_axes_share_a_uid_and_the_skin_keeps_its_own() -> None:
    rig = Rig(boards=(7, 8), inertial=BOTH)
    structure = rig.decoder.tables.structure
    for name in (*ACCELERATION, *ANGULAR_RATE):
        assert structure.sensor_uid[structure.index(name)].tolist() == [7 << 16 | 0x1000, 8 << 16 | 0x1000]
    rig.feed([*halves(3, 240), (MS, 0x571, bytes(6))])
    assert structure.physical(rig.decoder.state.values, "pressure")[3 * 10] == 15.0
    assert [bytes(name).decode() for name in structure.patch_name] == [
        "board 7",
        "board 7 inertial",
        "board 8",
        "board 8 inertial",
    ]


def test_inertial_data_between_the_halves_of_a_triangle_breaks_no_pair() -> None:
    rig = Rig(inertial=BOTH)
    head, tail = halves(3, 5)
    assert sorted(rig.feed([head, (MS, 0x571, bytes.fromhex("40000000C000")), tail])) == [3, 16]
    assert rig.count("orphans") == 0


def test_inertial_data_that_nobody_asked_for_is_unknown() -> None:
    rig = Rig()
    rig.feed([(MS, 0x571, bytes(6)), (MS, 0x573, bytes(8))])
    assert rig.count("unknown") == 2
    assert rig.decoder.tables.structure.dtype == np.uint8


@pytest.mark.parametrize("payload", ["", "0040", "0040000000", "00400000000000", "0040000000000000"])
def test_wrong_lengths_are_counted_and_not_shown(payload: str) -> None:
    rig = Rig(inertial=BOTH)
    assert rig.feed([(MS, 0x571, bytes.fromhex(payload))]) == []
    assert rig.count("bad_length") == 1


def test_an_accelerometer_of_an_mtb3_that_is_not_there_says_so() -> None:
    # what boards without one send: robotology/mesh-support issues 189 and 415
    rig = Rig(inertial=BOTH, inertial_scale="mtb3")
    rig.feed([(MS, 0x571, b"\xff" * 6), (MS, 0x570, b"\xff" * 6)])
    state = rig.decoder.state
    assert state.status[192:198].tolist() == [int(Status.NOT_CONNECTED)] * 3 + [0] * 3
    rig.feed([(2 * MS, 0x571, bytes.fromhex("003FF0000000"))])
    assert not state.status[192:198].any()


def gravity(frame: DriverSnapshot) -> float:
    axes = [frame.structure.physical(frame.values, name) for name in ACCELERATION]
    return float(np.linalg.norm(np.array(axes), axis=0).max())


@pytest.mark.usefixtures("hurry")
@pytest.mark.parametrize(
    ("emulator", "options", "told"),
    [
        ({}, {"inertial": BOTH}, ["4f0614", "4f0000"]),
        ({"mtb3": (7, 8)}, {"inertial": BOTH, "inertial_scale": "mtb3"}, ["4f0614", "4f0000"]),
        ({}, {"inertial": ("external_accelerometer",)}, ["4f0814", "4f0000"]),
        ({}, {"inertial": IMU}, ["3307000100000000", "3514", "3500"]),
    ],
    ids=["mtb4", "mtb3", "external", "imu"],
)
def test_emulated_boards_and_driver_agree(
    emulator: dict[str, Any], options: dict[str, Any], told: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), pattern="idle", **emulator)
    with driving(bus, inertial_period_ms=20, **options), DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        assert frame.patch_state.tolist() == [PatchState.LIVE] * 4
        assert gravity(frame) == pytest.approx(9.81, rel=0.01)
        later = read_until(reader, lambda f: f.sequence > frame.sequence + 30 and not f.status.any())
        assert reader.bus_counters(later)[0]["unknown"] == 0
    own = ("4f", "33", "35")
    for identifier in (0x207, 0x208):
        messages = [p for _, i, p in commands(log) if i == identifier and p.startswith(own)]
        assert list(dict.fromkeys(messages)) == told  # again, where a busy machine took a board for restarted
    assert "scaled as" not in caplog.text


@pytest.mark.usefixtures("hurry")
def test_only_some_boards_send_and_the_wrong_scale_is_named(caplog: pytest.LogCaptureFixture) -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), mtb3=(8,))
    special = (SpecialBoards((8,), inertial=("accelerometer",)),)
    with (
        caplog.at_level(logging.WARNING),
        driving(bus, special_boards=special),
        DriverReader("roboskin") as reader,
    ):
        names = [bytes(name).decode() for name in reader.structure.patch_name]
        assert names == ["board 7", "board 8", "board 8 inertial"]
        assert reader.structure.n_modules == 33  # no second board configuration: all triangles are still on
        read_until(reader, lambda f: not f.status.any())
    assert "board 8: is an MTB3, but its inertial data is scaled as that of an MTB4: set inertial_scale" in caplog.text
    assert [p for _, i, p in commands(log) if i == 0x207 and p.startswith("4f")] == []


def test_a_restarted_board_sends_its_inertial_data_again(hurry: None) -> None:
    bus = emulated(boards=(7, 8), boot_s=0.1, pattern="idle")
    with driving(bus, inertial=BOTH) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: hardware_of(bus).restart(8, bus._clock()))
        read_until(reader, lambda f: PatchState.LIVE not in f.patch_state[2:].tolist())
        frame = read_until(reader, lambda f: not f.status.any())
        assert frame.patch_state.tolist() == [PatchState.LIVE] * 4


def test_skin_and_inertial_sensors_are_switched_each_for_itself(hurry: None) -> None:
    log: list[Event] = []
    with driving(emulated(log, boards=(7,)), inertial=BOTH), DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        reader.call("enable", patch="board 7 inertial", on=False)
        read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE, PatchState.STALE])
        reader.call("enable", patch="board 7 inertial")
        read_until(reader, lambda f: not f.status.any())
        assert [p for _, _, p in commands(log)[before:] if p.startswith("4f")][:2] == ["4f0000", "4f0632"]


def test_a_listener_hears_inertial_data_too() -> None:
    bus = emulated(boards=(7,), streaming=True, listen_only=True)
    bus.hardware.receive(0x207, bytes.fromhex("4F0614"), bus._clock())
    with driving(bus, listen_only=True, inertial=BOTH, learn_s=0.3), DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        assert gravity(frame) == pytest.approx(9.81, rel=0.01)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"inertial": ("gyroscope", "gyroscope")}, "one occurs twice"),
        ({"inertial": ("accelerometer", "external_accelerometer")}, "send one message"),
        ({"inertial": ("accelerometer", "imu_gyroscope")}, "either those of an imu or the others"),
        ({"inertial": ("imu_gyroscope",), "inertial_scale": "mtb3"}, "only an MTB4 has it"),
        ({"inertial": ("accelerometer",), "old_style": True}, "the old way send no inertial data"),
        ({"special_boards": (SpecialBoards((7,), inertial=("gyroscope",)),), "old_style": True}, "no inertial data"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        RoboskinOptions(**options)
