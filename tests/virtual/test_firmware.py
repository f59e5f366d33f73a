"""The firmware's arithmetic, held against numbers worked out by hand.

Source: icub-firmware embot_app_application_theSkin.cpp, ``fill`` and ``computedrift``; MTB3: FillCanMessages8bit.
"""

from __future__ import annotations

import numpy as np
import pytest

from skinware_drivers.virtual.roboskin.converters import Arithmetic, FirmwareSample
from skinware_drivers.virtual.roboskin.touch import ArrayI

BASE = 0x9000


def sample(
    differences: dict[int, int], *, skin_type: int = 2, no_load: int = 240, shift: int = 2, mtb3: bool = False
) -> FirmwareSample:
    """Triangle 0 with some channels off their baseline."""
    baseline = np.full((16, 12), BASE, np.int64)
    raw = baseline.copy()
    for channel, difference in differences.items():
        raw[0, channel] += difference
    return Arithmetic(skin_type, no_load, (shift,) * 16, mtb3).sample(raw[np.newaxis], baseline)


@pytest.mark.parametrize(
    ("difference", "value"),
    [
        (0, 240),
        (3, 240),
        (4, 239),
        (959, 1),
        (960, 0),
        (5000, 0),
        (-1, 241),
        (-4, 241),
        (-5, 242),
        (-59, 255),
        (-60, 255),
    ],
)
@pytest.mark.parametrize("mtb3", [False, True])
def test_value(difference: int, value: int, mtb3: bool) -> None:
    assert sample({4: difference}, mtb3=mtb3).values[0, 0, 4] == value


@pytest.mark.parametrize(("difference", "out"), [(1919, False), (1920, True), (-119, False), (-120, True)])
def test_out_of_range_is_beyond_twice_the_limits(difference: int, out: bool) -> None:
    assert sample({4: difference}).diagnostics[0, 0] == (0x0100 if out else 0)


def test_without_a_shift_a_light_press_saturates() -> None:
    assert sample({4: 100}, shift=0).values[0, 0, 4] == 140
    assert sample({4: 240}, shift=0).values[0, 0, 4] == 0


def test_warmth_is_taken_off() -> None:
    # T = channel 6, +100: (100 >> 2) * gain >> 5 with gains 70 and 164 is 54 and 128
    values = sample({6: 100, 0: 54, 9: 128}, skin_type=0).values[0, 0]
    assert (values[0], values[9], values[6]) == (240, 240, 240 - 25)


@pytest.mark.parametrize(("mtb3", "drift"), [(False, -55), (True, -54)])
def test_cooling_is_rounded_down_by_the_mtb4_and_to_zero_by_the_mtb3(mtb3: bool, drift: int) -> None:
    # (100 >> 2) * 70 / 32 = 54.69
    values = [int(sample({6: -100, 0: off}, skin_type=0, shift=0, mtb3=mtb3).values[0, 0, 0]) for off in (-55, -54)]
    assert values == [240 - (off - drift) for off in (-55, -54)]


@pytest.mark.parametrize(
    ("skin_type", "mtb3", "compensated"),
    [(0, False, True), (0, True, True), (8, False, True), (8, True, False), (1, False, False), (2, False, False),
     (5, False, False), (15, False, False), (3, False, False), (3, True, False)],
)  # fmt: skip
def test_which_board_types_are_compensated(skin_type: int, mtb3: bool, compensated: bool) -> None:
    value = sample({6: 1000}, skin_type=skin_type, mtb3=mtb3).values[0, 0, 0]
    assert bool(value != 240) is compensated


def test_the_second_set_of_gains() -> None:
    assert sample({6: 128, 0: 58}, skin_type=8, shift=0).values[0, 0, 0] == 240  # 32 * 58 >> 5


def test_the_ergonomic_hand_compensates_from_triangle_5_on() -> None:
    baseline = np.full((16, 12), BASE, np.int64)
    raw: ArrayI = baseline.copy()
    raw[:, 6] += 1000
    values = Arithmetic(3, 240, (2,) * 16, False).sample(raw[np.newaxis], baseline).values[0, :, 0]
    assert (values != 240).tolist() == [False] * 5 + [True] * 11


@pytest.mark.parametrize("mtb3", [False, True])
def test_unplugged_reads_full_pressure_out_of_range_and_not_connected(mtb3: bool) -> None:
    found = sample(dict.fromkeys(range(12), 0xFFFF - BASE), mtb3=mtb3)
    assert found.values[0, 0].tolist() == [0] * 12
    assert found.diagnostics[0, 0] == 0xFFF2
    assert not found.no_ack[0, 0]


def test_unplugged_and_compensated_one_taxel_reads_the_other_way_round_on_an_mtb4() -> None:
    everything_high = dict.fromkeys(range(12), 0xFFFF - BASE)
    # 28671 - ((28671 >> 2) * 164 >> 5) = 28671 - 36730 < 0
    assert sample(everything_high, skin_type=0).values[0, 0].tolist() == [0] * 9 + [255, 0, 0]
    # 16-bit product on the MTB3: no drift above 2047
    assert sample(everything_high, skin_type=0, mtb3=True).values[0, 0].tolist() == [0] * 12


def test_not_acknowledging_is_flagged_only_beside_a_baseline() -> None:
    flagged = sample({4: -BASE})
    assert flagged.diagnostics[0, 0] == 0x0101
    assert flagged.values[0, 0, 4] == 255
    assert flagged.no_ack[0].tolist() == [True] + [False] * 15
    nothing = np.zeros((1, 16, 12), np.int64)
    unflagged = Arithmetic(0, 240, (2,) * 16, False).sample(nothing, nothing[0])
    assert not unflagged.diagnostics.any()
    assert (unflagged.values == 240).all()


def test_not_connected_needs_all_twelve() -> None:
    eleven = dict.fromkeys(range(11), 0xFFFF - BASE)
    assert sample(eleven).diagnostics[0, 0] & 0xF == 0


def test_raw_test_mode_sends_low_bytes() -> None:
    found = sample({0: 0x123, 4: -BASE}, skin_type=7)
    assert found.values[0, 0, :6].tolist() == [0x23, 0, 0, 0, 0, 0]
    assert not found.diagnostics.any()
    assert not found.no_ack.any()
