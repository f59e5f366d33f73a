"""The page shows one moment whole: types, rings, arrows and the wipe test are of what is selected, and of now."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page

from tests.browser.browsing import tell, until
from tests.browser.fake_server import FakeDriver, FakeServer

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
    choose(page, "default/warm")
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
