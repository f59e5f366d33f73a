"""A field that is taken off in C is the one of its specification in numpy, frame by frame."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from skinware.tactile.vectors import ArrayField
from tests.specification.field import SpecifiedField
from tests.tactile.turning import Turning

SPREAD = 0.1


class Both:
    """A field and its specification, which see the same frames."""

    def __init__(self, patch: npt.NDArray[np.integer]) -> None:
        self.ours, self.specified = ArrayField(patch, SPREAD), SpecifiedField(patch, SPREAD)

    def update(self, values: npt.NDArray[np.float32], usable: npt.NDArray[np.bool_], passed_s: float) -> None:
        rest, sure = self.ours.update(values, usable, passed_s)
        wanted, wanted_sure = self.specified.update(values, usable, passed_s)
        np.testing.assert_allclose(self.ours.now, self.specified.now, 1e-6, 1e-6)
        np.testing.assert_allclose(rest, wanted, 1e-5, 1e-5)
        np.testing.assert_array_equal(sure, wanted_sure)
        np.testing.assert_array_equal(self.ours.bears, self.specified.bears)


def run(world: Turning, both: Both | None = None, begin_s: float = 0.0) -> Both:
    (first, *_), shape = world.taxels(), (world.seeds * len(world.place),)
    both = both or Both(first.patch)
    for row, values in enumerate(world.values):
        passed_s = begin_s if row == 0 else 1 / world.rate_hz
        both.update(np.moveaxis(values, 1, 0).reshape(3, *shape), world.usable[row].reshape(shape), passed_s)
    return both


THOROUGH = pytest.mark.thorough


@pytest.mark.parametrize("kind", ["anyskin", pytest.param("xela", marks=THOROUGH)])
@pytest.mark.parametrize("lost", [0.3, pytest.param(0.0, marks=THOROUGH)])
def test_presses_while_hands_turn(kind: str, lost: float) -> None:
    run(Turning(kind, seeds=1, until_s=26.0, rate_hz=25.0, lost=lost))


@pytest.mark.parametrize("grip", [0.8, *(pytest.param(share, marks=THOROUGH) for share in (0.4, 1.0))])
def test_grips_of_most_taxels(grip: float) -> None:
    run(Turning("xela", seeds=1, until_s=26.0, rate_hz=25.0, grip=grip))


def test_hands_that_are_covered_or_rest_at_first() -> None:
    run(Turning("anyskin", seeds=1, until_s=23.0, rate_hz=25.0, covered=True))
    run(Turning("xela", seeds=1, until_s=23.0, rate_hz=25.0, begin_s=12.0, speed=4.0))


def test_silence_of_a_second_and_of_minutes() -> None:
    world = Turning("anyskin", seeds=1, until_s=8.0, rate_hz=25.0)
    both = run(world)
    for pause_s in (0.9, 1.5, 599.0, 601.0):
        run(world, both, begin_s=pause_s)


def test_taxels_that_never_send_and_patches_that_are_no_array() -> None:
    """Patches of 3, 4 and 9 taxels: the first is no array."""
    patch = np.repeat([0, 1, 2], [3, 4, 9])
    both, random = Both(patch), np.random.default_rng(2)
    usable = np.ones(16, bool)
    usable[[3, 10]] = False
    for number in range(350):
        field = 30 * np.sin(number / 40 + np.arange(3))[:, None]
        values = (field + 5 * (number // 100) * (np.arange(16) == 8) + random.standard_normal((3, 16))).astype("f4")
        both.update(values, usable if number % 50 else np.zeros(16, bool), 0.02)
    assert len(both.ours) == 2


def test_no_time_passes() -> None:
    both, random = Both(np.zeros(6, np.int64)), np.random.default_rng(3)
    for number in range(80):
        values = random.standard_normal((3, 6)).astype("f4")
        both.update(values + np.float32(number % 7), np.ones(6, bool), 0.02 * (number % 3))
