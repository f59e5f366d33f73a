"""Write LeRobot's dataset format v3.0 with pyarrow alone."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.conversion.learning.features import (
    IMAGE,
    STATISTICS,
    VIDEO,
    Batch,
    Feature,
    Moments,
    Statistics,
    pixel_count,
    pixels_of,
)
from skinware.conversion.tables import package, pyarrow
from skinware.errors import ConfigurationError

_ENCODER, _PIXELS = "libsvtav1", "yuv420p"
_OPTIONS = {"g": "2", "crf": "30", "preset": "12", "svtav1-params": "fast-decode=0"}
"""Defaults of huggingface/lerobot v0.6.1, lerobot/configs/video.py."""
_LEAST = 16
"""Pixels of the shortest side that the encoder was seen to take."""


class Video:
    """The video of one feature in one episode.

    Args:
        shape: height, width and channels of the images.
    """

    def __init__(self, path: Path, fps: int, shape: tuple[int, ...]) -> None:
        self._av, self._images = package("av", "data sets with videos"), package("PIL.Image", "data sets with videos")
        height, width = shape[:2]
        if height % 2 or width % 2 or min(height, width) < _LEAST:
            raise ConfigurationError(f"videos of {width} x {height}: give even sizes of at least {_LEAST}")
        self.info = {
            "video.height": height,
            "video.width": width,
            "video.codec": "av1",
            "video.pix_fmt": _PIXELS,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
            "is_depth_map": False,
        }
        os.environ.setdefault("SVT_LOG", "1")  # the encoder prints its settings otherwise
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._av.open(str(path), "w")
        self._stream = self._file.add_stream(_ENCODER, fps, options=_OPTIONS)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, _PIXELS

    def add(self, pngs: Iterable[bytes]) -> None:
        for png in pngs:
            with self._images.open(BytesIO(png)) as image:
                self._mux(self._av.VideoFrame.from_image(image))

    def close(self) -> None:
        self._mux(None)
        self._file.close()

    def _mux(self, frame: Any) -> None:
        self._file.mux(self._stream.encode(frame))


VERSION = "v3.0"
_CHUNK_FILES, _FILE_MB, _VIDEO_MB = 1000, 100, 200
_PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO_PLACE = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_OF_ALL = {
    "timestamp": Feature("float32", (1,)),
    "frame_index": Feature("int64", (1,)),
    "episode_index": Feature("int64", (1,)),
    "index": Feature("int64", (1,)),
    "task_index": Feature("int64", (1,)),
}
_SET_SAMPLE_BYTES, _EPISODE_SAMPLE_BYTES = 64 << 20, 16 << 20
_IMAGES = 100
"""Most images of an episode in its statistics."""


class DatasetWriter:
    """Writes a dataset episode by episode.

    Args:
        folder: of the dataset; it must not exist.
        fps: rows a second.
    """

    def __init__(
        self, folder: Path, fps: int, features: Mapping[str, Feature], lengths: Sequence[int], *, video: bool = False
    ) -> None:
        self._arrow = pyarrow()
        self._folder, self._fps = folder, fps
        images = [name for name, each in features.items() if each.dtype == IMAGE and video]
        self._features: dict[str, Feature] = {
            **features,
            **{name: features[name]._replace(dtype=VIDEO) for name in images},
            **_OF_ALL,
        }
        self._videos = images
        self._video_info: dict[str, Mapping[str, Any]] = {}
        (folder / "meta").mkdir(parents=True)
        self._stored = {name: each for name, each in self._features.items() if each.dtype != VIDEO}
        schema = self._arrow.schema([(name, _type(self._arrow, each)) for name, each in self._stored.items()])
        self._data = _Files(folder / "data", schema)
        self._episodes = _Files(folder / "meta" / "episodes", self._episode_schema())
        self._tasks: dict[str, int] = {}
        self._rows = self._count = 0
        self._whole = _FeatureStatistics(self._features, lengths, _SET_SAMPLE_BYTES)

    def add_episode(self, task: str, length: int, batches: Iterable[Batch]) -> None:
        place = self._data.next_place()
        task_index = self._tasks.setdefault(task, len(self._tasks))
        statistics = _FeatureStatistics(self._features, [length], _EPISODE_SAMPLE_BYTES)
        done = 0
        videos = {name: self._video(name) for name in self._videos}
        for batch in batches:
            count = len(next(iter(batch.values())))
            number = np.arange(done, done + count)
            rows = batch | {
                "timestamp": (number / self._fps).astype(np.float32)[:, np.newaxis],
                "frame_index": number[:, np.newaxis],
                "episode_index": np.full((count, 1), self._count),
                "index": self._rows + number[:, np.newaxis],
                "task_index": np.full((count, 1), task_index),
            }
            arrays = [_column(self._arrow, each, rows[name]) for name, each in self._stored.items()]
            self._data.write(arrays)
            for name, video in videos.items():
                video.add(rows[name])
            for name, numbers in self._numbers(rows, number, length):
                moments = Moments.of(numbers)
                statistics.add(name, numbers, moments)
                self._whole.add(name, numbers, moments)
            done += count
        for video in videos.values():
            video.close()
        self._write_episode(task, done, place, statistics.result())
        self._rows, self._count = self._rows + done, self._count + 1

    def close(self) -> None:
        self._data.close()
        self._episodes.close()

    def finish(self) -> None:
        self.close()
        meta = self._folder / "meta"
        _write_tasks(self._arrow, self._tasks, meta / "tasks.parquet")
        with (meta / "stats.json").open("w", encoding="utf-8") as stream:
            statistics = self._whole.result()
            json.dump(
                {name: {what: each.tolist() for what, each in of.items()} for name, of in statistics.items()}, stream
            )
        info = {
            "codebase_version": VERSION,
            "robot_type": None,
            "total_episodes": self._count,
            "total_frames": self._rows,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK_FILES,
            "data_files_size_in_mb": _FILE_MB,
            "video_files_size_in_mb": _VIDEO_MB,
            "fps": self._fps,
            "splits": {"train": f"0:{self._count}"},
            "data_path": f"data/{_PLACE}",
            "video_path": _VIDEO_PLACE if self._videos else None,
            "features": {
                name: {"dtype": each.dtype, "shape": list(each.shape), "names": each.names and list(each.names)}
                | ({"info": self._video_info[name]} if each.dtype == VIDEO else {})
                for name, each in self._features.items()
            },
        }
        (meta / "info.json").write_text(json.dumps(info, indent=4) + "\n", encoding="utf-8")

    def _numbers(
        self, rows: Batch, number: npt.NDArray[np.int64], length: int
    ) -> Iterator[tuple[str, npt.NDArray[Any]]]:
        """Yield (feature, data for its statistics): the numbers of all rows, and pixels of some images."""
        for name, each in self._features.items():
            if each.dtype not in (IMAGE, VIDEO):
                yield name, rows[name]
                continue
            chosen = rows[name][number % _image_step(length) == 0]
            if len(chosen):
                yield name, np.concatenate([pixels_of(png) for png in chosen])

    def _episode_schema(self) -> Any:
        arrow = self._arrow
        integers = ("dataset_from_index", "dataset_to_index", "data/chunk_index", "data/file_index")
        fields = [("episode_index", arrow.int64()), ("tasks", arrow.list_(arrow.string())), ("length", arrow.int64())]
        fields += [(name, arrow.int64()) for name in integers]
        for name, each in self._features.items():
            depth = 3 if each.dtype in (IMAGE, VIDEO) else len(each.shape)
            for what in STATISTICS:
                item, nested = (arrow.int64(), 1) if what == "count" else (arrow.float64(), depth)
                for _ in range(nested):
                    item = arrow.list_(item)
                fields.append((f"stats/{name}/{what}", item))
        for name in self._videos:
            fields += [(f"videos/{name}/{what}", arrow.int64()) for what in ("chunk_index", "file_index")]
            fields += [(f"videos/{name}/{what}", arrow.float64()) for what in ("from_timestamp", "to_timestamp")]
        fields += [(f"meta/episodes/{name}", arrow.int64()) for name in ("chunk_index", "file_index")]
        return arrow.schema(fields)

    def _video(self, name: str) -> Video:
        """The file of a feature in the next episode, each of which has one."""
        chunk, file = divmod(self._count, _CHUNK_FILES)
        path = self._folder / _VIDEO_PLACE.format(video_key=name, chunk_index=chunk, file_index=file)
        video = Video(path, self._fps, self._features[name].shape)
        self._video_info[name] = video.info
        return video

    def _write_episode(
        self, task: str, length: int, place: Mapping[str, int], statistics: Mapping[str, Mapping[str, Any]]
    ) -> None:
        own = self._episodes.next_place()
        chunk, file = divmod(self._count, _CHUNK_FILES)
        video = {
            "chunk_index": chunk,
            "file_index": file,
            "from_timestamp": 0.0,
            "to_timestamp": length / self._fps,
        }
        row = {
            "episode_index": self._count,
            "tasks": [task],
            "length": length,
            "dataset_from_index": self._rows,
            "dataset_to_index": self._rows + length,
            **{f"data/{name}": number for name, number in place.items()},
            **{f"videos/{name}/{what}": each for name in self._videos for what, each in video.items()},
            **{f"stats/{name}/{what}": each.tolist() for name, of in statistics.items() for what, each in of.items()},
            **{f"meta/episodes/{name}": number for name, number in own.items()},
        }
        schema = self._episodes.schema
        self._episodes.write([self._arrow.array([row[field.name]], field.type) for field in schema])


class _Files:
    """Parquet files of one schema in folders of many: a new one when the last is large."""

    def __init__(self, folder: Path, schema: Any) -> None:
        self._folder, self.schema = folder, schema
        self._number, self._writer, self._path = -1, None, folder

    def next_place(self) -> dict[str, int]:
        """Return the numbers of the folder and file for the next rows that belong together."""
        if self._writer is None or self._path.stat().st_size > _FILE_MB << 20:
            self.close()
            self._number += 1
            self._path = self._folder / _PLACE.format(**self._place)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pyarrow().parquet.ParquetWriter(self._path, self.schema, compression="zstd")
        return self._place

    def write(self, arrays: Sequence[Any]) -> None:
        table = pyarrow().Table.from_arrays(list(arrays), schema=self.schema)
        assert self._writer is not None  # noqa: S101, there is a place for them
        self._writer.write_table(table, row_group_size=len(table))

    def close(self) -> None:
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.close()

    @property
    def _place(self) -> dict[str, int]:
        chunk, file = divmod(self._number, _CHUNK_FILES)
        return {"chunk_index": chunk, "file_index": file}


class _FeatureStatistics:
    """``most_bytes``: of the rows that are kept for the quantiles of a feature."""

    def __init__(self, features: Mapping[str, Feature], lengths: Sequence[int], most_bytes: int) -> None:
        self._of: dict[str, Statistics] = {}
        for name, each in features.items():
            if each.dtype in (IMAGE, VIDEO):
                images = sum(len(range(0, length, _image_step(length))) for length in lengths)
                pixels = pixel_count(each.shape)
                self._of[name] = Statistics((3, 1, 1), np.float32, images * pixels, most_bytes, pixels)
            else:
                self._of[name] = Statistics(each.shape, each.dtype, sum(lengths), most_bytes)

    def add(self, name: str, rows: npt.NDArray[Any], moments: Moments) -> None:
        self._of[name].add(rows, moments)

    def result(self) -> dict[str, dict[str, npt.NDArray[Any]]]:
        return {name: each.result() for name, each in self._of.items()}


def _image_step(length: int) -> int:
    """Return n, where statistics use every n-th image of an episode."""
    return max(1, -(-length // _IMAGES))


def _type(arrow: Any, feature: Feature) -> Any:
    """Return the type of a column that LeRobot's reader expects."""
    if feature.dtype == IMAGE:
        return arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
    item = arrow.from_numpy_dtype(np.dtype(feature.dtype))
    if feature.shape == (1,):
        return item
    if len(feature.shape) == 1:
        return arrow.list_(item, feature.shape[0])
    return arrow.list_(arrow.list_(item))


def _column(arrow: Any, feature: Feature, rows: npt.NDArray[Any]) -> Any:
    kind = _type(arrow, feature)
    if feature.dtype == IMAGE:
        return arrow.array([{"bytes": png, "path": None} for png in rows], kind)
    items = arrow.array(np.ascontiguousarray(rows).reshape(-1))
    if feature.shape == (1,):
        return items
    if len(feature.shape) == 1:
        return arrow.FixedSizeListArray.from_arrays(items, type=kind)
    per_row, per_list = feature.shape
    lists = arrow.ListArray.from_arrays(np.arange(len(rows) * per_row + 1, dtype=np.int32) * per_list, items)
    return arrow.ListArray.from_arrays(np.arange(len(rows) + 1, dtype=np.int32) * per_row, lists)


def _write_tasks(arrow: Any, tasks: Mapping[str, int], path: Path) -> None:
    table = arrow.table(
        {"task_index": arrow.array(list(tasks.values()), arrow.int64()), "task": arrow.array(list(tasks))}
    )
    number = {"field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    text = {"field_name": "task", "pandas_type": "unicode", "numpy_type": "object"}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [{"name": None, **text, "field_name": None, "metadata": {"encoding": "UTF-8"}}],
        "columns": [{"name": each["field_name"], **each, "metadata": None} for each in (number, text)],
        "creator": {"library": "pyarrow", "version": arrow.__version__},
        "pandas_version": "2.0.0",
    }
    arrow.parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)
