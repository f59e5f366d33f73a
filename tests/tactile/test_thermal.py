"""Taxels whose temperature is measured: their drift is taken off, also under a grip of a whole patch."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware.tactile.baseline import Baseline
from skinware.tactile.chain import ChainSettings
from skinware.tactile.chain_state import read_state, save_state
from skinware.tactile.stages import Signal, Taxels
from skinware.tactile.thermal import ThermalSettings, ThermalStage
from tests.cli.fake_skin import fake_structure

N, PADS, RATE_HZ = 80, 16, 10
MODULE, PAD_MODULE = np.arange(N) // 10, np.arange(PADS) // 2
LOAD = 20.0

Floats = npt.NDArray[np.float64]


def taxels(pads: npt.NDArray[np.int64] = PAD_MODULE) -> tuple[Taxels, Taxels]:
    pressure, temperature = (of.measured(unit="counts", minimum=0.0, maximum=255.0) for of in (PRESSURE, TEMPERATURE))
    uid = np.arange(N + len(pads), dtype=np.uint64)
    return (
        Taxels(pressure, uid[:N], MODULE, np.zeros(N, np.int64), 1.0),
        Taxels(temperature, uid[N:], pads, np.zeros(len(pads), np.int64), 1.0),
    )


class Found(NamedTuple):
    """Shares of frames and taxels.

    Attributes:
        on: held ones that are touched.
        right: held ones whose value is within 20 % and three standard deviations of noise.
        false: taxels that nothing touches, touched.
    """

    on: float
    right: float
    false: float


def grip(seed: int, share: float, *, thermal: bool = True, heats: float = 0.0, lost: float = 0.0) -> Found:
    """Grip a share of a patch from 200 to 800 s, while it warms by 8 counts and cools, twice in 800 s.

    Args:
        seed: of noise and gains.
        share: of the taxels.
        thermal: whether the stage works.
        heats: counts by which a grip warms the patch in the end.
        lost: share of the temperatures and values that do not come.
    """
    random = np.random.default_rng(seed)
    stage, baseline = ThermalStage(*taxels(), spread=1.0), Baseline(MODULE, np.zeros(N), limits=(0, 255))
    gain, gripped = (1 + 0.3 * random.standard_normal(N)).clip(0.2, 3), np.arange(N) < share * N
    phase, uneven = random.uniform(0, 6), 1 + 0.1 * np.sin(np.arange(8))
    on, right, false = [], [], []
    for number in range(900 * RATE_HZ):
        time_s = number / RATE_HZ
        is_on = 200 < time_s < 800
        warmth = 8 * (np.sin(time_s * 2 * np.pi / 400 + phase) - np.sin(phase))
        warm = (warmth + heats * (1 - np.exp(-max(0, time_s - 200) / 60))) * uneven
        values = 60 + gain * warm[MODULE] + LOAD * (gripped & is_on) + 0.8 * random.standard_normal(N)
        pads = 100 + 3 * warm[PAD_MODULE] + 0.4 * random.standard_normal(PADS)
        signal, temperature = (
            Signal.of(number * NS_PER_S // RATE_HZ, np.round(of), random.random(len(of)) >= lost)
            for of in (values, pads)
        )
        if thermal:
            stage.step(signal, temperature)
        calm = baseline.update(signal.time_ns, signal.values, signal.usable)
        if is_on and time_s > 203:
            on.append(calm.touched[gripped].mean())
            right.append((np.abs(calm.value - LOAD)[gripped & calm.usable] <= 0.2 * LOAD + 2.4).mean())
        if time_s > 10 and not 200 <= time_s < 805:
            false.append(calm.touched.mean())
    return Found(float(np.mean(on)), float(np.mean(right)), float(np.mean(false)))


@pytest.mark.parametrize(
    ("share", "heats", "lost"),
    [
        (1.0, 0.0, 0.3),
        *(
            pytest.param(*how, 0.0, marks=pytest.mark.thorough)
            for how in [(1.0, 0.0), (0.9, 0.0), (0.5, 0.0), (1.0, 10.0)]
        ),
    ],
)
def test_a_long_grip_is_kept_while_the_skin_warms_and_cools(share: float, heats: float, lost: float) -> None:
    found = grip(1, share, heats=heats, lost=lost)
    assert found.on >= 0.99
    assert found.right >= 0.97
    assert found.false <= 0.005


@pytest.mark.thorough
@pytest.mark.timeout(400)
@pytest.mark.parametrize(("share", "heats"), [(1.0, 0.0), (0.9, 0.0), (1.0, 10.0)])
def test_twenty_grips_are_kept(share: float, heats: float) -> None:
    found = np.array([grip(seed, share, heats=heats) for seed in range(20)])
    on, right, false = found.mean(axis=0)
    assert on >= 0.99
    assert right >= 0.97
    assert false <= 0.005


@pytest.mark.thorough
def test_without_the_stage_the_same_grip_is_lost() -> None:
    assert grip(1, 1.0, thermal=False).on < 0.9


def steps(stage: ThermalStage, values: Floats, pads: Floats, first: int = 0) -> Signal:
    """Take frames through a stage, 10 a second: (m, N) values and (m, PADS) temperatures."""
    for number, (row, warm) in enumerate(zip(values, pads, strict=True), first):
        signal = Signal.of(number * NS_PER_S // RATE_HZ, row)
        stage.step(signal, Signal.of(signal.time_ns, warm))
    return signal


def test_taxels_of_which_nothing_is_known_are_like_their_patch() -> None:
    stage = ThermalStage(*taxels(), spread=1.0)
    warm = np.linspace(0, 30, 600)[:, np.newaxis]
    values = 60 + 2 * np.repeat(warm, N, axis=1) / 3
    values[:, 7] = np.nan
    steps(stage, values, 100 + np.repeat(warm, PADS, axis=1))
    assert stage.gains.gain == pytest.approx(np.full(N, 2 / 3), rel=0.05)


def test_a_value_at_the_end_of_its_range_stays_there_and_a_module_without_temperature_as_it_is() -> None:
    one, other = taxels(np.zeros(PADS, np.int64))
    stage = ThermalStage(one, other, spread=1.0)
    warm = np.linspace(0, 30, 600)[:, np.newaxis]
    values = 60 + np.repeat(warm, N, axis=1)
    values[-1, 3] = 255
    last = steps(stage, values, 100 + np.repeat(warm, PADS, axis=1)).values
    assert last[3] == 255
    assert last[:3] == pytest.approx(60, abs=6)  # it rises by 5 while the gain is not known
    assert last[10:] == pytest.approx(90)


def test_temperatures_that_come_later_or_again_move_nothing_at_once() -> None:
    stage = ThermalStage(*taxels(), spread=1.0)
    warm = np.linspace(0, 30, 600)[:, np.newaxis]
    values, pads = 60 + np.repeat(warm, N, axis=1), 100 + np.repeat(warm, PADS, axis=1)
    pads[:100] = np.nan
    pads[400:500] = np.nan
    shown = np.array([steps(stage, values[i : i + 1], pads[i : i + 1], i).values for i in range(600)])
    assert np.abs(np.diff(shown, axis=0)).max() < 1
    assert np.ptp(shown[500:]) < 6


def test_a_restarted_stage_goes_on_where_the_one_before_was() -> None:
    warm = np.linspace(0, 30, 600)[:, np.newaxis]
    values, pads = 60 + np.repeat(warm, N, axis=1), 100 + np.repeat(warm, PADS, axis=1)
    before, after = ThermalStage(*taxels(), spread=1.0), ThermalStage(*taxels(), spread=1.0)
    last = steps(before, values, pads).values
    rows = np.arange(N)
    rows[5] = -1
    after.restore(before.state(), rows)
    shown = steps(after, values[-1:] + 4, pads[-1:] + 4).values  # it was 4 counts warmer after a restart
    assert np.delete(shown, 5) == pytest.approx(np.delete(last, 5), abs=0.5)
    assert shown[5] == pytest.approx(60 + 30 + 4 - 4, abs=0.5)  # no drift from before, but the gain of its patch


@pytest.mark.parametrize(
    "wrong", [{}, {"own": np.zeros(3)}, {"drift": np.zeros((N, 2))}, {"warmth": np.zeros(N, "i8")}]
)
def test_a_state_that_does_not_fit_is_refused(wrong: dict[str, npt.NDArray[np.float64]]) -> None:
    stage = ThermalStage(*taxels(), spread=1.0)
    with pytest.raises(ConfigurationError, match="no state of the stage thermal"):
        stage.restore(stage.state() | wrong if wrong else {}, np.arange(N))


def test_a_chain_keeps_what_its_baselines_need(tmp_path: Path) -> None:
    settings = chain(tmp_path, '[[stage]]\nstage = "thermal"\n[[stage]]\nstage = "baseline"\n')
    before, after = settings.chain(fake_structure()), settings.chain(fake_structure())
    (stage,) = (stage for stage in before.stages["pressure"] if isinstance(stage, ThermalStage))
    stage.gains.own[:] = 0.5
    stage.gains.variance[:] = 0.0
    save_state(tmp_path / "state.npz", before.state())
    state, why = read_state(tmp_path / "state.npz")
    assert not why
    assert state is not None
    assert "pressure/thermal.own" in state.arrays
    after.restore(state)
    (stage,) = (stage for stage in after.stages["pressure"] if isinstance(stage, ThermalStage))
    assert stage.gains.gain == pytest.approx(0.5)


def chain(tmp_path: Path, stages: str) -> ChainSettings:
    path = tmp_path / "chain.toml"
    path.write_text(f'format = "skinware-chain"\nversion = 1\n{stages}')
    return ChainSettings.read(path)


def test_a_chain_makes_it_for_all_types_but_temperatures(tmp_path: Path) -> None:
    settings = chain(tmp_path, '[[stage]]\nstage = "thermal"\nspread = 2.0\n[[stage]]\nstage = "baseline"\n')
    made = settings.chain(fake_structure())
    assert [stage.name for stage in made.stages["pressure"]] == ["thermal", "baseline"]
    assert made.structure.type("pressure").unit == "counts"


def test_a_chain_for_a_driver_without_temperatures_says_so(tmp_path: Path) -> None:
    structure = fake_structure()
    settings = chain(tmp_path, '[[stage]]\nstage = "thermal"\ntypes = ["temperature"]\n')
    with pytest.raises(ConfigurationError, match="thermal: it needs sensors of type temperature, and others"):
        settings.chain(structure)
    with pytest.raises(ConfigurationError, match="no module with pressure has a sensor of type temperature"):
        ThermalSettings().stage(*taxels(np.full(PADS, 99)))
