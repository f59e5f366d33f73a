"""Packages that skin-new makes, and the example that was made so, as a stranger installs, tests and runs them."""

from __future__ import annotations

import json
import re
import shutil
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.outside.stranger import Stranger
from tests.streams.peers import free_port
from tests.wheel import ROOT

pytestmark = pytest.mark.timeout(400)


def install(stranger: Stranger, package: Path) -> None:
    stranger.do("pip", "install", "--quiet", "--no-deps", "-e", ".", cwd=package)


def check(stranger: Stranger, package: Path, *, at_least: int) -> None:
    """Lint, types and tests of a package."""
    stranger.do("ruff", "check", cwd=package)
    stranger.do("ruff", "format", "--check", cwd=package)
    stranger.do("mypy", cwd=package)
    told = stranger.do("pytest", "-q", "-p", "no:cacheprovider", cwd=package)
    passed = re.search(r"^(\d+) passed(?:, \d+ skipped)? in ", told, re.MULTILINE)
    assert passed, told
    assert int(passed[1]) >= at_least


def frame_of(stranger: Stranger, driver: str) -> dict[str, list[float]]:
    """The first frame in which everything is fresh."""
    for line in stranger.do("skin-dump", driver, "-n", "50", "--timeout", "50", "--json").splitlines():
        frame: dict[str, list[float]] = json.loads(line)
        if not any(frame["status"]):
            return frame
    raise AssertionError("no fresh frame")


PORT = "pty:{folder}/port", "{folder}/port"
MODBUS = "modbus:tcp://127.0.0.1:{free}", "modbus:tcp://127.0.0.1:{free}"
TCP = "tcp://127.0.0.1:{free}", "tcp://127.0.0.1:{free}"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("transport", "sensors", "ends"),
    [("can", 12, None), ("serial", 24, PORT), ("modbus", 24, MODBUS), ("tcp", 24, TCP), ("virtual", 100, None)],
    ids=["can", "serial", "modbus", "tcp", "virtual"],
)
def test_a_new_driver_passes_its_tests_and_runs_at_once(
    stranger: Stranger, transport: str, sensors: int, ends: tuple[str, str] | None, tmp_path: Path
) -> None:
    """With the devices in its own process and, where they can be, at the other end of a line or a connection."""
    name = f"new_{transport}"
    told = stranger.do("skin-new", name, "--transport", transport, cwd=tmp_path)
    package = tmp_path / name
    assert f"skin-driver --driver {name} --bus" in told
    install(stranger, package)
    check(stranger, package, at_least=20)
    with stranger.running("skin-driver", "--driver", name, "--bus", "virtual"):
        assert len(frame_of(stranger, name)["values"]) == sensors
    if ends is None:
        return
    free = free_port()
    there, here = (end.format(folder=tmp_path, free=free) for end in ends)
    with ExitStack() as running:
        running.enter_context(stranger.running("skin-emulate", "--driver", name, "--bus", there))
        running.enter_context(stranger.running("skin-driver", "--driver", name, "--bus", here, "--wait"))
        assert len(frame_of(stranger, name)["values"]) == sensors


@pytest.mark.thorough
def test_the_example_is_a_driver_like_any_other(stranger: Stranger, tmp_path: Path) -> None:
    package = tmp_path / "optoforce"
    leave = shutil.ignore_patterns("*.egg-info", "__pycache__", ".*_cache")
    shutil.copytree(ROOT / "examples/optoforce", package, ignore=leave)
    install(stranger, package)
    check(stranger, package, at_least=50)
    with stranger.running(
        "skin-driver", "--driver", "optoforce", "--bus", "virtual:optoforce?sensors=4", "--model", "four"
    ):
        assert len(frame_of(stranger, "optoforce")["values"]) == 12
        ask = "import skinware; reader = skinware.DriverReader('optoforce'); print(reader.call('tare')); reader.close()"
        stranger.do("python", "-c", ask)
