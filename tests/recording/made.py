"""Tables that tests make up, without a driver that would take its time."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware import Namespace, ServiceWriter, Structure
from skinware.conversion.mcap_files import write_recording
from skinware.conversion.tables import COLUMNS, OF_FRAMES, Block, Table
from skinware.memory import segments
from skinware.transfer.generation import Generation
from tests.cli.fake_skin import FakeSkin

START_NS = 1_790_000_000_000_000_000
"""Wall clock of the first frame."""


def generation_of_driver(name: str, structure: Structure) -> Generation:
    """What the frames of a driver with a structure are made of."""
    with FakeSkin(name, structure):
        return Generation(segments.attach(Namespace(), name).head, name)


def generation_of_service(name: str, columns: Mapping[str, Any]) -> Generation:
    """What the frames of a service with some columns are made of."""
    with ServiceWriter(name, columns):
        return Generation(segments.attach(Namespace(), name).head, name)


class MadeTable(Table):
    """Frames full of what a test wants.

    Args:
        generation: of them.
        columns: (n, ...) by name; those that are left out are zeros.
        n: frames.
        rate_hz: of the frames.
        rows: in a block.
        numbers: (n,) of the frames, each a period after the one before; what is left out was lost. Default: 0 to n.
    """

    def __init__(
        self,
        generation: Generation,
        columns: Mapping[str, npt.NDArray[Any]],
        n: int,
        rate_hz: float = 100.0,
        rows: int = 7,
        numbers: npt.ArrayLike | None = None,
    ) -> None:
        super().__init__(generation.name, generation.name, [generation])
        self.columns, self.n, self._period_ns, self._rows = columns, n, round(1e9 / rate_hz), rows
        self._numbers: npt.NDArray[np.int64] = np.arange(n) if numbers is None else np.asarray(numbers, np.int64)

    def blocks(self, names: Collection[str]) -> Iterator[Block]:
        for first in range(0, self.n, self._rows):
            yield {name: self._made(name, np.arange(first, min(first + self._rows, self.n))) for name in names} | {
                name: self._made(name, np.arange(first, min(first + self._rows, self.n))) for name in OF_FRAMES
            }

    def _made(self, name: str, numbers: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
        if name in OF_FRAMES:
            begin = {"time_ns": START_NS, "generation": self.origin.generation, "flags": 0}.get(name[7:], 1 << 40)
            step = {"generation": 0, "flags": 0, "sequence": 1}.get(name[7:], self._period_ns)
            begin = 1 if name.endswith("sequence") else begin
            return (begin + step * self._numbers[numbers]).astype(OF_FRAMES[name])
        shape, dtype = self.arrays[name]
        column = self.columns.get(name.removeprefix(COLUMNS))
        return np.zeros((len(numbers), *shape), dtype) if column is None else column[numbers]


class MadeSource:
    """Such tables as a file would have them."""

    def __init__(self, tables: Sequence[Table], events: Sequence[dict[str, Any]] = ()) -> None:
        self.path = Path("made")
        self.start_ns = START_NS
        self.tables = tables
        self.events = list(events)
        self.clock: list[dict[str, Any]] = []
        self.problems: list[str] = []

    def close(self) -> None:
        """Nothing is open."""


def made_recording(path: Path, structure: Structure, n: int, *, name: str = "torso", seed: int = 1) -> MadeTable:
    """A recording of a driver with noise in it; what is in it."""
    generator = np.random.default_rng(seed)
    generation = generation_of_driver(name, structure)
    shape = (n, structure.n_sensors)
    values = generator.integers(0, 250, shape).astype(structure.dtype)
    status = np.where(generator.random(shape) < 0.01, 1, 0).astype(np.uint8)
    times = (1 << 40) + generator.integers(0, 10**6, (n, structure.n_modules))
    table = MadeTable(generation, {"values": values, "status": status, "module_time_ns": times}, n)
    write_recording(MadeSource([table]), path)
    return table
