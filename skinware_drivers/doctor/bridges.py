"""Bridges: whether the robots are heard whose services appear here, and how well they come."""

from __future__ import annotations

from collections.abc import Iterator

from skinware.bridge_state import BridgeState
from skinware.cli._bridges import as_data, summary
from skinware.cli._format import age_text, rate_text
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.finding import Finding, Looked, Note, Severity

AREA = "bridges"
_PAGE = "how-to/two-machines.md"
_PULLED = "how-to/two-machines.md#what-the-link-cannot-take"


def check(evidence: Evidence) -> Iterator[Note]:
    """What is to be said of bridges."""
    for bridge in evidence.bridges:
        yield Looked(AREA, f"robot {bridge.robot}", summary(bridge.robot, as_data(bridge)))
        if not bridge.is_up:
            yield _not_heard(bridge)
        yield from _pulled(bridge)


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
        if service.state == "live" and service.mode == "pull" and service.age_p50_ns is not None:
            age = age_text(service.age_p50_ns)
            yield Finding(
                Severity.NOTE,
                AREA,
                "the link is too slow for all frames",
                f"{name} of robot {bridge.robot}",
                f"{rate_text(service.rate_hz)} come, {age} old (p50); the others are left out",
                "a faster link has them all",
                see=_PULLED,
            )


__all__ = ["check"]
