"""Rows and columns of matrices without a good taxel are named."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.sensor_types import FORCE, PRESSURE
from skinware_drivers.description import Module, Patch, assemble, taxels
from skinware_drivers.doctor.driver_log import whole_lines
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.rules import Severity
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.doctor.rig import SHORT_S, found, found_until, looked, of


@pytest.mark.parametrize(
    ("bad", "named"),
    [
        ([], ()),
        ([0, 1, 2], ()),
        ([0, 1, 2, 3], ("row 0 of pad, 3x4",)),
        ([1, 5, 9, 2, 6], ("column 1 of pad, 3x4",)),
        ([0, 1, 2, 3, 5, 9], ("row 0 of pad, 3x4", "column 1 of pad, 3x4")),
        (range(12), ("all of pad, 3x4",)),
        (range(12, 18), ("all of pad, strip",)),
        (range(12, 17), ()),
        (range(18, 22), ()),
    ],
)
def test_lines_that_are_all_bad(bad: list[int], named: tuple[str, ...]) -> None:
    modules = [
        Module(taxels(12), 0, "3x4", "3x4"),
        Module(taxels(6, first_uid=20), 1, "1x6", "strip"),
        Module(taxels(4, first_uid=30), 2, "block", "block"),
    ]
    structure = assemble([("bus", [Patch("pad", modules)])], [PRESSURE], np.uint8).structure
    of_sensor = np.zeros(structure.n_sensors, bool)
    of_sensor[list(bad)] = True
    assert whole_lines(structure, of_sensor) == named


def test_a_line_of_one_axis_is_named_once() -> None:
    modules = [Module(taxels(4, *(t.name for t in FORCE)), kind="2x2", name="tip")]
    structure = assemble([("bus", [Patch("hand", modules)])], FORCE, np.int16).structure
    of_taxel = np.array([True, True, False, False])
    bad = np.array([of_taxel[int(uid)] for uid in structure.sensor_uid])
    assert whole_lines(structure, bad) == ("row 0 of hand, tip",)


def test_broken_lines_of_a_pad_are_named() -> None:
    with emulated_skin("flexitac", broken_rows=(3,), broken_columns=(5, 6)):
        finding = found_until(of("taxels", "whole rows or columns"))
    assert finding.severity == Severity.ERROR
    assert finding.evidence == "row 3 of pad, matrix; column 5 of pad, matrix; column 6 of pad, matrix"


def test_a_pad_without_any_current() -> None:
    with emulated_skin("flexitac", rows=16, columns=16, broken_rows=tuple(range(16))):
        finding = found_until(of("taxels", "1 module has sent nothing but 0 so far"))
    assert finding.evidence == "pad, matrix"


def test_fingers_that_have_sent_nothing_but_0_are_named_and_are_no_fault() -> None:
    with emulated_skin("inspire", pattern="idle", zero=(13, 17)) as skin:
        read_until(skin.reader, lambda frame: frame.module_untouched.sum() == 2)
        words = "2 modules have sent nothing but 0 so far: right hand, thumb tip; right hand, palm"
        wait_until(lambda: any(words in one.seen for one in examine(looked(SHORT_S)).looked))
        wait_until(lambda: not [one.what for one in found() if one.area == "taxels"])
