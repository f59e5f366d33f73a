"""The data path in C for one generation: it decodes a batch and publishes snapshots that are due."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache

import numpy as np

import skinware.native
from skinware.errors import PlatformError
from skinware.realtime import now_ns
from skinware.status import PatchState, Status
from skinware_drivers import native
from skinware_drivers.bus import Filter, FrameBatch
from skinware_drivers.counters import OWN_BUS_COUNTERS
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch, compile_decoder
from skinware_drivers.running.path_hooks import PathHooks, SharedArrays
from skinware_drivers.running.publisher import Publisher

_real_now_ns = now_ns
_SKIPPED = OWN_BUS_COUNTERS.index("updates_skipped")


@cache
def _library() -> skinware.native.Library:
    library = native.library()
    quick, waiting = library.quick, library.waiting
    size = quick.skinware_path_size
    size.argtypes, size.restype = [ctypes.c_int64], ctypes.c_int64
    found = tuple(size(number) for number in range(len(structs.SIZES)))
    if found != structs.SIZES:
        raise PlatformError(f"the data path in C has structures of {found} bytes, not {structs.SIZES}")
    quick.skinware_path_new.restype = ctypes.c_void_p
    for call in (quick.skinware_path_deadline_ns, waiting.skinware_path_digest, waiting.skinware_flow_run):
        call.restype = ctypes.c_int64
    return library


class NativePath:
    """Decodes and publishes, on the arrays of a decoder and a publisher."""

    def __init__(self, decoder: Decoder, publisher: Publisher, batch: FrameBatch) -> None:
        self._decoder, self._publisher, self._batch = decoder, publisher, batch
        self._arrays = arrays = structs.Arrays()
        self._plan, self._words, self._rows = structs.Plan(), structs.Words(), compile_batch(batch, arrays)
        compile_decoder(decoder, self._plan, arrays)
        self._exchange = _compile_publisher(publisher, self._plan, arrays)
        self._hooks = PathHooks(decoder, publisher, batch, self._rows, self._words, self._exchange)
        self._plan.hooks = self._hooks.table()
        self._words.on_request = publisher.on_request
        self._words.last_published_ns = now_ns()
        library = _library()
        self._quick, self._waiting = library.quick, library.waiting
        made = self._quick.skinware_path_new(
            ctypes.byref(self._plan), ctypes.byref(self._rows), ctypes.byref(self._words)
        )
        if not made:
            raise MemoryError("no memory for the data path of a driver")
        self._path = path = ctypes.c_void_p(made)
        count = self._quick.skinware_path_count_strangers
        self.listeners, self.named = self._hooks.listeners, self._hooks.named
        self._hooks.count_strangers = lambda rows, n: count(path, ctypes.c_void_p(rows), ctypes.c_int64(n))

    def __del__(self) -> None:
        if hasattr(self, "_path"):
            self._quick.skinware_path_free(self._path)

    def announce_waits(self, expects_data: bool, awaited: Sequence[Filter]) -> None:
        """Set what coroutines wait for, before a call of C: frames that may be data, or awaited ones of no module."""
        self._words.expects_data = expects_data
        conditions = [structs.IdentifierCondition(mask, value) for value, mask in awaited]
        self._awaited = (structs.IdentifierCondition * len(conditions))(*conditions)
        self._plan.n_awaited, self._plan.awaited = len(conditions), ctypes.addressof(self._awaited)

    def empty(self) -> None:
        """Empty the batch, except for the frames that still wait for their partners, which come first."""
        self._batch.clear()
        self._batch.start = self._batch.headroom - self._words.carried

    def digest(self, interrupted: Sequence[int] = ()) -> None:
        """Decode the batch, and publish snapshots that are due; some buses have lost frames since the last batch."""
        self.interrupt(interrupted)
        self._rows.start, self._rows.stop = self._batch.start, self._batch.stop
        self._enter()
        result = self._waiting.skinware_path_digest(self._path)
        self._leave()
        if result < 0:
            raise MemoryError("no memory for the updates of a driver")

    def interrupt(self, buses: Sequence[int]) -> None:
        """Never join frames that wait for partners on these buses with later ones: frames were lost between them."""
        self._exchange.interrupted[list(buses)] = True

    def publish_if_due(self, read_ns: int) -> None:
        """Publish a snapshot if it is due; all frames that arrived until ``read_ns`` were taken."""
        self._words.read_ns = max(self._words.read_ns, read_ns)
        self._enter()
        self._waiting.skinware_path_publish_if_due(self._path)
        self._leave()

    def run(self, flow: structs.Flow) -> int:
        """Let frames flow until Python has something to do; return the reason, a number of ``flow.c``."""
        self._enter()
        result = int(self._waiting.skinware_flow_run(self._path, ctypes.byref(flow)))
        self._leave()
        return result

    @property
    def deadline_ns(self) -> int:
        """The latest time of the next call of ``publish_if_due``, CLOCK_MONOTONIC ns."""
        return int(self._quick.skinware_path_deadline_ns(self._path))

    def _enter(self) -> None:
        counts = self._publisher.count_buses()
        self._exchange.skipped_before[:] = counts[:, _SKIPPED]
        self._words.fixed_ns = 0 if now_ns is _real_now_ns else now_ns()
        self._words.wanted_ns = self._publisher.wanted_ns
        self._words.ring, self._words.sequence = self._publisher.writer.ring_address, self._publisher.writer.sequence
        self._hooks.take_from_watch()

    def _leave(self) -> None:
        self._batch.start, self._batch.stop = self._rows.start, self._rows.stop
        for bus in np.flatnonzero(self._exchange.skipped).tolist():
            self._publisher.buses.counters[bus].updates_skipped += int(self._exchange.skipped[bus])
        self._exchange.skipped[:] = 0
        if self._words.hastened:
            self._words.hastened = 0
            self._decoder.warn_of_haste()
        error, self._hooks.error = self._hooks.error, None
        if error is not None:
            raise error


def _compile_publisher(publisher: Publisher, plan: structs.Plan, arrays: structs.Arrays) -> SharedArrays:
    """Fill in the part of a plan that is about publishing; return the arrays that both sides change."""
    patches, buses, pace = publisher.patches, publisher.buses, publisher.pace
    exchange = SharedArrays(publisher.watch, len(buses.counters))
    plan.period_ns, plan.silence_ns, plan.patience_ns = pace.period_ns, pace.silence_ns, pace.patience_ns
    plan.pause_ns, plan.idle_ns = pace.pause_ns, pace.idle_ns
    plan.by_cycle, plan.most_at_once = publisher.by_cycle, publisher.writer.slots
    plan.stale = int(Status.STALE)
    plan.state_live, plan.state_stale = int(PatchState.LIVE), int(PatchState.STALE)
    plan.burst_pause_ns = arrays.at(patches.pause_ns)
    plan.standing_out_ns, plan.gap_ns = arrays.at(patches.standing_out_ns), arrays.at(patches.gap_ns)
    plan.is_prompt = arrays.at(publisher.state.is_prompt)
    plan.group_heard_ns, plan.age_limit_ns = arrays.at(patches.group_heard_ns), arrays.at(patches.age_limit_ns)
    plan.patch_heard_ns, plan.patch_state = arrays.at(patches.heard_ns), arrays.at(patches.state)
    plan.patch_lives_until_ns = arrays.at(patches.lives_until_ns)
    plan.module_status = arrays.at(exchange.module_status)
    plan.module_untouched = arrays.at(exchange.module_untouched)
    plan.bus_state, plan.bus_reason = arrays.at(buses.state), arrays.at(buses.reason)
    plan.bus_since_ns, plan.bus_load = arrays.at(buses.since_ns), arrays.at(buses.load)
    plan.bus_samples, plan.bus_samples_bytes = arrays.at(buses.samples), buses.samples.nbytes
    plan.latency_ns, plan.data_path = arrays.at(publisher.latency_ns), arrays.at(publisher.data_path)
    plan.bus_data_path = arrays.at(buses.data_path)
    counts = publisher.count_buses()
    plan.counts, plan.n_counts, plan.n_own_counts = arrays.at(counts), counts.shape[1], len(OWN_BUS_COUNTERS)
    plan.skipped_column = _SKIPPED
    for name in ("dropped", "frames", "errors", "refused"):
        setattr(plan, f"{name}_column", OWN_BUS_COUNTERS.index(name))
    plan.bytes_column = OWN_BUS_COUNTERS.index("bytes_in")
    plan.skipped, plan.skipped_before = arrays.at(exchange.skipped), arrays.at(exchange.skipped_before)
    plan.interrupted = arrays.at(exchange.interrupted)
    plan.sample_next_ns = arrays.at(exchange.sample_next_ns)
    timing = publisher.timing
    plan.timing, plan.timing_before_ns = arrays.at(timing.both), arrays.at(timing.before_ns)
    for name, offset in publisher.writer.column_offsets().items():
        setattr(plan.columns, name, offset)
    return exchange
