"""How all drivers are doing, as a view tells it: a tree of buses and patches, and problems with the worst first."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.state import (
    DEAD,
    LIVE,
    PAUSED,
    SILENT,
    STARTING,
    WITHOUT_NEWS,
    bus_reason_name,
    bus_state_name,
    patch_ages_ns,
    patch_state_name,
    rate_now_hz,
)
from skinware.status import BusState, PatchState, Status, load_report
from skinware.structure import Structure
from skinware.views.following import Followed

ERROR, WARNING, NOTE = "error", "warning", "note"
_SEVERITIES = (ERROR, WARNING, NOTE)
_LIVES = {
    DEAD: (ERROR, "its process is gone; what is shown is its last frame"),
    SILENT: (ERROR, "its process publishes nothing"),
    PAUSED: (NOTE, "paused"),
    STARTING: (NOTE, "no frame yet"),
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


def state_of(driver: Followed) -> dict[str, Any]:
    live, frame, life = driver.live, driver.frame, driver.life
    told: dict[str, Any] = {
        "id": driver.number,
        "name": driver.name,
        "namespace": driver.namespace,
        "state": life,
        "rate_hz": _rounded(rate_now_hz(life, live.rate_hz)),
        "age_ms": None if frame is None else round(frame.age_ns / 1e6, 3),
        "sensors": driver.structure.n_sensors,
        "fresh": int(np.count_nonzero(driver.status == 0)),
        "lost": 0,
        "load": None,
        "buses": [],
        "patches": [],
    }
    if frame is None or frame.structure is not live.reader.structure:  # it is just changing
        return told
    was = "was " if life in WITHOUT_NEWS else ""
    buses: list[dict[str, Any]] = []
    for bus, counters in enumerate(live.reader.bus_counters(frame)):
        own = {
            "name": frame.structure.buses[bus],
            "state": was + bus_state_name(int(frame.bus_state[bus])),
            "reason": bus_reason_name(int(frame.bus_reason[bus])),
            "load": load_report(int(frame.bus_load[bus]))["load"],
        }
        buses.append(own | {"lost": counters.get("lost", 0), "counters": _nonzero(counters)})
    loads = [bus["load"] for bus in buses if bus["load"] is not None]
    told |= {"lost": sum(bus["lost"] for bus in buses), "load": max(loads, default=None)}
    return told | {"buses": buses, "patches": _patches(driver)}


def problems_of(driver: Followed, state: dict[str, Any]) -> list[dict[str, Any]]:
    """What is wrong with a driver, each with how bad it is: ``error``, ``warning`` or ``note``, and where.

    Args:
        driver: it.
        state: what ``state_of`` said.
    """
    found: list[dict[str, Any]] = []

    def add(severity: str, text: str, **where: str) -> None:
        found.append({"severity": severity, "driver": driver.number, **where, "text": text})

    if driver.life != LIVE:
        add(*_LIVES.get(driver.life, (NOTE, driver.life)))
    if driver.life not in WITHOUT_NEWS:
        for bus in state["buses"]:
            if bus["state"] != bus_state_name(BusState.LIVE):
                add(ERROR, _because(f"{bus['name']} is {bus['state']}", bus["reason"]), bus=bus["name"])
            elif bus["reason"]:
                add(WARNING, _because(bus["name"], bus["reason"]), bus=bus["name"])
        for patch in state["patches"]:
            if patch["state"] != patch_state_name(PatchState.LIVE):
                age = "" if patch["age_ms"] is None else f", its newest data is {patch['age_ms'] / 1e3:.1f} s old"
                add(WARNING, f"{patch['name']} is {patch['state']}{age}", bus=patch["bus"], patch=patch["name"])
    for bit, (severity, text) in _STATUSES.items():
        sensors = np.flatnonzero(driver.status & np.uint8(bit))
        if len(sensors) and driver.frame is not None:
            where = _patch_of(driver.structure, sensors)
            add(severity, f"{len(sensors)} of {driver.structure.n_sensors} sensors {text}", **where)
    if state["lost"]:
        add(NOTE, f"{state['lost']} frames lost on its buses since it started")
    return found


def problem_of_all(text: str) -> dict[str, Any]:
    return {"severity": ERROR, "driver": None, "text": text}


def worst_first(problems: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Errors, then warnings, then notes; otherwise in their order."""
    return sorted(problems, key=lambda problem: _SEVERITIES.index(problem["severity"]))


def _patches(driver: Followed) -> list[dict[str, Any]]:
    frame = driver.frame
    assert frame is not None  # noqa: S101 - state_of() has seen one
    structure = frame.structure
    sensors = np.bincount(structure.sensor_patch, minlength=structure.n_patches).tolist()
    fresh = np.bincount(structure.sensor_patch[driver.status == 0], minlength=structure.n_patches).tolist()
    ages_ns, rates_hz = patch_ages_ns(frame), driver.live.patch_rates_hz
    counters = driver.live.reader.patch_counters(frame)
    was = "was " if driver.life in WITHOUT_NEWS else ""
    return [
        {
            "name": name,
            "bus": structure.buses[int(structure.patch_bus[patch])],
            "state": was + patch_state_name(int(frame.patch_state[patch])),
            "age_ms": None if ages_ns[patch] is None else round((ages_ns[patch] or 0) / 1e6, 3),
            "sensors": sensors[patch],
            "fresh": fresh[patch],
            "rate_hz": _rounded(rate_now_hz(driver.life, rates_hz[patch])),
            "counters": _nonzero(counters[patch]),
        }
        for patch, name in enumerate(structure.patch_names)
    ]


def _patch_of(structure: Structure, sensors: npt.NDArray[np.intp]) -> dict[str, str]:
    """Bus and patch that sensors have in common; empty if they are of several."""
    patch, *others = np.unique(structure.sensor_patch[sensors]).tolist()
    if others:
        return {}
    return {"bus": structure.buses[int(structure.patch_bus[patch])], "patch": structure.patch_names[patch]}


def _because(what: str, reason: str | None) -> str:
    return what if reason is None else f"{what}: {reason.replace('_', ' ')}"


def _nonzero(counters: dict[str, int]) -> dict[str, int]:
    return {name: count for name, count in counters.items() if count}


def _rounded(rate_hz: float | None) -> float | None:
    return None if rate_hz is None else round(rate_hz, 2)
