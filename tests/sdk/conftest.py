"""For tests of a running driver."""

from __future__ import annotations

import pytest

from skinware.realtime import NS_PER_S
from skinware_drivers.can import roboskin
from skinware_drivers.running import bus_line
from skinware_drivers.virtual import bus

HURRIED_WAIT_S = 0.06
"""What remains of the wait after set-up."""


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Emulated boards keep what nobody fetched for a while: a busy machine must not lose frames of these tests."""
    monkeypatch.setattr(bus, "_LONGEST_BACKLOG_NS", 30 * NS_PER_S)


@pytest.fixture
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter waits, where a test is not about their length. The order of all things stays."""
    monkeypatch.setattr(roboskin, "_AFTER_CONFIGURATION_S", HURRIED_WAIT_S)
    monkeypatch.setattr(roboskin, "_DISCOVERY_S", 0.1)
    monkeypatch.setattr(bus_line, "_FIRST_PAUSE_S", 0.03)
    monkeypatch.setattr(bus_line, "_LONGEST_PAUSE_S", 0.12)
