"""Write for the page how all drivers are doing: a tree of buses and patches, and problems with the worst first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.realtime import now_ns
from skinware.state import DEAD, LIVE, PAUSED, SILENT, STARTING, WITHOUT_NEWS, DriverReport, badness
from skinware.status import Status, Why
from skinware.structure import Structure
from skinware.text import SETTLING, age_text, count_text, plural, words
from skinware.views.following import ShownDriver
from skinware.views.quantities import Newest

ERROR, WARNING, NOTE = "error", "warning", "note"
_SEVERITIES = (ERROR, WARNING, NOTE)
_LIVES = {
    DEAD: (ERROR, "its process is gone; the last snapshot is shown"),
    SILENT: (ERROR, "its process publishes nothing"),
    PAUSED: (NOTE, "paused"),
    STARTING: (NOTE, "no snapshot yet"),
}
_STATUSES = {
    Status.NEVER_SEEN: (WARNING, "never seen"),
    Status.NO_ACK: (WARNING, "do not answer their board"),
    Status.UNHEALTHY: (WARNING, "unhealthy"),
    Status.SUSPECT: (NOTE, "suspect"),
    Status.OUT_OF_RANGE: (NOTE, "out of range"),
    Status.NOT_CONNECTED: (NOTE, "not connected"),
    Status.MASKED: (NOTE, "switched off"),
}
_COVERED = (
    "below their baselines, which were measured under a touch or a cover: free the skin there, and they are right a"
    " second later; until then, touches there seem weaker"
)
_REASONS = {
    Why.COVERED: (NOTE, _COVERED),
    Why.DOUBTED: (WARNING, "fall and return where nothing touches: their polarity may be wrong"),
    Why.SATURATED: (NOTE, "at the end of their range: they may bear more"),
    Why.NO_RESOLUTION: (WARNING, "too coarse to show how strong a touch is"),
}
"""Reasons of a calmed driver that are problems; touched taxels are none."""


def state_of(driver: ShownDriver, report: DriverReport) -> dict[str, Any]:
    loads = [bus.load for bus in report.buses if bus.load is not None]
    return {
        "id": driver.number,
        "name": driver.name,
        "namespace": driver.origin.title,
        "state": report.life,
        "shown": report.state,
        "bad": badness(report.state),
        "rate_hz": _rounded(report.rate_hz),
        "age_ms": _rounded(report.age_ns, 1e6, 3),
        "sensors": driver.structure.n_sensors,
        "fresh": report.fresh,
        "dropped": report.counters.get("dropped", 0),
        "load": max(loads, default=None),
        "buses": [
            {
                "name": bus.name,
                "state": (state := report.state_of(bus)),
                "bad": badness(state),
                "reason": bus.reason,
                "load": bus.load,
            }
            for bus in report.buses
        ],
        "patches": [
            {
                "name": patch.name,
                "bus": report.buses[patch.bus].name,
                "state": (state := report.state_of(patch)),
                "bad": badness(state),
                "age_ms": _rounded(patch.age_ns, 1e6, 3),
                "sensors": patch.sensors,
                "fresh": patch.fresh,
                "rate_hz": _rounded(patch.rate_hz),
            }
            for patch in report.patches
        ],
    }


def problems_of(driver: ShownDriver, report: DriverReport) -> list[dict[str, Any]]:
    """Return the problems of a driver, each with its severity (``error``, ``warning`` or ``note``) and its place.

    A driver without news has this one problem. ``since_ns`` is when the problem was first seen, CLOCK_MONOTONIC.
    """
    found: list[dict[str, Any]] = []
    before, driver.since_ns = driver.since_ns, {}

    def add(kind: str, severity: str, text: str, **where: str) -> None:
        known = driver.number, severity, kind, *where.values()
        driver.since_ns[known] = before.get(known) or now_ns()
        since = {"since_ns": str(driver.since_ns[known])}
        found.append({"severity": severity, "driver": driver.number, **where, "text": text, **since})

    if report.life != LIVE:
        add(report.life, *_LIVES.get(report.life, (NOTE, report.life)))
    if report.life in WITHOUT_NEWS:
        return found
    for bus in report.buses:
        reason = f": {words(bus.reason)}" if bus.reason else ""
        if bus.state != LIVE:
            add(bus.state, ERROR, f"{bus.name} is {bus.state}{reason}", bus=bus.name)
        elif reason:
            add(reason, WARNING, f"{bus.name}{reason}", bus=bus.name)
    for patch in report.patches:
        if patch.state != LIVE:
            age = "" if patch.age_ns is None else f", its newest data is {age_text(patch.age_ns)} old"
            on = report.buses[patch.bus].name
            add(patch.state, WARNING, f"{patch.name} is {patch.state}{age}", bus=on, patch=patch.name)
    if driver.newest is not None:
        for sensors, severity, text in _marked(driver.newest):
            if not len(sensors):
                continue
            shares = f"{count_text(len(sensors))} of {plural(driver.structure.n_sensors, 'sensor')}"
            add(text, severity, f"{shares} {text}", **_common_patch(driver.structure, sensors))
        waiting = driver.newest.settling
        if waiting.any():
            add(SETTLING, NOTE, f"{SETTLING}, {count_text(int(np.count_nonzero(waiting)))} left")
    dropped = report.counters.get("dropped", 0)
    if dropped:
        add("dropped", NOTE, f"{plural(dropped, 'frame')} dropped on its buses since it started")
    return found


def _marked(newest: Newest) -> Iterator[tuple[npt.NDArray[np.intp], str, str]]:
    """Yield the (k,) sensors of each problem that sensors have, its severity, and what they are or do."""
    for bit, (severity, text) in {} if newest.is_good else _STATUSES.items():
        marked = (newest.status & np.uint8(bit)) != 0
        yield np.flatnonzero(marked & ~newest.settling if bit == Status.NEVER_SEEN else marked), severity, text
    whys = newest.why
    for why, (severity, text) in _REASONS.items():
        yield np.flatnonzero(whys == np.uint8(why)), severity, text


def problem_of_all(text: str) -> dict[str, Any]:
    return {"severity": ERROR, "driver": None, "text": text}


def worst_first(problems: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(problems, key=lambda problem: _SEVERITIES.index(problem["severity"]))


def _common_patch(structure: Structure, sensors: npt.NDArray[np.intp]) -> dict[str, str]:
    """Return bus and patch that all these sensors have; empty if they are of several patches."""
    patch, *others = np.unique(structure.sensor_patch[sensors]).tolist()
    if others:
        return {}
    return {"bus": structure.buses[int(structure.patch_bus[patch])], "patch": structure.patch_names[patch]}


def _rounded(value: float | None, unit: float = 1.0, digits: int = 2) -> float | None:
    return None if value is None else round(value / unit, digits)
