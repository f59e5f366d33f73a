from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware import Status, Structure
from skinware.cli import _heat_map as heat
from skinware.cli._heat_map import BACKGROUND, LEVELS, arrange, codes_of, levels_of, marks_of
from skinware.errors import StructureError
from skinware.nominal_hand import FINGERS
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware_drivers.description import Module, Patch, assemble, taxels
from tests.cli.fake_skin import fake_structure

FINGERTIPS = [
    Patch("hand", [Module(taxels(1, first_uid=n), n, "1x1", f"{finger} tip") for n, finger in enumerate(FINGERS[:3])])
]


def skin_of(modules_per_patch: list[int], sensors_per_module: int) -> Structure:
    """Patches of modules of pressure sensors; every sensor has a temperature sensor beside it."""
    n_modules = sum(modules_per_patch)
    n_sensors = n_modules * sensors_per_module
    return Structure(
        types=[PRESSURE, TEMPERATURE],
        buses=["bus"],
        patch_name=[f"patch {number}" for number in range(len(modules_per_patch))],
        patch_bus=[0] * len(modules_per_patch),
        module_patch=np.repeat(np.arange(len(modules_per_patch)), modules_per_patch),
        module_kind=["tip"] * n_modules,
        sensor_uid=np.repeat(np.arange(n_sensors), 2),
        sensor_type=[PRESSURE.id, TEMPERATURE.id] * n_sensors,
        sensor_module=np.repeat(np.arange(n_modules), 2 * sensors_per_module),
        dtype="u2",
    )


def test_the_worst_that_is_known_of_a_sensor_is_shown() -> None:
    status = np.array(
        [
            0,
            Status.STALE,
            Status.OUT_OF_RANGE,
            Status.SUSPECT | Status.OUT_OF_RANGE,
            Status.STALE | Status.SUSPECT,
            Status.NO_ACK | Status.STALE,
            Status.MASKED | Status.NO_ACK,
            Status.NEVER_SEEN | Status.STALE,
            Status.NOT_CONNECTED | Status.NEVER_SEEN,
            Status.UNHEALTHY | Status.OUT_OF_RANGE,
            Status.UNHEALTHY | Status.SUSPECT,
        ],
        np.uint8,
    )
    settling = (status & np.uint8(Status.NEVER_SEEN)) != 0
    assert marks_of(status, settling).tolist()[7:9] == [heat.SETTLING, heat.NOT_CONNECTED]
    assert marks_of(status, np.zeros(len(status), bool)).tolist() == [
        heat.FRESH,
        heat.STALE,
        heat.OUT_OF_RANGE,
        heat.SUSPECT,
        heat.STALE,
        heat.NO_ACK,
        heat.MASKED,
        heat.NEVER_SEEN,
        heat.NOT_CONNECTED,
        heat.UNHEALTHY,
        heat.SUSPECT,
    ]


def test_levels_span_the_range() -> None:
    values = np.array([-9, 0, 15.9, 16, 127.9, 128, 255, 999, np.nan, np.inf, -np.inf], np.float32)
    assert levels_of(values, 0, 256).tolist() == [0, 0, 0, 1, 7, 8, 15, 15, 0, 15, 0]
    assert levels_of(values[:3], 5, 5).tolist() == [0, 0, 15]  # no range at all


def test_a_level_is_kept_while_the_value_is_near() -> None:
    before = np.array([4, 4, 4, 4], np.uint8)
    values = np.array([3.8, 5.2, 3.7, 5.3], np.float32)  # in levels
    assert levels_of(values, 0, LEVELS, before).tolist() == [4, 4, 3, 5]


def test_what_means_nothing_has_no_level() -> None:
    marks = np.array([heat.FRESH, heat.STALE, heat.NO_ACK, heat.NOT_CONNECTED], np.uint8)
    levels = np.full(4, 9, np.uint8)
    assert codes_of(levels, marks).tolist() == [9, 16 + 9, heat.NO_ACK * 16, heat.NOT_CONNECTED * 16]
    assert heat.NOT_CONNECTED * LEVELS + LEVELS <= BACKGROUND


@pytest.mark.thorough
@settings(max_examples=150, deadline=None)
@given(
    modules=st.lists(st.integers(1, 20), min_size=1, max_size=6),
    sensors=st.integers(1, 40),
    width=st.integers(1, 200),
    height=st.integers(1, 60),
    several=st.booleans(),
)
def test_every_sensor_has_a_square_of_its_own(
    modules: list[int], sensors: int, width: int, height: int, several: bool
) -> None:
    structure = skin_of(modules, sensors)
    patches = list(range(len(modules))) if several else [len(modules) - 1]
    arranged = arrange(structure, patches, "pressure", width, height)
    wanted = [s for s in range(0, structure.n_sensors, 2) if structure.sensor_patch[s] in patches]
    assert arranged.sensors.tolist() == wanted
    assert arranged.pixels.shape == (2 * arranged.lines, arranged.columns)
    numbers, counts = np.unique(arranged.pixels[arranged.pixels >= 0], return_counts=True)
    assert numbers.tolist() == list(range(len(wanted)))
    assert set(counts.tolist()) == {arranged.zoom**2}
    assert arranged.columns <= max(8, width)
    if arranged.zoom > 1:
        assert arranged.lines <= height
    for line, labels in arranged.labels.items():
        for label in labels:
            assert label.column >= 0
            assert label.column + len(label.text) <= max(arranged.columns, 8)
            cells = arranged.pixels[2 * line : 2 * line + 2, label.column : label.column + len(label.text)]
            assert (cells == -1).all()


def test_sensors_are_drawn_as_large_as_they_fit() -> None:
    structure = skin_of([1], 16)
    assert [arrange(structure, [0], "pressure", 80, height).zoom for height in (1, 4, 8, 12, 16, 99)] == [
        1,
        2,
        4,
        6,
        8,
        8,
    ]


def test_modules_have_their_names_within_the_patch_where_there_is_room() -> None:
    arranged = arrange(fake_structure(4, 2), [1], "pressure", 80, 13)
    assert [label.text for labels in arranged.labels.values() for label in labels] == ["triangle 0", "triangle 1"]


def test_modules_are_as_far_apart_as_their_names_need() -> None:
    structure = assemble([("bus", FINGERTIPS)], [PRESSURE], "u2").structure
    arranged = arrange(structure, [0], "pressure", 80, 20)
    [line] = arranged.labels.values()
    assert [label.text for label in line] == ["thumb tip", "index tip", "middle tip"]
    for before, after in pairwise(line):
        assert before.column + len(before.text) < after.column
    assert [arranged.sensor_at(2, label.column) for label in line] == [0, 1, 2]
    narrow = arrange(structure, [0], "pressure", 10, 20)
    assert narrow.columns <= 10
    assert len(narrow.labels) == 3  # below each other


def test_the_smallest_sensors_have_names_too() -> None:
    modules = [Module(taxels(n, first_uid=100 * n), n, "", f"{n} taxels") for n in (9, 15, 25, 40)]
    structure = assemble([("bus", [Patch("hand", modules)])], [PRESSURE], "u2").structure
    arranged = arrange(structure, [0], "pressure", 24, 9)
    assert arranged.zoom == 1
    assert [label.text for line in sorted(arranged.labels) for label in arranged.labels[line]] == [
        "9 taxels",
        "15 taxels",
        "25 taxels",
        "40 taxels",
    ]


def test_a_triangle_is_drawn_as_one_and_as_a_block_where_that_is_too_high() -> None:
    (one,) = (arrange(fake_structure(1, 1), [0], "pressure", 8, 4).pixels >= 0,)
    assert [row.sum() for row in one] == [2, 2, 4, 4, 6, 6, 8, 8]
    assert one[0].tolist() == [False] * 3 + [True] * 2 + [False] * 3
    small = arrange(fake_structure(1, 1), [0], "pressure", 8, 1).pixels >= 0
    assert [row.sum() for row in small] == [5, 5]


def test_where_each_sensor_needs_a_character_none_is_smaller() -> None:
    arranged = arrange(fake_structure(8, 16), range(8), "pressure", 80, 5, smallest=2)
    assert (arranged.zoom, arranged.lines > 5) == (2, True)
    assert (arranged.pixels[0::2] == arranged.pixels[1::2]).all()


def test_modules_have_their_numbers_and_patches_their_names() -> None:
    structure = fake_structure(4, 16)
    one = arrange(structure, [1], "pressure", 80, 12)
    assert one.zoom == 2
    assert [label.text for line in sorted(one.labels) for label in one.labels[line]] == [str(m) for m in range(16)]
    everything = arrange(structure, [0, 1, 2, 3], "pressure", 80, 12)
    assert (everything.zoom, everything.lines) == (1, 12)
    assert [(line, label.text) for line, labels in everything.labels.items() for label in labels] == [
        (0, "board 7"),
        (3, "board 8"),
        (6, "board 9"),
        (9, "board 10"),
    ]
    assert arrange(structure, [0, 1], "pressure", 40, 7).labels == {}  # no room for names


def test_what_does_not_fit_is_higher() -> None:
    arranged = arrange(fake_structure(8, 16), range(8), "pressure", 80, 5)
    assert (arranged.zoom, arranged.lines > 5) == (1, True)


def test_no_sensors_and_no_such_type() -> None:
    structure = fake_structure(1, 1)
    nothing = arrange(structure, [], "pressure", 80, 24)
    assert (len(nothing.sensors), nothing.lines) == (0, 0)
    assert nothing.draw(np.zeros(0, np.uint8)).shape == (0, 1)
    with pytest.raises(StructureError, match="There are: pressure, temperature"):
        arrange(structure, [0], "presure", 80, 24)


def test_codes_come_to_their_pixels() -> None:
    arranged = arrange(skin_of([2], 2), [0], "pressure", 12, 2)
    assert arranged.zoom == 2
    pixels = arranged.draw(np.array([1, 2, 3, 4], np.uint8))
    row = [1, 1, 2, 2, BACKGROUND, BACKGROUND, 3, 3, 4, 4]
    assert pixels[-1].tolist() == row
    assert pixels[-2].tolist() == row


def test_a_place_is_a_sensor() -> None:
    arranged = arrange(skin_of([2], 2), [0], "pressure", 12, 2)
    assert [arranged.sensor_at(1, column) for column in range(-1, 11)] == [
        None,
        0,
        0,
        2,
        2,
        None,
        None,
        4,
        4,
        6,
        6,
        None,
    ]
    assert arranged.sensor_at(0, 0) is None  # the module's number
    assert arranged.sensor_at(2, 0) is None
    assert arranged.sensor_at(-1, 0) is None


def test_modules_without_a_sensor_of_the_region_are_left_out() -> None:
    structure = fake_structure(4, 2)
    only = np.zeros(structure.n_sensors, bool)
    only[[0, 3, 12 * 3 + 5, 12 * 3 + 10]] = True  # the last one is of another type
    arranged = arrange(structure, range(4), "pressure", 80, 24, only=only)
    assert arranged.sensors.tolist() == [0, 3, 41]
    whole = arrange(structure, range(2), "pressure", 80, 24)
    assert sorted(set(arranged.pixels.ravel().tolist())) == [-1, 0, 1, 2]
    assert (arranged.pixels >= 0).sum() == 3 * arranged.zoom**2
    assert arranged.columns < whole.columns
    assert {label.text for labels in arranged.labels.values() for label in labels} >= {"board 7", "board 8"}
    sensors = {arranged.sensor_at(y, x) for y in range(arranged.lines) for x in range(arranged.columns)}
    assert sensors == {None, 0, 3, 41}
    nothing = arrange(structure, range(4), "pressure", 80, 24, only=np.zeros(structure.n_sensors, bool))
    assert (len(nothing.sensors), nothing.lines) == (0, 0)
