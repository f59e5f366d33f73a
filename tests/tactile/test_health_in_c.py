"""The evidence of health that C gathers from every frame is that of its specification in numpy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from skinware.tactile.baseline import SHOWN, Calm
from skinware.tactile.health_evidence import Use
from tests.specification.health import SpecifiedUse

N, LIMITS = 24, (0.0, 60.0)
COMPARED = ("far", "jump", "was_still", "at_end", "moved", "still", "was_free")
TAKEN = ("value", "peak", "usual", "changed_s", "seen", "touched", "total", "above", "begun", "hard", "plain")


def calm_of(random: np.random.Generator, given: npt.NDArray[np.float32]) -> Calm:
    """Return a frame as a baseline at 20 might calm it; NaN before it is known."""
    calm = Calm.of(np.zeros(SHOWN * N, np.uint8))
    calm.baseline[:] = np.where(random.random(N) < 0.05, np.nan, 20 + random.random(N))
    calm.noise[:] = np.where(np.isnan(calm.baseline), np.nan, 0.5 + random.random(N))
    calm.usable[:], calm.touched[:] = random.random(N) < 0.9, (given > 25) & (random.random(N) < 0.9)
    calm.value[:] = np.where(calm.touched, np.nan_to_num(given - calm.baseline), 0)
    return calm


@pytest.mark.parametrize("seed", range(3))
def test_evidence_is_that_of_the_specification(seed: int) -> None:
    random, module = np.random.default_rng(seed), np.arange(N, dtype=np.intp) // 6
    ours, specified = Use(module, 3, LIMITS), SpecifiedUse(N, LIMITS)
    found = set()
    for number in range(400):
        pressed = 40 * (random.random(N) < 0.1) * (number % 50 > 25)
        given = np.clip(20 + random.standard_normal(N) + pressed, *LIMITS).astype(np.float32)
        given[random.random(N) < 0.02] = np.nan
        calm, clear = calm_of(random, given), 4.0 + number % 3
        ours.arrays["misled"][:] = specified.misled[:] = random.random(N) < 0.1
        has_moved = ours.compare(given, calm, clear)
        specified.compare(given, calm, clear)
        assert has_moved == specified.moved.any()
        for name in COMPARED:
            np.testing.assert_array_equal(ours.arrays[name], getattr(specified, name), name)
        np.testing.assert_array_equal(ours.arrays["sums"].reshape(3, N), specified.sums)
        is_hard, is_plain = ours.take(number / 100, 0.01, clear)
        specified.take(given, calm, number / 100, 0.01, clear)
        assert (is_hard, is_plain) == (bool(specified.hard.any()), bool(specified.plain.any()))
        for name in TAKEN:
            np.testing.assert_array_equal(ours.arrays[name], getattr(specified, name), name)
        if number % 40 == 0:
            ours.arrays["total"][:] = specified.total[:] = 0
        found |= {(has_moved, is_hard, is_plain)}
    assert len(found) > 2
