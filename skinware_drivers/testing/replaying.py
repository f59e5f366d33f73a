"""What a device sent, decoded again and again with runs of frames lost and with a sender that catches up.

Every run of frames up to two bursts long, beginning at every frame of a burst, and many ways in which the frames round
it can be late: far too much to run a driver each time. So a few bursts of one patch are recorded once, and thousands of
variants of them go through the driver's layout in a few batches.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import gcd
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.decoding.device_numbers import read_numbers
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Layout

Indices = npt.NDArray[np.int64]

BURSTS = 8
_TROUBLE = 3
"""The burst in which frames begin to be lost."""
_APART = 2 * BURSTS
"""Periods from one variant to the next."""
_PACE_NS = 20_000
"""Between two frames of a sender that catches up."""
_MOST_PLACES, _MOST_FRAMES = 32, 1024
"""So many frames of a long burst are tried as the first that is lost; fewer of a very long one, so that all variants of
its frames are not too many."""


class Recording(NamedTuple):
    """Some bursts of one patch.

    Attributes:
        layout: what its frames mean.
        tables: the skin.
        period_s: from burst to burst.
        size: frames of a burst.
        wire: (bursts * size,) frames, as in a batch.
        time_ns: (bursts * size,) int64.
    """

    layout: Layout
    tables: SkinTables
    period_s: float
    size: int
    wire: npt.NDArray[Any]
    time_ns: Indices


@dataclass(frozen=True)
class Trouble:
    """What goes wrong with a recording.

    Attributes:
        first: first frame that is lost.
        lost: how many are.
        held: first frame that is held back, and from then on all until ``until_ns``; None: none is.
        until_ns: when the sender goes on.
    """

    first: int
    lost: int
    held: int | None = None
    until_ns: int = 0

    def in_words(self, recording: Recording) -> str:
        words = f"{self.lost} frames in a row were lost, from frame {self.first % recording.size + 1} of a burst on"
        if self.held is None:
            return words
        held_ms = (self.until_ns - int(recording.time_ns[self.held])) / 1e6
        return f"{words}, while the sender stood still for {held_ms:.3g} ms; then it caught up"


@dataclass
class Outcome:
    """What came of all troubles.

    Attributes:
        tried: troubles.
        shown: updates that were shown as fresh.
        torn: those of them that are of different bursts.
        first: a trouble of which one came.
    """

    tried: int = 0
    shown: int = 0
    torn: int = 0
    first: Trouble | None = None


def record(
    layout: Layout, tables: SkinTables, period_s: float, wire: npt.NDArray[Any], time_ns: Indices, bursts: int = BURSTS
) -> Recording | None:
    """Of the frames of a bus, those of its first patch; None if they are fewer than so many bursts.

    Args:
        layout: of the bus.
        tables: the skin.
        period_s: from burst to burst.
        wire: (n,) frames in order, as in a batch.
        time_ns: (n,) int64.
        bursts: how many of them.
    """
    # with a device's own time, it would be known when frames were sent; here they must be told apart without
    layout = replace(layout, frames=[replace(frame, time=None) for frame in layout.frames])
    decoder = Decoder([layout], tables)
    entry, kind, _ = decoder.name(_batch_of(decoder, wire, time_ns))
    own = np.flatnonzero((entry < tables.structure.n_modules) & (kind != 255))
    own = own[tables.structure.module_patch[entry[own]] == 0]
    same = np.flatnonzero((entry[own] == entry[own[:1]]) & (kind[own] == kind[own[:1]]))
    if len(same) < bursts + 1:
        return None
    own = own[: same[bursts]]
    size = len(own) // bursts
    own = own[: size * bursts]
    return Recording(layout, tables, period_s, size, wire[own].copy(), time_ns[own].copy())


def counter_values(recording: Recording) -> Indices:
    """(k,) every number that the counter of the cycle has in the recording; empty if there is no counter."""
    layout = recording.layout
    if layout.cycle is None or not layout.cycle.counters:
        return np.zeros(0, np.int64)
    decoder = Decoder([layout], recording.tables)
    _, kind, _ = decoder.name(_batch_of(decoder, recording.wire, recording.time_ns))
    names = [frame.name for frame in layout.frames]
    numbers = [
        read_numbers(recording.wire["payload"][kind == names.index(member)], counter)
        for member, counter in zip(layout.cycle.members, layout.cycle.counters, strict=True)
    ]
    return np.unique(np.concatenate(numbers))


def try_troubles(recording: Recording, with_period: bool = True) -> Outcome:
    """Lose every run of frames up to two bursts long, hold up the sender in every way, and see what is shown.

    Args:
        recording: of what.
        with_period: False: as if nobody knew how often the device sends.
    """
    outcome = Outcome()
    step = _step(recording.size)
    for place in range(0, recording.size, step):
        troubles = list(_troubles_at(recording, _TROUBLE * recording.size + place, step))
        fresh, torn = find_torn(recording, *_suffer(recording, troubles), with_period=with_period)
        outcome.tried += len(troubles)
        outcome.shown += len(fresh)
        outcome.torn += int(torn.sum())
        if torn.any() and outcome.first is None:
            number = (fresh.oldest_ns[torn][0] - recording.time_ns[0]) // _span_ns(recording)
            outcome.first = troubles[int(number)]
    return outcome


def _step(size: int) -> int:
    """From one place to be tried to the next; the places are at all distances from where modules begin."""
    step = -(-size // min(_MOST_PLACES, max(1, _MOST_FRAMES // size)))
    while gcd(step, size) > 1:
        step += 1
    return step


def find_torn(
    recording: Recording, rows: Indices, time_ns: Indices, *, with_period: bool = True
) -> tuple[Updates, npt.NDArray[np.bool_]]:
    """What is shown as fresh when these frames arrive.

    Args:
        recording: whose.
        rows: (n,) of it, in order of arrival.
        time_ns: (n,) when each arrives.
        with_period: False: as if nobody knew how often the device sends.

    Returns:
        The updates; and which of them are not of one burst, (n_updates,) bool.
    """
    layouts, tables, n_sensors = [recording.layout], recording.tables, recording.tables.structure.n_sensors
    known = _marks(_decode(Decoder(layouts, tables), recording.wire, recording.time_ns), n_sensors)
    decoder = Decoder(layouts, tables, [recording.period_s] if with_period else None)
    updates = _decode(decoder, recording.wire[rows], time_ns)
    fresh = updates.take(np.flatnonzero(~updates.status.any(axis=1)))
    return fresh, ~np.isin(_marks(fresh, n_sensors), known)


def _span_ns(recording: Recording) -> int:
    return round(_APART * recording.period_s * 1e9)


def _troubles_at(recording: Recording, first: int, step: int) -> Iterator[Trouble]:
    period_ns = round(recording.period_s * 1e9)
    begin = _TROUBLE * recording.size
    for lost in range(0, 2 * recording.size + 1, step):
        yield Trouble(first, lost)
        over_ns = int(recording.time_ns[first + lost])
        for held in sorted({begin - recording.size, begin, first - 1, first}):
            yield Trouble(first, lost, held, over_ns)
        yield Trouble(first, lost, begin, over_ns + period_ns)


def _suffer(recording: Recording, troubles: Sequence[Trouble]) -> tuple[Indices, Indices]:
    row, span_ns = np.arange(len(recording.wire)), _span_ns(recording)
    rows, times_ns = [], []
    for number, trouble in enumerate(troubles):
        kept = row[(row < trouble.first) | (row >= trouble.first + trouble.lost)]
        time_ns = recording.time_ns[kept]
        if trouble.held is not None:
            time_ns = np.where(kept >= trouble.held, np.maximum(time_ns, trouble.until_ns), time_ns)
            behind_ns = np.arange(len(kept)) * _PACE_NS
            time_ns = np.maximum.accumulate(time_ns - behind_ns) + behind_ns
        rows.append(kept)
        times_ns.append(time_ns + number * span_ns)
    return np.concatenate(rows), np.concatenate(times_ns)


def _batch_of(decoder: Decoder, wire: npt.NDArray[Any], time_ns: Indices) -> FrameBatch:
    batch = FrameBatch(len(wire), wire.dtype["payload"].shape[0], decoder.compiled.headroom)
    batch.stop = batch.start + len(wire)
    batch.wire[batch.start : batch.stop] = wire
    batch.time_ns[batch.start : batch.stop] = time_ns
    return batch


def _decode(decoder: Decoder, wire: npt.NDArray[Any], time_ns: Indices) -> Updates:
    updates, _ = decoder.decode(_batch_of(decoder, wire, time_ns))
    return updates.take(updates.whole)


def _marks(updates: Updates, n_sensors: int) -> Indices:
    values = np.where(updates.sensors == n_sensors, 0, updates.values).astype(updates.values.dtype)
    data = np.ascontiguousarray(values).view(np.uint8).reshape(len(updates), -1).astype(np.int64)
    factors = np.random.default_rng(3).integers(1, 1 << 62, data.shape[1])
    marks: Indices = data @ factors + updates.module * 0x9E37_79B9_7F4A_7C1
    return marks
