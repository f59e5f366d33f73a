"""Test that halves of different bursts are never shown as one, whatever is lost, late or caught up.

Every run of frames up to two bursts long, beginning at every frame of a burst, with the frames around it late in many
ways: too much to run a driver each time. So a few bursts of one patch are recorded once, and thousands of variants of
them go through the driver's layout in a few batches.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from math import gcd
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import Updates, read_numbers
from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Layout
from skinware_drivers.polling import Watch
from skinware_drivers.running.native_path import Named
from skinware_drivers.testing.comparison import ShownUpdates, until_fresh
from skinware_drivers.testing.rig import Running, Suite, in_its_time
from skinware_drivers.testing.vectors import DirectPath
from skinware_drivers.testing.waiting import defect, require
from skinware_drivers.testing.wire import Stumbling
from skinware_drivers.virtual.hand_clock import HandClock

Indices = npt.NDArray[np.int64]

BURSTS = 8
_TROUBLE = 3
"""The burst in which losses begin."""
_APART = 2 * BURSTS
"""Periods between two variants."""
_PACE_NS = 20_000
"""Time between two frames of a sender that catches up."""
_MOST_PLACES, _MOST_FRAMES = 32, 1024
"""Number of frames of a long burst that are tried as the first lost one, and frames of all variants of a burst."""
_STUMBLING_PERIODS = 80
_RECOVERY_S = 0.5
"""In it a driver gives up what it still waits for; one that asks has timeouts of many periods."""
_WHAT_TO_DO = (
    "say in the layout's Cycle where its frames have a `counter`; where they have none, make `maximum_age_s` half a"
    " period or shorter"
)


class TornTests(Suite):
    """Runs of lost frames, and senders that stand still and catch up."""

    @in_its_time
    async def test_no_run_of_lost_frames_tears_a_burst(self, clock: HandClock) -> None:
        """Runs up to two bursts long, from every frame on; the frames around them in time, late, or caught up."""
        async with self.running(clock) as rig:
            await until_fresh(rig)
            if not rig.adapter.layout.cycles:
                return  # a frame is all of an update
            heard = FrameLog(rig)
            await rig.sleep((BURSTS + 4) * rig.adapter.period_s)
            recording = heard.recording()
        if recording is None:
            defect(f"the emulated devices send fewer than {BURSTS} bursts in {BURSTS + 4} periods")
        cycle = recording.layout.cycle
        if cycle is not None and cycle.counters:
            _, kind = _named(recording.layout, recording.tables, recording.wire, recording.time_ns)
            names = [frame.name for frame in recording.layout.frames]
            found = [
                read_numbers(recording.wire["payload"][kind == names.index(member)], counter)
                for member, counter in zip(cycle.members, cycle.counters, strict=True)
            ]
            numbers = np.unique(np.concatenate(found))
            if len(numbers) == 1:
                defect(
                    f"the `counter` of the cycle is {numbers[0]} in all frames of {BURSTS} bursts, so that it cannot"
                    " distinguish them: look at its `offset`, `dtype` and `mask`"
                )
        outcome = try_troubles(recording)
        require(outcome.shown >= 2 * outcome.tried, "hardly anything is shown when frames are lost now and then")
        if outcome.first is not None:
            defect(
                f"{outcome.torn} of {outcome.shown} updates show values of two bursts as if they were fresh:"
                f" {outcome.first.in_words(recording)}; {_WHAT_TO_DO}"
            )

    @in_its_time
    async def test_nothing_torn_is_shown_while_a_sender_stumbles(self, clock: HandClock) -> None:
        """The driver runs while its devices lose runs of frames, stand still and catch up; then all is fresh again."""
        async with self.running(clock) as rig:
            await until_fresh(rig)
            before, bursts = rig.wire.frames, rig.truth.most_bursts
            await rig.sleep(8 * rig.adapter.period_s)
            size = round((rig.wire.frames - before) / max(1, rig.truth.most_bursts - bursts))
            rig.wire.stumbling = Stumbling(rig.period_ns, max(1, size))
            await rig.sleep(_STUMBLING_PERIODS * rig.adapter.period_s)
            require(rig.wire.stumbling.stumbles > 3, "the emulated devices send too little to test faults with")
            rig.wire.stumbling = None
            end_ns = clock.now_ns
            await rig.sleep(max(4 * rig.adapter.period_s, _RECOVERY_S))
            ShownUpdates(rig).require_right("runs of frames were lost, and the sender stood still and caught up")
            shown_ns = rig.record.frames[-1].module_time_ns
            require((shown_ns > end_ns).all(), "the sender works again, but not all modules are shown")


class Delivery(NamedTuple):
    """Frames that a bus delivered at once, and their stamps, as in a batch."""

    now_ns: int
    wire: npt.NDArray[np.void]
    time_ns: npt.NDArray[np.int64]


class FrameLog:
    """Write down the frames that the bus of a running driver delivers, in order."""

    def __init__(self, rig: Running) -> None:
        if rig.runner is None or rig.runner.builder.generation is None:
            defect("the driver publishes nothing yet")
        self._rig = rig
        self.takes: list[Delivery] = []
        self.tables: SkinTables = rig.runner.builder.generation.tables
        receive = rig.bus.receive

        def listen(batch: FrameBatch, ordinal: int) -> int:
            first = batch.stop
            count = receive(batch, ordinal)
            if batch.stop > first:
                rows = slice(first, batch.stop)
                self.takes.append(Delivery(rig.clock.now_ns, batch.wire[rows].copy(), batch.time_ns[rows].copy()))
            return count

        rig.bus.receive = listen  # type: ignore[method-assign]

    def recording(self, bursts: int = BURSTS) -> Bursts | None:
        """Return bursts of the first patch; None if there are too few."""
        if not self.takes:
            return None
        wire, time_ns = np.concatenate([t.wire for t in self.takes]), np.concatenate([t.time_ns for t in self.takes])
        adapter = self._rig.adapter
        return record(adapter.layout, self.tables, adapter.period_s, wire, time_ns, bursts)


# -- variants of a recording ----------------------------------------------------------------------------------------


class Bursts(NamedTuple):
    """Some bursts of one patch: (bursts * size,) frames and their stamps, as in a batch."""

    layout: Layout
    tables: SkinTables
    period_s: float
    size: int
    wire: npt.NDArray[Any]
    time_ns: Indices


@dataclass(frozen=True)
class Trouble:
    """Losses and delays in a recording.

    Attributes:
        first: the first lost frame.
        held: the first frame that is held back until ``until_ns``, with all that follow; None: none is.
        until_ns: time at which the sender continues.
    """

    first: int
    lost: int
    held: int | None = None
    until_ns: int = 0

    def in_words(self, recording: Bursts) -> str:
        words = f"{self.lost} frames in a row were lost, from frame {self.first % recording.size + 1} of a burst on"
        if self.held is None:
            return words
        held_ms = (self.until_ns - int(recording.time_ns[self.held])) / 1e6
        return f"{words}, while the sender stood still for {held_ms:.3g} ms; then it caught up"


class Marked(NamedTuple):
    """Whole updates that were shown; (n,) each.

    Attributes:
        module: int64.
        oldest_ns: int64, oldest stamp of the frames of each.
        marks: int64; equal values of a module have equal marks.
        flagged: bool: not shown as fresh.
    """

    module: Indices
    oldest_ns: Indices
    marks: Indices
    flagged: npt.NDArray[np.bool_]


@dataclass
class Outcome:
    """The result of all troubles, and the first one that tore an update."""

    tried: int = 0
    shown: int = 0
    torn: int = 0
    first: Trouble | None = None


def record(
    layout: Layout, tables: SkinTables, period_s: float, wire: npt.NDArray[Any], time_ns: Indices, bursts: int = BURSTS
) -> Bursts | None:
    """Return bursts of the first patch among the frames of a bus, as in a batch; None if there are too few."""
    # a device's own time would say when frames were sent; bursts must be distinguished without it
    layout = replace(layout, frames=[replace(frame, time=None) for frame in layout.frames])
    entry, kind = _named(layout, tables, wire, time_ns)
    own = np.flatnonzero((entry < tables.structure.n_modules) & (kind != 255))
    own = own[tables.structure.module_patch[entry[own]] == 0]
    same = np.flatnonzero((entry[own] == entry[own[:1]]) & (kind[own] == kind[own[:1]]))
    if len(same) < bursts + 1:
        return None
    own = own[: same[bursts]]
    size = len(own) // bursts
    own = own[: size * bursts]
    return Bursts(layout, tables, period_s, size, wire[own].copy(), time_ns[own].copy())


def try_troubles(recording: Bursts, with_period: bool = True) -> Outcome:
    """Lose every run of frames up to two bursts long, hold up the sender in every way, and count torn updates.

    Without the period of the device, cycles are joined whenever their frames come.
    """
    outcome, size = Outcome(), recording.size
    step = -(-size // min(_MOST_PLACES, max(1, _MOST_FRAMES // size)))
    while gcd(step, size) > 1:  # or some parts of modules would never be tried
        step += 1
    span_ns = round(_APART * recording.period_s * 1e9)
    for place in range(0, size, step):
        troubles = list(_troubles_at(recording, _TROUBLE * size + place, step))
        rows, times_ns = [], []
        for number, trouble in enumerate(troubles):
            kept, time_ns = _suffer(recording, trouble)
            rows.append(kept)
            times_ns.append(time_ns + number * span_ns)
        fresh, torn = find_torn(recording, np.concatenate(rows), np.concatenate(times_ns), with_period=with_period)
        outcome.tried += len(troubles)
        outcome.shown += len(fresh.module)
        outcome.torn += int(torn.sum())
        if torn.any() and outcome.first is None:
            number = (fresh.oldest_ns[torn][0] - recording.time_ns[0]) // span_ns
            outcome.first = troubles[int(number)]
    return outcome


def find_torn(
    recording: Bursts, rows: Indices, time_ns: Indices, *, with_period: bool = True
) -> tuple[Marked, npt.NDArray[np.bool_]]:
    """Return the updates that are shown as fresh when frames of a recording arrive, and which are torn.

    Args:
        rows: (n,) indices of frames, in order of arrival.
        time_ns: (n,) times of arrival.
        with_period: False: decode without knowing the period of the device.

    Returns:
        The updates, and (n_updates,) bool: those that mix different bursts.
    """
    known = _decode(recording, recording.wire, recording.time_ns, None)
    shown = _decode(recording, recording.wire[rows], time_ns, recording.period_s if with_period else None)
    fresh = Marked._make(column[~shown.flagged] for column in shown)
    return fresh, ~np.isin(fresh.marks, known.marks)


def _troubles_at(recording: Bursts, first: int, step: int) -> Iterator[Trouble]:
    period_ns = round(recording.period_s * 1e9)
    begin = _TROUBLE * recording.size
    for lost in range(0, 2 * recording.size + 1, step):
        yield Trouble(first, lost)
        over_ns = int(recording.time_ns[first + lost])
        for held in sorted({begin - recording.size, begin, first - 1, first}):
            yield Trouble(first, lost, held, over_ns)
        yield Trouble(first, lost, begin, over_ns + period_ns)


def _suffer(recording: Bursts, trouble: Trouble) -> tuple[Indices, Indices]:
    """Return the frames that arrive, and when."""
    row = np.arange(len(recording.wire))
    kept = row[(row < trouble.first) | (row >= trouble.first + trouble.lost)]
    time_ns = recording.time_ns[kept]
    if trouble.held is not None:
        time_ns = np.where(kept >= trouble.held, np.maximum(time_ns, trouble.until_ns), time_ns)
        behind_ns = np.arange(len(kept)) * _PACE_NS
        time_ns = np.maximum.accumulate(time_ns - behind_ns) + behind_ns
    return kept, time_ns


def _named(layout: Layout, tables: SkinTables, wire: npt.NDArray[Any], time_ns: Indices) -> Named:
    with closing(DirectPath(layout, tables, wire.dtype["payload"].shape[0], rows=len(wire))) as path:
        return path.feed_rows(wire, time_ns)


def _decode(recording: Bursts, wire: npt.NDArray[Any], time_ns: Indices, period_s: float | None) -> Marked:
    layout, tables, size = recording.layout, recording.tables, wire.dtype["payload"].shape[0]
    log = _UpdateLog(tables)
    with closing(DirectPath(layout, tables, size, period_s=period_s, rows=len(wire), watch=log)) as path:
        path.feed_rows(wire, time_ns)
    return log.all


class _UpdateLog(Watch):
    """Write down all whole updates."""

    sees_all = True

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        none = np.zeros(0, np.int64)
        self.all = Marked(none, none, none, none > 0)

    def look(self, updates: Updates) -> None:
        whole, sink = np.flatnonzero(updates.whole), self.tables.structure.n_sensors
        values = np.where(updates.sensors == sink, 0, updates.values).astype(updates.values.dtype)[whole]
        data = np.ascontiguousarray(values).view(np.uint8).reshape(len(whole), -1).astype(np.int64)
        factors = np.random.default_rng(3).integers(1, 1 << 62, data.shape[1])
        marks = data @ factors + updates.module[whole] * 0x9E37_79B9_7F4A_7C1
        self.all = Marked(
            np.append(self.all.module, updates.module[whole]),
            np.append(self.all.oldest_ns, updates.oldest_ns[whole]),
            np.append(self.all.marks, marks),
            np.append(self.all.flagged, (updates.status[whole] != 0).any(axis=1)),
        )
