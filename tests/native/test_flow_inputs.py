"""What waits in sockets and lines is taken by C, and counted once: some of the fuzzer's inputs, always the same."""

from __future__ import annotations

import random

import pytest

from tests.native import flow_fuzzing
from tests.serial.fuzzing import Script
from tests.specification.both_paths import hand_clock


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(4))
def test_what_waits_in_the_kernel_is_taken_and_counted(seed: int) -> None:
    rng = random.Random(seed)
    with hand_clock() as clock:
        published = [flow_fuzzing.run(clock, Script(rng.randbytes(1500))) for _ in range(12)]
    assert sum(published) > 12  # and it is data, too
