"""Many buses in one driver, with the same addresses on each; and buses that join and leave while it runs."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware import BusReason, BusState, DriverReader
from skinware.errors import ConfigurationError
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import Event
from tests.commands import running as running_command
from tests.sdk.driving import Driving, commands, driving, driving_lines, emulated, follow, read_until, troubled

pytestmark = pytest.mark.usefixtures("hurry")


@pytest.mark.thorough
def test_32_buses_with_the_same_addresses_on_each() -> None:
    buses = [emulated(boards=(7,), pattern="cycle") for _ in range(32)]
    lines = [(adapter(boards=(7,), period_ms=200), bus) for bus in buses]  # also a busy machine can emulate these
    with driving_lines(lines, "roboskin") as running, DriverReader("roboskin") as reader:
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


def adapter(**options: Any) -> RoboskinDriver:
    return RoboskinDriver(RoboskinOptions(**options))


def change_to(running: Driving, adapters: dict[str, RoboskinDriver], *new: VirtualCanBus) -> None:
    """Have these buses; those that are made for it are ``new``, in turn."""
    runner, left = running.runner, list(new)
    assert runner is not None
    do(running, lambda: runner.buses.change_to(adapters, lambda _name, _adapter: left.pop(0)))
    assert not left


def test_a_bus_joins_and_leaves_and_joins_again() -> None:
    log: list[Event] = []
    with driving(emulated(boards=(7,))) as running, DriverReader("roboskin") as reader:
        first = read_until(reader, lambda f: not f.status.any())
        uids = first.structure.sensor_uid

        second = emulated(log, boards=(7, 8))
        change_to(running, {"bus0": adapter(), "more": adapter()}, second)
        joined = follow(reader, lambda f: f.structure.n_patches == 3 and not f.status.any())
        assert joined.structure.buses == ("bus0", "more")
        assert joined.structure.sensor_uid[:192].tolist() == uids.tolist()

        change_to(running, {"bus0": adapter()})
        left = follow(reader, lambda f: f.structure.n_patches == 1 and not f.status.any())
        assert left.structure.sensor_uid.tolist() == uids.tolist()
        assert (left.bus_state[1], left.bus_reason[1]) == (BusState.GONE, BusReason.REMOVED)
        assert second.fileno() == -1
        assert {payload for _, _, payload in commands(log)[-2:]} == {"0701"}  # its boards were stopped

        change_to(running, {"bus0": adapter(), "more": adapter()}, emulated(boards=(9,)))
        again = follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
        assert again.structure.buses == ("bus0", "more")
        assert running.status()["buses"][1]["state"] == "live"


def test_the_first_bus_leaves_and_the_others_keep_their_uids() -> None:
    with driving(emulated(boards=(7,)), emulated(boards=(8,))) as running, DriverReader("roboskin") as reader:
        first = read_until(reader, lambda f: not f.status.any())
        change_to(running, {"bus1": adapter()})
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
        read_until(reader, lambda f: not f.status.any())
        change_to(running, {"bus0": adapter(), "late": adapter()}, late)
        waiting = follow(reader, lambda f: len(f.bus_state) == 2 and f.bus_state[1] == BusState.DOWN)
        assert waiting.structure.n_patches == 1
        follow(reader, lambda f: not f.status.any())
        wait_until(lambda: len(late.opened_at_s) >= 3)
        late.down = False
        follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
    assert caplog.text.count("bus late is there") == 1


def test_a_driver_stops_while_a_bus_joins() -> None:
    late = troubled(boards=(8,))
    late.down = True
    with driving(emulated(boards=(7,))) as running:
        change_to(running, {"bus0": adapter(), "late": adapter()}, late)
    assert late.fileno() == -1


def test_a_bus_with_other_options_is_opened_anew_in_its_place_and_the_others_go_on() -> None:
    logs: list[list[Event]] = [[], []]
    first, second = emulated(logs[0], boards=(7, 8)), emulated(logs[1], boards=(9,))
    with driving(first, second) as running, DriverReader("roboskin") as reader:
        before = read_until(reader, lambda f: not f.status.any())
        told = len(commands(logs[1]))
        change_to(running, {"bus0": adapter(boards=(8,)), "bus1": adapter()}, emulated(boards=(7, 8)))
        after = follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
        assert after.structure.buses == ("bus0", "bus1")
        assert bytes(after.structure.patch_name[0]) == b"board 8"
        assert after.structure.sensor_uid.tolist() == before.structure.sensor_uid[192:].tolist()
        assert first.fileno() == -1
        assert commands(logs[0])[-1][2] == "0701"  # its boards were stopped
        assert len(commands(logs[1])) == told


def test_while_the_only_bus_is_opened_anew_its_sensors_stay_without_data() -> None:
    again = troubled(boards=(7, 8))
    again.down = True
    with driving(emulated(boards=(7,))) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        change_to(running, {"bus0?filter=on": adapter()}, again)
        waiting = follow(reader, lambda f: f.bus_state[0] == BusState.DOWN)
        assert waiting.structure.buses == ("bus0?filter=on",)
        assert waiting.status.all()
        change_to(running, {"bus0?filter=on": adapter(), "more": adapter()}, emulated(boards=(9,)))
        follow(reader, lambda f: bytes(f.structure.patch_name[0]) == b"board 9" and not f.status.any())
        again.down = False
        follow(reader, lambda f: f.structure.n_patches == 3 and not f.status.any())


def test_a_listener_hears_a_bus_anew_that_is_its_only_one() -> None:
    with driving(emulated(boards=(7,), streaming=True), listen_only=True, learn_s=0.2) as running:
        with DriverReader("roboskin") as reader:
            read_until(reader, lambda f: not f.status.any())
            more = emulated(boards=(7, 8), streaming=True, listen_only=True)
            change_to(running, {"bus0": adapter(learn_s=0.4)}, more)
            follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())


def refuse(name: str, _adapter: AnyAdapter) -> VirtualCanBus:
    raise ConfigurationError(f"{name} has a bad option")


@pytest.mark.parametrize(
    ("wanted", "make", "message"),
    [
        ({"bus0": {"boards": (7,)}, "more": {}}, refuse, "bad option"),
        ({"bus0": {"inertial": ("accelerometer",), "inertial_scale": "mtb3"}}, None, "disagree on the type"),
        ({}, None, "last one with sensors"),
    ],
)
def test_buses_that_cannot_be_as_they_are_wanted_change_nothing(
    wanted: dict[str, dict[str, Any]], make: Callable[[str, AnyAdapter], VirtualCanBus] | None, message: str
) -> None:
    bus, other = emulated(boards=(7,)), emulated(boards=(8,))
    options: dict[str, Any] = {"inertial": ("accelerometer",)}
    with driving(bus, other, **options) as running, DriverReader("roboskin") as reader:
        before = read_until(reader, lambda f: f.bus_state.tolist() == [BusState.LIVE] * 2)
        runner = running.runner
        assert runner is not None
        adapters = {name: adapter(**of_bus) for name, of_bus in wanted.items()}
        if adapters:
            adapters["bus1"] = adapter(**options)
        with pytest.raises(ConfigurationError, match=message):
            do(running, lambda: runner.buses.change_to(adapters, make or (lambda _name, _adapter: emulated())))
        after = read_until(reader, lambda f: f.sequence > before.sequence + 3)
        assert after.generation == before.generation


def test_a_slow_bus_that_was_removed_slows_nothing_down() -> None:
    slow = RoboskinDriver(RoboskinOptions(boards=(8,), period_ms=250))
    fast = RoboskinDriver(RoboskinOptions(boards=(7,), period_ms=20))
    lines = [(fast, emulated(boards=(7,))), (slow, emulated(boards=(8,)))]
    with driving_lines(lines, "roboskin") as running:
        runner = running.runner
        assert runner is not None
        assert runner.builder._period_s == 0.25
        do(running, lambda: runner.buses.change_to({"bus0": fast}, lambda _name, _adapter: emulated()))
        assert runner.builder._period_s == 0.02
        assert runner.builder.generation is not None
        assert runner.builder.generation.period_s == 0.02


@pytest.mark.thorough
def test_sighup_reads_the_buses_of_the_file_again(tmp_path: Path) -> None:
    file = tmp_path / "torso.toml"
    one, two = 'name = "virtual?boards=7"', 'name = "virtual?boards=8,9"'

    def write(*buses: str) -> None:
        file.write_text('driver = "roboskin"\n' + "".join(f"[[bus]]\n{bus}\n" for bus in buses))
        driver.process.send_signal(signal.SIGHUP)

    file.write_text(f"[[bus]]\n{one}\n")
    with (
        running_command("skin-driver", "--config", str(file)) as driver,
        DriverReader("roboskin", timeout_s=60) as reader,
    ):
        driver.wait_for("ready")
        write(one, two)
        follow(reader, lambda f: f.structure.n_patches == 3 and not f.status.any())
        write(two, "nme = 3")
        wait_until(lambda: f"buses and places stay as they are: {file}:5: bus 2: unknown key 'nme'" in driver.errors)
        write(one, f"{two}\noptions = {{ boards = [9], period_ms = 0 }}")
        wait_until(lambda: f"{file}:6: options of virtual?boards=8,9: " in driver.errors)
        text = file.read_text()
        file.write_text(text.replace("roboskin", "xela"))
        driver.process.send_signal(signal.SIGHUP)
        wait_until(lambda: f"{file}: driver = 'xela', and 'roboskin' is running: stop it and start" in driver.errors)
        write(one, f"{two}\noptions = {{ boards = [9] }}")
        follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
        write(two)
        last = follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any() and "8" in names(f))
        assert names(last) == "board 8, board 9"


def names(frame: Any) -> str:
    return ", ".join(bytes(name).decode() for name in frame.structure.patch_name)
