from __future__ import annotations

import re
from dataclasses import replace

import pytest

from skinware import DriverReader
from skinware.cli._top_rows import (
    BUS,
    COLUMNS,
    DRIVER,
    PATCH,
    RowKey,
    as_data,
    patches_of,
    plain_line,
    rows_of,
)
from skinware.state import GOOD, OLD, BusReport, DriverReport, PatchReport, report_of
from skinware.text import counters_text
from tests.cli.fake_skin import FakeSkin, fake_structure

BUS_REPORT = BusReport("can0", "live", None, None, {"frames": 5156, "dropped": 0})
PATCH_REPORT = PatchReport("board 7", 0, "live", 192, 192, 0, 0, 12_000_000, None, {"orphans": 0})
STALE, UNCOUNTED = replace(PATCH_REPORT, state="stale"), replace(PATCH_REPORT, counters={})
REPORT = DriverReport(
    name="roboskin",
    life="live",
    rate_hz=20.0,
    age_ns=12_000_000,
    sensors=768,
    statuses={"fresh": 766, "stale": 2, "never_seen": 0},
    buses=(BUS_REPORT,),
    patches=(replace(PATCH_REPORT, counters={"orphans": 3}), *[PATCH_REPORT] * 3),
)


def test_a_plain_line() -> None:
    assert plain_line(REPORT) == (
        "roboskin  20.0 Hz  age 12 ms  sensors 768 (fresh 766, stale 2)  patches 4 live  dropped 0  orphans 3"
    )


@pytest.mark.parametrize(
    ("report", "words"),
    [
        (replace(REPORT, rate_hz=None), "roboskin  ? Hz  age 12 ms"),
        (replace(REPORT, life="dead", rate_hz=0.0), "roboskin  DEAD, this is its last sample  age 12 ms"),
        (replace(REPORT, life="silent"), "roboskin  SILENT, its process publishes nothing  age 12 ms"),
        (replace(REPORT, life="paused"), "roboskin  paused  age 12 ms"),
        (replace(REPORT, life="starting", age_ns=None), "roboskin  starting, no sample yet  sensors 768"),
        (
            replace(REPORT, patches=(*[PATCH_REPORT] * 3, replace(PATCH_REPORT, state="stale"))),
            "patches 3 live, 1 stale  dropped 0",
        ),
        (replace(REPORT, statuses={"fresh": 1, "stale": 0, "never_seen": 7}), "(fresh 1, stale 0, never seen 7)"),
        (
            replace(REPORT, buses=(), patches=(replace(PATCH_REPORT, counters={}),) * 4),
            "patches 4 live",
        ),  # what a driver does not count is not shown
        (replace(REPORT, buses=(), patches=()), "patches -"),
    ],
)
def test_plain_lines_of_all_kinds(report: DriverReport, words: str) -> None:
    assert words in plain_line(report)
    assert ("dropped" in plain_line(report)) == ("dropped" in report.counters and report.life != "starting")


def test_json_of_a_plain_line() -> None:
    assert as_data(REPORT, []) == {
        "driver": "roboskin",
        "state": "live",
        "rate_hz": 20.0,
        "age_ms": 12.0,
        "sensors": 768,
        "status": {"fresh": 766, "stale": 2, "never_seen": 0},
        "patches": {"live": 4},
        "counters": {"frames": 5156, "dropped": 0, "orphans": 3},
        "contacts": [],
    }
    nothing = as_data(replace(REPORT, rate_hz=None, age_ns=None), [])
    assert (nothing["rate_hz"], nothing["age_ms"]) == (None, None)


def test_a_row_per_driver_bus_and_patch() -> None:
    with FakeSkin("torso", fake_structure(4, 2, buses=2)) as skin, DriverReader("torso") as reader:
        skin.break_some()
        skin.publish()
        frame = reader.read()
        report = report_of(reader, frame, 19.96)
        rows = rows_of(report, worst_first=False)
    assert [(row.key.kind, row.key.number, row.cells[0]) for row in rows] == [
        (DRIVER, 0, "torso"),
        (BUS, 0, "  can0"),
        (PATCH, 0, "    board 7"),
        (PATCH, 1, "    board 8"),
        (BUS, 1, "  can1"),
        (PATCH, 2, "    board 9"),
        (PATCH, 3, "    board 10"),
    ]
    assert all(len(row.cells) == len(COLUMNS) for row in rows)
    cells = [row.cells for row in rows]
    assert cells[0][1:3] + cells[0][4:] == ("live", "20.0 Hz", "65/96", "2", "3", "")
    assert cells[1][1:] == ("live", "", "", "", "2", "", "frames 5,156  unknown 7")
    assert cells[2][1:3] + cells[2][4:] == ("live", "", "20/24", "", "3", "updates 640")
    assert re.fullmatch(r"[\d.]+ ms", cells[2][3])
    assert cells[6][1:3] + cells[6][4:] == ("stale", "", "0/24", "", "0", "")
    assert [(row.bad, row.is_fresh) for row in rows[4:]] == [(GOOD, False), (GOOD, True), (OLD, False)]
    worst = [(row.key.kind, row.key.number) for row in rows_of(report)]
    assert worst == [(DRIVER, 0), (BUS, 1), (PATCH, 3), (PATCH, 2), (BUS, 0), (PATCH, 0), (PATCH, 1)]
    assert rows[1].counters == {"frames": 5156, "dropped": 2, "errors": 0, "unknown": 7}
    assert [patches_of(row.key, frame.structure) for row in rows] == [[0, 1, 2, 3], [0, 1], [0], [1], [2, 3], [2], [3]]
    assert patches_of(RowKey("torso", PATCH, 9), frame.structure) == []
    assert patches_of(RowKey("torso", BUS, 9), frame.structure) == []


def test_patches_have_rates_as_far_as_they_are_known() -> None:
    with FakeSkin("torso", fake_structure(3, 2)) as skin, DriverReader("torso") as reader:
        skin.publish()
        frame = reader.read()
        rates = [row.cells[2] for row in rows_of(report_of(reader, frame, 20.0, [19.96, 0.0, None]))]
        assert rates == ["20.0 Hz", "", "20.0 Hz", "0.0 Hz", ""]
        other = report_of(reader, frame, 20.0, [19.96])  # of another structure
        assert [row.cells[2] for row in rows_of(other)][2:] == [""] * 3


def test_a_driver_without_a_frame_is_one_row() -> None:
    with FakeSkin("torso") as _, DriverReader("torso") as reader:
        (row,) = rows_of(report_of(reader, None))
    assert row.cells == ("torso", "starting", "0.0 Hz", "-", "0/768", "-", "-", "")


def test_the_last_states_of_a_dead_driver_are_told_as_such() -> None:
    skin = FakeSkin("torso", fake_structure(1, 2))
    skin.publish()
    with DriverReader("torso") as reader:
        frame = reader.read()
        skin.close()
        rows = rows_of(report_of(reader, frame, 20.0))
    assert [row.cells[1] for row in rows] == ["dead", "was live", "was live"]
    assert [row.cells[4] for row in rows] == ["0/24", "", "0/24"]
    assert rows[0].cells[2] == "0.0 Hz"


def test_counters_in_words() -> None:
    counters = {"frames": 12345, "dropped": 1, "send_failures": 2, "sent": 0}
    assert counters_text(counters) == "frames 12,345  dropped 1  send failures 2"
    assert counters_text(counters, besides=("dropped",)) == "frames 12,345  send failures 2"
    assert counters_text({}) == ""
