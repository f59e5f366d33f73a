"""Draw the skin as one viewer chooses by operations: a mode, a quantity, the values between which it is drawn."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.views.following import ShownDriver
from skinware.views.history import DriverRest, Memory, WipeTest, threshold
from skinware.views.quantities import HIGHEST, Levels, Newest, Quantity, levels_of, shear_of

Mode = Literal["raw", "change", "peak", "wipe"]

DEFAULT_FPS = 30.0

MOST_EXACT = 32
"""Sensors whose exact values are sent, and lines of plots, at most."""
MOST_MODULES = 4096

Number = Annotated[int, msgspec.Meta(ge=0, le=2**31)]


class Next(msgspec.Struct, tag_field="op", tag="next"):
    protocol: str | None = None


class Choose(msgspec.Struct, tag_field="op", tag="look"):
    mode: Mode = "raw"
    type: str | None = None
    scale: tuple[float, float] | None = None
    fps: Annotated[float, msgspec.Meta(ge=1, le=60)] = DEFAULT_FPS

    def __post_init__(self) -> None:
        if self.scale is not None and not (all(map(math.isfinite, self.scale)) and self.scale[0] < self.scale[1]):
            raise ValueError(f"scale {list(self.scale)}: give two numbers, the lower one first")


class Exact(msgspec.Struct, tag_field="op", tag="exact"):
    """Choose the sensors whose exact values are sent, as pairs of driver and position."""

    sensors: Annotated[list[tuple[Number, Number]], msgspec.Meta(max_length=MOST_EXACT)]


class Names(msgspec.Struct, tag_field="op", tag="names"):
    """Ask for the names of the sensors of a driver's quantity."""

    driver: Number
    type: str


class Line(msgspec.Struct, frozen=True):
    """A line of a plot: a taxel, the sum of modules, the load of a contact, or a function of the program."""

    driver: Number
    position: Number | None = None
    type: str = ""
    modules: Annotated[tuple[Number, ...], msgspec.Meta(max_length=MOST_MODULES)] = ()
    contact: Number | None = None
    function: Annotated[str, msgspec.Meta(max_length=200)] | None = None


class Plot(msgspec.Struct, tag_field="op", tag="plot"):
    """Choose the lines of which every sample is sent, with a number of this choice."""

    number: Number
    lines: Annotated[list[Line], msgspec.Meta(max_length=MOST_EXACT)]


class Mark(msgspec.Struct, tag_field="op", tag="mark"):
    text: Annotated[str, msgspec.Meta(max_length=200)]


class Tare(msgspec.Struct, tag_field="op", tag="tare"):
    """Take the present values for rest."""


class Wipe(msgspec.Struct, tag_field="op", tag="wipe"):
    """Begin a wipe test again, or leave it as it is."""

    action: Literal["start", "stop"]


class Record(msgspec.Struct, tag_field="op", tag="record"):
    action: Literal["start", "stop"]


class Replay(msgspec.Struct, tag_field="op", tag="replay"):
    """Control the replays that are shown, or the one of a number."""

    action: Literal["pause", "resume", "step", "seek", "speed", "loop"]
    value: int | float | bool | None = None
    number: Number | None = None


Operation = Next | Choose | Exact | Names | Plot | Mark | Tare | Wipe | Record | Replay
_DECODER = msgspec.json.Decoder(Operation)


def operation_of(text: str | bytes) -> Operation:
    try:
        operation: Operation = _DECODER.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:  # a ValidationError is a DecodeError
        raise ConfigurationError(str(error)) from None
    return operation


class QuantityPicture(NamedTuple):
    quantity: Quantity
    levels: Levels
    """(n,) uint8, see :mod:`skinware.views.quantities`."""
    scale: tuple[float, float]
    """Values of level 0 and of the highest level, in the quantity's unit."""
    shear: npt.NDArray[np.int8] | None
    """(n, 2) int8; None where there is no shear."""
    longest_shear: float
    """The shear that 127 means."""
    totals: npt.NDArray[np.float64] | None
    """(k, n_pads) see :meth:`skinware.views.following.Newest.totals`."""


class Look:
    """The choices of one viewer, and what its pictures remember from snapshot to snapshot.

    Attributes:
        mode: ``raw``: values; ``change``: their distance from rest; ``peak``: their greatest distance from rest since
            this mode was chosen or the skin was tared; ``wipe``: how far they have moved since the wipe test began,
            where the highest level is as far as a touch moves them.
        quantity: name of the quantity; None: the first of the first driver.
        scale: values of the lowest and the highest level; None: as they fit.
    """

    def __init__(self) -> None:
        self.mode: Mode = "raw"
        self.quantity: str | None = None
        self.scale: tuple[float, float] | None = None
        self.fps = DEFAULT_FPS
        self._memories: dict[int, Memory] = {}
        self._wiping = False

    def choose(self, choice: Choose) -> None:
        if choice.mode != self.mode and choice.mode == "peak":
            for memory in self._memories.values():
                memory.peak = None
        if choice.mode != self.mode and choice.mode == "wipe":
            self.wipe(True)
        self.mode, self.quantity, self.scale, self.fps = choice.mode, choice.type, choice.scale, choice.fps

    def tare(self) -> None:
        """Take the next values for rest, and begin peaks again."""
        for memory in self._memories.values():
            memory.rest = DriverRest(memory.structure)
            memory.peak = None

    def wipe(self, on: bool) -> None:
        """Begin a wipe test again, or leave it as it is now."""
        self._wiping = on
        if on:
            for memory in self._memories.values():
                memory.wipe = None

    def follow(self, driver: ShownDriver) -> None:
        quantity, newest = self.quantity_of(driver), driver.newest
        if quantity is None or newest is None:
            return
        memory = self._memory_of(driver)
        if memory.rest is not driver.rest:
            memory.rest.follow(newest.all_physical(), newest.status == 0, newest.frame.published_ns)
        if self.mode == "peak":
            change = newest.highest_change(quantity, memory.rest.baseline)
            memory.peak = quantity.name, np.fmax(_peaks(memory, quantity), change).astype(np.float32)
        if self.mode == "wipe" and self._wiping:
            if memory.wipe is None:
                memory.wipe = WipeTest(driver.structure)
            memory.wipe.follow(newest.all_physical(), newest.status == 0)
        totals = None if self.mode == "wipe" else newest.totals(quantity, self._rest(memory))
        memory.loads.extend((quantity.name, row) for row in (() if totals is None else totals))

    def quantity_of(self, driver: ShownDriver) -> Quantity | None:
        return driver.quantities[0] if self.quantity is None else driver.quantity(self.quantity)

    def picture(self, driver: ShownDriver) -> QuantityPicture | None:
        quantity, newest = self.quantity_of(driver), driver.newest
        if quantity is None or newest is None:
            return None
        status = newest.status[quantity.where]
        memory = self._memory_of(driver)
        if self.mode == "raw":
            scale = self.scale or self._limits(newest, quantity, memory, status)
            levels = newest.once((quantity.name, scale), lambda: newest.levels(quantity, *scale))
        else:
            values, fitting = self._distances(newest, quantity, memory, status == 0)
            scale = fitting if self.mode == "wipe" else self.scale or fitting
            levels = levels_of(values, status, *scale)
        if self.mode == "wipe":  # only sensors that moved further have the highest level, whatever rounding does
            levels[(levels == HIGHEST) & (values <= scale[1])] = HIGHEST - 1
        shear, longest = _shear(newest, quantity, memory)
        totals = None if self.mode == "wipe" else newest.totals(quantity, self._rest(memory))
        if totals is not None:
            loads = [row for name, row in memory.loads if name == quantity.name]
            totals = np.array([*loads[:-1], totals[-1]])
        memory.loads.clear()
        return QuantityPicture(quantity, levels, scale, shear, longest, totals)

    def _rest(self, memory: Memory) -> npt.NDArray[np.float32] | None:
        """Return (n_sensors,) the values that are taken off loads."""
        return None if self.mode == "raw" else memory.rest.baseline

    def _memory_of(self, driver: ShownDriver) -> Memory:
        memory = self._memories.get(driver.number)
        if memory is None or memory.structure is not driver.structure:
            memory = self._memories[driver.number] = Memory(driver.structure, driver.rest)
        return memory

    def _limits(
        self, newest: Newest, quantity: Quantity, memory: Memory, status: npt.NDArray[np.uint8]
    ) -> tuple[float, float]:
        """Return the scale that fits values."""
        name, known = quantity.type.name, (quantity.type.minimum, quantity.type.maximum)
        is_force = known[0] == 0 and quantity.type.unit.endswith("N")  # few come near the end of their range
        if all(map(math.isfinite, known)) and not is_force:
            return known
        values = newest.physical(quantity)[status == 0]
        if is_force:
            span = memory.span((name, self.mode), values, memory.rest.noise(name), newest.frame.published_ns)
            return 0.0, min(span, known[1])
        return memory.limits((name, self.mode), values, known)

    def _distances(
        self, newest: Newest, quantity: Quantity, memory: Memory, fresh: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.floating[Any]], tuple[float, float]]:
        """Return the (n,) distances that levels are made of, and the scale that fits."""
        name = quantity.type.name
        noise = memory.rest.noise(name)
        if self.mode == "wipe":
            travel = np.zeros(len(quantity), np.float32)
            if memory.wipe is not None:
                travel = memory.wipe.travel()[quantity.where]
            return travel, (0.0, threshold(noise) or 1.0)
        calm = newest.above_baseline(quantity)
        if self.mode == "peak":
            values = _peaks(memory, quantity)
        elif calm is not None:
            values = np.abs(calm)
        else:
            values = memory.rest.change(newest.all_physical())[quantity.where]
        span = memory.span((name, self.mode), values[fresh], noise, newest.frame.published_ns)
        return values, (0.0 if calm is not None else min(noise, span / 2), span)


def _peaks(memory: Memory, quantity: Quantity) -> npt.NDArray[np.float32]:
    if memory.peak is not None and memory.peak[0] == quantity.name:
        return memory.peak[1]
    return np.zeros(len(quantity), np.float32)


def _shear(newest: Newest, quantity: Quantity, memory: Memory) -> tuple[npt.NDArray[np.int8] | None, float]:
    """Return how far the two axes within the skin are from rest, and the length of the scale."""
    if not quantity.axes:
        return None, 0.0
    values = newest.all_physical()
    from_rest = np.where(quantity.shear >= 0, (values - memory.rest.baseline)[quantity.shear], np.float32(0))
    lengths = np.nan_to_num(np.linalg.norm(from_rest, axis=1)).astype(np.float32, copy=False)
    noise = max(map(memory.rest.noise, quantity.axes))
    longest = memory.span((quantity.name, "shear"), lengths, noise, newest.frame.published_ns)
    return shear_of(from_rest, longest), longest
