"""Turn values into what is drawn: quantities, their levels between two values, and loads in the newest snapshots."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from skinware._columns import Index
from skinware.driver_snapshot import DriverSnapshot
from skinware.geometry import Geometry
from skinware.nominal_hand import PARTS, NominalHand
from skinware.sensor_types import FORCE_Z, NOT_TOUCH, PRESSURE, SHEAR_X, SHEAR_Y, SensorType
from skinware.state import settling
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.contacts_service import ContactsSample
from skinware.tactile.motion import MotionSample
from skinware.tactile.neighbours import pitch_m

_Made = TypeVar("_Made")
Levels = npt.NDArray[np.uint8]

HIGHEST = 250
NO_VALUE = 255
WITHOUT_VALUE = Status.NO_ACK | Status.MASKED | Status.NEVER_SEEN | Status.NOT_CONNECTED
"""A sensor with one of these bits has no value that means anything."""
_NORMAL = (FORCE_Z.id, PRESSURE.id)
_NEVER_SEEN, _ALL_BITS = np.uint8(Status.NEVER_SEEN), np.uint8(0xFF)
_LONGEST = 127
_STEEPEST = float(np.finfo(np.float32).max)


class Pads(NamedTuple):
    """The modules of a driver; one with sensors on several fingers of a nominal hand is a pad on each.

    Attributes:
        of_sensor: (n_sensors,) int64.
        is_on_hand: (n_sensors,) bool.
    """

    of_sensor: npt.NDArray[np.int64]
    names: list[str]
    module: list[int]
    is_on_hand: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Quantity:
    """A picture of a skin: n taxels with a value each, and a vector where sensors of three axes lie together.

    Attributes:
        name: for people: ``pressure``; ``force`` for ``force_x``, ``force_y`` and ``force_z``.
        type: of the value; of three axes the one along the normal.
        index: (n,) int64, positions in a snapshot of the n sensors with the values.
        where: the same, as a slice if it is one.
        axes: names of the types of the two axes within the skin; empty where the skin has no such sensors.
        shear: (n, 2) int64, positions of the sensors of these axes, -1 without one.
    """

    name: str
    type: SensorType
    index: npt.NDArray[np.int64]
    where: Index
    geometry: Geometry
    axes: tuple[str, ...]
    shear: npt.NDArray[np.int64]
    pads: Pads

    def __len__(self) -> int:
        return len(self.index)

    @property
    def is_touch(self) -> bool:
        return not self.type.name.startswith(NOT_TOUCH)

    @property
    def total(self) -> Literal["sum", "highest"] | None:
        """How loads of several taxels add up: forces to their sum, pressures to the highest; None: not at all."""
        if self.type.unit.endswith("Pa"):
            return "highest"
        return "sum" if self.type.unit.endswith("N") or self.type.id in _NORMAL else None

    @property
    def is_count(self) -> bool:
        return not self.type.unit.endswith(("N", "Pa"))

    @cached_property
    def has_loads(self) -> bool:
        """Whether ``total`` of its values is a load: of counts only on a hand, where taxels rest at the least."""
        return self.total is not None and (not self.is_count or bool(self.pads.is_on_hand[self.where].all()))

    def totals(self, loads: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
        """Return (k, n_pads) the load on each pad from (k, n) loads of its taxels, 0 or more where there are none."""
        order, starts, pads = self._by_pad
        found = np.zeros((len(loads), len(self.pads.names)))
        if len(starts):
            reduce = np.maximum.reduceat if self.total == "highest" else np.add.reduceat
            found[:, pads] = reduce(loads[:, order].astype(np.float64), starts, axis=1)
        return found

    @cached_property
    def _by_pad(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """The order of taxels by pad, where each pad begins in it, and the pads."""
        pad = self.pads.of_sensor[self.where]
        order = np.argsort(pad, kind="stable")
        pads, starts = np.unique(pad[order], return_index=True)
        return order, starts, pads

    @cached_property
    def pitch_m(self) -> float:
        """The usual distance from a taxel to the nearest other, m; NaN where places are not known."""
        pitch = pitch_m(self.geometry)
        pitch = pitch[pitch > 0]
        return float(np.median(pitch)) if len(pitch) else float("nan")


def types_of(structure: Structure) -> list[SensorType]:
    """Return the types of a skin that have sensors, those first that people look at first.

    These are normal force and pressure, the one with more sensors first; then other types of touch, then all others.
    """
    counts = {t: int(np.count_nonzero(structure.sensor_type == t.id)) for t in structure.types}

    def rank(t: SensorType) -> tuple[int, ...]:
        if t.id in _NORMAL:
            return 0, -counts[t], _NORMAL.index(t.id)
        return (1 + t.name.startswith(NOT_TOUCH),)

    return sorted((t for t, count in counts.items() if count), key=rank)  # stable


def quantities_of(structure: Structure) -> tuple[Quantity, ...]:
    types = {t.name: t for t in types_of(structure)}
    names: dict[str, str] = {}
    axes: dict[str, tuple[str, str]] = {}
    for name in types:
        prefix = name.removesuffix("_z")
        pair = (SHEAR_X.name, SHEAR_Y.name) if name == PRESSURE.name else (f"{prefix}_x", f"{prefix}_y")
        if (prefix != name or name == PRESSURE.name) and types.keys() >= set(pair):
            names[name], axes[name] = prefix, pair
    shown = [name for name in types if not any(name in pair for pair in axes.values())]
    positions, pads = np.arange(structure.n_sensors), pads_of(structure)
    found = []
    for name in shown:
        where = structure.span(name)
        uid = structure.sensor_uid[where]
        geometry = structure.geometry
        found.append(
            Quantity(
                names.get(name, name),
                types[name],
                positions[where],
                where,
                Geometry.unknown([name] * len(uid), uid) if geometry is None else geometry[where],
                axes.get(name, ()),
                _with_uids(structure, uid.tolist(), axes.get(name, ())),
                pads,
            )
        )
    return tuple(found)


def _with_uids(structure: Structure, uids: list[int], types: tuple[str, ...]) -> npt.NDArray[np.int64]:
    """Return (n, len(types)) positions of the sensors of each type with these n uids, -1 without one."""
    columns = []
    for name in types:
        positions = structure.index(name).tolist()
        known = dict(zip(structure.sensor_uid[positions].tolist(), positions, strict=True))
        columns.append([known.get(uid, -1) for uid in uids])
    return np.array(columns, np.int64).reshape(len(types), len(uids)).T


def pads_of(structure: Structure) -> Pads:
    part = np.full(structure.n_sensors, -1)
    geometry = structure.geometry
    for frame in () if geometry is None else set(geometry.frame[geometry.known].tolist()):
        hand = NominalHand.in_frame(frame)
        if geometry is not None and hand is not None:
            here = geometry.known & (geometry.frame == frame)
            part[here] = hand.parts_at(geometry.position_m[here])
    module = structure.sensor_module.astype(np.int64)
    least, most = np.full(structure.n_modules, len(PARTS)), np.full(structure.n_modules, -1)
    np.minimum.at(least, module[part >= 0], part[part >= 0])
    np.maximum.at(most, module, part)
    own = np.where((least < most)[module], part + 1, 0)
    keys, of_sensor = np.unique(module * (len(PARTS) + 1) + own, return_inverse=True)
    modules, parts = np.divmod(keys, len(PARTS) + 1)
    names = np.where(parts > 0, np.array(["", *PARTS])[parts], np.array(structure.module_names)[modules])
    return Pads(of_sensor.astype(np.int64), names.tolist(), modules.tolist(), part >= 0)


def levels_of(values: npt.NDArray[np.floating[Any]], status: npt.NDArray[np.uint8], low: float, high: float) -> Levels:
    """Return (n,) uint8: where values lie between ``low`` (0) and ``high`` (250) in even steps; 255 without a value.

    Args:
        values: (n,) physical.
        status: (n,) uint8, bits of :class:`skinware.status.Status`.
        low: this value and all below it are level 0.
        high: this value and all above it are level 250.
    """
    scaled = (values - values.dtype.type(low)).astype(np.float32, copy=False)
    known = np.isfinite(scaled)
    if not known.all():
        scaled[~known] = 0
    steepness = HIGHEST / (high - low) if high > low else np.inf
    scaled *= np.float32(min(steepness, _STEEPEST))
    scaled += np.float32(0.5)
    np.clip(scaled, 0, HIGHEST, out=scaled)
    levels = scaled.astype(np.uint8)
    if not known.all():
        levels[~known] = NO_VALUE
    levels[(status & np.uint8(WITHOUT_VALUE)) != 0] = NO_VALUE
    return levels


@lru_cache(32)
def _levels_by_raw(dtype: np.dtype[Any], scale: float, offset: float, low: float, high: float) -> Levels:
    """Return the level of each raw value of at most 16 bits; negative ones are counted from the end."""
    raw = np.arange(1 << 8 * dtype.itemsize).astype(f"u{dtype.itemsize}").view(dtype)
    values = raw.astype(np.float32) * np.float32(scale) + np.float32(offset)
    with np.errstate(over="ignore"):  # far beyond both limits
        return levels_of(values, np.zeros(len(raw), np.uint8), low, high)


def shear_of(vectors: npt.NDArray[np.floating[Any]], longest: float) -> npt.NDArray[np.int8]:
    """Return (n, 2) int8: vectors as parts of ``longest``, which is 127; 0 where a vector is not known."""
    scaled = np.nan_to_num(vectors * np.float32(_LONGEST / longest if longest > 0 else 0.0), posinf=0.0, neginf=0.0)
    parts: npt.NDArray[np.int8] = np.clip(np.rint(scaled), -_LONGEST, _LONGEST).astype(np.int8)
    return parts


@dataclass(eq=False)
class Newest:
    """The newest snapshot of a driver, and what is known about it now.

    Attributes:
        status: (n_sensors,) uint8, status of its sensors now, with the health that the calmed driver publishes.
        calm: snapshot of the calmed driver, if it lives and has the same sensors.
        contacts, motion: on the driver; None where no service publishes them.
        shared: results that several viewers need, by a key of their own.
    """

    frame: DriverSnapshot
    status: npt.NDArray[np.uint8]
    calm: DriverSnapshot | None
    contacts: ContactsSample | None
    motion: MotionSample | None
    read_all: Callable[[], Sequence[DriverSnapshot]]
    shared: dict[object, Any] = field(default_factory=dict)

    def once(self, key: object, make: Callable[[], _Made]) -> _Made:
        if key not in self.shared:
            self.shared[key] = make()
        made: _Made = self.shared[key]
        return made

    def physical(self, quantity: Quantity) -> npt.NDArray[np.floating[Any]]:
        """Return (n,) values of a quantity's sensors in its unit."""
        return self.once(("physical", quantity.name), lambda: self.frame.physical(quantity.type.name))

    def levels(self, quantity: Quantity, low: float, high: float) -> Levels:
        """Return (n,) uint8, the values of a quantity's sensors as :func:`levels_of` returns them."""
        status, raw = self.status[quantity.where], self.frame.values[quantity.where]
        if raw.dtype.kind == "f" or raw.dtype.itemsize > 2:
            return levels_of(self.physical(quantity), status, low, high)
        by_raw = _levels_by_raw(raw.dtype, quantity.type.scale, quantity.type.offset, low, high)
        levels: Levels = by_raw.take(raw)
        if not self.is_good:
            levels[(status & np.uint8(WITHOUT_VALUE)) != 0] = NO_VALUE
        return levels

    def all_physical(self) -> npt.NDArray[np.float32]:
        """Return (n_sensors,) float32, values of the sensors of all types, each in its unit."""
        return self.once("all", self.frame.physical_values)

    def above_baseline(self, quantity: Quantity) -> npt.NDArray[np.floating[Any]] | None:
        """Return (n,) how far values are above their baselines, 0 without touch; None without a calmed driver."""
        calm = self.calm
        if calm is None:
            return None
        return self.once(("calm", quantity.name), lambda: calm.physical(quantity.type.name))

    @cached_property
    def is_good(self) -> bool:
        return not np.count_nonzero(self.status)

    @property
    def contacts_position(self) -> tuple[int, int] | None:
        return None if self.contacts is None else self.contacts.position

    @property
    def why(self) -> npt.NDArray[np.uint8]:
        """(n_sensors,) uint8: a :class:`skinware.status.Why` for each, of the calmed driver."""
        return (self.calm or self.frame).why

    @property
    def settling(self) -> npt.NDArray[np.bool_]:
        """(n_sensors,) bool: those whose baselines the calmed driver does not know yet."""
        return self.once("settling", lambda: settling(self.calm or self.frame))

    @cached_property
    def marked(self) -> npt.NDArray[np.uint8]:
        """(n_sensors,) uint8: ``status``, but all bits for sensors that were seen, and wait for their baselines."""
        status = self.status
        return status if self.is_good else np.where(self.settling & ((status & _NEVER_SEEN) != 0), _ALL_BITS, status)

    @property
    def all(self) -> Sequence[DriverSnapshot]:
        """Snapshots since the last one that was newest, of the calmed driver where there is one; the newest last."""
        return self.once("all snapshots", self.read_all)

    def highest_change(self, quantity: Quantity, rest: npt.NDArray[np.float32]) -> npt.NDArray[np.floating[Any]]:
        """Return (n,) the greatest distance of fresh values from ``rest``, or above baselines, in all snapshots."""
        changes = np.stack([frame.physical(quantity.type.name) for frame in self.all])
        if self.calm is None:
            changes -= rest[quantity.where]
        fresh = np.stack([frame.status[quantity.where] for frame in self.all]) == 0
        highest: npt.NDArray[np.floating[Any]] = np.where(fresh, np.nan_to_num(np.abs(changes)), 0).max(axis=0)
        return highest

    def totals(self, quantity: Quantity, rest: npt.NDArray[np.float32] | None) -> npt.NDArray[np.float64] | None:
        """Return (k, n_pads) the load on each pad in each of ``all``, the sum or the highest of its values.

        Args:
            rest: (n_sensors,) values at rest that are taken off; None: of counts the least of their type.

        Returns:
            None where values are no loads: counts, but on a hand or beside a calmed driver, and other quantities.
        """
        if self.calm is None and not quantity.has_loads:
            return None
        loads = np.stack([frame.physical(quantity.type.name) for frame in self.all])
        if self.calm is None and rest is not None:
            loads -= rest[quantity.where]
        elif self.calm is None and quantity.is_count and math.isfinite(quantity.type.minimum):
            loads -= loads.dtype.type(quantity.type.minimum)
        without = np.stack([frame.status[quantity.where] for frame in self.all]) & WITHOUT_VALUE
        return quantity.totals(np.where(without == 0, np.nan_to_num(loads), 0))
