"""``skin-driver --realtime``, ``--cpus`` and ``--latency``, on the command line and in a file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from skinware import DriverReader
from skinware.errors import ConfigurationError
from skinware_drivers.cli import driver_setup
from skinware_drivers.cli.driver import command
from tests import scheduling
from tests.commands import BIN, refused, running
from tests.scheduling import may_have_fifo
from tests.unprivileged import without_rights

VIRTUAL = ("--bus", "virtual?boards=7")
CPU = max(os.sched_getaffinity(0))

needs_rights = pytest.mark.skipif(not may_have_fifo(50), reason="this user may not have SCHED_FIFO and locked memory")


def config_file(folder: Path, text: str) -> Path:
    path = folder / "skin.toml"
    path.write_text(f'{text}\n[[bus]]\nname = "virtual?boards=7"\n')
    return path


@pytest.mark.thorough
@needs_rights
def test_a_running_driver_holds_what_was_asked_for() -> None:
    with running("skin-driver", *VIRTUAL, "--realtime", "fifo:50", "--cpus", str(CPU)) as driver:
        driver.wait_for("ready")
        process = driver.process.pid
        assert scheduling.policy(process) == (os.SCHED_FIFO, 50)
        assert os.sched_getaffinity(process) == {CPU}
        assert scheduling.locked_kib(process) > 10_000
        with DriverReader("roboskin") as reader:
            reader.read(newer_than=reader.read(), timeout_s=30)
        assert driver.stop()["event"] == "stopped"
    assert "refused" not in driver.errors


@pytest.mark.thorough
@needs_rights
def test_the_thread_of_a_python_can_bus_is_under_the_profile_too() -> None:
    """Else it would wait for a CPU while the loop waits for it."""
    bus = "udp_multicast:239.74.163.2?port=43118"
    with running("skin-emulate", "--bus", bus, "--boards", "7", "--streaming") as emulator:
        emulator.wait_for("ready")
        with running("skin-driver", "--bus", bus, "--listen-only", "--realtime", "fifo:50") as driver:
            driver.wait_for("ready")
            assert scheduling.threads_under(os.SCHED_FIFO, driver.process.pid) >= 2


@pytest.mark.thorough
@needs_rights
def test_a_file_asks_for_it_and_the_command_line_wins(tmp_path: Path) -> None:
    path = config_file(tmp_path, f'realtime = "fifo:40"\ncpus = [{CPU}]')
    with running("skin-driver", "--config", str(path)) as driver:
        driver.wait_for("ready")
        assert scheduling.policy(driver.process.pid) == (os.SCHED_FIFO, 40)
        assert os.sched_getaffinity(driver.process.pid) == {CPU}
    with running("skin-driver", "--config", str(path), "--realtime", "normal", "--cpus", "0") as driver:
        driver.wait_for("ready")
        assert scheduling.policy(driver.process.pid) == (os.SCHED_OTHER, 0)
        assert os.sched_getaffinity(driver.process.pid) == {0}
        assert scheduling.locked_kib(driver.process.pid) == 0


@pytest.mark.thorough
def test_cpus_alone_are_kept_and_nothing_else_is_asked_for() -> None:
    with running("skin-driver", *VIRTUAL, "--cpus", str(CPU)) as driver:
        driver.wait_for("ready")
        assert os.sched_getaffinity(driver.process.pid) == {CPU}
        assert scheduling.policy(driver.process.pid) == (os.SCHED_OTHER, 0)


@pytest.mark.thorough
def test_a_driver_without_rights_says_so_line_by_line_and_runs() -> None:
    arguments = without_rights(str(BIN / "skin-driver"), *VIRTUAL, "--realtime", "fifo:50", "--cpus", str(CPU))
    with running(*arguments) as driver:
        driver.wait_for("ready")
        process = driver.process.pid
        assert scheduling.policy(process) == (os.SCHED_OTHER, 0)
        assert os.sched_getaffinity(process) == {CPU}
        assert driver.stop()["event"] == "stopped"
    memory, policy = [line for line in driver.errors.splitlines() if "refused" in line]
    assert memory.startswith("skin-driver: locked memory refused: RLIMIT_MEMLOCK is 64 KiB")
    assert policy.startswith("skin-driver: SCHED_FIFO priority 50 refused: RLIMIT_RTPRIO is 0")


@pytest.mark.parametrize(
    ("file", "arguments", "latency_s"),
    [("", (), None), ("latency_ms = 2", (), 0.002), ("latency_ms = 2", ("--latency", "0.5"), 0.0005)],
)
def test_how_long_frames_may_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, arguments: tuple[str, ...], latency_s: float | None
) -> None:
    known: dict[str, Any] = {}

    def remember(*_arguments: object, **settings: object) -> None:
        known.update(settings)
        raise ConfigurationError("enough")

    monkeypatch.setattr(driver_setup, "Runner", remember)
    with pytest.raises(ConfigurationError, match="enough"):
        command.main(["--config", str(config_file(tmp_path, file)), *arguments], standalone_mode=False)
    assert known["latency_s"] == (None if latency_s is None else pytest.approx(latency_s))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--realtime", "fast"], "real-time profile 'fast': give normal or fifo:PRIORITY"),
        (["--realtime", ""], "real-time profile ''"),
        (["--realtime", "fifo"], "real-time profile 'fifo'"),
        (["--realtime", "fifo:0"], "fifo priority 0: give 1 (lowest) to 99"),
        (["--realtime", "fifo:100"], "fifo priority 100: give 1 (lowest) to 99"),
        (["--cpus", ""], "CPUs '': give numbers"),
        (["--cpus", "1-"], "CPUs '1-': give numbers"),
        (["--cpus", "3-1"], "the range 3-1 does not go upwards"),
        (["--realtime", "normal", "--cpus", "99999"], "CPU 99999 is not there; this machine has 0"),
    ],
)
def test_wrong_text_gets_one_line_and_exit_code_2(arguments: list[str], words: str) -> None:
    result = refused("skin-driver", *VIRTUAL, *arguments)
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("skin-driver: ")
    assert words in result.stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('realtime = "fast"', "real-time profile 'fast'"),
        ('realtime = ""', "real-time profile ''"),
        ("realtime = 50", "Expected str"),
        ("cpus = [99999]", "CPU 99999 is not there"),
        ("latency_ms = -1", "Expected float >= 0.0"),
        ('cpus = "1"', "Expected array"),
        ('realtim = "normal"', "unknown key 'realtim'; did you mean 'realtime'"),
    ],
)
def test_wrong_text_in_a_file_names_the_file(tmp_path: Path, text: str, words: str) -> None:
    path = config_file(tmp_path, text)
    result = refused("skin-driver", "--config", str(path))
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    line = path.read_text().splitlines().index(text) + 1
    assert result.stderr.startswith(f"skin-driver: {path}:{line}: ")
    assert words in result.stderr
