"""How one viewer looks at the skin: in which mode, at which quantity, between which values."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.views.following import Followed
from skinware.views.quantities import HIGHEST, ChangeSpan, Levels, Quantity, Rest, ValueLimits, levels_of, shear_of
from skinware.views.wiping import WipeTest, threshold

Mode = Literal["raw", "change", "peak", "wipe"]

DEFAULT_FPS = 30.0


class Picture(NamedTuple):
    """A quantity of a driver as a viewer looks at it."""

    quantity: Quantity
    levels: Levels
    """(n,) uint8, see :mod:`skinware.views.quantities`."""
    scale: tuple[float, float]
    """What level 0 and the highest stand for, in the quantity's unit."""
    shear: npt.NDArray[np.int8] | None
    """(n, 2) int8; None where there is no shear."""
    longest_shear: float
    """What 127 stands for."""


class Wiped(NamedTuple):
    """How far a wipe test has come."""

    touched: int
    of: int
    running: bool


class Look:
    """What one viewer has chosen, and what has to be remembered for it from frame to frame.

    Attributes:
        mode: ``raw``: values; ``change``: how far they are from rest; ``peak``: the furthest they were from rest since
            the mode was chosen or the rest was taken anew; ``wipe``: how far they have moved since the wipe test began,
            where the highest level is as far as a touch moves them.
        quantity: name of the one to look at; None: the first of the first driver.
        scale: what the lowest and the highest level stand for; None: as it fits.
        fps: pictures a second, at most.
    """

    def __init__(self) -> None:
        self.mode: Mode = "raw"
        self.quantity: str | None = None
        self.scale: tuple[float, float] | None = None
        self.fps = DEFAULT_FPS
        self._watched: dict[int, _Watched] = {}
        self._wiping = False

    def choose(self, mode: Mode, quantity: str | None, scale: tuple[float, float] | None, fps: float) -> None:
        """Look otherwise from now on."""
        if mode != self.mode and mode == "peak":
            for watched in self._watched.values():
                watched.peak = None
        if mode != self.mode and mode == "wipe":
            self.wipe(True)
        self.mode, self.quantity, self.scale, self.fps = mode, quantity, scale, fps

    def tare(self) -> None:
        """What comes next is rest; peaks begin anew."""
        for watched in self._watched.values():
            watched.rest = Rest(watched.structure)
            watched.peak = None

    def wipe(self, on: bool) -> None:
        """Begin a wipe test anew, or leave it as it is now."""
        self._wiping = on
        if on:
            for watched in self._watched.values():
                watched.wipe = None

    def follow(self, driver: Followed) -> None:
        """Take a new frame of a driver into account."""
        quantity, frame = self.quantity_of(driver), driver.frame
        if quantity is None or frame is None:
            return
        watched, values, fresh = self._watch(driver), driver.all_physical(), driver.status == 0
        if watched.rest is not driver.rest:
            watched.rest.follow(values, fresh, frame.published_ns)
        if self.mode == "peak":
            change = driver.calm(quantity)
            change = watched.rest.change(values)[quantity.where] if change is None else np.abs(change)
            watched.hold(quantity.name, np.where(fresh[quantity.where], change, 0))
        if self.mode == "wipe" and self._wiping:
            if watched.wipe is None:
                watched.wipe = WipeTest(driver.structure)
            watched.wipe.follow(values, fresh)

    def quantity_of(self, driver: Followed) -> Quantity | None:
        """The quantity of a driver that this viewer looks at; None: it has none."""
        return driver.quantities[0] if self.quantity is None else driver.quantity(self.quantity)

    def picture(self, driver: Followed) -> Picture | None:
        """The newest frame of a driver; None where there is nothing to be seen of it."""
        quantity, frame = self.quantity_of(driver), driver.frame
        if quantity is None or frame is None:
            return None
        status = driver.status[quantity.where]
        watched = self._watch(driver)
        values, fitting = self._values(driver, quantity, watched, status == 0)
        scale = fitting if self.mode == "wipe" else self.scale or fitting
        if self.mode == "raw":
            levels = driver.shared((quantity.name, scale), lambda: levels_of(values, status, *scale))
        else:
            levels = levels_of(values, status, *scale)
        if self.mode == "wipe":  # only what has moved by more has the highest level, whatever rounding says
            levels[(levels == HIGHEST) & (values <= scale[1])] = HIGHEST - 1
        shear, longest = self._shear(driver, quantity, watched)
        return Picture(quantity, levels, scale, shear, longest)

    def wiped(self, drivers: list[Followed]) -> Wiped | None:
        """How far the wipe test has come; None where there is none."""
        if self.mode != "wipe":
            return None
        touched = of = 0
        for driver in drivers:
            quantity = self.quantity_of(driver)
            if quantity is None:
                continue
            of += len(quantity)
            watched, name = self._watch(driver), quantity.type.name
            if watched.wipe is not None:
                touched += len(quantity) - len(watched.wipe.never_moved(name, watched.rest.noise(name)))
        return Wiped(touched, of, self._wiping)

    def _watch(self, driver: Followed) -> _Watched:
        watched = self._watched.get(driver.number)
        if watched is None or watched.structure is not driver.structure:
            watched = self._watched[driver.number] = _Watched(driver)
        return watched

    def _values(
        self, driver: Followed, quantity: Quantity, watched: _Watched, fresh: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.floating[Any]], tuple[float, float]]:
        """(n,) what the levels are made of, and the scale that fits."""
        name, frame = quantity.type.name, driver.frame
        assert frame is not None  # noqa: S101 - picture() has seen one
        if self.mode == "raw":
            values = driver.physical(quantity)
            limits = watched.limits.setdefault(name, ValueLimits())
            known = (quantity.type.minimum, quantity.type.maximum)
            return values, limits.follow(values[fresh] if not np.isfinite(known).all() else values, known)
        noise = watched.rest.noise(name)
        if self.mode == "wipe":
            travel = np.zeros(len(quantity), np.float32)
            if watched.wipe is not None:
                travel = watched.wipe.travel()[quantity.where]
            return travel, (0.0, threshold(noise) or 1.0)
        calm = driver.calm(quantity)
        if self.mode == "peak":
            values = watched.peaks(quantity.name, len(quantity))
        elif calm is not None:
            values = np.abs(calm)
        else:
            values = watched.rest.change(driver.all_physical())[quantity.where]
        span = watched.spans.setdefault((name, self.mode), ChangeSpan()).follow(
            values[fresh], noise, frame.published_ns
        )
        return values, (0.0 if calm is not None else min(noise, span / 2), span)

    def _shear(
        self, driver: Followed, quantity: Quantity, watched: _Watched
    ) -> tuple[npt.NDArray[np.int8] | None, float]:
        """How far the two axes within the skin are from rest."""
        if not quantity.axes or driver.frame is None:
            return None, 0.0
        values = driver.all_physical()
        from_rest = np.where(quantity.shear >= 0, (values - watched.rest.baseline)[quantity.shear], np.float32(0))
        lengths = np.nan_to_num(np.linalg.norm(from_rest, axis=1)).astype(np.float32, copy=False)
        noise = max(map(watched.rest.noise, quantity.axes))
        longest = watched.spans.setdefault((quantity.name, "shear"), ChangeSpan()).follow(
            lengths, noise, driver.frame.published_ns
        )
        return shear_of(from_rest, longest), longest


class _Watched:
    """What is kept of a driver from frame to frame."""

    def __init__(self, driver: Followed) -> None:
        self.structure = driver.structure
        self.rest = driver.rest
        self.wipe: WipeTest | None = None
        self.peak: tuple[str, npt.NDArray[np.float32]] | None = None
        self.limits: dict[str, ValueLimits] = {}
        self.spans: dict[tuple[str, str], ChangeSpan] = {}

    def hold(self, quantity: str, change: npt.NDArray[np.floating[Any]]) -> None:
        self.peak = quantity, np.fmax(self.peaks(quantity, len(change)), change).astype(np.float32)

    def peaks(self, quantity: str, n: int) -> npt.NDArray[np.float32]:
        known = self.peak is not None and self.peak[0] == quantity
        return self.peak[1] if known and self.peak is not None else np.zeros(n, np.float32)
