"""Some of the fuzzer's inputs, always the same: whoever asks, C or Python, the same comes of them."""

from __future__ import annotations

import random

import pytest

from tests.modbus import fuzzing
from tests.specification.both_paths import hand_clock

pytestmark = pytest.mark.usefixtures("namespace")


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(4))
def test_c_and_python_make_the_same_of_anything(seed: int) -> None:
    rng = random.Random(seed)
    with hand_clock() as clock:
        outcomes = [fuzzing.run(clock, rng.randbytes(800)) for _ in range(10)]
    assert sum(outcome.heard for outcome in outcomes) > 5000
    assert sum(outcome.frames for outcome in outcomes) > 10
    assert sum(outcome.in_c for outcome in outcomes) > 100


def test_a_listener_hears_anything() -> None:
    rng = random.Random(5)
    assert fuzzing.listen(rng.randbytes(20_000)) > 10_000
