from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from skinware import DriverFrame, DriverReader, Status
from skinware.cli import _heat_map as heat
from skinware.cli._heat_map import LEVELS
from skinware.cli._picture import Picture, describe_sensor
from skinware.cli._top_rows import BUS, DRIVER, PATCH, RowKey
from tests.cli.fake_skin import FakeSkin, fake_structure

DRIVER_ROW, BUS_ROW, PATCH_ROW = RowKey("a", DRIVER, 0), RowKey("a", BUS, 0), RowKey("a", PATCH, 1)


@contextmanager
def published() -> Iterator[tuple[FakeSkin, DriverReader]]:
    with FakeSkin("a", fake_structure(2, 3)) as skin, DriverReader("a") as reader:
        skin.values = np.where(skin.structure.sensor_type == 1, 255, 40)  # not touched, 20 degC
        skin.publish()
        yield skin, reader


def drawn(picture: Picture, key: RowKey, frame: DriverFrame, life: str = "live") -> list[int]:
    """The different codes in a picture."""
    picture.draw(key, frame, 78, 20, life)
    return sorted(set(picture.pixels.ravel().tolist()) - {heat.BACKGROUND})


def test_the_range_of_the_type_gives_the_colours() -> None:
    with published() as (skin, reader):
        picture = Picture()
        assert drawn(picture, PATCH_ROW, reader.read()) == [0]
        assert picture.title == "board 8 on can0: 3 triangle modules, 30 pressure sensors"
        assert picture.scale.plain.startswith("0 ")
        assert picture.scale.plain.endswith(" 255 counts")
        assert picture.marks.plain == "30 fresh"
        assert skin.values is not None
        skin.values[36] = 0  # the hardest touch
        skin.publish()
        assert drawn(picture, PATCH_ROW, reader.read()) == [0, LEVELS - 1]


def test_a_type_without_a_range_gets_its_colours_from_what_was_seen() -> None:
    with published() as (skin, reader):
        picture = Picture("temperature")
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


def test_the_other_scale_is_that_of_the_values_seen_from_now_on() -> None:
    with published() as (_, reader):
        picture = Picture()
        drawn(picture, BUS_ROW, reader.read())
        assert picture.title == "can0: 2 patches, 60 pressure sensors"
        picture.other_scale()
        drawn(picture, BUS_ROW, reader.read())
        assert picture.scale.plain.endswith(" 0 counts")
        picture.other_scale()
        drawn(picture, BUS_ROW, reader.read())
        assert picture.scale.plain.endswith(" 255 counts")


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
        assert describe_sensor(frame, 13) == "pressure sensor 13: 0 counts (raw 255), fresh; module 1, uid 0x3f5"
        assert describe_sensor(frame, 10) == (
            "temperature sensor 10: 20 degC (raw 40), stale, out of range; module 0, uid 0x3f2"
        )
