"""The main job on a real (virtual) CAN bus: emulated boards, driver and reader as separate processes."""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from skinware import BusState, DriverReader, PatchState, Status
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.roboskin_layout import HEAD_BYTE, TAIL_BYTE
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.testing.waiting import wait_until
from tests.can.conftest import ip
from tests.commands import run, running
from tests.sdk.driving import read_until

pytestmark = [pytest.mark.can, pytest.mark.timeout(400)]

SPAWN = multiprocessing.get_context("spawn")
TRIALS = Path(__file__).resolve().parents[3] / "shared" / "data" / "icub_grasp" / "trials"
MINUTE_FRAMES = 1200
ENOUGH_BYTES = 1 << 28
"""Receive buffer for the frames of a minute: none is dropped, however long its reader gets no processor time."""


def check_no_torn_module(frame: Any) -> npt.NDArray[np.bool_]:
    """All values of a fresh module carry one cycle number; returns which modules are fresh."""
    values, status = frame.values.reshape(-1, 12), frame.status.reshape(-1, 12)
    fresh = (status == 0).all(axis=1)
    assert (values[fresh].min(axis=1) == values[fresh].max(axis=1)).all(), "a torn module was shown as fresh"
    return np.asarray(fresh, bool)


def is_silent(frame: Any) -> bool:
    """Everything that was sent is counted."""
    return bool(frame.bus_state[0] == BusState.SILENT)


class Witness:
    """Hears the halves of all modules on an interface, and knows without any clock which of them are alone."""

    def __init__(self, interface: str) -> None:
        self._bus = SocketCanBus(interface, {"buffer": str(ENOUGH_BYTES)}, listen_only=True)
        self._batch = FrameBatch(4096)
        self._identifiers: list[npt.NDArray[np.uint32]] = []
        self._kinds: list[npt.NDArray[np.uint8]] = []

    def __enter__(self) -> Witness:
        self._bus.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.close()

    def hear(self) -> None:
        """Take what has come."""
        while self._bus.receive(self._batch, 0):
            wire = self._batch.wire[self._batch.start : self._batch.stop]
            is_data = (wire["identifier"] & 0x700) == 0x400
            self._identifiers.append(wire["identifier"][is_data])
            self._kinds.append(wire["payload"][is_data, 0])
            self._batch.clear()

    def alone(self) -> int:
        """Number of heads and tails that their board did not send next to their other half.

        A last head still waits for its tail.
        """
        self.hear()
        assert self._bus.counters.dropped == 0
        identifiers, kinds = np.concatenate(self._identifiers), np.concatenate(self._kinds)
        assert np.isin(kinds, (HEAD_BYTE, TAIL_BYTE)).all()
        alone = 0
        for board in np.unique(identifiers >> 4):
            module, is_tail = (column[identifiers >> 4 == board] for column in (identifiers, kinds == TAIL_BYTE))
            pairs = int(np.count_nonzero((module[1:] == module[:-1]) & ~is_tail[:-1] & is_tail[1:]))
            alone += len(module) - 2 * pairs - int(not is_tail[-1])
        return alone


def orphans_on_time(patches: Sequence[dict[str, Any]]) -> int:
    """Orphans but for those of a late pair: a starved emulation sent its halves too far apart."""
    return sum(patch["orphans"] - 2 * patch["late"] for patch in patches)


def test_768_sensors_at_20_hz_over_a_minute(vcan: Callable[[], str]) -> None:
    bus = vcan()
    with (
        Witness(bus) as witness,
        running("skin-emulate", "--bus", bus, "--boards", "7,8,9,10", "--pattern", "cycle") as emulator,
    ):
        emulator.wait_for("ready")
        with running("skin-driver", "--bus", f"{bus}?buffer={ENOUGH_BYTES}", "--slots", "64") as driver:
            ready = driver.wait_for("ready")
            assert (ready["sensors"], ready["modules"], ready["patches"]) == (768, 64, 4)
            with DriverReader("roboskin") as reader:
                frames = reader.in_order(timeout_s=60)
                updates, before_ns, first = 0, np.zeros(64, np.int64), next(frames).sequence
                for _ in range(MINUTE_FRAMES):
                    frame = next(frames)
                    fresh = check_no_torn_module(frame)
                    # a burst in which the emulation had no processor time makes two frames; both show the other boards
                    updates += int((fresh & (frame.module_time_ns > before_ns)).sum())
                    before_ns = frame.module_time_ns.copy()
                    witness.hear()
                assert frame.sequence - first == MINUTE_FRAMES + reader.missed  # a starved reader knows what it missed
                totals = emulator.stop()
                read_until(reader, is_silent)
            stopped = driver.stop()
        assert orphans_on_time(stopped["patches"]) == witness.alone(), stopped["patches"]
    (shown,) = stopped["buses"]
    assert shown["dropped"] == shown["bad_length"] == shown["unknown"] == shown["bad_content"] == 0
    assert totals["send_failures"] == 0
    assert 2 * updates <= shown["frames"] == totals["frames"]
    assert updates >= MINUTE_FRAMES


def test_lost_halves_are_all_known_and_nothing_torn_is_fresh(vcan: Callable[[], str], tmp_path: Path) -> None:
    bus, log = vcan(), tmp_path / "faults.jsonl"
    options = ("--boards", "7,8", "--pattern", "cycle", "--lose", "0.01", "--log", str(log))
    with Witness(bus) as witness, running("skin-emulate", "--bus", bus, *options) as emulator:
        emulator.wait_for("ready")
        with running("skin-driver", "--bus", bus, "--slots", "64") as driver:
            driver.wait_for("ready")
            with DriverReader("roboskin") as reader:
                frames = reader.in_order(timeout_s=60)
                for _ in range(100):
                    check_no_torn_module(next(frames))
                    witness.hear()
                emulator.stop()  # first: what it loses while the driver stops, nobody would count
                read_until(reader, is_silent)
            stopped = driver.stop()
        assert orphans_on_time(stopped["patches"]) == witness.alone(), stopped["patches"]
    events = [json.loads(line) for line in log.read_text().splitlines()]
    assert sum(event.get("fault") in ("lost", "unsent") for event in events) > 25


def test_a_dead_board_beside_a_living_one(vcan: Callable[[], str]) -> None:
    on_bus = ("skin-emulate", "--bus", bus := vcan(), "--boards")
    with running(*on_bus, "7") as living, running(*on_bus, "8") as mortal:
        living.wait_for("ready")
        mortal.wait_for("ready")
        with running("skin-driver", "--bus", bus) as driver, DriverReader("roboskin", timeout_s=600) as reader:
            read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE, PatchState.LIVE])
            mortal.stop()
            frame = read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE, PatchState.STALE])
            assert (frame.status[192:] & Status.STALE).all()
            wait_until(lambda: "board 8 fell silent" in driver.errors)


def test_link_down_and_up_and_interface_deleted_and_made_again(vcan: Callable[[], str]) -> None:
    bus = vcan()
    with running("skin-emulate", "--bus", bus, "--boards", "7", "--pattern", "idle") as emulator:
        emulator.wait_for("ready")
        with running("skin-driver", "--bus", bus) as driver:
            driver.wait_for("ready")
            with DriverReader("roboskin") as reader:
                frame = read_until(reader, lambda f: not f.status.any())
                ip("link", "set", bus, "down")
                read_until(reader, lambda f: f.bus_state[0] == BusState.DOWN)
                ip("link", "set", bus, "up")
                read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE and not f.status.any())
                wait_until(lambda: "is back" in driver.errors)
                assert driver.errors.count("went down") == 1  # to delete it will take it down again
                ip("link", "del", bus)
                read_until(reader, lambda f: f.bus_state[0] == BusState.GONE)
                ip("link", "add", "dev", bus, "type", "vcan")
                ip("link", "set", bus, "up")
                back = read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE and not f.status.any())
                assert back.generation == frame.generation


def test_a_killed_driver_and_its_restart_with_the_reader_kept(vcan: Callable[[], str]) -> None:
    bus = vcan()
    # idle: who is pressed while a board is set up again reads out of range once the press ends
    with running("skin-emulate", "--bus", bus, "--boards", "7,8", "--pattern", "idle") as emulator:
        emulator.wait_for("ready")
        with DriverReaderWhenItComes(bus) as (reader, driver):
            last = reader.read()
            driver.stop(signal.SIGKILL)
            assert not reader.alive
            assert reader.read().stale
            with running("skin-driver", "--bus", bus, "--boards", "7,8") as again:
                again.wait_for("ready")
                frame = reader.read(newer_than=last, timeout_s=60)
                assert frame.generation != last.generation
                read_until(reader, lambda f: not f.status.any())


class DriverReaderWhenItComes:
    """A driver on a bus and a reader that has seen a whole fresh frame of it."""

    def __init__(self, bus: str) -> None:
        self._driver = running("skin-driver", "--bus", bus, "--boards", "7,8")

    def __enter__(self) -> tuple[DriverReader, Any]:
        driver = self._driver.__enter__()
        driver.wait_for("ready")
        self._reader = DriverReader("roboskin")
        read_until(self._reader, lambda f: not f.status.any())
        return self._reader, driver

    def __exit__(self, *raised: Any) -> None:
        self._reader.close()
        self._driver.__exit__(*raised)


def test_two_controllers_at_1_mbit(can_pair: tuple[str, str]) -> None:
    with running("skin-emulate", "--bus", can_pair[0], "--boards", "7,8") as emulator:
        emulator.wait_for("ready")
        with running("skin-driver", "--bus", can_pair[1]) as driver:
            assert driver.wait_for("ready")["patches"] == 2
            with DriverReader("roboskin") as reader:
                read_until(reader, lambda f: not f.status.any())


FINGERS = 5


def fingertip_trial() -> tuple[list[list[int]], str]:
    """(slices of 5 fingers x 12 values, where from): a real trial where the data is present, else made up."""
    path = TRIALS / "full_vitamin_water_3.txt"
    if not path.exists():
        made = np.random.default_rng(1).integers(142, 256, (20, 60))
        return made.tolist(), "made up"
    slices: list[list[int]] = []
    fingers: list[int] = []
    for line in path.read_text().splitlines():
        numbers = [float(text) for text in line.split()]
        if len(numbers) == 12:
            fingers += [int(number) for number in numbers]
            if len(fingers) == 60:
                slices.append(fingers)
                fingers = []
    return slices, path.name


def replay(bus_name: str, slices: Sequence[Sequence[int]], ready: Any, read: Any) -> None:
    """Fingertips of board 1 send the slices, one per cycle; the first one until somebody reads, at the end the last."""
    from skinware_drivers.can.socketcan import SocketCanBus
    from skinware_drivers.cli.emulate import SignalWatch
    from skinware_drivers.virtual.emulation import Emulation
    from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
    from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions

    begun = itertools.count()
    slice_of: dict[int, int] = {}

    def source(_board: int, triangle: int, cycle: int, _time_ns: int) -> Sequence[int]:
        if cycle not in slice_of:
            slice_of[cycle] = min(next(begun), len(slices) - 1) if read.is_set() else 0
        values = slices[slice_of[cycle]]
        return values[12 * triangle : 12 * triangle + 12] if triangle < 5 else [240] * 12

    options = EmulatedRoboskinOptions(boards=(1,))
    hardware = EmulatedRoboskin(options, source=source)
    bus = SocketCanBus(bus_name)
    with SignalWatch() as stop:
        ready.set()
        Emulation(bus, hardware, lambda *_, **__: None).run(stop, bus_name=bus_name, driver="roboskin", options=options)


def without_repetitions(values: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
    return [one for n, one in enumerate(values) if n == 0 or one != values[n - 1]]


@pytest.mark.quick
def test_real_fingertip_data_reaches_a_reader_unchanged(vcan: Callable[[], str]) -> None:
    slices, _ = fingertip_trial()
    assert len(slices) >= 10
    expected = [[tuple(s[12 * finger : 12 * finger + 12]) for s in slices] for finger in range(FINGERS)]
    bus = vcan()
    ready, read = SPAWN.Event(), SPAWN.Event()
    emulator = SPAWN.Process(target=replay, args=(bus, slices, ready, read))
    emulator.start()
    try:
        assert ready.wait(120)
        with running("skin-driver", "--bus", bus, "--boards", "1", "--skin-type", "1", "--slots", "64") as driver:
            seen: list[list[tuple[int, ...]]] = [[] for _ in range(FINGERS)]  # what was fresh of each finger
            flagged = 0  # of a burst that this machine held up in the middle
            with DriverReader("roboskin", timeout_s=120) as reader:
                frames = reader.in_order(timeout_s=120)
                while [values[-1:] for values in seen] != [of_finger[-1:] for of_finger in expected]:
                    frame = next(frames)
                    fresh = (frame.status[: 12 * FINGERS].reshape(FINGERS, 12) == 0).all(axis=1)
                    orphans = int(reader.patch_counters(frame)[0]["orphans"])
                    if fresh.all() and not read.is_set():
                        orphans_before = orphans
                        read.set()
                    flagged += read.is_set() and not fresh.all()
                    for finger in np.flatnonzero(fresh).tolist():
                        seen[finger].append(tuple(frame.values[12 * finger : 12 * finger + 12].tolist()))
            driver.wait_for("ready")
        held_up = (orphans - orphans_before) // 10  # as a whole: no counter tells that from halves of two bursts
        for shown, sent in zip(map(without_repetitions, seen), map(without_repetitions, expected), strict=True):
            rest = iter(sent)
            assert all(values in rest for values in shown), "not in the order in which they were sent"
            assert shown[0] == sent[0]
            assert len(sent) - len(shown) <= 2 * (flagged + held_up)  # its neighbours may be equal, and shown as one
        assert frame.structure.module_kind[0] == b"fingertip"
    finally:
        if emulator.is_alive():
            os.kill(emulator.pid or 0, signal.SIGINT)
        emulator.join(60)
        emulator.close()


def test_an_interface_that_is_down_is_a_failure(vcan: Callable[[], str]) -> None:
    bus = vcan()
    ip("link", "set", bus, "down")
    result = run("skin-driver", "--bus", bus)
    assert result.returncode == 1
    assert f"ip link set {bus} up" in result.stderr
    assert run("skin-driver", "--bus", "vcan99").returncode == 1


def test_python_cans_own_socketcan_users_hear_us(vcan: Callable[[], str]) -> None:
    import can

    bus = vcan()
    with can.Bus(channel=bus, interface="socketcan") as other:
        with running("skin-emulate", "--bus", bus, "--boards", "7", "--streaming") as emulator:
            emulator.wait_for("ready")
            message = other.recv(60)
            assert message is not None
            assert message.arbitration_id >> 4 == 0x47
