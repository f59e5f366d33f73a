"""Buses that are not there when the driver starts, as when a robot boots and an adapter comes late."""

from __future__ import annotations

import logging
import signal
import threading
import time
from pathlib import Path

import pytest

from skinware import BusReason, BusState, DriverReader, Namespace
from skinware.errors import BusNotAvailable
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.description import Patch
from skinware_drivers.link import Link
from skinware_drivers.testing.waiting import wait_until
from tests.commands import running as running_command
from tests.sdk.driving import Driving, TroubledBus, driving, emulated, follow, read_until, troubled

pytestmark = pytest.mark.usefixtures("hurry")


def absent(*boards: int) -> TroubledBus:
    bus = troubled(boards=boards)
    bus.down = True
    return bus


def test_a_driver_starts_with_the_buses_that_are_there_and_the_others_join(caplog: pytest.LogCaptureFixture) -> None:
    late = absent(8)
    with (
        caplog.at_level(logging.WARNING),
        driving(late, emulated(boards=(7,))) as running,
        DriverReader("roboskin") as reader,
    ):
        waiting = read_until(reader, lambda f: f.bus_state.tolist() == [BusState.DOWN, BusState.LIVE])
        assert (waiting.bus_reason[0], waiting.structure.n_patches) == (BusReason.INTERFACE_DOWN, 1)
        assert running.status()["buses"][0]["reason"] == "interface_down"
        uids = waiting.structure.sensor_uid.tolist()
        wait_until(lambda: len(late.opened_at_s) >= 4)
        late.down = False
        joined = follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
        assert joined.bus_state.tolist() == [BusState.LIVE] * 2
        assert joined.structure.sensor_uid[192:].tolist() == uids
    assert caplog.text.count("the bus is down; waiting for it to appear") == 1
    assert caplog.text.count("bus bus0 is there") == 1


def test_without_any_bus_it_is_an_error() -> None:
    first, second = absent(7), absent(8)
    with pytest.raises(BusNotAvailable, match="the bus is down"), driving(first, second):
        pass
    assert [len(bus.opened_at_s) for bus in (first, second)] == [1, 1]


def test_a_bus_that_may_not_be_opened_is_an_error_and_leaves_the_others_closed(namespace: Namespace) -> None:
    first, second = emulated(boards=(7,)), troubled(boards=(7,))
    second.refused = True
    with pytest.raises(BusNotAvailable, match="not permitted"), driving(first, second, wait_for_buses=True):
        pass
    assert first.fileno() == -1
    assert namespace.services() == []


def test_what_a_driver_failed_with_is_told_also_while_its_thread_is_about_to_end() -> None:
    class Lingering(threading.Event):
        def set(self) -> None:
            super().set()
            time.sleep(0.5)  # the thread of a busy machine

    bus = troubled(boards=(7,))
    bus.refused = True
    running = Driving([(RoboskinDriver(RoboskinOptions()), bus)], "roboskin", listen_only=False, wait_for_buses=True)
    running.ready = Lingering()
    running.start()
    for step in (running.wait, running.stop):
        with pytest.raises(BusNotAvailable, match="not permitted"):
            step()


def test_a_driver_that_was_told_to_wait_waits_for_its_only_bus(caplog: pytest.LogCaptureFixture) -> None:
    bus = absent(7)
    with caplog.at_level(logging.WARNING), driving(bus, wait=False, wait_for_buses=True) as running:
        wait_until(lambda: len(bus.opened_at_s) >= 4)
        assert not running.ready.is_set()
        bus.down = False
        running.wait()
        with DriverReader("roboskin") as reader:
            read_until(reader, lambda f: not f.status.any())
    assert caplog.text.count("waiting for it to appear") == 1


def test_a_driver_that_waits_can_be_stopped() -> None:
    bus = absent(7)
    with driving(bus, wait=False, wait_for_buses=True):
        wait_until(lambda: len(bus.opened_at_s) >= 2)
    assert bus.fileno() == -1


class SelfDescribing(RoboskinDriver):
    """Knows no types before its devices have told them."""

    def __init__(self, options: RoboskinOptions) -> None:
        super().__init__(options)
        self._all_types = self.types
        del self.types

    async def describe(self, link: Link) -> list[Patch]:
        """As its devices say."""
        found = list(await super().describe(link))
        self.types = self._all_types
        return found


def test_a_bus_whose_devices_have_not_described_themselves_holds_up_no_other() -> None:
    late = absent(8)
    with driving(emulated(boards=(7,)), late, driver=SelfDescribing), DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        late.down = False
        follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())


@pytest.mark.thorough
def test_the_command_waits_if_it_is_told_to(tmp_path: Path) -> None:
    port = tmp_path / "port"
    file = tmp_path / "torso.toml"
    file.write_text(f'wait = true\n[[bus]]\nname = "slcan:{port}"\n')
    with running_command("skin-driver", "--config", str(file)) as driver:
        wait_until(lambda: "waiting for it to appear" in driver.errors)
        assert driver.process.poll() is None
        driver.stop(signal.SIGINT)
        assert driver.process.returncode == 0
        assert driver.errors.count("waiting for it to appear") == 1
