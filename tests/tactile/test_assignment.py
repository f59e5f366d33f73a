"""Who goes with whom, against trying all possibilities."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from skinware.tactile.arrays import Doubles
from skinware.tactile.tracks import assign

gains = hnp.arrays(
    np.float64,
    hnp.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=5),
    elements=st.one_of(st.just(0.0), st.integers(-2, 5).map(float), st.floats(0.125, 10, width=16)),
)


def most(gain: Doubles) -> float:
    """The largest sum, by trying all."""
    gain = np.maximum(gain, 0)
    if gain.shape[0] > gain.shape[1]:
        gain = gain.T
    orders = itertools.permutations(range(gain.shape[1]), gain.shape[0])
    return max((sum(gain[row, column] for row, column in enumerate(order)) for order in orders), default=0.0)


@given(gains)
def test_the_sum_is_the_largest_there_is(gain: Doubles) -> None:
    row, column = assign(gain)
    assert len(set(row.tolist())) == len(row) == len(column) == len(set(column.tolist()))
    assert (np.diff(row) > 0).all()
    assert (gain[row, column] > 0).all()
    assert np.isclose(gain[row, column].sum(), most(gain))


def test_a_large_one_ends_and_no_exchange_of_two_gains_more() -> None:
    gain = np.random.default_rng(1).random((64, 128))
    row, column = assign(gain)
    assert len(row) == 64
    now = gain[row, column]
    exchanged = gain[row[:, None], column[None, :]]
    assert (exchanged + exchanged.T <= now[:, None] + now[None, :] + 1e-9).all()


def test_rows_and_columns_may_be_exchanged() -> None:
    gain = np.random.default_rng(2).random((9, 6))
    row, column = assign(gain)
    columns, rows = assign(gain.T)
    assert sorted(zip(row.tolist(), column.tolist(), strict=True)) == sorted(
        zip(rows.tolist(), columns.tolist(), strict=True)
    )
