"""What went over real CAN sockets, captured and decoded again: to the last value the same."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from skinware_drivers.options import NoOptions
from skinware_drivers.proving.captures import check_capture
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.testing.waiting import wait_until
from tests.can.rig import TIP_IDENTIFIER, Tip, sender
from tests.can.test_drivers_on_can import emulating
from tests.recording.rig import recording
from tests.recording.test_wire_replay import record

pytestmark = [pytest.mark.can, pytest.mark.timeout(300)]


def test_a_capture_with_stamps_of_the_kernel_is_decoded_to_the_same_values(
    vcan: Callable[[], str], tmp_path: Path
) -> None:
    bus, file, numbers = vcan(), tmp_path / "tip.mcap", np.random.default_rng(3)
    with (
        recording(file, with_wires=True) as recorder,
        driving_lines([(Tip(NoOptions()), make_bus(bus))], "tip", wait=False) as driver,
        sender(bus) as out,
    ):
        wait_until(lambda: driver.runner is not None and driver.runner.lines[0].bus.fileno() >= 0)
        for _ in range(24):
            out.send(struct.pack("=IB3x8s", TIP_IDENTIFIER, 8, numbers.bytes(8)))
            time.sleep(0.05)
        driver.wait()
        wait_until(lambda: recorder.messages.get("/skin/tip/frame", 0) > 15)
    compared, _ = check_capture(file, Tip)
    assert compared.difference is None
    assert compared.compared >= 10


def test_a_capture_of_boards_that_are_set_up_is_decoded_to_the_same_values(
    vcan: Callable[[], str], tmp_path: Path
) -> None:
    bus, kind, file = vcan(), load_driver("roboskin"), tmp_path / "boards.mcap"
    with emulating("roboskin", bus, boards=(7,)):
        record(file, kind(kind.Options()), make_bus(bus), 20)
    compared, _ = check_capture(file, kind)
    assert compared.difference is None
    assert compared.compared >= 10
