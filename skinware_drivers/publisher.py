"""When a frame is published, and what it says: the decoder's arrays plus what only time can tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverWriter
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusState, PatchState, Status
from skinware_drivers.adapter import Watch
from skinware_drivers.bus import BusCounters, FrameBatch
from skinware_drivers.decoder import BUS_COUNTERS, PATCH_COUNTERS, Decoder, Updates

ALL_BUS_COUNTERS = ("frames", "lost", "errors", "refused", "sent", "send_failures", *BUS_COUNTERS)
"""Counters of every bus, in the order of the frame's ``bus_counters``."""
ALL_PATCH_COUNTERS = PATCH_COUNTERS

_IDLE_NS = NS_PER_S // 4
_SILENT_PERIODS = 3
_LEAST_SILENCE_NS = NS_PER_S // 5


class Publisher:
    """Copies the state of the skin into the ring at the right moments.

    By cycle: as soon as every module that lives was heard; and always before a module would be shown twice, so that
    no cycle is overwritten before it was published. If neither happens, half a period after the cycle is over.
    Otherwise at deadlines that the runner keeps.

    With nothing to show it publishes four times a second, so that readers see the states.

    Args:
        writer: where to.
        decoder: where from.
        watch: marks doubtful modules.
        period_s: nominal time between two updates of a module.
        by_cycle: see above.
    """

    def __init__(self, writer: DriverWriter, decoder: Decoder, watch: Watch, period_s: float, by_cycle: bool) -> None:
        self._writer = writer
        self._decoder = decoder
        self._watch = watch
        self._period_ns = round(period_s * NS_PER_S)
        self._by_cycle = by_cycle
        # longer than a period: what comes late must not be cut off from its burst, or bursts mix from then on
        self._patience_ns = self._period_ns * 3 // 2
        self._silence_ns = max(_SILENT_PERIODS * self._period_ns, _LEAST_SILENCE_NS)
        structure = decoder.tables.structure
        self._module_patch = structure.module_patch
        self._sensor_module = structure.sensor_module
        self._module_heard_ns = np.full(structure.n_modules, now_ns(), np.int64)
        self._behind = np.zeros(structure.n_modules, bool)
        self._patch_heard_ns = np.zeros(structure.n_patches, np.int64)
        self._first_at = np.zeros(structure.n_modules, np.int64)
        self._first_touch_ns = 0
        self._last_published_ns = now_ns()
        self.patch_state = np.full(structure.n_patches, int(PatchState.EXPECTED), np.uint8)
        self.bus_state: npt.NDArray[np.uint8] = np.full(len(structure.buses), int(BusState.CONNECTING), np.uint8)
        self.bus_counters: Sequence[BusCounters] = [BusCounters() for _ in structure.buses]

    @property
    def silence_ns(self) -> int:
        """How long a patch may be silent before it counts as stale."""
        return self._silence_ns

    @property
    def deadline_ns(self) -> int:
        """When ``publish`` is due at the latest, CLOCK_MONOTONIC ns."""
        if not self._by_cycle:
            return self._last_published_ns + self._period_ns
        idle_ns = self._last_published_ns + max(_IDLE_NS, 2 * self._period_ns)
        return min(self._first_touch_ns + self._patience_ns, idle_ns) if self._first_touch_ns else idle_ns

    def take(self, batch: FrameBatch, updates: Updates) -> None:
        """Show the updates of a batch, publishing as often as needed for none to be overwritten unseen."""
        state = self._decoder.state
        if self._by_cycle and len(updates) and self._has_repeats(updates):
            updates = updates.take(np.argsort(updates.rows[:, -1], kind="stable"))
            while len(updates) and (fits := self._first_repeat(updates)) < len(updates):
                self._apply(batch, updates.take(slice(0, fits)))
                self.publish()
                updates = updates.take(slice(fits, None))
        self._apply(batch, updates)
        self._welcome_patches(updates)
        if not self._first_touch_ns and state.touched.any():
            self._first_touch_ns = now_ns()
        if self._by_cycle and self._is_complete():
            self.publish()

    def publish(self) -> None:
        """Publish what there is."""
        state, structure = self._decoder.state, self._decoder.tables.structure
        time_ns = now_ns()
        self._module_heard_ns[state.touched] = time_ns
        live = (state.patch_time_ns > 0) & (time_ns - state.patch_time_ns < self._silence_ns)
        self.patch_state[live] = PatchState.LIVE
        self.patch_state[~live & (self.patch_state == PatchState.LIVE)] = PatchState.STALE
        columns = self._writer.begin()
        columns["values"][:] = state.values[:-1]
        columns["module_time_ns"][:] = state.module_time_ns
        module_bits = np.where(self._stale_modules(time_ns), np.uint8(Status.STALE), np.uint8(0))
        module_bits |= self._watch.module_status
        np.bitwise_or(state.status[:-1], module_bits[self._sensor_module], out=columns["status"])
        columns["patch_state"][:] = self.patch_state
        columns["bus_state"][:] = self.bus_state
        columns["bus_counters"].reshape(len(structure.buses), -1)[:] = self.count_buses()
        columns["patch_counters"].reshape(structure.n_patches, -1)[:] = state.patch_counters
        self._writer.commit(state.newest_ns or time_ns)
        state.updated[:] = False
        state.touched[:] = False
        self._first_touch_ns = 0
        self._last_published_ns = time_ns

    def count_buses(self) -> npt.NDArray[np.int64]:
        """(n_buses, len(ALL_BUS_COUNTERS)) int64."""
        own = [(c.frames, c.lost, c.error_frames, c.refused, c.sent, c.send_failures) for c in self.bus_counters]
        return np.concatenate([np.array(own, np.int64), self._decoder.state.bus_counters], axis=1)

    def _apply(self, batch: FrameBatch, updates: Updates) -> None:
        self._decoder.apply(batch, updates)
        self._watch.look(self._decoder.state, updates)

    def _welcome_patches(self, updates: Updates) -> None:
        """Expect all modules of a patch that begins to send: its first cycle is not over after its first module."""
        patch_sends = np.zeros(len(self._patch_heard_ns), bool)
        patch_sends[self._module_patch[updates.module]] = True
        time_ns = now_ns()
        begins = patch_sends & (time_ns - self._patch_heard_ns > self._silence_ns)
        if begins.any():
            self._module_heard_ns[begins[self._module_patch]] = time_ns
        self._patch_heard_ns[patch_sends] = time_ns

    def _has_repeats(self, updates: Updates) -> bool:
        updated = self._decoder.state.updated
        return bool(updated[updates.module].any() or np.bincount(updates.module).max() > 1)

    def _first_repeat(self, updates: Updates) -> int:
        """How many updates can be shown before one would overwrite another that was not published yet."""
        n = len(updates)
        backwards = np.arange(n - 1, -1, -1)
        self._first_at[updates.module[::-1]] = backwards  # of several for a module, the first one stays
        repeats = self._first_at[updates.module] != backwards[::-1]
        repeats |= self._decoder.state.updated[updates.module]
        return int(np.argmax(repeats)) if repeats.any() else n

    def _is_complete(self) -> bool:
        state = self._decoder.state
        if not state.updated.any():
            return False
        living = now_ns() - self._module_heard_ns < self._silence_ns
        return bool((state.touched | ~living).all())

    def _stale_modules(self, time_ns: int) -> npt.NDArray[np.bool_]:
        """Modules that missed their patch's last update, or that have been silent for too long.

        By cycle, a module is behind if others of its patch were updated since the last publication and it was not,
        and stays so until its own next update. At a rate, publications fall anywhere in a burst, so only time tells.
        """
        state, module_patch = self._decoder.state, self._module_patch
        if self._by_cycle:
            patch_updated = np.zeros(len(state.patch_time_ns), bool)
            patch_updated[module_patch[state.updated]] = True
            self._behind |= patch_updated[module_patch]
            self._behind[state.updated] = False
        else:
            self._behind = state.patch_time_ns[module_patch] - state.module_time_ns > self._period_ns * 3 // 2
        silent = time_ns - state.module_time_ns > self._silence_ns
        stale: npt.NDArray[np.bool_] = (self._behind | silent) & (state.module_time_ns > 0)
        return stale
