"""Names of patches, modules and sensors as people know them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from skinware import Structure
from skinware.errors import StructureError
from skinware.sensor_types import CATALOGUE
from skinware_drivers.can.roboskin_layout import skin_patch, triangle_module
from skinware_drivers.description import Module, Patch, Sensor, assemble, taxels


def structure_of(*buses: Sequence[Patch]) -> Structure:
    types = list(CATALOGUE.values())
    return assemble([(f"can{number}", patches) for number, patches in enumerate(buses)], types, "u1").structure


def names_of_sensors(structure: Structure) -> list[str]:
    names = [structure.sensor_name(position) for position in range(structure.n_sensors)]
    for sensor_type in structure.types:  # all of a type at once are called the same
        of_type = np.arange(structure.n_sensors)[structure.index(sensor_type.name)]
        assert structure.sensor_names(sensor_type.name) == [names[position] for position in of_type]
    return names


def test_a_roboskin_board_has_the_names_of_its_triangles_whichever_it_has() -> None:
    modules = [triangle_module(8, 3, "triangle", (6, 10)), triangle_module(8, 12, "palm", ())]
    structure = structure_of([skin_patch(8, modules, 3)])
    assert structure.patch_names == ("board 8",)
    assert structure.module_names == ("board 8, triangle 3", "board 8, palm 12")
    names = names_of_sensors(structure)
    assert names[5] == "board 8, triangle 3, taxel 5"
    assert names[6] == "board 8, triangle 3, temperature 6"
    assert names[7] == "board 8, triangle 3, taxel 7"  # as the board's drawing counts, the thermal pads too
    assert names[23] == "board 8, palm 12, taxel 11"


def test_what_a_driver_does_not_name_has_its_kind_and_a_number() -> None:
    modules = [
        Module(taxels(1, "shear_x", "pressure", first_uid=uid), key=uid, kind=kind)
        for uid, kind in enumerate(("cell", "cell", "tip", ""))
    ]
    structure = structure_of([Patch("finger", modules)])
    assert structure.module_names == ("finger, cell 0", "finger, cell 1", "finger, tip", "finger, module")
    assert names_of_sensors(structure)[:4] == ["finger, cell 0", "finger, cell 0", "finger, cell 1", "finger, cell 1"]


def test_the_only_module_of_a_patch_is_called_as_the_patch() -> None:
    channels = [*taxels(3, first_uid=100), Sensor("temperature", 103), Sensor("acceleration_x", 103)]
    structure = structure_of([Patch("WTS", [Module(channels, kind="3x1")])])
    assert structure.module_names == ("WTS",)
    taxel_names = ["WTS, taxel 0", "WTS, taxel 1", "WTS, taxel 2"]
    assert names_of_sensors(structure) == [*taxel_names, "WTS, temperature", "WTS, acceleration_x"]


def test_patches_of_one_name_on_two_buses_are_told_apart() -> None:
    patch = Patch("board 8", [Module(taxels(2))])
    structure = structure_of([patch, Patch("board 9", [Module(taxels(2, first_uid=2))], key=9)], [patch])
    assert structure.patch_names == ("board 8 on can0", "board 9", "board 8 on can1")
    assert structure.sensor_name(5) == "board 8 on can1, taxel 1"


def test_names_are_published_and_files_without_them_are_read() -> None:
    structure = structure_of([Patch("a", [Module(taxels(1), name="left"), Module(taxels(1, first_uid=1), key=1)])])
    columns = structure.to_columns()
    assert Structure.from_columns(columns, "u1").module_names == structure.module_names == ("a, left", "a, module 1")
    del columns["module_name"]
    assert Structure.from_columns(columns, "u1").module_names == ("a, module 0", "a, module 1")
    columns["module_name"] = np.array([b"left"], "S32")
    with pytest.raises(StructureError, match="the module columns have different lengths"):
        Structure.from_columns(columns, "u1")
