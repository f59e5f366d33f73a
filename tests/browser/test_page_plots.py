"""Plots in the page: their values are those of the ring; they pause, zoom, and are saved."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page

import skinware.recording
from skinware import DriverReader
from tests.browser.browsing import DRIVER, PHONE, READY, places, role, tell, until
from tests.browser.sleeve import Sleeve

OpenPage = Callable[..., Page]
LINE = "skin.plots[0]?.lines[0]"
DRAWN = """(() => {
  const canvas = document.querySelector('[data-role=strip-canvas]');
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  return data.filter((blue, i) => i % 4 === 2 && blue > 200 && data[i - 2] < 120).length;
})()"""
"""JavaScript: pixels of the first line's colour."""


def plotted(page: Page, taxel: int) -> None:
    """Plot a taxel that is pointed at."""
    ((x, y),) = places(page, [taxel])
    page.mouse.move(x, y)
    until(page, f"'' + skin.hovered === {DRIVER} + ',' + a[0]", taxel)
    page.keyboard.press("g")
    until(page, f"{LINE}?.times.length > 5")


def test_the_values_of_a_plot_are_those_of_the_ring(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#theme=dark&names=0")
    until(page, READY)
    taxel = int(sleeve.taxels[333])
    plotted(page, taxel)
    seen: dict[int, float] = {}
    with DriverReader("sleeve") as reader:
        for frame in reader.in_order(timeout_s=5):
            seen[frame.published_ns] = 255.0 - frame.values[taxel]
            if len(seen) % 10 == 0:
                sleeve.press(*[taxel] * (len(seen) % 20 == 0))
            if len(seen) == 60:
                break
    until(page, f"{LINE}.times.at(-1) >= a[0]", max(seen))
    line = tell(page, LINE)
    found = dict(zip(line["times"], line["values"], strict=True))
    assert {time: found.get(time) for time in seen} == seen
    assert set(seen.values()) == {15, 215}
    assert tell(page, DRAWN) > 50
    assert tell(page, "skin.plots[0].unit") == "counts"
    until(page, "location.hash.includes('plot=')")
    other = open_page(page.url)  # an address keeps the plots
    until(other, f"{LINE}?.times.length > 5")
    assert tell(other, LINE)["key"] == line["key"]


def test_it_stands_still_zooms_and_has_a_cursor(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#theme=dark&names=0")
    until(page, READY)
    plotted(page, int(sleeve.taxels[333]))
    until(page, f"{LINE}.times.at(-1) - {LINE}.times[0] > 1e9")  # a step of the cursor goes back by half a second
    page.keyboard.press("m")
    until(page, "skin.marks[0]?.text === 'mark 1'")
    page.keyboard.press("Space")
    until(page, "skin.paused")
    count, turn = tell(page, f"[{LINE}.times.length, skin.turn]")
    until(page, "skin.turn > a[0] + 5", turn)
    assert tell(page, f"{LINE}.times.length") == count
    canvas = page.locator("[data-role=strip-canvas]")
    canvas.focus()
    page.keyboard.press("+")
    assert tell(page, "skin.plots[0].span_s") == pytest.approx(60 / 1.25)
    page.keyboard.press("ArrowLeft")
    assert "15 counts" in str(canvas.get_attribute("aria-valuetext"))
    assert float(str(canvas.get_attribute("aria-valuenow"))) < 0
    box = canvas.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] - 40, box["y"] + 40)
    page.mouse.wheel(0, -100)
    until(page, "skin.plots[0].span_s < 40")
    page.locator(role("pause")).click()
    until(page, f"{LINE}.times.length > a[0]", count)


def test_it_is_saved_for_papers(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#theme=dark&names=0")
    until(page, READY)
    taxel = int(sleeve.taxels[333])
    plotted(page, taxel)
    page.locator("[data-role=row][data-patch='board 8']").click()
    page.mouse.move(3, 3)
    until(page, "skin.hovered === null")
    page.keyboard.press("g")
    until(page, "skin.plots[0].lines.length === 2 && skin.plots[0].lines[1].times.length > 5")
    until(page, f"{LINE}.label === a[0]", sleeve.structure.sensor_name(taxel))
    page.locator(role("pause")).click()
    files = {}
    for kind in ("CSV", "SVG", "PNG"):
        with page.expect_download() as download:
            page.locator(role("strip")).get_by_role("button", name=kind).click()
        files[kind] = Path(download.value.path())
    head, *rows = list(csv.reader(files["CSV"].read_text().splitlines()))
    name = sleeve.structure.sensor_name(taxel)
    assert head == ["time_ns", f"{name} [counts]", "board 8, sum [counts]"]
    line = tell(page, LINE)
    values = {int(row[0]): float(row[1]) for row in rows if row[1]}
    assert values == dict(zip(map(int, line["times"]), line["values"], strict=True))
    assert float(rows[-1][2]) == 160 * 15
    svg = files["SVG"].read_text()
    assert svg.startswith("<svg ")
    for text in (f">{name}<", ">board 8, sum<", ">counts<", "sleeve (fake), 20", "UTC", "0 s"):
        assert text in svg
    assert files["PNG"].read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    with page.expect_download() as download:
        page.keyboard.press("S")
    svg = Path(download.value.path()).read_text()
    for text in ("255 counts", "sleeve pressure", "Values. sleeve (fake), 20", "data:image/png;base64,"):
        assert text in svg


def test_a_spectrum_of_one_line(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#theme=dark&names=0")
    until(page, READY)
    plotted(page, int(sleeve.taxels[333]))
    until(page, f"{LINE}.times.length > 40")
    page.locator(role("strip")).get_by_role("button", name="Spectrum").click()
    until(page, "skin.plots[0].spectrum?.amplitude.length > 8")
    assert np.abs(tell(page, "skin.plots[0].spectrum.amplitude")).max() < 1e-9  # it rests


def test_lines_are_dragged_into_strips(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#theme=dark&names=0")
    until(page, READY)
    plotted(page, int(sleeve.taxels[333]))
    strips = page.locator(role("strip"))
    row = page.locator("[data-role=row][data-patch='board 9']")
    row.drag_to(page.locator("[data-role=strip-canvas]"))
    until(page, "skin.plots[0].lines.length === 2")
    strips.get_by_role("button", name="Remove this line").first.click()
    until(page, "skin.plots[0].lines.length === 1")
    strips.get_by_role("button", name="Close this strip").click()
    until(page, "!skin.plots.length")


def test_a_mark_is_in_the_recording(sleeve: Sleeve, address: str, open_page: OpenPage, tmp_path: Path) -> None:
    page = open_page(address)
    until(page, READY)
    page.keyboard.press("r")
    until(page, "skin.recording?.bytes > 0")
    page.keyboard.press("m")
    until(page, "document.body.innerText.includes('mark 1 is in ')")
    page.keyboard.press("r")
    until(page, "!skin.recording")
    (file,) = tmp_path.glob("*.mcap")
    with skinware.recording.open(file) as recording:
        assert [event["text"] for event in recording.events if event["event"] == "mark"] == ["mark 1"]


def test_strips_fit_into_a_telephone(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#names=0", PHONE)
    until(page, READY)
    plotted(page, int(sleeve.taxels[333]))
    wide = """[...document.querySelectorAll('#plots, #plots *')].filter(one => one.checkVisibility()
        && one.getBoundingClientRect().right > innerWidth + 1).map(one => one.outerHTML.slice(0, 80))"""
    assert tell(page, wide) == []
    box = page.locator("#stage").bounding_box()
    assert box is not None
    assert box["height"] > 0.2 * PHONE[1]
