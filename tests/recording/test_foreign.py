"""Data of other programs as recordings: each value as numpy, pyarrow or rosbags wrote it, or a clear line."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sqlite3
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_humble as ros

import skinware.recording
from skinware.cli._command import exit_status
from skinware.cli.convert import command as skin_convert
from skinware.conversion import convert_foreign
from skinware.conversion.foreign import bags, guess, open_source
from skinware.conversion.foreign.source import BLOCK_BYTES, whole
from skinware.errors import ConfigurationError
from skinware.limits import Limits
from skinware.recording import Series
from skinware.status import Status

N = 300
TIMES = np.arange(N) * 0.01
EPOCH_NS = 1_700_000_000_000_000_000
SHARED = Path(os.environ.get("SKINWARE_SHARED_DATA", Path(__file__).parents[3] / "shared" / "data"))


def imported(source: Path, changes: Callable[[str], str] = lambda text: text) -> dict[str, Series]:
    """Convert by the guessed map, changed by hand; return what was recorded of each driver."""
    with contextlib.closing(open_source(source)) as columns:
        text = changes(guess(columns))
    place = source.parent
    map_path, target = place / "map.toml", place / "made.mcap"
    map_path.write_text(text)
    target.unlink(missing_ok=True)
    converted = convert_foreign(source, target, "mcap", map_path)
    with skinware.recording.open(target) as recording:
        assert recording.problems == []
        found = {name: recording[name].read() for name in recording.services}
    assert {name: len(series) for name, series in found.items()} == converted.frames
    return found


def only(source: Path, changes: Callable[[str], str] = lambda text: text) -> Series:
    (series,) = imported(source, changes).values()
    return series


def require(series: Series, values: npt.NDArray[Any], times: npt.NDArray[Any] = TIMES) -> None:
    np.testing.assert_array_equal(series.column("values"), values)
    assert not series.column("status").any()
    np.testing.assert_allclose(series.time_s, times, rtol=0, atol=2e-7)


# -- CSV ----------------------------------------------------------------------------------------------------------


def write_csv(path: Path, names: list[str], rows: npt.NDArray[Any], **how: Any) -> None:
    np.savetxt(path, rows, **{"delimiter": ",", "header": ",".join(names), "comments": "", "fmt": "%.17g", **how})


def counts(*shape: int) -> npt.NDArray[np.int64]:
    return np.random.default_rng(4).integers(0, 4096, shape)


def test_csv(tmp_path: Path) -> None:
    values = counts(N, 12)
    path = tmp_path / "Data set.csv"
    write_csv(path, ["time", *(f"taxel_{n}" for n in range(12))], np.column_stack([TIMES, values]))
    ((name, series),) = imported(path).items()
    require(series, values)
    assert (name, series.structure.dtype.name, series.structure.n_modules) == ("data-set", "int32", 1)
    assert series.structure.sensor_names("pressure") == [f"data-set, taxel {n}" for n in range(12)]


def test_matrices_axes_and_units_by_names(tmp_path: Path) -> None:
    names = ["t_ms", *(f"f{f}_{r}_{c}_n" for f in range(2) for r in range(3) for c in range(4)), "joint_0"]
    names += [f"tip{n}_{axis}" for n in range(2) for axis in "xyz"]
    values = np.random.default_rng(5).normal(size=(N, 31)).astype(np.float32)
    path = tmp_path / "grid.csv"
    write_csv(path, names, np.column_stack([TIMES * 1000, values]))
    series = only(path)
    wanted = [*range(24), 25, 28, 26, 29, 27, 30]  # matrices, then x, y and z of the tips
    require(series, values[:, wanted])
    structure = series.structure
    assert structure.type("pressure").unit == "N"
    assert structure.matrices("pressure")["f, 1"].tolist() == np.arange(12, 24).reshape(3, 4).tolist()
    assert structure.sensor_names("force_z") == ["tip, taxel 0", "tip, taxel 1"]


@pytest.mark.parametrize("how", [{"delimiter": "\t"}, {"delimiter": " "}, {"delimiter": ";"}, {"comments": "# "}])
def test_other_separators(tmp_path: Path, how: dict[str, str]) -> None:
    values, separator = counts(N, 3), how.get("delimiter", ",")
    path = tmp_path / "data.txt"
    write_csv(path, [], np.column_stack([TIMES, values]), header=separator.join(["time", "s_0", "s_1", "s_2"]), **how)
    if separator == ";":  # as spreadsheets in some countries write it
        path.write_text(path.read_text().replace(".", ","))
    require(only(path), values)


@pytest.mark.parametrize("separator", ["\t", ";"])
def test_decimal_commas(tmp_path: Path, separator: str) -> None:
    values, path = counts(N, 3), tmp_path / "data.csv"
    write_csv(path, [], np.column_stack([TIMES, values]), header="", delimiter=separator, fmt="%.3f")
    names = separator.join(["Zeit [s]", "s_0", "s_1", "s_2"])
    path.write_text(names + "\n" + path.read_text().replace(".", ","), encoding="utf-8-sig")
    require(only(path), values)


@pytest.mark.parametrize(
    ("head", "patches"),
    [
        ("time,taxel_0,taxel_1\ns,N,N\n", ["data"]),
        (",left,right\n,s_0,s_0\ntime,,\n", ["left s", "right s"]),  # as pandas writes columns in two levels
        ("# by a program\ntime,taxel_0,taxel_1\n# begins\n", ["data"]),
    ],
)
def test_names_in_several_lines(tmp_path: Path, head: str, patches: list[str]) -> None:
    path, values = tmp_path / "data.csv", counts(N, 2)
    write_csv(path, [], np.column_stack([TIMES, values]), header="")
    path.write_text(head + path.read_text().lstrip())
    series = only(path)
    require(series, values)
    assert list(series.structure.patch_names) == patches
    assert series.structure.type("pressure").unit == ("N" if "N," in head else "counts")


@pytest.mark.parametrize(
    ("text", "begin"),
    [
        ("2026-11-28 12:00:00.{:06d}+01:00", "2026-11-28T11:00"),
        ("2026-11-28T12:00:00,{:06d}-0330", "2026-11-28T15:30"),
        ("2026-11-28T12:00:00.{:06d}Z", "2026-11-28T12:00"),
    ],
)
def test_dates_in_a_time_zone(tmp_path: Path, text: str, begin: str) -> None:
    path = tmp_path / "data.csv"
    path.write_text("when;taxel_0\n" + "".join(f"{text.format(n * 10_000)};{n}\n" for n in range(9)))
    require(only(path), np.arange(9)[:, None], TIMES[:9])
    with skinware.recording.open(tmp_path / "made.mcap") as recording:
        assert recording.start_ns == np.datetime64(begin, "ns").astype(int)


@pytest.mark.parametrize("kind", ["m8[us]", "M8[us]"])
@pytest.mark.parametrize("end", ["npz", "parquet"])
def test_times_as_such(tmp_path: Path, kind: str, end: str) -> None:
    """Also durations, and dates so near to 1970 that their size says nothing."""
    values, path = counts(N, 1), tmp_path / f"data.{end}"
    columns: dict[str, Any] = {"since": np.rint(TIMES * 1e6).astype("i8").view(kind), "taxel_0": values[:, 0]}
    np.savez(path, **columns) if end == "npz" else pa.parquet.write_table(pa.table(columns), path)
    require(only(path), values)


def test_missing_values_keep_the_last_one(tmp_path: Path) -> None:
    path = tmp_path / "gaps.csv"
    path.write_text("time,taxel_0,taxel_1\n0,,5\n1,1,\n2,nan,7\n3,4,8\n")
    map_path = tmp_path / "map.toml"
    map_path.write_text(guess(open_source(path)))
    notes = convert_foreign(path, None, "mcap", map_path).notes
    with skinware.recording.open(tmp_path / "gaps.mcap") as recording:
        series = recording["gaps"].read()
    assert series.column("values").tolist() == [[0, 5], [1, 5], [1, 7], [4, 8]]
    assert series.column("status").tolist() == [[Status.NEVER_SEEN, 0], [0, Status.STALE], [Status.STALE, 0], [0, 0]]
    assert notes == [f"{path}: 3 missing values of gaps keep the value before, with the status STALE"]


def test_times_since_1970_are_exact(tmp_path: Path) -> None:
    times_ns = EPOCH_NS + np.arange(N) * 10_000_001
    path = tmp_path / "epoch.csv"
    path.write_text("stamp,label,taxel_0\n" + "".join(f"{t},cup,{n}\n" for n, t in enumerate(times_ns.tolist())))
    series = only(path)
    require(series, np.arange(N)[:, None], (times_ns - EPOCH_NS) / 1e9)
    with skinware.recording.open(tmp_path / "made.mcap") as recording:
        assert recording.start_ns == EPOCH_NS
    assert np.diff(series.column("module_time_ns")[:, 0]).tolist() == [10_000_001] * (N - 1)
    dates = (np.datetime64(0, "ns") + times_ns).astype("datetime64[us]")
    path.write_text("time,taxel_0\n" + "".join(f"{date}Z,{n}\n" for n, date in enumerate(dates)))
    require(only(path), np.arange(N)[:, None], times_ns // 1000 / 1e6 - EPOCH_NS / 1e9)


def test_without_times_a_rate_is_needed(tmp_path: Path) -> None:
    path = tmp_path / "untimed.csv"
    write_csv(path, ["taxel_0", "taxel_1"], counts(N, 2))
    require(only(path, lambda text: text.replace("rate_hz = 100", "rate_hz = 50")), counts(N, 2), TIMES * 2)


# -- arrays and tables --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "f4", "f8", ">i2", "?"])
def test_npz(tmp_path: Path, dtype: str) -> None:
    values = (counts(N, 4, 6) % 100).astype(dtype)
    places = np.random.default_rng(6).random((24, 3)) / 10
    path = tmp_path / "hand.npz"
    np.savez(path, timestamp=EPOCH_NS + np.arange(N) * 10_000_000, palm_tactile=values, positions=places, name="x")
    series = only(path)
    require(series, values.reshape(N, 24))
    assert series.structure.matrices("pressure").keys() == {"palm tactile"}
    assert series.structure.geometry is not None
    np.testing.assert_array_equal(series.structure.geometry.position_m, places)


def test_switches_are_no_times(tmp_path: Path) -> None:
    path = tmp_path / "switches.npz"
    np.savez(path, time=TIMES, touch_0=np.arange(N) > 9)
    require(only(path), (np.arange(N) > 9)[:, None])


def test_npz_in_columns_compressed_and_of_three_axes(tmp_path: Path) -> None:
    values = np.random.default_rng(7).normal(size=(N, 5, 3)).astype(np.float32)
    path = tmp_path / "forces.npz"
    np.savez_compressed(path, t=TIMES, forces=np.asfortranarray(values))
    series = only(path)
    require(series, values.transpose(0, 2, 1).reshape(N, 15))
    assert [each.name for each in series.structure.types] == ["force_x", "force_y", "force_z"]


def test_parquet(tmp_path: Path) -> None:
    values, matrix = counts(N, 2), counts(N, 3, 4).astype(np.int16)
    lists = pa.array(matrix.tolist(), pa.list_(pa.list_(pa.int16())))
    fixed = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), 2)
    stamps = pa.array(EPOCH_NS + np.arange(N) * 10_000_000, pa.timestamp("ns"))
    table = pa.table(
        {"timestamp": stamps, "touch": fixed, "skin": lists, "who": ["x"] * N, "ragged": [[0]] + [[]] * (N - 1)}
    )
    pa.parquet.write_table(table, tmp_path / "a.parquet", row_group_size=70)
    require(only(tmp_path / "a.parquet"), np.concatenate([values, matrix.reshape(N, 12)], axis=1))
    folder = tmp_path / "parts"
    folder.mkdir()
    for number, first in enumerate(range(0, N, 100)):
        pa.parquet.write_table(table.slice(first, 100), folder / f"{number}.parquet")
    require(only(folder), np.concatenate([values, matrix.reshape(N, 12)], axis=1))


def test_pictures_in_parquet_are_read_a_few_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "camera.parquet"
    pictures = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(100 * 50_000, np.float32)), 50_000)
    pa.parquet.write_table(pa.table({"time": TIMES[:100], "picture": pictures}), path, compression="zstd")
    with contextlib.closing(open_source(path)) as source:
        assert all(rows["picture"].nbytes <= BLOCK_BYTES for rows in source.blocks("", ["picture"]))


def test_opening_parquet_reads_its_first_rows_alone(tmp_path: Path) -> None:
    path = tmp_path / "long.parquet"
    numbers = np.random.default_rng(1).random((4, 200_000))
    pa.parquet.write_table(pa.table(list(numbers), names=["time", "a", "b", "c"]), path, use_dictionary=False)

    def read_bytes() -> int:
        return int(Path("/proc/self/io").read_text().split()[1])

    open_source(path).close()  # which imports pyarrow
    before = read_bytes()
    open_source(path).close()
    assert read_bytes() - before < path.stat().st_size / 2


def test_a_parquet_page_that_does_not_fit_its_checksum(tmp_path: Path) -> None:
    path = tmp_path / "flipped.parquet"
    table = pa.table({"time": TIMES, "taxel_0": counts(N)})
    pa.parquet.write_table(table, path, use_dictionary=False, compression="none", write_page_checksum=True)
    require(only(path), counts(N)[:, None])
    data = path.read_bytes()
    value = counts(N)[N - 1].tobytes()
    path.write_bytes(data.replace(value, bytes([value[0] ^ 1]) + value[1:]))
    with pytest.raises(ConfigurationError, match="damaged"):
        imported(path)


def write_dataset(folder: Path, lengths: list[int], version: str = "v3.0") -> npt.NDArray[np.float32]:
    values = np.random.default_rng(8).random((sum(lengths), 6)).astype(np.float32)
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({"codebase_version": version, "fps": 10}))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    steps = [step for length in lengths for step in range(length)]
    table = pa.table(
        {
            "observation.tactile.left": list(values),
            "observation.state": [[0.0, 1.0]] * len(steps),
            "timestamp": np.array(steps, np.float32) / 10,
            "frame_index": steps,
            "episode_index": np.repeat(np.arange(len(lengths)), lengths),
            "index": np.arange(len(steps)),
        }
    )
    middle = len(steps) // 2  # in an episode
    for number, part in enumerate((table.slice(0, middle), table.slice(middle))):
        pa.parquet.write_table(part, folder / "data" / "chunk-000" / f"file-{number:03d}.parquet")
    return values


def test_a_dataset_of_lerobot(tmp_path: Path) -> None:
    values = write_dataset(tmp_path / "set", [20, 31, 15])
    ((name, series),) = imported(tmp_path / "set").items()
    assert name == "set"
    starts = np.repeat([0, 1.9 + 1, 1.9 + 1 + 3.0 + 1], [20, 31, 15])
    steps = np.concatenate([np.arange(length, dtype=np.float32) / np.float32(10) for length in (20, 31, 15)])
    require(series, values, starts + steps)
    with skinware.recording.open(tmp_path / "made.mcap") as recording:
        marks = [(event["text"], round(event["time_s"], 6)) for event in recording.events]
    assert marks == [("episode 0", 0.0), ("episode 1", 2.9), ("episode 2", 6.9)]


# -- bags ---------------------------------------------------------------------------------------------------------


def stamped(number: int) -> Any:
    time_ns = EPOCH_NS + number * 10_000_000
    return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(time_ns // 10**9, time_ns % 10**9), "palm")


def messages(points: npt.NDArray[np.float32], image: npt.NDArray[np.uint16], numbers: npt.NDArray[np.float32]) -> Any:
    field = ros.sensor_msgs__msg__PointField
    fields = [field(name, 4 * place, 7, 1) for place, name in enumerate(("x", "y", "z", "pressure"))]
    layout = ros.std_msgs__msg__MultiArrayLayout([], 0)
    for number in range(len(points)):
        data = points[number].tobytes()
        cloud = ros.sensor_msgs__msg__PointCloud2(
            stamped(number), 1, points.shape[1], fields, False, 16, len(data), np.frombuffer(data, np.uint8), True
        )
        rows, columns = image[number].shape
        data = image[number].tobytes()
        picture = ros.sensor_msgs__msg__Image(
            stamped(number), rows, columns, "mono16", 0, 2 * columns, np.frombuffer(data, np.uint8)
        )
        yield number, "/cloud", cloud
        yield number, "/skin_image", picture
        if not number % 2:
            yield number, "/touch", ros.std_msgs__msg__Float32MultiArray(layout, numbers[number])


def write_bag(path: Path, kind: str, made: Any, packing: str = "") -> None:
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    writer: Any
    if kind == "ros1":
        writer, serialize = Writer1(path), store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer, serialize = Writer2(path, version=9, storage_plugin=plugin), store.serialize_cdr
    if packing:
        writer.set_compression(
            *[writer.CompressionFormat[packing]]
            if kind == "ros1"
            else [CompressionMode[packing], CompressionFormat.ZSTD]
        )
    with writer:
        connections: dict[str, Any] = {}
        for number, topic, message in made:
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            if kind == "ros1" and hasattr(message, "header"):
                message = as_ros1(store, message)
            writer.write(connections[topic], EPOCH_NS + number * 10_000_000 + 500, serialize(message, name))


def as_ros1(store: Any, message: Any) -> Any:
    """With the header of ROS 1, which has a number."""
    header = message.header
    message.header = store.types["std_msgs/msg/Header"](0, header.stamp, header.frame_id)
    return message


@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_bags(tmp_path: Path, kind: str) -> None:
    generator = np.random.default_rng(9)
    points = np.concatenate([np.tile(generator.random((1, 8, 3)), (40, 1, 1)), generator.random((40, 8, 1))], axis=2)
    points = points.astype(np.float32)
    image, numbers = generator.integers(0, 60000, (40, 3, 4)).astype(np.uint16), generator.random((40, 7)).astype("f4")
    path = tmp_path / ("walk.bag" if kind == "ros1" else "walk")
    write_bag(path, kind, messages(points, image, numbers))
    found = imported(path)
    assert found.keys() == {"cloud", "skin-image", "touch"}
    require(found["cloud"], points[:, :, 3], TIMES[:40])
    geometry = found["cloud"].structure.geometry
    assert geometry is not None
    np.testing.assert_array_equal(geometry.position_m, points[0, :, :3].astype(np.float64))
    assert set(geometry.frame) == {"palm"}
    require(found["skin-image"], image.reshape(40, 12), TIMES[:40])
    require(found["touch"], numbers[::2], TIMES[:40:2] + 5e-7)  # when they were recorded
    if kind == "mcap":  # the file in the folder alone
        (inner,) = path.glob("*.mcap")
        require(imported(inner)["cloud"], points[:, :, 3], TIMES[:40])


def test_topics_beside_those_of_touch_are_no_taxels(tmp_path: Path) -> None:
    layout = ros.std_msgs__msg__MultiArrayLayout([], 0)
    rows = np.arange(40, dtype=np.float32).reshape(4, 10)
    made = [
        (number, topic, ros.std_msgs__msg__Float32MultiArray(layout, row))
        for number, row in enumerate(rows)
        for topic in ("/arm/commands", "/gripper/tactile")
    ]
    write_bag(tmp_path / "walk", "mcap", made)
    require(only(tmp_path / "walk"), rows, TIMES[:4])
    with contextlib.closing(open_source(tmp_path / "walk")) as source:
        text = guess(source)
    assert text.endswith("# not taken for taxels: the table /arm/commands\n")


@pytest.mark.parametrize(
    ("kind", "packing"),
    [("ros1", "BZ2"), ("ros1", "LZ4"), ("sqlite", "FILE"), ("sqlite", "MESSAGE"), ("mcap", "STORAGE")],
)
def test_packed_bags_are_read_as_far_as_the_limits_go(
    tmp_path: Path, kind: str, packing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout, numbers = ros.std_msgs__msg__MultiArrayLayout([], 0), np.arange(40, dtype=np.float32).reshape(4, 10)
    made = [(number, "/touch", ros.std_msgs__msg__Float32MultiArray(layout, row)) for number, row in enumerate(numbers)]
    path = tmp_path / ("walk.bag" if kind == "ros1" else "walk")
    write_bag(path, kind, made, packing)
    require(only(path), numbers, TIMES[:4])
    monkeypatch.setattr(bags, "LIMITS", Limits(chunk_size=40, always_size=40, ratio=0))
    with pytest.raises(ConfigurationError, match=r"walk.*: no bag of ROS, or damaged.* becomes? more than 40 bytes"):
        imported(path)


def test_a_topic_whose_shape_changes(tmp_path: Path) -> None:
    layout = ros.std_msgs__msg__MultiArrayLayout([], 0)
    made = [
        (number, "/touch", ros.std_msgs__msg__Float32MultiArray(layout, np.zeros(3 + (number == 2), np.float32)))
        for number in range(4)
    ]
    write_bag(tmp_path / "walk", "mcap", made)
    with pytest.raises(ConfigurationError, match=r"/touch, message 3: data has the shape \(4,\), and had \(3,\)"):
        imported(tmp_path / "walk")


def test_messages_that_a_bag_counts_and_lacks_are_reported(tmp_path: Path) -> None:
    layout = ros.std_msgs__msg__MultiArrayLayout([], 0)
    made = [
        (number, "/touch", ros.std_msgs__msg__Float32MultiArray(layout, np.full(3, number, np.float32)))
        for number in range(4)
    ]
    path, map_path = tmp_path / "walk", tmp_path / "map.toml"
    write_bag(path, "sqlite", made)
    with contextlib.closing(open_source(path)) as source:
        map_path.write_text(guess(source))
    with contextlib.closing(sqlite3.connect(path / "walk.db3")) as database, database:
        database.execute("DELETE FROM messages WHERE id = 3")
    converted = convert_foreign(path, tmp_path / "made.mcap", "mcap", map_path)
    assert converted.notes == [f"{path}: /touch has 3 messages, and should have 4"]


# -- YARP ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stamp", ["rx", "tx+rx", "old"])
def test_a_dump_of_yarp(tmp_path: Path, stamp: str) -> None:
    values = counts(N, 12)
    lines = ["Type: Bottle;"] if stamp == "old" else []
    for number, row in enumerate(values.tolist()):
        times = [f"{1_400_000_000 + number * 0.01:.6f}"] * (2 if stamp == "tx+rx" else 1)
        text = " ".join(map(str, row))
        lines.append(" ".join([str(number), *times, f"({text})" if number % 2 else text]))
    (tmp_path / "data.log").write_text("\n".join(lines) + "\n")
    if stamp != "old":
        (tmp_path / "info.log").write_text(f"Type: Bottle;\nStamp: {stamp};\n[1400000000.0] /skin [connected]\n")
    names = ["sequence", "time", *(["received_time"] if stamp == "tx+rx" else []), "value"]
    assert list(open_source(tmp_path).tables[""]) == names
    ((name, series),) = imported(tmp_path / "data.log").items()
    require(series, values)
    assert name == re.sub(r"[^a-z0-9]+", "-", tmp_path.name.lower())[:32].strip("-")


def test_a_dump_of_contacts_has_rows_of_different_lengths(tmp_path: Path) -> None:
    (tmp_path / "data.log").write_text("1 1400000000.0\n2 1400000000.1\n3 1400000000.2 ((83507 4) (0.1 0.2 0.3))\n")
    source = open_source(tmp_path)
    with pytest.raises(ConfigurationError, match=r"line 3: 7 cells instead of 2: only ports with equally many numbers"):
        whole(source, "", ["time"])


def real_dumps() -> list[Path]:
    return sorted(SHARED.rglob("data.log")) if SHARED.exists() else []


@pytest.mark.skipif(not real_dumps(), reason="no data.log of a robot here")
def test_dumps_of_robots() -> None:
    for path in real_dumps():
        assert len(whole(open_source(path), "", ["time"])["time"])


# -- mistakes -----------------------------------------------------------------------------------------------------


def damaged(name: str, make: Callable[[Path], object], words: str) -> Any:
    return pytest.param(name, make, words, id=name)


def cut(path: Path, write: Callable[[Path], object]) -> None:
    write(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def later(text: str) -> Callable[[Path], object]:
    """A text whose thousandth row has a mistake: after what is looked at first."""
    rows = "".join(f"{n},{n}\n" for n in range(1000))
    return lambda path: path.write_text(f"time,taxel_0\n{rows}{text}")


def zipped(path: Path, name: str, data: bytes, method: int = 0) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(name, data)
    data = path.read_bytes()
    path.write_bytes(data.replace(b"PK\1\2\x14\3\x14\0\0\0\0", b"PK\1\2\x14\3\x14\0\0\0" + bytes([method])))


def spoiled(path: Path, change: Callable[[Path], object]) -> None:
    write_dataset(path, [3])
    for table in path.rglob("*.parquet"):
        change(table)


MISTAKES = [
    damaged("no.csv", lambda path: path.write_text("hello\nworld\n"), "no line with numbers in it"),
    damaged("none.csv", lambda path: path.write_text(""), "no line with numbers in it"),
    damaged("bin.csv", lambda path: path.write_bytes(b"time,a\n0,\x001\n"), "bin.csv, byte 9: not a text"),
    damaged("latin.csv", lambda path: path.write_bytes(b"time,taxel_0\n0,1\n1,\xe9\n"), "latin.csv, byte 19: no UTF-8"),
    damaged("text.csv", later("1000,x\n"), "text.csv, line 1002: 'x' is no number"),
    damaged("place.csv", later("1000,1_0\n"), "place.csv, line 1002: '1_0' is no number"),
    damaged("few.csv", later("1000\n"), "few.csv, line 1002: 1 cells instead of 2"),
    damaged("many.csv", later("1000,1,2\n"), "many.csv, line 1002: 3 cells instead of 2"),
    damaged("back.csv", later("5,1\n"), "back.csv, row 1001: time goes back by 994 s"),
    damaged("half.csv", later("1000,0.5\n"), "row 1001: 0.5 in taxel_0 is no int32: say another dtype"),
    damaged("nan.csv", later("nan,1\n"), "row 1001: time nan s is no time"),
    damaged("mac.csv", lambda path: path.write_text("time,taxel_0\r0,1\r1,2\r"), "ends with a carriage return"),
    damaged("cell.csv", later(f"1000,{'9' * 200_000}\n"), "cell.csv: a cell has more than 131072 characters"),
    damaged("large.csv", later("1000,-1e400\n"), "large.csv, line 1002: '-1e400' is out of range: mend or remove"),
    damaged("inf.csv", later("1000,-inf\n"), "row 1001: -inf in taxel_0 is no int32"),
    damaged("first.csv", lambda path: path.write_text(f"time,taxel_0\n0,{'9' * 200_000}\n"), "a cell has more than"),
    damaged("line.csv", later("9" * (1 << 20)), "line.csv: a line of 1048576 bytes or more: not a text of numbers"),
    damaged("time.csv", lambda path: path.write_text(f"time,taxel_0\n{10**30},1\n{10**31},2\n"),
            "in time is neither a date nor an integer of 64 bits"),
    damaged("date.csv", lambda path: path.write_text("time,taxel_0\n2600-01-01 00:00:00,1\n2600-01-01 00:00:01,2\n"),
            "line 2: '2600-01-01 00:00:00' in time is neither a date"),
    damaged("digits.csv", lambda path: path.write_text(f"time,taxel_0\n{'9' * 5000},1\n1,2\n"), "is neither a date"),
    damaged("bare.npz", lambda path: zipped(path, "time", np.lib.format.magic(1, 0)), "bare.npz: not an NPZ file"),
    damaged("deep.npz", lambda path: zipped(path, "time.npy", np.lib.format.magic(1, 0) + b"\xe8\x03" + b"(" * 1000),
            "deep.npz: not an NPZ file, or damaged"),
    damaged("head.npz", lambda path: zipped(path, "time.npy", np.lib.format.magic(2, 0) + bytes([0, 0, 1, 0]) * 40_000),
            "head.npz: not an NPZ file, or damaged"),
    damaged("packed.npz", lambda path: zipped(path, "time.npy", b"", method=99), "compression method is not supported"),
    damaged("late.npz", lambda path: np.savez(path, time=np.array(["2600", "2601"], "M8[Y]"), taxel_0=[1, 2]),
            "row 1: time -9223372036854775808 s is no time"),
    damaged("two.parquet", lambda path: pa.parquet.write_table(
        pa.table([TIMES, TIMES, TIMES], names=["time", "taxel_0", "taxel_0"]), path), "no column of numbers 'taxel_0'"),
    damaged("wide.npz", lambda path: np.savez_compressed(path, time=TIMES[:2], taxel_0=np.zeros((2, 1 << 21), bool)),
            "no column of numbers 'taxel_0'"),
    damaged("thousand.csv", lambda path: path.write_text("time;taxel_0\n0.1;1,938\n0.2;12\n"),
            "'0.1' and '1,938': is the comma or the point that of decimals? Export it without marks between thousands"),
    damaged("spaces.txt", lambda path: path.write_text("0,00 1938,5\n0,01 1939,5\n"),
            "'00 1938' between commas: export it with points and commas, or tabs"),
    damaged("marks.csv", lambda path: path.write_text("time;taxel_0\n1;1,938\n2;12\n"),
            "is '1,938' a number of thousands?"),
    damaged("point.csv", lambda path: path.write_text("time;taxel_0\n" + "0,5;1,5\n" * 500 + "1,0;1.938\n"),
            "line 502: '1.938' is no number"),
    damaged("zone.csv", lambda path: path.write_text("time,taxel_0\n" + "2026-11-28T12:00:00Z,1\n" * 500 + "12:00,1\n"),
            "line 502: '12:00' in time is neither a date"),
    damaged("lfs.csv", lambda path: path.write_text("version https://git-lfs.github.com/spec/v1\nsize 7\n"),
            "only a pointer to the data: fetch them with git lfs pull"),
    damaged("a.csv.gz", lambda path: path.write_bytes(b"\x1f\x8b\x08" + bytes(50)), "packed by gzip: unpack it first"),
    damaged("a.feather", lambda path: path.write_bytes(b"ARROW1" + bytes(50)), "Feather is not read: write it as"),
    damaged("a.mat", lambda path: path.write_bytes(b"MATLAB 5.0 MAT-file" + bytes(150)), "MAT-files are not read"),
    damaged("a.xlsx", lambda path: zipped(path, "[Content_Types].xml", b"<Types>"), "spreadsheet can be saved as CSV"),
    damaged("a.h5", lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(50)), "HDF5 is not read"),
    damaged("a.npy", lambda path: np.save(path, np.zeros(3)), "save it with numpy.savez"),
    damaged("cut.npz", lambda path: cut(path, lambda path: np.savez(path, t=TIMES)), "not an NPZ file, or damaged"),
    damaged("cut.parquet", lambda path: cut(path, lambda path: pa.parquet.write_table(pa.table({"t": TIMES}), path)),
            "not Parquet, or damaged"),
    damaged("old", lambda path: write_dataset(path, [3], "v2.1"), "a dataset of LeRobot v2.1: convert it to v3.0"),
    damaged("bare", lambda path: spoiled(path, Path.unlink), "bare/data: no Parquet file in it: fetch the whole"),
    damaged("pointers", lambda path: spoiled(path, lambda each: each.write_text("version https://git-lfs.github.com")),
            "only a pointer to the data: fetch them with git lfs pull"),
    damaged("empty", lambda path: path.mkdir(), "a folder without metadata.yaml"),
    damaged("bad.bag", lambda path: path.write_bytes(b"#ROSBAG V2.0\n" + bytes(50)), "no bag of ROS, or damaged"),
    damaged("own.mcap", lambda path: path.write_bytes(b"\x89MCAP0\r\n\1\x1e" + bytes(7) + b"\x08\0\0\0skinware"),
            "a recording already, which needs no map"),
    damaged("bad.mcap", lambda path: path.write_bytes(b"\x89MCAP0\r\n" + bytes(50)), "no bag of ROS, or damaged"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "make", "words"), MISTAKES)
def test_damaged_and_foreign_files_get_one_clear_line(
    tmp_path: Path, name: str, make: Callable[[Path], object], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path, map_path = tmp_path / name, tmp_path / "map.toml"
    make(path)
    map_path.write_text(MAP)
    assert (
        exit_status(skin_convert, [str(path), "--map", str(map_path), "--to", "mcap", "-o", str(tmp_path / "made")])
        == 2
    )
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("skin-convert: ")
    assert words in err
    assert err.count("\n") == 1
    assert sorted(entry.name for entry in tmp_path.iterdir()) == sorted([name, "map.toml"])


MAP = """format = "skinware-columns"
version = 1

[[driver]]
name = "hand"
time = "time"
dtype = "int32"

[[driver.module]]
patch = "palm"
columns = ["taxel_0"]
"""
WRONG = [
    ('time = "time"', 'time = "tine"', "map.toml:6: no column of numbers 'tine' in {}; did you mean 'time'?"),
    ('columns = ["taxel_0"]', 'columns = ["taxel_{0..2}"]', "map.toml:11: no column of numbers 'taxel_2'"),
    ('columns = ["taxel_0"]', 'columns = ["taxel_0[3]"]', "map.toml:11: "),
    ('patch = "palm"', 'patch = "palm"\ntype = "presure"', "no sensor type 'presure'; did you mean 'pressure'?"),
    ('patch = "palm"', 'patch = "palm"\ntaxels = [1, 2]', "2 taxels for the 1 numbers"),
    ('patch = "palm"', 'patch = "palm"\nposition_m = [[0, 0, 0], [1, 0, 0]]', "2 places for the 1 taxels"),
    ('name = "hand"', 'name = "hand"\ntable = "/x"', "has no table '/x'"),
    ('time = "time"\n', "", "neither time nor rate_hz"),
    ("version = 1", "version = 2", "version 2, this Skinware reads version 1"),
]


@pytest.mark.parametrize(("old", "new", "words"), WRONG, ids=[words for _, _, words in WRONG])
def test_a_wrong_map(tmp_path: Path, old: str, new: str, words: str) -> None:
    path, map_path = tmp_path / "a.csv", tmp_path / "map.toml"
    write_csv(path, ["time", "taxel_0", "taxel_1"], np.column_stack([TIMES, counts(N, 2)]))
    map_path.write_text(MAP.replace(old, new))
    with pytest.raises(ConfigurationError) as error:
        convert_foreign(path, None, "mcap", map_path)
    assert words.format(path) in str(error.value)


def test_many_columns_with_numbers_are_taxels_beside_one_with_a_name(tmp_path: Path) -> None:
    path, taxels = tmp_path / "data.csv", [f"f1_{row}_{column}" for row in range(4) for column in range(4)]
    head = ["time", *taxels, "joint_0", "joint_1", "joint_2", "joint_3", "temp_c"]
    rows = [[f"{at / 50:.2f}", *["7"] * 20, "25.5"] for at in range(20)]
    path.write_text("\n".join(",".join(row) for row in [head, *rows]) + "\n")
    text = guess(open_source(path))
    assert 'columns = ["f1_{0..3}_{0..3}"]' in text
    assert 'kind = "4x4"' in text
    assert 'unit = "degC"' in text
    assert "not taken for taxels: joint_0, joint_1, joint_2, joint_3" in text


@pytest.mark.parametrize("name", ["Zeit", "tempo_ms", "t (ms)"])
def test_whole_times_are_found_by_name(tmp_path: Path, name: str) -> None:
    path = tmp_path / "data.csv"
    path.write_text(f"{name};taxel_0\n" + "".join(f"{10 * n};{7 * n % 5}\n" for n in range(9)))
    require(only(path), (7 * np.arange(9) % 5)[:, None], TIMES[:9])


def test_numbers_too_large_for_the_first_guess(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text("time,taxel_0,taxel_1\n0,5000000000,1\n0.5,4294967296,inf\n")
    require(only(path), np.array([[5e9, 1], [2**32, np.inf]], np.float32), np.arange(2) / 2)


def test_a_rate_is_made_up_aloud(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    path.write_text("time,taxel_0\n" + "".join(f"12:00:0{n},{n}\n" for n in range(5)))
    assert "# MADE UP: no column rises like a time (time: '12:00:00' is no number)" in guess(open_source(path))


def test_nothing_to_guess(tmp_path: Path) -> None:
    path = tmp_path / "joints.csv"
    write_csv(path, ["time", "joint_0"], np.column_stack([TIMES, counts(N, 1)]))
    with pytest.raises(ConfigurationError, match="nothing looks like taxels; columns of numbers: time, joint_0"):
        guess(open_source(path))


def test_columns_that_cannot_be_read_are_named_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "data.npz"
    np.savez(path, time=TIMES, tactile=counts(N, 3).astype(object))
    with pytest.raises(ConfigurationError, match=r"columns of numbers: time; others: tactile \(object of shape"):
        guess(open_source(path))
