"""Every fault does what it says, is counted, and is written down exactly."""

from __future__ import annotations

import itertools
from pathlib import Path

import msgspec
import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.virtual.hardware import Event, JsonLinesLog, WireFrame
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions

from .rig import MS, START_NS, Rig, cycles, damaged_cycles

Key = tuple[int, int, int]


def halves_by_cycle(frames: list[WireFrame]) -> dict[Key, list[WireFrame]]:
    """Frames of the pattern ``cycle``, by (board, triangle, cycle)."""
    found: dict[Key, list[WireFrame]] = {}
    for frame in frames:
        key = (frame.identifier >> 4 & 0xF, frame.identifier & 0xF, frame.payload[1])
        found.setdefault(key, []).append(frame)
    return found


# Lost and damaged frames


def test_the_log_of_lost_halves_tells_exactly_which_modules_are_damaged() -> None:
    rig = Rig(boards=(7, 8), streaming=True, pattern="cycle", lose=0.03, seed=4)
    frames = rig.run_ms(12_000)
    rig.send(0x207, "07 01")
    rig.send(0x208, "07 01")
    frames += rig.run_ms(20)
    totals = rig.hardware.totals()
    lost = rig.lost()
    assert totals["bursts"] < 2 * 256  # cycle numbers are unique in the values
    assert 0.02 < len(lost) / (totals["bursts"] * 32) < 0.04
    assert len(frames) + len(lost) == totals["bursts"] * 32
    intact = {key for key, halves in halves_by_cycle(frames).items() if len(halves) == 2}
    every = {(board, triangle, cycle) for board in (7, 8) for triangle in range(16)
             for cycle in range(totals["bursts"] // 2)}  # fmt: skip
    assert damaged_cycles(rig.log) == every - intact
    heard = {(*key, "head" if half.payload[0] == 0x40 else "tail")
             for key, halves in halves_by_cycle(frames).items() for half in halves}  # fmt: skip
    assert all((event.board, event.triangle, event.cycle, event.half) not in heard for event in lost)
    assert {event.half for event in lost} == {"head", "tail"}
    assert {event.reason for event in lost} == {"random"}
    assert totals["lost"] == len(lost)


def test_losing_everything_leaves_silence_on_a_busy_wire() -> None:
    rig = Rig(streaming=True, lose=1.0)
    assert rig.run_ms(1000) == []
    assert rig.hardware.totals()["lost"] == 32 * rig.hardware.totals()["bursts"] > 0


def test_a_lost_frame_takes_its_time_on_the_wire() -> None:
    whole, lossy = Rig(streaming=True), Rig(streaming=True, lose=0.3)
    assert {frame.time_ns for frame in lossy.run_ms(500)} < {frame.time_ns for frame in whole.run_ms(500)}


def test_truncated_frames_are_logged() -> None:
    rig = Rig(streaming=True, truncate=0.05)
    frames = rig.run_ms(5000)
    logged = rig.events("frame_fault")
    assert sorted(len(frame.payload) for frame in frames if len(frame.payload) != 8) == sorted(
        len(event.payload or "") // 2 for event in logged
    )
    assert rig.hardware.totals()["truncated"] == len(logged) > 100
    assert damaged_cycles(rig.log) == {(event.board, event.triangle, event.cycle) for event in logged}


def test_jitter_delays_single_bursts_and_does_not_add_up() -> None:
    steady, shaken = Rig(streaming=True), Rig(streaming=True, jitter_us=3000)
    on_time = [burst[0].time_ns for burst in cycles(steady.run_ms(5000))]
    late = [burst[0].time_ns for burst in cycles(shaken.run_ms(5000))]
    delays = [after - before for before, after in zip(on_time, late, strict=True)]
    assert all(0 <= delay <= 3 * MS for delay in delays)
    assert len(set(delays)) > 90
    assert not any(delay % 1000 for delay in delays)
    logged = {event.cycle: event.delay_ns for event in shaken.events("burst_delayed")}
    assert logged == {cycle: delay for cycle, delay in enumerate(delays) if delay}


def test_foreign_frames_come_at_their_rate_and_are_logged() -> None:
    rig = Rig(boards=(7, 8), foreign_hz=200)
    frames = rig.run_ms(10_000)
    logged = rig.events("foreign_frame")
    assert [(frame.identifier, len(frame.payload)) for frame in frames] == [
        (event.identifier, event.length) for event in logged
    ]
    assert 1800 < len(frames) < 2200
    assert rig.hardware.totals()["foreign"] == len(logged)
    standard = {frame.identifier for frame in frames if frame.identifier <= 0x7FF}
    assert {identifier >> 8 for identifier in standard} == {1, 3, 4, 5}
    assert not {identifier >> 4 & 0xF for identifier in standard} & {7, 8}
    extended = {frame.identifier for frame in frames} - standard
    assert {identifier & 0x8000_07FF for identifier in extended} == {0x8000_0473, 0x8000_0483}


# Boards that die and restart


def test_dead_from_the_start_is_deaf_and_dumb() -> None:
    rig = Rig(boards=(7, 8), dead=(8,), dead_after_s=0)
    rig.send(0x208, "1C 02 00")
    rig.send(0x70F, "FF")
    rig.configure(7)
    rig.configure(8)
    assert {frame.identifier >> 4 & 0xF for frame in rig.run_ms(1000)} == {7}
    assert rig.events("board_died") == [Event("board_died", START_NS, board=8)]


def test_dead_after_seconds_in_the_middle_of_a_burst() -> None:
    rig = Rig(streaming=True, pattern="cycle", dead=(7,), dead_after_s=2.0)
    alive = Rig(streaming=True, pattern="cycle").run_ms(4000)
    death_ns = START_NS + 2000 * MS
    frames = rig.run_ms(4000)
    assert frames == [frame for frame in alive if frame.time_ns < death_ns]
    assert rig.events("board_died") == [Event("board_died", death_ns, board=7)]
    bursts = rig.hardware.totals()["bursts"]
    assert len(frames) + len(rig.lost()) == 32 * bursts
    halves = halves_by_cycle(frames)
    assert damaged_cycles(rig.log) == {
        (7, triangle, bursts - 1) for triangle in range(16) if len(halves.get((7, triangle, bursts - 1), [])) < 2
    }


def test_death_in_a_burst_loses_what_was_not_sent_yet() -> None:
    rig = Rig(streaming=True, pattern="cycle")
    begin_ns = rig.hardware.next_due_ns()
    assert begin_ns is not None
    rig.hardware.kill(7, begin_ns + 4 * 130_000 + 1)
    assert len(rig.run_ms(1000)) == 5
    lost = rig.lost()
    assert len(lost) == 27
    assert (lost[0].triangle, lost[0].half, lost[0].reason) == (2, "tail", "died")
    assert damaged_cycles(rig.log) == {(7, triangle, 0) for triangle in range(2, 16)}


def test_a_half_is_lost_only_once() -> None:
    rig = Rig(streaming=True, pattern="cycle", lose=0.5)
    begin_ns = rig.hardware.next_due_ns()
    assert begin_ns is not None
    rig.hardware.kill(7, begin_ns + 2 * MS)
    heard = len(rig.run_ms(1000))
    lost = rig.lost()
    assert heard + len(lost) == 32
    assert len({(event.triangle, event.half) for event in lost}) == len(lost)
    assert {event.reason for event in lost} == {"random", "died"}


@pytest.mark.parametrize("mtb3", [(), (7,)])
def test_a_restarted_board_is_silent_forgets_everything_and_answers_after_its_boot(mtb3: tuple[int, ...]) -> None:
    rig = Rig(mtb3=mtb3, not_connected=("7/0",), restart=(7,), restart_after_s=2, boot_s=0.3)
    rig.configure()
    rig.run_ms(2001)
    (restarted,) = rig.events("board_restarted")
    assert restarted.ready_ns == START_NS + 2300 * MS
    rig.send(0x207, "1C 01 00")
    assert rig.run_ms(298) == []
    rig.run_ms(2)
    rig.send(0x207, "1C 01 00")
    assert [frame.identifier for frame in rig.run_ms(500)] == [0x270]
    rig.send(0x207, "07 00")
    assert rig.run_ms(100)[0].payload == bytes.fromhex("40 F5 F5 F5 F5 F5 F5 F5")  # no load 245 again
    rig.configure()
    rig.run_ms(210)
    assert rig.streams()


def test_cycles_go_on_after_a_restart() -> None:
    rig = Rig(pattern="cycle", streaming=True)
    before = {frame.payload[1] for frame in rig.run_ms(1000)}
    rig.hardware.restart(7, rig.now_ns)
    rig.run_ms(600)
    rig.configure()
    after = {frame.payload[1] for frame in rig.run_ms(1000)}
    assert max(before) < min(after) <= max(before) + 2


def test_a_dead_board_lives_again_after_a_restart() -> None:
    rig = Rig(streaming=True, dead=(7,), dead_after_s=0.2)
    rig.run_ms(1000)
    rig.hardware.restart(7, rig.now_ns)
    rig.run_ms(600)
    rig.configure()
    assert rig.streams()
    assert len(rig.run_ms(1000)) > 500


def test_faults_at_boards_that_are_not_there() -> None:
    with pytest.raises(ConfigurationError, match="no emulated device 9"):
        Rig().hardware.kill(9, START_NS)


# Triangles


@pytest.mark.parametrize("mtb3", [(), (7,)])
def test_unplugged_later_reads_full_pressure_and_is_flagged(mtb3: tuple[int, ...]) -> None:
    rig = Rig(mtb3=mtb3, unplugged=("7/3",), unplugged_after_cycles=4)
    rig.configure(skin_type=2)
    bursts = cycles(rig.run_ms(1000))
    assert [burst[7].payload[6:].hex() for burst in bursts[:6]] == ["0000"] * 4 + ["fff2"] * 2
    assert bursts[4][6].payload == bytes.fromhex("40 00 00 00 00 00 00 00")
    assert bursts[4][9].payload[6:] == b"\0\0"
    (fault,) = rig.events("triangle_fault")
    assert (fault.board, fault.triangle, fault.cycle, fault.fault) == (7, 3, 4, "unplugged")


def test_plugged_in_again() -> None:
    rig = Rig()
    rig.configure()
    rig.run_ms(500)
    rig.hardware.set_triangle(7, 3, "unplugged", rig.now_ns)
    rig.run_ms(5)
    assert {frame.payload[6:].hex() for frame in rig.run_ms(50) if frame.identifier == 0x473} >= {"fff2"}
    rig.hardware.set_triangle(7, 3, "plugged_in", rig.now_ns)
    rig.run_ms(5)
    assert {f.payload[6:].hex() for f in rig.run_ms(50) if (f.identifier, f.payload[0]) == (0x473, 0xC0)} == {"0000"}
    assert [event.fault for event in rig.events("triangle_fault")] == ["unplugged", "plugged_in"]


def test_a_triangle_plugged_in_after_calibration_reads_no_pressure_until_the_next_one() -> None:
    rig = Rig(not_connected=("7/3",))
    rig.configure(skin_type=2)
    rig.run_ms(100)
    rig.hardware.set_triangle(7, 3, "plugged_in", rig.now_ns)
    rig.run_ms(50)
    head, tail = cycles(rig.run_ms(100))[-1][6:8]
    assert head.payload == bytes.fromhex("40 FF FF FF FF FF FF FF")
    assert tail.payload[6:] == bytes.fromhex("FF F0")


def test_mtb4_recalibrates_after_five_cycles_without_ack_and_the_flag_is_gone() -> None:
    rig = Rig(no_ack=("7/3",), no_ack_after_cycles=4)
    rig.configure(skin_type=2)
    bursts = cycles(rig.run_ms(1000))
    assert [burst[7].payload[7] & 0xF for burst in bursts[:12]] == [0] * 4 + [1] * 5 + [0] * 3
    assert bursts[4][6].payload == bytes.fromhex("40 FF FF FF FF FF FF FF")
    assert bursts[9][6].payload == bytes.fromhex("40 F0 F0 F0 F0 F0 F0 F0")  # looks idle, and is not
    by_no_ack = [event for event in rig.events("recalibrated") if event.reason == "no_ack"]
    assert [event.cycle for event in by_no_ack] == [9]
    starts = [burst[0].time_ns for burst in bursts]
    assert {later - earlier for earlier, later in itertools.pairwise(starts)} == {50 * MS}


def test_mtb3_sends_nothing_for_two_periods_while_it_recalibrates() -> None:
    rig = Rig(mtb3=(7,), no_ack=("7/3",), no_ack_after_cycles=4)
    rig.configure()
    bursts = cycles(rig.run_ms(1500))
    assert [burst[7].payload[7] & 0xF for burst in bursts[:12]] == [0] * 4 + [1] * 5 + [0] * 3
    starts = [burst[0].time_ns for burst in bursts]
    gaps_ms = [(later - earlier) // MS for earlier, later in itertools.pairwise(starts)]
    assert gaps_ms[:12] == [50] * 8 + [150] + [50] * 3


def test_silent_triangles_count_together() -> None:
    rig = Rig(no_ack=("7/3", "7/4", "7/5"), no_ack_after_cycles=4)
    rig.configure()
    bursts = cycles(rig.run_ms(1000))
    assert [burst[7].payload[7] & 0xF for burst in bursts[:8]] == [0] * 4 + [1] * 2 + [0] * 2


def test_disabled_triangles_do_not_count() -> None:
    rig = Rig(no_ack=("7/3",), no_ack_after_cycles=4)
    rig.configure(start=False)
    rig.send(0x207, "50 03 03 02 00 00 22")
    rig.send(0x207, "07 00")
    rig.run_ms(1000)
    assert not [event for event in rig.events("recalibrated") if event.reason == "no_ack"]


def test_the_recalibration_of_a_pressed_patch_makes_values_jump() -> None:
    rig = Rig()
    rig.configure(skin_type=2, period_ms=10)
    while (deepest := min(min(f.payload[1:6], default=255) for f in rig.run_ms(10))) > 150:
        assert rig.now_ns < START_NS + 20_000 * MS
    rig.hardware.set_triangle(7, 15, "no_ack", rig.now_ns)
    rig.run_ms(70)
    assert deepest + 60 < min(min(frame.payload[1:6]) for frame in rig.run_ms(10))
    assert rig.events("triangle_fault")[0].fault == "no_ack"


def test_acknowledging_again_after_the_recalibration_reads_full_pressure() -> None:
    rig = Rig(no_ack=("7/3",), no_ack_after_cycles=4)
    rig.configure(skin_type=2)
    rig.run_ms(1000)
    rig.hardware.set_triangle(7, 3, "ack", rig.now_ns)
    rig.run_ms(50)
    head, tail = cycles(rig.run_ms(100))[-1][6:8]
    assert (head.payload, tail.payload[6:]) == (bytes.fromhex("40 00 00 00 00 00 00 00"), bytes.fromhex("FF F0"))


def test_broken_taxels_are_logged_and_stay_broken_over_calibrations() -> None:
    rig = Rig(out_of_range=("7/3/4",), streaming=True)
    assert [(event.board, event.triangle, event.taxel) for event in rig.events("taxel_out_of_range")] == [(7, 3, 4)]
    for _ in range(2):
        assert cycles(rig.run_ms(100))[0][7].payload[6:] == bytes.fromhex("01 00")
        rig.configure()
        rig.run_ms(5)


# The log


def test_events_as_json_lines(tmp_path: Path) -> None:
    path = tmp_path / "faults.jsonl"
    log = JsonLinesLog(path)
    hardware = EmulatedRoboskin(EmulatedRoboskinOptions(boards=(7,), streaming=True, lose=0.05), log=log)
    hardware.skip(START_NS)
    hardware.emit(START_NS + 1000 * MS)
    lines = [msgspec.json.decode(line) for line in path.read_bytes().splitlines()]
    log.close()
    log.close()
    lost = [line for line in lines if line["event"] == "frame_fault"]
    assert len(lost) == hardware.totals()["lost"] > 0
    assert set(lost[0]) == {
        *("event", "time_ns", "board", "triangle", "cycle", "position", "identifier"),
        *("half", "fault", "reason", "payload"),
    }
    assert {line["event"] for line in lines} == {"recalibrated", "frame_fault"}


def test_a_log_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot write the log"):
        JsonLinesLog(tmp_path / "missing" / "x.jsonl")
