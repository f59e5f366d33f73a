"""What each command does to an MTB4; what is other on an MTB3 is in test_mtb3.py.

Sources: icub-firmware embot_app_application_theSkin.cpp, embot_prot_can_analog_polling.cpp, embot_prot_can.cpp,
embot_prot_can_bootloader.cpp.
"""

from __future__ import annotations

import itertools

import pytest

from .rig import ENABLE_ALL, START_NS, Rig, constant_source, cycles

CONFIGURE = "4D 00 32 F0"


def test_silent_at_power_up() -> None:
    rig = Rig(boards=(7, 8), mtb3=(8,))
    assert rig.run_ms(10_000) == []
    assert rig.hardware.next_due_ns() is None


def test_start_alone_streams_all_triangles_with_firmware_defaults() -> None:
    rig = Rig(not_connected=("7/0",))
    rig.send(0x207, "07 00")
    bursts = cycles(rig.run_ms(500))
    assert bursts[0][0].payload == bytes.fromhex("40 F5 F5 F5 F5 F5 F5 F5")  # no load 245
    assert [len(burst) for burst in bursts] == [32] * 10
    assert bursts[1][0].time_ns - bursts[0][0].time_ns == 50_000_000


def test_stop_is_07_01() -> None:
    rig = Rig()
    rig.configure()
    assert rig.streams()
    rig.send(0x207, "07 01")
    rig.run_ms(10)
    assert rig.run_ms(1000) == []


@pytest.mark.parametrize("period_ms", [1, 20, 255])
def test_bursts_come_at_the_commanded_period(period_ms: int) -> None:
    rig = Rig(source=constant_source(1))
    rig.send(0x207, f"4D 00 {period_ms:02X} F0")
    rig.send(0x207, "50 05 05 02 01 00 22")
    rig.send(0x207, "07 00")
    heads = [frame.time_ns for frame in rig.run_ms(10 * period_ms) if frame.payload[0] == 0x40]
    assert len(heads) == 10
    assert {later - earlier for earlier, later in itertools.pairwise(heads)} == {period_ms * 1_000_000}
    assert START_NS < heads[0] <= START_NS + period_ms * 1_000_000


def test_period_zero_never_sends() -> None:
    rig = Rig()
    rig.configure(period_ms=0)
    assert rig.run_ms(1000) == []


@pytest.mark.parametrize("mtb3", [(), (7,)])
def test_period_zero_ends_a_stream(mtb3: tuple[int, ...]) -> None:
    rig = Rig(mtb3=mtb3)
    rig.configure()
    assert rig.streams()
    rig.send(0x207, "4D 00 00 F0")
    rig.run_ms(10)
    assert rig.run_ms(1000) == []


def test_set_brd_cfg_disables_all_triangles_even_while_streaming() -> None:
    rig = Rig()
    rig.configure()
    assert rig.streams()
    rig.send(0x207, CONFIGURE)
    rig.run_ms(10)
    assert rig.run_ms(1000) == []
    rig.send(0x207, "07 00")
    assert not rig.streams()


def test_the_no_load_value_is_taken_over() -> None:
    rig = Rig(not_connected=("7/0",))
    rig.send(0x207, "4D 00 32 64")
    rig.send(0x207, ENABLE_ALL)
    rig.send(0x207, "07 00")
    assert rig.run_ms(60)[0].payload == bytes.fromhex("40 64 64 64 64 64 64 64")


@pytest.mark.thorough
@pytest.mark.parametrize("board_type", ["00", "10"], ids=["0", "only the low four bits count"])
def test_the_board_type_is_four_bits(board_type: str) -> None:
    rig, plain = Rig(), Rig()
    plain.configure()
    rig.send(0x207, f"4D {board_type} 32 F0")
    rig.send(0x207, ENABLE_ALL)
    rig.send(0x207, "07 00")
    assert rig.run_ms(60_000) == plain.run_ms(60_000)


@pytest.mark.parametrize("triangles", ["05 04", "00 10", "10 10", "FF FF"])
def test_set_triang_cfg_with_a_bad_range_is_ignored(triangles: str) -> None:
    rig = Rig()
    rig.configure()
    before = len(rig.events("recalibrated"))
    rig.send(0x207, f"50 {triangles} 02 00 00 22")
    assert rig.streams()
    assert len(rig.events("recalibrated")) == before


def test_set_triang_cfg_stops_an_mtb4_and_recalibrates_it() -> None:
    rig = Rig()
    rig.configure()
    assert rig.streams()
    rig.send(0x207, "50 04 04 02 01 00 22")
    rig.run_ms(10)
    assert rig.run_ms(1000) == []
    assert rig.events("recalibrated")[-1].reason == "command"


def test_the_new_baseline_of_a_pressed_triangle_is_its_idle_value() -> None:
    rig = Rig()
    rig.configure(skin_type=2, period_ms=10)
    while min(min(frame.payload[1:6], default=255) for frame in rig.run_ms(20)) > 150:
        assert rig.now_ns < START_NS + 20_000_000_000
    rig.send(0x207, "07 01")
    rig.run_ms(5)
    rig.configure(skin_type=2, period_ms=10)
    assert min(min(frame.payload[1:6]) for frame in rig.run_ms(11)) > 230
    assert max(max(frame.payload[1:6]) for frame in rig.run_ms(3000)) == 255  # let go: lighter than idle


def test_enable_bit_off_takes_triangles_out() -> None:
    rig = Rig()
    rig.configure(start=False)
    rig.send(0x207, "50 01 0E 02 00 00 22")
    rig.send(0x207, "07 00")
    assert {frame.identifier for frame in rig.run_ms(60)} == {0x470, 0x47F}


def test_only_bit_0_of_enable_counts() -> None:
    rig = Rig()
    rig.send(0x207, CONFIGURE)
    rig.send(0x207, "50 00 00 02 FE 00 22")
    rig.send(0x207, "50 01 01 02 FF 00 22")
    rig.send(0x207, "07 00")
    assert {frame.identifier for frame in rig.run_ms(60)} == {0x471}


def test_a_larger_shift_makes_presses_smaller() -> None:
    def deepest(shift: int) -> int:
        rig = Rig(seed=3)
        rig.send(0x207, "4D 02 32 F0")
        rig.send(0x207, f"50 00 0F {shift:02X} 01 00 22")
        rig.send(0x207, "07 00")
        return min(min(frame.payload[1:6]) for frame in rig.run_ms(4000))

    assert deepest(0) == 0
    assert deepest(2) < deepest(3) < deepest(4)


def test_a_far_off_cdc_offset_saturates_the_converters() -> None:
    rig = Rig(seed=3)
    rig.send(0x207, CONFIGURE)
    rig.send(0x207, "50 00 0F 02 01 00 FF")
    rig.send(0x207, "07 00")
    assert {frame.payload[1:6] for frame in rig.run_ms(4000)} == {b"\xf0" * 5}


def test_no_configuration_command_is_answered() -> None:
    rig = Rig(boards=(7, 8), mtb3=(8,))
    for board in (7, 8):
        for payload in (CONFIGURE, ENABLE_ALL, "07 01", "4F 00 00", "4E 02 02 F0 08 FF FF 0A"):
            rig.send(0x200 | board, payload)
    assert rig.run_ms(1000) == []


def test_other_boards_do_not_hear_a_unicast() -> None:
    rig = Rig(boards=(7, 8))
    rig.configure(7)
    assert rig.streams(7)
    assert not rig.streams(8)


def test_the_broadcast_starts_mtb4s_only() -> None:
    rig = Rig(boards=(7, 8), mtb3=(8,))
    rig.send(0x20F, "07 00")
    frames = rig.run_ms(100)
    assert {frame.identifier >> 4 for frame in frames} == {0x47}


@pytest.mark.parametrize("payload", ["", "07", "4D 00 32", "50 00 0F 02 01 00", "1C 02"])
def test_too_short_commands_do_nothing(payload: str) -> None:
    rig = Rig(boards=(7, 8), mtb3=(8,))
    rig.send(0x207, payload)
    rig.send(0x208, payload)
    assert rig.run_ms(1000) == []
    assert rig.hardware.totals()["commands"] == 0


@pytest.mark.parametrize("identifier", [0x0207 | 0x8000_0000, 0x107, 0x307, 0x407, 0x507, 0x607, 0x206, 0x200])
def test_frames_for_others_mean_nothing(identifier: int) -> None:
    rig = Rig()
    rig.send(identifier, "07 00")
    assert rig.run_ms(1000) == []


def test_mtb4_ignores_the_top_bit_of_a_command() -> None:
    rig = Rig()
    rig.send(0x207, "87 00")
    assert rig.streams()


def test_what_was_felt_before_a_stop_is_not_sent_after_it() -> None:
    rig, reference = Rig(), Rig()
    for each in (rig, reference):
        each.configure()
        each.run_ms(3025)
        each.send(0x207, "07 01")
        each.run_ms(4000)
    reference.hardware.set_triangle(7, 0, "ack", reference.now_ns)  # changes nothing, but all is computed again
    for each in (rig, reference):
        each.send(0x207, "07 00")
    assert rig.run_ms(1000) == reference.run_ms(1000)


# Versions and discovery


def test_version_of_an_mtb4() -> None:
    rig = Rig()
    rig.send(0x207, "1C 02 00")
    (reply,) = rig.run_ms(5)
    assert (reply.identifier, reply.payload) == (0x270, bytes.fromhex("1C 0B 01 19 00 02 00 01"))


@pytest.mark.parametrize(("wanted", "compatible"), [("02 00", 1), ("02 01", 0), ("01 00", 0), ("03 00", 0)])
def test_version_says_whether_the_protocols_fit(wanted: str, compatible: int) -> None:
    rig = Rig()
    rig.send(0x207, f"1C {wanted}")
    assert rig.run_ms(5)[0].payload[7] == compatible


def test_version_by_broadcast_is_answered_by_mtb4s_only() -> None:
    rig = Rig(boards=(9, 7, 8), mtb3=(8,))
    rig.send(0x20F, "1C 02 00")
    assert [frame.identifier for frame in rig.run_ms(5)] == [0x270, 0x290]
    rig.send(0x208, "1C 01 00")
    (reply,) = rig.run_ms(5)
    assert (reply.identifier, reply.payload[:2]) == (0x280, bytes.fromhex("1C 05"))


def test_discovery_is_answered_by_all() -> None:
    rig = Rig(boards=(7, 8), mtb3=(8,))
    rig.send(0x70F, "FF")
    replies = rig.run_ms(5)
    assert [frame.identifier for frame in replies] == [0x770, 0x780]
    assert replies[0].payload == bytes.fromhex("FF 0B 01 19 00")
    assert (replies[1].payload[:2], len(replies[1].payload)) == (bytes.fromhex("FF 05"), 5)


def test_replies_go_to_whoever_asked() -> None:
    rig = Rig()
    rig.send(0x237, "1C 02 00")
    assert rig.run_ms(5)[0].identifier == 0x273


def test_a_version_request_does_not_disturb_the_stream() -> None:
    rig = Rig(boards=(7, 8), mtb3=(8,))
    for board in (7, 8):
        rig.configure(board)
    rig.run_ms(300)
    for board in (7, 8):
        rig.send(0x200 | board, "1C 02 00")
    assert rig.streams(7)
    assert rig.streams(8)


def test_mtb4_takes_tact_setup_without_its_parameters() -> None:
    rig = Rig(not_connected=("7/0",))
    rig.send(0x207, "4C 01 01 03 00 30 10 10")
    bursts = cycles(rig.run_ms(400))
    assert bursts[0][0].identifier == 0x470
    assert bursts[0][0].payload == bytes.fromhex("40 F5 F5 F5 F5 F5 F5 F5")
    assert bursts[1][0].time_ns - bursts[0][0].time_ns == 40_000_000


def test_mtb4_does_not_know_tact_setup2() -> None:
    rig = Rig()
    rig.configure()
    rig.run_ms(100)
    rig.send(0x207, "4E 02 22 F0 08 03 80 0A")
    assert len(cycles(rig.run_ms(101))[0]) == 32


# Inertial sensors and addresses


def test_inertial_data() -> None:
    rig = Rig()
    rig.send(0x207, "4F 06 0A")
    frames = rig.run_ms(101)
    assert [(frame.identifier, len(frame.payload)) for frame in frames[:2]] == [(0x571, 6), (0x570, 6)]
    assert len(frames) == 20
    x, _, z = (int.from_bytes(frames[0].payload[at : at + 2], "little", signed=True) for at in (0, 2, 4))
    assert 970**2 < x**2 + z**2 < 990**2  # gravity in cm/s^2
    rig.send(0x207, "4F 02 32")
    assert {frame.identifier for frame in rig.run_ms(500)} == {0x571}
    rig.send(0x207, "4F 00 32")
    assert rig.run_ms(500) == []


def test_a_level_mtb3_sends_its_gravity_as_16384() -> None:
    rig = Rig(mtb3=(7,))
    rig.send(0x207, "4F 02 0A")
    (frame,) = rig.run_ms(11)
    x, y, z = (int.from_bytes(frame.payload[at : at + 2], "little", signed=True) for at in (0, 2, 4))
    assert (frame.identifier, y) == (0x571, 0)
    assert 16300**2 < x**2 + z**2 < 16400**2


def test_an_imu_sends_its_sensors_with_one_number_per_round() -> None:
    rig = Rig()
    rig.send(0x207, "33 07 00 01 00 00 00 00")
    assert rig.run_ms(200) == []
    rig.send(0x207, "35 0A")
    frames = rig.run_ms(31)
    assert {frame.identifier for frame in frames} == {0x573}
    assert [frame.payload[:2].hex() for frame in frames] == [f"0{n}0{sensor}" for n in (1, 2, 3) for sensor in range(3)]
    assert {len(frame.payload) for frame in frames} == {8}
    rig.send(0x207, "35 00")
    assert rig.run_ms(200) == []


def test_an_mtb3_has_no_imu() -> None:
    rig = Rig(mtb3=(7,))
    rig.send(0x207, "33 07 00 01 00 00 00 00")
    rig.send(0x207, "35 0A")
    assert rig.run_ms(200) == []
    assert rig.hardware.totals()["commands"] == 0


def test_skipping_counts_what_an_imu_would_have_sent() -> None:
    rig = Rig()
    rig.send(0x207, "33 05 00 01 00 00 00 00")
    rig.send(0x207, "35 05")
    rig.hardware.skip(START_NS + 60_002_000_000)  # the last ones need their time on the wire
    assert rig.hardware.totals()["unheard"] == 2 * 200 * 60


@pytest.mark.parametrize("identifier", [0x207, 0x707])
def test_set_address(identifier: int) -> None:
    rig = Rig()
    rig.configure()
    rig.send(identifier, "32 05")
    assert rig.streams(5)
    rig.send(0x207, "07 01")
    assert rig.streams(5)
    rig.send(0x205, "07 01")
    rig.run_ms(10)
    assert not rig.streams(5)


@pytest.mark.parametrize("address", ["00", "0F", "10", "FF"])
def test_impossible_addresses_are_refused(address: str) -> None:
    rig = Rig()
    rig.send(0x207, f"32 {address}")
    rig.configure()
    assert rig.streams(7)


def test_commands_are_logged_and_counted() -> None:
    rig = Rig(boards=(7, 8))
    rig.send(0x20F, "1C 02 00")
    rig.send(0x208, "07 00")
    rig.send(0x209, "07 00")
    commands = rig.events("command_received")
    assert [(event.identifier, event.payload, event.boards) for event in commands] == [
        (0x20F, "1c0200", [7, 8]),
        (0x208, "0700", [8]),
    ]
    assert rig.hardware.totals()["commands"] == 2


def test_streaming_from_power_up() -> None:
    rig = Rig(boards=(7, 8), mtb3=(8,), streaming=True)
    assert rig.streams(7)
    assert rig.streams(8)
    assert rig.hardware.totals()["commands"] == 0
