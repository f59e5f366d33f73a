"""Medians by group, against numpy's, group by group."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from skinware.tactile.drift import GroupMedian


@pytest.mark.thorough
@given(st.data())
def test_each_groups_median_is_that_of_its_members_that_count(data: st.DataObject) -> None:
    group = data.draw(hnp.arrays(np.intp, st.integers(1, 60), elements=st.integers(0, 12)))
    values = data.draw(hnp.arrays(np.float32, len(group), elements=st.floats(-1000, 1000, width=32)))
    counts = data.draw(hnp.arrays(np.bool_, len(group)))
    medians, found = GroupMedian(group)(values, counts)
    assert len(medians) == len(found) == group.max() + 1
    for number in range(len(medians)):
        members = values[(group == number) & counts]
        assert found[number] == len(members)
        if len(members):
            assert np.isclose(medians[number], np.median(members), rtol=1e-5, atol=1e-3)
        else:
            assert np.isnan(medians[number])


def test_values_that_do_not_count_may_be_anything() -> None:
    values = np.array([np.nan, 1, np.inf, 2, -np.inf], np.float32)
    medians, _ = GroupMedian(np.zeros(5, np.intp))(values, np.isfinite(values))
    assert medians.tolist() == [1.5]


def test_of_no_values_there_are_no_groups() -> None:
    medians, found = GroupMedian(np.zeros(0, np.intp))(np.zeros(0, np.float32), np.zeros(0, bool))
    assert len(medians) == len(found) == 0
