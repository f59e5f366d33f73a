"""Learning sets: each row is what was there at its time, and nothing else; read by a strict reader of the format."""

from __future__ import annotations

import contextlib
import io
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow
import pyarrow.parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import skinware.recording
from skinware import Status, Structure
from skinware.conversion import Selection, convert_foreign
from skinware.conversion.foreign import guess, open_source
from skinware.conversion.learning import (
    Interval,
    Join,
    LearningSet,
    convert_to_learning_set,
    dataset,
    export,
    features,
    interval_of,
    join_of,
    read_intervals,
)
from skinware.conversion.learning.features import Moments, Statistics
from skinware.conversion.learning.wanted import Joined, matched
from skinware.conversion.mcap_files import write_recording
from skinware.conversion.tables import Table
from skinware.errors import BadRecording, ConfigurationError
from skinware.learning.images import Colours, TouchImage
from skinware.skin_layout import SkinLayout
from skinware.tactile.regions import SensorChoice
from tests.cli.fake_skin import fake_structure
from tests.recording.lerobot_format import Read, read_dataset
from tests.recording.made import START_NS, MadeSource, MadeTable, generation_of_driver, generation_of_service

TACTILE = "observation.tactile."
MONOTONIC_NS = 1 << 40
"""Of the first frame of a made recording."""


class Made(NamedTuple):
    """A recording of drivers at 100 Hz."""

    path: Path
    tables: list[MadeTable]


def table_of(
    name: str, structure: Structure, numbers: Sequence[int], *, rate_hz: float = 100.0, seed: int = 1
) -> MadeTable:
    """Frames of a driver, full of noise, some sensors not good."""
    generator, n = np.random.default_rng(seed), len(numbers)
    shape = (n, structure.n_sensors)
    columns = {
        "values": generator.integers(0, 250, shape).astype(structure.dtype),
        "status": np.where(generator.random(shape) < 0.05, 4, 0).astype(np.uint8),
        "module_time_ns": MONOTONIC_NS
        + np.asarray(numbers)[:, np.newaxis] * round(1e9 / rate_hz)
        - generator.integers(0, 10**6, (n, structure.n_modules)),
    }
    generation = generation_of_driver(name, structure)
    return MadeTable(generation, columns, n, rate_hz=rate_hz, numbers=numbers)


def write(path: Path, *tables: MadeTable, clock: Sequence[dict[str, Any]] = ()) -> Made:
    source = MadeSource(tables)
    source.clock = list(clock)
    write_recording(source, path)
    return Made(path, list(tables))


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """Two seconds of a driver; its clocks."""
    seconds = [s * 10**9 for s in range(3)]
    clock = [
        {"monotonic_ns": MONOTONIC_NS + ns, "realtime_ns": START_NS + ns, "log_time_ns": START_NS + ns}
        for ns in seconds
    ]
    return write(tmp_path / "walk.mcap", table_of("torso", fake_structure(1, 2, dtype="<u2"), range(200)), clock=clock)


def learn(made: Made | Sequence[Path], wanted: LearningSet | None = None, **more: Any) -> Read:
    """A learning set of recordings, as it is read."""
    paths = [made.path] if isinstance(made, Made) else list(made)
    target = paths[0].with_name("set")
    converted = convert_to_learning_set(paths, target, wanted or LearningSet(), **more)
    assert converted.path == target
    return read_dataset(target)


def physical(table: MadeTable, type_name: str) -> npt.NDArray[Any]:
    """(n, sensors) float32."""
    assert table.structure is not None
    return table.structure.physical(table.columns["values"], type_name).astype(np.float32)


def status_of(table: MadeTable, type_name: str) -> npt.NDArray[np.uint8]:
    """(n, sensors)."""
    assert table.structure is not None
    rows: npt.NDArray[np.uint8] = table.columns["status"][:, table.structure.index(type_name)]
    return rows


# -- what a row has -----------------------------------------------------------------------------------------------


def test_a_row_has_the_newest_frame_of_its_time(made: Made) -> None:
    read = learn(made)
    (table,) = made.tables
    newest = [int(row / 30 * 100 + 1e-6) for row in range(60)]
    assert read.info["total_frames"] == 60
    assert read.info["fps"] == 30
    assert read.tasks == ["walk"]
    for type_name in ("pressure", "temperature"):
        assert np.array_equal(read.features[f"{TACTILE}torso.{type_name}"], physical(table, type_name)[newest])
        assert np.array_equal(read.features[f"{TACTILE}torso.{type_name}_status"], status_of(table, type_name)[newest])
    late_s = np.arange(60) / 30 - np.array(newest) / 100
    assert read.features[f"{TACTILE}torso.age"] == pytest.approx(late_s, abs=1e-6)
    told = read.info["features"][f"{TACTILE}torso.pressure"]
    assert (told["dtype"], told["shape"], told["names"][0]) == ("float32", [20], "board 7, triangle 0, taxel 0")


@pytest.mark.parametrize(("window", "frames"), [(7, 7), (0, 4)])
def test_windows_have_the_skins_own_rate(made: Made, window: int, frames: int) -> None:
    read = learn(made, LearningSet(window=window))
    (table,) = made.tables
    values, age = read.features[f"{TACTILE}torso.pressure"], read.features[f"{TACTILE}torso.age"]
    first_s = (frames - 1) / 100  # a row has whole windows only
    assert values.shape == (len(values), frames, 20)
    for row in range(len(values)):
        newest = int((first_s + row / 30) * 100 + 1e-6)
        of = np.arange(newest - frames + 1, newest + 1)
        assert np.array_equal(values[row], physical(table, "pressure")[of])
        assert np.array_equal(read.features[f"{TACTILE}torso.pressure_status"][row], status_of(table, "pressure")[of])
        assert age[row] == pytest.approx(first_s + row / 30 - of / 100, abs=1e-6)
    assert len(values) == int((1.99 - first_s) * 30) + 1


@pytest.mark.thorough
def test_a_driver_that_falls_silent_is_stale_and_old(tmp_path: Path) -> None:
    structure = fake_structure(1, 2)
    silent = table_of("torso", structure, [*range(50), *range(400, 450)])
    made = write(tmp_path / "walk.mcap", silent, table_of("arm", structure, range(450)))
    read = learn(made, LearningSet(fps=10, window=3))
    status, age = read.features[f"{TACTILE}torso.pressure_status"], read.features[f"{TACTILE}torso.age"][:, -1]
    time_s = 0.02 + read.features["timestamp"]
    is_silent = (time_s > 0.49) & (time_s < 4)
    assert age[is_silent] == pytest.approx(time_s[is_silent] - 0.49, abs=1e-5)
    is_stale = (status & Status.STALE).astype(bool)
    too_old = is_silent & (age > 1.01)  # a second, for a driver that does not tell its period
    assert too_old.sum() > 20
    assert is_stale[too_old].all()
    assert not is_stale[age < 0.99].any()
    assert not (read.features[f"{TACTILE}arm.pressure_status"] & Status.STALE).any()


def test_sensors_that_were_stale_in_their_frame_stay_so(made: Made) -> None:
    (table,) = made.tables
    assert {0, 4} == set(np.unique(table.columns["status"]).tolist())
    table.columns["status"][:, 3] = Status.STALE
    write_again = made.path.with_name("again.mcap")
    write(write_again, table)
    read = learn([write_again])
    assert (read.features[f"{TACTILE}torso.pressure_status"][:, 3] == Status.STALE).all()


def test_a_selection_has_what_was_asked_for(tmp_path: Path) -> None:
    structure = fake_structure(2, 2)
    made = write(
        tmp_path / "walk.mcap", table_of("torso", structure, range(100)), table_of("arm", structure, range(100), seed=2)
    )
    read = learn(made, selection=Selection(["arm"], SensorChoice(types=["pressure"], patches=["board 8"])))
    assert {name for name in read.features if name.startswith("obs")} == {
        f"{TACTILE}arm.{name}" for name in ("pressure", "pressure_status", "age")
    }
    newest = [int(row / 30 * 100 + 1e-6) for row in range(30)]
    assert np.array_equal(read.features[f"{TACTILE}arm.pressure"], physical(made.tables[1], "pressure")[newest, 20:])
    sensors = pyarrow.parquet.read_table(io.BytesIO((tmp_path / "set/meta/skin/arm.sensors.parquet").read_bytes()))
    assert set(sensors["patch"].to_pylist()) == {"board 8"}


def test_a_row_has_the_nearest_sample(made: Made) -> None:
    read = learn(made, LearningSet(resample="nearest"))
    (table,) = made.tables
    nearest = np.rint(np.arange(60) / 30 * 100).astype(int)
    assert np.array_equal(read.features[f"{TACTILE}torso.pressure"], physical(table, "pressure")[nearest])
    assert read.features[f"{TACTILE}torso.age"] == pytest.approx(np.arange(60) / 30 - nearest / 100, abs=1e-6)


def test_values_between_samples_are_said_to_be(made: Made, tmp_path: Path) -> None:
    read = learn(made, LearningSet(fps=40, resample="linear"))
    (table,) = made.tables
    before, share = np.divmod(np.arange(80) * 2.5, 1)
    after = np.minimum(before + 1, 199).astype(int)
    values = physical(table, "pressure")
    expected = values[before.astype(int)] * (1 - share[:, np.newaxis]) + values[after] * share[:, np.newaxis]
    assert np.allclose(read.features[f"{TACTILE}torso.pressure"], expected, atol=1e-3)
    assert read.features[f"{TACTILE}torso.interpolated"] == pytest.approx(share, abs=1e-6)
    status = status_of(table, "pressure")
    both = status[before.astype(int)] | np.where(share[:, np.newaxis] > 0, status[after], 0)
    assert np.array_equal(read.features[f"{TACTILE}torso.pressure_status"], both)
    again = convert_to_learning_set([made.path], tmp_path / "again", LearningSet(40, resample="linear", form="points"))
    assert again.notes == ["torso: 40 of 80 rows are interpolated"]
    assert read_dataset(again.path).features[f"{TACTILE}interpolated"] == pytest.approx(share, abs=1e-6)
    with pytest.raises(ConfigurationError, match="leave out --window"):
        LearningSet(resample="linear", window=2)


def test_nothing_is_interpolated_over_a_lost_sample(tmp_path: Path) -> None:
    made = write(tmp_path / "walk.mcap", table_of("torso", fake_structure(1, 1), [*range(20), *range(25, 50)]))
    read = learn(made, LearningSet(fps=80, resample="linear"))
    share, time_s = read.features[f"{TACTILE}torso.interpolated"], read.features["timestamp"]
    in_gap = (time_s > 0.19) & (time_s < 0.25)
    assert in_gap.sum() > 3
    assert not share[in_gap].any()
    assert (share[~in_gap] > 0).mean() > 0.7


# -- episodes -----------------------------------------------------------------------------------------------------


def test_episodes_that_are_asked_for(made: Made, tmp_path: Path) -> None:
    (tmp_path / "episodes.csv").write_text("start_s,end_s,task\n1.5,1.7,place\n0.5,1.0,\n")
    intervals = [interval_of("0.1..0.3"), *read_intervals(tmp_path / "episodes.csv")]
    read = learn(made, LearningSet(fps=50, intervals=intervals, task="pick"))
    assert [read.task_of(number) for number in range(3)] == ["pick", "pick", "place"]
    assert [row["length"] for row in read.episodes] == [10, 25, 10]
    for number, start in enumerate((10, 50, 150)):
        rows = physical(made.tables[0], "pressure")[start : start + 2 * read.episodes[number]["length"] : 2]
        assert np.array_equal(read.episode(number)[f"{TACTILE}torso.pressure"], rows)


def test_gaps_end_episodes(tmp_path: Path) -> None:
    numbers = [*range(100), *range(200, 300), *range(305, 400)]
    made = write(tmp_path / "walk.mcap", table_of("torso", fake_structure(1, 1), numbers))
    read = learn(made, LearningSet(fps=50, gap_s=0.5, window=2))
    assert [row["length"] for row in read.episodes] == [50, 100]
    age = read.features[f"{TACTILE}torso.age"]
    assert age[:, 0].max() < 0.08
    assert np.array_equal(read.episode(1)[f"{TACTILE}torso.pressure"][0], physical(made.tables[0], "pressure")[100:102])


@pytest.mark.thorough
def test_several_recordings_are_one_set(made: Made, tmp_path: Path) -> None:
    structure = made.tables[0].structure
    assert structure is not None
    other = write(tmp_path / "run.mcap", table_of("torso", structure, range(100), seed=5))
    read = learn([made.path, other.path], LearningSet(fps=50))
    assert [row["length"] for row in read.episodes] == [100, 50]
    assert read.tasks == ["walk", "run"]
    assert np.array_equal(read.episode(1)[f"{TACTILE}torso.pressure"], physical(other.tables[0], "pressure")[::2])
    intervals = [Interval(0.5, 1.0, "x", "run.mcap"), Interval(0, 1, None, str(made.path))]
    wanted = LearningSet(fps=50, intervals=intervals)
    converted = convert_to_learning_set([made.path, other.path], tmp_path / "part", wanted)
    read = read_dataset(converted.path)
    assert [(row["length"], row["tasks"]) for row in read.episodes] == [(50, ["walk"]), (25, ["x"])]


@pytest.mark.thorough
def test_a_change_of_structure_is_refused(tmp_path: Path) -> None:
    small, large = fake_structure(1, 1), fake_structure(2, 1)
    tables = [
        table_of("torso", small, range(100)),
        table_of("torso", large, range(150, 250), seed=2),
        table_of("torso", small, range(300, 400), seed=3),
    ]
    made = write(tmp_path / "walk.mcap", *tables)
    with pytest.raises(ConfigurationError, match=r"changes in it, at 1\.500 s, 3\.000 s: choose a part"):
        learn(made)
    with pytest.raises(ConfigurationError, match=r"changes in it, at 1\.500 s, 3\.000 s"):
        learn(made, LearningSet(gap_s=0.2))
    with pytest.raises(ConfigurationError, match=r"changes in the episode 0\.5\.\.2, at 1\.500 s"):
        learn(made, LearningSet(intervals=[Interval(0.5, 2)]))
    assert sorted(each.name for each in tmp_path.iterdir()) == ["walk.mcap"]
    part = convert_to_learning_set([made.path], tmp_path / "part", LearningSet(50), start_s=1.4, end_s=2.6)
    assert read_dataset(part.path).features[f"{TACTILE}torso.pressure"].shape == (50, 20)


# -- what is joined -----------------------------------------------------------------------------------------------


@pytest.mark.thorough
@settings(max_examples=200, deadline=None)
@given(
    times=st.lists(st.integers(0, 60), min_size=1, max_size=12).map(sorted),
    at=st.lists(st.integers(-5, 70), min_size=1, max_size=8),
    limit=st.integers(0, 20),
    match=st.sampled_from(["previous", "nearest"]),
)
def test_what_is_matched(times: list[int], at: list[int], limit: int, match: Literal["previous", "nearest"]) -> None:
    found = matched(np.array(times), np.array(at), match, limit)
    for moment, row in zip(at, found.tolist(), strict=True):
        near = [time for time in times if abs(time - moment) <= limit and (match == "nearest" or time <= moment)]
        if not near:
            assert row == -1
        else:
            assert abs(times[row] - moment) == min(abs(time - moment) for time in near)
            assert match == "nearest" or times[row] <= moment


TIME_BASES: dict[str, Callable[[float], float]] = {
    "time_s": lambda s: s,
    "time_ns": lambda s: START_NS + round(s * 1e9),
    "unix_s": lambda s: START_NS / 1e9 + s,
    "monotonic_ns": lambda s: MONOTONIC_NS + round(s * 1e9),
}


def write_joints(path: Path, base: str, seconds: Sequence[float]) -> npt.NDArray[np.float32]:
    """Two joints and their times."""
    angles = np.stack((np.sin(seconds), np.arange(len(seconds)) / 7), axis=1)
    times = [TIME_BASES[base](each) for each in seconds]
    if path.suffix == ".csv":
        lines = [f"{time!r},{a!r},{b!r}" for time, (a, b) in zip(times, angles.tolist(), strict=True)]
        path.write_text("\n".join([f"{base},hip,knee", *lines]) + "\n")
    elif path.suffix == ".parquet":
        pyarrow.parquet.write_table(pyarrow.table({base: times, "hip": angles[:, 0], "knee": angles[:, 1]}), path)
    else:
        arrays: dict[str, Any] = {base: np.array(times), "angle": angles}
        np.savez(path, **arrays)
    return angles.astype(np.float32)


@pytest.mark.thorough
@pytest.mark.parametrize("base", TIME_BASES)
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".npz"])
def test_joints_are_joined_at_their_times(made: Made, tmp_path: Path, suffix: str, base: str) -> None:
    seconds = (0.101 + np.arange(170) / 100).tolist()
    angles = write_joints(tmp_path / f"joints{suffix}", base, seconds)
    read = learn(made, LearningSet(fps=25, joins=[Join("observation.state", tmp_path / f"joints{suffix}")]))
    rows_s = seconds[0] + np.arange(len(read.features["index"])) / 25
    assert rows_s[-1] <= seconds[-1] + 1 / 25
    newest = np.searchsorted(seconds, rows_s + 1e-6, "right") - 1
    assert np.array_equal(read.features["observation.state"], angles[newest])
    told = read.info["features"]["observation.state"]
    names = ["angle[0]", "angle[1]"] if suffix == ".npz" else ["hip", "knee"]
    assert told == {"dtype": "float32", "shape": [2], "names": names}


def test_one_column_is_a_number(made: Made, tmp_path: Path) -> None:
    angles = write_joints(tmp_path / "joints.csv", "time_s", (np.arange(200) / 100).tolist())
    join = join_of(f"action={tmp_path / 'joints.csv'}:knee")
    read = learn(made, LearningSet(fps=50, joins=[join], match="nearest", within_s=0.001))
    assert read.features["action"].shape == (100,)
    assert np.array_equal(read.features["action"], angles[::2, 1])


def write_images(folder: Path, times_s: Sequence[float], size: tuple[int, int] = (6, 4)) -> Path:
    """PNG files and a CSV of them."""
    folder.mkdir()
    lines = ["time_s,file"]
    for number, time_s in enumerate(times_s):
        Image.new("RGB", size, (number, 255 - number, 7)).save(folder / f"{number}.png")
        lines.append(f"{time_s!r},{number}.png")
    (folder / "top.csv").write_text("\n".join(lines) + "\n")
    return folder / "top.csv"


def test_images_and_rows_at_their_times(made: Made, tmp_path: Path) -> None:
    generator = np.random.default_rng(3)
    times_s = (0.05 + np.arange(40) / 25 + generator.uniform(-0.004, 0.004, 40)).tolist()
    path = write_images(tmp_path / "top", times_s)
    feature = "observation.images.top"
    read = learn(made, LearningSet(fps=25, joins=[Join(feature, path)], at=feature))
    images = read.features[feature]
    assert [Image.open(io.BytesIO(png)).getpixel((5, 3)) for png in images] == [(n, 255 - n, 7) for n in range(40)]
    assert read.info["features"][feature]["shape"] == [4, 6, 3]
    told = read.statistics[feature]
    assert np.ravel(told["mean"]) == pytest.approx(np.array([19.5, 255 - 19.5, 7]) / 255, abs=1e-6)
    assert told["count"] == [40]
    newest = np.floor(np.array(times_s) * 100 + 1e-6).astype(int)
    assert np.array_equal(read.features[f"{TACTILE}torso.pressure"], physical(made.tables[0], "pressure")[newest])
    late_s = np.array(times_s) - newest / 100
    assert read.features[f"{TACTILE}torso.age"] == pytest.approx(late_s, abs=1e-6)


# -- what is wrong ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", ["time_ns", "monotonic_ns"])
def test_what_is_joined_finds_its_frames_over_a_step_of_the_wall_clock(tmp_path: Path, base: str) -> None:
    hour_ns = 3600 * 10**9
    source = MadeSource([])
    source.clock = [
        {"monotonic_ns": MONOTONIC_NS + ns, "realtime_ns": START_NS + ns + step_ns, "log_time_ns": START_NS + ns}
        for ns, step_ns in ((0, 0), (10**9, hour_ns), (2 * 10**9, hour_ns))
    ]
    seconds = [0.25, 1.5]
    stepped = {"time_ns": [0, hour_ns], "monotonic_ns": [0, 0]}[base]
    times = [int(TIME_BASES[base](each)) + later_ns for each, later_ns in zip(seconds, stepped, strict=True)]
    arrays: dict[str, Any] = {base: np.array(times), "angle": np.zeros((2, 1))}
    np.savez(tmp_path / "joints.npz", **arrays)
    rows = Joined(Join("action", tmp_path / "joints.npz", ()))
    assert rows.times_ns(source, is_only=True).tolist() == [START_NS + round(each * 1e9) for each in seconds]


def joined(tmp_path: Path, text: str, name: str = "joints.csv", feature: str = "action") -> LearningSet:
    (tmp_path / name).write_text(text)
    return LearningSet(joins=[Join(feature, tmp_path / name)])


def test_times_that_do_not_overlap(made: Made, tmp_path: Path) -> None:
    words = r"no time in it has all the data .* torso from 0\.000 to 1\.990 s, .*joints\.csv from 50\.000 to 51\.000 s"
    with pytest.raises(ConfigurationError, match=words):
        learn(made, joined(tmp_path, "time_s,a\n50,1\n51,2\n"))
    with pytest.raises(ConfigurationError, match=r"no time in the episode 5\.\.6 has all the data"):
        learn(made, LearningSet(intervals=[Interval(5, 6)]))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no line with numbers in it"),
        ("a\n1\n", "one column must have the time, as one of: time_ns, unix_s, monotonic_ns, time_s"),
        ("a,b\n1,2\n", "one column must have the time"),
        ("time_s,time_ns,a\n1,2,3\n", "one column must have the time"),
        ("time_s,a\n", "no line with numbers in it"),
        ("time_s\n1\n", "no columns of numbers"),
        ("time_s,a\n0,1\n0.5,2,3\n", "line 3: 3 cells instead of 2"),
        ("time_s,a,b\n0,1,x\n1,1,x\n", "b is not numbers; choose columns: FEATURE=FILE:COLUMN"),
        ("time_s,a,b\n0,1,x\n1,1,1\n", "line 2: 'x' is no number"),
        ("time_s,a\n0,1\n1,nan\n", "a is not a finite number in row 2"),
        ("time_s,a\n0,1\nx,1\n", "line 3: 'x' is no number"),
        ("time_s,a\nnan,1\n1,1\n", "time_s is not numbers"),
        ("time_s,a\n0,1\n1,1\n0.5,1\n", "time goes back after row 2"),
        ("time_s,a\n0,1\n0.4,1\n0.8,1\n", r"nothing within 0\.0333 s at or before .* the first at 0\.067 s of"),
        ("time_s,file\n0,film.mp4\n1,film.mp4\n", "videos are not joined: give a PNG file for each time"),
        ("time_s,file\n0,joints.csv\n", "images are joined as PNG files with 8 bits of red, green"),
    ],
)
def test_files_that_cannot_be_joined_are_one_line(made: Made, tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as raised:
        learn(made, joined(tmp_path, text))
    assert "\n" not in str(raised.value)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["joints.csv", "walk.mcap"]


@pytest.mark.parametrize(("name", "begin"), [("joints.npz", "PK"), ("joints.parquet", "PAR1"), ("joints.npy", "a\0")])
def test_what_is_damaged_is_one_line(made: Made, tmp_path: Path, name: str, begin: str) -> None:
    with pytest.raises(ConfigurationError, match=name) as raised:
        learn(made, joined(tmp_path, f"{begin}time_s,a\n0,1\n", name))
    assert "\n" not in str(raised.value)


def test_columns_that_are_not_there(made: Made, tmp_path: Path) -> None:
    (tmp_path / "joints.csv").write_text("time_s,a\n0,1\n1,1\n")
    with pytest.raises(ConfigurationError, match="no column 'b'; there are: time_s, a"):
        learn(made, LearningSet(joins=[join_of(f"action={tmp_path}/joints.csv:b")]))


def test_a_camera_of_another_rate(made: Made, tmp_path: Path) -> None:
    feature = "observation.images.top"
    joins = [Join(feature, write_images(tmp_path / "slow", (np.arange(20) / 20).tolist()))]
    with pytest.raises(ConfigurationError, match="20 times a second, but the set has 30: --fps 20"):
        learn(made, LearningSet(joins=joins, at=feature))
    times_s = np.delete(np.arange(40) / 30, 20).tolist()
    joins = [Join(feature, write_images(tmp_path / "missed", times_s))]
    with pytest.raises(ConfigurationError, match=r"a time is missing after 0\.633 s: end an episode there"):
        learn(made, LearningSet(joins=joins, at=feature))
    intervals = [Interval(0, 0.64), Interval(0.7, 1.9)]
    read = learn(made, LearningSet(joins=joins, at=feature, intervals=intervals))
    assert [row["length"] for row in read.episodes] == [20, 19]


def test_images_of_different_sizes(made: Made, tmp_path: Path) -> None:
    path = write_images(tmp_path / "top", (np.arange(30) / 30).tolist())
    Image.new("RGB", (6, 5)).save(tmp_path / "top" / "20.png")
    with pytest.raises(ConfigurationError, match=r"20\.png: 6 x 5: not as large as the first image"):
        learn(made, LearningSet(joins=[Join("observation.images.top", path)]))
    good = (tmp_path / "top" / "0.png").read_bytes()
    (tmp_path / "top" / "20.png").write_bytes(good)
    (tmp_path / "top" / "0.png").write_bytes(good[:-20])
    with pytest.raises(ConfigurationError, match=r"0\.png: cut off"):
        learn(made, LearningSet(joins=[Join("observation.images.top", path)]))
    (tmp_path / "top" / "0.png").write_bytes(good[:45] + bytes(len(good) - 65) + good[-20:])
    with pytest.raises(ConfigurationError, match="a PNG file is damaged"):
        learn(made, LearningSet(joins=[Join("observation.images.top", path)]))


def test_several_recordings_that_do_not_fit(made: Made, tmp_path: Path) -> None:
    structure = fake_structure(2, 2)
    others = write(tmp_path / "run.mcap", table_of("torso", structure, range(100)))
    with pytest.raises(ConfigurationError, match=r"run\.mcap: a driver has another structure from 0.000 s on"):
        learn([made.path, others.path])
    arm = write(tmp_path / "arm.mcap", table_of("arm", structure, range(100)))
    with pytest.raises(ConfigurationError, match=r"arm.mcap: other drivers than the first recording \(arm\)"):
        learn([made.path, arm.path])
    with pytest.raises(ConfigurationError, match=r"joints.csv: time_s is of one recording: with several, give time_ns"):
        learn([made.path, others.path], joined(tmp_path, "time_s,a\n0,1\n2,1\n"))
    with pytest.raises(ConfigurationError, match=r"the episode 0\.\.1 does not name its recording"):
        learn([made.path, others.path], LearningSet(intervals=[Interval(0, 1)]))
    with pytest.raises(ConfigurationError, match=r"of 'x': that is not the name of one of the recordings"):
        learn(made, LearningSet(intervals=[Interval(0, 1, None, "x")]))


def test_clocks_that_are_not_told(tmp_path: Path) -> None:
    made = write(tmp_path / "walk.mcap", table_of("torso", fake_structure(1, 1), range(100)))
    with pytest.raises(ConfigurationError, match=r"has no readings of clocks: .*joints.csv needs time_ns or unix_s"):
        learn(made, joined(tmp_path, f"monotonic_ns,a\n{MONOTONIC_NS},1\n"))


def test_nothing_to_learn_from(tmp_path: Path) -> None:
    pose = MadeTable(generation_of_service("pose", {"angle": ("f4", 3)}), {}, 10)
    with pytest.raises(ConfigurationError, match="no frames of a driver are in it"):
        learn(write(tmp_path / "pose.mcap", pose))
    made = write(tmp_path / "both.mcap", pose, table_of("torso", fake_structure(1, 1), range(100)))
    converted = convert_to_learning_set([made.path], tmp_path / "set", LearningSet(fps=200))
    assert converted.notes == [
        f"{made.path}: torso publishes 100 frames a second: at 200 rows a second some are there twice",
        f"{made.path}: pose is left out: it has no sensors",
    ]
    read_dataset(converted.path)


class SetBack(MadeTable):
    """A driver whose recorder's clock was set back by some time after the first half."""

    shift_ns = 0

    def _made(self, name: str, numbers: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        made = super()._made(name, numbers)
        return made - self.shift_ns * (numbers >= self.n // 2) if name == "frames/time_ns" else made


def test_a_clock_that_was_set_back(tmp_path: Path) -> None:
    whole = table_of("torso", fake_structure(1, 1), range(100))
    table = SetBack(whole.origin, whole.columns, 100)
    table.shift_ns = 3 * 10**7  # a recorder that was held up
    read = learn(write(tmp_path / "held.mcap", table), LearningSet(fps=100))
    assert read.features[f"{TACTILE}torso.age"].min() >= 0
    assert read.info["total_frames"] == 97
    table.shift_ns = 3 * 10**8
    write(tmp_path / "back.mcap", table)
    with pytest.raises(BadRecording, match="torso: the clock was set back while it was recorded"):
        convert_to_learning_set([tmp_path / "back.mcap"], None, LearningSet())


@pytest.mark.parametrize("text", ["", "1", "1..", "..2", "2..1", "1..1", "-1..2", "a..b", "0..inf", "0..nan"])
def test_what_is_no_interval(text: str) -> None:
    with pytest.raises(ConfigurationError, match=r"is not START\.\.END in seconds"):
        interval_of(text)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("begin,end\n1,2\n", "its first line must be start_s,end_s"),
        ("", "its first line must be start_s,end_s"),
        ("start_s,end_s,x\n1,2,3\n", "its first line must be start_s,end_s"),
        ("start_s,end_s\n1,2\n5,4\n", "line 3 is not START..END"),
        ("start_s,end_s\n1\n", "line 2 is not START..END"),
    ],
)
def test_what_is_no_file_of_episodes(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(ConfigurationError, match=words):
        read_intervals(tmp_path / "x.csv")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: join_of("joints.csv"), "is not FEATURE=FILE"),
        (lambda: join_of("action="), "is not FEATURE=FILE"),
        (lambda: LearningSet(fps=0), "that is no learning set"),
        (lambda: LearningSet(joins=[Join("a/b", Path("x"))]), "cannot be the name of a joined feature"),
        (lambda: LearningSet(joins=[Join("index", Path("x"))]), "cannot be the name of a joined feature"),
        (lambda: LearningSet(joins=[Join("a", Path("x")), Join("a", Path("y"))]), "or is there twice"),
        (lambda: LearningSet(at="top"), "rows at the times of 'top': that is not joined"),
    ],
)
def test_what_is_no_learning_set(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        make()


def test_a_recording_that_changes_while_it_is_read(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    written = features.Frames.__init__

    def change(frames: features.Frames, table: Table, times_ns: npt.NDArray[np.int64], window: int) -> None:
        written(frames, table, times_ns + 1, window)

    monkeypatch.setattr(features.Frames, "__init__", change)
    with pytest.raises(BadRecording, match="torso: the recording changed while it was read"):
        learn(made)
    assert list(made.path.parent.iterdir()) == [made.path]
    monkeypatch.undo()
    frames = features.Frames(made.tables[0], np.zeros(300, np.int64), 1)
    with pytest.raises(BadRecording, match="torso: the recording changed while it was read"):
        frames.take(np.array([250]))


def test_features_of_one_name(made: Made, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=f"two features are both '{TACTILE}torso.age'"):
        learn(made, joined(tmp_path, "time_s,a\n0,1\n0.01,2\n", feature=f"{TACTILE}torso.age"))


def test_episodes_that_overlap(made: Made) -> None:
    with pytest.raises(ConfigurationError, match=r"the episodes 0\.\.1 and 0\.5\.\.1\.5 overlap"):
        learn(made, LearningSet(intervals=[Interval(0.5, 1.5), Interval(0, 1)]))


def test_an_episode_that_is_not_all_there_is_told(made: Made, tmp_path: Path) -> None:
    wanted = LearningSet(fps=50, intervals=[Interval(1, 5)])
    converted = convert_to_learning_set([made.path], tmp_path / "set", wanted)
    (note,) = converted.notes
    assert note.startswith(f"{made.path}: the episode 1..5 begins 0.000 s later and ends 3.0")
    assert read_dataset(converted.path).info["total_frames"] == 50


# -- large ones ---------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_many_files_and_batches_are_the_same_set(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    intervals = [Interval(n / 5, (n + 1) / 5) for n in range(9)]
    whole = learn(made, LearningSet(fps=50, window=3, intervals=intervals))
    monkeypatch.setattr(dataset, "_FILE_MB", 0)
    monkeypatch.setattr(dataset, "_CHUNK_FILES", 4)
    monkeypatch.setattr(export, "_BATCH_BYTES", 3000)
    converted = convert_to_learning_set(
        [made.path], tmp_path / "parts", LearningSet(fps=50, window=3, intervals=intervals)
    )
    parts = read_dataset(converted.path)
    assert len(list(converted.path.glob("data/chunk-002/*"))) == 1
    for name, rows in whole.features.items():
        assert np.array_equal(rows, parts.features[name]), name
    for name, of in whole.statistics.items():
        for what, numbers in of.items():
            np.testing.assert_allclose(parts.statistics[name][what], numbers, rtol=1e-6, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=6),
    kept=st.integers(1, 40),
    seed=st.integers(0, 1 << 30),
)
def test_statistics_of_parts_are_those_of_the_whole(lengths: list[int], kept: int, seed: int) -> None:
    generator, total = np.random.default_rng(seed), sum(lengths)
    rows = (generator.normal(1e4, 3, (total, 2, 3))).astype(np.float32)
    least, features._LEAST_ROWS = features._LEAST_ROWS, 1
    try:
        each = Statistics((2, 3), np.float32, total, kept * 24)
    finally:
        features._LEAST_ROWS = least
    for part in np.split(rows, np.cumsum(lengths)[:-1]):
        each.add(part, Moments.of(part))
    told, exact = each.result(), rows.astype(np.float64)
    np.testing.assert_allclose(told["mean"], exact.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(told["std"], exact.std(axis=0), rtol=1e-6, atol=1e-6)
    assert np.array_equal(told["min"], exact.min(axis=0))
    assert np.array_equal(told["max"], exact.max(axis=0))
    step = -(-total // kept)
    np.testing.assert_allclose(told["q50"], np.quantile(exact[::step], 0.5, axis=0), rtol=1e-6)


@pytest.mark.thorough
def test_memory_does_not_grow_with_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "_BATCH_BYTES", 1 << 16)
    monkeypatch.setattr(features, "_SAMPLE_ROWS", 40)
    peaks = []
    for n in (200, 1000):
        made = write(tmp_path / f"{n}.mcap", table_of("torso", fake_structure(2, 8), range(n)))
        tracemalloc.start()
        convert_to_learning_set([made.path], tmp_path / f"{n}.set", LearningSet(fps=50, window=4))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.6 * peaks[0]


def test_nothing_is_left_of_one_that_was_stopped(made: Made, tmp_path: Path) -> None:
    asked: list[bool] = []

    def is_stopped() -> bool:
        asked.append(True)
        return len(asked) > 10

    with pytest.raises(KeyboardInterrupt):
        convert_to_learning_set([made.path], tmp_path / "set", LearningSet(), is_stopped=is_stopped)
    assert list(tmp_path.iterdir()) == [made.path]
    (tmp_path / "set").mkdir()
    with pytest.raises(FileExistsError):
        convert_to_learning_set([made.path], tmp_path / "set", LearningSet())


# -- forms that stock policies read ---------------------------------------------------------------------------------


def good(table: MadeTable, rows: Sequence[int]) -> npt.NDArray[Any]:
    """(rows, sensors) of pressure, 0 where the status is not good."""
    return np.where(status_of(table, "pressure") == 0, physical(table, "pressure"), 0)[rows]


ROWS = [int(row / 30 * 100 + 1e-6) for row in range(60)]
ONE_TYPE = Selection(sensors=SensorChoice(types=("pressure",)))


def test_touch_as_state_is_beside_the_joints(made: Made, tmp_path: Path) -> None:
    seconds = np.arange(200) / 100
    (tmp_path / "joints.csv").write_text(
        "time_s,hip\n" + "".join(f"{second:.3f},{second * 2:.3f}\n" for second in seconds)
    )
    joins = [Join("observation.state", tmp_path / "joints.csv")]
    read = learn(made, LearningSet(form="state", joins=joins), selection=ONE_TYPE)
    values = good(made.tables[0], ROWS)[-len(read.features["observation.state"]) :]
    state = read.features["observation.state"]
    names = read.info["features"]["observation.state"]["names"]
    module = "touch.board_7.triangle_0"
    assert names == [
        "hip",
        f"{module}.sum.vel",
        f"{module}.peak.vel",
        *(n.replace("_0", "_1") for n in names[1:3]),
        "touch.age_s.vel",
    ]
    assert not any(name.startswith(TACTILE) for name in read.features)
    assert state[:, 1] == pytest.approx(values[:, :10].sum(axis=1), rel=1e-5)
    assert state[:, 4] == pytest.approx(values[:, 10:].max(axis=1))
    assert (state[:, 5] < 0.02).all()
    each = learn(
        [made.path.rename(_folder(tmp_path) / "again.mcap")],
        LearningSet(form="state", numbers="taxel"),
        selection=ONE_TYPE,
    )
    assert np.array_equal(each.features["observation.state"][:, :20], good(made.tables[0], ROWS))


def test_touch_as_images_has_the_colours_of_its_values(made: Made) -> None:
    read = learn(made, LearningSet(form="images", size=(24, 48)), selection=ONE_TYPE)
    images = read.features["observation.images.touch"]
    layout = SkinLayout(("torso",), (made.tables[0].structure,))  # type: ignore[arg-type]
    expected = TouchImage(layout, "pressure", np.arange(20), 24, 48, Colours("grey", 0, 255))
    values = good(made.tables[0], ROWS)
    for row in (0, 17, 59):
        assert np.array_equal(np.asarray(Image.open(io.BytesIO(images[row]))), expected.of(values[row]))
    assert read.info["features"]["observation.images.touch"]["shape"] == [24, 48, 3]


def test_images_as_videos_are_those_images_nearly(made: Made, tmp_path: Path) -> None:
    intervals = [Interval(0, 1), Interval(1.2, 1.8)]
    wanted = LearningSet(form="images", size=(48, 96), intervals=intervals)
    exact = learn(made, wanted, selection=ONE_TYPE)
    converted = convert_to_learning_set([made.path], tmp_path / "v", replace(wanted, video=True), ONE_TYPE)
    videos = read_dataset(converted.path).features["observation.images.touch"]
    images = [np.asarray(Image.open(io.BytesIO(png))) for png in exact.features["observation.images.touch"]]
    assert np.abs(videos.astype(int) - np.array(images)).mean() < 12
    with pytest.raises(ConfigurationError, match="videos of 95 x 48: give even sizes"):
        convert_to_learning_set([made.path], tmp_path / "odd", replace(wanted, size=(48, 95), video=True), ONE_TYPE)
    assert not (tmp_path / "odd").exists()


def test_touch_as_points_has_places_and_forces(made: Made) -> None:
    read = learn(made, LearningSet(form="points"))
    assert read.features[f"{TACTILE}points_pressure"].shape == (60, 20, 6)
    assert read.features[f"{TACTILE}points_temperature"].shape == (60, 4, 6)


def test_forms_that_cannot_be_made_are_refused(made: Made) -> None:
    with pytest.raises(ConfigurationError, match="one sample in a row: leave out --window"):
        learn(made, LearningSet(form="state", window=2))
    with pytest.raises(ConfigurationError, match="temperature has no range of values of its own: give --range"):
        learn(made, LearningSet(form="images"))


def test_marks_begin_and_end_episodes(tmp_path: Path) -> None:
    marks = [(0.2, "pick"), (0.8, "end"), (1.0, ""), (1.5, "drop")]
    source = MadeSource([table_of("torso", fake_structure(1, 2, dtype="<u2"), range(200))])
    source.events = [
        {"event": "mark", "service": "", "time_ns": 0, "text": text, "log_time_ns": START_NS + round(at_s * 1e9)}
        for at_s, text in marks
    ]
    path = tmp_path / "day.mcap"
    write_recording(source, path)
    read = learn([path], LearningSet(fps=10, by_marks=True, task="else"))
    assert [(each["tasks"], each["length"]) for each in read.episodes] == [(["pick"], 6), (["else"], 5), (["drop"], 5)]
    with pytest.raises(ConfigurationError, match="either at marks or listed"):
        LearningSet(by_marks=True, intervals=[Interval(0, 1)])
    source.events, none = [], _folder(tmp_path) / "none.mcap"
    write_recording(source, none)
    with pytest.raises(ConfigurationError, match="no mark in it begins an episode"):
        learn([none], LearningSet(by_marks=True))


def _folder(tmp_path: Path) -> Path:
    """Another one, for another set."""
    (tmp_path / "more").mkdir()
    return tmp_path / "more"


def test_a_set_becomes_a_recording_again(made: Made, tmp_path: Path) -> None:
    set_of_all = convert_to_learning_set([made.path], tmp_path / "set", LearningSet(), ONE_TYPE).path
    file = tmp_path / "map.toml"
    with contextlib.closing(open_source(set_of_all)) as source:
        file.write_text(guess(source))
    back = convert_foreign(set_of_all, tmp_path / "back.mcap", "mcap", file).path
    with skinware.recording.open(back) as recording:
        (driver,) = recording.drivers
        series = recording[driver].read()
        assert np.array_equal(series.physical("pressure"), physical(made.tables[0], "pressure")[ROWS])
        assert np.allclose(np.diff(series.acquired_ns), 1e9 / 30, atol=1e5)
