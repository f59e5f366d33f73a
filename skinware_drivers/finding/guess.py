"""Count the frames on a CAN bus, and find the drivers whose layouts know them."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import BusError, BusSendError, ConfigurationError
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import EXTENDED_FLAG, Bus, FrameBatch
from skinware_drivers.description import Patch
from skinware_drivers.fields import Bits, Identifier
from skinware_drivers.layout import Expand, Frame, Layout
from skinware_drivers.link import Heard, Link
from skinware_drivers.loading import registered, short_name
from skinware_drivers.registry import DRIVERS, load_driver

_MOST_KEPT = 1 << 17
_CLASS_BITS = 8


@dataclass(frozen=True)
class IdentifierClass:
    """Identifiers with the same first digit.

    Attributes:
        name: ``4xx``: 11-bit identifiers 400 to 4FF; ``29-bit``: all of those.
        first, last: the lowest and the highest that was heard.
    """

    name: str
    first: int
    last: int
    identifiers: int
    frames: int


class Traffic:
    def __init__(self) -> None:
        self.frames: int = 0
        self._kept = 0
        self._wire: list[npt.NDArray[Any]] = []

    def take(self, batch: FrameBatch) -> None:
        wire = batch.wire[batch.start : batch.stop]
        self.frames += len(wire)
        if self._kept < _MOST_KEPT:
            self._wire.append(wire.copy())
            self._kept += len(wire)

    def wire(self) -> npt.NDArray[Any]:
        """Return (n,) rows of ``wire_dtype``: the frames, at most about the first 131072."""
        return np.concatenate(self._wire) if self._wire else FrameBatch(0).wire

    def classes(self) -> list[IdentifierClass]:
        identifier = self.wire()["identifier"]
        extended = (identifier & EXTENDED_FLAG) != 0
        number = np.where(extended, 1 << 11 - _CLASS_BITS, identifier >> _CLASS_BITS)
        found = []
        for one in np.unique(number).tolist():
            of_class, counts = np.unique(identifier[number == one] & ~np.uint32(EXTENDED_FLAG), return_counts=True)
            name = "29-bit" if one == 1 << 11 - _CLASS_BITS else f"{one:X}xx"
            found.append(IdentifierClass(name, int(of_class[0]), int(of_class[-1]), len(of_class), int(counts.sum())))
        return found

    def heard(self) -> dict[Heard, int]:
        """Return identifier, first byte and length of the frames, by which listening drivers know them, with counts."""
        wire = self.wire()
        rows = zip(wire["identifier"].tolist(), wire["payload"][:, 0].tolist(), wire["length"].tolist(), strict=True)
        counts: dict[Heard, int] = {}
        for row in rows:
            counts[Heard(*row)] = counts.get(Heard(*row), 0) + 1
        return counts


_NAMING_S = 0.5


@dataclass(frozen=True)
class Guess:
    """A driver that knows some of the frames.

    Attributes:
        share: of all frames, 0 to 1.
        likely: no other driver explains these frames better; False: a possibility.
    """

    driver: str
    frames: int
    share: float
    patches: tuple[str, ...]
    likely: bool


@dataclass(frozen=True)
class _Match:
    name: str
    adapter: AnyAdapter
    rows: npt.NDArray[np.bool_]
    keys: frozenset[int]
    weight: float


def known_drivers(medium: str, only: Collection[str] = ()) -> dict[str, type[AnyAdapter]]:
    """Return drivers for a kind of bus, by name.

    Args:
        only: drivers, as ``load_driver`` takes them; none: all that are registered and can be loaded.
    """
    found = {short_name(name): load_driver(name) for name in only}
    for name in () if only else sorted(registered(DRIVERS)):
        with contextlib.suppress(ConfigurationError):
            found[name] = load_driver(name)
    return {name: driver for name, driver in found.items() if driver.medium == medium}


async def guess(traffic: Traffic, bus: Bus, drivers: dict[str, type[AnyAdapter]]) -> list[Guess]:
    """Return the drivers that know the frames, the most likely first.

    A driver knows a frame if identifier, length and constant bytes are right, and all frames of its cycle were heard.
    If several know the same frames, the one with more constant bits wins. Only the name of the bus is used.
    """
    wire = traffic.wire()
    adapters = {
        name: adapter for name, driver in drivers.items() if (adapter := with_default_options(driver)) is not None
    }
    matches = [match for name, adapter in adapters.items() if (match := _match(name, adapter, wire)) is not None]
    explained = np.zeros(len(wire), bool)
    guesses = []
    for match in sorted(matches, key=lambda match: -match.weight):
        is_new = match.rows & ~explained
        explained |= match.rows
        count = int(match.rows.sum())
        names = {patch.key: patch.name for patch in await _describe(match.adapter, bus, traffic.heard())}
        patches = tuple(names.get(key, f"patch {key}") for key in sorted(match.keys))
        guesses.append(Guess(match.name, count, count / len(wire), patches, bool(is_new.any())))
    return sorted(guesses, key=lambda one: not one.likely)


async def patches_heard(traffic: Traffic, bus: Bus, adapter: AnyAdapter) -> list[Patch]:
    """Return the patches of one driver that were heard, as it describes them; only the name of the bus is used."""
    match = _match(type(adapter).__name__, adapter, traffic.wire())
    if match is None:
        return []
    return [patch for patch in await _describe(adapter, bus, traffic.heard()) if patch.key in match.keys]


def matching_rows(frame: Frame, wire: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    identifier, payload, length = wire["identifier"], wire["payload"], wire["length"]
    match = np.isin(length, list(frame.length))
    match &= ((identifier & EXTENDED_FLAG) != 0) == frame.extended
    for condition in frame.when:
        if isinstance(condition, Identifier):
            match &= (identifier & condition.mask) == condition.value
        elif condition.offset < payload.shape[1]:
            match &= (payload[:, condition.offset] & condition.mask) == condition.value
            match &= length > condition.offset
        else:
            match[:] = False
    return match


def with_default_options(driver: type[AnyAdapter]) -> AnyAdapter | None:
    """Return a driver's adapter with default options; None if it has options without a default."""
    try:
        return driver(driver.Options())
    except (TypeError, ConfigurationError):
        return None


def _match(name: str, adapter: AnyAdapter, wire: npt.NDArray[Any]) -> _Match | None:
    """Return the frames that a driver knows; None if there is none, or if its layout depends on the hardware."""
    layout: Layout | None = getattr(adapter, "layout", None)
    if layout is None or not len(wire):
        return None
    cycles = [set(cycle.members) for cycle in layout.cycles]
    without_values = {  # alone, such frames do not make a patch
        frame.name
        for frame in layout.frames
        if not isinstance(frame.values, Expand) and not any(values.count for values in frame.runs)
    }
    heard: dict[int, dict[str, npt.NDArray[np.bool_]]] = {}
    bits = 0.0
    for frame in layout.frames:
        rows = matching_rows(frame, wire)
        required = sum((condition.mask & 0x1FFF_FFFF).bit_count() for condition in frame.when)
        bits += required * int(rows.sum())
        patch: object = frame.patch
        keys = np.full(len(wire), patch if isinstance(patch, int) else 0, np.int64)
        if isinstance(patch, Bits):
            keys = wire["identifier"].astype(np.int64) >> patch.shift & ((1 << patch.width) - 1)
        for key in np.unique(keys[rows]).tolist():
            heard.setdefault(key, {})[frame.name] = rows & (keys == key)
    whole: dict[int, dict[str, npt.NDArray[np.bool_]]] = {}
    for key, frames in heard.items():
        lacking = {name for members in cycles if not members <= frames.keys() for name in members}
        known = {name: rows for name, rows in frames.items() if name not in lacking}
        if known.keys() - without_values:
            whole[key] = known
    if not whole:
        return None
    rows = np.logical_or.reduce([of_frame for frames in whole.values() for of_frame in frames.values()])
    return _Match(name, adapter, rows, frozenset(whole), bits / len(wire))


class _HeardLink(Link):
    """A driver's link to recorded frames: it listens without waiting, and cannot send."""

    def __init__(self, bus: Bus, heard: dict[Heard, int]) -> None:
        super().__init__(bus)
        self._known = Counter(heard)

    @property
    def listen_only(self) -> bool:
        return True

    async def send(self, identifier: int, payload: bytes, *, timeout_s: float = 0.0) -> None:  # noqa: ARG002
        raise BusSendError(f"{self.bus_name}: frame {identifier:03X} not sent: recorded frames cannot be answered")

    async def listen(self, duration_s: float) -> Counter[Heard]:
        del duration_s
        return self._known

    async def sleep(self, duration_s: float) -> None:
        del duration_s
        await asyncio.sleep(0)


async def _describe(adapter: AnyAdapter, bus: Bus, heard: dict[Heard, int]) -> Sequence[Patch]:
    try:
        return await asyncio.wait_for(adapter.describe(_HeardLink(bus, heard)), _NAMING_S)
    except (BusError, TimeoutError):
        return ()
