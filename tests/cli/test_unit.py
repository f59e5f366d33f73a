"""The systemd unit that ships: well formed, for the program that prints it, and what it says can be run."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import tomllib
from collections import defaultdict
from fnmatch import fnmatch
from pathlib import Path

import pytest

from skinware import DriverReader
from skinware_drivers.cli.driver import UNIT_FILE
from tests.commands import BIN, run, running

INSTANCE = "torso"


def printed() -> str:
    done = run("skin-driver", "--systemd")
    assert done.returncode == 0, done.stderr
    return done.stdout


def settings(unit: str) -> dict[str, list[str]]:
    """What a unit sets, all sections together."""
    found = defaultdict(list)
    for line in unit.splitlines():
        if line and not line.startswith(("#", "[")):
            key, equals, value = line.partition("=")
            assert equals, line
            found[key].append(value)
    return found


@pytest.mark.thorough
def test_it_is_for_the_program_that_prints_it() -> None:
    (command,) = settings(printed())["ExecStart"]
    assert shlex.split(command)[0] == str(BIN / "skin-driver")


def test_it_is_packed_with_the_package() -> None:
    package = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    patterns = package["tool"]["setuptools"]["package-data"]["skinware_drivers"]
    assert any(fnmatch(f"data/{UNIT_FILE}", pattern) for pattern in patterns)


@pytest.mark.thorough
def test_systemd_finds_nothing_wrong_with_it(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None or not Path("/bin/kill").exists():
        pytest.skip("no systemd-analyze here, or not the /bin/kill that is on every machine that systemd runs")
    unit = tmp_path / UNIT_FILE.replace("@", f"@{INSTANCE}")
    for text, is_right in ((printed(), True), (printed().replace("RestartSec=2", "RestartSec=soon"), False)):
        unit.write_text(text)
        done = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
        said = [line for line in done.stderr.splitlines() if INSTANCE in line]  # not of other units of this machine
        assert (not said) == is_right, done.stderr


@pytest.mark.thorough
def test_what_it_runs_is_a_driver_that_starts_reloads_and_stops(tmp_path: Path) -> None:
    found = settings(printed())
    (command,), (reload,), (never_again,) = found["ExecStart"], found["ExecReload"], found["RestartPreventExitStatus"]
    file = tmp_path / f"{INSTANCE}.toml"
    program, *arguments = shlex.split(command.replace("%i", INSTANCE).replace("/etc/skinware", str(tmp_path)))
    assert str(file) in arguments

    file.write_text('[[bus]]\nnme = "virtual?boards=7"\n')
    assert run(Path(program).name, *arguments).returncode == int(never_again)

    file.write_text('[[bus]]\nname = "virtual?boards=7"\n')
    with running(Path(program).name, *arguments) as driver:
        assert driver.wait_for("ready")["name"] == INSTANCE
        assert reload == "/bin/kill -HUP $MAINPID"
        with file.open("a") as more:
            more.write('[[bus]]\nname = "virtual?boards=8"\n')
        os.kill(driver.process.pid, signal.SIGHUP)
        assert any(len(driver.wait_for("status")["patches"]) == 2 for _ in range(120))
        with DriverReader(INSTANCE) as reader:
            assert reader.structure.n_patches == 2
        assert driver.stop(signal.SIGTERM)["event"] == "stopped"
        assert driver.process.returncode == 0
