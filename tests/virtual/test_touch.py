"""The skin feels something that looks like touch."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from skinware.realtime import NS_PER_S
from skinware_drivers.virtual.roboskin.converters import Arithmetic
from skinware_drivers.virtual.roboskin.touch import DEFAULT_CDC_OFFSET, Touch

from .rig import Rig, cycles


def values(rig: Rig, duration_ms: float) -> npt.NDArray[np.int64]:
    """(n_cycles, 16, 12) what went over the wire."""
    bursts = [burst for burst in cycles(rig.run_ms(duration_ms)) if len(burst) == 32]
    found = np.zeros((len(bursts), 16, 12), np.int64)
    for at, burst in enumerate(bursts):
        for frame in burst:
            first, count = (0, 7) if frame.payload[0] == 0x40 else (7, 5)
            found[at, frame.identifier & 0xF, first : first + count] = list(frame.payload[1 : 1 + count])
    return found


TACTILE = [channel for channel in range(12) if channel not in (6, 10)]


def test_idle_noise_is_one_or_two() -> None:
    rig = Rig(pattern="idle")
    rig.configure()
    idle = values(rig, 3000)[:, :, TACTILE]
    assert (abs(idle - 240) <= 2).mean() > 0.98
    assert abs(idle - 240).max() <= 3
    assert (idle != 240).mean() > 0.3
    assert (np.diff(idle, axis=0) != 0).mean(axis=(1, 2)).min() > 0.2


def test_nobody_presses_before_the_board_streamed_for_a_second() -> None:
    rig = Rig(seed=5)
    rig.run_ms(7300)
    rig.configure()
    felt = values(rig, 1000)[:, :, TACTILE]
    assert felt.min() > 236
    assert values(rig, 4000)[:, :, TACTILE].min() < 200


def test_a_press_wanders_and_lets_go() -> None:
    rig = Rig()
    rig.configure()
    felt = values(rig, 30_000)
    pressed = felt[:, :, TACTILE] < 220
    touched = pressed.any(axis=(1, 2))
    assert 0.3 < touched.mean() < 0.9  # presses and pauses
    assert 100 < felt[:, :, TACTILE].min() < 160
    assert (pressed.any(axis=2).any(axis=0)).sum() >= 12  # nearly all triangles get their turn
    assert pressed.sum(axis=(1, 2)).max() < 100  # a spot, not the whole patch
    assert abs(np.diff(felt, axis=0)).max() < 70  # smooth


def test_thermal_pads_feel_warmth_and_no_pressure() -> None:
    rig = Rig()
    rig.configure()
    pads = values(rig, 60_000)[:, :, [6, 10]]
    assert np.ptp(pads) > 10
    assert pads.min() > 200
    assert abs(np.diff(pads, axis=0)).max() <= 4


@pytest.mark.thorough
def test_a_skin_that_nobody_touches_stays_in_range_for_an_hour_whenever_its_baseline_was_taken() -> None:
    seconds = np.arange(3600)
    offset = np.full((16, 1), DEFAULT_CDC_OFFSET)
    raw = Touch(0, 0).capacitances(seconds * NS_PER_S, seconds, offset, fingertip=False)
    for skin_type in (0, 2):
        arithmetic = Arithmetic(skin_type, 240, (2,) * 16, mtb3=False)
        for baseline in raw[::97]:
            sample = arithmetic.sample(raw, baseline)
            assert not sample.diagnostics.any()
            assert 200 < sample.values.min() <= sample.values.max() < 255


@pytest.mark.thorough
def test_warmth_shows_in_taxels_that_are_not_compensated() -> None:
    def spread(skin_type: int) -> int:
        rig = Rig(pattern="idle")
        rig.configure(skin_type=skin_type)
        return int(np.ptp(values(rig, 60_000)[:, :, 9]))

    assert spread(2) > 15
    assert spread(0) < 8


def test_a_fingertip_feels_pressure_in_all_channels() -> None:
    rig = Rig()
    rig.configure(skin_type=1)
    felt = values(rig, 30_000)
    assert felt[:, :, 6].min() < 200
    assert felt[:, :, 10].min() < 200


def test_boards_feel_different_things() -> None:
    at = np.arange(10) * 1_000_000_000
    offset = np.full((16, 1), DEFAULT_CDC_OFFSET)
    one, again, other = (
        Touch(0, ordinal).capacitances(at, at // at[1], offset, fingertip=False) for ordinal in (0, 0, 1)
    )
    assert (one == again).all()
    assert (one != other).mean() > 0.9


def test_the_pattern_cycle_is_the_burst_s_number_in_every_value() -> None:
    rig = Rig(pattern="cycle", streaming=True)
    felt = values(rig, 14_000)
    assert len(felt) > 256
    assert (felt == (np.arange(len(felt)) % 256)[:, np.newaxis, np.newaxis]).all()


def test_a_programmed_source_is_asked_once_for_every_triangle_of_every_burst() -> None:
    asked: list[tuple[int, int, int, int]] = []

    def source(board: int, triangle: int, cycle: int, time_ns: int) -> list[int]:
        asked.append((board, triangle, cycle, time_ns))
        return [(cycle * 16 + triangle + channel) % 256 for channel in range(12)]

    rig = Rig(source=source)
    rig.configure(start=False)
    rig.send(0x207, "50 08 0F 02 00 00 22")
    rig.send(0x207, "07 00")
    bursts = cycles(rig.run_ms(201))
    assert [(board, triangle, cycle) for board, triangle, cycle, _ in asked] == [
        (7, triangle, cycle) for cycle in range(len(bursts)) for triangle in range(8)
    ]
    assert [time_ns for _, triangle, _, time_ns in asked if not triangle] == [burst[0].time_ns for burst in bursts]
    assert bursts[2][10].payload == bytes([0x40, *range(37, 44)])
    assert bursts[2][11].payload == bytes([0xC0, *range(44, 49), 0, 0])
