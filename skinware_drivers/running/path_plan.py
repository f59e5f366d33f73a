"""What C publishes from: a publisher's arrays in the plan of a data path, and the arrays that both sides change."""

from __future__ import annotations

import numpy as np

from skinware.samples import Unused
from skinware.status import PatchState, Status
from skinware_drivers.counters import OWN_BUS_COUNTERS
from skinware_drivers.native import structs
from skinware_drivers.polling import Watch
from skinware_drivers.running.publisher import Publisher

SKIPPED = OWN_BUS_COUNTERS.index("updates_skipped")


class SharedArrays:
    """Arrays through which Python and C tell each other what changes between two calls.

    Attributes:
        module_status, module_untouched: (n_modules,) uint8, what the watch holds against modules.
        skipped, skipped_before: (n_buses,) int64, updates that were skipped in this call, and before it.
        interrupted: (n_buses,) bool, buses that have lost frames since the last batch.
        sample_next_ns: (n_buses, reasons) int64, when the next sample of an unused frame is wanted.
    """

    def __init__(self, watch: Watch, n_buses: int) -> None:
        self.module_status = watch.module_status.copy()  # a watch may replace its own
        self.module_untouched = watch.module_untouched.copy()
        self.skipped, self.skipped_before = np.zeros((2, n_buses), np.int64)
        self.interrupted = np.zeros(n_buses, bool)
        self.sample_next_ns = np.zeros((n_buses, len(Unused) + 1), np.int64)


def compile_publisher(publisher: Publisher, plan: structs.Plan, arrays: structs.Arrays) -> SharedArrays:
    """Fill in what a plan says of publishing."""
    pauses, patches, buses, pace = publisher.pauses, publisher.patches, publisher.buses, publisher.pace
    exchange = SharedArrays(publisher.watch, len(buses.counters))
    plan.period_ns, plan.silence_ns, plan.patience_ns = pace.period_ns, pace.silence_ns, pace.patience_ns
    plan.pause_ns, plan.idle_ns = pace.pause_ns, pace.idle_ns
    plan.by_cycle, plan.most_at_once = publisher.by_cycle, publisher.writer.slots
    plan.stale = int(Status.STALE)
    plan.state_live, plan.state_stale = int(PatchState.LIVE), int(PatchState.STALE)
    plan.burst_pause_ns = arrays.at(pauses.pause_ns)
    plan.standing_out_ns, plan.gap_ns = arrays.at(pauses.standing_out_ns), arrays.at(pauses.gap_ns)
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
    plan.skipped_column = SKIPPED
    for name in ("lost", "frames", "errors", "refused"):
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
