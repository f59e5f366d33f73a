"""Two fingers that cross, bounce off each other or meet keep their identities."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.tactile.passing import FingerPass, Way, told

SPEEDS_M_S, SIGMAS_M = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0), (0.002, 0.004, 0.006, 0.008)
WAYS: tuple[Way, ...] = ("cross", "bounce", "meet")
MOST_SWAPPED, MOST_NEW = 0.02, 0.05


def passes(way: Way, speeds_m_s: tuple[float, ...], sigmas_m: tuple[float, ...]) -> list[FingerPass]:
    """In each lane; two alike that bounce in one lane look like two that cross."""
    lanes = range(1 if way == "bounce" else 0, 6)
    return [FingerPass(way, speed, lane, sigma, seed=0) for speed in speeds_m_s for lane in lanes for sigma in sigmas_m]


def test_fingers_that_cross_keep_their_identities() -> None:
    found = [told(one) for one in passes("cross", (0.2, 1.0), (0.004, 0.006))]
    outcomes = Counter(one.outcome for one in found)
    assert outcomes["swapped"] <= MOST_SWAPPED * len(found)
    assert outcomes["new"] <= MOST_NEW * len(found)


@pytest.mark.thorough
def test_identities_are_kept_at_all_speeds_and_widths() -> None:
    """Of all ways together; the page has the table."""
    found = [told(one) for way in WAYS for one in passes(way, SPEEDS_M_S, SIGMAS_M)]
    outcomes = Counter(one.outcome for one in found)
    assert outcomes["swapped"] <= MOST_SWAPPED * len(found)
    assert outcomes["new"] <= MOST_NEW * len(found)


@pytest.mark.parametrize(("rate_hz", "lane"), [(50.0, 0), (50.0, 1), (50.0, 2), (100.0, 0), (100.0, 1)])
def test_fingers_that_rest_beside_each_other_keep_both_identities(rate_hz: float, lane: int) -> None:
    """They brake, so that they are expected beyond each other, and set off within a sample."""
    found = [told(FingerPass("meet", 1.0, lane, 0.004, seed, rate_hz)) for seed in range(3)]
    assert [(one.outcome, one.identities) for one in found] == 3 * [("kept", 2)]


@pytest.mark.parametrize("sigma_m", [0.004, 0.008])
def test_a_finger_at_2_m_s_is_one_contact(sigma_m: float) -> None:
    assert told(FingerPass("cross", 2.0, 5, sigma_m, seed=1)).identities == 2
