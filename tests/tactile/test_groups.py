"""Medians by group, against numpy's, group by group."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tests.specification.baseline.offsets import Grouping


@pytest.mark.thorough
@given(st.data())
def test_each_groups_median_is_that_of_its_members_that_count(data: st.DataObject) -> None:
    group = data.draw(hnp.arrays(np.intp, st.integers(1, 60), elements=st.integers(0, 12)))
    values = data.draw(hnp.arrays(np.float32, len(group), elements=st.floats(-1000, 1000, width=32)))
    counts = data.draw(hnp.arrays(np.bool_, len(group)))
    groups = Grouping(group)
    medians, sums = groups.median(values, counts), groups.sum(values * counts)
    assert len(medians) == len(sums) == groups.n == group.max() + 1
    for number in range(groups.n):
        members = values[(group == number) & counts]
        assert np.isclose(sums[number], members.sum(dtype=np.float64), rtol=1e-4, atol=1e-2)
        assert np.isclose(medians[number], np.median(members) if len(members) else 0, rtol=1e-5, atol=1e-3)


def test_values_that_do_not_count_may_be_anything() -> None:
    values = np.array([np.nan, 1, np.inf, 2, -np.inf], np.float32)
    assert Grouping(np.zeros(5, np.intp)).median(values, np.isfinite(values)).tolist() == [1.5]


def test_no_values_have_no_groups() -> None:
    groups = Grouping(np.zeros(0, np.intp))
    assert len(groups.median(np.zeros(0, np.float32), np.zeros(0, bool))) == len(groups.sum(np.zeros(0))) == 0
