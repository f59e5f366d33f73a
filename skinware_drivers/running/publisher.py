"""When a frame is published, and what it says: the decoder's arrays plus what only time can tell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverWriter
from skinware.realtime import NS_PER_S, now_ns
from skinware.samples import SAMPLE, SAMPLES
from skinware.status import LOAD_UNKNOWN, BusState, DataPath, PatchState, Status, age_limit_ns
from skinware_drivers.counters import OWN_BUS_COUNTERS, BusCounters, read_own
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.decoding.skin_state import BUS_COUNTERS, PATCH_COUNTERS, Updates
from skinware_drivers.polling import Watch
from skinware_drivers.running.attention import HoldUp
from skinware_drivers.running.bursts import Bursts
from skinware_drivers.running.guard import failure
from skinware_drivers.running.patch_timing import PatchTiming

ALL_BUS_COUNTERS = (*OWN_BUS_COUNTERS, *BUS_COUNTERS)
"""Counters of every bus, in the order of the frame's ``bus_counters``."""
ALL_PATCH_COUNTERS = PATCH_COUNTERS

_IDLE_NS = NS_PER_S // 4
NOBODY_WAITS = (1 << 63) - 1
"""In place of the oldest data that is new enough for somebody."""
_STALE = np.uint8(Status.STALE)
_LIVE, _NOW_STALE = np.uint8(PatchState.LIVE), np.uint8(PatchState.STALE)


class Desk(Protocol):
    """Who waits for frames; see :class:`skinware_drivers.running.desk.RequestDesk`."""

    @property
    def wanted_ns(self) -> int: ...

    def published(self, oldest_ns: int, position: tuple[int, int]) -> None: ...


class Publisher:
    """Copies the state of the skin into the ring at the right moments.

    By cycle: as soon as every update group that lives was heard (but for those that are slower than the driver); and
    always before a patch begins its next burst, so that no update is overwritten before it was published and no frame
    holds two bursts of a patch (see ``bursts``). If neither happens, half a period after the cycle is over. Otherwise
    at deadlines that the runner keeps.

    With nothing to show it publishes four times a second, so that readers see the states.

    Args:
        writer: where to.
        decoder: where from.
        watch: marks doubtful modules.
        period_s: nominal time between two updates of a module.
        by_cycle: see above.
        desk: who asks for frames.
        on_request: publish only what somebody waits for (beside the very first frame).
    """

    def __init__(
        self,
        writer: DriverWriter,
        decoder: Decoder,
        watch: Watch,
        period_s: float,
        by_cycle: bool,
        desk: Desk | None = None,
        on_request: bool = False,
    ) -> None:
        self._writer = writer
        self._state = decoder.state
        self.watch = watch
        self.period_ns = round(period_s * NS_PER_S)
        self.by_cycle = by_cycle
        self._desk, self.on_request = desk, on_request and desk is not None
        self.most_at_once: int = writer.slots  # of one take; more than the ring holds are seen by nobody
        # longer than a period: what comes late must not be cut off from its burst, or bursts mix from then on
        self.patience_ns = self.period_ns * 3 // 2
        self.pause_ns = self.period_ns // 2
        self.idle_ns: int = max(_IDLE_NS, 2 * self.period_ns)
        self._silence_ns = age_limit_ns(self.period_ns)
        self._structure = structure = decoder.tables.structure
        self._group_patch = self._state.group_patch
        self._group_module = structure.group_module.astype(np.intp)
        self._sensor_group = structure.sensor_group.astype(np.intp)
        self._state.settle_pace(self.period_ns)
        self.age_limit_ns = structure.group_age_limits_ns(self.period_ns)
        self._counts = np.zeros((len(structure.buses), len(ALL_BUS_COUNTERS)), np.int64)
        self.bursts = Bursts(self._state, self.period_ns, self._show, self._skip)
        self.group_heard_ns = np.full(structure.n_groups, now_ns(), np.int64)
        self.timing: PatchTiming = PatchTiming(structure)
        self.patch_heard_ns = np.zeros(structure.n_patches, np.int64)
        self.patch_lives_until_ns = np.zeros(structure.n_patches, np.int64)  # unless something whole comes before
        self._due_ns = 0
        self._not_before_ns = 0  # a burst that has begun holds up the frame until then
        self._last_published_ns = now_ns()
        self.patch_state: npt.NDArray[np.uint8] = np.full(structure.n_patches, int(PatchState.EXPECTED), np.uint8)
        self.bus_state: npt.NDArray[np.uint8] = np.full(len(structure.buses), int(BusState.CONNECTING), np.uint8)
        self.bus_reason: npt.NDArray[np.uint8] = np.zeros(len(structure.buses), np.uint8)
        self.bus_since_ns: npt.NDArray[np.int64] = np.zeros(len(structure.buses), np.int64)
        self.bus_load: npt.NDArray[np.uint16] = np.full(len(structure.buses), LOAD_UNKNOWN, np.uint16)
        self.bus_samples: npt.NDArray[np.void] = np.zeros((len(structure.buses), SAMPLES), SAMPLE)
        self.latency_ns: npt.NDArray[np.int64] = np.zeros(1, np.int64)
        self.data_path: npt.NDArray[np.uint8] = np.full(1, int(DataPath.PYTHON), np.uint8)
        self.bus_data_path: npt.NDArray[np.uint8] = np.full(len(structure.buses), int(DataPath.PYTHON), np.uint8)
        self.bus_counters: Sequence[BusCounters] = [BusCounters() for _ in structure.buses]

    @property
    def sequence(self) -> int:
        return self._writer.sequence

    @property
    def ring_address(self) -> int | None:
        """Of what C code publishes through; None where Python does."""
        return self._writer.ring_address

    def column_offsets(self) -> dict[str, int]:
        """Where each column of a frame begins, bytes from the beginning of its slot."""
        return self._writer.column_offsets()

    @property
    def silence_ns(self) -> int:
        """How long a patch may be silent before it counts as stale."""
        return self._silence_ns

    @property
    def deadline_ns(self) -> int:
        """When ``publish_if_due`` has something to do at the latest, CLOCK_MONOTONIC ns."""
        if not self.by_cycle:
            return self._last_published_ns + self.period_ns
        idle_ns = self._last_published_ns + self.idle_ns
        return max(self._not_before_ns, min(self._due_ns, idle_ns) if self._due_ns else idle_ns)

    def take(self, updates: Updates) -> None:
        if not len(updates):
            return
        time_ns = now_ns()
        self.count_buses()
        self._hear(updates, time_ns)
        self._update_patch_states(time_ns)
        if not self.by_cycle:
            self._show(updates)
            return
        self.bursts.take(updates, self._living(time_ns), self.publish, self.most_at_once - 1)
        self._look_at_frame(time_ns)

    def publish_if_due(self, read_ns: int) -> None:
        """Publish if the time has come, and nothing speaks against it.

        Args:
            read_ns: all that arrived until then was taken, CLOCK_MONOTONIC ns. What came since may belong to a burst
                that has begun.
        """
        time_ns = now_ns()
        if time_ns < self.deadline_ns:
            return
        self.count_buses()
        self._update_patch_states(time_ns)
        if self.by_cycle:
            read_ns = min(read_ns, time_ns)
            living = self._living(read_ns)
            open_patches = self.bursts.in_the_middle(living, read_ns)
            if open_patches.any():
                self._due_ns = self._not_before_ns = self.bursts.pause_ends_ns(open_patches)
                return
            self.publish()
            self.bursts.take(None, living, self.publish, self.most_at_once - 2)
            self._look_at_frame(read_ns)
        else:
            self.publish()

    def publish(self) -> None:
        state, time_ns = self._state, now_ns()
        if self._wanted(time_ns):
            self._write(time_ns)
        state.begin_frame()
        self._due_ns = self._not_before_ns = 0
        self._last_published_ns = time_ns

    def _wanted(self, time_ns: int) -> bool:
        if not self.on_request or not self._writer.sequence:
            return True
        return self.wanted_ns <= self._oldest_new_ns(time_ns)

    def _oldest_new_ns(self, time_ns: int) -> int:
        """Oldest stamp of what is new in this frame; if nothing is, the frame says so as of now."""
        new = self._state.updated
        return int(self._state.group_time_ns[new].min()) if new.any() else time_ns

    def _write(self, time_ns: int) -> None:
        state = self._state
        self.timing.count(state.updated & state.is_prompt, state.group_time_ns, time_ns)
        columns = self._writer.begin()
        columns["values"][:] = state.values
        columns["module_time_ns"][:] = state.module_time_ns
        if not self._structure.groups_are_modules:
            columns["group_time_ns"][:] = state.group_time_ns
        self._fill_status(columns["status"], time_ns)
        columns["module_untouched"][:] = self.watch.module_untouched
        columns["patch_state"][:] = self.patch_state
        columns["bus_state"][:] = self.bus_state
        columns["bus_reason"][:] = self.bus_reason
        columns["bus_since_ns"][:] = self.bus_since_ns
        columns["bus_load"][:] = self.bus_load
        columns["bus_samples"][:] = self.bus_samples.view(np.uint8).reshape(-1)
        columns["bus_counters"][:] = self._counts.reshape(-1)
        columns["patch_counters"][:] = state.patch_counters.reshape(-1)
        columns["patch_interval_counts"][:] = self.timing.intervals.reshape(-1)
        columns["patch_age_counts"][:] = self.timing.ages.reshape(-1)
        columns["latency_ns"][:] = self.latency_ns
        columns["data_path"][:] = self.data_path
        columns["bus_data_path"][:] = self.bus_data_path
        self._writer.commit(state.newest_ns or time_ns)
        if self.wanted_ns < NOBODY_WAITS:
            self.answer(self._oldest_new_ns(time_ns))

    @property
    def wanted_ns(self) -> int:
        """The oldest data that is new enough for one of those who wait for a frame; far ahead if nobody does."""
        return NOBODY_WAITS if self._desk is None else self._desk.wanted_ns

    def answer(self, oldest_ns: int) -> None:
        """A frame was published: tell those who waited for it.

        Args:
            oldest_ns: of the data that is new in it, CLOCK_MONOTONIC ns.
        """
        if self._desk is not None:
            self._desk.published(oldest_ns, self._writer.position)

    def lose(self, patch: int, state: PatchState) -> None:
        """Take a patch as silent from here on, until its next data."""
        self.patch_lives_until_ns[patch] = 0
        self.patch_state[patch] = state

    def excuse(self, hold_up: HoldUp) -> None:
        """Count silence from now on, of patches that lived when this process was held up.

        What was heard before the machine slept is older by as much as it slept.
        """
        lived = self.patch_lives_until_ns > hold_up.since_ns
        until_ns = np.maximum(self.patch_lives_until_ns, now_ns() + self._silence_ns)
        self.patch_lives_until_ns[lived] = until_ns[lived]
        times_ns = self._state.group_time_ns
        times_ns[:] = np.where(times_ns > 0, np.maximum(1, times_ns - hold_up.asleep_ns), 0)

    def silent_ns(self, patch: int) -> int:
        """For how long a patch has been silent beyond its age limit, while this process attended."""
        return now_ns() - int(self.patch_lives_until_ns[patch])

    def count_buses(self) -> npt.NDArray[np.int64]:
        """(n_buses, len(ALL_BUS_COUNTERS)) int64, as of now."""
        self._counts[:, : len(OWN_BUS_COUNTERS)] = [read_own(counters) for counters in self.bus_counters]
        self._counts[:, len(OWN_BUS_COUNTERS) :] = self._state.bus_counters
        return self._counts

    def _update_patch_states(self, time_ns: int) -> None:
        live = self.patch_lives_until_ns > time_ns
        if not live.all() or not (self.patch_state == _LIVE).all():
            self.patch_state[~live & (self.patch_state == _LIVE)] = _NOW_STALE
            self.patch_state[live] = _LIVE

    def _show(self, updates: Updates) -> None:
        self._state.show(updates)
        are_flagged = updates.flagged and updates.status.any()  # not only others of the same batch
        if are_flagged or (self.watch.sees_all and len(updates)):
            self.look(updates)

    def look(self, updates: Updates) -> None:
        """Let the watch look at updates that were shown.

        Raises:
            DriverError: it raised something.
        """
        try:
            self.watch.look(updates)
        except Exception as error:
            buses = np.unique(self._structure.patch_bus[self._group_patch[updates.group]]).tolist()
            names = ", ".join(self._structure.buses[bus] for bus in buses)
            raise failure("Watch.look", f"bus {names}", error) from error

    def _skip(self, of_patch: npt.NDArray[np.int64]) -> None:
        for patch in np.flatnonzero(of_patch).tolist():
            self.bus_counters[int(self._structure.patch_bus[patch])].updates_skipped += int(of_patch[patch])

    def _look_at_frame(self, time_ns: int) -> None:
        """After new data: publish a complete frame, or say when it will be due."""
        state = self._state
        if self.bursts.holds_back:
            self._due_ns = time_ns + self.pause_ns
        elif state.updated.any() and (state.touched | ~self._living(time_ns)).all():
            self.publish()
        elif not self._due_ns and state.touched.any():
            self._due_ns = time_ns + self.patience_ns

    def _hear(self, updates: Updates, time_ns: int) -> None:
        """Note which groups live. Of a patch that begins to send, all: its first burst is not over after one."""
        group, whole = updates.group, updates.whole
        patch_sends = np.zeros(len(self.patch_heard_ns), bool)
        patch_sends[self._group_patch[group[self._state.is_prompt[group]]]] = True
        begins = patch_sends & (time_ns - self.patch_heard_ns > self._silence_ns)
        if begins.any():
            self.group_heard_ns[begins[self._group_patch]] = time_ns
        self.patch_heard_ns[patch_sends] = time_ns
        self.group_heard_ns[group] = time_ns
        until_ns = np.minimum(updates.newest_ns[whole], time_ns) + self.age_limit_ns[group[whole]]
        np.maximum.at(self.patch_lives_until_ns, self._group_patch[group[whole]], until_ns)

    def _living(self, time_ns: int) -> npt.NDArray[np.bool_]:
        """(n_groups,) bool, groups that can be expected to send in every period."""
        living: npt.NDArray[np.bool_] = time_ns - self.group_heard_ns < self._silence_ns
        living &= self._state.is_prompt
        return living

    def _fill_status(self, status: npt.NDArray[np.uint8], time_ns: int) -> None:
        """What the wire said, what time tells, and what the driver's watch holds against a module."""
        seen_ns = self._state.group_time_ns
        bits = np.multiply((seen_ns > 0) & (seen_ns < time_ns - self.age_limit_ns), _STALE)
        bits |= self.watch.module_status[self._group_module]
        if bits.any():
            np.bitwise_or(self._state.status, bits.take(self._sensor_group), out=status)
        else:
            status[:] = self._state.status
