"""Images of touch: where each taxel is, and which colour it has, whatever else is in the image."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from skinware import Structure
from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.learning.images import Colours, TouchImage, range_of
from skinware.skin_layout import SkinLayout
from tests.cli.fake_skin import fake_structure
from tests.learning.test_live import hand
from tests.tactile.skins import placed

LAYOUT = SkinLayout(("hand",), (hand(),))


def test_a_matrix_fills_its_field_row_by_row() -> None:
    image = TouchImage(LAYOUT, "pressure", np.arange(6), 9, 13, Colours())
    assert image.sensor[0, [0, 4, 8]].tolist() == [0, 1, 2]
    assert image.sensor[4, [0, 4, 8]].tolist() == [3, 4, 5]
    assert (image.sensor[-1] == -1).all()  # between two modules
    assert (image.sensor[:, -1] == -1).all()
    assert np.array_equal(np.unique(image.sensor), np.arange(-1, 6))


def test_every_taxel_of_each_module_has_pixels() -> None:
    image = TouchImage(LAYOUT, "pressure", np.arange(15), 16, 32, Colours())
    assert np.array_equal(np.unique(image.sensor), np.arange(-1, 15))
    apart = [np.flatnonzero((image.sensor == number).any(axis=0)) for number in (0, 6)]
    assert apart[0].max() < apart[1].min()  # side by side


def test_taxels_without_rows_are_where_they_are() -> None:
    structure = fake_structure(1, 1)
    xy = np.array([(column * 0.01, row * 0.01) for row in range(2) for column in range(5)])
    places = np.zeros((12, 3))
    places[:10, :2] = xy
    layout = SkinLayout(("arm",), (structure.placed(_with_uids(places, structure.sensor_uid)),))
    image = TouchImage(layout, "pressure", np.arange(10), 21, 51, Colours())
    rows, columns = (
        np.array([np.argwhere(image.sensor == number).mean(axis=0)[axis] for number in range(10)]) for axis in (0, 1)
    )
    assert abs(np.corrcoef(columns, xy[:, 0])[0, 1]) > 0.95  # along the longer side, either way round
    assert abs(np.corrcoef(rows, xy[:, 1])[0, 1]) > 0.95
    unplaced = TouchImage(SkinLayout(("arm",), (structure,)), "pressure", np.arange(10), 21, 51, Colours())
    assert np.array_equal(np.unique(unplaced.sensor), np.arange(-1, 10))


def _with_uids(places: npt.NDArray[np.float64], uid: npt.NDArray[np.uint64]) -> Geometry:
    geometry = placed(places)
    geometry.uid[:] = uid
    return geometry


def test_colours_have_a_fixed_range() -> None:
    grey = Colours("grey", 10, 20)
    assert grey.of_values(np.array([0, 10, 15, 20, 99.0]))[:, 0].tolist() == [0, 0, 128, 255, 255]
    signed = Colours("signed", -1, 4).of_values(np.array([4, 2, 0, -4.0])).tolist()
    assert signed == [[255, 0, 0], [128, 0, 0], [0, 0, 0], [0, 0, 255]]
    log = Colours("log", 0, 255).of_values(np.array([0, 15, 255.0]))[:, 1].tolist()
    assert log == [0, round(255 * math.log(16) / math.log(256)), 255]
    shear = Colours("shear", -2, 2).of_values(np.array([[2.0, -2.0, 1.0], [0.0, 0.0, -1.0]])).tolist()
    assert shear == [[255, 1, 128], [128, 128, 0]]
    with pytest.raises(ConfigurationError, match="give a finite range"):
        Colours("grey", 3, 3)


def test_an_image_is_coloured_by_its_values_alone() -> None:
    image = TouchImage(
        LAYOUT,
        "pressure",
        np.arange(15),
        16,
        32,
        Colours("grey", *range_of(SkinLayout(("h",), (_ranged(),)), "pressure")),
    )
    pixels = image.of(np.arange(15.0))
    assert pixels.dtype == np.uint8
    assert (pixels[image.sensor == -1] == 0).all()
    assert (pixels[image.sensor == 7] == round(7 / 14 * 255 + 1e-9)).all()


def _ranged() -> Structure:
    structure = hand()
    return structure.replace(types=[each.measured(unit="N", minimum=0.0, maximum=14.0) for each in structure.types])


def test_what_does_not_fit_is_said() -> None:
    with pytest.raises(ConfigurationError, match="2 modules in 3 x 3 pixels"):
        TouchImage(LAYOUT, "pressure", np.arange(15), 3, 3, Colours())
    with pytest.raises(ConfigurationError, match="0 modules"):
        TouchImage(LAYOUT, "pressure", np.arange(0), 30, 30, Colours())
