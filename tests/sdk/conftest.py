"""For tests of a running driver."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator

import pytest

from skinware.realtime import NS_PER_S
from skinware_drivers.can import roboskin, roboskin_setup
from skinware_drivers.running import bus_line
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual import hardware
from tests.sdk.cable import SO_TIMESTAMPNS, Cable, pass_ms

HURRIED_WAIT_S = 0.06
"""What remains of the wait after set-up."""


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Emulated boards keep what nobody fetched for a while: a busy machine must not lose frames of these tests."""
    monkeypatch.setattr(hardware, "_LONGEST_BACKLOG_NS", 30 * NS_PER_S)


@pytest.fixture
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter waits, where a test is not about their length. The order of all things stays."""
    monkeypatch.setattr(roboskin, "_AFTER_CONFIGURATION_S", HURRIED_WAIT_S)
    monkeypatch.setattr(roboskin_setup, "_DISCOVERY_S", 0.1)
    monkeypatch.setattr(bus_line, "_FIRST_PAUSE_S", 0.03)
    monkeypatch.setattr(bus_line, "_LONGEST_PAUSE_S", 0.12)


@pytest.fixture
def stamping() -> Iterator[None]:
    """The kernel begins to stamp a while after the first socket has asked for it, and goes on as long as one does."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", 0))
        end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

        def is_stamped_at_once() -> bool:
            end.sendto(b"", end.getsockname())
            sent_ns = time.time_ns()
            pass_ms(5)
            _, ((_, _, stamp),), _, _ = end.recvmsg(10, 100)
            seconds, nanoseconds = struct.unpack("=qq", stamp)
            return bool(seconds * 10**9 + nanoseconds < sent_ns + 2_000_000)

        wait_until(is_stamped_at_once)
        yield


@pytest.fixture
def cable(stamping: None) -> Iterator[Cable]:
    """A socket whose frames are stamped at once."""
    made = Cable()
    yield made
    made.close()


@pytest.fixture
def spare_cable(stamping: None) -> Iterator[Cable]:
    """Another one."""
    made = Cable()
    yield made
    made.close()
