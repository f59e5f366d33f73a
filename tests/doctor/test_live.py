"""``skin-doctor`` with running drivers: it finds each fault that was made, and no others."""

from __future__ import annotations

import dataclasses
import itertools
import os
import signal
import threading
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest

from skinware import BusReason, BusState, DriverWriter, Namespace, Status
from skinware.realtime import now_ns
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.rules import Finding, Severity
from skinware_drivers.finding.running import RunningDriver
from skinware_drivers.testing.driving import EmulatedSkin, emulated_skin
from skinware_drivers.testing.waiting import read_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import EmulatedHardware, WireFrame
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill, publishing
from tests.cli.test_regions import placed_structure
from tests.cli.test_sensor_health import looked_after
from tests.doctor.rig import found, found_until, looked, nothing_found, of
from tests.sdk.driving import driving, emulated

Skins = Callable[..., EmulatedSkin]
DRIVERS = sorted(entry_points(group="skinware.drivers").names)


@pytest.mark.thorough
@pytest.mark.timeout(150)
@pytest.mark.parametrize("driver", DRIVERS)
def test_nothing_is_wrong_with_emulated_hardware(driver: str) -> None:
    def run_and_look() -> Sequence[Finding]:
        with emulated_skin(driver):
            return found()

    nothing_found(run_and_look)


def test_what_was_looked_at_and_what_could_not_be_is_told(skins: Skins) -> None:
    skins("roboskin", boards=(7,))
    told = examine(looked())
    assert {one.area for one in told.looked} == {
        "interfaces", "permissions", "buses", "patches", "timing", "taxels", "files", "machine"
    }  # fmt: skip
    versions = next(one.seen for one in told.looked if one.what == "versions here")
    assert all(name in versions for name in ("skinware 0.1.0", "Python 3", "numpy ", "Linux "))
    not_looked = {one.what: one for one in told.not_looked}
    by_strokes = not_looked["exchanged or mirrored modules of skin"].commands
    assert "skin-calibrate check skin.toml skin" in by_strokes
    assert "these were" in not_looked["stuck taxels of skin"].why


def test_no_driver_at_all_or_one_that_began_too_late(namespace: Namespace) -> None:
    late = RunningDriver("arm", namespace.name, "roboskin", 5, ())
    (finding,) = examine(dataclasses.replace(looked(0.0), running=(late,))).findings
    assert f"; running now: driver 'arm' (namespace {namespace.name}, pid 5)" in finding.evidence
    (finding,) = found(0.0)
    assert (finding.area, finding.severity) == ("timing", Severity.ERROR)
    assert finding.what == "no driver has published anything"
    assert "skin-find" in finding.commands


# -- boards ---------------------------------------------------------------------------------------------------------


def test_a_board_that_dies(skins: Skins) -> None:
    skins("roboskin", boards=(7, 8), dead=(8,))
    finding = found_until(of("patches", "board 8 fell silent"))
    assert (finding.severity, finding.see) == (Severity.ERROR, "reference/faults.md#patches")
    assert "1 of 2 patches are live" in finding.evidence
    assert finding.commands == ("skin-info skin", "skin-find bus0")  # the type of the driver is unknown


def test_a_board_that_never_answered() -> None:
    with driving(emulated(boards=(7,)), boards=(7, 8)):
        finding = found_until(of("patches", "board 8 never answered"))
    assert finding.severity == Severity.ERROR
    assert finding.evidence == "state expected, no data of its 192 sensors; 1 of 2 patches are live"


class _TwoWithOneAddress:
    """Two boards with address 7 beside board 8, each with a clock of its own; the host hears all."""

    def __init__(self) -> None:
        self._boards = [EmulatedRoboskin(EmulatedRoboskinOptions(boards=boards)) for boards in ((7, 8), (7,))]
        self._later_ns = 23_000_000

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        for number, boards in enumerate(self._boards):
            boards.receive(identifier, payload, now_ns - number * self._later_ns)

    def next_due_ns(self) -> int | None:
        due = [one for number, boards in enumerate(self._boards) if (one := self._due(boards, number)) is not None]
        return min(due, default=None)

    def emit(self, now_ns: int) -> list[WireFrame]:
        frames = [frame for boards in self._boards[:1] for frame in boards.emit(now_ns)]
        return frames + self._boards[1].emit(now_ns - self._later_ns)

    def skip(self, now_ns: int) -> int:
        return sum(boards.skip(now_ns - number * self._later_ns) for number, boards in enumerate(self._boards))

    def totals(self) -> dict[str, int]:
        return self._boards[0].totals()

    def _due(self, boards: EmulatedHardware, number: int) -> int | None:
        due = boards.next_due_ns()
        return None if due is None else due + number * self._later_ns


def test_two_boards_with_one_address() -> None:
    bus = VirtualCanBus("", hardware=_TwoWithOneAddress())
    with driving(bus):
        finding = found_until(of("patches", "two boards with one address"), seconds=1.5)
    assert finding.what.startswith("board 7 sends ")
    assert finding.severity == Severity.ERROR
    assert finding.evidence.endswith(" are due")


def test_what_the_hardware_says_of_its_taxels(skins: Skins) -> None:
    faults = {"not_connected": ("7/1",), "out_of_range": ("7/3/5",)}
    skins("roboskin", boards=(7,), pattern="idle", **faults)
    finding = found_until(of("taxels", "are not connected"))
    assert finding.what.startswith("12 sensors")
    assert finding.severity == Severity.ERROR
    assert "board 7, triangle 1, taxel 0" in finding.evidence
    broken = found_until(of("taxels", "beyond"))
    assert broken.evidence == "status out of range: board 7, triangle 3, taxel 5"


def test_a_board_that_moves_its_baseline_because_a_triangle_does_not_acknowledge(skins: Skins) -> None:
    skins("roboskin", boards=(7,), pattern="idle", no_ack=("7/2",), no_ack_after_cycles=1)
    finding = found_until(of("taxels", "doubtful"))
    assert finding.what.startswith("192 sensors")
    assert finding.commands == ("skin-info skin",)  # the type of the driver is unknown


@pytest.mark.parametrize("status", [Status.NO_ACK, Status.NOT_CONNECTED, Status.OUT_OF_RANGE, Status.SUSPECT])
def test_every_status_of_a_sensor_is_told(status: Status) -> None:
    skin = FakeSkin()
    skin.status[20:22] = status
    with publishing(skin):
        finding = found_until(lambda one: one.area == "taxels", seconds=0.1)
    assert finding.what.startswith("2 sensors are ") or finding.what.startswith("2 sensors do not answer")
    assert finding.evidence.startswith(f"status {str(status.name).lower().replace('_', ' ')}: board 7, triangle 1")


@pytest.mark.thorough
def test_frames_without_partners_and_foreign_ones(skins: Skins) -> None:
    skin = skins("roboskin", boards=(7, 8), lose=0.1, truncate=0.1, foreign_hz=500.0)
    lost = found_until(of("patches", "without their partners"))
    assert lost.severity == Severity.WARNING
    assert "board 7: " in lost.evidence
    assert "beside" in lost.evidence
    assert found_until(of("buses", "another length")).severity == Severity.WARNING
    foreign = found_until(of("buses", "other devices"))
    assert foreign.severity == Severity.NOTE
    assert "such as" in foreign.evidence
    assert skin.driver.failure is None


def test_what_skin_calm_says_of_taxels(namespace: Namespace) -> None:
    with looked_after(namespace):
        seen = looked(0.1)
    told = examine(seen)
    findings = {one.what: one.evidence for one in told.findings if one.area == "taxels"}
    assert findings == {
        "1 taxel is stuck": "board 7, triangle 0, taxel 5: at 73 counts for 700 s, while its module was touched"
        " (judged by skin-calm)",
        "1 taxel is noisy": "board 7, triangle 1, taxel 7: noise 6 counts, 7.5 times that of the others"
        " (judged by skin-calm)",
    }
    assert "nothing has touched 2 of 640 so far" in {one.why for one in told.not_looked}


def test_places_that_are_shared_or_missing() -> None:
    structure = placed_structure()
    assert structure.geometry is not None
    position = structure.geometry.position_m
    position[1], position[5] = position[0], np.nan
    with publishing(FakeSkin("torso", structure)):
        told = {one.what: one for one in found() if one.area == "taxels"}
    assert told["2 sensors are at places of others"].severity == Severity.WARNING
    assert told["1 sensor has no place"].severity == Severity.NOTE
    assert "triangle 0" in told["2 sensors are at places of others"].evidence
    assert "skin-calibrate check skin.toml torso" in told["1 sensor has no place"].commands


# -- buses ----------------------------------------------------------------------------------------------------------


def test_a_bus_that_is_unplugged_and_comes_back(skins: Skins) -> None:
    skin = skins("roboskin", boards=(7,))
    assert isinstance(skin.bus, VirtualCanBus)
    skin.driver.do(skin.bus.vanish)
    read_until(skin.reader, lambda frame: int(frame.bus_state[0]) in (BusState.DOWN, BusState.GONE))
    away = found_until(lambda finding: finding.area == "buses" and finding.severity == Severity.ERROR)
    assert away.where == "driver skin, bus bus0"
    assert away.see == "troubleshooting.md#a-bus-has-a-problem"


@pytest.mark.parametrize("reason", [one for one in BusReason if one not in (BusReason.NONE, BusReason.REMOVED)])
def test_every_reason_of_a_bus_is_told_with_what_to_do(reason: BusReason) -> None:
    skin = FakeSkin()
    skin.bus_reason[0] = reason
    with publishing(skin):
        finding = found_until(lambda one: one.area == "buses", seconds=0.1)
    assert reason.name.lower().replace("_", "-") in finding.evidence
    assert finding.action
    assert not any("{" in command for command in finding.commands)


class _Failing(FakeSkin):
    """Its bus is full, loses frames, and comes and goes."""

    def publish(self, count: int = 1) -> None:
        if self.writer.sequence % 5 == 0:
            self.bus_state[0] = BusState.GONE if self.bus_state[0] == BusState.LIVE else BusState.LIVE
        self.bus_load[0] = 930
        self.bus_counters[0] += np.array([100, 3, 1, 0], np.uint64)
        super().publish(count)


def test_a_bus_that_is_full_loses_frames_and_comes_and_goes() -> None:
    with publishing(_Failing()):
        found_until(of("buses", "it comes and goes"))
        told = {one.what: one for one in found()}
    assert told["the wire is nearly full"].severity == Severity.ERROR
    assert "load 93 %" in told["the wire is nearly full"].evidence
    lost = told["frames were dropped before the driver took them"]
    assert lost.severity == Severity.ERROR
    assert "machine load" in lost.evidence


def test_losses_before_somebody_looked_are_no_more_than_a_note() -> None:
    skin = FakeSkin()
    skin.bus_counters[0] = (5156, 2, 0, 0)
    skin.patch_counters[0] = (30, 640)
    with publishing(skin):
        told = {one.what: one for one in found()}
    lost = told["frames were dropped before the driver took them"]
    assert (lost.severity, lost.evidence.partition(";")[0]) == (
        Severity.NOTE,
        "2 frames since the driver was started, none in these 400 ms",
    )
    assert told["frames came without their partners, whose update was not shown"].severity == Severity.NOTE


def test_two_drivers_on_one_bus(alone: Path, namespace: Namespace) -> None:
    (alone / namespace.path.name).rmdir()
    (alone / namespace.path.name).symlink_to(namespace.path)  # now they are seen to run
    with publishing(FakeSkin("arm", fake_structure(1))), publishing(FakeSkin("leg", fake_structure(1))):
        findings = [one for one in found() if "two drivers" in one.what]
    assert len(findings) == 1
    assert findings[0].commands == ("skin-driver --bus can0 --listen-only",)


# -- programs -------------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_driver_that_was_killed_stopped_or_restarted() -> None:
    with fake_process("torso") as process:
        os.kill(process.pid, signal.SIGSTOP)
        try:
            silent = found_until(of("timing", "publishes nothing"))
        finally:
            os.kill(process.pid, signal.SIGCONT)
        assert silent.commands == (f"ps -o pid,stat,wchan:20,args -p {process.pid}",)
        kill(process)
        dead = found_until(of("timing", "was killed"))
        assert dead.severity == Severity.ERROR
        assert f"pid {process.pid} is gone" in dead.evidence
        with fake_process("arm") as other:
            kill(other)
            assert {one.where for one in found() if of("timing", "was killed")(one)} == {"driver arm", "driver torso"}


def test_a_paused_driver() -> None:
    with FakeSkin() as skin:
        skin.publish()
        skin.writer.pause()
        assert found_until(of("timing", "is paused"), seconds=0.0).severity == Severity.NOTE


def test_files_that_are_damaged_and_a_namespace_that_cannot_be_trusted(namespace: Namespace) -> None:
    with publishing(FakeSkin()):
        (namespace.path / "broken.ring").write_bytes(b"x")
        damaged = found_until(of("files", "cannot be read"))
        (namespace.path / "broken.ring").unlink()
        assert "broken.ring" in damaged.evidence
        namespace.path.chmod(0o777)
        try:
            refused = found_until(of("permissions", "cannot be read"))
        finally:
            namespace.path.chmod(0o2750)
    assert "chmod 2750" in refused.evidence
    assert refused.severity == Severity.ERROR


def test_times_that_cannot_be() -> None:
    structure = fake_structure(1, 2)
    with publishing(FakeSkin("calm", structure)), DriverWriter("torso", structure) as writer:
        stop = threading.Event()

        def publish() -> None:
            for ahead_ns in itertools.cycle((5_000_000_000, 0)):
                columns = writer.begin()
                columns["module_time_ns"][:] = now_ns() + ahead_ns
                writer.commit(now_ns())
                if stop.wait(0.01):
                    return

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            ahead = found_until(of("timing", "later than it was published"))
            back = found_until(of("timing", "went backwards"))
        finally:
            stop.set()
            thread.join()
    assert ahead.where == back.where == "driver torso"
    assert ahead.evidence.startswith("by up to 5.0 s")


def test_a_driver_that_is_late() -> None:
    """Without processor time, its periods begin late, and its data is old when it is published."""
    skin = FakeSkin()
    with publishing(skin, rate_hz=50) as late:
        commit = late.writer.commit

        def commit_late(acquired_ns: int, flags: int = 0) -> int:
            return commit(acquired_ns - 2_000_000_000, flags)

        late.writer.commit = commit_late  # type: ignore[method-assign]
        finding = found_until(of("timing", "old when it is published"))
    assert "machine load" in finding.evidence
    assert "period" in finding.evidence
