"""Captures: a driver and its wires from the first byte on, in a file that may be given away and decoded again."""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import socket
from pathlib import Path
from typing import Any

import pytest

import skinware.recording
from skinware import DriverReader, Namespace
from skinware.recording import Recording, WireItem
from skinware_drivers.doctor.report import Disguise, Secrets
from skinware_drivers.testing.waiting import wait_until
from tests.commands import children_of, is_there, refused, run, running
from tests.streams.peers import LOCAL, free_port

ARRAY = str(Path(__file__).parents[1] / "modbus" / "array_file.py")


def frames_come(driver: Any, name: str) -> None:
    driver.wait_for("ready")
    with DriverReader(name, timeout_s=30) as reader:
        first = reader.read(timeout_s=30).position[1]
        wait_until(lambda: reader.read(timeout_s=30).position[1] > first + 5)


def items_of(recording: Recording) -> list[WireItem]:
    (wire,) = recording.wires
    return list(wire.items())


def received(path: Path) -> list[WireItem]:
    """What a file has so far; it may be written still."""
    if not path.exists() or path.stat().st_size < 1000:
        return []
    with skinware.recording.open(path) as recording:
        return [item for wire in recording.wires for item in wire.items() if not item.is_sent]


@pytest.mark.thorough
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_capture_is_whole_and_begins_with_the_first_question(tmp_path: Path, number: signal.Signals) -> None:
    path = tmp_path / "hand.mcap"
    options = ("--driver", "weiss_wts", "--period-ms", "20")
    with running("skin-driver", *options, "--bus", "virtual", "--capture", str(path)) as driver:
        frames_come(driver, "weiss_wts")
        told = driver.stop(number)
    assert told == {"event": "captured", "file": str(path), "bytes": path.stat().st_size, "missed": 0, "problem": ""}
    with skinware.recording.open(path) as recording:
        assert recording.is_whole
        assert recording.problems == []
        first, *_, last = items_of(recording)
        assert first.is_sent
        assert last.time_ns - first.time_ns > 100_000_000
        assert recording["weiss_wts"].read().column("values").shape[0] > 5
        about = recording.about("weiss_wts")
    assert about["driver_type"] == "weiss_wts"
    assert about["buses"]["virtual"]["medium"] == "serial"
    assert about["buses"]["virtual"]["options"]["period_ms"] == 20
    assert about["versions"].keys() == {"skinware", "numpy", "python", "linux"}
    again = refused("skin-prove", "--captured", str(path))
    assert (again.returncode, again.stdout.splitlines()[-1]) == (0, "equal")


@pytest.mark.thorough
def test_a_driver_that_is_killed_leaves_a_whole_capture(tmp_path: Path) -> None:
    path = tmp_path / "hand.mcap"
    with running("skin-driver", "--driver", "xela", "--bus", "virtual", "--capture", str(path)) as driver:
        frames_come(driver, "xela")
        wait_until(lambda: len(received(path)) > 20)
        os.kill(driver.process.pid, signal.SIGKILL)
        driver.stop()
    shutil.rmtree(Namespace().path)  # what nobody cleared away

    def is_whole() -> bool:
        with skinware.recording.open(path) as recording:
            return recording.is_whole

    wait_until(is_whole)
    with skinware.recording.open(path) as recording:
        assert len(items_of(recording)) > 20


@pytest.mark.thorough
def test_what_nobody_understands_is_captured(tmp_path: Path) -> None:
    """The wrong driver for what is on the bus: nothing is published, and every frame is there."""
    path = tmp_path / "hand.mcap"
    with running(
        "skin-driver", "--driver", "barrett", "--bus", "virtual:xela?streaming=yes", "--capture", str(path)
    ) as driver:
        wait_until(lambda: len(received(path)) > 20, 60)
        assert driver.stop()["problem"] == ""
    with skinware.recording.open(path) as recording:
        assert {item.is_sent for item in items_of(recording)} == {True, False}
        assert recording.about("barrett")["driver_type"] == "barrett"
    assert "nothing was decoded then, 0 updates are now" in refused("skin-prove", "--captured", str(path)).stderr


@pytest.mark.thorough
def test_a_bus_on_which_nothing_comes_is_in_the_capture_too(tmp_path: Path) -> None:
    path = tmp_path / "hand.mcap"
    options = ("--driver", "xela", "--listen-only", "--bus", "virtual:barrett", "--capture", str(path))
    with running("skin-driver", *options) as driver:
        driver.wait_for("ready")
        driver.stop()
    with skinware.recording.open(path) as recording:
        assert items_of(recording) == []
        assert recording.about("xela")["listen_only"] is True


@pytest.mark.thorough
def test_a_capture_of_modbus_is_decoded_again_with_its_options_and_without_its_host(tmp_path: Path) -> None:
    path, name = tmp_path / "hand.mcap", f"modbus:tcp://{LOCAL}:{free_port()}"
    with running("skin-emulate", "--driver", ARRAY, "--bus", name) as devices:
        devices.wait_for("ready")
        with running("skin-driver", "--driver", ARRAY, "--bus", name, "--capture", str(path)) as driver:
            frames_come(driver, "array_file")
            driver.stop()
    with skinware.recording.open(path) as recording:
        then = recording["array_file"].read()
        (wire,) = recording.wires
        assert wire.bus == name.replace(LOCAL, "host1")
        assert then.structure.buses == (wire.bus,)
    host = socket.gethostname().encode()
    for secret in (LOCAL.encode(), *([host] if len(host) > 5 else [])):  # short names are in any bytes by chance
        assert secret not in readable(path)
    with running("skin-driver", "--driver", ARRAY, "--bus", f"replay:{path}") as driver:
        driver.wait_for("ready")
        with DriverReader("array_file") as reader:
            assert reader.structure.sensor_uid.tolist() == then.structure.sensor_uid.tolist()
            shown = {row.tobytes() for row in then.column("values")}
            assert reader.read(timeout_s=30).values.tobytes() in shown


def readable(path: Path) -> bytes:
    """All that is in a file, uncompressed."""
    with skinware.recording.open(path) as recording:
        contents = recording.chunks(set(recording._source.channels))
        texts = [bytes(message.data) for chunk in contents for message in chunk.messages]
        channels = [f"{one.topic} {one.metadata}".encode() for one in recording._source.channels.values()]
    return b"".join([*texts, *channels])


@pytest.mark.thorough
def test_driver_and_options_come_from_the_file_unless_they_are_given(tmp_path: Path) -> None:
    path = tmp_path / "hand.mcap"
    options = ("--driver", "xela", "--rows", "2", "--bus", "virtual")
    with running("skin-driver", *options, "--capture", str(path)) as driver:
        frames_come(driver, "xela")
        driver.stop()
    with running("skin-driver", "--bus", f"replay:{path}") as driver:
        ready = driver.wait_for("ready")
        assert (ready["driver"], ready["sensors"]) == ("xela", 24)
    with running("skin-driver", "--bus", f"replay:{path}", "--rows", "4") as driver:
        assert driver.wait_for("ready")["sensors"] == 48


@pytest.mark.thorough
def test_a_file_that_is_there_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "hand.mcap"
    path.write_text("mine")
    refused = run("skin-driver", "--driver", "xela", "--bus", "virtual", "--capture", str(path))
    assert refused.returncode == 2
    assert refused.stderr == f"skin-driver: {path}: exists already: give another name, or remove it\n"
    assert path.read_text() == "mine"


def test_a_driver_whose_capture_ended_early_has_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")  # or the limit cuts off the bytecode of what is imported
    path = tmp_path / "hand.mcap"
    with running("skin-driver", "--driver", "xela", "--bus", "virtual", "--capture", str(path), "--json") as driver:
        driver.wait_for("ready")
        (recorder,) = children_of(driver.process.pid)
        resource.prlimit(recorder, resource.RLIMIT_FSIZE, (1, 1))  # as a full disk
        wait_until(lambda: not is_there(recorder))
        sequence = driver.wait_for("status")["sequence"]
        assert driver.wait_for("status")["sequence"] > sequence
        last = driver.stop()
    assert (driver.process.returncode, last["event"], last["problem"]) == (1, "captured", "File too large")


@pytest.mark.parametrize(
    ("name", "disguised"),
    [
        ("can0", "can0"),
        ("/dev/ttyUSB0?baudrate=921600", "/dev/ttyUSB0?baudrate=921600"),
        ("tcp://hand.lab.example:4000", "tcp://host1:4000"),
        ("udp://:4000", "udp://:4000"),
        ("udp://[fe80::1]:4000", "udp://host1:4000"),
        ("modbus:tcp://10.0.0.7", "modbus:tcp://host1"),
        ("socketcand:can0?host=tower&port=29536", "socketcand:can0?host=host1&port=29536"),
        ("serial:/home/jane/port", "serial:<home>/port"),
        ("udp_multicast:239.74.163.2", "udp_multicast:<address>"),
    ],
)
def test_names_of_buses_in_disguise(name: str, disguised: str) -> None:
    assert Disguise(Secrets(texts={"/home/jane": "<home>"}))(name) == disguised


def test_a_host_has_one_name_and_another_host_another() -> None:
    disguise = Disguise(Secrets())
    names = [disguise(f"tcp://{host}:1") for host in ("a", "b", "a")]
    assert names == ["tcp://host1:1", "tcp://host2:1", "tcp://host1:1"]
    assert not re.search("secret", disguise("token=secret"))
