"""Judge services, drivers, buses and patches from what their readers see.

This is the one model of a driver that commands, the terminal, the page and ROS 2 show.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from skinware.realtime import NS_PER_S, now_ns
from skinware.status import (
    LOAD_FILTERED,
    LOAD_UNKNOWN,
    BusReason,
    BusState,
    PatchState,
    Status,
    Why,
    are_young,
    is_fresh,
)
from skinware.text import NOT_FRESH, state_shown

if TYPE_CHECKING:
    import numpy.typing as npt

    from skinware.driver_service import DriverReader
    from skinware.driver_snapshot import DriverSnapshot
    from skinware.memory.ring import Sample
    from skinware.service import ServiceReader

LIVE, SILENT, PAUSED, STARTING, DEAD = "live", "silent", "paused", "starting", "dead"
WITHOUT_NEWS = (SILENT, PAUSED, DEAD)
"""States of a driver in which nothing in its newest snapshot is fresh."""
GOOD, ODD, OLD, GONE = range(4)
"""How bad a state is; the worst are shown first."""
_BAD = {LIVE: GOOD, "stale": OLD, SILENT: OLD, NOT_FRESH: OLD, "gone": GONE, "down": GONE, DEAD: GONE}

_LEAST_SILENCE_NS = NS_PER_S
_SILENT_PERIODS = 5


@dataclass(frozen=True)
class BusReport:
    """One bus of a driver.

    Attributes:
        state: name of a :class:`skinware.status.BusState`.
        reason: name of a :class:`skinware.status.BusReason`; None without one.
        load: part of the time that the bus is in use, 0 to 1; None where it is not known.
        counters: all counters of the driver for this bus, by name.
    """

    name: str
    state: str
    reason: str | None
    load: float | None
    counters: dict[str, int]


@dataclass(frozen=True)
class PatchReport:
    """One patch of a driver.

    Attributes:
        bus: index of its bus.
        state: name of a :class:`skinware.status.PatchState`.
        sensors, fresh, untouched: number of all its sensors, of the fresh ones, and of those that were only 0 so far.
        settling: number of those of a calmed driver that wait for their baselines.
        age_ns: age of its newest data; None if it never sent any.
        rate_hz: updates per second of its modules; None where that is not known.
        counters: all counters of the driver for this patch, by name.
    """

    name: str
    bus: int
    state: str
    sensors: int
    fresh: int
    untouched: int
    settling: int
    age_ns: int | None
    rate_hz: float | None
    counters: dict[str, int]


@dataclass(frozen=True)
class DriverReport:
    """One driver with its buses and patches.

    Attributes:
        life: what it is doing, see :func:`life_of`.
        rate_hz: snapshots per second now; None where that is not known yet.
        age_ns: age of its newest data; None before the first snapshot.
        statuses: number of sensors by status, ``fresh`` and ``stale`` first; one sensor can have several. ``untouched``
            counts those of modules that sent only 0 so far; they are fresh all the same. ``settling`` counts those of a
            calmed driver that wait for their baselines; they are not among ``never_seen``.
        buses, patches: in the order of the structure; empty before the first snapshot and while the structure changes.
    """

    name: str
    life: str
    rate_hz: float | None
    age_ns: int | None
    sensors: int
    statuses: dict[str, int]
    buses: tuple[BusReport, ...] = ()
    patches: tuple[PatchReport, ...] = ()

    @property
    def fresh(self) -> int:
        return self.statuses.get("fresh", 0)

    @property
    def counters(self) -> dict[str, int]:
        """Sums of the counters of all buses and patches, by name."""
        sums: dict[str, int] = {}
        for counters in [bus.counters for bus in self.buses] + [patch.counters for patch in self.patches]:
            for name, count in counters.items():
                sums[name] = sums.get(name, 0) + count
        return sums

    @property
    def state(self) -> str:
        """Its state for people: nothing without a fresh sensor is called live."""
        if self.age_ns is None:
            return self.life
        return state_shown(self.life, self.fresh, self.sensors, self.statuses.get("settling", 0))

    def state_of(self, part: BusReport | PatchReport) -> str:
        """Return the state of a bus or patch for people; ``was live`` where it is only the last one that is known."""
        state = self.last(part.state)
        return state if isinstance(part, BusReport) else state_shown(state, part.fresh, part.sensors, part.settling)

    @property
    def worst(self) -> int:
        """How bad the worst state of the driver, its buses and its patches is."""
        return max(map(badness, [self.state, *map(self.state_of, self.buses), *map(self.state_of, self.patches)]))

    @property
    def patch_states(self) -> dict[str, int]:
        """Number of patches by state, as :meth:`last` names it."""
        states = sorted(self.last(patch.state) for patch in self.patches)
        return {state: states.count(state) for state in dict.fromkeys(states)}

    def last(self, state: str) -> str:
        """Return the state of a bus or patch; ``was live`` where it is only the last one that is known."""
        return f"was {state}" if self.life in WITHOUT_NEWS else state


def report_of(
    reader: DriverReader,
    frame: DriverSnapshot | None,
    measured_hz: float | None = None,
    patch_rates_hz: Sequence[float | None] = (),
    *,
    life: str | None = None,
    status: npt.NDArray[np.uint8] | None = None,
) -> DriverReport:
    """Return the report of a driver.

    Args:
        patch_rates_hz: updates per second of each patch as measured; ignored unless there is one for each patch.
        life: what it is doing; default: what :func:`life_of` returns.
        status: (n_sensors,) uint8, status of its sensors now; default: what :func:`status_now` returns.
    """
    life = life_of(reader, frame) if life is None else life
    rate_hz = rate_now_hz(life, measured_hz)
    if frame is None:
        return DriverReport(reader.name, life, rate_hz, None, reader.structure.n_sensors, {})
    status = status_now(life, frame) if status is None else status
    structure, is_untouched, is_settling = frame.structure, untouched(frame), settling(frame)
    statuses = count_statuses(status) | {"untouched": int(np.count_nonzero(is_untouched))}
    statuses["settling"] = int(np.count_nonzero(is_settling))
    statuses["never_seen"] -= statuses["settling"]
    report = DriverReport(reader.name, life, rate_hz, frame.age_ns, structure.n_sensors, statuses)
    if structure is not reader.structure and structure != reader.structure:
        return report
    columns = (frame.bus_state.tolist(), frame.bus_reason.tolist(), frame.bus_load.tolist(), reader.bus_counters(frame))
    buses = tuple(
        BusReport(
            name,
            state_name(BusState, state),
            state_name(BusReason, reason) if reason else None,
            None if load in (LOAD_UNKNOWN, LOAD_FILTERED) else load / 1000,
            counters,
        )
        for name, state, reason, load, counters in zip(structure.buses, *columns, strict=True)
    )
    none = [0] * structure.n_patches
    fresh, dark, waiting = (
        np.bincount(structure.sensor_patch[chosen], minlength=structure.n_patches).tolist() if chosen.any() else none
        for chosen in (status == 0, is_untouched, is_settling)
    )
    rates = patch_rates_hz if len(patch_rates_hz) == structure.n_patches else [None] * structure.n_patches
    ages_ns, patch_buses, states = patch_ages_ns(frame), structure.patch_bus.tolist(), frame.patch_state.tolist()
    patches = tuple(
        PatchReport(
            name=structure.patch_names[patch],
            bus=patch_buses[patch],
            state=state_name(PatchState, states[patch]),
            sensors=len(structure.patch_index(patch)),
            fresh=fresh[patch],
            untouched=dark[patch],
            settling=waiting[patch],
            age_ns=ages_ns[patch],
            rate_hz=None if rates[patch] is None else rate_now_hz(life, rates[patch]),
            counters=counters,
        )
        for patch, counters in enumerate(reader.patch_counters(frame))
    )
    return replace(report, buses=buses, patches=patches)


def life_of(service: ServiceReader[Any], newest: Sample | None) -> str:
    """Return what a service is doing.

    Returns:
        ``live``; ``silent``: its process runs but has published nothing for a second and for five of its periods (it
        hangs or was stopped); ``paused``: it announced that; ``starting``: it has published nothing so far; ``dead``:
        its process is gone.
    """
    if not service.alive:
        return DEAD
    if service.paused:
        return PAUSED
    if newest is None:
        return STARTING
    rate_hz = service.rate_hz()
    periods_ns = round(_SILENT_PERIODS * NS_PER_S / rate_hz) if rate_hz else 0
    return SILENT if now_ns() - newest.published_ns > max(_LEAST_SILENCE_NS, periods_ns) else LIVE


def rate_now_hz(life: str, measured_hz: float | None) -> float | None:
    """Return the rate at which samples arrive now: 0 from a service that is not live, whatever was measured before."""
    return measured_hz if life == LIVE else 0.0


def status_now(life: str, frame: DriverSnapshot, at_ns: int | None = None) -> npt.NDArray[np.uint8]:
    """Return (n_sensors,) uint8, the status of a snapshot's sensors now, or at a time: values too old are stale."""
    status, stale = frame.status, np.uint8(Status.STALE)
    if life in WITHOUT_NEWS:
        return status | stale
    at_ns = now_ns() if at_ns is None else at_ns
    if not frame.stale and are_young(frame.group_time_ns, at_ns):
        return status
    fresh = is_fresh(
        status,
        frame.sensor_time_ns,
        at_ns=at_ns,
        max_age_ns=frame.structure.age_limits_ns(frame.period_ns),
        alive=not frame.stale,
    )
    return np.where(fresh | (status != 0), status, stale)


def untouched(frame: DriverSnapshot) -> npt.NDArray[np.bool_]:
    """Return (n_sensors,) bool: sensors of modules that sent only 0 so far; they are fresh all the same."""
    return frame.module_untouched[frame.structure.sensor_module]


def count_reasons(why: npt.NDArray[np.uint8]) -> dict[str, int]:
    """Return how many sensors there are for each reason, by its name in lower case; without reasons of none."""
    counts = np.bincount(why, minlength=len(Why)).tolist()
    return {reason.name.lower(): counts[reason] for reason in Why if counts[reason]}


def settling(frame: DriverSnapshot) -> npt.NDArray[np.bool_]:
    """Return (n_sensors,) bool: sensors of a calmed driver that were seen, and wait for their baselines."""
    without: npt.NDArray[np.bool_] = (frame.why == np.uint8(Why.RELEARNING)) & (
        (frame.status & np.uint8(Status.NEVER_SEEN)) != 0
    )
    return without & (frame.sensor_time_ns > 0) if without.any() else without


def badness(state: str) -> int:
    """Return how bad the state of a driver, bus or patch is, from ``GOOD`` to ``GONE``."""
    return OLD if state.startswith("was ") else _BAD.get(state, ODD)


def count_statuses(status: npt.NDArray[np.uint8]) -> dict[str, int]:
    """Return how many sensors are fresh, and how many have each other status (``stale``, ``never_seen`` ...)."""
    counts = {"fresh": int(np.count_nonzero(status == 0))}
    for bit in (Status.STALE, *(bit for bit in Status if bit != Status.STALE)):
        counts[str(bit.name).lower()] = int(np.count_nonzero(status & np.uint8(bit)))
    return counts


def patch_ages_ns(frame: DriverSnapshot) -> list[int | None]:
    """Return the age of the newest data of each patch; None for one that never sent any."""
    newest_ns = np.zeros(frame.structure.n_patches, np.int64)
    np.maximum.at(newest_ns, frame.structure.group_patch, frame.group_time_ns)
    time_ns = now_ns()
    return [time_ns - newest if newest else None for newest in newest_ns.tolist()]


@lru_cache
def state_name(states: type[enum.IntEnum], number: int) -> str:
    """Return the name of a state of a patch or bus, or of a reason; an unknown number stays a number."""
    try:
        return states(number).name.lower()
    except ValueError:
        return str(number)
