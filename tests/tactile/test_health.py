"""Which taxels are broken: planted faults are found with their kind, and nothing else is, in 20 worlds."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from skinware.errors import ConfigurationError
from skinware.tactile.baseline import Baseline
from skinware.tactile.health import Health, HealthKind, HealthReport, HealthSettings
from skinware.tactile.testing import Response, World, grid
from tests.tactile.bench import BENCH_S
from tests.tactile.judging import Worlds
from tests.tactile.skins import placed
from tests.tactile.test_calm_contacts import placed_structure

PLATES, SIDE = 20, 8
"""Plates of 8 x 8 taxels, each a world with its own faults."""
TAXELS = SIDE * SIDE
SURFACE = grid(PLATES, SIDE, SIDE, patches=PLATES)
MODULE = np.arange(PLATES * TAXELS) // 16
INSIDE = [row * SIDE + column for row in range(1, SIDE - 1) for column in range(1, SIDE - 1)]
CORNERS = [0, SIDE - 1, TAXELS - SIDE, TAXELS - 1]
STROKES, PAUSE_S, END_S = 60, 60.0, 250.0
QUICK = HealthSettings(stuck_s=90.0)


def plates(seed: int, **how: object) -> World:
    """Somebody strokes all plates for some minutes, wherever it pleases him."""
    settings: dict[str, object] = {"noise": 0.8, "drift_per_min": 1.0, "gain_spread": 0.2}
    response = Response(width_m=0.004, sag=0.2, remainder=0.2)
    world = World(SURFACE, seed=seed, rate_hz=20, response=response, **settings | how)  # type: ignore[arg-type]
    np.clip(world.gain, 0.6, 1.6, out=world.gain)  # beyond, a taxel would be called weak
    random = np.random.default_rng(seed)
    corner = SURFACE.position_m.reshape(PLATES, TAXELS, 3)
    for stroke in range(STROKES):
        for plate in range(PLATES):
            low, high = corner[plate].min(axis=0), corner[plate].max(axis=0)
            ends = random.uniform(low, high, (2, 3))
            begin_s = 7 + 3.0 * stroke + random.uniform(0, 0.5) + PAUSE_S * (stroke >= STROKES / 2)
            world.stroke(ends, random.uniform(30, 60), begin_s, begin_s + 2, radius_m=0.006)
    return world


def judged(world: World, settings: HealthSettings | None = None, until_s: float = END_S) -> HealthReport:
    """What is known at the end."""
    baseline = Baseline(MODULE, SURFACE.patch)
    geometry = placed(SURFACE.position_m, normal=SURFACE.normal)
    health = Health(MODULE, geometry, settings, limits=(world.minimum, world.maximum))
    for sample in world.samples(until_s):
        values = sample.values.astype(np.float32)
        health.update(sample.time_ns, values, baseline.update(sample.time_ns, values, sample.usable))
    return health.report()


def names(kind: npt.NDArray[np.uint8]) -> list[str]:
    return [HealthKind(one).name.lower() for one in kind.tolist()]


def told(report: HealthReport, taxels: npt.NDArray[np.int64]) -> list[str]:
    return [f"{taxel}: {HealthKind(report.kind[taxel]).name}: {report.evidence(taxel)}" for taxel in taxels.tolist()]


def chosen(seed: int) -> npt.NDArray[np.int64]:
    """(plates, 5) taxels of each plate that have neighbours on all sides, and none of them beside another."""
    random = np.random.default_rng([seed, 1])
    found = []
    for plate in range(PLATES):
        taxels: list[int] = []
        while len(taxels) < 5:
            new = int(random.choice(INSIDE))
            away = [max(abs(new // SIDE - old // SIDE), abs(new % SIDE - old % SIDE)) for old in taxels]
            taxels += [new] if min(away, default=SIDE) > 1 else []
        found.append(plate * TAXELS + np.array(taxels))
    return np.array(found)


@pytest.fixture(scope="module")
def faulty() -> tuple[npt.NDArray[np.int64], HealthReport]:
    world = plates(1)
    taxels = chosen(1)
    dead, weak, noisy, stuck, clipped = taxels.T
    world.dead(dead)
    world.gain[weak] = 0.16
    world.noisy(noisy, 6)
    for plate, taxel in enumerate(stuck.tolist()):
        world.stuck([taxel], 10 + 10 * plate)
    world.jump(clipped[::2], 300, at_s=-1)
    world.jump(clipped[1::2], -60, at_s=-1)
    return taxels, judged(world, QUICK)


@pytest.mark.thorough
def test_every_fault_is_found_with_its_kind_and_nothing_else(
    faulty: tuple[npt.NDArray[np.int64], HealthReport],
) -> None:
    taxels, report = faulty
    for column, kind in enumerate(("dead", "weak", "noisy", "stuck", "clipped")):
        found = names(report.kind[taxels[:, column]])
        assert found == [kind] * PLATES, told(report, taxels[:, column])
    others = np.setdiff1d(np.arange(len(report.kind)), taxels)
    assert not report.faulty[others].any(), told(report, others[report.faulty[others]])


@pytest.mark.thorough
def test_the_evidence_says_why(faulty: tuple[npt.NDArray[np.int64], HealthReport]) -> None:
    taxels, report = faulty
    dead, weak, noisy, stuck, clipped = taxels[3].tolist()
    assert report.evidence(stuck, "counts").startswith("at 40 counts for ")
    assert report.still_s[stuck] > QUICK.stuck_s
    assert "times that of the others" in report.evidence(noisy, "counts")
    assert report.noise_times[noisy] == pytest.approx(6, rel=0.3)
    share = 100 * report.clipped[clipped]
    assert report.evidence(clipped) == f"at 0, an end of the range, for {share:.0f} % of the time"
    assert share > 98
    assert report.evidence(dead).endswith(f"of what presses both its sides, in {report.touches[dead]} touches")
    assert report.shown[dead] < 0.1
    assert "; its neighbours show " in report.evidence(weak)
    assert report.touches[[dead, weak]].min() >= 3
    assert report.evidence(np.flatnonzero(~report.faulty)[0]) == ""


@pytest.mark.thorough
def test_healthy_skins_have_no_faults_in_25_minutes() -> None:
    """20 bench worlds of each drift, with a hold of 10 minutes, covers, sags and strokes."""
    worlds = Worlds(5, 20)
    baseline = Baseline(worlds.module, worlds.patch)
    count = worlds.count * len(worlds.drifts)
    place = np.concatenate([worlds.surface.position_m + np.array([0, number, 0]) for number in range(count)])
    health = Health(worlds.module, placed(place), limits=(0, 255))
    found, untouched = [], np.zeros(0, bool)
    for times_ns, values, _ in worlds.blocks(BENCH_S):
        for time_ns, row in zip(times_ns.tolist(), values.astype(np.float32), strict=True):
            health.update(time_ns, row, baseline.update(time_ns, row))
        report = health.report()
        found.append(names(report.kind[report.faulty]))
        untouched = report.kind == HealthKind.NEVER_TOUCHED
    assert found == [[]] * len(found)
    of_module = untouched.reshape(count, 10, 12)
    assert of_module[:, 7:].all(), "nobody touched them"
    assert not of_module[:, 6].any(), "strokes went over all of it"


@pytest.mark.thorough
@pytest.mark.parametrize("how", [{"gain_spread": 0.3, "drift_per_min": 3.0}, {"noise": 0.05}], ids=["uneven", "quiet"])
def test_healthy_plates_have_no_faults(how: dict[str, float]) -> None:
    report = judged(plates(2, **how), QUICK)
    assert not report.faulty.any(), told(report, np.flatnonzero(report.faulty))
    assert np.isfinite(report.shown).mean() > 0.8, "most of them could be judged"


@pytest.mark.thorough
def test_dead_corners_stay_unknown_and_exchanged_taxels_are_found() -> None:
    """A dead taxel at a corner lies between no others: perhaps nothing touches it."""
    world = plates(3)
    one, other = TAXELS + 2 * SIDE + 2, TAXELS + 5 * SIDE + 5
    world.dead(CORNERS)
    world.swap([one], [other])
    report = judged(world, QUICK)
    assert names(report.kind[CORNERS]) == ["never_touched"] * 4
    assert names(report.kind[[one, other]]) == ["swapped", "swapped"]
    assert report.other[[one, other]].tolist() == [other, one]
    assert np.flatnonzero(report.faulty).tolist() == [one, other]


def test_a_dead_taxel_is_found_under_a_hand_that_covers_thousands() -> None:
    """More than are looked at in one frame."""
    surface = grid(1, 60, 60)
    dead = 30 * 60 + 30
    baseline, health = Baseline(surface.module, surface.patch), Health(surface.module, placed(surface.position_m))
    baseline.update(0, np.full(3600, 10.0))
    baseline.tare()
    for tenth in range(1, 200):
        values = np.full(3600, 60.0 if tenth % 50 > 30 else 10.0)
        values[dead] = 10
        health.update(tenth * 100_000_000, values, baseline.update(tenth * 100_000_000, values))
    report = health.report()
    assert np.flatnonzero(report.faulty).tolist() == [dead]
    assert names(report.kind[[dead]]) == ["dead"]
    assert report.shown[31 * 60 + 20] == pytest.approx(1)


@pytest.mark.thorough
def test_what_is_known_goes_with_the_taxels() -> None:
    """To another health of the same ones, in another order, and of one that is new."""
    surface = grid(1, 10, 10)
    dead, stuck, away = 44, 77, 12
    baseline = Baseline(np.arange(100) // 25, surface.patch)
    settings = HealthSettings(stuck_s=30)
    health = Health(np.arange(100) // 25, placed(surface.position_m), settings)
    rustle = np.random.default_rng(1)
    baseline.update(0, np.full(100, 10.0))
    baseline.tare()

    def next_frame(tenth: int) -> npt.NDArray[np.float64]:
        values = rustle.integers(0, 2, 100).astype(np.float64) + (60 if tenth % 70 > 60 else 10)
        values[dead] = 10 + tenth % 2
        values[stuck] = 15
        return values

    for tenth in range(1, 500):
        values = next_frame(tenth)
        health.update(tenth * 100_000_000, values, baseline.update(tenth * 100_000_000, values))
    before = health.report()
    assert names(before.kind[[dead, stuck]]) == ["dead", "stuck"]

    order = rustle.permutation(np.delete(np.arange(100), away))
    rows = np.append(order, -1)
    place = np.append(order, away)
    other = Health((np.arange(100) // 25)[place], placed(surface.position_m[place]), settings)
    other.restore(health.state(), rows)
    values = next_frame(500)
    calm, again = baseline.update(50_000_000_000, values), Baseline((np.arange(100) // 25)[place], surface.patch)
    again.restore(baseline.state(), place)
    health.update(50_000_000_000, values, calm)
    other.update(7, values[place], again.update(7, values[place]))
    one, two = health.report(), other.report()
    known = np.arange(99)
    assert two.kind[known].tolist() == one.kind[order].tolist()
    assert two.touches[known].tolist() == one.touches[order].tolist()
    for name in ("shown", "peak", "noise", "clipped", "still_s"):
        np.testing.assert_allclose(getattr(two, name)[known], getattr(one, name)[order], atol=0.2, err_msg=name)
    assert (np.isnan(two.noise[99]), two.touches[99]) == (True, 0)
    for wrong in ({}, health.state() | {"noise": np.zeros(100)}, health.state() | {"due": np.zeros(50)}):
        with pytest.raises(ConfigurationError, match="no state of health"):
            other.restore(wrong, rows)


@pytest.mark.thorough
def test_what_was_mended_is_good_again() -> None:
    world = plates(4)
    middle = 3 * SIDE + 3
    world.jump([middle], 300, at_s=-1)
    world.jump([middle], -300, at_s=60)
    baseline, geometry = Baseline(MODULE, SURFACE.patch), placed(SURFACE.position_m, normal=SURFACE.normal)
    health = Health(MODULE, geometry, QUICK, limits=(0, 255))
    kinds = set()
    for sample in world.samples(END_S):
        values = sample.values.astype(np.float32)
        health.update(sample.time_ns, values, baseline.update(sample.time_ns, values, sample.usable))
        if sample.time_ns % 1_000_000_000 < 60_000_000:
            kinds.add(names(health.report().kind)[middle])
    assert "clipped" in kinds
    assert names(health.report().kind)[middle] == "good"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("touched", "tared_s"),
    [((-5, 7.0), None), ((-5, 7.0), 3.0), ((-5, 9.4), 8.0), ((7, 9.5), 8.0), ((7, 19.3), 8.0), ((1, 15.0), 2.0)],
)
def test_a_finger_that_leaves_what_was_tared_under_it_makes_no_noise(
    touched: tuple[float, float], tared_s: float | None
) -> None:
    """The last frames of some of these fingers stand at the end of a measurement."""
    world = World(grid(5, 4, 4), seed=1, rate_hz=20)
    world.push(world.surface.position_m[37], 120, *touched, radius_m=0.006)
    baseline, health = Baseline(world.surface.module, world.surface.patch), Health(world.surface.module)
    for number, sample in enumerate(world.samples(45)):
        values = sample.values.astype(np.float32)
        health.update(sample.time_ns, values, baseline.update(sample.time_ns, values))
        if tared_s == number / 20:
            baseline.tare()
        report = health.report()
        assert not report.faulty.any(), (number / 20, told(report, np.flatnonzero(report.faulty)))
    assert np.isfinite(report.noise).all(), "all was judged"


@pytest.mark.thorough
def test_taxels_that_stay_far_below_their_baselines_are_judged_as_well() -> None:
    """While baselines are held by an operator nothing follows them down."""
    world = World(grid(5, 4, 4), seed=1, rate_hz=20)
    world.noisy([11], 8)
    world.jump(range(8, 16), -12, at_s=7)
    baseline, health = Baseline(world.surface.module, world.surface.patch), Health(world.surface.module)
    for number, sample in enumerate(world.samples(45)):
        values = sample.values.astype(np.float32)
        health.update(sample.time_ns, values, baseline.update(sample.time_ns, values))
        baseline.hold(number > 120)
    report = health.report()
    assert np.isfinite(report.noise).all()
    assert np.flatnonzero(report.faulty).tolist() == [11]
    assert names(report.kind[[11]]) == ["noisy"]


def still(values: list[list[float]], settings: HealthSettings, **how: object) -> HealthReport:
    """Frames at 10 Hz, each row for a second, of one module, without noise."""
    n = len(values[0])
    baseline = Baseline(np.zeros(n, int), np.zeros(n, int))
    health = Health(np.zeros(n, int), None, settings, **how)  # type: ignore[arg-type]
    baseline.update(0, values[0])
    baseline.tare()
    for second, row in enumerate(values):
        for tenth in range(10):
            time_ns = (second * 10 + tenth) * 100_000_000
            health.update(time_ns, row, baseline.update(time_ns, row))
    return health.report()


@pytest.mark.thorough
def test_a_skin_without_noise_is_not_stuck_because_nothing_touches_it() -> None:
    report = still([[10.0, 10, 10, 10]] * 30, HealthSettings(stuck_s=10), limits=(0, 255))
    assert names(report.kind) == ["never_touched"] * 4
    assert report.still_s.min() > 25
    taps = [[10.0, 10, 10, 60 if second % 8 == 7 else 10] for second in range(60)]
    report = still(taps, HealthSettings(stuck_s=10), limits=(0, 255))
    assert names(report.kind) == ["never_touched"] * 3 + ["good"], "it may just be that nobody touched the others"


def test_a_skin_that_rests_at_the_end_of_its_range_is_not_clipped() -> None:
    taps = [[0.0, 0, 0, 60 if second % 8 == 7 else 0] for second in range(60)]
    report = still(taps, HealthSettings(stuck_s=10, noise_s=5), limits=(0, 255))
    assert report.clipped.max() == 1
    assert not report.faulty.any()


@pytest.mark.thorough
def test_a_hard_press_that_lasts_is_no_fault() -> None:
    """At the end of the range, without any change: but what is beside it is pressed, too."""
    rustle = np.random.default_rng(1).integers(0, 3, (100, 5))
    rows = [[10.0 + r for r in row] for row in rustle.tolist()]
    for second in range(20, 90):
        rows[second][:2] = [255, 200 + 10 * (second % 2)]
    settings = HealthSettings(stuck_s=20, noise_s=5)
    assert not still(rows[:80], settings, limits=(0, 255)).faulty.any()
    assert not still(rows, settings, limits=(0, 255)).faulty.any()


def test_silence_is_no_stillness() -> None:
    n = 4
    baseline, health = Baseline(np.zeros(n, int), np.zeros(n, int)), Health(np.zeros(n, int))
    usable = np.ones(n, bool)
    for frame in range(600):
        usable[0] = frame < 100
        values = 10.0 + np.array([frame % 2, frame % 3, frame % 5, frame % 7])
        values[0] = values[0] if usable[0] else np.nan
        calm = baseline.update(frame * 100_000_000, values, usable)
        health.update(frame * 100_000_000, values, calm)
    report = health.report()
    assert report.still_s.max() < 1
    assert not report.faulty.any()
    assert np.isfinite(report.value).all()


def test_before_anything_is_known_nothing_is_said() -> None:
    n = 3
    health = Health(np.zeros(n, int), None, limits=(0, 255))
    for report in (health.report(), HealthReport.unknown(n)):
        assert names(report.kind) == ["good"] * n
        assert np.isnan(report.still_s).all()
        assert [report.evidence(taxel) for taxel in range(n)] == [""] * n


def test_health_of_a_drivers_sensors() -> None:
    structure = placed_structure()
    health = Health.of(structure, "pressure", QUICK)
    baseline = Baseline.of(structure, "pressure")
    values = np.full(80, 55.0)
    values[7] = 255
    for frame in range(300):
        health.update(frame * 50_000_000, values, baseline.update(frame * 50_000_000, values))
        if frame == 0:
            baseline.tare()
    assert np.flatnonzero(health.report().faulty).tolist() == [7]
    assert HealthKind(health.report().kind[7]) is HealthKind.CLIPPED


@pytest.mark.parametrize(("name", "value"), [("stuck_s", 0), ("noisy", -1), ("weak", math.inf), ("dead", math.nan)])
def test_settings_that_make_no_sense_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigurationError, match=f"{name} = "):
        HealthSettings(**{name: value})  # type: ignore[arg-type]


def test_places_of_other_taxels_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="health of 3 taxels: the places are of 2"):
        Health(np.zeros(3, int), placed([[0, 0, 0], [1, 0, 0]]))
