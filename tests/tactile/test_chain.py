"""Chains of stages: each alone, in any order, and what each says that it cannot do."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from skinware import DriverReader, Status, Structure
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE, PROXIMITY, SHEAR_X, SHEAR_Y, TEMPERATURE, SensorType
from skinware.tactile.chain import ChainSettings
from skinware.tactile.curves import MOST_KNOTS, Curve, CurveTable, read_curves
from skinware.tactile.stages import AmplifierSettings, FilterSettings, ScalerSettings, Signal, Stage, Taxels
from tests.cli.fake_skin import FakeSkin, fake_structure

MS = 1_000_000
N = 4
COUNTS = PRESSURE.measured(unit="counts", minimum=0.0, maximum=255.0)
CURVES = """
format = "skinware-curves"
version = 1
[[curve]]
type = "pressure"
from_unit = "counts"
unit = "Pa"
x = [0.0, 10.0, 100.0]
y = [0.0, 1000.0, 50000.0]
[[curve]]
type = "pressure"
uid = [1003]
from_unit = "counts"
unit = "Pa"
x = [0, 10]
y = [0, 20]
"""


def taxels(sensor_type: SensorType = COUNTS, n: int = N) -> Taxels:
    none = np.zeros(n, np.int64)
    return Taxels(sensor_type, np.arange(n, dtype=np.uint64), none, none, 1.0)


def through(stage: Stage, *rows: npt.ArrayLike, period_ms: int = 20) -> list[npt.NDArray[np.float32]]:
    """What comes out of a stage, frame by frame."""
    found = []
    for number, row in enumerate(rows):
        signal = Signal.of((number + 1) * period_ms * MS, row)
        stage.step(signal)
        found.append(signal.values)
    return found


def test_a_lowpass_goes_by_time_and_not_by_frames() -> None:
    for period_ms in (5, 20, 50):
        stage = FilterSettings(tau_s=0.1).stage(taxels())
        frames = [np.zeros(N)] + [np.full(N, 100.0)] * (100 // period_ms)
        assert through(stage, *frames, period_ms=period_ms)[-1] == pytest.approx(100 * (1 - np.exp(-1)), abs=0.1)


@pytest.mark.parametrize(("method", "expected"), [("median", [5, 5, 6]), ("mean", [5, 20, 64 / 3])])
def test_mean_and_median_are_of_the_last_frames(method: str, expected: list[float]) -> None:
    stage = FilterSettings(method=method, frames=3).stage(taxels())  # type: ignore[arg-type]
    shown = through(stage, *[np.full(N, value) for value in (5.0, 50.0, 9.0)])
    assert shown[0] == pytest.approx(expected[0])
    assert shown[1] == pytest.approx(expected[1])
    assert shown[2] == pytest.approx(9 if method == "median" else expected[2])


@pytest.mark.parametrize("settings", [FilterSettings(), FilterSettings(method="mean"), FilterSettings(method="median")])
def test_a_filter_passes_over_what_is_missing(settings: FilterSettings) -> None:
    rows: list[npt.ArrayLike] = [
        [np.nan, 10, 10, 10],
        [np.nan, np.nan, 10, 10],
        [7, np.nan, 10, np.inf],
        [7, 10, 10, 10],
    ]
    shown = through(settings.stage(taxels()), *rows)
    assert np.isnan(shown[1][0])
    assert shown[2][0] == 7
    for frame in shown:
        assert frame[1:] == pytest.approx(10)


def test_a_scaler_by_the_range_of_the_type_has_no_unit() -> None:
    stage = ScalerSettings(low=-1, high=1).stage(taxels())
    assert (stage.taxels.type.unit, stage.taxels.type.minimum, stage.taxels.type.maximum) == ("1", -1, 1)
    assert through(stage, [0, 255, 127.5, 400])[0].tolist() == [-1, 1, 0, 1]
    with pytest.raises(ConfigurationError, match=re.escape("pressure has no range (-inf to inf): give source")):
        ScalerSettings().stage(taxels(PRESSURE))
    with pytest.raises(ConfigurationError, match="give a range"):
        ScalerSettings(low=1, high=1)


def test_a_scaler_by_what_was_seen_may_forget() -> None:
    rows = [np.full(N, 0.0), np.full(N, 200.0), *[np.full(N, 100.0)] * 500]
    kept = through(ScalerSettings(source="seen").stage(taxels(PRESSURE)), *rows)
    assert kept[0] == pytest.approx(0)
    assert kept[1] == pytest.approx(1)
    assert kept[-1] == pytest.approx(0.5)
    stage = ScalerSettings(source="seen", shrink_s=1).stage(taxels(PRESSURE))
    forgot = through(stage, *rows, np.full(N, 101.0))
    assert forgot[-1] == pytest.approx(1), "the range is narrow by now"
    unseen = through(ScalerSettings(source="seen").stage(taxels()), [np.nan, 1, 2, 3], [np.nan, 2, 1, 3])
    assert unseen[1][1:].tolist() == [1, 0, 0]


def test_an_amplifier_keeps_the_sign() -> None:
    stage = AmplifierSettings(gain=2, exponent=0.5, offset=1).stage(taxels())
    assert through(stage, [0, 4, -9, 100])[0].tolist() == [1, 5, -5, 21]
    assert stage.taxels.type.unit == "1"
    assert (stage.taxels.type.minimum, stage.taxels.type.maximum) == pytest.approx((1, 1 + 2 * 255**0.5))
    for wrong in ({"gain": 0}, {"offset": np.inf}):
        with pytest.raises(ConfigurationError, match="give finite numbers"):
            AmplifierSettings(**wrong)


@pytest.mark.thorough
@given(st.data())
def test_curves_are_what_interpolation_says(data: st.DataObject) -> None:
    knots = data.draw(st.integers(2, MOST_KNOTS))
    number = st.floats(-1000, 1000, width=16)
    x = sorted(data.draw(st.sets(st.integers(-500, 500), min_size=knots, max_size=knots)))
    y = sorted(data.draw(st.lists(number, min_size=knots, max_size=knots)))
    curve = Curve(type="pressure", from_unit="counts", unit="Pa", x=tuple(map(float, x)), y=tuple(y))
    values = data.draw(hnp.arrays(np.float32, 5, elements=st.floats(-2000, 2000, width=32)))
    table = CurveTable([curve], "pressure", np.arange(5, dtype=np.uint64))
    assert table(values) == pytest.approx(np.interp(values, x, y), rel=1e-4, abs=0.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no file of curves: it does not say format"),
        ("x = [0.0, 10.0]", "3 x and 2 y|2 x and 3 y"),
        ("x = [0.0, 10.0, 5.0]", "x must rise"),
        ("y = [0.0, 10.0, 5.0]", "y must not fall"),
        ("unit = 3", "Expected"),
        ("curve = 3", "no curves|Expected|not TOML"),
        ("again", "a second curve for pressure, all"),
    ],
)
def test_a_wrong_file_of_curves_says_where(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "curves.toml"
    key = text.partition(" ")[0]
    lines = CURVES.splitlines()
    if text == "":
        lines = []
    elif text == "again":
        lines += lines[3:9]
    else:
        first = next((number for number, line in enumerate(lines) if line.startswith(key)), 0)
        lines[first] = text
    path.write_text("\n".join(lines))
    with pytest.raises(ConfigurationError, match=words) as error:
        read_curves(path)
    assert str(path) in str(error.value)


def chain_of(tmp_path: Path, *stages: str) -> ChainSettings:
    path = tmp_path / "chain.toml"
    (tmp_path / "curves.toml").write_text(CURVES)
    path.write_text('format = "skinware-chain"\nversion = 1\n' + "".join(f"[[stage]]\n{text}\n" for text in stages))
    return ChainSettings.read(path)


BASELINE, CURVE, FILTER = 'stage = "baseline"', 'stage = "curve"\nfile = "curves.toml"', 'stage = "filter"'
SCALER, AMPLIFIER = 'stage = "scaler"\ntypes = ["pressure"]', 'stage = "amplifier"\ntypes = ["pressure"]'


@pytest.mark.parametrize(
    ("stages", "unit"),
    [
        ([BASELINE], "counts"),
        ([BASELINE, CURVE, FILTER], "Pa"),
        ([CURVE, BASELINE], "Pa"),
        ([FILTER, BASELINE, SCALER, AMPLIFIER], "1"),
        ([AMPLIFIER + '\nunit = "mN"', SCALER + '\nsource = "seen"', FILTER, BASELINE], "1"),
        ([SCALER, AMPLIFIER + '\nunit = "mN"', BASELINE, FILTER], "mN"),
    ],
)
def test_stages_in_any_order_follow_a_driver(tmp_path: Path, stages: list[str], unit: str) -> None:
    settings = chain_of(tmp_path, *stages)
    with FakeSkin() as skin:
        chain = settings.chain(skin.structure)
        assert chain.structure.dtype == np.float32
        assert chain.structure.type("pressure").unit == unit
        assert chain.structure.type("temperature").unit == "degC"
        assert np.array_equal(chain.structure.sensor_uid, skin.structure.sensor_uid)
        values, status = np.zeros(skin.structure.n_sensors, np.float32), np.zeros(skin.structure.n_sensors, np.uint8)
        skin.status[30] = Status.STALE
        with DriverReader("fake") as reader:
            for _ in range(5):
                skin.publish()
                chain.step(reader.read(), values, status)
        assert np.isfinite(values).all()
        assert status[30] & Status.STALE
        temperature = skin.structure.index("temperature")
        assert values[temperature] == pytest.approx(25, abs=2)


def test_a_chain_says_what_a_baseline_did(tmp_path: Path) -> None:
    with FakeSkin() as skin:
        chain = chain_of(tmp_path, BASELINE).chain(skin.structure)
        values, status = np.zeros(skin.structure.n_sensors, np.float32), np.zeros(skin.structure.n_sensors, np.uint8)
        skin.values = np.full(skin.structure.n_sensors, 200.0)
        with DriverReader("fake") as reader:
            for step in range(3):
                skin.publish()
                chain.step(reader.read(), values, status)
                pressure = skin.structure.index("pressure")
                if step == 0:
                    assert (status[pressure] == Status.NEVER_SEEN).all()
                    assert not values[pressure].any()
                    chain.baselines["pressure"].tare()
                else:
                    assert (status[pressure] == (Status.SUSPECT if step == 1 else 0)).all()
        assert list(chain.baselines) == ["pressure"]


@pytest.mark.parametrize(
    "axes", [(SHEAR_X, SHEAR_Y, PRESSURE), tuple(SensorType(f"resultant_{a}", 1 << 12 | ord(a), "Pa") for a in "xyz")]
)
def test_axes_within_the_skin_bear_no_load_without_one_along_the_normal(axes: tuple[SensorType, ...]) -> None:
    """They are covered at the start; later a load holds some of them, and pulls others that it does not press."""
    n, types = 24, [axis.measured(unit="counts", minimum=-500, maximum=500) for axis in axes]
    structure = Structure(
        types=types,
        buses=["can0"],
        patch_name=["palm"],
        patch_bus=[0],
        module_patch=[0, 0],
        module_kind=["pad"] * 2,
        sensor_uid=[*range(n)] * 3,
        sensor_type=np.repeat([one.id for one in types], n),
        sensor_module=np.arange(3 * n) % n // 12,
        dtype="i2",
    )
    chain, random = ChainSettings.calm().chain(structure), np.random.default_rng(1)
    rows = [structure.index(one.name) for one in types]
    shown, status = np.zeros(3 * n, np.float32), np.zeros(3 * n, np.uint8)

    def run(first_s: int, last_s: int, *loads: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Return (types, n) the shares of these seconds in which each is touched."""
        seen = []
        for number in range(50 * first_s, 50 * last_s):
            values = 5 + 0.6 * random.standard_normal(3 * n)
            for of, load in zip(rows, loads, strict=False):
                values[of] += load
            sample = SimpleNamespace(
                acquired_ns=number * 20 * MS, physical_values=lambda v=values: np.round(v), status=status * 0
            )
            chain.step(cast(DriverSnapshot, sample), shown, status)
            seen.append([chain.baseline_stages[one.name].shown.touched.copy() for one in types])
        share: npt.NDArray[np.float64] = np.mean(seen, axis=0)
        return share

    pressed = 60.0 * (np.arange(n) < 6)
    run(0, 6, -0.6 * pressed, 0.5 * pressed, pressed)
    run(6, 9)
    assert not run(9, 12).any()
    pressed = 45.0 * (np.abs(np.arange(n) - 7) < 3)
    beside = 12.0 * (np.arange(n) == 11)
    touched = run(12, 40, 0.4 * pressed + beside, -0.7 * pressed, pressed)
    assert touched[:, pressed > 0].min() > 0.98
    assert touched[0, 11] > 0.98, "the skin is pulled there"
    run(40, 42)
    assert not run(42, 44).any()


@pytest.mark.parametrize(
    ("stages", "words"),
    [
        ([], "no \\[\\[stage\\]\\] in it"),
        (['stage = "blur"'], "chain.toml:4: Invalid value 'blur'"),
        (['stage = "filter"\nmethod = "max"'], "chain.toml:5: Invalid enum value 'max' .*; there are .*'median'"),
        (['stage = "filter"\nframes = 1'], "chain.toml:5: Expected int >= 2"),
        (['stage = "filter"\ntau = 1'], "unknown field tau"),
        (['stage = "curve"'], "missing required field file"),
        ([BASELINE, 'stage = "baseline"\non_sigma = 2'], "chain.toml:5: on_sigma = 2"),
    ],
)
def test_a_wrong_file_says_where(tmp_path: Path, stages: list[str], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        chain_of(tmp_path, *stages)


def structure_of(sensor_type: SensorType) -> Structure:
    one = fake_structure(1, 1)
    ids = np.full(one.n_sensors, sensor_type.id)
    return one.replace(types=[sensor_type], sensor_type=ids)


@pytest.mark.parametrize(
    ("stages", "sensor_type", "words"),
    [
        ([BASELINE], TEMPERATURE, "chain.toml:3: baseline: a temperature has no rest"),
        ([BASELINE], PROXIMITY, "baseline: a proximity in m falls"),
        ([FILTER, CURVE], TEMPERATURE, "chain.toml:5: curve: no curve for temperature, any"),
        ([CURVE], PRESSURE, "curve: the curves are for counts, and the values are in Pa"),
        ([CURVE, CURVE], COUNTS, "chain.toml:6: curve: the curves are for counts, and the values are in Pa"),
        ([SCALER], PRESSURE, "scaler: pressure has no range"),
        (['stage = "filter"\ntypes = ["presure"]'], PRESSURE, "no sensor type 'presure'; there are: pressure"),
        (['stage = "curve"\nfile = "no.toml"'], COUNTS, "no.toml: No such file"),
    ],
)
def test_a_stage_says_what_it_cannot_do(tmp_path: Path, stages: list[str], sensor_type: SensorType, words: str) -> None:
    settings = chain_of(tmp_path, *stages)
    with pytest.raises(ConfigurationError, match=words):
        settings.chain(structure_of(sensor_type))
