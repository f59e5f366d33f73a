"""What a person does on the page: points, clicks, types, scrolls back, records, and opens it on a telephone."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page

import skinware.recording
from skinware import PatchState, Status
from tests.browser.browsing import (
    DESKTOP,
    DRIVER,
    PHONE,
    RAW_SCALE,
    READY,
    let_settle,
    level,
    look,
    places,
    role,
    states,
    tell,
    until,
)
from tests.browser.sleeve import Sleeve

OpenPage = Callable[..., Page]


def place(page: Page, position: int) -> tuple[float, float]:
    """Where a taxel is on the screen."""
    ((x, y),) = places(page, [position])
    return float(x), float(y)


def let_rest(page: Page) -> None:
    """Wait until the camera glides no more, and the address tells where it is."""
    eyes = [None, tell(page, "skin.camera.position")]
    while eyes[-2] != eyes[-1]:
        page.wait_for_timeout(400)
        eyes.append(tell(page, "skin.camera.position"))


FIGURES_BESIDE_NAMES = """(() => {
  const row = document.querySelector(a[0]), name = row.querySelector(".name"), cut = [];
  const room = row.querySelector(".figures"), own = name.textContent;
  let whole = 0;
  for (let length = 1; length <= 40; length++) {
    name.textContent = "n".repeat(length);
    const box = room.getBoundingClientRect(), figure = room.firstElementChild.getBoundingClientRect();
    if (figure.top >= box.bottom - 1) continue;
    if (figure.left < box.left - 0.5 || figure.right > box.right + 0.5) cut.push(length);
    else whole++;
  }
  name.textContent = own;
  return [whole, cut];
})()"""
"""JavaScript: beside how many of 40 names the first figure of a row is seen whole, and beside which it is cut."""


def test_a_taxel_is_named_where_the_mouse_points(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#{RAW_SCALE}")
    until(page, READY)
    for taxel in map(int, sleeve.taxels[[0, 333, 639]]):
        sleeve.press(taxel)
        page.mouse.move(*place(page, taxel))
        until(page, f"'' + skin.hovered === {DRIVER} + ',' + a[0]", taxel)
        until(page, "document.body.innerText.includes(a[0])", sleeve.structure.sensor_name(taxel))
        until(page, "document.body.innerText.includes('215 counts')")  # 255 - 40
    page.mouse.move(3, 3)
    until(page, "skin.hovered === null")


def test_taxels_are_pinned_and_let_go(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#{RAW_SCALE}")
    until(page, READY)
    first, second = (int(taxel) for taxel in sleeve.taxels[[100, 500]])
    for taxel in (first, second):
        page.mouse.click(*place(page, taxel))
    until(page, "skin.pins.map(pin => pin[1]).join() === a[0].join()", [first, second])
    cards = page.locator(role("pin"))
    assert cards.count() == 2
    until(page, "document.querySelector(a[0]).innerText.includes('40')", role("pin"))  # the idle raw value is 240
    text = cards.first.inner_text()
    assert sleeve.structure.sensor_name(first) in text
    assert f"{int(sleeve.structure.sensor_uid[first]):x}" in text.lower()
    page.mouse.click(*place(page, first))
    until(page, "skin.pins.map(pin => pin[1]).join() === a[0].join()", [second])


def test_problems_stand_first_and_a_row_leads_to_its_taxels(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    sleeve.patch_state[2] = PatchState.STALE
    sleeve.status[sleeve.structure.patch_index(2)] = Status.STALE
    page = open_page(f"{address}#{RAW_SCALE}")
    until(page, "skin.problems.some(text => text.includes('board 9'))")
    assert "board 9" in page.locator(role("problems")).inner_text()
    page.locator(role("problems")).get_by_role("button", name="board 9 is stale").click()
    until(page, "skin.selected?.endsWith('/board 9')")
    stale, others = (int(np.flatnonzero(sleeve.structure.sensor_patch == patch)[0]) for patch in (2, 0))
    assert states(page, [stale, others], "dimmed") == [False, True]
    before = look(page)
    page.locator(role("row", "[data-patch='board 8']")).click()
    until(page, "skin.selected?.endsWith('/board 8')")
    page.wait_for_timeout(300)
    assert abs(look(page) - before).mean() > 1


def test_a_figure_beside_a_long_name_is_whole_or_not_there(address: str, sleeve: Sleeve, open_page: OpenPage) -> None:
    page = open_page(address)
    until(page, f"{READY} && document.querySelector(a[0]).innerText.includes('Hz')", role("row"))
    whole, cut = tell(page, FIGURES_BESIDE_NAMES, role("row"))
    assert cut == []
    assert 0 < whole < 40  # there is no room beside the longest


def test_peaks_stay_and_zero_is_what_is_felt_now(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#scale=0,255")
    until(page, READY)
    one, other = (int(taxel) for taxel in sleeve.taxels[[200, 400]])
    page.locator(role("mode", "[data-mode=peak]")).click()
    until(page, "skin.drawnMode === 'peak'")
    let_settle(page, sleeve)
    for taxel in (one, other):
        sleeve.press(taxel)
        until(page, f"{level(taxel)} > 150")
    assert tell(page, level(one)) > 150
    page.locator(role("mode", "[data-mode=change]")).click()
    until(page, f"skin.drawnMode === 'change' && {level(other)} > 150 && {level(one)} < 50")
    page.keyboard.press("b")
    until(page, f"{level(other)} < 50")
    let_settle(page, sleeve)
    sleeve.press(other, one)
    until(page, f"{level(one)} > 150")
    assert tell(page, level(other)) < 50


def test_a_wipe_test_counts_what_was_touched(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(address)
    until(page, READY)
    page.locator(role("mode", "[data-mode=wipe]")).click()
    until(page, "skin.wipe?.of === a[0]", len(sleeve.taxels))
    let_settle(page, sleeve)
    touched, never = sleeve.taxels[:-17], sleeve.taxels[-17:]
    for part in np.array_split(touched, 4):
        sleeve.press(*part)
        until(page, "skin.wipe.touched >= a[0]", int(np.searchsorted(touched, part[-1])) + 1)
    sleeve.press()
    assert tell(page, "skin.wipe.touched") == len(touched)
    until(
        page, f"document.querySelector(a[0]).innerText.includes('{len(touched)} of {len(sleeve.taxels)}')", role("wipe")
    )
    assert set(states(page, never, "mark")) == {"not touched"}
    assert set(states(page, touched, "mark")) == {"fresh"}
    with page.expect_download() as download:
        page.locator(role("wipe")).get_by_role("button", name="Save").click()
    text = Path(download.value.path()).read_text()
    assert [sleeve.structure.sensor_name(int(taxel)) in text for taxel in never] == [True] * len(never)
    assert sleeve.structure.sensor_name(int(touched[0])) + "\n" not in text


def test_the_past_is_there_while_it_goes_on(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#{RAW_SCALE}")
    until(page, READY)
    early, late = (int(taxel) for taxel in sleeve.taxels[[50, 600]])
    sleeve.press(early)
    until(page, f"{level(early)} > 200")
    page.wait_for_timeout(300)
    then = tell(page, "performance.now()")
    page.wait_for_timeout(300)
    sleeve.press(late)
    until(page, f"{level(late)} > 200 && {level(early)} < 50")
    page.locator(role("pause")).click()
    until(page, "skin.paused")
    sleeve.press()
    back_s = tell(page, "(a[0] - performance.now()) / 1000", then)
    tell(
        page,
        "(slider => { slider.value = a[1]; slider.dispatchEvent(new Event('input', {bubbles: true})) })"
        "(document.querySelector(a[0]))",
        role("past"),
        back_s,
    )
    until(page, f"skin.at_s < 0 && {level(early)} > 200 && {level(late)} < 50")
    page.locator(role("pause")).click()
    until(page, f"!skin.paused && {level(late)} < 50 && {level(early)} < 50")


def test_keys_do_what_buttons_do(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(address)
    until(page, READY)
    page.keyboard.press("?")
    until(page, "document.querySelector('dialog').open")
    page.keyboard.press("Escape")
    until(page, "!document.querySelector('dialog').open && document.activeElement === document.body")
    page.keyboard.press("Space")
    until(page, "skin.paused")
    page.keyboard.press("Space")
    until(page, "!skin.paused")
    theme = tell(page, "skin.theme")
    page.keyboard.press("d")
    until(page, "skin.theme !== a[0]", theme)


@pytest.mark.quick
@pytest.mark.parametrize("size", [PHONE, (320, 568), (844, 390), DESKTOP])
def test_nothing_is_wider_than_the_window(
    sleeve: Sleeve, address: str, open_page: OpenPage, size: tuple[int, int]
) -> None:
    page = open_page(address, size, has_touch=size[0] < 900)
    until(page, READY)
    overflowing = """[...document.querySelectorAll('body *')].filter(element => {
        const box = element.getBoundingClientRect();
        return box.width && box.height && element.checkVisibility() && (box.right > innerWidth + 1 || box.left < -1);
    }).map(element => element.outerHTML.slice(0, 100))"""
    assert tell(page, overflowing) == []
    assert tell(page, "document.documentElement.scrollWidth") <= size[0]
    canvas = page.locator("canvas").first.bounding_box()
    assert canvas is not None
    assert canvas["height"] > 0.3 * size[1]
    for taxel in sleeve.taxels[[0, -1]]:
        x, y = place(page, int(taxel))
        assert 0 <= x <= size[0]
        assert 0 <= y <= size[1]


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_theme_is_that_of_the_system(sleeve: Sleeve, address: str, open_page: OpenPage, theme: str) -> None:
    page = open_page(address, color_scheme=theme)
    until(page, READY)
    assert tell(page, "skin.theme") == theme
    assert (np.median(look(page)) > 128) == (theme == "light")


def test_an_address_shows_the_same_to_others(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(address, reduced_motion="reduce")
    until(page, READY)
    page.locator(role("mode", "[data-mode=peak]")).click()
    x, y = place(page, int(sleeve.taxels[320]))
    page.mouse.move(x + 60, y + 40)
    page.mouse.down()
    page.mouse.move(x + 160, y - 40, steps=4)
    page.mouse.up()
    page.mouse.wheel(0, -300)
    let_rest(page)
    page.mouse.click(*place(page, int(sleeve.taxels[320])))
    until(page, "skin.pins.length === 1")
    let_rest(page)
    other = open_page(page.url)
    until(other, f"{READY} && skin.pins.length === 1 && skin.mode === 'peak'")
    for taxel in map(int, sleeve.taxels[[0, 320, 639]]):
        assert place(other, taxel) == pytest.approx(place(page, taxel), abs=1.5)


def test_a_recording_of_the_page_is_read(sleeve: Sleeve, address: str, open_page: OpenPage, tmp_path: Path) -> None:
    page = open_page(address)
    until(page, READY)
    page.locator(role("record")).click()
    until(page, "skin.recording?.bytes > 0")
    sleeve.press(int(sleeve.taxels[9]))
    until(page, "skin.recording.s > 1")
    page.locator(role("record")).click()
    until(page, "!skin.recording")
    (file,) = tmp_path.glob("*.mcap")
    with skinware.recording.open(file) as recording:
        values = recording["sleeve"].read(["values"]).column("values")
    assert len(values) > 20
    assert (values[-1, sleeve.taxels] == 40).sum() == 1


def test_a_picture_is_saved(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#{RAW_SCALE}&theme=dark")
    until(page, READY)
    sleeve.press(*map(int, sleeve.taxels))
    until(page, f"{level(int(sleeve.taxels[-1]))} > 200")
    with page.expect_download() as download:
        page.locator(role("picture")).click()
    assert download.value.suggested_filename.endswith(".png")
    with Image.open(io.BytesIO(Path(download.value.path()).read_bytes())) as image:
        grey = np.asarray(image.convert("L"))
    assert (grey > 150).mean() > 0.05  # it has the taxels in it
