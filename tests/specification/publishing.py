"""When a snapshot is published, in numpy: what ``publishing.c`` and ``bursts.c`` are compared with."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.memory.statistics import BUCKETS
from skinware.realtime import now_ns
from skinware.status import PatchState, Status
from skinware_drivers.decoding.decoder import Updates
from skinware_drivers.running.publisher import NEVER_NS, PatchTiming, Publisher
from tests.specification.bursts import Bursts
from tests.specification.decoding import SpecifiedState

_SPLIT = 4
_STALE = np.uint8(Status.STALE)
_LIVE, _NOW_STALE = np.uint8(PatchState.LIVE), np.uint8(PatchState.STALE)


class SpecifiedPublisher(Publisher):
    """A publisher that publishes by itself."""

    state: SpecifiedState

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.most_at_once = self.writer.slots
        self.bursts = Bursts(self.state, self.patches, self.pace, self._show, self._skip)
        self._group_module = self._structure.group_module.astype(np.intp)
        self._sensor_group = self._structure.sensor_group.astype(np.intp)
        self._n_split = 0  # frames in turn that held a long pause
        self._is_early = np.zeros(self._structure.n_groups, bool)  # what came before it
        self._due_ns = 0
        self._not_before_ns = 0  # a burst that has begun holds up the snapshot until then
        self._last_published_ns = now_ns()

    @property
    def deadline_ns(self) -> int:
        """When ``publish_if_due`` has something to do at the latest, CLOCK_MONOTONIC ns."""
        if not self.by_cycle:
            return self._last_published_ns + self.pace.period_ns
        idle_ns = self._last_published_ns + self.pace.idle_ns
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
        state, time_ns = self.state, now_ns()
        if self._wanted(time_ns):
            self._write(time_ns)
        state.updated[:] = False
        state.touched[:] = False
        self._due_ns = self._not_before_ns = 0
        self._last_published_ns = time_ns

    def _wanted(self, time_ns: int) -> bool:
        if not self.on_request or not self.writer.sequence:
            return True
        return self.wanted_ns <= self._oldest_new_ns(time_ns)

    def _oldest_new_ns(self, time_ns: int) -> int:
        """Oldest stamp of what is new in this frame; if nothing is, the frame says so as of now."""
        new = self.state.updated
        return int(self.state.group_time_ns[new].min()) if new.any() else time_ns

    def _write(self, time_ns: int) -> None:
        state = self.state
        count_timing(self.timing, state.group_patch, state.updated & state.is_prompt, state.group_time_ns, time_ns)
        columns = self.writer.begin()
        columns["values"][:] = state.values
        columns["module_time_ns"][:] = state.module_time_ns
        if not self._structure.groups_are_modules:
            columns["group_time_ns"][:] = state.group_time_ns
        self._fill_status(columns["status"], time_ns)
        columns["module_untouched"][:] = self.watch.module_untouched
        columns["patch_state"][:] = self.patches.state
        columns["bus_state"][:] = self.buses.state
        columns["bus_reason"][:] = self.buses.reason
        columns["bus_since_ns"][:] = self.buses.since_ns
        columns["bus_load"][:] = self.buses.load
        columns["bus_samples"][:] = self.buses.samples.view(np.uint8).reshape(-1)
        columns["bus_counters"][:] = self._counts.reshape(-1)
        columns["patch_counters"][:] = state.patch_counters.reshape(-1)
        columns["patch_interval_counts"][:] = self.timing.intervals.reshape(-1)
        columns["patch_age_counts"][:] = self.timing.ages.reshape(-1)
        columns["latency_ns"][:] = self.latency_ns
        columns["data_path"][:] = self.data_path
        columns["bus_data_path"][:] = self.buses.data_path
        self.writer.commit(state.newest_ns or time_ns)
        if self.wanted_ns < NEVER_NS:
            self.answer(self._oldest_new_ns(time_ns))

    def _update_patch_states(self, time_ns: int) -> None:
        live = self.patches.lives_until_ns > time_ns
        if not live.all() or not (self.patches.state == _LIVE).all():
            self.patches.state[~live & (self.patches.state == _LIVE)] = _NOW_STALE
            self.patches.state[live] = _LIVE

    def _show(self, updates: Updates) -> None:
        self.state.show(updates)
        are_flagged = updates.flagged and updates.status.any()  # not only others of the same batch
        if are_flagged or (self.watch.sees_all and len(updates)):
            self.look(updates)

    def _skip(self, of_patch: npt.NDArray[np.int64]) -> None:
        for patch in np.flatnonzero(of_patch).tolist():
            self.buses.counters[int(self._structure.patch_bus[patch])].updates_skipped += int(of_patch[patch])

    def _look_at_frame(self, time_ns: int) -> None:
        """After new data: publish a complete frame, or say when it will be due."""
        state = self.state
        if self.bursts.holds_back:
            self._due_ns = time_ns + self.pace.pause_ns
        elif state.updated.any() and (state.touched | ~self._living(time_ns)).all():
            self._find_pause()
            self.publish()
        elif state.updated.any() and self._is_at_pause():
            self._n_split = 0
            self.publish()
        elif not self._due_ns and state.touched.any():
            self._due_ns = time_ns + self.pace.patience_ns

    def _find_pause(self) -> None:
        """Find the pause of patches that send together, if a complete frame does not end before it."""
        is_new, times_ns = self.state.updated & self.state.is_prompt, self.state.group_time_ns
        new_ns = np.unique(times_ns[is_new])
        if len(new_ns) < 2:
            self._n_split = 0
            return
        middle_ns = new_ns[0] + (new_ns[-1] - new_ns[0]) // 2
        self._is_early = is_new & (times_ns <= middle_ns)
        pause_ns = new_ns[new_ns > middle_ns][0] - new_ns[new_ns <= middle_ns][-1]
        self._n_split = self._n_split + 1 if pause_ns > self.pace.period_ns // 8 * 5 else 0

    def _is_at_pause(self) -> bool:
        """Return whether all has come that comes before the pause, so that the next frame can begin behind it."""
        is_split = self._n_split >= _SPLIT and not self.on_request
        return is_split and bool(self.state.updated[self._is_early].all())

    def _hear(self, updates: Updates, time_ns: int) -> None:
        """Note which groups live. Of a patch that begins to send, all: its first burst is not over after one."""
        group, whole = updates.group, updates.whole
        patch_sends = np.zeros(len(self.patches.heard_ns), bool)
        patch_sends[self.state.group_patch[group[self.state.is_prompt[group]]]] = True
        begins = patch_sends & (time_ns - self.patches.heard_ns > self.pace.silence_ns)
        if begins.any():
            self.patches.group_heard_ns[begins[self.state.group_patch]] = time_ns
        self.patches.heard_ns[patch_sends] = time_ns
        self.patches.group_heard_ns[group] = time_ns
        until_ns = np.minimum(updates.newest_ns[whole], time_ns) + self.patches.age_limit_ns[group[whole]]
        np.maximum.at(self.patches.lives_until_ns, self.state.group_patch[group[whole]], until_ns)

    def _living(self, time_ns: int) -> npt.NDArray[np.bool_]:
        """(n_groups,) bool, groups that can be expected to send in every period."""
        living: npt.NDArray[np.bool_] = time_ns - self.patches.group_heard_ns < self.pace.silence_ns
        living &= self.state.is_prompt
        return living

    def _fill_status(self, status: npt.NDArray[np.uint8], time_ns: int) -> None:
        """What the wire said, what time tells, and what the driver's watch holds against a module."""
        seen_ns = self.state.group_time_ns
        bits = np.multiply((seen_ns > 0) & (seen_ns < time_ns - self.patches.age_limit_ns), _STALE)
        bits |= self.watch.module_status[self._group_module]
        if bits.any():
            np.bitwise_or(self.state.status, bits.take(self._sensor_group), out=status)
        else:
            status[:] = self.state.status


def count_timing(
    timing: PatchTiming,
    group_patch: npt.NDArray[np.intp],
    updated: npt.NDArray[np.bool_],
    group_time_ns: npt.NDArray[np.int64],
    time_ns: int,
) -> None:
    """Count what a frame shows for the first time.

    Args:
        timing: where it is counted.
        group_patch: (n_groups,) the patch of each group.
        updated: (n_groups,) bool.
        group_time_ns: (n_groups,) int64, stamps of what the frame shows.
        time_ns: when it is published.
    """
    group = np.flatnonzero(updated)
    again = np.flatnonzero(updated & (timing.before_ns > 0))
    for histograms, groups, times_ns in (
        (timing.intervals, again, group_time_ns[again] - timing.before_ns[again]),
        (timing.ages, group, time_ns - group_time_ns[group]),
    ):
        # the exponent of a number of nanoseconds is its length in bits, which is its bucket
        bucket = np.frexp(np.maximum(times_ns, 0).astype(np.float64))[1].astype(np.intp)
        np.add.at(histograms, (group_patch[groups], np.minimum(bucket, BUCKETS - 1)), 1)
    timing.before_ns[group] = group_time_ns[group]
