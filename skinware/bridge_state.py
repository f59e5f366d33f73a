"""The state of a bridge: a service of the namespace in which a robot appears; and the same as JSON and in words.

Once a second, and whenever the link comes or goes::

    with BridgeReader(service_name("icub"), namespace="icub") as bridge:
        state = bridge.read().state
        print(state.is_up, state.services["arm"].age_p99_ns)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from skinware.errors import BadServiceFile
from skinware.memory import segments
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import Column, ServiceReader, ServiceWriter
from skinware.text import age_text_ms, count_text, plural, rate_text, table

KIND = "bridge"
RATE_HZ = 1.0
"""How often it is published at least."""
MOST = 64
"""Number of services that a state lists at most."""
_STATE = Column(np.dtype("S40960"), (), "", "JSON, with the attributes of BridgeState")
_LONGEST_NAME, _LONGEST_REASON = 64, 160


@dataclass(frozen=True)
class ServiceState:
    """State of one service that comes over a bridge.

    Attributes:
        state: as on the robot (live, paused, closed, dead), or ``unheard``.
        mode: ``pull`` or ``push``.
        rate_hz, gap_hz: samples of the last second that were published here, and that the robot published and that did
            not come.
        gap: samples that the robot published and that did not come, since the first one.
        bytes_per_s: of messages, in the last second.
        age_p50_ns, age_p99_ns: from the publication there to the one here, in the last second; None: there was none.
    """

    state: str
    mode: str
    rate_hz: float = 0.0
    gap: int = 0
    bytes_per_s: float = 0.0
    age_p50_ns: float | None = None
    age_p99_ns: float | None = None
    gap_hz: float = 0.0


@dataclass(frozen=True)
class BridgeState:
    """State of a bridge.

    Attributes:
        since_ns: since when that is so, CLOCK_MONOTONIC.
        clock_offset_ns: our clock minus the robot's; None: not known.
        clock_error_ns: largest error of the offset; None: not known.
        round_trip_ns: the shortest lately.
        instance: number of the bridge that is followed; empty: none so far.
        host: name of its machine; empty: not known.
        namesakes: other bridges that serve a robot of this name.
        switches: how often another robot of this name took the place of the one that was followed.
        refused: messages of the robot that could not be read.
        last_refused: the last of those, and what was wrong; empty: none so far.
    """

    robot: str
    is_up: bool
    since_ns: int
    clock_offset_ns: int | None
    clock_error_ns: int | None
    round_trip_ns: int
    services: Mapping[str, ServiceState]
    instance: str = ""
    host: str = ""
    namesakes: int = 0
    switches: int = 0
    refused: int = 0
    last_refused: str = ""


def service_name(robot: str) -> str:
    return f"{robot[:40]}-bridge"


class BridgeSample(Sample):
    __slots__ = ()

    @property
    def state(self) -> BridgeState:
        """Return the state.

        Raises:
            BadServiceFile: another program published something else.
        """
        try:
            return msgspec.json.decode(bytes(self.column("state").item()), type=BridgeState)
        except msgspec.MsgspecError as error:
            raise BadServiceFile(f"service {self.context!r} publishes no state of a bridge ({error})") from None


class BridgeReader(ServiceReader[BridgeSample]):
    """Read the state of a bridge.

    Args:
        name: of the service (:func:`service_name`).
        namespace, timeout_s, announce: as for :class:`skinware.service.ServiceReader`, which also lists the errors.

    Raises:
        BadServiceFile: the service is no state of a bridge.
    """

    frame_class = BridgeSample

    def _describe(self, attached: segments.Segment) -> str:
        column = attached.schema.columns.get("state")
        is_bridge = bytes(attached.header["kind"]) == KIND.encode()
        if not is_bridge or column is None or (column.dtype, column.shape) != (_STATE.dtype, _STATE.shape):
            raise BadServiceFile(f"service {self.name!r} is no state of a bridge")
        return self.name


class BridgeStateWriter(ServiceWriter):
    """Publish the state of a bridge."""

    def __init__(self, robot: str, namespace: Namespace) -> None:
        super().__init__(
            service_name(robot),
            {"state": _STATE},
            namespace=namespace,
            kind=KIND,
            rate_hz=RATE_HZ,
            description=f"the bridge to robot {robot}",
        )

    def publish(self, state: BridgeState, at_ns: int) -> None:
        """Publish the state at a time, CLOCK_MONOTONIC ns.

        Raises:
            Closed, NameInUse: as :meth:`skinware.service.ServiceWriter.begin`.
        """
        state = replace(
            state,
            services=dict(list(state.services.items())[:MOST]),
            host=state.host[:_LONGEST_NAME],
            last_refused=state.last_refused[:_LONGEST_REASON],
        )
        self.begin()["state"][...] = msgspec.json.encode(state)
        self.commit(at_ns)


_TITLES = ("service", "state", "mode", "rate", "age 50 %", "age 99 %", "not come")


def as_data(bridge: BridgeState) -> dict[str, Any]:
    clock = None
    if bridge.clock_offset_ns is not None and bridge.clock_error_ns is not None:
        clock = {
            "offset_ms": bridge.clock_offset_ns / 1e6,
            "error_ms": bridge.clock_error_ns / 1e6,
            "round_trip_ms": bridge.round_trip_ns / 1e6,
        }
    services = {}
    for name, service in bridge.services.items():
        ages_ns = {"p50": service.age_p50_ns, "p99": service.age_p99_ns}
        services[name] = {
            "state": service.state,
            "mode": service.mode,
            "rate_hz": service.rate_hz,
            "gap": service.gap,
            "gap_hz": service.gap_hz,
            "bytes_per_s": round(service.bytes_per_s),
            "age_ms": {share: None if age_ns is None else age_ns / 1e6 for share, age_ns in ages_ns.items()},
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
        "services": services,
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
