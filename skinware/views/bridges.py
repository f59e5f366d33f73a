"""Write the state of bridges as JSON and in words."""

from __future__ import annotations

from typing import Any

from skinware.bridge_state import BridgeState, ServiceState
from skinware.realtime import NS_PER_S, now_ns
from skinware.text import age_text_ms, count_text, plural, rate_text, table

_TITLES = ("service", "state", "mode", "rate", "age 50 %", "age 99 %", "not come")


def as_data(bridge: BridgeState) -> dict[str, Any]:
    clock = None
    if bridge.clock_offset_ns is not None and bridge.clock_error_ns is not None:
        clock = {
            "offset_ms": bridge.clock_offset_ns / 1e6,
            "error_ms": bridge.clock_error_ns / 1e6,
            "round_trip_ms": bridge.round_trip_ns / 1e6,
        }
    return {
        "connected": bridge.is_up,
        "since_s": round(max(0, now_ns() - bridge.since_ns) / NS_PER_S, 3),
        "clock": clock,
        "instance": bridge.instance or None,
        "host": bridge.host or None,
        "namesakes": bridge.namesakes,
        "switches": bridge.switches,
        "refused": bridge.refused,
        "last_refused": bridge.last_refused or None,
        "services": {name: _service_data(service) for name, service in bridge.services.items()},
    }


def summary(robot: str, state: dict[str, Any]) -> str:
    heard = "heard" if state["connected"] else "not heard"
    host = f" on {state['host']}" if state["host"] else ""
    line, clock = f"robot {robot}{host} {heard} for {age_text_ms(state['since_s'] * 1e3)}", state["clock"]
    if clock is None:
        return f"{line}, its clock is not known"
    error, round_trip = age_text_ms(clock["error_ms"]), age_text_ms(clock["round_trip_ms"])
    return f"{line}, its clock known to {error}, round trip {round_trip}"


def trouble(state: dict[str, Any]) -> list[str]:
    """Return lines about unreadable messages and about robots with one name, from the data of :func:`as_data`."""
    lines = []
    if state["refused"]:
        lines.append(f"{plural(state['refused'], 'message')} could not be read; the last: {state['last_refused']}")
    if state["namesakes"]:
        lines.append(
            f"{plural(state['namesakes'], 'other bridge')} of this name; bridge {state['instance'][:8]} is followed"
        )
    if state["switches"]:
        lines.append(f"another robot of this name took its place {plural(state['switches'], 'time')}")
    return lines


def as_lines(robot: str, state: dict[str, Any]) -> list[str]:
    rows = [
        (
            name,
            service["state"],
            service["mode"],
            rate_text(service["rate_hz"]),
            *(age_text_ms(service["age_ms"][share]) for share in ("p50", "p99")),
            count_text(service["gap"]),
        )
        for name, service in state["services"].items()
    ]
    return [summary(robot, state), *trouble(state), *(["", *table(_TITLES, rows, left=3)] if rows else [])]


def _service_data(service: ServiceState) -> dict[str, Any]:
    p50_ns, p99_ns = service.age_p50_ns, service.age_p99_ns
    return {
        "state": service.state,
        "mode": service.mode,
        "rate_hz": service.rate_hz,
        "gap": service.gap,
        "gap_hz": service.gap_hz,
        "bytes_per_s": round(service.bytes_per_s),
        "age_ms": {
            "p50": None if p50_ns is None else p50_ns / 1e6,
            "p99": None if p99_ns is None else p99_ns / 1e6,
        },
    }
