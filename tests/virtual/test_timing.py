"""When frames go onto the wire: in order, one at a time, the lowest identifier first."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from skinware_drivers.virtual.device import Transmission, Wire, frame_time_ns
from skinware_drivers.virtual.hardware import WireFrame

from .rig import MS, START_NS, Rig, cycles, is_data

FRAME_NS = 130_000


def test_a_frame_of_eight_bytes_takes_130_bits() -> None:
    assert frame_time_ns(0x473, 8) == FRAME_NS
    assert frame_time_ns(0x473, 0) == 53_000
    assert frame_time_ns(0x473, 6) == 111_000
    assert frame_time_ns(0x8000_0473, 8) == 154_000


def test_frames_of_a_burst_follow_each_other_without_a_gap() -> None:
    rig = Rig()
    rig.configure()
    burst = cycles(rig.run_ms(60))[0]
    assert [frame.time_ns - burst[0].time_ns for frame in burst] == [at * FRAME_NS for at in range(32)]


def test_boards_begin_at_phases_of_their_own() -> None:
    rig = Rig(boards=(7, 8, 9, 10), streaming=True)
    first: dict[int, float] = {}
    for frame in rig.run_ms(60):
        first.setdefault(frame.identifier >> 4 & 0xF, (frame.time_ns - START_NS) / MS)
    assert len(first) == 4
    assert len({round(time_ms) for time_ms in first.values()}) == 4
    assert all(0 < time_ms <= 50 for time_ms in first.values())


@pytest.mark.thorough
def test_one_frame_at_a_time_however_the_bursts_collide() -> None:
    rig = Rig(boards=tuple(range(1, 15)), streaming=True, foreign_hz=500, lose=0.02)
    frames = rig.run_ms(2000)
    assert len(frames) > 14 * 30 * 35
    for before, after in itertools.pairwise(frames):
        assert after.time_ns >= before.time_ns + frame_time_ns(before.identifier, len(before.payload))


def test_halves_of_a_board_stay_in_order_among_other_boards() -> None:
    rig = Rig(boards=tuple(range(1, 15)), streaming=True, pattern="cycle")
    frames = rig.run_ms(1000)
    for board in range(1, 15):
        own = [frame for frame in frames if is_data(frame, board)]
        own = own[: len(own) // 32 * 32]
        assert [frame.payload[0] for frame in own[::2]] == [0x40] * (len(own) // 2)
        for head, tail in zip(own[::2], own[1::2], strict=True):
            assert (tail.payload[0], tail.identifier, tail.payload[1]) == (0xC0, head.identifier, head.payload[1])
    interleaved = sum(
        one.identifier >> 4 != other.identifier >> 4 for one, other in zip(frames[::2], frames[1::2], strict=False)
    )
    assert interleaved > 0


def test_the_lowest_identifier_wins_the_wire() -> None:
    wire = Wire()
    third, second, first = wire.attach(), wire.attach(), wire.attach()
    first.append(Transmission(0, [0x4A0, 0x4A0], [b"12345678", b"abcdefgh"], usual=True))
    second.append(Transmission(10_000, [0x470, 0x600], [b"x", b"y"]))
    third.append(Transmission(20_000, [0x8000_0000 | 0x4A0 << 18], [b""]))
    wire.run(1_000_000)
    assert [(frame.identifier & 0x7FF, frame.payload) for frame in wire.heard] == [
        (0x4A0, b"12345678"),  # alone when it began
        (0x470, b"x"),
        (0x4A0, b"abcdefgh"),  # a standard frame before an extended one that begins alike
        (0, b""),
        (0x600, b"y"),
    ]


def test_a_wire_sends_nothing_before_it_is_due() -> None:
    wire = Wire()
    device = wire.attach()
    device.append(Transmission(100, [0x470] * 3, [b"12345678"] * 3, usual=True))
    assert wire.next_start_ns() == 100
    wire.run(100)
    assert wire.heard == []
    wire.run(101)
    assert [frame.time_ns for frame in wire.heard] == [100]
    assert wire.next_start_ns() == 130_100
    wire.run(130_101)
    assert [frame.time_ns for frame in wire.heard] == [100, 130_100]
    assert len(device) == 1


def test_frames_of_odd_lengths_take_their_own_time() -> None:
    burst = cycles(Rig(streaming=True, truncate=0.5).run_ms(60))[0]
    for before, after in itertools.pairwise(burst):
        assert after.time_ns == before.time_ns + frame_time_ns(0x470, len(before.payload))


def test_frames_that_went_out_before_a_command_came_are_due() -> None:
    rig = Rig(streaming=True)
    rig.now_ns += 60 * MS
    rig.send(0x207, "1C 02 00")
    due_ns = rig.hardware.next_due_ns()
    assert due_ns is not None
    assert due_ns < rig.now_ns
    assert rig.run_ms(0)[0].time_ns == due_ns


def test_nothing_depends_on_how_often_one_asks() -> None:
    options: dict[str, Any] = {
        "boards": (7, 8, 9), "streaming": True, "lose": 0.05, "jitter_us": 3000, "foreign_hz": 200}  # fmt: skip
    coarse, fine = Rig(**options), Rig(**options)
    at_once = coarse.run_ms(1500)
    bit_by_bit: list[WireFrame] = []
    while fine.now_ns < coarse.now_ns:
        bit_by_bit += fine.run_ms(0.7 if fine.now_ns + 0.7 * MS < coarse.now_ns else (coarse.now_ns - fine.now_ns) / MS)
    assert bit_by_bit == at_once
    assert fine.log == coarse.log


def test_asking_when_due_gets_every_frame_at_its_time() -> None:
    rig, other = Rig(boards=(7, 8), streaming=True), Rig(boards=(7, 8), streaming=True)
    frames: list[WireFrame] = []
    empty = 0
    while (due_ns := rig.hardware.next_due_ns()) is not None and due_ns <= START_NS + 300 * MS:
        new = rig.hardware.emit(due_ns)
        assert all(frame.time_ns == due_ns for frame in new)
        frames += new
        empty += not new
    assert frames == other.run_ms(300)
    assert empty == 0


def test_another_seed_is_another_skin_and_the_same_seed_the_same() -> None:
    def run(seed: int) -> list[WireFrame]:
        return Rig(seed=seed, streaming=True, lose=0.1).run_ms(500)

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_a_time_before_the_last_one_changes_nothing() -> None:
    rig = Rig(streaming=True)
    rig.run_ms(500)
    assert rig.hardware.emit(START_NS) == []
    rig.hardware.receive(0x207, bytes.fromhex("1C0200"), START_NS)
    assert rig.run_ms(1)[0].time_ns > START_NS + 500 * MS


@pytest.mark.thorough
def test_a_period_shorter_than_the_burst_overflows_the_boards_queue_and_says_so() -> None:
    rig = Rig(pattern="cycle")
    rig.configure(period_ms=2)
    frames = rig.run_ms(1000)
    assert 1000 / 0.13 * 0.98 < len(frames) <= 1000 / 0.13
    lost = rig.lost()
    assert {event.reason for event in lost} == {"overflow"}
    totals = rig.hardware.totals()
    assert totals["lost"] == len(lost)
    waiting = totals["bursts"] * 32 - len(frames) - len(lost)
    assert 0 <= waiting <= 48


# Nobody listens


@pytest.mark.thorough
def test_skipping_counts_what_went_unheard_and_cycles_go_on() -> None:
    heard, unheard = Rig(streaming=True, pattern="cycle"), Rig(streaming=True, pattern="cycle")
    count = len(heard.run_ms(60_000))
    later = heard.run_ms(1000)
    assert unheard.hardware.skip(START_NS + 60_000 * MS) == count
    unheard.now_ns += 60_000 * MS
    assert unheard.run_ms(1000) == later
    assert unheard.hardware.totals()["unheard"] == count


def test_skipping_an_hour_is_quick() -> None:
    rig = Rig(boards=(7, 8), streaming=True, foreign_hz=1000)
    rig.send(0x207, "4F 06 05")
    rig.hardware.skip(START_NS + 3600 * 1000 * MS)
    totals = rig.hardware.totals()
    assert totals["bursts"] == 2 * 20 * 3600
    expected = totals["bursts"] * 32 + 2 * 200 * 3600 + 1000 * 3600
    assert abs(totals["unheard"] - expected) < 0.001 * expected
