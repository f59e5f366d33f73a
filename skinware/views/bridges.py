"""How bridges are, in words and as JSON has it."""

from __future__ import annotations

from typing import Any

from skinware.bridge_state import BridgeState, ServiceState
from skinware.realtime import NS_PER_S, now_ns
from skinware.text import age_text, count_text, plural, rate_text, table

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


def summary(robot: str, told: dict[str, Any]) -> str:
    state = "heard" if told["connected"] else "not heard"
    host = f" on {told['host']}" if told["host"] else ""
    line, clock = f"robot {robot}{host} {state} for {age_text(told['since_s'] * 1e9)}", told["clock"]
    if clock is None:
        return f"{line}, its clock is not known"
    error, round_trip = age_text(clock["error_ms"] * 1e6), age_text(clock["round_trip_ms"] * 1e6)
    return f"{line}, its clock known to {error}, round trip {round_trip}"


def trouble(told: dict[str, Any]) -> list[str]:
    """Lines on messages that could not be read, and on robots of one name; of what ``as_data`` returns."""
    lines = []
    if told["refused"]:
        lines.append(f"{plural(told['refused'], 'message')} could not be read; the last: {told['last_refused']}")
    if told["namesakes"]:
        lines.append(
            f"{plural(told['namesakes'], 'other bridge')} of this name; bridge {told['instance'][:8]} is followed"
        )
    if told["switches"]:
        lines.append(f"another robot of this name took its place {plural(told['switches'], 'time')}")
    return lines


def as_lines(robot: str, told: dict[str, Any]) -> list[str]:
    rows = [
        (
            name,
            service["state"],
            service["mode"],
            rate_text(service["rate_hz"]),
            *(_age_text(service["age_ms"][share]) for share in ("p50", "p99")),
            count_text(service["lost"]),
        )
        for name, service in told["services"].items()
    ]
    return [summary(robot, told), *trouble(told), *(["", *table(_TITLES, rows, left=3)] if rows else [])]


def _age_text(age_ms: float | None) -> str:
    return age_text(None if age_ms is None else age_ms * 1e6)


def _service_data(service: ServiceState) -> dict[str, Any]:
    p50_ns, p99_ns = service.age_p50_ns, service.age_p99_ns
    return {
        "state": service.state,
        "mode": service.mode,
        "rate_hz": service.rate_hz,
        "lost": service.lost,
        "lost_hz": service.lost_hz,
        "bytes_per_s": round(service.bytes_per_s),
        "age_ms": {
            "p50": None if p50_ns is None else p50_ns / 1e6,
            "p99": None if p99_ns is None else p99_ns / 1e6,
        },
    }
