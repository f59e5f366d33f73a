"""Place sensors as coloured squares, each in one of a few codes. Pure functions.

A *pixel* is one column wide and half a line high, so that it looks square; a sensor is a square of ``zoom`` by ``zoom``
pixels. A sensor is drawn in its *code*, ``mark * LEVELS + level``: the mark is its status (0 = fresh), the level its
value. Few codes mean few redraws, which keeps a terminal over ssh usable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.status import Status
from skinware.structure import Structure
from skinware.views.scene import ModuleShape, rows_of, shape_of

LEVELS = 16
FRESH, STALE, OUT_OF_RANGE, SUSPECT, UNHEALTHY, NO_ACK, MASKED, NEVER_SEEN, NOT_CONNECTED, SETTLING = range(10)
FIRST_WITHOUT_VALUE = NO_ACK
"""From this mark on, the level means nothing and is not drawn."""
BACKGROUND = 255
"""Code of a pixel without a sensor."""

_HOLD = 0.75
"""A level stays while the value is within this many levels of its middle, so that noise on an edge does not flicker."""
_LABEL_ROOM = 2
_SIZES = tuple((zoom, room) for zoom in (8, 6, 4, 2, 1) for room in (_LABEL_ROOM, 0))
"""Zooms, and pixels above a block for the name of its module; the first that fits is used."""
_LONGEST_NAME = 16
_NAMES_FROM_WIDTH = 48
_MARK_BITS = (
    (NOT_CONNECTED, Status.NOT_CONNECTED),
    (NEVER_SEEN, Status.NEVER_SEEN),
    (MASKED, Status.MASKED),
    (NO_ACK, Status.NO_ACK),
    (STALE, Status.STALE),
    (SUSPECT, Status.SUSPECT),
    (UNHEALTHY, Status.UNHEALTHY),
    (OUT_OF_RANGE, Status.OUT_OF_RANGE),
)
"""The marks of status bits; the first one wins where a sensor has several."""
_MARK_OF = np.array([next((m for m, bit in _MARK_BITS if status & bit), FRESH) for status in range(256)], np.uint8)


def marks_of(status: npt.NDArray[np.uint8], settling: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """Return (n,) uint8, the mark of each sensor; ``settling`` ones were seen, and wait for baselines."""
    marks: npt.NDArray[np.uint8] = _MARK_OF[status]
    marks[settling & (marks == NEVER_SEEN)] = SETTLING
    return marks


def levels_of(
    values: npt.NDArray[np.float32], low: float, high: float, before: npt.NDArray[np.uint8] | None = None
) -> npt.NDArray[np.uint8]:
    """Return (n,) uint8, 0 to 15: where values lie; levels ``before`` stay while they are nearly right."""
    span = high - low if high > low else 1.0
    exact = np.clip(np.nan_to_num((values - low) / span), 0.0, 1.0) * LEVELS
    levels: npt.NDArray[np.uint8] = np.minimum(exact, LEVELS - 1).astype(np.uint8)
    if before is None:
        return levels
    return np.where(np.abs(exact - (before + 0.5)) <= _HOLD, before, levels)


def codes_of(levels: npt.NDArray[np.uint8], marks: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    return marks * np.uint8(LEVELS) + np.where(marks < FIRST_WITHOUT_VALUE, levels, np.uint8(0))


@dataclass(frozen=True)
class Label:
    """A word at a column of the terminal.

    Attributes:
        is_mark: it stands over sensors and marks something there; otherwise it stands beside or above them.
    """

    column: int
    text: str
    is_mark: bool = False


@dataclass(frozen=True, eq=False)
class Arrangement:
    """The places of sensors in a picture.

    Attributes:
        sensors: (n,) int64, positions in a snapshot of the sensors that are drawn.
        pixels: (2 * lines, columns) int64, index into ``sensors`` of the sensor at each pixel; -1 = none.
        labels: words in free places, by line of the terminal.
        zoom: pixels along the side of a sensor.
    """

    sensors: npt.NDArray[np.int64]
    pixels: npt.NDArray[np.int64]
    labels: Mapping[int, Sequence[Label]]
    zoom: int

    @property
    def lines(self) -> int:
        return len(self.pixels) // 2

    @property
    def columns(self) -> int:
        return int(self.pixels.shape[1])

    def draw(self, codes: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return (2 * lines, columns) uint8, the code of every pixel, from the codes of ``sensors``."""
        return np.append(codes, np.uint8(BACKGROUND))[self.pixels]  # pixel -1 is the last one

    def limited(self, only: npt.NDArray[np.bool_]) -> Arrangement:
        """Return the same picture with some of its sensors, (n_sensors,) bool."""
        stays = only[self.sensors]
        number = np.append(np.where(stays, np.cumsum(stays) - 1, -1), -1)  # pixel -1 is the last one
        return Arrangement(self.sensors[stays], number[self.pixels], self.labels, self.zoom)

    def sensor_at(self, line: int, column: int) -> int | None:
        """Return the position in a snapshot of the sensor at a place of the terminal, None between sensors."""
        if not (0 <= line < self.lines and 0 <= column < self.columns):
            return None
        upper, lower = (int(pixel) for pixel in self.pixels[2 * line : 2 * line + 2, column])
        found = upper if upper >= 0 else lower
        return int(self.sensors[found]) if found >= 0 else None


def arrange(
    structure: Structure,
    patches: Sequence[int],
    type_name: str,
    width: int,
    height: int,
    *,
    smallest: int = 1,
    only: npt.NDArray[np.bool_] | None = None,
) -> Arrangement:
    """Place the sensors of one type on some patches, module by module, as large as they fit.

    A picture that does not fit at the smallest size is higher than ``height``, and is scrolled; modules whose names are
    words keep them then.

    Args:
        patches: to draw; several are drawn below each other with their names.
        smallest: pixels along the side of the smallest sensor: 1, or 2 where each needs a whole character.
        only: (n_sensors,) bool, sensors of a region; other sensors are left out, and modules without any of these.
    """
    wanted = np.zeros(structure.n_sensors, bool)
    wanted[structure.index(type_name)] = True
    wanted &= np.isin(structure.sensor_patch, np.asarray(patches, np.uint32))
    if only is not None:
        wanted &= np.isin(structure.sensor_module, structure.sensor_module[wanted & only])
    positions = np.flatnonzero(wanted)
    order = np.argsort(structure.sensor_module[positions], kind="stable")
    positions = positions[order]
    if not len(positions):
        return Arrangement(positions, np.full((0, 1), -1, np.int64), {}, 1)
    modules, starts = np.unique(structure.sensor_module[positions], return_index=True)
    blocks = [
        _Block(module, int(structure.module_patch[module]), structure.module_kind[module].decode(), start, end)
        for module, start, end in zip(modules.tolist(), starts, [*starts[1:], len(positions)], strict=True)
    ]
    labels = [
        structure.module_names[block.module].removeprefix(structure.patch_names[block.patch]).removeprefix(", ")
        for block in blocks
    ]
    patches = sorted({block.patch for block in blocks}) if only is not None else patches
    names = {patch: structure.patch_names[patch] for patch in patches} if len(patches) > 1 else {}
    grid = _choose_grid(blocks, labels, names, max(8, width), max(1, height), smallest)
    arrangement = _place(blocks, labels, names, grid, positions)
    return arrangement if only is None else arrangement.limited(only)


def _short(label: str) -> str:
    """Return the number at the end of a name, or else the name."""
    last = label.rpartition(" ")[2]
    return last if last.isdigit() else label


@dataclass(frozen=True)
class _Block:
    """The sensors of one module: from ``start`` to ``end`` of all that are drawn."""

    module: int
    patch: int
    kind: str
    start: int
    end: int

    def shape(self, compact: bool) -> ModuleShape:
        return shape_of("" if compact else self.kind, self.end - self.start)


@dataclass(frozen=True)
class _Grid:
    """Equal places for all blocks. Sizes in pixels, but ``margin``: columns for the names of patches."""

    zoom: int
    halves: int
    """Half sensors side by side in a block."""
    rows: int
    """Sensors above each other in a block."""
    per_line: int
    """Blocks side by side."""
    head: int
    """Room above a block for its name; 0 = no names."""
    gap: int
    """Room below a block."""
    margin: int
    compact: bool
    """Draw every block as a rectangle, which takes less room than other shapes."""
    name: int
    """Columns of the longest name above a block."""

    @property
    def width(self) -> int:
        """Columns of a place: those of a block, or of a longer name."""
        return max((self.halves * self.zoom + 1) // 2, self.name)

    @property
    def pitch(self) -> int:
        """Pixels from the top of a block to the top of the next one below; names need whole lines."""
        pitch = self.head + self.rows * self.zoom + self.gap
        return pitch + pitch % 2 if self.head else pitch

    def group_lines(self, count: int) -> int:
        """Return the lines of the terminal for ``count`` blocks of one patch, with the gap below."""
        return math.ceil(math.ceil(count / self.per_line) * self.pitch / 2)

    def lines(self, groups: list[list[_Block]]) -> int:
        *above, last = (len(group) for group in groups)
        last_pixels = math.ceil(last / self.per_line) * self.pitch - self.gap
        return sum(self.group_lines(count) for count in above) + math.ceil(last_pixels / 2)

    def shape(self, block: _Block) -> ModuleShape:
        """Return the shape in which a block is drawn: its own, unless that is too wide."""
        own = block.shape(self.compact)
        return own if own.halves <= self.halves else rows_of(len(own.cells), self.halves // 2)


def _choose_grid(
    blocks: list[_Block], labels: list[str], names: dict[int, str], width: int, height: int, smallest: int
) -> _Grid:
    """Return the grid with the largest zoom at which everything fits, or else the smallest."""
    margin = min(_LONGEST_NAME, max(map(len, names.values()))) + 2 if names and width >= _NAMES_FROM_WIDTH else 0
    room = width - margin
    label_width = max(len(_short(label)) for label in labels)
    groups = _by_patch(blocks)
    longest = max(len(group) for group in groups)
    named: _Grid | None = None
    sizes = [(zoom, head, False) for zoom, head in _SIZES if zoom >= smallest]
    for zoom, head, compact in [*sizes, (smallest, 0, True)]:
        shapes = {block.shape(compact) for block in blocks}
        natural = max(shape.halves for shape in shapes)
        halves = min(natural, 2 * max(1, room // zoom))
        fits = halves == natural
        gap = 2 if zoom > 1 else 1
        name = label_width if head else 0
        most = max(1, (room + gap) // (max((halves * zoom + 1) // 2, name) + gap))
        rows_of_blocks = math.ceil(longest / most)
        grid = _Grid(
            zoom=zoom,
            halves=halves,
            rows=max(s.rows if s.halves <= halves else math.ceil(len(s.cells) / (halves // 2)) for s in shapes),
            per_line=math.ceil(longest / rows_of_blocks),
            head=head,
            gap=0 if head else gap,
            margin=margin,
            compact=compact,
            name=name,
        )
        if head and (len(blocks) == 1 or not 0 < label_width <= room):
            continue
        if fits and grid.lines(groups) <= height:
            return grid
        if head and zoom == smallest and not all(_short(label).isdigit() for label in labels):
            named = grid
    return named or grid


def _place(
    blocks: list[_Block], labels: list[str], names: dict[int, str], grid: _Grid, positions: npt.NDArray[np.int64]
) -> Arrangement:
    groups = _by_patch(blocks)
    gap = 2 if grid.zoom > 1 else 1
    across = grid.width + gap
    width = grid.margin + grid.per_line * across - gap
    height = 2 * sum(grid.group_lines(len(group)) for group in groups)
    pixels = np.full((height, width), -1, np.int64)
    words: dict[int, list[Label]] = {}
    line = 0
    if max(map(len, labels)) > grid.width:
        labels = [_short(label) for label in labels]
    label_of = {block.module: label for block, label in zip(blocks, labels, strict=True)}
    for group in groups:
        if grid.margin:
            name = names[group[0].patch]
            words.setdefault(line + (1 if grid.head else 0), []).append(Label(0, name[:_LONGEST_NAME]))
        for number, block in enumerate(group):
            top = 2 * line + number // grid.per_line * grid.pitch
            left = grid.margin + number % grid.per_line * across
            if grid.head:
                words.setdefault(top // 2, []).append(Label(left, label_of[block.module]))
            top += grid.head
            for sensor, (row, half) in enumerate(grid.shape(block).cells, block.start):
                y, x = top + row * grid.zoom, left + half * grid.zoom // 2
                pixels[y : y + grid.zoom, x : x + grid.zoom] = sensor
        line += grid.group_lines(len(group))
    return Arrangement(positions, pixels[: 2 * grid.lines(groups)], words, grid.zoom)


def _by_patch(blocks: list[_Block]) -> list[list[_Block]]:
    groups: dict[int, list[_Block]] = {}
    for block in blocks:
        groups.setdefault(block.patch, []).append(block)
    return list(groups.values())
