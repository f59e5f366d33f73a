from __future__ import annotations

import numpy as np
import pytest
from rich.color_triplet import ColorTriplet
from rich.segment import Segment

from skinware.cli import _heat_map as heat
from skinware.cli._heat_map import BACKGROUND, LEVELS, Label
from skinware.cli._painting import (
    CHARACTERS,
    MARK_CHARACTERS,
    MARK_NAMES,
    TRUE_COLOURS,
    changed_lines,
    colour_of,
    marks_text,
    scale_text,
    segments_of,
)

RAMP = TRUE_COLOURS.ramp
STALE, MASKED = heat.STALE * LEVELS, heat.MASKED * LEVELS


def line(upper: list[int], lower: list[int], *labels: Label) -> list[Segment]:
    return segments_of(np.array(upper, np.uint8), np.array(lower, np.uint8), labels, TRUE_COLOURS)


GROUND = ColorTriplet(18, 18, 18)


def text(segments: list[Segment]) -> str:
    return "".join(segment.text for segment in segments)


def colours(segment: Segment) -> tuple[ColorTriplet | None, ColorTriplet | None]:
    style = segment.style
    assert style is not None
    return style.color and style.color.triplet, style.bgcolor and style.bgcolor.triplet


def test_equal_neighbours_are_one_segment() -> None:
    segments = line([3, 3, 3, 5], [3, 3, 3, 5])
    assert [segment.text for segment in segments] == ["   ", " "]
    assert [colours(segment)[1] for segment in segments] == [RAMP[3], RAMP[5]]


def test_two_sensors_share_a_cell() -> None:
    (segment,) = line([3], [5])
    assert (segment.text, colours(segment)) == ("▀", (RAMP[3], RAMP[5]))


def test_a_sensor_at_the_edge_leaves_the_other_half_alone() -> None:
    upper, lower = line([3, BACKGROUND, BACKGROUND], [BACKGROUND, 5, BACKGROUND])
    assert (upper.text, colours(upper)) == ("▀", (RAMP[3], GROUND))
    assert (lower.text, colours(lower)) == ("▄ ", (RAMP[5], GROUND))  # a blank needs no colour of its own


@pytest.mark.parametrize(("mark", "character"), MARK_CHARACTERS.items())
def test_every_mark_has_its_character(mark: int, character: str) -> None:
    assert text(line([mark * LEVELS] * 2, [mark * LEVELS] * 2)) == 2 * character


def test_marks_are_told_apart_where_there_is_no_room_for_characters() -> None:
    assert colour_of(9, TRUE_COLOURS) == RAMP[9]
    assert sum(colour_of(STALE + 9, TRUE_COLOURS)) < sum(RAMP[9])
    assert colour_of(MASKED, TRUE_COLOURS) not in RAMP


def test_without_colours_levels_and_marks_are_characters() -> None:
    codes = np.array([0, 15, STALE + 9, MASKED, BACKGROUND], np.uint8)
    segments = segments_of(codes, codes, [Label(4, "7")], CHARACTERS)
    assert text(segments) == "▁█░-7"
    assert all(colours(segment) == (None, None) for segment in segments[:-1])
    assert scale_text([0, 1], "N", CHARACTERS).plain == "0 ▂▃▄▅▆▇██ 1 N"


def test_labels_take_the_place_of_what_is_below() -> None:
    segments = line([BACKGROUND] * 8 + [3], [BACKGROUND] * 8 + [3], Label(0, "12"), Label(4, "13"))
    assert text(segments) == "12  13   "
    assert colours(segments[-1])[1] == RAMP[3]


def test_changed_lines() -> None:
    before = np.zeros((8, 3), np.uint8)
    now = before.copy()
    assert changed_lines(before, now) == []
    now[1, 2], now[6, 0] = 1, 1
    assert changed_lines(before, now) == [0, 3]


def test_the_scale_has_values_and_a_unit() -> None:
    scale = scale_text([-0.5, 1234.5], "kPa", TRUE_COLOURS)
    assert scale.plain == "-0.5 ▌▌▌▌▌▌▌▌ 1234 kPa"  # two colours in each cell
    assert [span.style.color.triplet for span in scale.spans] == list(RAMP[0::2])  # type: ignore[union-attr]
    assert scale_text([0, 50, 200], "", TRUE_COLOURS).plain == "0 ▌▌▌▌ 50 ▌▌▌▌ 200"


def test_only_marks_that_are_there_are_explained() -> None:
    marks = np.array([heat.FRESH] * 5 + [heat.STALE] * 2 + [heat.NOT_CONNECTED], np.uint8)
    assert marks_text(marks, {}, TRUE_COLOURS).plain == "5 fresh  ░ 2 stale  x 1 not connected"
    assert marks_text(np.zeros(0, np.uint8), {}, TRUE_COLOURS).plain == "0 fresh"
    waiting = np.array([heat.FRESH] * 5 + [heat.SETTLING] * 82, np.uint8)
    reasons = {"held": 2, "no_resolution": 1}
    assert marks_text(waiting, reasons, TRUE_COLOURS).plain == "5 fresh  ~ settling, 82 left  2 held  1 no resolution"
    assert MARK_NAMES.keys() | {heat.FRESH} == MARK_CHARACTERS.keys() == set(range(10))
