"""Two devices with one identifier are reported once they have sent too much for a while."""

from __future__ import annotations

import numpy as np

from skinware.realtime import NS_PER_S
from skinware_drivers.running.news import Doubles
from tests.cli.fake_skin import fake_structure


class Patches:
    """Two patches of three modules each at 10 Hz, and what each sends."""

    def __init__(self) -> None:
        self.time_ns = 0
        self.updates = np.zeros(2, np.int64)
        self.doubles = Doubles(fake_structure(2, 3), NS_PER_S // 10, lambda: self.time_ns)

    def send(self, seconds: int, *ratios: float) -> list[tuple[int, float]]:
        reported = []
        for _ in range(10 * seconds):
            self.time_ns += NS_PER_S // 10
            self.updates += np.round(3 * np.array(ratios)).astype(np.int64)
            reported += [(patch, round(ratio, 3)) for patch, ratio in self.doubles.look(self.updates)]
        return reported


def test_a_patch_that_sends_twice_as_much_is_reported_once() -> None:
    patches = Patches()
    assert patches.send(5, 1, 2) == []
    assert patches.send(3, 1, 2) == [(1, 2.0)]
    assert patches.send(60, 1, 2) == []
    assert patches.send(60, 2, 2) == [(0, 2.0)]


def test_a_patch_that_catches_up_or_is_a_little_fast_is_not() -> None:
    patches = Patches()
    for _ in range(10):
        assert patches.send(5, 0, 4 / 3) == []
        assert patches.send(5, 2, 4 / 3) == []
