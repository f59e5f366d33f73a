"""Every rule is applied once, and each command line that it advises is one that the command takes."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click
import pytest

import skinware_drivers.doctor
from skinware import Status
from skinware.bridge_state import BridgeState, ServiceState
from skinware.cli._command import exit_status
from skinware.memory.namespace import Namespace
from skinware.memory.statistics import BUCKETS, Histogram
from skinware_drivers.cli import config
from skinware_drivers.doctor.evidence import (
    BusSeen,
    Change,
    Counted,
    DriverSeen,
    Evidence,
    HealthSeen,
    NamespaceSeen,
    PatchSeen,
    ReaderSeen,
    RecordingSeen,
    TaxelFault,
)
from skinware_drivers.doctor.examining import Examination, examine
from skinware_drivers.doctor.rules import RULES, Finding, Rule
from skinware_drivers.finding.interfaces import CanInterface
from skinware_drivers.finding.ports import SerialPort, UsbIdentity, User
from skinware_drivers.finding.running import RunningDriver
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, publishing
from tests.cli.test_regions import placed_structure
from tests.commands import COMMANDS, parse, refused, running
from tests.doctor.rig import found, found_until, looked, of

_OF_OTHERS = ("docker", "du", "findmnt", "free", "ip", "journalctl", "ls", "modprobe", "pip", "ps", "rm", "sysctl",
              "usermod")  # fmt: skip


def late(bucket: int) -> Histogram:
    """Times of a second and more, all in one bucket."""
    counts = [0] * BUCKETS
    counts[bucket] = 100
    return Histogram(counts)


def counted(names: Mapping[str, object]) -> Counted:
    counts = dict.fromkeys(names, 1000) | {"frames": 1000, "unknown": 900, "updates": 1000, "sent": 3}
    return Counted(counts, counts)


def patch(name: str, bus: str, state: str, **changes: object) -> PatchSeen:
    seen = PatchSeen(name, bus, state, 12, 1, 12, 1_000_000, counted({}), Histogram(), Histogram())
    return dataclasses.replace(seen, **changes)  # type: ignore[arg-type]


def bus(name: str, state: str = "live", reason: str = "") -> BusSeen:
    losses = counted(RULES["bus-loss"])
    losses = dataclasses.replace(losses, grown={**losses.grown, "polls_late": 900})
    return BusSeen(name, state, reason, 3.0, 0.97, losses, ("unknown: 7FF",), (Change(0.0, state),))


def ill(driver: DriverSeen, name: str, kind: str) -> Iterator[DriverSeen]:
    """Drivers with everything that a driver can have, on a bus, between them."""
    reasons = [bus(name, "down", reason) for reason in RULES["reason"]]
    states = [bus(name, state) for state in ("silent", "down", "gone", "connecting")]
    away = (Change(0.0, "live"), Change(1.0, "gone"), Change(2.0, "live"))
    flapping = dataclasses.replace(bus(name), changes=away * 3)
    back = dataclasses.replace(bus(name), changes=away)
    sick = [
        patch("board 7", name, "expected", age_ns=None),
        patch("board 8", name, "stale"),
        patch("board 9", name, "restarted"),
        patch("board 10", name, "live", fresh=0),
        patch("board 11", name, "live", changes=(Change(0.0, "live"), Change(1.0, "stale"), Change(2.0, "live"))),
        patch("board 12", name, "live", counted=counted(RULES["patch-loss"])),
    ]
    twice = Counted({}, {"updates": 9000, "orphans": 9000})
    sick += [patch("board 13", name, "live", counted=twice), patch("board 14", name, "live")]
    statuses = {"fresh": 1, **dict.fromkeys(RULES["status"], 5)}
    faults = HealthSeen("skin-calm", 8, (TaxelFault("taxel 1", "stuck", "at 7"),), {"noisy": "too short"})
    times = dataclasses.replace(
        driver.timing, period_ns=10_000_000, missed=1000, age=late(BUCKETS - 2), future_ns=10**9, backwards=3,
        before_boot=3, longest_gap_s=5.0,
    )  # fmt: skip
    yield dataclasses.replace(
        driver, driver_type=kind, life="live", buses=(*reasons, *states, flapping, back), patches=tuple(sick),
        timing=times, restarts=2, statuses=statuses, lines=("row 1 of palm",), dark={"palm": 1}, health=faults,
    )  # fmt: skip
    for life in ("dead", "silent", "starting", "paused"):
        yield dataclasses.replace(driver, driver_type=kind, life=life, pid=17)


def ill_machine(seen: Evidence) -> Evidence:
    """A machine, its interfaces, ports and namespaces with everything that they can have."""
    ports = [
        SerialPort(f"/dev/ttyUSB{number}", "ftdi_sio", UsbIdentity("0403", "6001", "", "", "", "1-1", "00"), (), *may)
        for number, may in enumerate(((False, "dialout", False), (False, "dialout", True), (False, "", False)))
    ]
    ports.append(dataclasses.replace(ports[0], path="/dev/ttyACM0", may_open=True, users=(User(17, "minicom"),)))
    controllers = [
        CanInterface("can0", "can", "", False, "down", False, 10),
        CanInterface("can1", "can", "", False, "down", False, 10, 1_000_000),
        CanInterface("can2", "can", "", True, "up", False, 10, 1_000_000, state="BUS-OFF"),
        CanInterface("can3", "can", "", True, "up", False, 10, 1_000_000, state="ERROR-PASSIVE"),
    ]
    states = {"weak": ServiceState("live", "pull", 10.0, 9, 1.0, 1e6, 1e6, 50.0)}
    return dataclasses.replace(
        seen,
        machine=dataclasses.replace(
            seen.machine, memory_bytes=100, memory_available_bytes=0,
            shared_bytes=100, shared_free_bytes=0, shared_problem="read-only", softnet_dropped=9, clock_set_s=9.0,
        ),
        files=NamespaceSeen("mine", "/dev/shm/skinware.mine", "others may write it", ("a.ring: bad",), (), ("a", "b")),
        interfaces=tuple((one, counted(RULES["drop"])) for one in controllers),
        ports=tuple(ports),
        readers=(ReaderSeen("python3", 17, "torso", 5, 9),),
        bridges=(BridgeState("icub", False, 0, None, None, 0, states, "1", "", 2, 3, 4, "nonsense"),),
        waiting=(18,),
    )  # fmt: skip


def ill_recording(seen: Evidence) -> Evidence:
    events = {"unreadable": 3}
    walk = RecordingSeen("my walk.mcap", 9, 9.0, False, ("a chunk",), (), 3, events, ((1.0, 60.0),), 2, "skinware")
    return dataclasses.replace(seen, recording=walk, namespace="")


@pytest.fixture
def everything() -> list[Examination]:
    """The findings with every fault, live and recorded, with drivers of several types and buses."""
    structure = placed_structure()
    assert structure.geometry is not None
    structure.geometry.position_m[1], structure.geometry.position_m[5] = structure.geometry.position_m[0], float("nan")
    with publishing(FakeSkin("torso", structure)):
        seen = looked(0.0)
    names = {"can0": "roboskin", "can1?bitrate=500000": "xela", "/dev/ttyUSB0?baud=9600": "paxini",
             "modbus:tcp://10.0.0.2?unit=2": "inspire", "udp_multicast:239.0.0.1?port=5000&lose=1": "roboskin",
             "serial:?serial_number=A50285BI": "anyskin", "virtual?boards=7": "roboskin", "tcp://hand:5000": "tesollo",
             "replay:walk.cap": "roboskin", "websocket:ws://hand:5000": "not_installed"}  # fmt: skip
    drivers = tuple(one for name, kind in names.items() for one in ill(seen.drivers[0], name, kind))
    others = tuple(RunningDriver("leg", "lab", "roboskin", 5, (name,)) for name in names)
    here = tuple(RunningDriver("torso", drivers[0].namespace, "roboskin", 6, (name,)) for name in names)
    bad = dataclasses.replace(ill_machine(seen), seconds=3.0, running=(*others, *here))
    live = dataclasses.replace(bad, drivers=drivers)
    return [examine(one) for one in (live, bad, dataclasses.replace(bad, drivers=()), ill_recording(live))]


def rules() -> list[Rule]:
    return [rule for of_kind in RULES.values() for rule in of_kind.values()]


@pytest.fixture
def applied(monkeypatch: pytest.MonkeyPatch) -> list[Rule]:
    """The rules that made findings so far."""
    noted: list[Rule] = []
    found_by = Rule.found

    def note(rule: Rule, *arguments: Any, **named: Any) -> Finding:
        noted.append(rule)
        return found_by(rule, *arguments, **named)

    monkeypatch.setattr(Rule, "found", note)
    return noted


@pytest.mark.thorough
def test_every_rule_makes_a_finding_here(applied: list[Rule], everything: list[Examination]) -> None:
    assert len(rules()) > 60
    assert [rule.what for rule in rules() if rule not in applied] == []


def test_findings_come_from_rules() -> None:
    """Only the advice on an interface is made by the interface itself."""
    folder = Path(skinware_drivers.doctor.__file__).parent
    texts = {path.stem: path.read_text() for path in folder.glob("*.py")}
    assert {name for name, text in texts.items() if "yield Finding(" in text} == {"machine"}


def advised(everything: list[Examination]) -> set[str]:
    of_findings = {command for one in everything for note in one.findings for command in note.commands}
    return of_findings | {command for one in everything for note in one.not_looked for command in note.commands}


@pytest.mark.thorough
def test_every_advised_command_line_is_one_that_its_command_takes(
    everything: list[Examination], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "skin.toml").touch()
    commands = advised(everything)
    problems = []
    for line in sorted(commands):
        program, *arguments = shlex.split(line.removeprefix("sudo "))
        if program not in COMMANDS:
            assert program in _OF_OTHERS, line
            continue
        try:
            parse(program, *arguments)
        except click.UsageError as error:
            problems.append(f"{line}: {error.format_message()}")
    assert problems == []
    assert len([line for line in commands if line.startswith("skin-")]) > 20


@pytest.mark.thorough
def test_no_advice_removes_folders_or_has_gaps(everything: list[Examination]) -> None:
    lines = advised(everything)
    assert [line for line in lines if "rm -" in line or "..." in line or "{" in line] == []


@pytest.mark.thorough
def test_buses_are_named_as_they_are_found(everything: list[Examination]) -> None:
    lines = advised(everything)
    assert {line for line in lines if line.startswith("skin-find ") and "udev" not in line} == {
        "skin-find can0", "skin-find can1", "skin-find /dev/ttyUSB0", "skin-find modbus:tcp://10.0.0.2",
        "skin-find 'udp_multicast:239.0.0.1?port=5000'", "skin-find 'serial:?serial_number=A50285BI'",
        "skin-find tcp://hand:5000", "skin-find websocket:ws://hand:5000",
    }  # fmt: skip


@pytest.mark.thorough
def test_operations_are_advised_of_drivers_that_have_them(everything: list[Examination]) -> None:
    readdressing = [line for line in advised(everything) if "set_address" in line]
    assert readdressing
    assert all("can0" in line or "239.0.0.1" in line for line in readdressing)
    with publishing(FakeSkin("torso", driver_type="paxini")) as skin:
        skin.status[:5] = Status.SUSPECT
        doubtful = found_until(of("taxels", "doubtful"), seconds=0.1)
    assert doubtful.commands == ("skin-info torso",)


@pytest.mark.parametrize(("late", "is_silent"), [(999, True), (1000, False)])
def test_late_answers_are_not_called_missing(late: int, is_silent: bool) -> None:
    with publishing(FakeSkin("torso")):
        seen = looked(0.0)
    counts = {"frames": 1000, "polls_unanswered": 1000, "polls_late": late}
    slow = dataclasses.replace(bus("/dev/ttyUSB0"), counted=Counted(counts, counts))
    evidence = dataclasses.replace(seen, drivers=(dataclasses.replace(seen.drivers[0], buses=(slow,)),))
    faults = [finding.what for finding in examine(evidence).findings]
    assert "answers of devices came after their timeout" in faults
    assert ("devices did not answer" in faults) == is_silent


def test_advice_reaches_the_namespace_that_was_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    skin = FakeSkin("torso")
    skin.break_some()
    with publishing(skin):
        seen = looked(0.1)
        here = advised([examine(seen)])
        monkeypatch.setenv("SKINWARE_NAMESPACE", "another")
        elsewhere = advised([examine(seen)])
        assert not [line for line in here if "--namespace" in line]
        followers = [line for line in elsewhere if line.startswith(("skin-info", "skin-config", "skin-top"))]
        assert followers
        assert all(line.endswith(f" --namespace {seen.namespace}") for line in followers)
        for line in [one for one in followers if one.startswith("skin-info")]:
            assert refused(*shlex.split(line)).returncode == 0, line


@pytest.mark.thorough
def test_rebaseline_mends_doubtful_taxels(alone: Path, namespace: Namespace) -> None:
    (alone / namespace.path.name).rmdir()
    (alone / namespace.path.name).symlink_to(namespace.path)
    bus_name = "virtual?boards=7&no_ack=7/2&no_ack_after_cycles=1&pattern=idle"
    with running("skin-driver", "--bus", bus_name, "--name", "torso"):
        doubtful = found_until(of("taxels", "doubtful"))
        assert doubtful.commands == ("skin-config torso rebaseline",)
        program, *arguments = shlex.split(doubtful.commands[0])
        assert program == "skin-config"
        assert exit_status(config.command, [*arguments, "--yes"]) == 0
        wait_until(lambda: not [one for one in found() if of("taxels", "doubtful")(one)])
