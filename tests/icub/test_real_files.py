"""The real files of robots, read in place: what is made of them, and what a person is told of it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from skinware.geometry import read_geometry
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.can.roboskin_setup import BoardSetUp
from skinware_drivers.icub.importer import Import, import_files
from skinware_drivers.icub.xml_tree import Notes
from tests.icub.conftest import configuration


def imported(*paths: Path) -> tuple[Import, Notes]:
    notes = Notes()
    return import_files(paths, notes), notes


@pytest.fixture
def robot(robots: Path, geometry: Path) -> Import:
    """The first whole robot, with all positions."""
    return imported(robots / "iCubGenova02", geometry)[0]


@pytest.mark.thorough
def test_every_value_of_all_files_is_understood(robots: Path, geometry: Path) -> None:
    done, notes = imported(robots, geometry)
    assert [str(note) for note in notes.all() if note.level == "unknown"] == []
    there_are = [path for folder in (robots, geometry) for path in folder.rglob("*")]
    assert set(done.files) == {path for path in there_are if path.suffix in (".xml", ".txt", ".ini")}
    missing = {note.text for note in notes.all() if note.level == "missing"}
    assert missing == {"there is no skin device 'torso_skin'; its ports are not used"}


FILL_IN_A_BUS, FINGERTIPS_OR_PALMS = "fill in", "fingertips or palms?"
GIVEN_AGAIN, NO_BOOLEAN, STAY_OFF = "given again as", "neither true nor false", "they stay off"
ALL_OFF, NO_DEVICE, NO_KIND = "no triangle is switched on", "there is no skin device", "what the modules are"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("iCubGenova02", {FILL_IN_A_BUS: 5, FINGERTIPS_OR_PALMS: 2}),
        ("iCubShanghai01", {FILL_IN_A_BUS: 5, FINGERTIPS_OR_PALMS: 2, NO_BOOLEAN: 1}),
        ("iCubStanford01", {FILL_IN_A_BUS: 5, FINGERTIPS_OR_PALMS: 2, NO_BOOLEAN: 1, GIVEN_AGAIN: 8, ALL_OFF: 2}),
        ("SkinFingertipDemo", {NO_KIND: 1}),
        ("experimentalSetups/torsoSkinLaptop", {}),
        ("robots-icebox/iCubAnkara01", {FILL_IN_A_BUS: 2, FINGERTIPS_OR_PALMS: 2, ALL_OFF: 2, NO_DEVICE: 1}),
        ("robots-icebox/iCubLondon01", {FILL_IN_A_BUS: 3, FINGERTIPS_OR_PALMS: 2, STAY_OFF: 2}),
        ("robots-icebox/iCubRome02", {FILL_IN_A_BUS: 2, NO_DEVICE: 1}),
    ],
)
def test_a_person_is_told_what_a_person_must_know(robots: Path, name: str, expected: dict[str, int]) -> None:
    told = [note.text for note in imported(robots / name)[1].all() if note.level != "info"]
    assert Counter(what for what in expected for text in told if what in text) == expected
    assert len(told) == sum(expected.values())


def test_every_part_is_there_with_the_triangles_that_its_files_enable(robot: Import) -> None:
    assert {part.name: (part.triangles, len(part.buses)) for part in robot.parts} == {
        "left_arm-eb2-j4_15-skin": (74, 1),
        "right_arm-eb4-j4_15-skin": (74, 1),
        "left_leg-eb10-skin": (208, 2),
        "right_leg-eb11-skin": (208, 2),
        "torso-eb22-skin": (64, 1),
    }


@pytest.mark.thorough
def test_what_is_written_is_what_the_driver_reads(robots: Path, geometry: Path, tmp_path: Path) -> None:
    for part in imported(robots, geometry)[0].parts:
        text = part.configuration()
        for number in range(len(part.buses)):
            text = text.replace('name = ""', f'name = "can{number}"', 1)
        written = configuration(text)
        options = [written.options_of_bus(RoboskinOptions, bus.name) for bus in written.settings.bus]
        assert options == [bus.options for bus in part.buses]
        path = tmp_path / "geometry.toml"
        path.write_text(part.geometry())
        places = read_geometry(path)
        assert len(places) == sum(len(group.uid) for group in part.groups)
        assert places.known.all()


def test_the_right_arm(robot: Import) -> None:
    arm = next(part for part in robot.parts if part.name.startswith("right_arm"))
    (bus,) = arm.buses
    assert bus.options.boards == (14, 13, 12, 11, 10, 9, 8)
    enabled = {board: sorted(BoardSetUp(bus.options, board).enabled) for board in bus.options.boards}
    assert enabled[14] == [0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11]
    assert enabled[12] == [0, 1, 3, 6, 8, 9, 12, 13]
    kinds = [(module.triangles, module.kind, module.thermal) for module in bus.options.modules if module.kind]
    assert kinds == [((8, 9, 10), "palm", None), ((11,), "palm", (7,))]
    palm = [group for group in arm.groups if group.type == "pressure"]
    assert [group.name.split(", ")[2] for group in palm] == [f"triangle {t}" for t in (8, 9, 10, 11)]
    assert {group.frame for group in palm} == {"r_hand"}


def test_the_left_leg_is_on_two_buses_of_which_the_second_has_the_foot(robot: Import) -> None:
    leg = next(part for part in robot.parts if part.name.startswith("left_leg"))
    assert [bus.options.boards for bus in leg.buses] == [(1, 2, 3, 4, 5, 6, 7), (13, 12, 8, 9, 10, 11)]
    boards = {(group.frame, uid >> 32, uid >> 16 & 0xFFFF) for group in leg.groups for uid in group.uid}
    foot = {("l_foot", 1, 12), ("l_foot", 1, 13)}
    assert boards == foot | {("l_upper_leg", 0, board) for board in range(1, 8)}
    assert sum(len(group.uid) for group in leg.groups) == leg.placed == 250 + 680  # 210 of them beyond taxel2Repr


def test_a_torso_has_all_its_528_places(robots: Path, geometry: Path) -> None:
    (torso,) = imported(robots / "experimentalSetups" / "torsoSkinLaptop", geometry)[0].parts
    assert torso.buses[0].name == "can0"
    by_type = {kind: sum(len(g.uid) for g in torso.groups if g.type == kind) for kind in ("pressure", "temperature")}
    assert by_type == {"pressure": 440, "temperature": 88}
