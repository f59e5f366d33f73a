"""The page shows one moment whole: types, rings, arrows and the wipe test are of what is selected, and of now."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page

from skinware import PatchState, Status
from tests.browser.browsing import PATIENCE_MS, tell, until
from tests.browser.fake_server import MONOTONIC_NS, FakeDriver, FakeServer
from tests.browser.sleeve import Sleeve

OpenPage = Callable[..., Page]
OPTIONS = "[...document.querySelectorAll('#types option')].map(option => option.text)"
EMPTY = "document.getElementById('empty').checkVisibility() ? document.getElementById('empty').innerText : ''"
INK = """(() => {
  const {width, height} = document.querySelector('canvas.over');
  const data = document.querySelector('canvas.over').getContext('2d').getImageData(0, 0, width, height).data;
  return data.filter((alpha, i) => i % 4 === 3 && alpha).length;
})()"""
"""JavaScript: pixels with a ring, an arrow or a name."""


@pytest.fixture
def sheet() -> FakeDriver:
    return FakeDriver(0, "sheet", boards=2, triangles=4, placed=False)


@pytest.fixture
def server(sheet: FakeDriver) -> Iterator[FakeServer]:
    warm = FakeDriver(1, "warm", boards=1, triangles=4, placed=False)
    warm.position += sheet.position.max(axis=0)
    warm.type, warm.unit, warm.is_touch = "temperature", "degC", False
    server = FakeServer([sheet, warm])
    yield server
    server.close()


@pytest.fixture
def page(server: FakeServer, open_page: OpenPage) -> Page:
    page = open_page(f"{server.url}#theme=dark&sharp=1&names=0")
    until(page, "skin.connected && skin.drawn > 2 && skin.drivers.length === 2")
    return page


def choose(page: Page, key: str) -> None:
    page.locator(f"[data-role=row][data-key='{key}']").click()
    until(page, "skin.selected === a[0]", key)


def contact(sheet: FakeDriver, number: int, taxel: int) -> dict[str, Any]:
    place = {"position": sheet.position[taxel].tolist(), "normal": [0.0, 0.0, 1.0], "area_m2": 4e-4}
    return {"id": number, "kind": "touch", "load": 9.0, "unit": "counts", "speed": 0.0, "age_s": 1.0} | place


def test_types_are_those_of_what_is_selected_and_an_empty_stage_says_why(page: Page, server: FakeServer) -> None:
    assert tell(page, OPTIONS) == ["each its own", "pressure", "temperature"]
    choose(page, "default/sheet")
    assert tell(page, OPTIONS) == ["pressure"]
    page.keyboard.press("Escape")
    page.locator("#types select").select_option("pressure")
    assert tell(page, EMPTY) == ""
    choose(page, "default/warm")  # of a driver without that type, its own
    until(page, f"!({EMPTY}) && skin.pixelOf(1, 0)")
    page.goto("about:blank")
    page.goto(f"{server.url}#type=pressure&selected=default%2Fwarm")
    until(page, f"({EMPTY}).includes('warm has no pressure')")
    assert "It has temperature" in tell(page, EMPTY)
    page.keyboard.press("t")
    until(page, f"!({EMPTY}) && skin.type === 'temperature' && skin.pixelOf(1, 0)")
    page.keyboard.press("2")
    server.drivers.clear()
    server.names = ["torso"]
    server.restructure()
    until(page, f"({EMPTY}).includes('None of the drivers torso runs in namespace default')")
    assert "skin-driver --bus virtual --name torso" in tell(page, EMPTY)


def test_rings_and_arrows_are_of_the_moment_that_is_shown(page: Page, sheet: FakeDriver) -> None:
    assert tell(page, INK) == 0
    sheet.contacts = [contact(sheet, 7, 20)]
    sheet.shear = np.zeros((sheet.n, 2), np.int8)
    sheet.shear[60:70] = 100
    until(page, f"skin.contacts[0]?.id === 7 && {INK} > 500")
    page.keyboard.press("Space")
    sheet.contacts, sheet.shear = [contact(sheet, 8, 30)], None
    turn = tell(page, "skin.turn")
    until(page, "skin.turn > a[0] + 5", turn)
    page.keyboard.press("ArrowLeft")  # drawn again
    assert tell(page, "skin.contacts.map(({id}) => id)") == [7]
    assert "7\ttouch" in page.locator("#contacts").inner_text()
    page.keyboard.press("Space")
    until(page, "skin.contacts[0]?.id === 8")
    sheet.contacts = []
    until(page, f"!skin.contacts.length && {INK} === 0")


@pytest.mark.parametrize("way", ["stale", "dead", "another type"])
def test_nothing_of_what_is_over_stays(page: Page, sheet: FakeDriver, way: str) -> None:
    sheet.contacts = [contact(sheet, 7, 20)]
    sheet.shear = np.full((sheet.n, 2), 100, np.int8)
    until(page, f"skin.contacts.length === 1 && {INK} > 500")
    if way == "stale":
        sheet.status[:], sheet.contacts = 2, []
    elif way == "dead":
        sheet.state = "dead"
    else:
        page.locator("#types select").select_option("temperature")
    until(page, f"{INK} === 0")


def test_a_wipe_test_is_of_what_is_selected_and_of_touch(page: Page, server: FakeServer, sheet: FakeDriver) -> None:
    sheet.levels[:60] = 250
    sheet.status[[3, 5]] = [32, 8]  # switched off; no answer
    sheet.levels[[3, 5]] = 255
    page.locator("[data-role=mode][data-mode=wipe]").click()
    until(page, "skin.wipe?.of === 79 && skin.wipe.touched === 58")
    assert tell(page, "skin.pixelOf(1, 0)") is None  # temperature is not drawn
    choose(page, "default/sheet/can0/board 9")
    until(page, "skin.wipe?.of === 40 && skin.wipe.touched === 20")
    assert "board 9: 20 of 40 touched" in page.locator("[data-role=wipe]").inner_text()
    sheet.levels[40:] = 250
    until(page, "skin.untouched.length === 0")
    choose(page, "default/sheet/can0/board 8")
    until(page, "skin.untouched.join() === '0,5'")
    page.keyboard.press("Escape")
    choose(page, "default/warm")
    until(page, f"({EMPTY}).includes('nothing to wipe over') && skin.wipe.of === 0")


def test_a_problem_says_since_when_and_what_helps(page: Page, server: FakeServer, sheet: FakeDriver) -> None:
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    since_ns = str(MONOTONIC_NS + time.monotonic_ns() - 3600 * 10**9)
    place = {"driver": 0, "bus": "can0", "patch": "board 9"}
    sheet.problems = [{"severity": "warning", "text": "board 9 is stale", "since_ns": since_ns} | place]
    finding = {"severity": "warning", "where": "driver sheet, bus can0, board 9", "what": "a board is silent"}
    advice = {"evidence": "newest data 3.2 s old", "action": "check its cable", "commands": ["skin-top sheet"]}
    other = {
        "severity": "error",
        "where": "permissions",
        "what": "no rights",
        "evidence": "",
        "action": "",
        "commands": [],
    }
    server.findings = [finding | advice, other, other | {"severity": "note", "what": "no trouble"}]
    problems = page.locator("[data-role=problems]")
    until(page, "skin.problems.join() === 'permissions: no rights,sheet: board 9 is stale'")
    until(page, "document.getElementById('problems').innerText.includes('for 60 min')")
    problems.get_by_text("What to do").last.click()
    for text in ("a board is silent: newest data 3.2 s old", "check its cable", "skin-top sheet"):
        assert text in problems.inner_text()
    problems.get_by_role("button", name="Copy skin-top sheet").click()
    until(page, "document.getElementById('problems').innerText.includes('Copied')")
    assert tell(page, "navigator.clipboard.readText()") == "skin-top sheet"
    assert "no trouble" not in problems.inner_text()


def test_only_what_is_fresh_is_green_and_a_dead_driver_is_one_line(page: Page, sheet: FakeDriver) -> None:
    green = """[...document.querySelectorAll('[data-role=row]')].filter(row => {
        const [r, g, b] = getComputedStyle(row.querySelector('.sign')).color.match(/[0-9]+/g).map(Number);
        return g > r + 40 && g > b + 40;
    }).map(row => row.dataset.key.split('/').slice(1).join('/'))"""
    until(page, f"({green}).filter(key => key.startsWith('sheet')).length === 4")
    sheet.status[45] = 64  # suspect
    until(page, f"({green}).filter(key => key.startsWith('sheet')).join() === 'sheet/can0/board 8'")
    sheet.state = "dead"
    rows = "[...document.querySelectorAll('[data-role=row]')].map(row => row.dataset.key)"
    until(page, f"({rows}).filter(key => key.startsWith('default/sheet')).join() === 'default/sheet'")
    page.locator("[data-role=row][data-key='default/sheet'] .fold").click()
    until(page, f"({rows}).filter(key => key.startsWith('default/sheet')).length === 4")


def test_bodies_are_dragged_apart(page: Page, server: FakeServer, open_page: OpenPage) -> None:
    def places() -> list[list[float]]:
        return [tell(page, "skin.pixelOf(a[0], 0)", driver) for driver in (0, 1)]

    def drag(driver: int) -> None:
        page.mouse.move(*places()[driver])
        page.keyboard.down("Alt")
        page.mouse.down()
        x, y = places()[driver]
        page.mouse.move(x + 60, y - 40, steps=4)
        page.mouse.up()
        page.keyboard.up("Alt")

    still, before = places()
    drag(1)
    assert places()[0] == pytest.approx(still)
    assert places()[1] == pytest.approx([before[0] + 60, before[1] - 40], abs=1)
    assert tell(page, "skin.pins") == []
    choose(page, "default/sheet")
    page.locator("#stage").focus()
    still = places()[0]
    page.keyboard.press("Shift+ArrowRight")
    assert places()[0] == pytest.approx([still[0] + 12, still[1]], abs=1)
    until(page, "(location.hash.match(/at=/g) ?? []).length === 2")
    other = open_page(page.url)
    until(other, "skin.connected && skin.drawn > 2 && skin.pixelOf(1, 0)")
    assert tell(other, "skin.pixelOf(1, 0)") == pytest.approx(places()[1], abs=1.5)
    server.posed = True
    server.restructure()
    turn = tell(page, "skin.turn")
    until(page, "skin.turn > a[0] + 3", turn)
    still = places()[0]
    page.keyboard.press("Shift+ArrowRight")
    assert places()[0] == pytest.approx(still)  # its place is known


def test_the_doctor_is_asked_about_a_problem(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    sleeve.patch_state[2] = PatchState.STALE
    sleeve.status[sleeve.structure.patch_index(2)] = Status.STALE
    page = open_page(f"{address}#names=0")
    until(page, "document.querySelector('#problems code')?.textContent.startsWith('skin-')", within_ms=4 * PATIENCE_MS)
    sleeve.patch_state[2] = PatchState.LIVE
    sleeve.status[:] = 0
    until(page, "!document.querySelector('#problems code') && document.getElementById('problems').hidden")
