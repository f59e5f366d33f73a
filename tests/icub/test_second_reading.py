"""Every skin device of every robot at hand, compared with a second reading of its files that shares no code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skinware.geometry import read_geometry
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.can.roboskin_setup import BoardSetUp
from skinware_drivers.icub.importer import ImportedPart, import_files
from skinware_drivers.icub.xml_tree import Notes
from tests.icub.conftest import DATA, configuration
from tests.icub.second_reading import Board, Device, board_after, devices, places, ports

ROBOTS = DATA / "robots_configuration"


def _robots() -> list[Path]:
    """Folders with skin devices: of a robot, never of several."""
    skins = {path.parent for path in ROBOTS.rglob("hardware/skin/*.xml")}
    return sorted(path.parents[1] for path in skins)


def _parts(robot: Path, *more: Path, positions: dict[str, Path] | None = None) -> dict[str, ImportedPart]:
    done = import_files([robot, *more], Notes(), positions=positions)
    return {part.part.name: part for part in done.parts}


def _written_boards(part: ImportedPart) -> dict[tuple[int, int], BoardSetUp]:
    """Set-up of each board by the configuration file that was written, in the order of the robot's index."""
    text = part.configuration()
    for number in range(len(part.buses)):
        text = text.replace('name = ""', f'name = "fill{number}"', 1)
    written = configuration(text)
    found = {}
    for bus, settings in zip(part.buses, written.settings.bus, strict=True):
        options = written.options_of_bus(RoboskinOptions, settings.name)
        found.update({(bus.patch, board): BoardSetUp(options, board, is_mtb4=False) for board in options.boards})
    return found


def _told(set_up: BoardSetUp) -> Board:
    return board_after([*set_up.first, *set_up.special_board, *set_up.special_triangles])


needs_robots = pytest.mark.skipif(not ROBOTS.is_dir(), reason=f"the real files are not here: {ROBOTS}")
of_each_robot = pytest.mark.parametrize("robot", _robots() or [ROBOTS], ids=lambda path: path.name)


@pytest.mark.thorough
@needs_robots
@of_each_robot
def test_boards_are_told_what_the_files_say(robot: Path) -> None:
    parts = _parts(robot)
    read = {device.name: device for device in devices(robot)}
    assert set(parts) == set(read)
    for name, device in read.items():
        of_can = parts[name].part.device_type == "canBusSkin"
        made = {(_patch(device) if of_can else p, b): s for (p, b), s in _written_boards(parts[name]).items()}
        if device.old:
            _compare_old(device, made)
            continue
        on = {patch for (patch, _), board in device.boards.items() if board.triangles}
        wanted = {key: board for key, board in device.boards.items() if key[0] in on}
        assert {key: _told(set_up) for key, set_up in made.items()} == wanted
        assert {key: set_up.enabled for key, set_up in made.items()} == {k: set(b.triangles) for k, b in wanted.items()}


def _patch(device: Device) -> int:
    (patch,) = {patch for patch, _ in device.boards}
    return patch


def _compare_old(device: Device, made: dict[tuple[int, int], BoardSetUp]) -> None:
    assert set(made) == set(device.boards)
    for number, set_up in enumerate(made.values()):
        old = {key: values[number] for key, values in device.old.items()}
        tact_setup, tact_setup_2 = set_up.first
        assert tact_setup[3:6] == bytes((old["4C_Timer"], old["4C_CDCOffsetL"], old["4C_CDCOffsetH"]))
        ticks = old["4C_TimeL"] | old["4C_TimeH"] << 8
        assert abs((tact_setup[6] | tact_setup[7] << 8) - ticks) <= 312.5 / 2  # whole milliseconds
        keys = ("4E_Shift", "4E_Shift3_1", "4E_NoLoad", "4E_Param", "4E_EnaL", "4E_EnaH")
        assert tact_setup_2[1:7] == bytes(old[key] for key in keys)


@pytest.mark.thorough
@needs_robots
@of_each_robot
@pytest.mark.parametrize("forearm", ["V2", "mesh", "nomesh"])
def test_every_place_in_the_files_is_kept(robot: Path, forearm: str, geometry: Path, tmp_path: Path) -> None:
    parts = _parts(robot, geometry, positions=_positions(robot, geometry, forearm))
    for device in devices(robot):
        wanted: dict[tuple[str, int], tuple[tuple[float, ...], tuple[float, ...] | None]] = {}
        boards = list(device.boards)
        on = {patch for (patch, _), board in device.boards.items() if board.triangles}
        buses = {patch: bus for bus, patch in enumerate(sorted(on))}
        for name, (first, last, local) in ports(robot, device).items():
            path = _positions(robot, geometry, forearm).get(name) or next(geometry.glob(f"{name}*.txt"), None)
            for channel, (is_taxel, position, normal) in places(path).items() if path else ():
                index = first + channel - local
                patch, board = boards[index // 192]
                if first <= index <= last and patch in buses:
                    uid = buses[patch] << 32 | board << 16 | index % 192 // 12 << 8 | index % 12
                    wanted["pressure" if is_taxel else "temperature", uid] = position, normal
        file = tmp_path / "geometry.toml"
        file.write_text(parts[device.name].geometry())
        made = read_geometry(file)
        keys = list(zip(made.type_name.tolist(), made.uid.tolist(), strict=True))
        assert set(keys) == set(wanted)
        positions = [wanted[key][0] for key in keys]
        normals = [wanted[key][1] or (np.nan,) * 3 for key in keys]
        assert made.position_m.tolist() == [list(position) for position in positions]
        assert np.allclose(made.normal, np.array(normals).reshape(-1, 3), atol=2e-6, equal_nan=True)


def _positions(robot: Path, geometry: Path, forearm: str) -> dict[str, Path]:
    """The file of the body part of which there are several."""
    has_one = any("left_forearm" in ports(robot, device) for device in devices(robot))
    return {"left_forearm": geometry / f"left_forearm_{forearm}.txt"} if has_one else {}
