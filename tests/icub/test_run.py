"""From a robot's files to live data: import, run the driver on emulated boards of that part, read as a user would."""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from skinware import DriverReader, PatchState
from skinware.cli._command import exit_status
from skinware.geometry import read_geometry
from skinware.tactile.regions import Region, read_regions
from skinware_drivers.cli.import_ import command
from tests.commands import run, running
from tests.icub.conftest import DEFAULTS, WRAPPER, Made, board_sets, device, triangle_sets
from tests.icub.test_positions import TRIANGLE, positions
from tests.sdk.driving import read_until


@pytest.mark.thorough
def test_a_real_arm_lives(robots: Path, geometry: Path, tmp_path: Path) -> None:
    name = "right_arm-eb4-j4_15-skin"
    bus = "virtual?boards=14,13,12,11,10,9,8&pattern=idle&mtb3=14,13,12"
    arguments = ["icub", str(robots / "iCubGenova02"), str(geometry), "--part", name, "--bus", f"2={bus}"]
    assert exit_status(command, [*arguments, "-o", str(tmp_path)]) == 0
    with running("skin-driver", "--config", str(tmp_path / f"{name}.toml")) as driver:
        ready = driver.wait_for("ready")
        assert (ready["modules"], ready["sensors"], ready["patches"]) == (74, 74 * 12, 7)
        # seven fingertips without a thermal channel, four palm triangles with one each
        assert ready["types"] == {"pressure": 63 * 10 + 7 * 12 + 4 * 11, "temperature": 63 * 2 + 4}
        with DriverReader(name) as reader:
            frame = read_until(reader, lambda f: not f.status.any())
            assert frame.patch_state.tolist() == [PatchState.LIVE] * 7
            counters = reader.bus_counters(frame)[0]
            assert (counters["unknown"], counters["bad_length"], counters["bad_content"]) == (0, 0, 0)
            structure = frame.structure
            kinds = Counter(structure.module_kind.tolist())
            assert kinds == {b"triangle": 63, b"fingertip": 7, b"palm": 4}
            places = read_geometry(tmp_path / f"{name}.geometry.toml").of(structure, "pressure")
            board_and_triangle = structure.sensor_uid[structure.index("pressure")] >> 8
            palm = (board_and_triangle >= 14 << 8 | 8) & (board_and_triangle <= 14 << 8 | 11)
            assert np.array_equal(places.known, palm)
            regions = read_regions(tmp_path / f"{name}.regions.toml").of(structure, "pressure")
            assert list(regions) == ["right_hand", "right_forearm", "right_arm"]
            boards = {part: set((board_and_triangle[index] >> 8).tolist()) for part, index in regions.items()}
            assert boards == {"right_hand": {14}, "right_forearm": {12, 13}, "right_arm": {8, 9, 10, 11}}


@pytest.mark.thorough
def test_a_real_leg_on_two_buses_lives(robots: Path, geometry: Path, tmp_path: Path) -> None:
    name = "left_leg-eb10-skin"
    buses = ["virtual?boards=1-7&pattern=idle", "virtual?boards=8-13&pattern=idle"]
    arguments = [f"--bus={patch}={bus}" for patch, bus in enumerate(buses, 1)]
    paths = [str(robots / "iCubGenova02"), str(geometry)]
    assert exit_status(command, ["icub", *paths, "--part", name, "-o", str(tmp_path), *arguments]) == 0
    with running("skin-driver", "--config", str(tmp_path / f"{name}.toml")) as driver:
        assert driver.wait_for("ready")["sensors"] == 13 * 16 * 12
        with DriverReader(name) as reader:
            frame = read_until(reader, lambda f: not f.status.any())
            places = read_geometry(tmp_path / f"{name}.geometry.toml")
            known = places.of(frame.structure, "pressure").known
            boards = frame.structure.sensor_uid[frame.structure.index("pressure")][known] >> 16
            foot = {1 << 16 | 12, 1 << 16 | 13}  # on the second bus
            assert set(boards.tolist()) == {*range(1, 8), *foot}
            assert known.sum() == len(places) == 680 + 250
            regions = read_regions(tmp_path / f"{name}.regions.toml").of(frame.structure, "pressure")
            of_foot = np.zeros(len(known), bool)
            of_foot[regions["left_foot"]] = True
            uid = frame.structure.sensor_uid[frame.structure.index("pressure")]
            assert set((uid[of_foot] >> 16).tolist()) == foot
            assert (of_foot & known).sum() == 250


@pytest.mark.thorough
def test_a_made_up_part_lives_with_what_its_files_enable(made: Made, tmp_path_factory: pytest.TempPathFactory) -> None:
    sets = board_sets("0 8 8 100 1 0xf0") + triangle_sets("0 8 0 3 1 2 0x2200", "0 7 15 15 0 2 0x2200")
    made.write("skin.xml", device(DEFAULTS + sets))
    made.write("wrapper.xml", WRAPPER)
    palm = [1] * 11 + [-1]
    made.write("torso.txt", positions([TRIANGLE] * 16 + [palm] * 16))
    out = tmp_path_factory.mktemp("out")
    bus = "virtual?boards=7,8&pattern=idle"
    assert exit_status(command, ["icub", str(made.folder), "-o", str(out), "--bus", f"1={bus}"]) == 0
    with running("skin-driver", "--config", str(out / "torso_skin.toml")) as driver:
        driver.wait_for("ready")
        with DriverReader("torso_skin") as reader:
            frame = read_until(reader, lambda f: not f.status.any())
            structure = frame.structure
            assert structure.n_modules == 15 + 4
            assert [bytes(kind) for kind in structure.module_kind[15:]] == [b"palm"] * 4
            places = read_geometry(out / "torso_skin.geometry.toml")
            assert places.of(structure, "pressure").known.all()
            last = structure.index("pressure")
            assert structure.sensor_uid[last][-1] == 8 << 16 | 3 << 8 | 10
            assert places.of(structure, "pressure").position_m[-1].tolist() == [0.19, 0.1, 0]
        assert "switched them off" in driver.errors  # board 8, triangles 4 to 15


# The command


def call(*arguments: object) -> int:
    return exit_status(command, ["icub", *map(str, arguments)])


def test_one_part_goes_to_stdout_and_the_remarks_to_stderr(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    made.write("skin.xml", device(DEFAULTS + '<param name="gain"> 4 </param>'))
    assert call(made.folder) == 0
    out, err = capsys.readouterr()
    assert out.startswith("# torso_skin (canBusSkin), made by skin-import from skin.xml.\n")
    assert 'name = "can0"' in out
    assert "Not understood and left out:\n" in err
    assert "skin.xml:9: param \"gain\": not understood: '4'" in err
    assert "Nothing to do: 1 (-v names them)" in err
    assert call(made.folder, "-v") == 0
    assert "whether the robot's software logs faults" in capsys.readouterr().err


def test_json_holds_everything(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    made.write("skin.xml", device())
    made.write("wrapper.xml", WRAPPER)
    made.write("torso.txt", positions([TRIANGLE] * 32))
    assert call(made.folder, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    (part,) = data["parts"]
    assert part["buses"] == [{"patch": 1, "name": "can0", "boards": [7, 8]}]
    assert (part["triangles"], part["sensors"], part["sensors_with_a_place"]) == (32, 384, 384)
    assert part["configuration_text"].startswith("# torso_skin")
    assert {"level", "file", "line", "element", "text"} == set(data["notes"][0])
    assert len(data["files"]) == 3
    assert call(made.folder, "--json", "-o", made.folder / "out") == 0
    (part,) = json.loads(capsys.readouterr().out)["parts"]
    assert Path(part["config"]).read_text().startswith("# torso_skin")
    assert len(read_geometry(part["geometry"])) == 384
    assert list(read_regions(part["regions"])) == [
        Region("torso", "pressure", ("torso_skin",), patch=("board 7", "board 8"))
    ]


def test_odd_characters_of_names_reach_no_terminal_and_no_file(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    skin = device().replace("torso_skin", "a&#10;driver = &#34;x&#34;&#127;")
    made.write("skin.xml", skin)
    made.write("wrapper.xml", WRAPPER.replace("> torso_skin <", '>"a driver = x"<'))
    made.write("torso.txt", "taxel2Repr\n[calibration]\n")
    with open(bytes(made.folder) + b"/\xff.ini", "wb") as file:
        file.write(b"robotPart x\n\x1b[31m\n[SENSORS]\n\x1b[0m 1\n")
    assert call(made.folder, "--json") == 0
    data = json.loads(capsys.readouterr().out)
    assert tomllib.loads(data["parts"][0]["configuration_text"])["name"] == "a_driver____x__"
    assert call(made.folder, "-v") == 0
    out, err = capsys.readouterr()
    assert all(c.isprintable() or c == "\n" for c in out + err)
    assert tomllib.loads(out)["driver"] == "roboskin"


def test_nothing_is_written_over_unasked(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    made.write("a.xml", device())
    made.write("b.xml", device().replace("torso_skin", "arm"))
    out = made.folder / "out"
    made.write("out/torso_skin.toml", "mine")
    assert call(made.folder, "-o", out) == 2
    assert "torso_skin.toml: exist already; give another folder, or --force" in capsys.readouterr().err
    assert (out / "torso_skin.toml").read_text() == "mine"
    assert not (out / "arm.toml").exists()
    assert call(made.folder, "-o", out, "--force") == 0
    assert (out / "torso_skin.toml").read_text() != "mine"
    assert "2 boards, 32 triangles, 384 sensors, 0 with a place" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("files", "arguments", "words"),
    [
        ({"a.xml": "<devices/>"}, [], "no device of type embObjSkin or canBusSkin in what was read"),
        ({"a.xml": "<devices"}, [], "a.xml: cannot be used: "),
        ({"a.xml": device(), "b.xml": device().replace("torso_skin", "arm")}, [], "2 parts (torso_skin, arm): choose"),
        ({"a.xml": device()}, ["--bus", "can0"], "'can0': write --bus PATCH=NAME"),
        ({"a.xml": device()}, ["--bus", "3=can0"], "--bus 3=...: a patch is 1 or 2"),
        ({"a.xml": device()}, ["--bus", "2=can0"], "torso_skin has no patch 2"),
        ({"a.xml": device()}, ["--positions", "torso"], "'torso': write --positions PART=FILE"),
        ({"a.xml": device(boards="99")}, [], "no part could be translated"),
    ],
)
def test_wrong_use_ends_with_2_and_one_clear_line(
    made: Made, files: dict[str, str], arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, text in files.items():
        made.write(name, text)
    assert call(made.folder, *arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err
    assert err.splitlines()[-1].startswith("skin-import: ")


def test_a_file_that_is_named_must_be_of_use(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(made.folder / "none.xml") == 2
    assert "does not exist" in capsys.readouterr().err
    path = made.write("notes.txt", "nothing")
    assert call(path) == 2
    assert "neither a position file nor a drawing of skinGui" in capsys.readouterr().err
    assert call(made.write("a.xml", "<a")) == 2
    assert "a.xml:1: not XML" in capsys.readouterr().err


@pytest.mark.thorough
def test_options_of_the_file_are_not_lost_to_another_bus(made: Made) -> None:
    made.write("skin.xml", device())
    assert call(made.folder, "-o", made.folder) == 0
    done = run("skin-driver", "--config", str(made.folder / "torso_skin.toml"), "--bus", "virtual")
    assert done.returncode == 2
    assert "--bus virtual: the file has options for can0 and none for this bus; change the name there" in done.stderr


@pytest.mark.thorough
def test_a_bus_that_is_not_filled_in_is_refused_by_the_driver(made: Made) -> None:
    made.write("skin.xml", device().replace("socketcan", "ecan"))
    assert call(made.folder, "-o", made.folder) == 0
    done = run("skin-driver", "--config", str(made.folder / "torso_skin.toml"))
    assert done.returncode == 2
    assert "a bus has no name yet: fill in the interface that it is, as can0" in done.stderr
