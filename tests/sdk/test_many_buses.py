"""Many buses in one driver, with the same addresses on each; and buses that join and leave while it runs."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Callable, Coroutine
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from skinware import BusReason, BusState, DriverReader
from skinware.errors import ConfigurationError, StructureChanged
from skinware_drivers.can.roboskin import RoboskinDriver, RoboskinOptions
from tests.commands import Running
from tests.commands import running as running_command
from tests.conftest import wait_until
from tests.sdk.driving import Driving, commands, driving, emulated, read_until, troubled

pytestmark = pytest.mark.usefixtures("hurry")


def test_32_buses_with_the_same_addresses_on_each() -> None:
    buses = [emulated(boards=(7,), pattern="cycle") for _ in range(32)]
    with driving(*buses) as running, DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        structure = frame.structure
        assert (len(structure.buses), structure.n_patches, structure.n_sensors) == (32, 32, 32 * 192)
        assert len(np.unique(structure.sensor_uid)) == structure.n_sensors
        assert (structure.sensor_uid >> np.uint64(32)).tolist() == np.repeat(np.arange(32), 192).tolist()
        running.do(buses[17].vanish)
        lost = read_until(
            reader, lambda f: f.bus_state[17] == BusState.GONE and bool(f.status[17 * 192 : 18 * 192].all())
        )
        others = np.ones(structure.n_sensors, bool)
        others[17 * 192 : 18 * 192] = False
        after = read_until(reader, lambda f: f.sequence > lost.sequence + 5 and not f.status[others].any())
        assert after.bus_state[17] == BusState.GONE
        assert {row["unknown"] for row in reader.bus_counters(after)} == {0}
        running.do(buses[17].come_back)


def do(running: Driving, action: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a coroutine in the driver's loop and wait for it; raises what it raises."""
    assert running._loop is not None
    asyncio.run_coroutine_threadsafe(action(), running._loop).result(60)


def adapter() -> RoboskinDriver:
    return RoboskinDriver(RoboskinOptions())


def follow(reader: DriverReader, condition: Callable[[Any], bool]) -> Any:
    """The first frame that fulfils a condition, over as many generations as it takes."""
    while True:
        try:
            return read_until(reader, condition)
        except StructureChanged:
            reader.reattach()


def test_a_bus_joins_and_leaves_and_joins_again() -> None:
    log: list[msgspec.Struct] = []
    with driving(emulated(boards=(7,))) as running, DriverReader("roboskin") as reader:
        runner = running.runner
        assert runner is not None
        first = read_until(reader, lambda f: not f.status.any())
        uids = first.structure.sensor_uid

        second = emulated(log, boards=(7, 8))
        do(running, lambda: runner.add_bus("more", adapter(), second))
        joined = follow(reader, lambda f: f.structure.n_patches == 3 and not f.status.any())
        assert joined.structure.buses == ("bus0", "more")
        assert joined.structure.sensor_uid[:192].tolist() == uids.tolist()
        with pytest.raises(ConfigurationError, match="in use already"):
            do(running, lambda: runner.add_bus("more", adapter(), emulated(boards=(9,))))

        do(running, lambda: runner.remove_bus("more"))
        left = follow(reader, lambda f: f.structure.n_patches == 1 and not f.status.any())
        assert left.structure.sensor_uid.tolist() == uids.tolist()
        assert (left.bus_state[1], left.bus_reason[1]) == (BusState.GONE, BusReason.REMOVED)
        assert second.fileno() == -1
        assert {payload for _, _, payload in commands(log)[-2:]} == {"0701"}  # its boards were stopped
        with pytest.raises(ConfigurationError, match="there is no bus"):
            do(running, lambda: runner.remove_bus("more"))
        with pytest.raises(ConfigurationError, match="last one"):
            do(running, lambda: runner.remove_bus("bus0"))

        do(running, lambda: runner.add_bus("more", adapter(), emulated(boards=(9,))))
        again = follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
        assert again.structure.buses == ("bus0", "more")
        assert running.status()["buses"][1]["state"] == "live"


def test_the_first_bus_leaves_and_the_others_keep_their_uids() -> None:
    with driving(emulated(boards=(7,)), emulated(boards=(8,))) as running, DriverReader("roboskin") as reader:
        assert running.runner is not None
        first = read_until(reader, lambda f: not f.status.any())
        do(running, lambda: running.runner.remove_bus("bus0"))  # type: ignore[union-attr]
        left = follow(reader, lambda f: f.structure.n_patches == 1 and not f.status.any())
        assert left.structure.sensor_uid.tolist() == first.structure.sensor_uid[192:].tolist()


def test_a_bus_that_is_not_there_yet_joins_when_it_comes(caplog: pytest.LogCaptureFixture) -> None:
    late = troubled(boards=(8,))
    late.down = True
    with (
        caplog.at_level(logging.WARNING),
        driving(emulated(boards=(7,))) as running,
        DriverReader("roboskin") as reader,
    ):
        assert running.runner is not None
        read_until(reader, lambda f: not f.status.any())
        do(running, lambda: running.runner.add_bus("late", adapter(), late))  # type: ignore[union-attr]
        waiting = follow(reader, lambda f: len(f.bus_state) == 2 and f.bus_state[1] == BusState.DOWN)
        assert waiting.structure.n_patches == 1
        follow(reader, lambda f: not f.status.any())
        wait_until(lambda: len(late.opened_at_s) >= 3)
        late.down = False
        follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
    assert caplog.text.count("bus late is back") == 1


def test_a_driver_stops_while_a_bus_joins() -> None:
    late = troubled(boards=(8,))
    late.down = True
    with driving(emulated(boards=(7,))) as running:
        assert running.runner is not None
        do(running, lambda: running.runner.add_bus("late", adapter(), late))  # type: ignore[union-attr]
    assert late.fileno() == -1


def as_file(path: Path) -> AbstractContextManager[Running]:
    return running_command("skin-driver", "--config", str(path))


def test_sighup_reads_the_buses_of_the_file_again(tmp_path: Path) -> None:
    file = tmp_path / "torso.toml"
    one, two = 'name = "virtual?boards=7"', 'name = "virtual?boards=8"'

    def write(*buses: str) -> None:
        file.write_text('driver = "roboskin"\n' + "".join(f"[[bus]]\n{bus}\n" for bus in buses))

    write(one)
    with (
        running_command("skin-driver", "--config", str(file)) as driver,
        DriverReader("roboskin", timeout_s=60) as reader,
    ):
        driver.wait_for("ready")
        write(one, two)
        driver.process.send_signal(signal.SIGHUP)
        follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
        write(two, "nme = 3")
        driver.process.send_signal(signal.SIGHUP)
        wait_until(lambda: "buses stay as they are: " in driver.errors)
        write(two)
        driver.process.send_signal(signal.SIGHUP)
        last = follow(reader, lambda f: f.structure.n_patches == 1 and not f.status.any())
        assert bytes(last.structure.patch_name[0]) == b"board 8"
