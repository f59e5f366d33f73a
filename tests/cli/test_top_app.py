"""The live view, run by Textual without a terminal."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from queue import SimpleQueue
from threading import Thread

import numpy as np
import pytest
from textual.pilot import Pilot
from textual.widgets import Static

from skinware import DriverReader, Namespace, Status
from skinware import state as health
from skinware.cli import _top_app
from skinware.cli._painting import (
    CHARACTERS,
    COLOURS_16,
    COLOURS_256,
    MARK_NAMES,
    TRUE_COLOURS,
    HeatMap,
    Palette,
)
from skinware.cli._picture import CHANGE, RANGE
from skinware.cli._terminal import EndOfKeys
from skinware.cli._top_app import KEYS, Help, SkinTop
from skinware.cli._top_list import DriverList, room_for
from skinware.cli._top_rows import COLUMNS
from skinware.realtime import now_ns
from skinware.status import Why
from skinware.tactile.regions import Region, Regions
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill, publishing
from tests.commands import PATIENCE_S

SIZES = [(80, 24), (160, 48), (40, 12), (20, 6), (240, 70)]


@asynccontextmanager
async def shown(
    size: tuple[int, int] = (80, 24),
    type_name: str | None = None,
    duration_s: float | None = None,
    scale_name: str = CHANGE,
    regions: Regions | None = None,
    names: Sequence[str] = (),
) -> AsyncIterator[tuple[SkinTop, Pilot[None]]]:
    app = SkinTop(
        Namespace(), names, type_name, duration_s, palette=TRUE_COLOURS, scale_name=scale_name, regions=regions
    )
    async with app.run_test(size=size) as pilot:
        await pilot.pause()
        yield app, pilot


async def until(pilot: Pilot[None], condition: Callable[[], bool]) -> None:
    """Let the app run until a condition comes true; fails the test if it does not in time."""
    deadline_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline_s, condition
        await pilot.pause(0.02)


def line(app: SkinTop, name: str) -> str:
    """What a line of text says."""
    return str(app.query_one(f"#{name}", Static).content)


def listed(app: SkinTop) -> list[str]:
    """Names and states in the list."""
    return [" ".join(cell.strip() for cell in row.cells[:2]) for row in app.query_one(DriverList).rows]


def chosen(app: SkinTop) -> str:
    """Name in the row under the cursor."""
    row = app.query_one(DriverList).chosen
    assert row is not None
    return row.cells[0].strip()


def picture(app: SkinTop) -> list[str]:
    """The heat map as characters."""
    heat_map = app.query_one(HeatMap)
    return [strip.text for strip in heat_map.render_lines(heat_map.size.region)]


def go(scene: Callable[[], Awaitable[None]]) -> None:
    async def run() -> None:
        await scene()

    asyncio.run(run())


@pytest.fixture(autouse=True)
def look_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware.drivers.LOOK_EVERY_NS", 0)
    monkeypatch.setattr(_top_app, "_LIST_PERIOD_S", 0.1)


def test_only_drivers_that_are_named_are_shown() -> None:
    async def scene() -> None:
        with publishing(FakeSkin("torso", fake_structure(1, 2))), publishing(FakeSkin("arm", fake_structure(1, 2))):
            async with shown(names=["torso"]) as (app, pilot):
                await until(pilot, lambda: listed(app) == ["torso live", "can0 live", "board 7 live"])
            async with shown(names=["torzo"]) as (app, _):
                assert "No driver torzo runs in namespace" in line(app, "why")
                assert "did you mean 'torso'" in line(app, "why")

    go(scene)


def test_nobody_runs_then_somebody_does_then_nobody() -> None:
    async def scene() -> None:
        async with shown() as (app, pilot):
            assert app.query_one("#nothing").display
            assert not app.query_one("#all").display
            assert f"No driver runs in namespace '{Namespace().name}'" in line(app, "why")
            assert "skin-driver --bus virtual" in line(app, "why")
            with publishing(FakeSkin("a", fake_structure(1, 2))):
                await until(pilot, lambda: listed(app) == ["a live", "can0 live", "board 7 live"])
                assert app.query_one("#all").display
                await until(pilot, lambda: line(app, "title") == "a: 1 patch, 20 pressure sensors")
            await until(pilot, lambda: bool(app.query_one("#nothing").display))
            assert line(app, "head").endswith("0 drivers")

    go(scene)


@pytest.mark.thorough
@pytest.mark.parametrize("size", SIZES)
def test_it_fits_every_terminal(size: tuple[int, int]) -> None:
    async def scene() -> None:
        skin = FakeSkin("a")
        skin.break_some()
        with publishing(skin):
            async with shown(size) as (app, pilot):
                await until(pilot, lambda: "pressure sensors" in line(app, "title"))
                await pilot.press("down", "down", "t", "s", "pagedown", "pageup")
                await until(pilot, lambda: line(app, "title").startswith("board 10: "))
                heat_map = app.query_one(HeatMap)
                assert all(len(text) == heat_map.size.width for text in picture(app))
                for widget in (app.query_one(DriverList), heat_map, app.query_one("#head")):
                    assert app.screen.region.contains_region(widget.region)

    go(scene)


@pytest.mark.thorough
def test_what_a_newcomer_sees_at_80_by_24() -> None:
    async def scene() -> None:
        skin = FakeSkin("torso")
        skin.break_some()
        with publishing(skin):
            async with shown() as (app, pilot):
                await until(pilot, lambda: bool(line(app, "marks")))
                assert listed(app) == [
                    "torso live",
                    "can0 live",
                    "board 10 stale",
                    "board 7 live",
                    "board 8 live",
                    "board 9 live",
                ]
                assert line(app, "head").startswith("skin-top   namespace ")
                assert line(app, "title") == "torso: 4 patches, 640 pressure sensors"
                assert line(app, "scale").startswith("change 0 ")
                assert line(app, "detail") == "frames 5,156  dropped 2  unknown 7  orphans 3  updates 640"
                drawn = picture(app)
                assert len(drawn) == 12  # all of it, unscrolled
                assert [text[:8].strip() for text in drawn[::3]] == ["board 7", "board 8", "board 9", "board 10"]
                await pilot.press("o")
                assert listed(app)[2:] == ["board 7 live", "board 8 live", "board 9 live", "board 10 stale"]
                await pilot.press("down", "down")
                await until(pilot, lambda: line(app, "title").startswith("board 7: "))
                assert line(app, "title") == "board 7: 16 triangles, 160 pressure sensors"
                assert line(app, "marks").startswith("155 fresh  ░ 2 stale  ^ 1 out of range")
                assert line(app, "detail") == "orphans 3  updates 640"
                drawn = picture(app)
                assert drawn[0].split() == [str(number) for number in range(8)]
                for mark in ("xx", "··", "░░"):
                    assert any(mark in text for text in drawn)

    go(scene)


@pytest.mark.thorough
def test_what_does_not_fit_is_told_of() -> None:
    async def scene() -> None:
        with publishing(FakeSkin("torso", fake_structure(20, 16))):
            async with shown() as (app, pilot):
                table = app.query_one(DriverList)
                await until(pilot, lambda: len(listed(app)) == 22)
                await until(pilot, lambda: f"↓ {22 - (table.size.height - 1)} more" in line(app, "head"))
                assert "↑" not in line(app, "head")
                await until(pilot, lambda: "(PgUp, PgDn: " in line(app, "title"))
                await pilot.press(*["down"] * 21)
                await until(pilot, lambda: f"↑ {22 - (table.size.height - 1)} more" in line(app, "head"))
                assert "↓" not in line(app, "head")
                await until(pilot, lambda: line(app, "title").startswith("board 26: "))
                assert "PgDn" not in line(app, "title")

    go(scene)


@pytest.mark.thorough
def test_a_driver_dies_and_returns_changed() -> None:
    async def scene() -> None:
        async with shown() as (app, pilot):
            with fake_process("a", "--patches", "1", "--modules", "2") as process:
                await until(pilot, lambda: len(listed(app)) == 3)
                await pilot.press("down", "down")
                await until(pilot, lambda: line(app, "title").endswith("2 triangles, 20 pressure sensors"))
                kill(process)
                await until(pilot, lambda: listed(app) == ["a dead", "can0 was live", "board 7 was live"])
                await until(pilot, lambda: line(app, "marks") == "0 fresh  ░ 20 stale")
                with fake_process("a", "--patches", "2", "--modules", "3"):
                    await until(pilot, lambda: listed(app)[:1] == ["a live"])
                    await until(pilot, lambda: len(listed(app)) == 4)
                    await until(pilot, lambda: line(app, "title").startswith("board 7: 3 triangles"))
                    await until(pilot, lambda: line(app, "marks") == "30 fresh")
                    assert chosen(app) == "board 7"

    go(scene)


@pytest.mark.thorough
def test_the_chosen_row_is_chosen_again_when_its_driver_comes_back() -> None:
    async def scene() -> None:
        with FakeSkin("other", fake_structure(1, 1)) as other:
            other.publish()
            async with shown() as (app, pilot):
                for _ in range(2):
                    with FakeSkin("a", fake_structure(2, 1)) as skin:
                        skin.publish()
                        await until(pilot, lambda: len(listed(app)) == 7)
                        if chosen(app) != "board 8":
                            await pilot.press("up")
                        assert chosen(app) == "board 8"
                    await until(pilot, lambda: len(listed(app)) == 3)
                    assert chosen(app) == "other"
                await pilot.press("down")  # a choice of its own ends the waiting
                with FakeSkin("a", fake_structure(2, 1)) as skin:
                    skin.publish()
                    await until(pilot, lambda: len(listed(app)) == 7)
                    assert chosen(app) == "can0"
                    assert app.query_one(DriverList).cursor == 5

    go(scene)


def test_settling_and_reasons_are_shown_beside_fresh_taxels() -> None:
    why = np.array([Why.RELEARNING] * 8 + [Why.HELD, Why.REST] + [Why.REST] * 2, np.uint8)

    async def scene() -> None:
        skin = FakeSkin("a", fake_structure(1, 1), why=why)
        skin.status[:8] = Status.NEVER_SEEN
        with publishing(skin):
            async with shown((60, 15)) as (app, pilot):
                await until(pilot, lambda: line(app, "marks") == "2 fresh  ~ settling, 8 left  1 held")
                heat_map, strips = app.query_one(HeatMap), picture(app)
                row = next(number for number, text in enumerate(strips) if "~" in text)
                await pilot.hover(heat_map, offset=(strips[row].index("~"), row))
                await until(pilot, lambda: "never seen, relearning; position" in line(app, "detail"))

    go(scene)


@pytest.mark.parametrize("width", [20, 60, 80, 120, 200])
def test_columns_have_room(width: int) -> None:
    room = room_for(width)
    assert sum(room.values()) + 2 * (len(room) - 1) <= max(width, 16)
    assert (4 in room) == (width >= 60)  # fresh
    assert (7 in room) == (width >= 120)


def test_a_silent_driver_is_shown_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scene() -> None:
        with publishing(FakeSkin("a", fake_structure(1, 1))) as skin:
            async with shown() as (app, pilot):
                await until(pilot, lambda: line(app, "marks") == "10 fresh")
                skin.is_hung = True
                monkeypatch.setattr(health, "now_ns", lambda: now_ns() + 10**16)
                await until(pilot, lambda: listed(app)[:1] == ["a silent"])
                await until(pilot, lambda: line(app, "marks") == "0 fresh  ░ 10 stale")

    go(scene)


def test_types_and_scales_take_turns() -> None:
    async def scene() -> None:
        with FakeSkin("a", fake_structure(1, 1)) as skin:
            skin.publish()
            async with shown(type_name="temperature") as (app, pilot):
                await until(pilot, lambda: line(app, "title") == "a: 1 patch, 2 temperature sensors")
                await pilot.press("t")
                await until(pilot, lambda: line(app, "title") == "a: 1 patch, 10 pressure sensors")
                assert line(app, "scale").startswith("change ")
                await pilot.press("s")
                await until(pilot, lambda: line(app, "scale").startswith("range "))
                assert line(app, "scale").endswith(" 255 counts")
                await pilot.press("s")
                await until(pilot, lambda: line(app, "scale").startswith("raw "))

    go(scene)


@pytest.mark.parametrize(
    ("environment", "palette"),
    [
        ({"TERM": "xterm-256color", "COLORTERM": "truecolor"}, TRUE_COLOURS),
        ({"TERM": "xterm-256color"}, COLOURS_256),  # as over ssh
        ({"TERM": "xterm"}, COLOURS_16),
        ({"TERM": "xterm-256color", "COLORTERM": "truecolor", "NO_COLOR": "1"}, CHARACTERS),
    ],
)
def test_the_terminal_chooses_the_palette(
    environment: dict[str, str], palette: Palette, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("COLORTERM", "NO_COLOR", "TEXTUAL_COLOR_SYSTEM"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert SkinTop(Namespace())._heat_map._palette is palette


@pytest.mark.thorough
def test_the_mouse_chooses_and_points() -> None:
    async def scene() -> None:
        skin = FakeSkin("a", fake_structure(2, 1))
        skin.status[3] = Status.SUSPECT
        with publishing(skin):
            async with shown() as (app, pilot):
                await until(pilot, lambda: len(listed(app)) == 4)
                await pilot.click(DriverList, offset=(5, 3))
                await until(pilot, lambda: chosen(app) == "board 7")
                await until(pilot, lambda: line(app, "title").startswith("board 7: "))
                heat_map = app.query_one(HeatMap)
                row = next(number for number, text in enumerate(picture(app)) if "?" in text)
                await pilot.hover(heat_map, offset=(picture(app)[row].index("?"), row))
                await until(pilot, lambda: line(app, "detail").startswith("board 7, taxel 3: "))
                assert "suspect; position 3, uid 0x3eb" in line(app, "detail")
                await pilot.hover("#head")
                await until(pilot, lambda: "taxel 3" not in line(app, "detail"))

    go(scene)


@pytest.mark.thorough
def test_a_picture_that_does_not_fit_is_scrolled() -> None:
    async def scene() -> None:
        with FakeSkin("a", fake_structure(30, 16)) as skin:
            skin.publish()
            async with shown() as (app, pilot):
                await until(pilot, lambda: bool(line(app, "marks")))
                heat_map = app.query_one(HeatMap)
                before = picture(app)
                await pilot.press("pagedown")
                await until(pilot, lambda: heat_map.scroll_offset.y > 0)
                assert picture(app) != before
                await pilot.press("pageup")
                await until(pilot, lambda: heat_map.scroll_offset.y == 0)
                assert picture(app) == before

    go(scene)


def test_nothing_is_drawn_again_that_has_not_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[int] = []
    monkeypatch.setattr(HeatMap, "refresh", lambda _, *regions, **more: drawn.extend(region.y for region in regions))

    async def scene() -> None:
        with FakeSkin("a", fake_structure(4, 16)) as skin:
            skin.values = skin.status * 0 + 200
            skin.publish()
            async with shown(scale_name=RANGE) as (app, pilot):
                await until(pilot, lambda: bool(line(app, "marks")))
                skin.values[0] = 10
                skin.publish()
                await until(pilot, lambda: bool(drawn))
                assert drawn == [0]
                for _ in range(5):
                    skin.publish()
                    sequence = skin.writer.sequence
                    await until(pilot, lambda: _taken(app) == sequence)  # noqa: B023
                assert drawn == [0]

    go(scene)


def _taken(app: SkinTop) -> int:
    driver = app._overview.drivers.get("a")
    return driver.frame.sequence if driver is not None and driver.frame is not None else 0


@pytest.mark.parametrize("key", ["q", "ctrl+c"])
def test_keys_end_it(key: str) -> None:
    async def scene() -> None:
        with FakeSkin("a") as skin:
            skin.publish()
            async with shown() as (app, pilot):
                await pilot.press(key)
                await until(pilot, lambda: not app.is_running)
        assert app.return_code == 0

    go(scene)


def test_it_ends_by_itself_after_its_time(namespace: Namespace) -> None:
    async def scene() -> None:
        with FakeSkin("a") as skin, DriverReader("a", announce=False):
            skin.publish()
            async with shown(duration_s=0.2) as (app, pilot):
                await until(pilot, lambda: not app.is_running)
            assert list(namespace.reader_files()) == []
        assert app.return_code == 0

    go(scene)


def test_a_namespace_that_cannot_be_trusted_is_explained(namespace: Namespace) -> None:
    async def scene() -> None:
        with FakeSkin("a") as skin:
            skin.publish()
            async with shown() as (app, pilot):
                await until(pilot, lambda: len(listed(app)) == 6)
                with FakeSkin("b"):
                    namespace.path.chmod(0o777)
                    await until(pilot, lambda: "can be written by others" in line(app, "why"))
                    namespace.path.chmod(0o2750)
                    await until(pilot, lambda: "b starting" in listed(app))

    go(scene)


@pytest.mark.thorough
def test_a_key_goes_from_region_to_region_where_there_are_any() -> None:
    async def scene() -> None:
        with publishing(FakeSkin("a", fake_structure(2, 2))):
            async with shown(regions=Regions([Region("left", patch=("board 7",))])) as (app, pilot):
                everything, left = "a: 2 patches, 40 pressure sensors", "a: 2 patches, 20 pressure sensors, in left"
                await until(pilot, lambda: line(app, "title") == everything)
                await pilot.press("r")
                await until(pilot, lambda: line(app, "title") == left)
                arrangement = app._picture.arrangement
                assert arrangement is not None
                y, x = next(yx for yx in np.ndindex(arrangement.lines, 30) if arrangement.sensor_at(*yx) is not None)
                await pilot.hover(app.query_one(HeatMap), offset=(x, y))
                await until(pilot, lambda: line(app, "detail").endswith("; in left"))
                await pilot.press("r")
                await until(pilot, lambda: line(app, "title") == everything)
            async with shown() as (app, pilot):
                await until(pilot, lambda: line(app, "title") == everything)
                await pilot.press("r")
                await pilot.pause()
                assert app.check_action("next_region", ()) is False

    go(scene)


@pytest.mark.parametrize("size", [(100, 40), (60, 15)])
def test_a_question_mark_explains_every_column_mark_and_key(size: tuple[int, int]) -> None:
    async def scene() -> None:
        with publishing(FakeSkin("a", fake_structure(1, 2))):
            async with shown(size) as (app, pilot):
                await until(pilot, lambda: listed(app)[:1] == ["a live"])
                await pilot.press("?")
                await until(pilot, lambda: isinstance(app.screen, Help))
                explained = str(app.screen.query_one(Static).content)
                assert all(title in explained for title in COLUMNS)
                assert all(name in explained for name in MARK_NAMES.values())
                assert all(f"  {key}" in explained for key in KEYS)
                await pilot.press("escape")
                await until(pilot, lambda: not isinstance(app.screen, Help))
                assert listed(app)[:1] == ["a live"]

    go(scene)


def test_the_thread_of_keys_sleeps_until_there_is_one_or_it_shall_end() -> None:
    keys, answers = os.eventfd(0), SimpleQueue[bool]()
    end = EndOfKeys(keys)

    def ask() -> None:
        answers.put(end.is_set())
        os.eventfd_read(keys)
        while not end.is_set():
            answers.put(False)
        answers.put(True)

    thread = Thread(target=ask)
    thread.start()
    os.eventfd_write(keys, 1)
    found = [answers.get(timeout=PATIENCE_S) for _ in range(4)]  # Textual makes keys of bytes meanwhile
    end.set()
    thread.join()
    assert [*found, answers.get()] == [False, False, False, False, True]
    os.close(keys)
