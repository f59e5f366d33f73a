"""What others script: JSON keys, exit codes, one clear line per mistake."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from skinware import DriverReader, Namespace
from skinware_drivers.testing.waiting import wait_until
from tests.commands import BIN, refused, run, running

VIRTUAL = ("--bus", "virtual?boards=7,8")


def all_live(status: dict[str, Any]) -> bool:
    """Whether data of everything comes, as it always does unless the machine kept the program waiting."""
    return all(part["state"] == "live" for part in (*status["buses"], *status["patches"]))


@pytest.mark.thorough
def test_skin_driver_tells_what_it_does() -> None:
    with running("skin-driver", *VIRTUAL) as driver:
        ready = driver.wait_for("ready")
        assert (ready["driver"], ready["sensors"], ready["modules"], ready["patches"]) == ("roboskin", 384, 32, 2)
        status = driver.wait_for("status", all_live)
        (bus,) = status["buses"]
        assert (bus["name"], bus["state"], bus["dropped"], bus["errors"]) == ("virtual?boards=7,8", "live", 0, 0)
        assert bus["frames"] > 0
        assert [(p["name"], p["state"], p["orphans"]) for p in status["patches"]] == [
            ("board 7", "live", 0),
            ("board 8", "live", 0),
        ]
        assert all(patch["age_ms"] >= 0 for patch in status["patches"])
        assert driver.stop()["event"] == "stopped"
        assert driver.process.returncode == 0


@pytest.mark.thorough
def test_sigterm_ends_a_driver_in_good_order(namespace: Namespace) -> None:
    with running("skin-driver", *VIRTUAL) as driver:
        driver.wait_for("ready")
        assert driver.stop(signal.SIGTERM)["event"] == "stopped"
        assert driver.process.returncode == 0
    assert namespace.services() == []


@pytest.mark.thorough
def test_skin_dump_and_skin_info_keep_their_contracts() -> None:
    untouched = ("--bus", "virtual?boards=7,8&pattern=idle")  # a deep touch is out of range, and not fresh
    with running("skin-driver", *untouched, "--name", "torso", "--slots", "64") as driver:
        driver.wait_for("ready")
        dumped = run("skin-dump", "torso", "-n", "3", "--json")
        frames = [json.loads(line) for line in dumped.stdout.splitlines()]
        assert len(frames) == 3
        for frame in frames:
            assert {"driver", "sequence", "acquired_ns", "age_ms", "values", "status"} <= frame.keys()
            assert frame["driver"] == "torso"
            assert len(frame["values"]) == len(frame["status"]) == 384
        assert [f["sequence"] for f in frames] == list(range(frames[0]["sequence"], frames[0]["sequence"] + 3))
        with DriverReader("torso") as reader:
            reader.read()
            told = json.loads(run("skin-info", "--json").stdout)
        assert told.keys() >= {"namespace", "drivers", "services"}
        (shown,) = told["drivers"]
        assert shown["name"] == "torso"
        assert shown["alive"] is True
        assert shown["pid"] == driver.process.pid
        assert (shown["sensors"], shown["modules"], shown["patches"]) == (384, 32, 2)
        assert [(t["name"], t["sensors"]) for t in shown["types"]] == [("pressure", 320), ("temperature", 64)]
        assert {"rate_hz", "sequence", "age_ms"} <= shown.keys()
        assert shown["buses"][0]["frames"] > 0
        assert shown["readers"][0]["pid"] == os.getpid()
        sensors = json.loads(run("skin-info", "torso", "--sensors", "--json").stdout)
        assert len(sensors) == 384
        assert sensors[6] == {
            "name": "board 7, triangle 0, temperature 6",
            "uid": 7 << 16 | 6,
            "type": "temperature",
            "module": 0,
            "patch": 0,
        }
        physical = run("skin-dump", "torso", "-n", "1", "--json", "--type", "pressure")
        assert len(json.loads(physical.stdout)["values"]) == 320
        assert "board 7" in run("skin-info").stdout
        assert "torso #" in run("skin-dump", "-n", "1").stdout
        wait_until(lambda: "fresh 384" in run("skin-top", "--plain", "-T", "1").stdout)


def test_a_killed_driver_is_shown_as_dead_and_its_readers_live_on() -> None:
    with running("skin-driver", *VIRTUAL) as driver:
        driver.wait_for("ready")
        with DriverReader("roboskin") as reader:
            last = reader.read()
            driver.stop(signal.SIGKILL)
            assert json.loads(run("skin-info", "--json").stdout)["drivers"][0]["alive"] is False
            assert reader.read().stale
            with running("skin-driver", *VIRTUAL) as again:
                again.wait_for("ready")
                assert reader.read(newer_than=last, timeout_s=30).generation != last.generation


@pytest.mark.thorough
def test_output_into_a_pipe_that_closes_is_no_error() -> None:
    with running("skin-driver", *VIRTUAL) as driver:
        driver.wait_for("ready")
        dump = subprocess.Popen([BIN / "skin-dump", "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert dump.stdout is not None
        assert dump.stderr is not None
        dump.stdout.readline()
        dump.stdout.close()
        assert dump.wait(60) == 0
        assert dump.stderr.read() == b""
        dump.stderr.close()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--bus", "nonsense:1"], 2, "no interface 'nonsense'"),
        (["--bus", "virtual", "--driver", "robskin"], 2, "did you mean 'roboskin'"),
        (["--bus", "virtual", "--boards", "0"], 2, "board address 0"),
        (["--bus", "virtual", "--boards", "7,15"], 2, "board address 15"),
        (["--bus", "virtual?board=7"], 2, "did you mean 'boards'"),
        (["--bus", "virtual", "--period-ms", "0"], 2, "period_ms"),
        (["--bus", "virtual", "--name", "a/b"], 2, "service name"),
        (["--bus", "virtual?boards"], 2, "?key=value"),
        (["--bus", "virtual", "--config", "/no/such/file.toml"], 2, "/no/such/file.toml"),
        (["--bus", "virtual", "--slots", "1"], 2, "slots"),
        (["--bus", "can0", "--bus", "socketcan:can0"], 2, "bus socketcan:can0 is named twice"),
        ([], 2, "which bus?"),
    ],
)
def test_mistakes_get_one_clear_line_and_the_right_exit_code(arguments: list[str], code: int, words: str) -> None:
    result = refused("skin-driver", *arguments)
    assert result.returncode == code, result.stderr
    assert words in result.stderr


@pytest.mark.thorough
@pytest.mark.parametrize(("arguments", "code", "words"), [(["--bus", "no-such-can0"], 1, "CAN"), ([], 2, "which bus?")])
def test_the_exit_code_is_that_of_the_process(arguments: list[str], code: int, words: str) -> None:
    result = run("skin-driver", *arguments)
    assert result.returncode == code, result.stderr
    assert words in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('drivr = "roboskin"', "unknown key 'drivr'; did you mean 'driver'"),
        ('[[bus]]\nname = "virtual"\nopts = {}', "bus 1: unknown key 'opts'; did you mean 'options'"),
        ('[[bus]]\nname = "virtual"\n[options]\nperiod = 5', "unknown key 'period'; did you mean 'period_ms'"),
        ('[[bus]]\nname = "virtual"\n[options]\nboards = [99]', "board address 99"),
        ('[[bus]]\nname = "virtual"\n[options]\nboards = "7"', "Expected"),
        ("= 5", "not TOML"),
    ],
)
def test_mistakes_in_a_file_say_where(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "skin.toml"
    path.write_text(text)
    result = refused("skin-driver", "--config", str(path))
    assert result.returncode == 2, result.stderr
    assert words in result.stderr


@pytest.mark.thorough
def test_a_file_configures_buses_kinds_and_names(tmp_path: Path) -> None:
    path = tmp_path / "skin.toml"
    path.write_text(
        """
        name = "hand"
        [[bus]]
        name = "virtual?boards=7"
        [bus.options]
        boards = [7]
        modules = [{ board = 7, triangles = [0, 1, 2, 3, 4], kind = "fingertip" }]
        """
    )
    with running("skin-driver", "--config", str(path)) as driver:
        assert driver.wait_for("ready")["types"] == {"pressure": 5 * 12 + 11 * 10, "temperature": 22}
        with DriverReader("hand") as reader:
            assert reader.structure.module_kind[:6].tolist() == [b"fingertip"] * 5 + [b"triangle"]


@pytest.mark.thorough
def test_a_listener_takes_boards_in_on_a_hangup_signal(tmp_path: Path) -> None:
    """Told to listen only in the file, it sends nothing; SIGHUP makes it look again and does not end it."""
    path = tmp_path / "skin.toml"
    path.write_text(
        """
        listen_only = true
        [[bus]]
        name = "virtual?boards=7&streaming=true"
        [options]
        learn_s = 0.2
        """
    )
    with running("skin-driver", "--config", str(path)) as driver:
        assert driver.wait_for("ready")["patches"] == 1
        os.kill(driver.process.pid, signal.SIGHUP)
        for _ in range(2):
            (bus,) = driver.wait_for("status", all_live)["buses"]
            assert (bus["sent"], bus["send_failures"]) == (0, 0)
        assert driver.stop()["event"] == "stopped"
        assert driver.process.returncode == 0


@pytest.mark.thorough
def test_a_name_in_use_is_refused() -> None:
    with running("skin-driver", *VIRTUAL) as driver:
        driver.wait_for("ready")
        result = run("skin-driver", *VIRTUAL)
        assert result.returncode == 1
        assert "a running driver or service is called 'roboskin'" in result.stderr


@pytest.mark.thorough
def test_nobody_there_is_said() -> None:
    assert "Nothing runs here yet" in run("skin-info").stdout
    result = run("skin-dump")
    assert result.returncode == 1
    assert "start one" in result.stderr
    assert "no driver runs" in run("skin-top", "--plain", "-T", "1").stdout


@pytest.mark.thorough
def test_frames_of_another_python_can_program_are_decoded() -> None:
    """The first of the done-when list that needs no CAN in the kernel: multicast between two processes."""
    bus = "udp_multicast:239.74.163.2?port=43117"
    with running("skin-emulate", "--bus", bus, "--boards", "7", "--streaming") as emulator:
        emulator.wait_for("ready")
        with running("skin-driver", "--bus", bus, "--listen-only") as driver:
            ready = driver.wait_for("ready")
            assert (ready["patches"], ready["sensors"]) == (1, 192)
            status = driver.wait_for("status", all_live)
            assert status["buses"][0]["sent"] == 0
            assert len(status["patches"]) == 1
