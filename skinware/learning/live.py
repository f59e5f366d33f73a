"""Live touch for a loop of another program: the same sensors at each turn, or an error, or a flag."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, ServiceTimeout
from skinware.learning.images import ColourMap, Colours, Pixels, TouchImage, range_of
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.skin import Skin
from skinware.skin_layout import SkinLayout
from skinware.snapshot import Snapshot
from skinware.status import age_limit_ns
from skinware.tactile.regions import Region, Regions, read_regions

Positions = npt.NDArray[np.int64]

_LONGEST_WAIT = 2
"""So many periods a sample that may be nearer is waited for; it comes within half a period of a driver in time."""


@dataclass(frozen=True)
class ChosenSensors:
    """A choice of the sensors of one type.

    Attributes:
        type_name: their type.
        modules: names of modules (``right hand, index tip``) or patches; empty: all.
        regions: a file of regions; ``modules`` then are names in it.
    """

    type_name: str = "pressure"
    modules: Collection[str] = ()
    regions: str | Path | None = None

    def of(self, layout: SkinLayout) -> Positions:
        """Return (n,) int64: positions of the chosen sensors among those of the type, ascending.

        Raises:
            StructureError: no driver has such sensors.
            ConfigurationError: a name selects none of them; or a bad file.
        """
        count = len(layout.module_of(self.type_name))
        if not self.modules:
            return np.arange(count)
        if self.regions is None:
            known = Regions([Region(name, module=(name,), patch=(name,)) for name in dict.fromkeys(self.modules)])
        else:
            known = read_regions(self.regions)
        index, chosen = known.of(layout, self.type_name), np.zeros(count, bool)
        for name in self.modules:
            chosen[index[name]] = True
            if not chosen[index[name]].any():
                there_are = sorted({layout.modules[module] for module in layout.module_of(self.type_name).tolist()})
                raise ConfigurationError(f"no {self.type_name} sensors in {name!r}; modules: {'; '.join(there_are)}")
        return np.flatnonzero(chosen)


class TouchSample(NamedTuple):
    """Values of chosen sensors at a moment.

    Attributes:
        snapshot: of the skin; the last good one if ``is_held``.
        values: (n,) float32 in the unit of the type; 0 where ``fresh`` is false.
        fresh: (n,) bool, as of the moment.
        off_s: time of the data minus the moment, s: the driver furthest away.
        is_held: nothing young enough came, and this is the last touch before.
    """

    snapshot: Snapshot
    values: npt.NDArray[np.floating[Any]]
    fresh: npt.NDArray[np.bool_]
    off_s: float
    is_held: bool


class LiveTouch:
    """The same sensors of the same drivers at each call, for loops that want arrays of one shape.

    It waits for a driver that comes back with the same sensors. Use it in one thread at a time.

    Args:
        sensors: which sensors.
        drivers: names of drivers; default: all that run when it is opened.
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        max_age_s: oldest data of each driver; default: three periods of the driver, at least 0.2 s.
        when_stale: ``raise`` a ServiceTimeout when a driver died, is silent or changed; or ``hold`` the last touch.

    Attributes:
        layout: of the skin when it was opened.
        positions: (n,) int64, positions of the sensors among those of their type.
    """

    def __init__(
        self,
        sensors: ChosenSensors | None = None,
        *,
        drivers: Collection[str] | None = None,
        namespace: Namespace | str | None = None,
        max_age_s: float | None = None,
        when_stale: Literal["raise", "hold"] = "raise",
    ) -> None:
        self.sensors = ChosenSensors() if sensors is None else sensors
        self._namespace, self._drivers = namespace, drivers
        self._max_age_s, self._when_stale = max_age_s, when_stale
        self._skin: Skin | None = None
        self._last: TouchSample | None = None
        self.layout: SkinLayout = SkinLayout((), ())
        self.positions: Positions = np.zeros(0, np.int64)

    @property
    def is_open(self) -> bool:
        """Whether it was opened, and not closed since."""
        return self._skin is not None

    def open(self, *, timeout_s: float = 5.0) -> Self:
        """Attach to the drivers, and wait for a sample of each.

        Raises:
            ServiceTimeout: they did not all publish in time.
            StructureError, ConfigurationError: as :meth:`ChosenSensors.of`.
        """
        wanted = self._drivers
        if wanted is None:  # those that run now; others that begin later are not its business
            with Skin(self._namespace, types=[self.sensors.type_name]) as skin:
                wanted = skin.read(timeout_s=timeout_s).layout.drivers
        skin = Skin(self._namespace, drivers=wanted)
        try:
            deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
            snapshot = skin.read(timeout_s=timeout_s)
            while missing := set(wanted) - set(snapshot.layout.drivers):
                left_s = (deadline_ns - now_ns()) / NS_PER_S
                if left_s <= 0:
                    raise ServiceTimeout(f"no driver {', '.join(sorted(missing))} in {skin.namespace.name!r}")
                with contextlib.suppress(ServiceTimeout):
                    snapshot = skin.read(newer_than=snapshot, timeout_s=min(left_s, 0.2))
            self.layout = snapshot.layout
            snapshot.unit(self.sensors.type_name)
            self.positions = self.sensors.of(self.layout)
        except BaseException:
            skin.close()
            raise
        self._skin, self._last = skin, None
        return self

    def now(self) -> TouchSample:
        """Return the touch nearest to this moment: the newest one, unless it is more than half a period old.

        Then the next one is waited for, at most two periods of the driver.

        Raises:
            ServiceTimeout: a driver died, is silent, or came back with other sensors (``when_stale="raise"``).
            ConfigurationError: it is not open.
        """
        return self.at(now_ns())

    def at(self, time_ns: int) -> TouchSample:
        """Return the touch nearest to a moment; wait as :meth:`now`.

        Args:
            time_ns: the moment, CLOCK_MONOTONIC ns: now or a little earlier.
        """
        if self._skin is None:
            raise ConfigurationError("touch is read before it was opened")
        try:
            snapshot = self._nearest(self._skin, time_ns)
        except ServiceTimeout:
            if self._when_stale == "raise" or self._last is None:
                raise
            return self._last._replace(is_held=True)
        type_name = self.sensors.type_name
        fresh = snapshot.fresh(type_name, max_age_s=self._max_age_s, at_ns=time_ns)[self.positions]
        values = np.where(fresh, snapshot.physical(type_name)[self.positions], 0)
        off_ns = snapshot.acquired_ns - time_ns
        self._last = TouchSample(snapshot, values, fresh, float(off_ns[np.argmax(np.abs(off_ns))]) / NS_PER_S, False)
        return self._last

    def close(self) -> None:
        """Detach from all drivers. Idempotent."""
        if self._skin is not None:
            self._skin.close()
        self._skin = None

    def _nearest(self, skin: Skin, time_ns: int) -> Snapshot:
        snapshot = skin.read(timeout_s=0.0)
        self._check(snapshot)
        longest_ns = _LONGEST_WAIT * max(sample.period_ns for sample in snapshot.samples)
        while (left_ns := time_ns + longest_ns - now_ns()) > 0 and self._may_be_nearer(snapshot, time_ns):
            with contextlib.suppress(ServiceTimeout):
                snapshot = skin.read(newer_than=snapshot, timeout_s=left_ns / NS_PER_S)
        nearest = skin.at(time_ns).nearest
        self._check(nearest)
        too_old = [
            f"{name} ({(time_ns - sample.acquired_ns) / NS_PER_S:.2f} s)"
            for name, sample in zip(nearest.layout.drivers, nearest.samples, strict=True)
            if time_ns - sample.acquired_ns > self._limit_ns(sample.period_ns)
        ]
        if too_old:
            raise ServiceTimeout(f"drivers whose data is too old: {', '.join(too_old)}")
        return nearest

    def _may_be_nearer(self, snapshot: Snapshot, time_ns: int) -> bool:
        """Return whether a sample to come can be nearer to the moment than the newest one."""
        return any(
            sample.period_ns / 2 < time_ns - sample.acquired_ns <= self._limit_ns(sample.period_ns)
            for sample in snapshot.samples
        )

    def _limit_ns(self, period_ns: int) -> int:
        return age_limit_ns(period_ns) if self._max_age_s is None else round(self._max_age_s * NS_PER_S)

    def _check(self, snapshot: Snapshot) -> None:
        if snapshot.layout is self.layout:
            return
        gone = set(self.layout.drivers) - set(snapshot.layout.drivers)
        if gone:
            raise ServiceTimeout(f"drivers that died or were stopped: {', '.join(sorted(gone))}")
        pairs = zip(self.layout.drivers, self.layout.structures, strict=True)
        if any(snapshot.of(name).structure != structure for name, structure in pairs):
            raise ServiceTimeout("a driver came back with other sensors: open again")
        self.layout = snapshot.layout

    def __enter__(self) -> Self:
        return self if self.is_open else self.open()

    def __exit__(self, *_: object) -> None:
        self.close()


class LiveImage:
    """Live touch as images: see :class:`skinware.learning.images.TouchImage`.

    Args:
        touch: what is shown; with colours ``shear`` of the normal component, such as ``force_z``.
        height, width: of the images, pixels.
        map: of the colours.
        lowest, highest: range of the colours; default: that of the drivers' sensor type.
        tangential: types of the two tangential components for ``shear``, of the same taxels.
    """

    def __init__(
        self,
        touch: LiveTouch,
        height: int,
        width: int,
        map: ColourMap = "grey",  # noqa: A002, as in Colours
        *,
        lowest: float | None = None,
        highest: float | None = None,
        tangential: tuple[str, str] = ("force_x", "force_y"),
    ) -> None:
        self.touch = touch
        self._size, self._map, self._range, self._tangential = (height, width), map, (lowest, highest), tangential
        self._image: TouchImage | None = None

    def open(self, *, timeout_s: float = 5.0) -> Self:
        """Open the touch, and lay out the image.

        Raises:
            ConfigurationError: the drivers give no range, the image is too small, or the components are not of the same
                taxels.
            ServiceTimeout, StructureError: as :meth:`LiveTouch.open`.
        """
        self.touch.open(timeout_s=timeout_s)
        layout, type_name = self.touch.layout, self.touch.sensors.type_name
        try:
            lowest, highest = self._range
            own = range_of(layout, type_name)
            lowest, highest = own[0] if lowest is None else lowest, own[1] if highest is None else highest
            if self._map == "shear" and any(
                not np.array_equal(layout.uids(name), layout.uids(type_name)) for name in self._tangential
            ):
                raise ConfigurationError(f"{', '.join(self._tangential)} are not of the same taxels as {type_name}")
            colours = Colours(self._map, lowest, highest)
            self._image = TouchImage(layout, type_name, self.touch.positions, *self._size, colours)
        except BaseException:
            self.touch.close()
            raise
        return self

    def now(self) -> tuple[Pixels, TouchSample]:
        """Return (height, width, 3) uint8, and the touch it shows; errors as :meth:`LiveTouch.now`."""
        return self.at(now_ns())

    def at(self, time_ns: int) -> tuple[Pixels, TouchSample]:
        """Return the image of a moment, as :meth:`LiveTouch.at`."""
        touch = self.touch.at(time_ns)
        if self._image is None:
            raise ConfigurationError("an image is read before it was opened")
        values = touch.values
        if self._map == "shear":
            parts = [touch.snapshot.physical(name)[self.touch.positions] * touch.fresh for name in self._tangential]
            values = np.stack((*parts, values), axis=1)
        return self._image.of(values), touch

    def close(self) -> None:
        """Detach from all drivers. Idempotent."""
        self.touch.close()


class Totals:
    """Named numbers of some sensors: of each module the sum and the largest value, or every sensor.

    Args:
        layout: of the skin.
        type_name: their type.
        positions: (n,) as of :meth:`ChosenSensors.of`.
        each: ``module``: two numbers for each module; ``taxel``: one for each sensor.

    Attributes:
        names: of the numbers: ``right_hand.index_tip.sum``, ``right_hand.index_tip.peak``; ``...taxel_3``.
    """

    def __init__(
        self, layout: SkinLayout, type_name: str, positions: Positions, each: Literal["module", "taxel"] = "module"
    ) -> None:
        module_of = layout.module_of(type_name)[positions]
        modules, self._row = np.unique(module_of, return_inverse=True)
        self._each = each
        if each == "module":
            texts = [layout.modules[module] for module in modules.tolist()]
            self.names: tuple[str, ...] = tuple(f"{_slug(text)}.{what}" for text in texts for what in ("sum", "peak"))
        else:
            self.names = tuple(_slug(layout.sensor_name(type_name, position)) for position in positions.tolist())

    def of(self, values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """Return (len(names),) float32 of (n,) values."""
        if self._each == "taxel" or not len(values):
            return values.astype(np.float32)
        sums = np.bincount(self._row, values)
        peaks = np.full(len(sums), -np.inf)
        np.maximum.at(peaks, self._row, values)
        return np.column_stack((sums, peaks)).ravel().astype(np.float32)


def points(layout: SkinLayout, values: npt.NDArray[Any], type_name: str, positions: Positions) -> npt.NDArray[Any]:
    """Return (..., n, 6) float32 ``[x, y, z, Fx, Fy, Fz]``: places in m in their frames, and force against the skin.

    The force is the value, in the unit of the type, against the outward normal; 0 where the normal is not known, as is
    the place.

    Args:
        values: (..., n) of the sensors at ``positions``.
    """
    geometry = layout.geometry(type_name)
    place = np.nan_to_num(geometry.position_m[positions])
    force = -values[..., np.newaxis] * np.nan_to_num(geometry.normal[positions])
    found: npt.NDArray[np.float32] = np.concatenate((np.broadcast_to(place, force.shape), force), axis=-1).astype("f4")
    return found


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "_", text.replace(", ", ".")).strip("_")
