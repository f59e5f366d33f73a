"""A strict reader of LeRobot's dataset format v3.0, by its description: what is not as it says there fails."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pyarrow
import pyarrow.parquet

OF_ALL = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
STATISTICS = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}
VIDEO_PLACE = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


@dataclass
class Read:
    """A dataset that is as it should be.

    Attributes:
        info: of ``info.json``.
        features: (rows, ...) by name; of images lists of PNG bytes, of videos (rows, height, width, 3) uint8.
        episodes: rows of ``meta/episodes``.
        tasks: by number.
        statistics: of ``stats.json``.
    """

    info: dict[str, Any]
    features: dict[str, Any]
    episodes: list[dict[str, Any]]
    tasks: list[str]
    statistics: dict[str, dict[str, Any]]

    def episode(self, number: int) -> dict[str, Any]:
        """The rows of one episode."""
        rows = slice(self.episodes[number]["dataset_from_index"], self.episodes[number]["dataset_to_index"])
        return {name: each[rows] for name, each in self.features.items()}

    def task_of(self, number: int) -> str:
        """What is done in an episode."""
        return self.tasks[int(self.episode(number)["task_index"][0])]


def read_dataset(folder: Path) -> Read:
    """Read a dataset, and check all that can be checked."""
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["data_path"] == f"data/{PLACE}"
    has_videos = any(told["dtype"] == "video" for told in info["features"].values())
    assert info["video_path"] == (VIDEO_PLACE if has_videos else None)
    assert type(info["fps"]) is int
    assert info["splits"] == {"train": f"0:{info['total_episodes']}"}
    for name, dtype in OF_ALL.items():
        assert info["features"][name] == {"dtype": dtype, "shape": [1], "names": None}
    tasks = _tasks(folder / "meta/tasks.parquet")
    assert len(tasks) == info["total_tasks"]
    episodes = _episodes(folder, info)
    features = _rows(folder, info, episodes)
    read = Read(info, features, episodes, tasks, json.loads((folder / "meta/stats.json").read_text()))
    _check_numbers(read)
    _check_statistics(read)
    return read


def _table(path: Path) -> pyarrow.Table:
    with path.open("rb") as stream:
        return pyarrow.parquet.read_table(stream)


def _tasks(path: Path) -> list[str]:
    table = _table(path)
    assert table.schema.names == ["task_index", "task"]
    assert table.schema.field("task_index").type == pyarrow.int64()
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    assert table["task_index"].to_pylist() == list(range(len(table)))
    tasks: list[str] = table["task"].to_pylist()
    assert len(set(tasks)) == len(tasks)
    return tasks


def _places(folder: Path, chunk_files: int) -> list[tuple[dict[str, int], Path]]:
    """The files of a folder with their numbers, in order; none is left out."""
    found = []
    for number, path in enumerate(sorted(folder.glob("*/*"))):
        chunk, file = divmod(number, chunk_files)
        assert str(path.relative_to(folder)) == PLACE.format(chunk_index=chunk, file_index=file)
        found.append(({"chunk_index": chunk, "file_index": file}, path))
    assert found
    return found


def _episodes(folder: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    episodes: list[dict[str, Any]] = []
    for place, path in _places(folder / "meta/episodes", info["chunks_size"]):
        for row in _table(path).to_pylist():
            assert {name: row[f"meta/episodes/{name}"] for name in place} == place
            episodes.append(row)
    assert len(episodes) == info["total_episodes"]
    at = 0
    for number, row in enumerate(episodes):
        assert (row["episode_index"], row["dataset_from_index"]) == (number, at)
        at += row["length"]
        assert row["dataset_to_index"] == at
        assert row["length"] > 0
        told = {re.sub(r"stats/(.*)/\w+", r"\1", name) for name in row if name.startswith("stats/")}
        assert told == set(info["features"])
    assert at == info["total_frames"]
    return episodes


def _rows(folder: Path, info: dict[str, Any], episodes: list[dict[str, Any]]) -> dict[str, Any]:
    parts: list[pyarrow.Table] = []
    for place, path in _places(folder / "data", info["chunks_size"]):
        table = _table(path)
        inside = [row["episode_index"] for row in episodes if {n: row[f"data/{n}"] for n in place} == place]
        assert table["episode_index"].unique().to_pylist() == inside  # whole episodes, each where it is said to be
        assert sum(episodes[number]["length"] for number in inside) == len(table)
        parts.append(table)
    table = pyarrow.concat_tables(parts)
    videos = [name for name, told in info["features"].items() if told["dtype"] == "video"]
    assert table.schema.names == [name for name in info["features"] if name not in videos]
    return {
        name: _video(folder, name, info, episodes) if name in videos else _feature(table, name, told)
        for name, told in info["features"].items()
    }


def _video(folder: Path, name: str, info: dict[str, Any], episodes: list[dict[str, Any]]) -> Any:
    told, rows = info["features"][name], []
    for row in episodes:
        of = {what: row[f"videos/{name}/{what}"] for what in ("chunk_index", "file_index")}
        with av.open(str(folder / VIDEO_PLACE.format(video_key=name, **of))) as file:
            (stream,) = file.streams.video
            assert (stream.codec.canonical_name, stream.average_rate) == (told["info"]["video.codec"], info["fps"])
            frames = list(file.decode(stream))
        first, last = (round(row[f"videos/{name}/{end}_timestamp"] * info["fps"]) for end in ("from", "to"))
        assert last - first == row["length"]
        times = [round((frame.time or 0.0) * info["fps"]) for frame in frames]
        assert times == list(range(len(frames)))
        rows += [frame.to_ndarray(format="rgb24") for frame in frames[first:last]]
    assert np.shape(rows) == (info["total_frames"], *told["shape"])
    return np.array(rows)


def _feature(table: pyarrow.Table, name: str, told: dict[str, Any]) -> Any:
    assert set(told) == {"dtype", "shape", "names"}
    column, shape = table[name].combine_chunks(), tuple(told["shape"])
    assert not column.null_count
    if told["dtype"] == "image":
        assert told["names"] == ["height", "width", "channels"]
        assert column.type == pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
        return [row["bytes"] for row in column.to_pylist()]
    item = pyarrow.from_numpy_dtype(np.dtype(told["dtype"]))
    if shape == (1,):
        assert column.type == item
        return column.to_numpy()
    if len(shape) == 1:
        assert column.type == pyarrow.list_(item, shape[0])
        assert told["names"] is None or len(told["names"]) == shape[0]
        return column.flatten().to_numpy().reshape(len(table), *shape)
    assert len(shape) == 2
    assert column.type == pyarrow.list_(pyarrow.list_(item))
    assert told["names"] is None or len(told["names"]) == 2
    assert set(column.value_lengths().to_pylist()) == {shape[0]}
    assert set(column.flatten().value_lengths().to_pylist()) == {shape[1]}
    return column.flatten().flatten().to_numpy().reshape(len(table), *shape)


def _check_numbers(read: Read) -> None:
    features, fps = read.features, read.info["fps"]
    assert features["index"].tolist() == list(range(read.info["total_frames"]))
    for number, row in enumerate(read.episodes):
        episode = read.episode(number)
        frame = np.arange(row["length"])
        assert (episode["episode_index"] == number).all()
        assert episode["frame_index"].tolist() == frame.tolist()
        assert np.array_equal(episode["timestamp"], (frame / fps).astype(np.float32))
        assert row["tasks"] == [read.task_of(number)]
        assert len(set(episode["task_index"].tolist())) == 1


def _check_statistics(read: Read) -> None:
    assert set(read.statistics) == set(read.info["features"])
    for name, told in read.info["features"].items():
        assert set(read.statistics[name]) == STATISTICS
        if told["dtype"] in ("image", "video"):
            for of in (read.statistics[name], *(_of_episode(row, name) for row in read.episodes)):
                assert {np.shape(of[what]) for what in STATISTICS - {"count"}} == {(3, 1, 1)}
                assert 0 <= np.min(of["min"]) <= np.min(of["q50"]) <= np.max(of["max"]) <= 1
            continue
        _check_of(read.statistics[name], read.features[name])
        for number, row in enumerate(read.episodes):
            _check_of(_of_episode(row, name), read.episode(number)[name])


def _of_episode(row: dict[str, Any], name: str) -> dict[str, Any]:
    return {what: row[f"stats/{name}/{what}"] for what in STATISTICS}


def _check_of(told: dict[str, Any], rows: npt.NDArray[Any]) -> None:
    """Statistics of a feature; quantiles are exact here, where all rows fit into the sample."""
    rows = rows.astype(np.float64) if rows.ndim > 1 else rows.astype(np.float64)[:, np.newaxis]
    assert told["count"] == [len(rows)]
    expected = {"min": rows.min(axis=0), "max": rows.max(axis=0), "mean": rows.mean(axis=0), "std": rows.std(axis=0)}
    if len(rows) <= 1000:
        expected |= {f"q{of:02d}": np.quantile(rows, of / 100, axis=0) for of in (1, 10, 50, 90, 99)}
    for what, numbers in expected.items():
        assert np.shape(told[what]) == numbers.shape
        np.testing.assert_allclose(told[what], numbers, rtol=1e-5, atol=1e-5)
