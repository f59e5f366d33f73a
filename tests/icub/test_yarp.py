"""A robot's files as a configuration that reads its YARP ports: each value is what the port map says it is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from skinware import DriverReader
from skinware.cli._command import exit_status
from skinware.geometry import read_geometry
from skinware.tactile.regions import read_regions
from skinware_drivers.cli.driver_setup import ConfigFile
from skinware_drivers.cli.import_ import command
from skinware_drivers.streams.yarp import Triangles, YarpOptions
from tests.commands import running
from tests.icub.conftest import DEFAULTS, WRAPPER, Made, device, triangle_sets
from tests.icub.test_positions import TRIANGLE, positions
from tests.sdk.driving import read_until

ROOT = "yarp://10.0.0.1:10000/icub/skin"


def call(*arguments: object) -> int:
    return exit_status(command, ["icub", *map(str, arguments), "--yarp", ROOT])


def options_of(path: Path) -> dict[str, YarpOptions]:
    file = ConfigFile(path)
    assert file.settings.driver == "yarp"
    return {bus.name: file.options_of_bus(YarpOptions, bus.name) for bus in file.settings.bus}


def test_a_real_arm_has_three_ports(robots: Path, geometry: Path, tmp_path: Path) -> None:
    name = "left_arm-eb2-j4_15-skin"
    assert call(robots / "iCubGenova02", geometry, "--part", name, "-o", tmp_path) == 0
    ports = options_of(tmp_path / f"{name}.toml")
    assert {bus.removeprefix(ROOT): options.length for bus, options in ports.items()} == {
        "/left_hand_comp": 192,
        "/left_forearm_comp": 384,
        "/left_arm_comp": 768,
    }
    hand, forearm, arm = ports.values()
    assert {run.board for run in hand.triangles} == {14}
    assert {run.board: run.first for run in forearm.triangles} == {13: 0, 12: 192}
    assert {run.board: run.first for run in arm.triangles} == {11: 0, 10: 192, 9: 384, 8: 576}
    assert sum(len(run.triangles) for options in ports.values() for run in options.triangles) == 74
    regions = read_regions(tmp_path / f"{name}.regions.toml")
    assert [region.name for region in regions] == ["left_hand", "left_forearm", "left_arm"]


def test_a_real_leg_has_its_second_bus_first(robots: Path, geometry: Path, tmp_path: Path) -> None:
    name = "left_leg-eb10-skin"
    assert call(robots / "iCubGenova02", geometry, "--part", name, "-o", tmp_path) == 0
    upper, lower, foot = options_of(tmp_path / f"{name}.toml").values()
    assert {run.board: run.first for run in foot.triangles} == {12: 0, 13: 192} or {
        run.board for run in foot.triangles
    } == {12, 13}
    assert (upper.length, lower.length, foot.length) == (1344, 768, 384)


@pytest.mark.thorough
def test_every_port_of_all_real_robots_can_be_read(robots: Path, geometry: Path, tmp_path: Path) -> None:
    for number, robot in enumerate(
        sorted(path.parent.parent for path in robots.rglob("skin") if path.parent.name == "wrappers")
    ):
        out = tmp_path / str(number)
        assert call(robot.parent if robot.name == "wrappers" else robot, geometry, "-o", out) in (0, 2)
        for path in out.glob("*-skin.toml"):
            assert options_of(path)


SETS = triangle_sets("0 7 3 3 0 2 0x2200", "0 8 0 15 0 2 0x2200", "0 8 5 5 1 2 0x2200")


def make(made: Made) -> None:
    made.write("skin.xml", device(DEFAULTS + SETS))
    made.write("wrapper.xml", WRAPPER)
    made.write("torso.txt", positions([TRIANGLE] * 32))


@pytest.mark.thorough
def test_each_value_is_where_the_position_file_says(made: Made, tmp_path_factory: pytest.TempPathFactory) -> None:
    make(made)
    out = tmp_path_factory.mktemp("out")
    assert call(made.folder, "-o", out) == 0
    path = out / "torso_skin.toml"
    ((name, options),) = options_of(path).items()
    assert name == f"{ROOT}/torso_comp"
    assert options == YarpOptions(
        length=384,
        triangles=(Triangles(7, 0, tuple(t for t in range(16) if t != 3)), Triangles(8, 192, (5,))),
    )
    path.write_text(path.read_text().replace(f"{ROOT}/torso_comp", "virtual:yarp?length=384&pattern=idle"))
    with running("skin-driver", "--config", str(path)) as driver:
        assert driver.wait_for("ready")["modules"] == 16
        with DriverReader("torso_skin") as reader:
            structure = read_until(reader, lambda f: not f.status.any()).structure
            places = structure.geometry
            assert places is not None
            assert structure.patch_name.tolist() == [b"board 7", b"board 8"]
            uid = structure.sensor_uid.astype(int)
            assert uid.tolist() == [
                12 * number + channel
                for number in [*(t for t in range(16) if t != 3), 21]
                for channel in range(12)
                if channel not in (6, 10)
            ]
            known = read_geometry(out / "torso_skin.geometry.toml").of(structure, "pressure")
            assert known.known.all()
            assert np.array_equal(places.position_m, known.position_m)
            torso = read_regions(out / "torso_skin.regions.toml").of(structure, "pressure")["torso"]
            assert np.arange(len(uid))[torso].tolist() == list(range(len(uid)))


def test_on_stdout_and_as_json(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    make(made)
    assert call(made.folder) == 0
    text = capsys.readouterr().out
    assert 'driver = "yarp"' in text
    assert 'values = "compensated"' in text
    assert call(made.folder, "--json") == 0
    assert json.loads(capsys.readouterr().out)["parts"][0]["configuration_text"] == text


def test_nobody_is_told_to_connect_a_can_bus(robots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(robots / "iCubGenova02", "-o", tmp_path) == 0
    assert "connect a CAN interface" not in capsys.readouterr().err


def test_without_a_port_map_there_is_no_port(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    made.write("skin.xml", device())
    assert call(made.folder) == 2
    assert "no part could be translated that has ports" in capsys.readouterr().err


@pytest.mark.parametrize("root", ["tcp://h:1/icub", "icub/skin", "yarp://h:1x/icub", "yarp://h:1/ic ub"])
def test_a_root_that_is_none(made: Made, root: str, capsys: pytest.CaptureFixture[str]) -> None:
    make(made)
    assert exit_status(command, ["icub", str(made.folder), "--yarp", root]) == 2
    assert "yarp://" in capsys.readouterr().err
