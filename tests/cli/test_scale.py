from __future__ import annotations

import numpy as np
import pytest

from skinware.cli._picture import ChangeScale, ValueScale
from skinware.views.quantities import rounded_up

NOISE = 3.0
FRESH = np.ones(5, bool)
S = 10**9


def levels(scale: ChangeScale, change: list[float], time_ns: int = S) -> list[int]:
    return scale.draw(np.array(change, np.float32), FRESH, NOISE, time_ns, None).levels.tolist()  # type: ignore[no-any-return]


def test_a_light_press_is_seen_beside_a_hard_one() -> None:
    """At rest 12 to 17 of 255, pressed up to 136: the figures of a real fingertip."""
    rest, noisy, light, firm, hard = levels(ChangeScale(), [0, 3, 10, 50, 122])
    assert rest == noisy == 0
    assert light >= 2
    assert firm >= light + 4
    assert hard >= 11


def test_rest_alone_is_dark() -> None:
    assert levels(ChangeScale(), [0, 1, 2, 3, 3]) == [0] * 5


def test_the_scale_says_what_it_means() -> None:
    scale = ChangeScale()
    assert scale.draw(np.full(5, 122, np.float32), FRESH, NOISE, S, None).values == (0, 37.5, 150)
    assert scale.draw(np.zeros(5, np.float32), FRESH, NOISE, 2 * S, None).values == (0, 37.5, 150)
    assert scale.draw(np.zeros(5, np.float32), FRESH, NOISE, 200 * S, None).values == (0, 7.5, 30)  # forgotten


def test_what_is_not_fresh_does_not_count() -> None:
    fresh = np.array([True, True, True, True, False])
    drawn = ChangeScale().draw(np.array([0, 1, 2, 3, 9999], np.float32), fresh, NOISE, S, None)
    assert drawn.values[-1] == 30
    drawn = ValueScale().draw(np.array([0, 1, 2, 3, 9999], np.float32), fresh, (-np.inf, np.inf), None)
    assert drawn.values == (0, 3)


def test_values_between_known_limits() -> None:
    drawn = ValueScale().draw(np.array([0, 64, 128, 192, 255], np.float32), FRESH, (0, 255), None)
    assert (drawn.levels.tolist(), drawn.values) == ([0, 4, 8, 12, 15], (0, 255))


def test_values_between_what_was_seen() -> None:
    scale = ValueScale()
    nothing = scale.draw(np.full(5, np.nan, np.float32), FRESH, (-np.inf, np.inf), None)
    assert nothing.values == (0, 1)
    assert scale.draw(np.full(5, 7, np.float32), FRESH, (0, np.inf), None).values == (7, 7)
    assert scale.draw(np.full(5, 3, np.float32), FRESH, (0, np.inf), None).values == (3, 7)


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
