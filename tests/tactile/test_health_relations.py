"""Signals that belong to others, or come and go: each is found with its kind, and nothing else is."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from skinware.tactile.baseline import Baseline
from skinware.tactile.health import Health, HealthKind, HealthReport
from skinware.tactile.testing import grid
from tests.tactile.skins import placed

pytestmark = pytest.mark.thorough

SIDE, PLATES, PASSES = 8, 7, 8
TAXELS = SIDE * SIDE
SURFACE = grid(PLATES, SIDE, SIDE, patches=PLATES)
MODULE = np.arange(PLATES * TAXELS) // 16  # two rows
FRAMES, PRESSED, PAUSE, PERIOD_NS = 25, 8, 450, 50_000_000
HEALTHY, SWAPPED, TWINS, SHORTED, CROSSTALK, INTERMITTENT, DYING = range(PLATES)
REST, FORCE = 20.0, 120.0


def at(plate: int, row: int, column: int) -> int:
    return plate * TAXELS + row * SIDE + column


def presses() -> npt.NDArray[np.float64]:
    """(TAXELS, TAXELS) what a tip shows at each place, on each taxel."""
    row, column = np.divmod(np.arange(TAXELS), SIDE)
    squares = (row[:, None] - row) ** 2 + (column[:, None] - column) ** 2
    shapes: npt.NDArray[np.float64] = FORCE * np.exp(-squares / (2 * 1.2**2)) * (squares < 9)
    return shapes


def spoil(values: npt.NDArray[np.float64], share: float, random: np.random.Generator) -> None:
    """Plant the faults of all plates in a frame; ``share`` of the time has passed."""
    one, two = at(SWAPPED, 2, 2), at(SWAPPED, 5, 5)
    values[[one, two]] = values[[two, one]]
    for one, two in ((at(TWINS, 3, 3), at(TWINS, 3, 4)), (at(SHORTED, 4, 1), at(SHORTED, 4, 6))):
        values[[one, two]] = values[[one, two]].mean()
    values[at(CROSSTALK, 4, 1)] += 0.4 * (values[at(CROSSTALK, 4, 6)] - REST)
    if random.random() < 0.05:
        values[at(INTERMITTENT, 4, 4)] = 0
    values[at(DYING, 4, 4)] = REST + (values[at(DYING, 4, 4)] - REST) * (1 if share < 0.45 else 0.15)


@pytest.fixture(scope="module")
def report() -> HealthReport:
    random, shapes = np.random.default_rng(1), presses()
    gain = random.uniform(0.85, 1.15, PLATES * TAXELS)
    baseline = Baseline(MODULE, SURFACE.patch)
    health = Health(MODULE, placed(SURFACE.position_m, normal=SURFACE.normal), limits=(0, 255))
    baseline.update(0, np.full(PLATES * TAXELS, REST))
    baseline.tare()
    a_pass = TAXELS * FRAMES + PAUSE
    total = PASSES * a_pass
    for number in range(1, total):
        press, frame = divmod(number % a_pass, FRAMES)
        strength = np.sin(np.pi * frame / PRESSED) if frame < PRESSED and press < TAXELS else 0.0
        # a pass presses every place, in an order in which no press is beside the one before
        place = (press * 27) % TAXELS
        values = REST + gain * np.tile(strength * shapes[place], PLATES) + random.normal(0, 0.6, PLATES * TAXELS)
        spoil(values, number / total, random)
        values = np.clip(np.round(values), 0, 255)
        health.update(number * PERIOD_NS, values, baseline.update(number * PERIOD_NS, values))
    return health.report()


def test_each_fault_has_its_kind_and_its_other_taxel(report: HealthReport) -> None:
    planted = {
        at(SWAPPED, 2, 2): (HealthKind.SWAPPED, at(SWAPPED, 5, 5)),
        at(SWAPPED, 5, 5): (HealthKind.SWAPPED, at(SWAPPED, 2, 2)),
        at(TWINS, 3, 3): (HealthKind.SHORTED, at(TWINS, 3, 4)),
        at(TWINS, 3, 4): (HealthKind.SHORTED, at(TWINS, 3, 3)),
        at(SHORTED, 4, 1): (HealthKind.SHORTED, at(SHORTED, 4, 6)),
        at(SHORTED, 4, 6): (HealthKind.SHORTED, at(SHORTED, 4, 1)),
        at(CROSSTALK, 4, 1): (HealthKind.CROSSTALK, at(CROSSTALK, 4, 6)),
        at(INTERMITTENT, 4, 4): (HealthKind.INTERMITTENT, -1),
        at(DYING, 4, 4): (HealthKind.DYING, -1),
    }
    faulty = np.flatnonzero(report.faulty).tolist()
    found = {taxel: (HealthKind(report.kind[taxel]), int(report.other[taxel])) for taxel in faulty}
    assert found == planted


def test_the_evidence_names_the_other_taxel(report: HealthReport) -> None:
    assert report.evidence(at(SWAPPED, 2, 2)) == f"shows what presses taxel {at(SWAPPED, 5, 5)}"
    assert report.other_shown[at(CROSSTALK, 4, 1)] == pytest.approx(0.4, abs=0.05)
    assert report.evidence(at(SHORTED, 4, 1)).endswith(f"% of what presses taxel {at(SHORTED, 4, 6)}")
    assert report.evidence(at(INTERMITTENT, 4, 4), "counts").startswith("lost its value about ")
    assert "; it showed " in report.evidence(at(DYING, 4, 4))
