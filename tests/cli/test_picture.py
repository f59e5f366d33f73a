from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from skinware import DriverReader, DriverSnapshot, Status
from skinware.cli import _heat_map as heat
from skinware.cli._heat_map import LEVELS
from skinware.cli._picture import RANGE, Picture, describe_sensor
from skinware.cli._top_rows import BUS, DRIVER, PATCH, RowKey
from skinware.tactile.regions import Region, Regions
from tests.cli.fake_skin import FakeSkin, fake_structure

DRIVER_ROW, BUS_ROW, PATCH_ROW = RowKey("a", DRIVER, 0), RowKey("a", BUS, 0), RowKey("a", PATCH, 1)


@contextmanager
def published() -> Iterator[tuple[FakeSkin, DriverReader]]:
    with FakeSkin("a", fake_structure(2, 3)) as skin, DriverReader("a") as reader:
        skin.values = np.where(skin.structure.sensor_type == 1, 255, 40)  # not touched, 20 degC
        skin.publish()
        yield skin, reader


def drawn(picture: Picture, key: RowKey, frame: DriverSnapshot, life: str = "live") -> list[int]:
    """The different codes in a picture."""
    picture.draw(key, frame, 78, 20, life)
    return sorted(set(picture.pixels.ravel().tolist()) - {heat.BACKGROUND})


def test_the_range_of_the_type_gives_the_colours() -> None:
    with published() as (skin, reader):
        picture = Picture(scale_name=RANGE)
        assert drawn(picture, PATCH_ROW, reader.read()) == [0]
        assert picture.title == "board 8: 3 triangles, 30 pressure sensors"
        assert picture.scale.plain.startswith("range 0 ")
        assert picture.scale.plain.endswith(" 255 counts")
        assert picture.marks.plain == "30 fresh"
        assert skin.values is not None
        skin.values[36] = 0  # the hardest touch
        skin.publish()
        assert drawn(picture, PATCH_ROW, reader.read()) == [0, LEVELS - 1]


def test_a_type_without_a_range_gets_its_colours_from_what_was_seen() -> None:
    with published() as (skin, reader):
        picture = Picture("temperature", RANGE)
        assert drawn(picture, DRIVER_ROW, reader.read()) == [0]
        assert picture.title == "a: 2 patches, 12 temperature sensors"
        assert skin.values is not None
        skin.values[10], skin.values[11], skin.values[22] = 60, 50, 250
        skin.status[22] = Status.SUSPECT  # does not count for the scale
        skin.publish()
        assert drawn(picture, DRIVER_ROW, reader.read()) == [0, 8, 15, heat.SUSPECT * LEVELS + 15]
        assert "20 " in picture.scale.plain
        assert picture.scale.plain.endswith(" 30 degC")
        skin.values[10] = 50
        skin.publish()
        drawn(picture, DRIVER_ROW, reader.read())
        assert picture.scale.plain.endswith(" 30 degC")  # what was once seen counts


def test_scales_take_turns() -> None:
    with published() as (_, reader):
        picture = Picture()
        seen = []
        for _ in range(4):
            drawn(picture, BUS_ROW, reader.read())
            seen.append(picture.scale.plain.translate({ord("▌"): None}).split())
            picture.next_scale()
        assert seen[0] == ["change", "0", "2", "8", "counts"]
        assert seen[1] == ["range", "0", "255", "counts"]
        assert seen[2] == ["raw", "255", "255"]
        assert seen[3] == seen[0]
        assert picture.title == "can0: 2 patches, 60 pressure sensors"


def test_a_light_press_is_seen_beside_a_hard_one() -> None:
    """At rest 12 to 17 of 255, pressed up to 136: the figures of a real skin. A fixed scale shows nearly nothing."""
    with published() as (skin, reader):
        rest, light, hard = 255 - 15, 255 - 27, 255 - 136
        skin.values = np.full(skin.structure.n_sensors, rest)
        changing, fixed = Picture(), Picture(scale_name=RANGE)
        for noise in (-2, 2) * 3:
            skin.values[:] = rest + noise
            skin.publish()
            assert drawn(changing, PATCH_ROW, reader.read())[0] == 0
        skin.values[:] = rest
        skin.values[36], skin.values[37] = light, hard
        skin.publish()
        at_rest, lightly, firmly = drawn(changing, PATCH_ROW, reader.read())
        assert at_rest == 0
        assert lightly >= 2
        assert firmly >= 12
        assert drawn(fixed, PATCH_ROW, reader.read()) == [0, 1, 8]


def test_the_baseline_is_taken_anew_on_request() -> None:
    with published() as (skin, reader):
        assert skin.values is not None
        picture = Picture()
        drawn(picture, PATCH_ROW, reader.read())
        skin.values[36] = 100
        skin.publish()
        assert len(drawn(picture, PATCH_ROW, reader.read())) == 2
        picture.take_baselines()
        assert drawn(picture, PATCH_ROW, reader.read()) == [0]


def test_nothing_but_nan_is_drawn_all_the_same() -> None:
    with FakeSkin("a", fake_structure(1, 1, dtype="f4")) as skin, DriverReader("a") as reader:
        skin.values = np.full(12, math.nan)
        skin.publish()
        picture = Picture("temperature")
        assert drawn(picture, DRIVER_ROW, reader.read()) == [0]


def test_types_take_turns() -> None:
    with published() as (skin, _):
        picture = Picture()
        assert picture.type_in(skin.structure).name == "pressure"
        picture.next_type(skin.structure)
        assert picture.type_in(skin.structure).name == "temperature"
        picture.next_type(skin.structure)
        assert picture.type_in(skin.structure).name == "pressure"


def test_a_type_that_is_not_there_is_said() -> None:
    with published() as (_, reader):
        picture = Picture("shear_x")
        drawn(picture, DRIVER_ROW, reader.read())
        assert picture.title == "a: 2 patches, 60 pressure sensors (there are no shear_x sensors)"


@pytest.mark.parametrize("life", ["dead", "silent", "paused"])
def test_an_old_frame_has_nothing_fresh(life: str) -> None:
    with published() as (_, reader):
        picture = Picture()
        assert drawn(picture, DRIVER_ROW, reader.read(), life) == [heat.STALE * LEVELS]
        assert picture.marks.plain == "0 fresh  ░ 60 stale"


def test_a_row_that_a_change_took_away() -> None:
    with published() as (_, reader):
        picture = Picture()
        for kind in (BUS, PATCH):
            assert drawn(picture, RowKey("a", kind, 7), reader.read()) == []
            assert picture.title == "no patches here"


def test_a_sensor_in_words() -> None:
    with published() as (skin, reader):
        skin.status[10] = Status.STALE | Status.OUT_OF_RANGE
        skin.publish()
        frame = reader.read()
        assert describe_sensor(frame, 13) == (
            "board 7, triangle 1, taxel 1: pressure 0 counts (raw 255), fresh; position 13, uid 0x3f5"
        )
        assert describe_sensor(frame, 10) == (
            "board 7, triangle 0, temperature 10: temperature 20 degC (raw 40), stale, out of range;"
            " position 10, uid 0x3f2"
        )


def test_the_sensors_of_one_region_are_drawn() -> None:
    regions = Regions(
        [
            Region("left", driver=("a",), patch=("board 7",)),
            Region("odd", type="pressure", uid=(1000, 1003)),
            Region("arm", driver=("b",), patch=("board 7",)),
        ]
    )
    with published() as (_, reader):
        picture = Picture(regions=regions, region="left")
        frame = reader.read()
        drawn(picture, DRIVER_ROW, frame)
        assert picture.arrangement is not None
        assert len(picture.arrangement.sensors) == 30
        assert picture.title.endswith("30 pressure sensors, in left")
        assert (picture.regions_of("a", 0), picture.regions_of("a", 1)) == (["left", "odd"], ["left"])
        for region, count in (("odd", 2), ("arm", 0), (None, 60), ("left", 30)):
            picture.next_region()
            drawn(picture, DRIVER_ROW, frame)
            assert len(picture.arrangement.sensors) == count
            assert (f", in {region}" in picture.title) == (region is not None)
        picture.next_type(frame.structure)
        picture.next_region()
        drawn(picture, DRIVER_ROW, frame)
        assert len(picture.arrangement.sensors) == 0  # the region has no temperatures
