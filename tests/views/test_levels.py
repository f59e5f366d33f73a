"""Levels are the values between two limits, in even steps, whatever the values are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from skinware import Status
from skinware.views.quantities import HIGHEST, NO_VALUE, WITHOUT_VALUE, levels_of, shear_of

VALUES = arrays.arrays(np.float32, 20, elements=st.floats(width=32))
LIMITS = st.tuples(st.floats(-1e30, 1e30), st.floats(-1e30, 1e30))
STATUS = arrays.arrays(np.uint8, 20)


@pytest.mark.thorough
@given(VALUES, STATUS, LIMITS)
def test_any_values(
    values: npt.NDArray[np.float32], status: npt.NDArray[np.uint8], limits: tuple[float, float]
) -> None:
    low, high = limits
    before = values.copy()
    with np.errstate(over="ignore", invalid="ignore"):  # as numpy has it, but for what is infinite
        levels = levels_of(values, status, low, high)
    assert np.array_equal(values, before, equal_nan=True)
    nothing = ~np.isfinite(values) | ((status & int(WITHOUT_VALUE)) != 0)
    assert (levels[nothing] == NO_VALUE).all()
    shown = levels[~nothing]
    assert ((shown <= HIGHEST) | (shown == NO_VALUE)).all()
    order = np.argsort(values[~nothing], kind="stable")
    assert (np.diff(shown[order].astype(int)) >= 0).all()


def test_steps_are_even() -> None:
    values = np.linspace(-10, 10, 251, dtype=np.float32)
    assert levels_of(values, np.zeros(251, np.uint8), -10, 10).tolist() == list(range(251))
    assert levels_of(values, np.zeros(251, np.uint8), -5, 5)[[0, 62, 125, 188, 250]].tolist() == [0, 0, 125, 250, 250]


def test_large_numbers_keep_their_differences() -> None:
    values = 2.0**31 + np.arange(5.0)
    assert levels_of(values, np.zeros(5, np.uint8), 2.0**31, 2.0**31 + 5).tolist() == [0, 50, 100, 150, 200]


def test_only_some_statuses_take_the_value_away() -> None:
    status = np.array([0, *Status], np.uint8)
    levels = levels_of(np.ones(len(status), np.float32), status, 0, 2)
    assert [int(s) for s, level in zip(status, levels, strict=True) if level == NO_VALUE] == [1, 8, 16, 32]


@given(arrays.arrays(np.float32, (7, 2), elements=st.floats(width=32)), st.floats(0, 1e30))
def test_any_shear(vectors: npt.NDArray[np.float32], longest: float) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        shear = shear_of(vectors, longest)
    assert (shear >= -127).all()
    known = np.isfinite(vectors) & (np.abs(vectors) < 1e30)
    assert (np.sign(shear[known]) * np.sign(vectors[known]) >= 0).all()
