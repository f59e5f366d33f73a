"""``skin-config``: through the running driver where there is one, itself where there is none."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest

from skinware import Namespace
from skinware.cli._command import exit_status
from skinware_drivers import registry
from skinware_drivers.can import roboskin, roboskin_setup
from skinware_drivers.cli.config import command
from skinware_drivers.finding import running, without_driver
from skinware_drivers.finding.running import RunningDriver, driver_on, running_drivers, same_bus
from skinware_drivers.virtual.hardware import Event
from tests.finding.fakes import see_only
from tests.sdk.driving import commands, driving, emulated

VIRTUAL = "virtual?boards=7,8"


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch, namespace: Namespace, tmp_path_factory: pytest.TempPathFactory) -> None:
    see_only(namespace, tmp_path_factory.mktemp("shm"), monkeypatch)
    monkeypatch.setattr(roboskin, "_AFTER_CONFIGURATION_S", 0.05)
    monkeypatch.setattr(roboskin_setup, "_DISCOVERY_S", 0.1)
    monkeypatch.setattr(without_driver, "_LISTEN_S", 0.1)


@pytest.fixture
def person(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Somebody at a terminal, who answers with what the test puts here; True if nothing is left."""
    answers: list[bool] = []
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr(click, "confirm", lambda *_, **__: answers.pop(0) if answers else True)
    return answers


def configured(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> str:
    assert exit_status(command, arguments) == status
    printed = capsys.readouterr()
    return printed.out if status == 0 else printed.err


def configured_data(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(configured(capsys, *arguments, "--json"))
    return data


def test_what_can_be_done_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    text = configured(capsys, VIRTUAL)
    assert "rate: Change how often" in text
    assert "Takes hz: float" in text
    assert "set_address: Give one board" in text
    with driving(emulated(boards=(7,))):
        data = configured_data(capsys, "roboskin")
    assert data["operations"].keys() == {"enable", "rate", "rebaseline", "versions"}
    assert data["driver"]["name"] == "roboskin"


def test_a_bus_without_driver_is_asked_and_set_up(capsys: pytest.CaptureFixture[str]) -> None:
    text = configured(capsys, VIRTUAL, "versions")
    assert text.splitlines()[1] == "  7: type mtb4, runs application, firmware 1.25.0, protocol 2.0"
    data = configured_data(capsys, VIRTUAL, "set_address", "address=9", "patch=board 7", "--yes")
    assert data["results"][VIRTUAL]["is"] == 9
    assert data["driver"] is None
    assert configured(capsys, VIRTUAL, "rebaseline", "--yes") == f"{VIRTUAL}: done\n"


def test_options_come_from_the_command_line_and_a_file(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "torso.toml"
    path.write_text(f'[[bus]]\nname = "{VIRTUAL}"\noptions = {{ boards = [8, 9] }}\n')
    text = configured(capsys, VIRTUAL, "versions", "--config", str(path))
    assert "8: type mtb4" in text
    assert "9: no answer" in text
    assert "7:" not in text
    assert "7: type" in configured(capsys, VIRTUAL, "versions", "--config", str(path), "--option", "boards=7")


def test_a_person_is_asked_before_anything_is_changed(capsys: pytest.CaptureFixture[str], person: list[bool]) -> None:
    person.append(False)
    assert "nothing was changed" in configured(capsys, VIRTUAL, "rebaseline", status=1)
    configured(capsys, VIRTUAL, "rebaseline")
    log: list[Event] = []
    with driving(emulated(log, boards=(7,))):
        before = len(commands(log))
        person.append(False)
        assert "nothing was changed" in configured(capsys, "roboskin", "rebaseline", status=1)
        assert len(commands(log)) == before
        assert configured(capsys, "roboskin", "rebaseline") == "bus0: done\n"
        assert len(commands(log)) == before + 3


def test_a_script_must_say_yes(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    assert "add --yes" in configured(capsys, VIRTUAL, "rebaseline", status=2)
    assert "type mtb4" in configured(capsys, VIRTUAL, "versions")


def test_a_running_drivers_bus_is_set_up_through_the_driver(capsys: pytest.CaptureFixture[str]) -> None:
    log: list[Event] = []
    with driving(emulated(log, boards=(7, 8)), emulated(boards=(9,))):
        before = len(commands(log))
        data = configured_data(capsys, "bus0", "rebaseline", "patch=board 8", "--yes")
        assert data["results"] == {"bus0": None}
        assert {identifier for _, identifier, _ in commands(log)[before:]} == {0x208}
        assert configured_data(capsys, "roboskin", "rate", "hz=50", "--yes")["results"] == {"bus0": 50.0, "bus1": 50.0}
        assert configured_data(capsys, "bus1", "versions")["results"]["bus1"].keys() == {"9"}


def test_the_drivers_namespace_does_not_hide_it(capsys: pytest.CaptureFixture[str], namespace: Namespace) -> None:
    with driving(emulated(boards=(7,))):
        data = configured_data(capsys, "bus0", "versions", "--namespace", "elsewhere")
        assert data["driver"]["namespace"] == namespace.name
        text = configured(capsys, "roboskin", "versions", "--namespace", "elsewhere", status=1)
        assert "no driver 'roboskin' runs in namespace 'elsewhere'" in text


def test_what_needs_the_bus_alone_is_refused_while_a_driver_runs(capsys: pytest.CaptureFixture[str]) -> None:
    with driving(emulated(boards=(7,))):
        text = configured(capsys, "bus0", "set_address", "address=9", "--yes", status=2)
        assert "set_address needs the bus without a driver: end driver 'roboskin'" in text
        assert "do not apply" in configured(capsys, "bus0", "versions", "--force", status=2)
        assert "did you mean 'rebaseline'" in configured(capsys, "bus0", "rebasline", status=2)


def test_a_driver_that_starts_while_a_person_thinks_is_noticed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    late = RunningDriver("torso", "default", "roboskin", 1, ("can0",))
    monkeypatch.setattr(registry, "make_bus", lambda *_, **__: emulated(boards=(7,)))
    looks: list[list[RunningDriver]] = [[], [late]]
    monkeypatch.setattr(running, "running_drivers", lambda: looks.pop(0))
    assert "was started meanwhile; nothing was changed" in configured(capsys, "can0", "rebaseline", "--yes", status=2)


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        ([VIRTUAL, "nonsense"], 2, "no operation 'nonsense'"),
        (["rebaseline"], 2, "rebaseline is an operation: name the driver or the bus before it"),
        ([VIRTUAL, "rate", "50"], 2, "KEY=VALUE"),
        ([VIRTUAL, "rate", "hz=50", "pace=3", "--yes"], 2, "it takes: bus, patch, hz"),
        ([VIRTUAL, "rate", "hz=0", "--yes"], 2, "3.93 to 1000 Hz"),
        ([VIRTUAL, "versions", "--driver", "robskin"], 2, "did you mean 'roboskin'"),
        ([VIRTUAL, "versions", "--option", "boards"], 2, "KEY=VALUE"),
        ([VIRTUAL, "versions", "--option", "board=7"], 2, "did you mean 'boards'"),
        (["virtual?boards=7&streaming=yes", "rebaseline", "--yes"], 2, "another program may be using the bus"),
        (["torso", "versions"], 1, "no driver 'torso' runs in namespace"),
        (["torso", "--driver", "xela"], 1, "no bus has this name either"),
        ([VIRTUAL, "versions", "--config", "/no/such.toml"], 2, "/no/such.toml"),
    ],
)
def test_mistakes_get_one_clear_line_and_the_right_exit_code(
    capsys: pytest.CaptureFixture[str], arguments: list[str], status: int, words: str
) -> None:
    text = configured(capsys, *arguments, status=status)
    assert words in text
    assert "Traceback" not in text


def test_the_nearest_driver_is_proposed_before_any_operation_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    with driving(emulated(boards=(7,))):
        assert "did you mean 'roboskin'" in configured(capsys, "robskin", status=1)
        assert "did you mean 'roboskin'" in configured(capsys, "robskin", "versions", status=1)


def test_running_drivers_are_those_that_live(namespace: Namespace) -> None:
    with driving(emulated(boards=(7,))):
        (found,) = [one for one in running_drivers() if one.namespace == namespace.name]
        assert (found.name, found.driver_type, found.buses) == ("roboskin", "roboskin", ("bus0",))
        assert driver_on("socketcan:bus0", [found]) is found
        assert driver_on("bus1", [found]) is None
    assert [one for one in running_drivers() if one.namespace == namespace.name] == []


def test_buses_are_the_same_under_all_their_names(tmp_path: Path) -> None:
    assert same_bus("can0", "socketcan:can0?buffer=100")
    assert not same_bus("can0", "can1")
    assert not same_bus("virtual", "virtual")
    assert same_bus("slcan:/dev/ttyACM0?bitrate=1", "slcan:/dev/ttyACM0")
    assert same_bus("serial:?serial_number=A1&baudrate=9600", "serial:?serial_number=A1")
    assert not same_bus("serial:?serial_number=A1", "serial:?serial_number=B2")
    assert same_bus("serial?serial_number=A1", "serial:?serial_number=A1")
    assert not same_bus("serial?serial_number=A1", "serial?serial_number=B2")
    assert not same_bus("udp_multicast:239.0.0.1?port=43113", "udp_multicast:239.0.0.1?port=43114")
    assert same_bus("udp_multicast:239.0.0.1?port=43113&fd=true", "udp_multicast:239.0.0.1")
    assert not same_bus("socketcand:can0?host=a&port=29536", "socketcand:can0?host=b&port=29536")


def test_a_serial_line_is_where_its_device_is_plugged_in(monkeypatch: pytest.MonkeyPatch) -> None:
    plugged_in = [
        SimpleNamespace(device="/dev/ttyUSB0", serial_number="A1", vid=0x0403, pid=0x6001, description=""),
        SimpleNamespace(device="/dev/ttyUSB1", serial_number="B2", vid=0x0403, pid=0x6001, description=""),
        SimpleNamespace(device="/dev/ttyACM0", serial_number=None, vid=0x0483, pid=0x5740, description=""),
    ]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: plugged_in)
    assert same_bus("/dev/ttyUSB0", "serial:?serial_number=A1")
    assert same_bus("serial?serial_number=A1&baudrate=9600", "serial:/dev/ttyUSB0?baudrate=115200")
    assert same_bus("serial?serial_number=A1&vid_pid=0403:6001", "serial?serial_number=A1")
    assert same_bus("serial?vid_pid=0483:5740", "/dev/ttyACM0")
    assert not same_bus("/dev/ttyUSB1", "serial:?serial_number=A1")
    assert not same_bus("serial?serial_number=A1", "serial?serial_number=B2")
    assert not same_bus("serial?vid_pid=0403:6001", "/dev/ttyUSB0")  # it may be the other one
    assert not same_bus("serial?serial_number=C3", "/dev/ttyUSB0")
    assert not same_bus("serial", "/dev/ttyUSB0")
