"""What a running driver tells people and programs about its buses and patches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from skinware.driver_service import DriverWriter
from skinware.memory.statistics import Histogram
from skinware.realtime import now_ns
from skinware.samples import sample_report
from skinware.status import DataPath, PatchState, load_report
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.generation import Generation
from skinware_drivers.running.news import MachineLimits
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS, ALL_PATCH_COUNTERS


def figures(
    lines: Sequence[BusLine],
    machine: MachineLimits,
    writer: DriverWriter | None,
    generation: Generation | None,
) -> dict[str, Any]:
    """State and counters of every bus and patch; only the buses' states as long as nothing is published."""
    if writer is None or generation is None:
        return {"sequence": 0, "buses": [_bus(line) for line in lines], "machine": _machine(machine)}
    publisher, state, time_ns = generation.publisher, generation.decoder.state, now_ns()
    structure = generation.tables.structure
    buses = []
    for line, row in zip(lines, publisher.count_buses().tolist(), strict=True):
        counters = dict(zip(ALL_BUS_COUNTERS, row, strict=True))
        path = DataPath(int(publisher.buses.data_path[line.ordinal])).name.lower()
        buses.append({**_bus(line), "data_path": path, **counters})
    patches = []
    for patch in range(structure.n_patches):
        last_ns = int(state.patch_time_ns[patch])
        counters = dict(zip(ALL_PATCH_COUNTERS, state.patch_counters[patch].tolist(), strict=True))
        patches.append(
            {
                "name": generation.name_of(patch),
                "bus": lines[int(structure.patch_bus[patch])].name,
                "state": PatchState(int(publisher.patches.state[patch])).name.lower(),
                "age_ms": round((time_ns - last_ns) / 1e6, 3) if last_ns else None,
                "interval": _bounds(publisher.timing.intervals[patch].tolist()),
                "age": _bounds(publisher.timing.ages[patch].tolist()),
                **counters,
            }
        )
    latency_ms = int(publisher.latency_ns[0]) / 1e6
    figures = {"sequence": writer.sequence, "latency_ms": latency_ms, "buses": buses, "patches": patches}
    return {**figures, "machine": _machine(machine)}


def _machine(machine: MachineLimits) -> dict[str, int]:
    return {"softnet_dropped": machine.softnet_dropped}


def _bus(line: BusLine) -> dict[str, Any]:
    state_age_s = round((now_ns() - line.since_ns) / 1e9, 3)
    reason = line.reason.name.lower() if line.reason else None
    state = {"name": line.name, "state": line.state.name.lower(), "reason": reason, "state_age_s": state_age_s}
    samples = sample_report(line.bus.samples.rows)
    return {**state, **load_report(line.limits.permille), "samples": samples}


def _bounds(counts: list[int]) -> dict[str, int | None]:
    histogram = Histogram(counts)
    return {"p50_ns": histogram.quantile_ns(0.5), "p99_ns": histogram.quantile_ns(0.99)}
