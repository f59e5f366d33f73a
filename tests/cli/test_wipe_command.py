"""skin-wipe: a whole skin in one command, which ends with the sensors that never answered."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
from typing import Any

import numpy as np
import pytest

from skinware import Status
from skinware.sensor_types import PRESSURE
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import BIN, PATIENCE_S, refused, run, running

STRUCTURE = fake_structure(1, 4)
TAXELS = np.arange(STRUCTURE.n_sensors)[STRUCTURE.index("pressure")]
DEAD = [3, 25]
"""Among the taxels."""


def values(*pressed: int) -> Any:
    """Of a frame, with some of the taxels pressed."""
    found = np.where(STRUCTURE.sensor_type == PRESSURE.id, 240, 50)
    found[TAXELS[list(pressed)]] = 150
    return found


def wiped(without: list[int]) -> list[list[int]]:
    """Which taxels are pressed, one half after the other."""
    pressed = [taxel for taxel in range(len(TAXELS)) if taxel not in without]
    return [pressed[::2], pressed[1::2]]


@pytest.mark.thorough
def test_it_ends_by_itself_when_all_have_answered() -> None:
    with publishing(FakeSkin("hand", STRUCTURE)) as skin:
        skin.values = values()
        with running("skin-wipe", "hand") as wipe:
            ready = wipe.wait_for("ready")
            assert (ready["driver"], ready["type"], ready["sensors"], ready["unit"]) == (
                "hand",
                "pressure",
                40,
                "counts",
            )
            first, second = wiped([])
            skin.values = values(*first)
            wipe.wait_for("wiping", lambda told: told["answered"] == 20)
            skin.values = values(*second)
            assert wipe.wait_for("done") == {"event": "done", "answered": 40, "sensors": 40, "never": []}
            assert wipe.process.wait(PATIENCE_S) == 0
            wipe.stop()


@pytest.mark.thorough
def test_interrupted_it_names_those_that_never_answered() -> None:
    with publishing(FakeSkin("hand", STRUCTURE)) as skin:
        skin.values = values()
        skin.status[TAXELS[7]] = Status.MASKED  # switched off: nobody expects it to answer
        skin.status[TAXELS[25]] = Status.NOT_CONNECTED
        with running("skin-wipe") as wipe:  # the only driver
            assert wipe.wait_for("ready")["sensors"] == 39
            for pressed in wiped(DEAD):
                skin.values = values(*pressed)
                wipe.wait_for("wiping")
                wipe.wait_for("wiping")
            wipe.wait_for("wiping", lambda told: told["answered"] == 37)
            done = wipe.stop(signal.SIGINT)
            assert wipe.process.returncode == 1
        assert [(one["name"], one["status"]) for one in done["never"]] == [
            ("board 7, triangle 0, taxel 3", 0),
            ("board 7, triangle 2, taxel 5", Status.NOT_CONNECTED),
        ]
        assert [one["position"] for one in done["never"]] == TAXELS[DEAD].tolist()
        assert [one["uid"] for one in done["never"]] == STRUCTURE.sensor_uid[TAXELS[DEAD]].tolist()


@pytest.mark.thorough
def test_lines_for_people() -> None:
    with publishing(FakeSkin("hand", STRUCTURE)) as skin:
        skin.values = values()
        skin.status[TAXELS[25]] = Status.NOT_CONNECTED
        done = run("skin-wipe", "hand", "-T", "1.5")
        assert done.returncode == 1
        first, *middle, summary = done.stdout.splitlines()[: -len(TAXELS)]
        assert first == "hand: press your way over 40 pressure sensors, more than 6 counts each (Ctrl-C ends)"
        assert set(middle) == {"0 of 40 answered"}
        assert summary == "0 of 40 answered, never:"
        assert "  board 7, triangle 2, taxel 5 (not connected)" in done.stdout.splitlines()
        assert "  board 7, triangle 3, taxel 9" in done.stdout.splitlines()


@pytest.mark.thorough
def test_in_a_terminal_one_line_tells_how_it_goes() -> None:
    with publishing(FakeSkin("hand", STRUCTURE)) as skin:
        skin.values = values()
        keyboard, terminal = pty.openpty()
        process = subprocess.Popen([BIN / "skin-wipe", "-T", "2.5"], stdin=terminal, stdout=terminal, stderr=terminal)
        os.close(terminal)
        shown = b""
        while b"never:" not in shown:
            shown += os.read(keyboard, 4096)
        assert process.wait(PATIENCE_S) == 1
        os.close(keyboard)
        assert shown.count(b"\r0 of 40 answered\x1b[K") >= 1


@pytest.mark.thorough
def test_a_real_driver_is_wiped() -> None:
    """Somebody wanders over the emulated board, but not everywhere."""
    with running("skin-driver", "--bus", "virtual?boards=7") as driver:
        driver.wait_for("ready")
        with running("skin-wipe", "roboskin", "-T", "3") as wipe:
            told = wipe.wait_for("wiping", lambda told: told["answered"] > 0)
            assert told["sensors"] == 160
            done = wipe.wait_for("done")
            wipe.process.wait(PATIENCE_S)
            wipe.stop()
            assert done["answered"] + len(done["never"]) == 160
            assert all(one["name"].startswith("board 7, triangle ") for one in done["never"])
            assert wipe.process.returncode == (1 if done["never"] else 0)


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["nobody"], 1, "'nobody'"),
        (["hand", "--type", "shear_x"], 1, "no sensor type 'shear_x'"),
        (["hand", "-T", "soon"], 2, "not a number of seconds"),
    ],
)
def test_mistakes_get_one_clear_line(arguments: list[str], status: int, words: str) -> None:
    with FakeSkin("hand", STRUCTURE) as skin:
        skin.publish()
        done = refused("skin-wipe", *arguments)
    assert (done.returncode, done.stdout) == (status, "")
    assert words in done.stderr


@pytest.mark.thorough
def test_of_several_drivers_one_must_be_named() -> None:
    with publishing(FakeSkin("left", STRUCTURE)), publishing(FakeSkin("right", STRUCTURE)):
        done = run("skin-wipe", "-T", "1")
    assert done.returncode == 2
    assert "choose one with skin-wipe NAME: left, right" in done.stderr
