"""Recorded samples as datasets: windows by number, or a stream; arrays and tensors share one piece of memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import skinware.recording
from skinware.errors import ConfigurationError, MissingExtra
from skinware.recording.tracks import Series, Track
from skinware.structure import Structure

_GAP_PERIODS = 1.5
"""A longer time between two samples than so many periods is a gap."""

Item = dict[str, npt.NDArray[Any]]
"""``values`` and ``fresh`` of the sensors, and ``time_s`` since the recording began."""


class _Stretch(NamedTuple):
    """Samples without a gap, and the number of their first window."""

    values: npt.NDArray[np.floating[Any]]
    fresh: npt.NDArray[np.bool_]
    time_s: npt.NDArray[np.float64]
    first: int


class RecordedWindows(Sequence[Item]):
    """All windows of consecutive samples of a driver's sensors, in memory, over one or more recordings.

    A window never spans a gap (lost samples, silence, a restart) or two recordings. An item has ``values`` (window, n)
    float32, ``fresh`` (window, n) bool and ``time_s`` (window,) float64. Its arrays are read-only views: no copy.

    Args:
        paths: of recordings.
        type_name: which sensors; all recordings have the same ones.
        driver: name of the driver; default: the only one with such sensors.
        window: samples in a window.
        step: samples from the beginning of one window to the next.

    Attributes:
        structure: of the driver, with these sensors alone.

    Raises:
        BadRecording: a file is not a recording.
        ConfigurationError: no driver, several, or with different sensors; a window or step below 1.
        StructureError: the driver has no such sensors.
        OSError: a file cannot be read.
    """

    def __init__(
        self, *paths: str | Path, type_name: str, driver: str | None = None, window: int = 1, step: int = 1
    ) -> None:
        if window < 1 or step < 1:
            raise ConfigurationError(f"windows of {window} samples, {step} apart: give at least 1")
        self._window, self._step, self._length = window, step, 0
        self._stretches: list[_Stretch] = []
        known: Structure | None = None
        for path in paths:
            with skinware.recording.open(path) as recording:
                for part in _track(recording, type_name, driver).parts:
                    if known not in (None, part.structure):
                        raise ConfigurationError(f"{path}: other sensors than before; make a dataset of each structure")
                    known = part.structure
                    self._add(part.read(type_name=type_name), type_name)
        if known is None:
            raise ConfigurationError("a dataset of no recording: give at least one")
        self.structure: Structure = known.only(known.span(type_name))

    def _add(self, series: Series, type_name: str) -> None:
        values, fresh = series.physical(type_name), series.fresh(type_name)
        for array in (values, fresh, series.time_s):
            array.flags.writeable = False
        period_s = series.origin.period_ns / 1e9
        ends = (np.diff(series.sequence.astype(np.int64)) != 1) | (np.diff(series.generation.astype(np.int64)) != 0)
        if period_s:
            ends |= np.diff(series.time_s) > max(_GAP_PERIODS * period_s, 0.2)
        bounds = [0, *(np.flatnonzero(ends) + 1).tolist(), len(series)]
        for begin, end in pairwise(bounds):
            if end - begin >= self._window:
                self._stretches.append(
                    _Stretch(values[begin:end], fresh[begin:end], series.time_s[begin:end], self._length)
                )
                self._length += (end - begin - self._window) // self._step + 1

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, number: Any) -> Any:
        """Return the item of a number, or those of a slice as a list."""
        if isinstance(number, slice):
            return [self[each] for each in range(*number.indices(len(self)))]
        number = range(len(self))[number]
        place = int(np.searchsorted([each.first for each in self._stretches], number, side="right")) - 1
        stretch = self._stretches[place]
        begin = (number - stretch.first) * self._step
        rows = slice(begin, begin + self._window)
        return {"values": stretch.values[rows], "fresh": stretch.fresh[rows], "time_s": stretch.time_s[rows]}

    def __repr__(self) -> str:
        return f"<RecordedWindows: {len(self)} of {self._window} samples of {self.structure.n_sensors} sensors>"


class StreamedSamples:
    """The samples of a driver's sensors one after the other, for recordings that memory cannot hold.

    Iterating reads the files from the beginning, a quarter of a second at a time. An item has ``values`` (n,) float32,
    ``fresh`` (n,) bool and ``time_s`` (1,) float64: views of what was read, without a copy.

    Args:
        paths: of recordings.
        type_name: which sensors.
        driver: name of the driver; default: the only one with such sensors.

    Raises:
        BadRecording, ConfigurationError, StructureError, OSError: as :class:`RecordedWindows`, when iterating.
    """

    def __init__(self, *paths: str | Path, type_name: str, driver: str | None = None) -> None:
        self.paths: tuple[str | Path, ...] = paths
        self._type_name, self._driver = type_name, driver

    def __iter__(self) -> Iterator[Item]:
        return self.share(0, 1)

    def share(self, number: int, count: int) -> Iterator[Item]:
        """Yield one of ``count`` equal shares: the recordings number, number + count and so on."""
        for path in self.paths[number::count]:
            with skinware.recording.open(path) as recording:
                for part in _track(recording, self._type_name, self._driver).parts:
                    for block in part.blocks(type_name=self._type_name):
                        values, fresh = block.physical(self._type_name), block.fresh(self._type_name)
                        for row in range(len(block)):
                            yield {"values": values[row], "fresh": fresh[row], "time_s": block.time_s[row : row + 1]}


def torch_dataset(windows: Sequence[Item]) -> Any:
    """Return a ``torch.utils.data.Dataset`` whose items are tensors in the memory of the windows' arrays.

    Do not write into these tensors: windows overlap.

    Raises:
        MissingExtra: torch is not installed.
    """
    torch = _torch()

    class OfWindows:
        def __len__(self) -> int:
            return len(windows)

        def __getitem__(self, number: int) -> dict[str, Any]:
            return _tensors(torch, windows[number])

        def __reduce__(self) -> tuple[Any, ...]:  # for workers that are not forked
            return torch_dataset, (windows,)

    return type("TorchWindows", (OfWindows, torch.utils.data.Dataset), {})()


def torch_iterable(samples: StreamedSamples) -> Any:
    """Return a ``torch.utils.data.IterableDataset`` of a stream, whose workers read different recordings.

    Raises:
        MissingExtra: torch is not installed.
    """
    torch = _torch()

    class OfStream:
        def __iter__(self) -> Iterator[dict[str, Any]]:
            worker = torch.utils.data.get_worker_info()
            share = (0, 1) if worker is None else (worker.id, worker.num_workers)
            return (_tensors(torch, item) for item in samples.share(*share))

        def __reduce__(self) -> tuple[Any, ...]:
            return torch_iterable, (samples,)

    return type("TorchStream", (OfStream, torch.utils.data.IterableDataset), {})()


def _tensors(torch: Any, item: Item) -> dict[str, Any]:
    """Tensors in the memory of arrays, which may be read-only: torch has no such flag, and would warn."""
    return {name: torch.from_numpy(np.asarray(_Writable(array))) for name, array in item.items()}


class _Writable:
    """An array for consumers that do not write, but ask for memory in which they could."""

    def __init__(self, array: npt.NDArray[Any]) -> None:
        interface = dict(array.__array_interface__)
        interface["data"] = (interface["data"][0], False)
        self.__array_interface__ = interface
        self._owner = array


def _torch() -> Any:
    try:
        import torch
        import torch.utils.data
    except ImportError:
        raise MissingExtra.of("tensors", "torch") from None
    return torch


def _track(recording: skinware.recording.Recording, type_name: str, driver: str | None) -> Track:
    if driver is not None:
        return recording[driver]
    with_type = [
        name
        for name in recording.drivers
        if any(each.name == type_name for part in recording[name].parts for each in part.structure.types)
    ]
    if len(with_type) != 1:
        found = f"drivers with {type_name}: {', '.join(with_type)}" if with_type else f"no driver with {type_name}"
        raise ConfigurationError(f"{recording.path}: {found}; give driver=, one of: {', '.join(recording.drivers)}")
    return recording[with_type[0]]
