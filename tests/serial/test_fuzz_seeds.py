"""What the fuzzer has found worth keeping, over again: as it is, and changed at random, always in the same way.

``tools/fuzz`` goes further, guided by coverage and in another way each time.
"""

from __future__ import annotations

import random
import tomllib
from pathlib import Path

import pytest

from tests.serial.framings import EXAMPLES, ONLY_IN_PYTHON
from tests.serial.fuzzing import changed, examples_of_drivers, known_examples, run

SEEDS = Path(__file__).parent / "seeds"
NAMES = sorted(path.stem for path in SEEDS.iterdir())
N_CHANGED = 30
LONGEST = 600


def seeds_of(name: str) -> list[bytes]:
    return [bytes.fromhex(line) for line in (SEEDS / f"{name}.hex").read_text().split()]


@pytest.mark.thorough
def test_every_framing_has_seeds() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    ours = {f"driver_{name}" for name in project["project"]["entry-points"]["skinware.drivers"]}
    assert {*EXAMPLES, *ONLY_IN_PYTHON} | ours & set(examples_of_drivers()) == set(NAMES)


@pytest.mark.thorough
def test_seeds_and_what_comes_of_them() -> None:
    known = known_examples()
    for name in NAMES:
        inputs, rng = seeds_of(name), random.Random(1)
        for data in [*inputs, *(changed(inputs, rng, LONGEST) for _ in range(N_CHANGED))]:
            try:
                run(known[name], data)
            except BaseException as error:
                error.add_note(f"{name}: {data.hex()}")
                raise
