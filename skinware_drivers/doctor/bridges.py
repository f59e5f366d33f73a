"""Bridges: whether the robots are heard whose services appear here, and how well they come."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.bridge_state import BridgeState
from skinware.cli._bridges import as_data, summary
from skinware.text import age_text, count_text, rate_text
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, Severity

AREA = "bridges"
_LOST = 0.05
"""Of all frames: fewer are no reason to look at the link."""
_PAGE = "how-to/two-machines.md"
_PULLED = "how-to/two-machines.md#what-the-link-cannot-take"


def check(evidence: Evidence) -> Iterator[Note]:
    for bridge in evidence.bridges:
        yield Looked(AREA, f"robot {bridge.robot}", summary(bridge.robot, as_data(bridge)))
        if not bridge.is_up:
            yield _not_heard(bridge)
        yield from _pulled(bridge)
        yield from _refused(bridge)
        if bridge.namesakes or bridge.switches:
            yield _namesakes(bridge)


def _not_heard(bridge: BridgeState) -> Finding:
    return Finding(
        Severity.ERROR,
        AREA,
        "a robot is not heard over its bridge",
        f"robot {bridge.robot}",
        summary(bridge.robot, as_data(bridge)),
        "look at what skin-bridge join says, at the network, and whether skin-bridge serve runs on the robot",
        see=_PAGE,
    )


def _pulled(bridge: BridgeState) -> Iterator[Finding]:
    for name, service in bridge.services.items():
        all_hz = service.rate_hz + service.lost_hz
        if service.state == "live" and service.lost_hz > _LOST * all_hz and service.age_p50_ns is not None:
            age = age_text(service.age_p50_ns)
            yield Finding(
                Severity.NOTE,
                AREA,
                "the link is too slow for all frames",
                f"{name} of robot {bridge.robot}",
                f"{rate_text(service.rate_hz)} of {rate_text(all_hz)} come, {age} old (p50)",
                "a faster link has them all",
                see=_PULLED,
            )


def _refused(bridge: BridgeState) -> Iterator[Finding]:
    if bridge.refused:
        yield Finding(
            Severity.WARNING,
            AREA,
            "messages of a robot cannot be read",
            f"robot {bridge.robot}",
            f"{count_text(bridge.refused)} so far; the last: {bridge.last_refused}",
            "install the same version on both machines; if it is the same, something else speaks as this robot",
            see=_PAGE,
        )


def _namesakes(bridge: BridgeState) -> Finding:
    now = f"bridge {bridge.instance[:8]}{' on ' if bridge.host else ''}{bridge.host} is followed"
    return Finding(
        Severity.WARNING,
        AREA,
        "several robots have one name",
        f"robot {bridge.robot}",
        f"{now}; {bridge.namesakes} other now, {bridge.switches} switches between robots so far",
        "give each robot a name of its own: skin-bridge serve --robot NAME",
        see=_PAGE,
    )
