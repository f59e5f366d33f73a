"""Make the features of a learning set and their statistics: arrays with a row for each row of the set."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.conversion.learning.wanted import Joined
from skinware.conversion.tables import COLUMNS, TIME, Block, Table, package
from skinware.errors import BadRecording, ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.structure import Structure

MOST_NAMES = 4096
"""Most names of sensors in the description of a feature; the side file has them all."""
IMAGE, VIDEO = "image", "video"
_PNG, _RGB = b"\x89PNG\r\n\x1a\n", (8, 2)
_OF_MODULES, _OF_GROUPS = COLUMNS + "module_time_ns", COLUMNS + "group_time_ns"
_NEEDED = (COLUMNS + "values", COLUMNS + "status", TIME)
_MORE = ("frames/acquired_ns", "frames/published_ns")

Batch = dict[str, npt.NDArray[Any]]
"""Rows of features, by name; images are PNG files as bytes objects."""


class Feature(NamedTuple):
    """The format of a feature's rows.

    Attributes:
        dtype: a numpy name, ``image`` or ``video``.
        shape: of a row; (1,) for one number.
        names: of its numbers or axes; None: no names.
    """

    dtype: str
    shape: tuple[int, ...]
    names: Sequence[str] | None = None


class SkinFeatures:
    """Features of a driver: values and status of each sensor type, and the age of its samples.

    Args:
        sensor_names: in the order of its values.
        window: number of samples in a row, the oldest first.
        period_ns: the driver's nominal period, 0 if it has none.
        longest_ns: values are interpolated between samples that are not further apart; 0: never.

    Attributes:
        interpolated: number of rows with values between two samples.
    """

    def __init__(
        self,
        service: str,
        structure: Structure,
        sensor_names: Sequence[str],
        window: int,
        period_ns: int,
        longest_ns: int = 0,
    ) -> None:
        self._structure, self._window, self._longest_ns = structure, window, longest_ns
        self.interpolated = 0
        self._limits_ns = structure.group_age_limits_ns(period_ns)
        self._prefix = "observation.tactile." + service.replace("/", "_")
        self._types = {
            each.name: structure.index(each.name) for each in structure.types if len(structure.module_of(each.name))
        }
        self._names = sensor_names

    @property
    def descriptions(self) -> dict[str, Feature]:
        described = {}
        for type_name, positions in self._types.items():
            shape: tuple[int, ...] = (len(positions),)
            names = [self._names[position] for position in positions.tolist()] if len(positions) <= MOST_NAMES else None
            if self._window > 1:
                shape, names = (self._window, *shape), ["frame", "sensor"]
            described[f"{self._prefix}.{type_name}"] = Feature("float32", shape, names)
            described[f"{self._prefix}.{type_name}_status"] = Feature("uint8", shape, names)
        if self._longest_ns:
            described[f"{self._prefix}.interpolated"] = Feature("float32", (1,))
        return described | {f"{self._prefix}.age": Feature("float32", (self._window,))}

    def rows(self, frames: Block, numbers: npt.NDArray[np.int64], rows_ns: npt.NDArray[np.int64]) -> Batch:
        """Return the features of t rows.

        Args:
            numbers: (t, window) samples of each row, the newest last; to interpolate (t, 2): the one before and after.
            rows_ns: (t,) time of each row, wall clock.
        """
        if self._longest_ns:
            return self._blended(frames, numbers, rows_ns)
        return self._taken(frames, numbers, rows_ns)

    def _blended(self, frames: Block, numbers: npt.NDArray[np.int64], rows_ns: npt.NDArray[np.int64]) -> Batch:
        before, after = (self._taken(frames, numbers[:, place : place + 1], rows_ns) for place in (0, 1))
        begin_ns, end_ns = frames[TIME][numbers].T
        span_ns = end_ns - begin_ns
        share = np.where(span_ns > 0, (rows_ns - begin_ns) / np.maximum(span_ns, 1), 0.0)
        share = np.where(span_ns <= self._longest_ns, np.clip(share, 0.0, 1.0), 0.0).astype(np.float32)[:, np.newaxis]
        self.interpolated += int(np.count_nonzero(share))
        batch = dict(before)
        for type_name in self._types:
            name = f"{self._prefix}.{type_name}"
            batch[name] = before[name] + share * (after[name] - before[name])
            batch[f"{name}_status"] = before[f"{name}_status"] | np.where(share > 0, after[f"{name}_status"], 0)
        return batch | {f"{self._prefix}.interpolated": share}

    def _taken(self, frames: Block, numbers: npt.NDArray[np.int64], rows_ns: npt.NDArray[np.int64]) -> Batch:
        late_ns = rows_ns - frames[TIME][numbers[:, -1]]
        status = self._status(frames, numbers, late_ns)
        batch: Batch = {}
        for type_name, positions in self._types.items():
            physical = self._structure.physical(frames[COLUMNS + "values"], type_name).astype(np.float32, copy=False)
            batch[f"{self._prefix}.{type_name}"] = self._in_rows(physical[numbers])
            batch[f"{self._prefix}.{type_name}_status"] = self._in_rows(status[..., positions])
        acquired_ns, published_ns = frames["frames/acquired_ns"], frames["frames/published_ns"]
        before_ns = np.where(acquired_ns > 0, published_ns - acquired_ns, 0)
        age_ns = rows_ns[:, np.newaxis] - frames[TIME][numbers] + before_ns[numbers]
        return batch | {f"{self._prefix}.age": (age_ns / NS_PER_S).astype(np.float32)}

    def _status(
        self, frames: Block, numbers: npt.NDArray[np.int64], late_ns: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.uint8]:
        """Return (t, window, n) status, with STALE for data that was too old at the time of the row.

        Older samples of a window count as late as the newest one: a driver that fell silent makes all of them stale.
        """
        times_ns = frames[_OF_GROUPS if _OF_GROUPS in frames else _OF_MODULES]
        time_ns = times_ns[numbers]  # (t, window, groups)
        at_ns = frames["frames/published_ns"][numbers] + late_ns[:, np.newaxis]
        is_old = (time_ns > 0) & (time_ns < at_ns[..., np.newaxis] - self._limits_ns)
        status: npt.NDArray[np.uint8] = frames[COLUMNS + "status"][numbers]
        if is_old.any():
            status |= np.where(is_old[..., self._structure.sensor_group], np.uint8(Status.STALE), np.uint8(0))
        return status

    def _in_rows(self, rows: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return rows if self._window > 1 else rows[:, 0]


class Frames:
    """Samples of a driver by number, read in one pass over its table.

    Args:
        times_ns: (f,) times of all samples, from the pass before.
        window: number of samples that stay available.
    """

    def __init__(self, table: Table, times_ns: npt.NDArray[np.int64], window: int) -> None:
        self._name, self._times_ns, self._window = table.name, times_ns, window
        self._wanted = (*_NEEDED, *_MORE, _OF_GROUPS if _OF_GROUPS in table.arrays else _OF_MODULES)
        self._blocks = table.blocks(self._wanted)
        self._kept: list[tuple[int, Block]] = []
        self._next = 0

    def take(self, numbers: npt.NDArray[np.int64]) -> Block:
        """Return samples by number.

        Args:
            numbers: ascending; at most a window before the last one that was taken.
        """
        needed = int(numbers[-1]) - self._window + 1
        parts: list[Block] = []
        kept: list[tuple[int, Block]] = []
        for first, block in self._until(int(numbers[-1])):
            end = first + len(block[TIME])
            inside = numbers[(numbers >= first) & (numbers < end)] - first
            if len(inside):
                parts.append({name: block[name][inside] for name in self._wanted})
            if end > needed:
                kept.append((first, block))
        self._kept = kept
        taken = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        if not np.array_equal(taken[TIME], self._times_ns[numbers]):
            raise self._changed()
        return taken

    def _until(self, last: int) -> Iterator[tuple[int, Block]]:
        """Yield the kept blocks and then new ones, up to the block with a sample."""
        yield from self._kept
        while self._next <= last:
            block = next(self._blocks, None)
            if block is None:
                raise self._changed()
            first, self._next = self._next, self._next + len(block[TIME])
            yield first, block

    def _changed(self) -> BadRecording:
        return BadRecording(f"{self._name}: the recording changed while it was read")


class JoinedFeature:
    def __init__(self, joined: Joined) -> None:
        self._joined, self.name = joined, joined.name
        if joined.rows.ndim == 1:
            width, height = _png_size(Path(joined.rows[0]))[1:]
            self.description = Feature(IMAGE, (height, width, 3), ["height", "width", "channels"])
        else:
            self.description = Feature("float32", (joined.rows.shape[1],), joined.names)

    def rows(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        """Return (t, n) float32, or (t,) PNG files as bytes objects."""
        chosen = self._joined.rows[numbers]
        if self.description.dtype != IMAGE:
            return chosen
        images = np.empty(len(chosen), object)
        for number, path in enumerate(chosen.tolist()):
            images[number], width, height = _png_size(Path(path))
            if (height, width) != self.description.shape[:2]:
                raise ConfigurationError(f"{path}: {width} x {height}: not as large as the first image")
        return images


def pixels_of(png: bytes) -> npt.NDArray[np.float32]:
    """Return (pixels, 3, 1, 1) float32 of an image, 0 to 1; evenly spaced pixels of a large one."""
    image_module = package("PIL.Image", "data sets with images")
    try:
        with image_module.open(BytesIO(png)) as image:
            pixels = np.asarray(image)
    except (OSError, SyntaxError) as error:
        raise ConfigurationError(f"a PNG file is damaged: {error}") from None
    step = _pixel_step(pixels.shape)
    chosen: npt.NDArray[np.float32] = pixels[::step, ::step].reshape(-1, 3, 1, 1).astype(np.float32)
    return chosen / np.float32(255)


def pixel_count(shape: tuple[int, ...]) -> int:
    """Return the number of pixels that :func:`pixels_of` returns."""
    step = _pixel_step(shape)
    return -(-shape[0] // step) * -(-shape[1] // step)


def _pixel_step(shape: tuple[int, ...]) -> int:
    return max(1, min(shape[:2]) // 150)


def joined_rows(features: Sequence[JoinedFeature], rows: Mapping[str, npt.NDArray[np.int64]], part: slice) -> Batch:
    return {feature.name: feature.rows(rows[feature.name][part]) for feature in features}


def _png_size(path: Path) -> tuple[bytes, int, int]:
    data = path.read_bytes()
    if data[:8] != _PNG or data[12:16] != b"IHDR" or tuple(data[24:26]) != _RGB:
        raise ConfigurationError(f"{path}: images are joined as PNG files with 8 bits of red, green and blue")
    if data[-8:-4] != b"IEND":
        raise ConfigurationError(f"{path}: cut off")
    width, height = struct.unpack(">II", data[16:24])
    return data, width, height


QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", "count", *QUANTILES)
_SAMPLE_ROWS, _LEAST_ROWS = 1000, 32
"""Most rows kept for quantiles; and least, however large they are."""
_AT_ONCE = 4096

Numbers = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Moments:
    """Moments of rows.

    Attributes:
        least, greatest, mean: (...) of each number of a row.
        squares: (...) sum of the squared differences from the mean.
    """

    count: int
    least: Numbers
    greatest: Numbers
    mean: Numbers
    squares: Numbers

    @classmethod
    def of(cls, rows: npt.NDArray[Any]) -> Moments:
        mean = rows.mean(axis=0, dtype=np.float64)
        difference = rows - mean
        squares = np.einsum("m...,m...->...", difference, difference)
        return cls(len(rows), rows.min(axis=0).astype(float), rows.max(axis=0).astype(float), mean, squares)

    def with_(self, other: Moments) -> Moments:
        count = self.count + other.count
        apart = other.mean - self.mean
        return Moments(
            count,
            np.minimum(self.least, other.least),
            np.maximum(self.greatest, other.greatest),
            self.mean + apart * (other.count / count),
            self.squares + other.squares + apart * apart * (self.count * other.count / count),
        )


class ChosenRows:
    """Evenly chosen rows of the ``rows`` that are added, of ``most_bytes`` at most."""

    def __init__(self, shape: tuple[int, ...], dtype: npt.DTypeLike, rows: int, most_bytes: int) -> None:
        row_bytes = np.dtype(dtype).itemsize * math.prod(shape)
        kept = min(max(most_bytes // row_bytes, _LEAST_ROWS), _SAMPLE_ROWS)
        self._step = max(1, -(-rows // kept))
        self._seen = self._kept = 0
        self._rows = np.zeros((-(-rows // self._step), *shape), dtype)

    def add(self, rows: npt.NDArray[Any]) -> None:
        chosen = rows[-self._seen % self._step :: self._step]
        self._rows[self._kept : self._kept + len(chosen)] = chosen
        self._kept += len(chosen)
        self._seen += len(rows)

    def quantiles(self) -> dict[str, Numbers]:
        rows = self._rows[: self._kept].reshape(self._kept, -1)
        found = np.zeros((len(QUANTILES), rows.shape[1]))
        for first in range(0, rows.shape[1], _AT_ONCE):  # all at once would copy the whole sample
            part = slice(first, first + _AT_ONCE)
            found[:, part] = np.quantile(rows[:, part], list(QUANTILES.values()), axis=0)
        return dict(zip(QUANTILES, found.reshape(-1, *self._rows.shape[1:]), strict=True))


class Statistics:
    """Statistics of the rows of a feature; ``most_bytes``: of the rows that are kept for quantiles."""

    def __init__(
        self, shape: tuple[int, ...], dtype: npt.DTypeLike, rows: int, most_bytes: int, per_item: int = 1
    ) -> None:
        self._sample, self._per_item = ChosenRows(shape, dtype, rows, most_bytes), per_item
        self._moments: Moments | None = None

    def add(self, rows: npt.NDArray[Any], moments: Moments) -> None:
        """Add (m, ...) rows, at least one, with their moments."""
        self._sample.add(rows)
        self._moments = moments if self._moments is None else self._moments.with_(moments)

    def result(self) -> dict[str, npt.NDArray[Any]]:
        """Return :data:`STATISTICS`, each (...), but ``count``: (1,); at least one row must have been added."""
        moments = self._moments
        assert moments is not None  # noqa: S101, there were rows
        return {
            "min": moments.least,
            "max": moments.greatest,
            "mean": moments.mean,
            "std": np.sqrt(moments.squares / moments.count),
            "count": np.array([moments.count // self._per_item]),
            **self._sample.quantiles(),
        }
