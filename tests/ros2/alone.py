"""A graph of its own for each test: on this machine alone, and met by no other test."""

from __future__ import annotations

import os
import zlib

import pytest

from skinware import Namespace


def own_domain(namespace: Namespace, monkeypatch: pytest.MonkeyPatch) -> int:
    """The domain that all who start from now on take by default; with its ports below those that others get."""
    number = zlib.crc32(namespace.name.encode()) % 99 + 1
    monkeypatch.setenv(
        "CYCLONEDDS_URI",
        "<CycloneDDS><Domain id='any'><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
        "<AllowMulticast>false</AllowMulticast></General><Discovery>"
        f"<Tag>{namespace.name}-{os.getpid()}</Tag><ParticipantIndex>auto</ParticipantIndex>"
        "<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers>"
        "<SPDPInterval>0.2 s</SPDPInterval></Discovery></Domain></CycloneDDS>",
    )
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    return number
