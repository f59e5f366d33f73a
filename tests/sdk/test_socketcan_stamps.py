"""Time stamps of SocketCAN without CAN in the kernel: when a frame arrived, whatever the wall clock does."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest

from skinware_drivers.bus import FrameBatch
from skinware_drivers.can import socketcan
from skinware_drivers.can.socketcan import SocketCanBus
from tests.sdk.cable import Cable, drain, pass_ms

SO_TIMESTAMPING = 37


def test_stamps_tell_when_a_frame_arrived_not_when_it_was_fetched(cable: Cable) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    pass_ms(20)
    before_ns, after_ns = cable.put_ten()
    pass_ms(20)
    batch = FrameBatch(10)
    drain(bus, batch)
    stamps = batch.time_ns[:10]
    slack_ns = 5_000_000  # two clocks are read one after the other
    assert before_ns - slack_ns <= stamps.min()
    assert stamps.max() <= after_ns + slack_ns
    assert np.all(np.diff(stamps) >= 0)


@pytest.mark.parametrize("step_s", [3600, -3600, 0.5, -0.5])
def test_a_step_of_the_wall_clock_bends_no_stamp(cable: Cable, step_s: float) -> None:
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    batch = FrameBatch(10)
    bounds = []
    for _ in range(4):  # each time the clock was set before a frame was stamped; how it was before, the bus knows
        pass_ms(5)
        bus._can.offset_ns += round(step_s * 1e9)
        before_ns = time.monotonic_ns()
        cable.put(0x123)
        bounds.append((before_ns, time.monotonic_ns()))
        pass_ms(20)
        drain(bus, batch)
    slack_ns = 2_000_000  # two clocks are read one after the other
    for (before_ns, after_ns), stamp in zip(bounds, batch.time_ns[:4].tolist(), strict=True):
        assert before_ns - slack_ns <= stamp <= after_ns + slack_ns


def test_an_interface_without_stamps_of_its_own_says_so_where_they_were_asked_for(cable: Cable) -> None:
    bus = SocketCanBus("lo", {"timestamps": "hardware", "buffer": "20000"})
    bus.adopt(cable.end)
    assert bus.note == "bus lo: its controller gives no time stamps; the kernel's are taken instead"
    cable.put(0x123)
    batch = FrameBatch(10)
    drain(bus, batch)
    assert batch.time_ns[0] > 0


def test_stamping_with_hardware_takes_the_kernels_where_there_are_no_others(
    cable: Cable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socketcan, "has_hardware_stamps", lambda *_: True)
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    batch = FrameBatch(100)
    for _ in range(3):
        pass_ms(10)
        before_ns, after_ns = cable.put_ten()
        pass_ms(10)
        first = batch.stop
        drain(bus, batch)
        stamps = batch.time_ns[first : batch.stop]
        assert before_ns - 5_000_000 <= stamps.min()
        assert stamps.max() <= after_ns + 5_000_000


def test_a_frame_without_a_stamp_is_as_old_as_its_receipt(cable: Cable, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcan, "has_hardware_stamps", lambda *_: True)
    bus = SocketCanBus("can0")
    bus.adopt(cable.end)
    batch = FrameBatch(10)
    cable.put(0x123)
    drain(bus, batch)
    cable.end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, 0)
    cable.put(0x123)
    before_ns = time.monotonic_ns()
    drain(bus, batch)
    assert before_ns <= batch.time_ns[1] <= time.monotonic_ns()
