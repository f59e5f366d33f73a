"""A driver that was stopped for a while takes nothing for silent that went on meanwhile."""

from __future__ import annotations

import os
import signal
import time

import pytest

from skinware import DriverReader
from skinware_drivers.testing.waiting import wait_until
from tests.commands import Running, running

BUS = "udp_multicast:239.74.163.3?port=43122"
STOPPED_S = 4


def recalibrations(boards: Running) -> int:
    """How often the boards have moved their baselines, a second from now."""
    boards.wait_for("status")
    return int(boards.wait_for("status")["recalibrations"])


@pytest.mark.thorough
def test_boards_are_not_set_up_again_because_the_driver_was_stopped() -> None:
    with (
        running("skin-emulate", "--driver", "roboskin", "--bus", BUS, "--boards", "7,8") as boards,
        running("skin-driver", "--driver", "roboskin", "--bus", BUS, "--name", "torso") as driver,
    ):
        driver.wait_for("ready")
        with DriverReader("torso", timeout_s=10) as reader:
            wait_until(lambda: bool(reader.read().fresh("pressure").all()))
            before = recalibrations(boards)
            os.kill(driver.process.pid, signal.SIGSTOP)
            try:
                time.sleep(STOPPED_S)
                stopped = reader.read()
            finally:
                os.kill(driver.process.pid, signal.SIGCONT)
            assert not stopped.fresh("pressure").any()
            wait_until(lambda: bool(reader.read().fresh("pressure").all()))
        assert recalibrations(boards) == before
        wait_until(lambda: "held up for" in driver.errors)
        assert "silent" not in driver.errors.replace("silence is counted", "")
