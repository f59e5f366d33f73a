"""skin-press reaches an emulated skin in another process."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from skinware import DriverReader, Namespace, ServiceReader, ServiceWriter
from skinware.cli._command import exit_status
from skinware.cli.press import command as press
from skinware.geometry import read_geometry
from skinware_drivers.cli.emulate import command as emulate
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions
from tests.commands import run, running

IDLE = "virtual?boards=7,8&pattern=idle"
BUS = "udp_multicast:239.74.163.2?port=43121"


def pressed(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> str:
    assert exit_status(press, arguments) == status
    told = capsys.readouterr()
    return told.err if status else told.out


@pytest.mark.thorough
def test_a_driver_shows_the_press_where_its_geometry_says(capsys: pytest.CaptureFixture[str]) -> None:
    with running("skin-driver", "--bus", IDLE) as driver:
        driver.wait_for("ready")
        with DriverReader("roboskin") as reader:
            structure = reader.structure
            geometry = structure.geometry
            assert geometry is not None
            assert geometry.known.all()
            taxels = geometry.of(structure, "pressure")
            x, y, z = map(str, taxels.position_m[201])
            idle = read_until(reader, lambda frame: not frame.status.any()).physical("pressure")
            done = run("skin-press", x, y, z, "--newtons", "4", "--seconds", "30", "--radius", "0.001")
            assert (done.returncode, done.stderr) == (0, "")
            assert f"roboskin on {IDLE}: 4 N for 30 s; the nearest taxel: board 8, triangle 4" in done.stdout
            assert done.stdout.endswith("0.0 mm away\n")
            frame = read_until(reader, lambda frame: frame.physical("pressure")[201] > idle[201] + 80)
            rise = frame.physical("pressure") - idle
            distance = np.linalg.norm(taxels.position_m - taxels.position_m[201], axis=1)
            assert abs(rise[distance > 0.025]).max() <= 8
        told = json.loads(pressed(capsys, x, y, z, "--json"))
        assert told["name"] == "roboskin"
        assert told["pressed"][IDLE]["triangle"] == 4


@pytest.mark.thorough
def test_an_emulator_takes_presses_by_a_service_and_tells_where_it_is_pressed(
    capsys: pytest.CaptureFixture[str], namespace: Namespace
) -> None:
    with running("skin-emulate", "--bus", BUS, "--pattern", "idle", "--name", "hand") as hand:
        hand.wait_for("ready")
        with ServiceReader("hand") as reader:
            assert reader.operations() == {"press": "Press the emulated skin at a place for a while."}
            wait_until(lambda: reader.newest_position is not None)
            assert reader.read().column("count")[0] == 0
            told = pressed(capsys, "0.19", "0", "-0.0125", "--seconds", "60")
            assert told.startswith(f"hand on {BUS}: 3 N for 60 s; the nearest taxel: board 10")
            frame = reader.request()
            assert frame.column("count")[0] == 1
            assert frame.column("point_m")[0].tolist() == [0.19, 0, -0.0125]
            wait_until(lambda: bool(reader.read().column("force_n")[0] == pytest.approx(3)))
            assert "mm away; the skin is between" in pressed(capsys, "1", "1", "1", status=1)
            assert "at_m" in pressed(capsys, "nan", "0", "0", status=1)
        assert hand.stop()["event"] == "stopped"
    assert namespace.services() == []


def test_it_says_why_nothing_can_be_pressed(capsys: pytest.CaptureFixture[str]) -> None:
    assert "nothing in the namespace" in pressed(capsys, "0", "0", "0", status=1)
    assert "'nobody'" in pressed(capsys, "0", "0", "0", "--name", "nobody", status=1)
    with ServiceWriter("other", {"x": ("f8", 1)}) as writer:
        writer.begin()
        writer.commit(1)
        assert "nothing in the namespace" in pressed(capsys, "0", "0", "0", status=1)


@pytest.mark.thorough
def test_of_several_one_must_be_named(capsys: pytest.CaptureFixture[str]) -> None:
    with running("skin-driver", "--bus", IDLE) as one, running("skin-driver", "--bus", IDLE, "--name", "two") as two:
        one.wait_for("ready")
        two.wait_for("ready")
        told = pressed(capsys, "0.07", "0.0225", "0", status=2)
        assert "several can be pressed; give --name: roboskin, two" in told
        assert pressed(capsys, "0.07", "0.0225", "0", "--name", "two").startswith("two on ")


@pytest.mark.parametrize("arguments", [["0", "0"], ["0", "0", "up"], ["0", "0", "0", "--newtons", "hard"]])
def test_wrong_usage_is_told(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert "Usage: skin-press" in pressed(capsys, *arguments, status=2)


def test_an_emulator_without_places_has_no_service(capsys: pytest.CaptureFixture[str], namespace: Namespace) -> None:
    for option in ("--name", "--geometry"):
        arguments = ["--driver", "xela", "--bus", BUS, option, "hand"]
        assert exit_status(emulate, arguments) == 2
        assert f"{option}: these emulated devices have no places" in capsys.readouterr().err
    assert namespace.services() == []


def test_an_emulator_writes_down_where_its_sensors_are(tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    arguments = ["--bus", BUS, "--boards", "7,9", "--geometry", str(file), "-T", "0"]
    assert exit_status(emulate, arguments) == 0
    written = read_geometry(file)
    own = EmulatedRoboskin(EmulatedRoboskinOptions(boards=(7, 9))).geometry()
    assert written.type_name.tolist() == own.type_name.tolist()
    assert (set(written.frame), written.uid.tolist()) == ({"arm"}, own.uid.tolist())
    for name in ("position_m", "normal", "radius_m"):
        assert np.allclose(getattr(written, name), getattr(own, name))
