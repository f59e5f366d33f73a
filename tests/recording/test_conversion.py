"""Recordings in other formats, read by numpy, h5py, pyarrow and csv: complete and true, whatever the file is like."""

from __future__ import annotations

import contextlib
import csv
import json
import math
import tracemalloc
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pyarrow.parquet
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import skinware.recording
from skinware import Structure
from skinware.conversion import Selection, convert, rows
from skinware.conversion.converting import FORMATS
from skinware.conversion.rows import leaves
from skinware.conversion.tables import ArrayFormat, RecordedSource, Table
from skinware.errors import BadRecording, ConfigurationError
from skinware.geometry import Geometry
from skinware.recording import Recording
from skinware.tactile.regions import Region, Regions, SensorChoice
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure
from tests.recording.damaging import frames_of, with_a_bad_chunk
from tests.recording.made import MadeSource, MadeTable, generation_of_service, made_recording
from tests.recording.rig import recording

ARRAYS = ("npz", "parquet", "hdf5")


def whole(table: Table) -> dict[str, npt.NDArray[Any]]:
    """All arrays of a table."""
    blocks = list(table.blocks(table.arrays))
    return {name: np.concatenate([block[name] for block in blocks]) for name in table.arrays}


def read_array(path: Path, table: str, name: str, each: ArrayFormat) -> npt.NDArray[Any]:
    """Read an array of a table with the library of the file's format."""
    if path.is_dir():
        return from_parquet(read_parquet(path / f"{table}.parquet"), name, each)
    with path.open("rb") as stream:
        magic = stream.read(2)
    if magic == b"PK":
        with np.load(path) as arrays:
            return np.asarray(arrays[f"{table}/{name}"])
    with h5py.File(path) as file:
        return np.asarray(file[f"{table}/{name}"])


def from_parquet(rows: pyarrow.Table, name: str, each: ArrayFormat) -> npt.NDArray[Any]:
    array = np.zeros((len(rows), *each.shape), each.dtype)
    for leaf in leaves(each):
        items = rows[leaf.name(name)].combine_chunks()
        items = items.flatten() if leaf.shape else items
        plain = np.frombuffer(items.buffers()[1], leaf.dtype)[items.offset : items.offset + len(items)]
        field = array
        for part in leaf.path:
            field = field[part]
        field[...] = plain.reshape(field.shape)
    return array


def check_arrays(path: Path, table: Table) -> None:
    """A file has all arrays of a table, byte by byte."""
    for name, array in whole(table).items():
        read = read_array(path, table.name, name, table.arrays[name])
        assert (read.shape, read.dtype, read.tobytes()) == (array.shape, array.dtype, array.tobytes()), name


@pytest.mark.thorough
@pytest.mark.parametrize("format_name", ARRAYS)
def test_arrays_are_those_of_the_recording(path: Path, tmp_path: Path, format_name: str) -> None:
    converted = convert(path, tmp_path / "x", format_name)
    assert converted.frames["torso"] == 75
    assert converted.notes == []
    with contextlib.closing(RecordedSource(path, 0, None)) as source:
        assert {table.name for table in source.tables} == {"arm", "pose", "torso"}
        for table in source.tables:
            check_arrays(tmp_path / "x", table)


def test_a_recording_written_again_is_the_same(path: Path, tmp_path: Path) -> None:
    again = convert(path, tmp_path / "again.mcap", "mcap")
    assert again.notes == []
    assert frames_of(again.path) == frames_of(path)
    with skinware.recording.open(path) as old, skinware.recording.open(again.path) as new:
        assert new.is_whole
        assert (new.start_ns, new.end_ns) == (old.start_ns, old.end_ns)
        assert sorted(map(str, new.events)) == sorted(map(str, old.events))
        assert new.clock == old.clock
        assert np.array_equal(new["torso"].read().time_s, old["torso"].read().time_s)
        assert new["torso"].structure == old["torso"].structure
        assert [g.head for g in new["pose"].generations] == [g.head for g in old["pose"].generations]


@pytest.fixture
def placed(tmp_path: Path) -> tuple[Path, MadeTable]:
    """A recording of a driver with places."""
    structure = fake_structure(2, 2, dtype="<u2")
    n = structure.n_sensors
    unknown = Geometry.unknown(["x"] * n, structure.sensor_uid)
    unknown.position_m[:] = np.random.default_rng(1).random((n, 3))
    unknown.frame[:] = "chest"
    file = tmp_path / "placed.mcap"
    return file, made_recording(file, structure.replace(geometry=unknown), 40)


def test_what_numpy_reads(placed: tuple[Path, MadeTable], tmp_path: Path) -> None:
    file, table = placed
    convert(file, tmp_path / "x.npz", "npz")
    structure = table.structure
    assert structure is not None
    with np.load(tmp_path / "x.npz") as arrays:
        assert np.array_equal(arrays["torso/columns/values"], table.columns["values"])
        assert np.array_equal(arrays["torso/columns/status"], table.columns["status"])
        assert np.array_equal(arrays["torso/columns/module_time_ns"], table.columns["module_time_ns"])
        for name in ("pressure", "temperature"):
            physical = structure.physical(table.columns["values"], name)
            assert np.array_equal(arrays[f"torso/physical/{name}"], physical)
            assert arrays[f"torso/physical/{name}"].dtype == physical.dtype
        assert arrays["torso/frames/sequence"].tolist() == list(range(1, 41))
        check_sensors(structure, {name[14:]: arrays[name] for name in arrays if name.startswith("torso/sensors/")})
        told = json.loads(str(arrays["recording"]))
    assert told["tables"][0]["units"]["physical/pressure"] == "counts"


def test_what_hdf5_readers_read(placed: tuple[Path, MadeTable], tmp_path: Path) -> None:
    file, table = placed
    convert(file, tmp_path / "x.h5", "hdf5")
    structure = table.structure
    assert structure is not None
    with h5py.File(tmp_path / "x.h5") as opened_file:
        torso = opened_file["torso"]
        assert np.array_equal(torso["columns/values"], table.columns["values"])
        assert np.array_equal(torso["physical/pressure"], structure.physical(table.columns["values"], "pressure"))
        assert torso["physical/pressure"].attrs["unit"] == "counts"
        assert torso["physical/temperature"].attrs["unit"] == "degC"
        check_sensors(structure, {name: np.array(array) for name, array in torso["sensors"].items()})


def read_parquet(file: Path) -> pyarrow.Table:
    with file.open("rb") as stream:  # given a path, pyarrow may close it later
        return pyarrow.parquet.read_table(stream)


def test_what_parquet_readers_read(placed: tuple[Path, MadeTable], tmp_path: Path) -> None:
    file, table = placed
    convert(file, tmp_path / "x", "parquet")
    structure = table.structure
    assert structure is not None
    rows = read_parquet(tmp_path / "x" / "torso.parquet")
    assert np.array_equal(rows["columns/values"].to_pylist(), table.columns["values"])
    assert np.array_equal(
        rows["physical/pressure"].to_pylist(), structure.physical(table.columns["values"], "pressure")
    )
    assert rows.schema.field("physical/pressure").metadata == {b"unit": b"counts"}
    sensors = read_parquet(tmp_path / "x" / "torso.sensors.parquet")
    check_sensors(structure, {name: sensors[name].to_numpy() for name in sensors.column_names})


def test_what_readers_of_texts_read(placed: tuple[Path, MadeTable], tmp_path: Path) -> None:
    file, table = placed
    converted = convert(file, tmp_path / "x", "csv")
    structure = table.structure
    assert structure is not None
    assert converted.notes == [f"{tmp_path}/x: counters, histograms and events are left out: csv does not hold them"]

    def lines(name: str) -> list[list[str]]:
        with (tmp_path / "x" / f"torso.{name}.csv").open(newline="") as stream:
            return list(csv.reader(stream))

    head, *rows = lines("values")
    assert head[:2] == ["time_s", "pressure 0x3e8"]
    assert np.array_equal(np.array(rows)[:, 1:].astype(int), table.columns["values"])
    assert np.allclose(np.array(rows)[:, 0].astype(float), np.arange(40) / 100, atol=1e-9)
    head, *rows = lines("temperature")
    uids = [f"{uid:#x}" for uid in structure.sensor_uid[structure.index("temperature")].tolist()]
    assert head[1:] == uids
    numbers = np.array(rows)[:, 1:].astype(np.float32)
    assert np.array_equal(numbers, structure.physical(table.columns["values"], "temperature"))
    head, *rows = lines("sensors")
    columns = {name: np.array([row[number] for row in rows]) for number, name in enumerate(head)}
    columns["uid"] = np.array([int(uid, 16) for uid in columns["uid"]])
    check_sensors(structure, columns | {name: columns[name].astype(float) for name in ("x_m", "y_m", "z_m", "scale")})
    assert lines("module_time_ns")[0][1] == "board 7, triangle 0"
    assert ",".join(lines("frames")[0]) == "time_s,time_ns,generation,sequence,acquired_ns,published_ns,flags"


def check_sensors(structure: Structure, told: dict[str, npt.NDArray[Any]]) -> None:
    """What a file tells of the sensors is what the structure has."""
    as_texts = {name: [_text(each) for each in told[name].tolist()] for name in ("name", "type", "unit", "patch")}
    assert as_texts["name"] == [structure.sensor_name(position) for position in range(structure.n_sensors)]
    assert [structure.type(name).id for name in as_texts["type"]] == structure.sensor_type.tolist()
    assert as_texts["unit"] == [structure.type(name).unit for name in as_texts["type"]]
    assert as_texts["patch"] == [structure.patch_names[patch] for patch in structure.sensor_patch.tolist()]
    assert told["uid"].tolist() == structure.sensor_uid.tolist()
    assert told["scale"].tolist() == [structure.type(name).scale for name in as_texts["type"]]
    assert structure.geometry is not None
    for axis, letter in enumerate("xyz"):
        assert np.array_equal(told[f"{letter}_m"], structure.geometry.position_m[:, axis])


def _text(each: str | bytes) -> str:
    return each.decode() if isinstance(each, bytes) else each


# -- what is selected ---------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_selection_has_what_was_asked_for_and_nothing_else(path: Path, tmp_path: Path) -> None:
    palm = Region("palm", "pressure", ("torso",), uid=(1000, 1001, 1024), patch=("board 9",))
    with skinware.recording.open(path) as opened_path:
        start_s, end_s = 0.3 * opened_path.duration_s, 0.7 * opened_path.duration_s
    for number, selection in enumerate(
        [
            Selection(["torso"], SensorChoice(types=["temperature"])),
            Selection(sensors=SensorChoice(patches=["board 8"], types=["pressure"])),
            Selection(sensors=SensorChoice(regions=Regions([palm]), in_regions=["palm"])),
        ]
    ):
        convert(path, tmp_path / f"{number}.mcap", "mcap", selection, start_s=start_s, end_s=end_s)
        for format_name in ARRAYS:
            part = tmp_path / f"{number}.{format_name}"
            convert(path, part, format_name, selection, start_s=start_s, end_s=end_s)
            with contextlib.closing(RecordedSource(tmp_path / f"{number}.mcap", 0, None)) as source:
                for table in source.tables:
                    check_arrays(part, table)
        with skinware.recording.open(path) as old, skinware.recording.open(tmp_path / f"{number}.mcap") as new:
            assert new.services == (("arm", "torso") if number == 1 else ("torso",))
            for name in new.services:
                series, all_of_it = new[name].read(), old[name].read(start_s=start_s, end_s=end_s)
                structure, before = series.structure, all_of_it.structure
                pairs = zip(structure.sensor_type.tolist(), structure.sensor_uid.tolist(), strict=True)
                types = {each.id: each.name for each in structure.types}
                rows = [before.position(types[type_id], uid) for type_id, uid in pairs]
                assert rows == wanted(before, number).tolist()
                for column in ("values", "status"):
                    assert np.array_equal(series.column(column), all_of_it.column(column)[:, rows])
                assert np.array_equal(series.sequence, all_of_it.sequence)
                assert len(series) > 5


def wanted(structure: Structure, number: int) -> npt.NDArray[np.int64]:
    """Positions of the sensors that each of the selections above is of."""
    pressure = structure.sensor_type == structure.type("pressure").id
    patch = np.array(structure.patch_names)[structure.sensor_patch]
    in_palm = pressure & (np.isin(structure.sensor_uid, [1000, 1001, 1024]) | (patch == "board 9"))
    return np.flatnonzero([~pressure, pressure & (patch == "board 8"), in_palm][number])


@pytest.mark.parametrize(
    ("selection", "words"),
    [
        (Selection(["leg"]), "no service 'leg'; there are: arm, pose, torso"),
        (Selection(sensors=SensorChoice(types=["force"])), "no sensor type 'force'; there are: pressure, temperature"),
        (Selection(sensors=SensorChoice(patches=["board 1"])), "no patch 'board 1'; there are: board 7, board 8"),
        (Selection(sensors=SensorChoice(in_regions=["palm"])), "no region 'palm'; there are: none"),
        (Selection(["pose"], SensorChoice(types=["pressure"])), "no sensor in it is selected"),
    ],
)
def test_what_there_is_not_is_one_line(path: Path, tmp_path: Path, selection: Selection, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as raised:
        convert(path, tmp_path / "x.npz", "npz", selection)
    assert "\n" not in str(raised.value)
    with pytest.raises(ConfigurationError, match="no sample of the selection was recorded in that time"):
        convert(path, tmp_path / "x.npz", "npz", start_s=1e5)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.thorough
@pytest.mark.parametrize("format_name", ARRAYS)
def test_drivers_that_restart_and_change_are_tables_of_their_own(tmp_path: Path, format_name: str) -> None:
    file = tmp_path / "skin.mcap"
    with recording(file) as recorder:
        structures = (fake_structure(1, 2), fake_structure(1, 2), fake_structure(2, 2, dtype="<f4"))
        for count, structure in enumerate(structures, 1):
            with FakeSkin("torso", structure) as skin:
                skin.publish(5)
                wait_until(lambda count=count: recorder.messages.get("/skin/torso/frame") == 5 * count)  # type: ignore[misc]
    converted = convert(file, tmp_path / "there", format_name)
    assert set(converted.frames) == {"torso", "torso@2"}
    with contextlib.closing(RecordedSource(file, 0, None)) as source:
        assert [len(table.generations) for table in source.tables] == [2, 1]
        for table in source.tables:
            check_arrays(tmp_path / "there", table)
    convert(file, tmp_path / "again.mcap", "mcap")
    assert frames_of(tmp_path / "again.mcap") == frames_of(file)


# -- any service --------------------------------------------------------------------------------------------------

CODES = ("u1", "<i2", "<u4", "<i8", "<u8", "<f4", "<f8", "<f2", "S3", "V5")
PLAIN = st.sampled_from(CODES)
FIELD = st.tuples(PLAIN, st.sampled_from([(), (2,), (1, 3)]))
STRUCTURES = st.lists(FIELD, min_size=1, max_size=3).map(
    lambda fields: np.dtype([(f"f{number}", *field) for number, field in enumerate(fields)])
)
COLUMN = st.tuples(st.one_of(PLAIN, STRUCTURES), st.sampled_from([(), (0,), (1,), (5,), (2, 3)]))


@pytest.mark.thorough
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    columns=st.dictionaries(st.text("abc_", min_size=1, max_size=4), COLUMN, min_size=1, max_size=3),
    n=st.integers(1, 12),
    seed=st.integers(0, 1000),
)
def test_any_columns_are_written_as_they_are(
    tmp_path_factory: pytest.TempPathFactory, columns: dict[str, Any], n: int, seed: int
) -> None:
    folder = tmp_path_factory.mktemp("any")
    generator = np.random.default_rng(seed)
    generation = generation_of_service("any", columns)
    filled = {}
    for name, (shape, dtype, _) in generation.columns.items():
        size = n * math.prod(shape) * dtype.itemsize
        if size:
            filled[name] = np.frombuffer(generator.bytes(size), dtype).reshape(n, *shape)
    table = MadeTable(generation, filled, n)
    for format_name in ARRAYS:
        FORMATS[format_name].write(MadeSource([table]), folder / format_name)
        check_arrays(folder / format_name, table)
    FORMATS["mcap"].write(MadeSource([table]), folder / "mcap")
    with contextlib.closing(RecordedSource(folder / "mcap", 0, None)) as source:
        (read,) = source.tables
        assert read.arrays == table.arrays
        assert {name: array.tobytes() for name, array in whole(read).items()} == {
            name: array.tobytes() for name, array in whole(table).items()
        }
    FORMATS["csv"].write(MadeSource([table]), folder / "csv")
    for name in filled:
        part = "".join(letter if letter.isalnum() else "_" for letter in name)
        with (folder / "csv" / f"any.{part}.csv").open(newline="") as stream:
            assert len(list(csv.reader(stream))) == n + 1


@pytest.mark.parametrize(
    ("columns", "format_name", "words"),
    [
        ({".": ("u1", 2)}, "hdf5", r"HDF5 cannot hold a column '\.' of 'any'"),
        ({"a/b": ("u1", 2)}, "hdf5", "HDF5 cannot hold a column 'a/b' of 'any'"),
        ({"a.b": ("u1", 2), "a_b": ("u1", 2)}, "csv", "CSV cannot hold two columns that are both 'a_b' there"),
        ({"frames": ("u1", 2)}, "csv", "CSV cannot hold two columns that are both 'frames' there"),
        ({"a": ([("b", "u1")], 2), "a.b": ("u1", 2)}, "parquet", "Parquet cannot hold two columns that are both"),
    ],
)
def test_what_a_format_cannot_hold_is_one_line(
    tmp_path: Path, columns: dict[str, Any], format_name: str, words: str
) -> None:
    table = MadeTable(generation_of_service("any", columns), {}, 3)
    with pytest.raises(ConfigurationError, match=words) as raised:
        FORMATS[format_name].write(MadeSource([table]), tmp_path / "x")
    assert "\n" not in str(raised.value)
    assert str(raised.value).endswith("choose another format, or leave 'any' out")


def test_columns_of_a_service_are_texts_too(tmp_path: Path, path: Path) -> None:
    convert(path, tmp_path / "x", "csv", Selection(["pose"]))
    with (tmp_path / "x" / "pose.joint.csv").open(newline="") as stream:
        head, first, *_ = csv.reader(stream)
    assert head[1:] == [f"joint.name[{n}]" for n in range(4)] + [f"joint.at[{n}]" for n in range(4)]
    assert first[1:] == ["j1"] * 4 + [repr(1 / 3) + "1"] * 4
    assert (tmp_path / "x" / "pose.angle.csv").read_text().startswith('time_s,"angle[0,0]","angle[0,1]"')


# -- files that are not whole -------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_cut_or_damaged_recording_is_converted_as_far_as_it_is_whole(path: Path, tmp_path: Path) -> None:
    data = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    converted = convert(cut, tmp_path / "cut.npz", "npz")
    assert converted.notes == [f"{cut}: cut off or damaged: converted as far as it is whole"]
    assert 20 < converted.frames["torso"] < 75
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(with_a_bad_chunk(path))
    converted = convert(damaged, tmp_path / "damaged.npz", "npz")
    assert converted.notes == [f"{damaged}: 1 chunk damaged and left out"]
    convert(damaged, tmp_path / "again.mcap", "mcap")
    assert frames_of(tmp_path / "again.mcap") == frames_of(damaged)


def test_what_went_over_wires_is_said_to_be_left_out(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Recording, "wires", (object(),))
    converted = convert(path, tmp_path / "x.npz", "npz")
    assert converted.notes == [f"{path}: wires are left out: convert them to candump or pcapng"]


@pytest.mark.parametrize(
    ("contents", "words"),
    [
        (b"", "empty, so not a recording"),
        (b"PK\x03\x04 no more", r"not a recording \(not an MCAP file\)"),
        (b"\x89HDF\r\n\x1a\n", r"not a recording \(not an MCAP file\)"),
        (b"time,value\n", r"not a recording \(not an MCAP file\)"),
    ],
)
def test_what_is_no_recording_is_one_line(tmp_path: Path, contents: bytes, words: str) -> None:
    file = tmp_path / "x"
    file.write_bytes(contents)
    with pytest.raises(BadRecording, match=words) as raised:
        convert(file, None, "npz")
    assert "\n" not in str(raised.value)


@pytest.mark.thorough
@pytest.mark.parametrize("format_name", [*ARRAYS, "mcap", "csv"])
def test_memory_does_not_grow_with_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format_name: str
) -> None:
    monkeypatch.setattr(rows, "_GROUP_BYTES", 1 << 18)
    peaks = []
    for n in (200, 1200):
        file = tmp_path / f"{n}.mcap"
        made_recording(file, fake_structure(2, 8), n)
        tracemalloc.start()
        convert(file, tmp_path / f"{n}.out", format_name)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.6 * peaks[0]


def test_nothing_is_overwritten(path: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.npz").write_text("mine")
    with pytest.raises(FileExistsError):
        convert(path, tmp_path / "mine.npz", "npz")
    assert (tmp_path / "mine.npz").read_text() == "mine"
