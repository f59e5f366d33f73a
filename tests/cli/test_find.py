"""What ``skin-find`` prints, for people and for programs, and how it ends."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from skinware import Namespace
from skinware.cli._command import exit_status
from skinware_drivers.can import roboskin_setup
from skinware_drivers.cli.find import as_text, command
from skinware_drivers.finding import interfaces, ports
from skinware_drivers.finding.interfaces import CanInterface
from skinware_drivers.finding.ports import SerialPort, UsbIdentity, User
from skinware_drivers.streams.dds import HeardTopic
from skinware_drivers.testing.driving import emulated_on_a_pty
from tests.commands import running
from tests.finding.fakes import see_only
from tests.sdk.driving import driving, emulated

STREAMING = "virtual?boards=7,8&streaming=yes"
LISTEN = ("-T", "0.2")
COUNTS = dict.fromkeys(interfaces._STATISTICS, 0) | {"rx_packets": 12345, "rx_errors": 7}
CAN0 = CanInterface("can0", "can", "peak_usb", False, "down", is_fd=True, queue_length=10, statistics=COUNTS)
FTDI = UsbIdentity("0403", "6001", "A50285BI", "FTDI", "FT232R USB UART", "1-1.2", "00")
TTY = SerialPort("/dev/ttyUSB0", "ftdi_sio", FTDI, ("/dev/skin/A50285BI",), False, "dialout", False, latency_ms=16)


@pytest.fixture(autouse=True)
def machine(
    monkeypatch: pytest.MonkeyPatch, namespace: Namespace, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., None]:
    """A machine of the test's making; nothing is plugged in at first."""
    see_only(namespace, tmp_path_factory.mktemp("shm"), monkeypatch)

    def make(
        can: list[CanInterface] | None = None,
        tty: list[SerialPort] | None = None,
        kernel_has_can: bool = True,
    ) -> None:
        monkeypatch.setattr(interfaces, "can_interfaces", lambda: can or [])
        monkeypatch.setattr(interfaces, "kernel_has_can", lambda: kernel_has_can)
        monkeypatch.setattr(ports, "serial_ports", lambda: tty or [])

    monkeypatch.setattr(roboskin_setup, "_DISCOVERY_S", 0.1)
    make()
    return make


def found(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> str:
    assert exit_status(command, [*LISTEN, *arguments]) == status
    return capsys.readouterr().out


def found_data(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(found(capsys, *arguments, "--json"), parse_constant=pytest.fail)
    return data


def fits(text: str) -> bool:
    """80 columns, except for commands that are to be copied, and what has no blank."""
    return all(
        len(line) <= 80 or line.lstrip().startswith("sudo ") or " " not in line.strip() for line in text.splitlines()
    )


def test_an_empty_machine_is_told_what_to_do(capsys: pytest.CaptureFixture[str], machine: Callable[..., None]) -> None:
    text = found(capsys)
    assert "no CAN interface" in text
    assert "      sudo modprobe vcan\n      sudo ip link add dev vcan0 type vcan" in text
    assert "no serial port" in text
    machine(kernel_has_can=False)
    assert "this kernel has no CAN" in found(capsys)
    assert found_data(capsys)["can"]["in_kernel"] is False


def test_a_machine_with_everything(capsys: pytest.CaptureFixture[str], machine: Callable[..., None]) -> None:
    up = dataclasses.replace(
        CAN0, name="can1", bit_rate=500_000, data_bit_rate=2_000_000, state="BUS-OFF", restart_ms=0
    )
    machine([CAN0, up], [TTY])
    text = found(capsys)
    assert fits(text), text
    for words in (
        "can0  down, kernel driver peak_usb, no bit rate known",
        "      sudo ip link set can0 type can bitrate 1000000 restart-ms 100\n      sudo ip link set can0 up",
        "500 kbit/s, data 2000 kbit/s, bus-off",
        "received 12,345, sent 0, rx errors 7",
        "/dev/ttyUSB0  FTDI FT232R USB UART, 0403:6001, serial number A50285BI,",
        "  /dev/skin/A50285BI",
        "whether a program of another user has it open is not known",
        "sudo usermod -aG dialout $USER",
        "holds data back for up to 16 ms",
    ):
        assert words in text
    data = found_data(capsys)
    assert [one["name"] for one in data["can"]["interfaces"]] == ["can0", "can1"]
    assert data["can"]["interfaces"][0]["heard"] is None
    (port,) = data["ports"]
    assert (port["path"], port["usb"]["serial_number"], port["may_open"]) == ("/dev/ttyUSB0", "A50285BI", False)
    assert data.keys() == {"can", "buses", "ports"}


def test_what_is_heard_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    text = found(capsys, STREAMING)
    assert fits(text), text
    assert "4xx: " in text
    assert "looks like roboskin: board 7, board 8 (all frames)" in text
    assert "CAN interfaces" not in text
    (bus,) = found_data(capsys, STREAMING)["buses"]
    assert bus["heard"]["guesses"][0]["patches"] == ["board 7", "board 8"]
    assert bus["heard"]["duration_s"] >= 0.2
    assert bus["probe"] is None
    assert "no installed driver knows" not in text


def test_a_bus_that_cannot_be_heard_does_not_spoil_the_report(
    capsys: pytest.CaptureFixture[str], machine: Callable[..., None]
) -> None:
    machine([dataclasses.replace(CAN0, name="no-such-can0", up=True, bit_rate=1_000_000)], [TTY])
    text = found(capsys)
    assert "! there is no CAN interface" in text or "! this kernel has no CAN" in text
    assert "/dev/ttyUSB0" in text
    assert "CAN" in found_data(capsys, "--probe")["can"]["interfaces"][0]["probe"]["refused"]


def test_probing_tells_who_answers(capsys: pytest.CaptureFixture[str]) -> None:
    assert "to ask which devices are on it: skin-find virtual?boards=3 --probe" in found(capsys, "virtual?boards=3")
    assert "answers: ROBOSKIN: board 3 (mtb4 1.25.0)" in found(capsys, "virtual?boards=3", "--probe")
    (bus,) = found_data(capsys, "virtual?boards=3", "--probe", "--driver", "roboskin")["buses"]
    assert bus["probe"]["asked"] == ["roboskin"]


def test_a_bus_with_a_running_driver_is_shown_and_not_asked(capsys: pytest.CaptureFixture[str]) -> None:
    with driving(emulated(boards=(7,))) as driver:
        assert driver.runner is not None
        assert found_data(capsys, "virtual:roboskin")["buses"][0]["used_by"] is None
        machine_has = dataclasses.replace(CAN0, name="bus0")  # as `driving` calls it
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(interfaces, "can_interfaces", lambda: [machine_has])
            data = found_data(capsys)
            text = found(capsys)
    (one,) = data["can"]["interfaces"]
    assert one["used_by"]["name"] == "roboskin"
    assert one["used_by"]["buses"] == ["bus0"]
    assert "driver 'roboskin' (namespace" in text


@pytest.mark.parametrize(
    ("port", "words"),
    [
        (TTY, "not asked: you may not open it"),
        (dataclasses.replace(TTY, may_open=True, users=(User(41, "screen"),)), "not asked: screen (pid 41) has it"),
        (dataclasses.replace(TTY, may_open=True), "not asked: no installed driver has a harmless question"),
    ],
)
def test_ports_that_cannot_be_asked_are_told(
    capsys: pytest.CaptureFixture[str], machine: Callable[..., None], port: SerialPort, words: str
) -> None:
    machine(tty=[port])
    assert words in found(capsys, "/dev/ttyUSB0", "--probe", "--driver", "roboskin")


def test_the_port_of_an_emulator_is_a_port(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """What `skin-emulate --bus pty:port` makes, named as it is named to `skin-driver`; and it can be asked."""
    with emulated_on_a_pty("weiss_wts") as path:
        link = tmp_path / "port"
        link.symlink_to(path)
        text = found(capsys, str(link))
        (port,) = found_data(capsys, str(link), "--probe", "--driver", "weiss_wts")["ports"]
    assert f"{path}  pseudo terminal" in text
    assert str(link) in text
    assert (port["path"], port["links"], port["may_open"]) == (path, [str(link)], True)
    assert "weiss_wts" in port["probe"]["asked"]


@pytest.mark.thorough
def test_an_emulator_does_not_stand_in_the_way_at_its_own_port(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """It keeps the port open for programs that come and go; one that uses it is told of."""
    link = tmp_path / "port"
    with running("skin-emulate", "--driver", "weiss_wts", "--bus", f"pty:{link}") as emulator:
        emulator.wait_for("ready")
        (port,) = found_data(capsys, str(link), "--probe", "--driver", "weiss_wts")["ports"]
        assert (port["users"], port["probe"]["refused"]) == ([], "")
        terminal = os.open(link, os.O_RDONLY | os.O_NOCTTY)
        with subprocess.Popen(["sleep", "60"], stdin=terminal) as user:
            os.close(terminal)
            (port,) = found_data(capsys, str(link))["ports"]
            user.kill()
    assert [one["pid"] for one in port["users"]] == [user.pid]


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["no-such-can0"], 1, "CAN"),
        (["/dev/ttyUSB7"], 1, "there is no serial port /dev/ttyUSB7"),
        (["./port"], 1, "there is no serial port ./port"),
        (["/dev/null"], 1, "there is no serial port /dev/null"),
        (["--driver", "robskin"], 2, "did you mean 'roboskin'"),
        (["virtual?board=7"], 2, "did you mean 'boards'"),
        (["nonsense:0"], 2, "no interface 'nonsense'"),
        (["--force"], 2, "--probe"),
        (["-T", "-1"], 2, "seconds"),
        (["--udev", "can0"], 2, "not a serial port"),
        (["serial:?serial_number=A5"], 1, "there is no serial port"),
        (["tcp://127.0.0.1", "--probe"], 2, "bus tcp://127.0.0.1: which port? Write tcp://HOST:PORT"),
        (["modbus:tcp://:70000"], 2, "ports have numbers up to 65535"),
    ],
)
def test_mistakes_get_one_clear_line_and_the_right_exit_code(
    capsys: pytest.CaptureFixture[str], arguments: list[str], status: int, words: str
) -> None:
    assert exit_status(command, arguments) == status
    printed = capsys.readouterr()
    assert words in printed.err
    assert printed.out == ""


def test_topics_that_a_driver_reads_come_first() -> None:
    topics = [HeardTopic("rr/tareReply", "T", 1), HeardTopic("rt/touch", "U", 2, ("ros2",))]
    bus = {"bus": "dds://0", "used_by": None, "heard": None, "probe": None, "topics": topics}
    _, *lines = as_text({"can": {"interfaces": [], "advice": []}, "buses": [bus], "ports": []})
    assert [line.split()[0] for line in lines] == ["rt/touch:", "rr/tareReply:"]


def test_rules_for_what_is_plugged_in(capsys: pytest.CaptureFixture[str], machine: Callable[..., None]) -> None:
    machine(tty=[TTY])
    assert exit_status(command, ["--udev"]) == 0
    printed = capsys.readouterr()
    assert 'SYMLINK+="skin/A50285BI"' in printed.out
    assert "sudo tee /etc/udev/rules.d/70-skinware.rules" in printed.err
    told = json.loads(found(capsys, "--udev", "--json"))
    assert told["rules"] == printed.out
    assert told["place"] == "/etc/udev/rules.d/70-skinware.rules"
    assert "udevadm control --reload-rules" in told["then"][0]


def test_without_a_device_the_usual_rules_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command, ["--udev"]) == 0
    printed = capsys.readouterr()
    shipped = Path(ports.__file__).parents[1] / "data/70-skinware.rules"
    assert printed.out == shipped.read_text()
    assert "no serial device is plugged in" in printed.err
