"""What never moved is found, however plausible its value."""

from __future__ import annotations

import numpy as np

from skinware.views.history import WipeTest
from tests.cli.fake_skin import fake_structure

STRUCTURE = fake_structure(1, 2)
N = STRUCTURE.n_sensors
FRESH = np.ones(N, bool)
STUCK, MISSING = 3, 12
NOISE = 2.0


def wiped() -> WipeTest:
    test = WipeTest(STRUCTURE)
    for touch in (0, 60, 1):
        values = np.full(N, 14 + touch, np.float32)
        values[STUCK] = 73 + touch / 60  # plausible, and a little alive
        fresh = FRESH.copy()
        fresh[MISSING] = False
        test.follow(values, fresh)
    return test


def test_what_never_moved_is_found() -> None:
    test = wiped()
    assert test.never_moved("pressure", NOISE).tolist() == [STUCK, MISSING]
    assert test.travel()[[0, STUCK, MISSING]].tolist() == [60, 1, 0]
    assert WipeTest(STRUCTURE).never_moved("pressure", NOISE).tolist() == [*range(10), *range(12, 22)]


def test_a_value_that_is_no_number_takes_nothing_away() -> None:
    test = wiped()
    test.follow(np.full(N, np.nan, np.float32), FRESH)
    assert test.never_moved("pressure", NOISE).tolist() == [STUCK, MISSING]
