from __future__ import annotations

import numpy as np
import pytest

from skinware.cli._heat_map import levels_of
from skinware.cli._picture import change_levels
from skinware.views.history import Memory, rounded_up
from tests.cli.fake_skin import fake_structure

NOISE = 3.0
S = 10**9
UNKNOWN = (-np.inf, np.inf)
KEY = "pressure", "change"


def memory() -> Memory:
    return Memory(fake_structure(1, 1))


def levels(change: list[float]) -> list[int]:
    """Levels of changes that were never greater before."""
    array = np.array(change, np.float32)
    return change_levels(array, NOISE, memory().span(KEY, array, NOISE, S))[0].tolist()  # type: ignore[no-any-return]


def test_a_light_press_is_seen_beside_a_hard_one() -> None:
    """At rest 12 to 17 of 255, pressed up to 136: the figures of a real fingertip."""
    rest, noisy, light, firm, hard = levels([0, 3, 10, 50, 122])
    assert rest == noisy == 0
    assert light >= 2
    assert firm >= light + 4
    assert hard >= 11


def test_rest_alone_is_dark() -> None:
    assert levels([0, 1, 2, 3, 3]) == [0] * 5


def test_the_scale_follows_changes_and_forgets_them() -> None:
    seen, nothing = memory(), np.zeros(5, np.float32)
    assert seen.span(KEY, np.full(5, 122, np.float32), NOISE, S) == 150
    assert seen.span(KEY, nothing, NOISE, 2 * S) == 150
    assert seen.span(KEY, nothing, NOISE, 200 * S) == 30
    assert change_levels(nothing, NOISE, 150)[1] == (0, 37.5, 150)


def test_values_between_known_limits() -> None:
    values = np.array([0, 64, 128, 192, 255], np.float32)
    limits = memory().limits(KEY, values, (0, 255))
    assert limits == (0, 255)
    assert levels_of(values, *limits).tolist() == [0, 4, 8, 12, 15]


def test_values_between_what_was_seen() -> None:
    seen = memory()
    assert seen.limits(KEY, np.full(5, np.nan, np.float32), UNKNOWN) == (0, 1)
    assert seen.limits(KEY, np.full(5, 7, np.float32), (0, np.inf)) == (7, 7)
    assert seen.limits(KEY, np.full(5, 3, np.float32), (0, np.inf)) == (3, 7)


@pytest.mark.parametrize(
    ("value", "rounded"),
    [
        (122, 150),
        (200, 200),
        (201, 300),
        (0.031, 0.04),
        (1, 1),
        (9.99, 10),
        (0, 1),
        (float("inf"), 1),
        (float("nan"), 1),
    ],
)
def test_rounded_up(value: float, rounded: float) -> None:
    assert rounded_up(value) == pytest.approx(rounded)
