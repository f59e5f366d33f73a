"""Recordings in the page: its moments by an address, beside each other, and files that are dropped on it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from playwright.sync_api import Page

import skinware.recording
from skinware.memory.namespace import Namespace
from skinware.recording.files import Files
from skinware.recording.recorder import Recorder
from skinware_drivers.testing.waiting import wait_until
from tests.browser.browsing import DRIVER, RAW_SCALE, level, look, places, role, tell, until, viewing
from tests.browser.sleeve import Sleeve
from tests.cli.fake_skin import publishing

OpenPage = Callable[..., Page]
FRAMES, LENGTH_S = 30, 1.5
DROP = """([files, of]) => {
    const dropped = new DataTransfer();
    for (const [name, size] of files) dropped.items.add(new File([new Uint8Array(size)], name));
    document.dispatchEvent(new DragEvent("drop", { dataTransfer: dropped, bubbles: true, cancelable: true }));
}"""


@pytest.fixture
def recording(namespace: Namespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A sleeve whose first taxel is pressed at the begin, and its last one at the end."""
    monkeypatch.chdir(tmp_path)
    file = Path("walk.mcap")
    with publishing(Sleeve(), 50) as skin:
        assert isinstance(skin, Sleeve)
        skin.press(int(skin.taxels[0]))
        recorder = Recorder(Files(file))
        running = threading.Thread(target=recorder.run, args=(LENGTH_S,))
        running.start()
        wait_until(lambda: skin.writer.sequence > FRAMES)
        skin.press(int(skin.taxels[-1]))
        running.join()
    return file


@pytest.fixture
def address(recording: Path) -> Iterator[str]:
    """Serve the page of the recording; the server outlives all pages."""
    with viewing(str(recording)) as (_, url):
        yield url


def drop(page: Page, *files: tuple[str, int]) -> None:
    page.evaluate(DROP, [files, None])


def times(page: Page) -> list[float]:
    found: list[float] = tell(page, "skin.replays.map(({ time_s }) => time_s)")
    return found


def test_a_link_leads_to_a_moment(address: str, open_page: OpenPage) -> None:
    skin = Sleeve("unused")
    first, last = int(skin.taxels[0]), int(skin.taxels[-1])
    skin.close()
    page = open_page(f"{address}#{RAW_SCALE}&t=0.200")
    until(page, f"{level(first)} > 190 && {level(last)} < 20 && skin.replays[0].paused")
    x, y = (int(at) for at in places(page, [first])[0])
    pressed = look(page, x - 2, y - 2, x + 3, y + 3).mean()
    assert times(page) == [0.2]
    page.locator(role("replay")).get_by_role("slider").press("End")
    until(page, f"{level(last)} > 190 && {level(first)} < 20")
    assert abs(look(page, x - 2, y - 2, x + 3, y + 3).mean() - pressed) > 40
    until(page, "location.hash.includes('t=' + skin.replays[0].time_s.toFixed(3))")
    other = open_page(page.url)
    until(other, f"{level(last)} > 190 && skin.replays[0].time_s > 1")
    page.keyboard.press(" ")
    until(page, f"!skin.replays[0].paused && {level(first)} > 190")
    assert tell(page, "skin.drivers[0].state") == "live"
    until(page, "skin.outlines[0].samples?.length > 3")


def test_a_plot_has_the_times_of_the_recording(address: str, recording: Path, open_page: OpenPage) -> None:
    with skinware.recording.open(recording) as opened:
        series = opened["sleeve"].read(type_name="pressure")
    page = open_page(f"{address}#{RAW_SCALE}&t=1.000")
    until(page, "skin.replays[0]?.time_s === 1")
    until(page, f"skin.pixelOf({DRIVER}, 0)")
    x, y = places(page, [0])[0]
    page.mouse.move(x, y)
    until(page, "skin.hovered")
    taxel = tell(page, "skin.hovered[1]")
    page.keyboard.press("g")
    line = "skin.plots[0]?.lines[0]"
    until(page, f"{line}?.times.length > 20")  # nothing was played
    found = tell(page, line)
    assert np.allclose(np.array(found["times"]) / 1e9, series.time_s[: len(found["times"])], atol=1e-6)
    assert np.allclose(found["values"], series.physical("pressure")[: len(found["values"]), taxel])
    page.keyboard.press(" ")
    until(page, "skin.replays[0].time_s > 1.2")
    times = np.array(tell(page, f"{line}.times"))
    assert (np.diff(times) > 0).all()
    assert times.max() / 1e9 <= tell(page, "skin.replays[0].duration_s")


def test_a_person_chooses_how_recordings_match(address: str, recording: Path, open_page: OpenPage) -> None:
    Path("later.mcap").write_bytes(recording.read_bytes())
    page = open_page(f"{address.partition('?')[0]}?recording=walk.mcap&recording=later.mcap#t=0.500,0.900")
    until(page, "skin.replays.map(({ time_s }) => time_s).join() === '0.5,0.9'")
    match = page.get_by_label("Match")
    assert match.input_value() == "hand"
    assert match.locator("option[value=mark]").is_disabled()  # there is none
    match.select_option("day")
    until(page, "Math.abs(skin.replays[1].time_s - 0.5) < 0.001")
    match.blur()
    assert match.input_value() == "day"
    page.locator(role("replay")).get_by_role("slider").nth(1).press("Shift+End")
    until(page, "skin.replays[1].time_s > 1")
    until(page, "document.querySelector('label[title^=What] select').value === 'hand'")


def test_dropped_files_are_found_or_asked_for(address: str, recording: Path, open_page: OpenPage) -> None:
    Path("again.mcap").write_bytes(recording.read_bytes())
    size = recording.stat().st_size
    page = open_page(address.partition("?")[0])
    until(page, "skin.connected")
    drop(page, ("notes.txt", 5))
    until(page, "document.getElementById('notice').textContent.includes('no recording')")
    drop(page, (recording.name, size + 1))  # another file of this name
    until(page, "document.getElementById('notice').textContent.includes('skin-view walk.mcap')")
    drop(page, (recording.name, size))
    until(page, "window.skin?.replays.length === 1 && skin.drivers.length === 1")
    drop(page, ("again.mcap", size))
    until(page, "window.skin?.replays.length === 2 && skin.drivers.length === 2")
    assert parse_qs(urlsplit(page.url).query)["recording"] == ["walk.mcap", "again.mcap"]
    assert tell(page, "skin.drivers.map(({ name }) => name)") == ["sleeve (walk)", "sleeve (again)"]
    sides = [tell(page, "a[0].map(p => skin.pixelOf(skin.drivers[a[1]].id, p)[0])", [0, 1, 5, 600], i) for i in (0, 1)]
    assert max(sides[0]) < min(sides[1])  # in the order of the files
    assert not page.locator(role("record")).is_visible()
