"""Histograms of patches: every update counted once, in the bucket that the plain way gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware import DriverReader
from skinware.memory.statistics import BUCKETS, Histogram
from skinware_drivers.running.publisher import PatchTiming
from tests.cli.fake_skin import fake_structure
from tests.sdk.driving import driving, emulated, read_until
from tests.specification.publishing import count_timing

times = st.integers(-10, 2**40) | st.sampled_from([0, 1, 2, 2**20 - 1, 2**20, 2**30, 2**31 - 1, 2**31, 2**50])


@pytest.mark.thorough
@given(st.lists(st.tuples(st.lists(st.booleans(), min_size=6, max_size=6), times, times), max_size=30))
def test_as_many_and_where_the_plain_way_puts_them(frames: list[tuple[list[bool], int, int]]) -> None:
    structure = fake_structure(2, 3)
    timing, group_patch = PatchTiming(structure), structure.group_patch.astype(np.intp)
    ages = [Histogram() for _ in range(2)]
    intervals = [Histogram() for _ in range(2)]
    shown_ns, before_ns = np.full(6, 10**15, np.int64), np.zeros(6, np.int64)
    for updated, step_ns, age_ns in frames:
        flags = np.array(updated)
        shown_ns[flags] += step_ns
        time_ns = int(shown_ns.max()) + age_ns
        count_timing(timing, group_patch, flags, shown_ns.copy(), time_ns)
        for module in np.flatnonzero(flags).tolist():
            ages[module // 3].add(time_ns - int(shown_ns[module]))
            if before_ns[module]:
                intervals[module // 3].add(int(shown_ns[module] - before_ns[module]))
        before_ns[flags] = shown_ns[flags]
    assert timing.ages.tolist() == [h.counts for h in ages]
    assert timing.intervals.tolist() == [h.counts for h in intervals]


def test_users_see_how_regular_each_patch_of_a_running_driver_is() -> None:
    slow, fast = emulated(boards=(7,)), emulated(boards=(7,))
    with driving(slow, fast) as running, DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: bool((f.patch_interval_counts.sum(axis=1) > 16 * 20).all()))
        shown = [patch["interval"]["p50_ns"] for patch in running.status()["patches"]]
        updates = [counters["updates"] for counters in reader.patch_counters(frame)]
    assert frame.patch_age_counts.shape == (2, BUCKETS)
    for patch in range(2):
        counted = int(frame.patch_age_counts[patch].sum())
        assert counted <= updates[patch]
        assert counted == int(frame.patch_interval_counts[patch].sum()) + 16  # the first of each of its modules
        median_ns = Histogram(frame.patch_interval_counts[patch].tolist()).quantile_ns(0.5)
        assert median_ns is not None
        assert 40_000_000 < median_ns < 140_000_000  # boards send every 50 ms: so do the stamps say, whoever is slow
        assert shown[patch] == median_ns
