"""What the fuzzer has found worth keeping, over again."""

from __future__ import annotations

from pathlib import Path

from tests.serial.framings import EXAMPLES
from tests.serial.fuzzing import examples_of_drivers, run

SEEDS = Path(__file__).parent / "seeds"


def test_seeds() -> None:
    assert {path.stem for path in SEEDS.iterdir()} == set(EXAMPLES)
    for name, example in EXAMPLES.items():
        for line in (SEEDS / f"{name}.hex").read_text().split():
            run(example, bytes.fromhex(line))


def test_framings_of_installed_drivers() -> None:
    inputs = [bytes(range(at, at + 200)) for at in range(0, 56, 7)]
    for example in examples_of_drivers().values():
        for data in inputs:
            run(example, data)
