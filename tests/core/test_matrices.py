"""Modules that are matrices, as indices."""

from __future__ import annotations

import numpy as np
import pytest

from skinware import Structure
from skinware.errors import StructureError
from skinware.sensor_types import CATALOGUE
from skinware.skin_layout import SkinLayout
from skinware_drivers import Module, Patch, Sensor, taxels
from skinware_drivers.description import assemble


def hand(*modules: Module) -> Structure:
    return assemble([("bus", [Patch("hand", modules)])], list(CATALOGUE.values()), "u2").structure


TIP = Module(taxels(6), 0, "2x3", "tip")
THREE_AXES = Module(taxels(4, "shear_x", "shear_y", "pressure", first_uid=100), 1, "2x2", "pad")
PROXIMITY = Module([Sensor("proximity", 200)], 2, "1x1", "proximity")
SCATTERED = Module(taxels(52, first_uid=300), 3, "52 points", "palm")
MORE_AXES_OF_SOME = Module([Sensor("pressure", 400), Sensor("pressure", 401), Sensor("shear_x", 400)], 4, "1x2", "back")


@pytest.fixture
def structure() -> Structure:
    return hand(SCATTERED, TIP, THREE_AXES, PROXIMITY, MORE_AXES_OF_SOME)


def test_a_matrix_indexes_arrays_of_its_type_row_by_row(structure: Structure) -> None:
    uids = structure.sensor_uid[structure.index("pressure")]
    matrices = structure.matrices("pressure")
    assert list(matrices) == ["hand, tip", "hand, pad", "hand, back"]
    assert uids[matrices["hand, tip"]].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert uids[matrices["hand, pad"]].tolist() == [[100, 101], [102, 103]]
    assert structure.matrices("pressure") is matrices


def test_each_axis_has_a_matrix_of_its_own(structure: Structure) -> None:
    uids = structure.sensor_uid[structure.index("shear_y")]
    matrices = structure.matrices("shear_y")
    assert list(matrices) == ["hand, pad"]
    assert uids[matrices["hand, pad"]].tolist() == [[100, 101], [102, 103]]


def test_what_is_no_matrix_is_told(structure: Structure) -> None:
    with pytest.raises(StructureError, match=r"no module 'hand, toe' here; matrices of proximity: 'hand, proximity'$"):
        structure.matrices("proximity")["hand, toe"]
    with pytest.raises(StructureError, match=r"'hand, palm' is no matrix but '52 points'"):
        structure.matrices("pressure")["hand, palm"]
    with pytest.raises(StructureError, match=r"'hand, back' is 1x2, but does not have a shear_x sensor at each place"):
        structure.matrices("shear_x")["hand, back"]
    with pytest.raises(StructureError, match="no sensor type 'force' in this skin"):
        structure.matrices("force")


def test_a_part_of_a_matrix_is_none(structure: Structure) -> None:
    tip = np.arange(structure.n_sensors)[structure.module_index(structure.module_names.index("hand, tip"))]
    part = structure.only(np.setdiff1d(np.arange(structure.n_sensors), tip[2:3]))
    assert list(part.matrices("pressure")) == ["hand, pad", "hand, back"]
    with pytest.raises(StructureError, match=r"'hand, tip' is 2x3, but does not have a pressure sensor at each place"):
        part.matrices("pressure")["hand, tip"]


def test_many_matrices_are_not_all_listed() -> None:
    many = hand(*(Module(taxels(1, first_uid=number), number, "1x1", f"cell {number}") for number in range(30)))
    with pytest.raises(StructureError, match=r"'hand, cell 18', 'hand, cell 19' \.\.\. \(30 in all\)$"):
        many.matrices("pressure")["cell 5"]


def test_matrices_of_two_hands_have_the_names_and_places_of_the_whole_skin(structure: Structure) -> None:
    layout = SkinLayout(("left", "right"), (structure, hand(TIP)))
    matrices = layout.matrices("pressure")
    assert list(matrices) == [
        ("left", "hand", "tip"),
        ("left", "hand", "pad"),
        ("left", "hand", "back"),
        ("right", "hand", "tip"),
    ]
    right = matrices["right", "hand", "tip"]
    assert (layout.driver_of("pressure")[right] == 1).all()
    assert layout.uids("pressure")[right].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert layout.matrices("pressure") is matrices


def test_another_driver_changes_no_key_and_no_name_that_it_does_not_have(structure: Structure) -> None:
    alone = SkinLayout(("left",), (structure,)).matrices("pressure")
    both = SkinLayout(("left", "right"), (structure, hand(TIP))).matrices("pressure")
    assert list(alone) == list(both)[:3]
    for matrices in (alone, both):
        assert matrices["hand, pad"] is matrices["left", "hand", "pad"]
        with pytest.raises(StructureError, match="no module 'hand, toe' here"):
            matrices["hand, toe"]
    assert ("left", "hand", "tip") in both
    assert ("left", "hand", "toe") not in both
    assert alone["hand, tip"] is alone["left", "hand", "tip"]
    which = r"\('left', 'hand', 'tip'\), \('right', 'hand', 'tip'\)"
    with pytest.raises(StructureError, match=rf"several drivers have a module 'hand, tip'; say which: {which}$"):
        both["hand, tip"]


def test_a_module_that_is_the_whole_patch_has_no_name_in_its_key() -> None:
    matrices = SkinLayout(("pad",), (hand(Module(taxels(6), 0, "2x3")),)).matrices("pressure")
    assert list(matrices) == [("pad", "hand", "")]
    assert matrices["hand"].shape == (2, 3)
    with pytest.raises(
        StructureError, match=r"no module \('pad', 'foot', ''\) here; matrices of pressure: \('pad', 'hand', ''\)$"
    ):
        matrices["pad", "foot", ""]
