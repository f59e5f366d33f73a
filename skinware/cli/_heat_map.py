"""From a frame to coloured squares: which sensor is drawn where, in which of a few codes. Pure functions.

A *pixel* is one column wide and half a line high, so that it looks square; a sensor is a square of ``zoom`` by ``zoom``
pixels. What is drawn of a sensor is its *code*: ``mark * LEVELS + level``, where the mark tells its status (0 = fresh)
and the level its value. Few codes mean few redraws: that keeps a terminal over ssh usable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.status import Status
from skinware.structure import Structure

LEVELS = 16
FRESH, STALE, OUT_OF_RANGE, SUSPECT, NO_ACK, MASKED, NEVER_SEEN, NOT_CONNECTED = range(8)
FIRST_WITHOUT_VALUE = NO_ACK
"""From this mark on, the value means nothing and is not drawn."""
BACKGROUND = 255
"""Code of a pixel that is no sensor."""

_HOLD = 0.75
"""A level is kept while the value is within so many levels of its middle: noise on an edge does not flicker."""
_NUMBER_ROOM = 2
_SIZES = (
    (8, _NUMBER_ROOM),
    (8, 0),
    (6, _NUMBER_ROOM),
    (6, 0),
    (4, _NUMBER_ROOM),
    (4, 0),
    (2, _NUMBER_ROOM),
    (2, 0),
    (1, 0),
)
"""Zooms, and room in pixels above a block for the number of its module; the first that fits is taken."""
_LONGEST_NAME = 16
_NAMES_FROM_WIDTH = 48
_MARK_BITS = (
    (NOT_CONNECTED, Status.NOT_CONNECTED),
    (NEVER_SEEN, Status.NEVER_SEEN),
    (MASKED, Status.MASKED),
    (NO_ACK, Status.NO_ACK),
    (STALE, Status.STALE),
    (SUSPECT, Status.SUSPECT),
    (OUT_OF_RANGE, Status.OUT_OF_RANGE),
)
"""Which mark wins where a sensor has several bits: the first."""


def marks_of(status: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """(n,) uint8: the one mark that each sensor is drawn with."""
    marks = np.full(len(status), FRESH, np.uint8)
    marks[status != 0] = SUSPECT  # a bit that this version does not know
    for mark, bit in reversed(_MARK_BITS):
        marks[(status & np.uint8(bit)) != 0] = mark
    return marks


def levels_of(
    values: npt.NDArray[np.float32], low: float, high: float, before: npt.NDArray[np.uint8] | None = None
) -> npt.NDArray[np.uint8]:
    """(n,) uint8, 0 to 15: where values lie between ``low`` and ``high``.

    Args:
        values: (n,) physical values.
        low: what is level 0.
        high: what is level 15.
        before: the levels drawn so far, which are kept as long as they are nearly right.
    """
    span = high - low if high > low else 1.0
    exact = np.clip(np.nan_to_num((values - low) / span), 0.0, 1.0) * LEVELS
    levels: npt.NDArray[np.uint8] = np.minimum(exact, LEVELS - 1).astype(np.uint8)
    if before is None:
        return levels
    return np.where(np.abs(exact - (before + 0.5)) <= _HOLD, before, levels)


def codes_of(levels: npt.NDArray[np.uint8], marks: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """(n,) uint8: the codes of sensors with these levels and marks."""
    return marks * np.uint8(LEVELS) + np.where(marks < FIRST_WITHOUT_VALUE, levels, np.uint8(0))


@dataclass(frozen=True)
class Label:
    """A word beside or above sensors, at a column of the terminal."""

    column: int
    text: str


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Where sensors are drawn.

    Attributes:
        sensors: (n,) int64, positions in a frame of the sensors that are drawn.
        pixels: (2 * lines, columns) int64, index into ``sensors`` of the sensor at each pixel; -1 = none.
        labels: words in the free places, by line of the terminal.
        zoom: pixels along the side of a sensor.
    """

    sensors: npt.NDArray[np.int64]
    pixels: npt.NDArray[np.int64]
    labels: Mapping[int, Sequence[Label]]
    zoom: int

    @property
    def lines(self) -> int:
        """Height in lines of the terminal."""
        return len(self.pixels) // 2

    @property
    def columns(self) -> int:
        """Width in columns of the terminal."""
        return int(self.pixels.shape[1])

    def draw(self, codes: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """(2 * lines, columns) uint8: the code of every pixel, from the codes of ``sensors``."""
        return np.append(codes, np.uint8(BACKGROUND))[self.pixels]  # pixel -1 is the last one

    def sensor_at(self, line: int, column: int) -> int | None:
        """Position in a frame of the sensor at a place of the terminal, None between sensors."""
        if not (0 <= line < self.lines and 0 <= column < self.columns):
            return None
        upper, lower = (int(pixel) for pixel in self.pixels[2 * line : 2 * line + 2, column])
        found = upper if upper >= 0 else lower
        return int(self.sensors[found]) if found >= 0 else None


def arrange(structure: Structure, patches: Sequence[int], type_name: str, width: int, height: int) -> Arrangement:
    """Lay out the sensors of one type on some patches, module by module, as large as they fit.

    What does not fit even at one pixel a sensor becomes higher than ``height`` (and is scrolled).

    Args:
        structure: what they belong to.
        patches: which patches; more than one are drawn below each other with their names.
        type_name: which sensors.
        width: columns of the terminal.
        height: lines of the terminal.

    Raises:
        StructureError: there is no such type.
    """
    wanted = np.zeros(structure.n_sensors, bool)
    wanted[structure.index(type_name)] = True
    wanted &= np.isin(structure.sensor_patch, np.asarray(patches, np.uint32))
    positions = np.flatnonzero(wanted)
    order = np.argsort(structure.sensor_module[positions], kind="stable")
    positions = positions[order]
    if not len(positions):
        return Arrangement(positions, np.full((0, 1), -1, np.int64), {}, 1)
    modules, starts = np.unique(structure.sensor_module[positions], return_index=True)
    blocks = [
        _Block(module, int(structure.module_patch[module]), start, end)
        for module, start, end in zip(modules.tolist(), starts, [*starts[1:], len(positions)], strict=True)
    ]
    names = {patch: structure.patch_name[patch].decode() for patch in patches} if len(patches) > 1 else {}
    grid = _choose_grid(blocks, names, max(8, width), max(1, height))
    return _place(blocks, names, grid, positions)


def block_columns(count: int) -> int:
    """How many of ``count`` sensors of a module are drawn side by side: a compact block with few empty places."""
    narrowest = math.isqrt(count - 1) + 1
    widest = max(narrowest, int(2.5 * math.sqrt(count)))
    return min(range(narrowest, widest + 1), key=lambda columns: (-count % columns, columns))


@dataclass(frozen=True)
class _Block:
    """The sensors of one module: from ``start`` to ``end`` of those that are drawn."""

    module: int
    patch: int
    start: int
    end: int


@dataclass(frozen=True)
class _Grid:
    """Equal places for all blocks. Sizes in pixels, but ``margin``: columns for the names of patches."""

    zoom: int
    columns: int
    """Sensors side by side in a block."""
    rows: int
    """Sensors above each other in a block."""
    per_line: int
    """Blocks side by side."""
    head: int
    """Room above a block for its number; 0 = no numbers."""
    gap: int
    """Room below a block."""
    margin: int

    @property
    def width(self) -> int:
        return self.columns * self.zoom

    @property
    def pitch(self) -> int:
        """From the top of a block to that of the one below."""
        return self.head + self.rows * self.zoom + self.gap

    def group_lines(self, count: int) -> int:
        """Lines of the terminal for ``count`` blocks of one patch, with the gap below."""
        return math.ceil(math.ceil(count / self.per_line) * self.pitch / 2)

    def lines(self, groups: list[list[_Block]]) -> int:
        """Lines of the terminal for everything, without the last gap."""
        *above, last = (len(group) for group in groups)
        last_pixels = math.ceil(last / self.per_line) * self.pitch - self.gap
        return sum(self.group_lines(count) for count in above) + math.ceil(last_pixels / 2)


def _choose_grid(blocks: list[_Block], names: dict[int, str], width: int, height: int) -> _Grid:
    """The largest zoom at which everything fits, else the smallest."""
    largest = max(block.end - block.start for block in blocks)
    margin = min(_LONGEST_NAME, max(map(len, names.values()))) + 2 if names and width >= _NAMES_FROM_WIDTH else 0
    room = width - margin
    number_width = len(str(blocks[-1].module))
    groups = _by_patch(blocks)
    longest = max(len(group) for group in groups)
    for zoom, head in _SIZES:
        columns = min(block_columns(largest), max(1, room // zoom))
        gap = 2 if zoom > 1 else 1
        most = max(1, (room + gap) // (columns * zoom + gap))
        rows_of_blocks = math.ceil(longest / most)
        grid = _Grid(
            zoom=zoom,
            columns=columns,
            rows=math.ceil(largest / columns),
            per_line=math.ceil(longest / rows_of_blocks),
            head=head,
            gap=0 if head else gap,
            margin=margin,
        )
        if head and (len(blocks) == 1 or number_width > grid.width):
            continue
        if grid.columns == block_columns(largest) and grid.lines(groups) <= height:
            return grid
    return grid


def _place(blocks: list[_Block], names: dict[int, str], grid: _Grid, positions: npt.NDArray[np.int64]) -> Arrangement:
    groups = _by_patch(blocks)
    gap = 2 if grid.zoom > 1 else 1
    across = grid.width + gap
    width = grid.margin + grid.per_line * across - gap
    height = 2 * sum(grid.group_lines(len(group)) for group in groups)
    pixels = np.full((height, width), -1, np.int64)
    labels: dict[int, list[Label]] = {}
    line = 0
    for group in groups:
        if grid.margin:
            name = names[group[0].patch]
            labels.setdefault(line + (1 if grid.head else 0), []).append(Label(0, name[:_LONGEST_NAME]))
        for number, block in enumerate(group):
            top = 2 * line + number // grid.per_line * grid.pitch
            left = grid.margin + number % grid.per_line * across
            if grid.head:
                labels.setdefault(top // 2, []).append(Label(left, str(block.module)))
            cells = np.full(grid.rows * grid.columns, -1, np.int64)
            cells[: block.end - block.start] = np.arange(block.start, block.end)
            square = cells.reshape(grid.rows, grid.columns).repeat(grid.zoom, axis=0).repeat(grid.zoom, axis=1)
            top += grid.head
            pixels[top : top + len(square), left : left + grid.width] = square
        line += grid.group_lines(len(group))
    return Arrangement(positions, pixels[: 2 * grid.lines(groups)], labels, grid.zoom)


def _by_patch(blocks: list[_Block]) -> list[list[_Block]]:
    groups: dict[int, list[_Block]] = {}
    for block in blocks:
        groups.setdefault(block.patch, []).append(block)
    return list(groups.values())
