"""The real files of robots, read in place."""

from __future__ import annotations

from pathlib import Path

import pytest

from skinware.geometry import read_geometry
from skinware_drivers.can.roboskin_options import RoboskinOptions
from skinware_drivers.can.roboskin_setup import BoardSetUp
from skinware_drivers.icub.importer import Import, import_files
from skinware_drivers.icub.notes import Notes
from tests.icub.conftest import configuration


@pytest.fixture
def all_files(robots: Path, geometry: Path) -> tuple[Import, Notes]:
    notes = Notes()
    return import_files([robots, geometry], notes), notes


def test_every_value_of_all_files_is_understood(all_files: tuple[Import, Notes], robots: Path, geometry: Path) -> None:
    done, notes = all_files
    assert [str(note) for note in notes.all() if note.level == "unknown"] == []
    there_are = [path for folder in (robots, geometry) for path in folder.rglob("*")]
    assert set(done.files) == {path for path in there_are if path.suffix in (".xml", ".txt", ".ini")}
    missing = {note.element for note in notes.all() if note.level == "missing"}
    assert missing == {"xi:include", ""}  # of the robot's other files, and fingertips without a place


def test_every_part_is_there_with_the_triangles_that_its_files_enable(all_files: tuple[Import, Notes]) -> None:
    parts = {part.name: (part.triangles, len(part.buses)) for part in all_files[0].parts}
    assert parts == {
        "fingertip": (16, 1),
        "torso_skin": (64, 1),
        "left_arm-eb2-j4_15-skin": (74, 1),
        "right_arm-eb4-j4_15-skin": (74, 1),
        "left_leg-eb10-skin": (208, 2),
        "right_leg-eb11-skin": (208, 2),
        "torso-eb22-skin": (64, 1),
    }


def test_what_is_written_is_what_the_driver_reads(all_files: tuple[Import, Notes], tmp_path: Path) -> None:
    for part in all_files[0].parts:
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


def test_the_right_arm(all_files: tuple[Import, Notes]) -> None:
    arm = next(part for part in all_files[0].parts if part.name.startswith("right_arm"))
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


def test_the_left_leg_is_on_two_buses_of_which_the_second_has_the_foot(all_files: tuple[Import, Notes]) -> None:
    leg = next(part for part in all_files[0].parts if part.name.startswith("left_leg"))
    assert [bus.options.boards for bus in leg.buses] == [(1, 2, 3, 4, 5, 6, 7), (13, 12, 8, 9, 10, 11)]
    uids = {uid for group in leg.groups for uid in group.uid}
    assert {uid >> 32 for uid in uids} == {1}
    assert {uid >> 16 & 0xFFFF for uid in uids} == {12, 13}
    assert {group.frame for group in leg.groups} == {"l_foot"}


def test_a_torso_has_all_its_528_places(all_files: tuple[Import, Notes]) -> None:
    torso = next(part for part in all_files[0].parts if part.name == "torso_skin")
    assert torso.buses[0].name == "can0"
    by_type = {kind: sum(len(g.uid) for g in torso.groups if g.type == kind) for kind in ("pressure", "temperature")}
    assert by_type == {"pressure": 440, "temperature": 88}
