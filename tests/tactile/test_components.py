"""Which touched taxels hang together, against a search from taxel to taxel."""

from __future__ import annotations

import itertools
from collections import deque

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from skinware.tactile.neighbours import NONE, Components, neighbours, neighbours_of_pairs
from tests.tactile.skins import placed, triangles


def by_search(table: npt.NDArray[np.int32], touched: set[int]) -> set[frozenset[int]]:
    """Breadth first, one taxel at a time."""
    found, seen = set(), set[int]()
    for start in touched:
        if start in seen:
            continue
        component, queue = {start}, deque([start])
        while queue:
            for taxel in table[queue.popleft()].tolist():
                if taxel != NONE and taxel in touched and taxel not in component:
                    component.add(taxel)
                    queue.append(taxel)
        seen |= component
        found.add(frozenset(component))
    return found


def as_sets(components: Components, touched: set[int]) -> set[frozenset[int]]:
    rows = np.array(sorted(touched), np.int64)
    label, count = components.of(rows)
    assert sorted(set(label.tolist())) == list(range(count))
    return {frozenset(rows[label == number].tolist()) for number in range(count)}


@st.composite
def graphs(draw: st.DrawFn) -> tuple[int, list[tuple[int, int]]]:
    """Sparse and dense ones, with their taxels numbered in no order."""
    n = draw(st.integers(1, 60))
    number = st.integers(0, n - 1)
    pairs = draw(st.lists(st.tuples(number, number), max_size=3 * n))
    return n, pairs


@pytest.mark.thorough
@given(graphs(), st.data())
def test_as_by_a_breadth_first_search(graph: tuple[int, list[tuple[int, int]]], data: st.DataObject) -> None:
    n, pairs = graph
    table = neighbours_of_pairs(pairs, n)
    components = Components(n, table)
    for touched in data.draw(st.lists(st.sets(st.integers(0, n - 1)), min_size=1, max_size=3)):
        assert as_sets(components, touched) == by_search(table, touched)


@given(st.permutations(range(40)))
@example(list(range(40)))
@example([*range(0, 40, 2), *range(1, 40, 2)])
def test_a_long_chain_numbered_in_any_order_is_one(order: list[int]) -> None:
    components = Components(40, neighbours_of_pairs(list(itertools.pairwise(order)), 40))
    assert as_sets(components, set(range(40))) == {frozenset(range(40))}
    without = set(order) - {order[17]}
    assert as_sets(components, without) == {frozenset(order[:17]), frozenset(order[18:])}


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.7, 1.0])
def test_any_share_of_a_large_skin(share: float) -> None:
    table = neighbours(placed(triangles(30, 40)))
    components = Components(1200, table)
    touched = set(np.flatnonzero(np.random.default_rng(1).random(1200) < share).tolist())
    assert as_sets(components, touched) == by_search(table, touched)


def test_nothing_touched_and_no_taxels() -> None:
    assert Components(3, None).of(np.zeros(0, np.int64))[1] == 0
    assert Components(0, None, np.zeros(0, np.int64)).of(np.zeros(0, np.int64))[1] == 0


def test_without_neighbours_a_module_is_one_blob() -> None:
    module = np.array([7, 7, 7, 2, 2, 9])
    assert as_sets(Components(6, None, module), {0, 2, 3, 5}) == {frozenset({0, 2}), frozenset({3}), frozenset({5})}
    assert as_sets(Components(6, None), {0, 2}) == {frozenset({0}), frozenset({2})}


def test_modules_join_only_taxels_without_neighbours() -> None:
    table = neighbours_of_pairs([(0, 1), (2, 3)], 6)
    components = Components(6, table, np.zeros(6, int))
    assert as_sets(components, set(range(6))) == {frozenset({0, 1}), frozenset({2, 3}), frozenset({4, 5})}
