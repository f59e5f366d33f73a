"""What the fuzzer has found worth keeping, over again."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.serial.framings import EXAMPLES
from tests.serial.fuzzing import examples_of_drivers, run

SEEDS = Path(__file__).parent / "seeds"


@pytest.mark.parametrize("name", EXAMPLES)
def test_seeds(name: str) -> None:
    lines = (SEEDS / f"{name}.hex").read_text().split()
    assert lines
    for line in lines:
        run(EXAMPLES[name], bytes.fromhex(line))


def test_framings_of_installed_drivers() -> None:
    inputs = [bytes(range(at, at + 200)) for at in range(0, 56, 7)]
    for example in examples_of_drivers().values():
        for data in inputs:
            run(example, data)
