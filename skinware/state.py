"""How a service and a skin are doing, from what its reader sees: the judgements that several commands share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusReason, BusState, PatchState, Status, is_fresh

if TYPE_CHECKING:
    import numpy.typing as npt

    from skinware.driver_service import DriverReader
    from skinware.driver_snapshot import DriverSnapshot
    from skinware.memory.ring import Sample
    from skinware.service import ServiceReader

LIVE, SILENT, PAUSED, STARTING, DEAD = "live", "silent", "paused", "starting", "dead"
WITHOUT_NEWS = (SILENT, PAUSED, DEAD)
"""Lives in which the newest frame is the last word for now: nothing in it is fresh."""

_LEAST_SILENCE_NS = NS_PER_S
_SILENT_PERIODS = 5
_PATCH_STATES = {int(state): state.name.lower() for state in PatchState}
_BUS_STATES = {int(state): state.name.lower() for state in BusState}
_BUS_REASONS = {int(reason): reason.name.lower() for reason in BusReason}


def life_of(service: ServiceReader[Any], newest: Sample | None) -> str:
    """What a service is doing.

    Args:
        service: its reader.
        newest: its newest frame.

    Returns:
        ``live``; ``silent``: its process is there but has published nothing for a second and five of its periods (hung
        or stopped); ``paused``: it said so; ``starting``: it has published nothing so far; ``dead``: its process is
        gone.
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
    """The rate at which frames come now: none come from who is not live, whatever was measured before."""
    return measured_hz if life == LIVE else 0.0


@dataclass(frozen=True)
class SkinHealth:
    """One driver in a few figures.

    Attributes:
        name: the driver.
        life: see :func:`life_of`.
        rate_hz: frames per second now; None where not known yet.
        age_ns: how old its newest data is; None before the first frame.
        sensors: how many it has.
        statuses: sensors by status, ``fresh`` and ``stale`` first; one sensor can have several. ``untouched``: those of
            modules that have sent nothing but 0 so far, which are fresh all the same.
        patches: patches by state (``was live``: by their last state, where nothing newer comes).
        counters: sums over all buses and patches of the counters that the driver publishes, by name.
    """

    name: str
    life: str
    rate_hz: float | None
    age_ns: int | None
    sensors: int
    statuses: dict[str, int]
    patches: dict[str, int]
    counters: dict[str, int]


def health_of(reader: DriverReader, frame: DriverSnapshot | None, measured_hz: float | None) -> SkinHealth:
    """Sum up a driver.

    Args:
        reader: its reader.
        frame: its newest frame.
        measured_hz: its rate as measured.
    """
    life = life_of(reader, frame)
    rate_hz = rate_now_hz(life, measured_hz)
    if frame is None:
        return SkinHealth(reader.name, life, rate_hz, None, reader.structure.n_sensors, {}, {}, {})
    was = "was " if life in WITHOUT_NEWS else ""
    states = [was + patch_state_name(state) for state in frame.patch_state.tolist()]
    counters: dict[str, int] = {}
    for row in (*reader.bus_counters(frame), *reader.patch_counters(frame)):
        for name, count in row.items():
            counters[name] = counters.get(name, 0) + count
    return SkinHealth(
        reader.name,
        life,
        rate_hz,
        frame.age_ns,
        frame.structure.n_sensors,
        count_statuses(status_now(life, frame)) | {"untouched": int(np.count_nonzero(untouched(frame)))},
        {state: states.count(state) for state in dict.fromkeys(sorted(states))},
        counters,
    )


def status_now(life: str, frame: DriverSnapshot) -> npt.NDArray[np.uint8]:
    """(n_sensors,) uint8: the status of a frame's sensors now: what has become too old since, is stale."""
    status, stale = frame.status, np.uint8(Status.STALE)
    if life in WITHOUT_NEWS:
        return status | stale
    fresh = is_fresh(
        status,
        frame.sensor_time_ns,
        at_ns=now_ns(),
        max_age_ns=frame.structure.age_limits_ns(frame.period_ns),
        alive=not frame.stale,
    )
    return np.where(fresh | (status != 0), status, stale)


def untouched(frame: DriverSnapshot) -> npt.NDArray[np.bool_]:
    """(n_sensors,) bool: sensors of modules that have sent nothing but 0 so far; they are fresh all the same."""
    return frame.module_untouched[frame.structure.sensor_module]


def count_statuses(status: npt.NDArray[np.uint8]) -> dict[str, int]:
    """How many sensors are fresh, and how many have each of the other statuses (``stale``, ``never_seen`` ...)."""
    counts = {"fresh": int(np.count_nonzero(status == 0))}
    for bit in (Status.STALE, *(bit for bit in Status if bit != Status.STALE)):
        counts[str(bit.name).lower()] = int(np.count_nonzero(status & np.uint8(bit)))
    return counts


def patch_ages_ns(frame: DriverSnapshot) -> list[int | None]:
    """How old the newest data of every patch is; None for one that was never heard."""
    newest_ns = np.zeros(frame.structure.n_patches, np.int64)
    np.maximum.at(newest_ns, frame.structure.group_patch, frame.group_time_ns)
    time_ns = now_ns()
    return [time_ns - newest if newest else None for newest in newest_ns.tolist()]


def patch_state_name(state: int) -> str:
    """Name of a :class:`PatchState`; a number that this version does not know stays a number."""
    return _PATCH_STATES.get(state, str(state))


def bus_state_name(state: int) -> str:
    """Name of a :class:`BusState`; a number that this version does not know stays a number."""
    return _BUS_STATES.get(state, str(state))


def bus_reason_name(reason: int) -> str | None:
    """Name of a :class:`BusReason`, None for ``NONE``; a number that this version does not know stays a number."""
    return _BUS_REASONS.get(reason, str(reason)) if reason else None
