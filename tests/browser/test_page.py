"""The page against a server that says what a test wants: what it shows, what it asks for, and what it survives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page

from skinware_drivers.testing.waiting import wait_until
from tests.browser.browsing import DRIVER, PHONE, READY, Troubles, look, role, tell, until
from tests.browser.fake_server import FakeDriver, FakeServer

OpenPage = Callable[..., Page]
LEGEND = "document.querySelector('#scaling').innerText"


@pytest.fixture
def driver() -> FakeDriver:
    return FakeDriver(0, "sheet", boards=4, triangles=4, placed=False)


@pytest.fixture
def server(driver: FakeDriver) -> Iterator[FakeServer]:
    server = FakeServer([driver])
    yield server
    server.close()


@pytest.fixture
def page(server: FakeServer, open_page: OpenPage) -> Page:
    page = open_page(f"{server.url}#theme=dark&sharp=1")
    until(page, READY)
    return page


def asked(server: FakeServer, op: str) -> list[dict[str, Any]]:
    return [one for one in server.ops if one["op"] == op]


def test_a_silent_server_is_told_and_left_for_a_new_connection(page: Page, server: FakeServer) -> None:
    """One that accepts connections and answers nothing is no connection: what is shown stays old until turns come."""
    server.muted = True
    until(page, "!skin.connected")
    banner = page.locator(role("lost"))
    assert "Trying again" in banner.inner_text()
    page.wait_for_timeout(700)
    assert banner.is_visible()
    assert tell(page, "skin.stateOf(0, 0).mark") == "stale"
    server.muted = False
    until(page, "skin.connected && skin.stateOf(0, 0).mark === 'fresh'")
    assert not banner.is_visible()


def test_a_lost_gpu_changes_nothing_but_the_way_of_drawing(page: Page, driver: FakeDriver) -> None:
    driver.levels[:80] = 250
    until(page, "skin.stateOf(0, 0).level === 250")
    page.wait_for_timeout(200)
    before = look(page)
    lose = (
        "document.querySelector('#stage canvas').getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
    )
    tell(page, lose)
    until(page, "skin.flat")
    drawn = tell(page, "skin.drawn")
    until(page, "skin.drawn > a[0] + 5", drawn)
    x, y = tell(page, "skin.pixelOf(0, 40)")
    rows, columns = slice(round(y) - 20, round(y) + 20), slice(round(x) - 20, round(x) + 20)
    after = look(page)
    assert np.corrcoef(after[rows, columns].ravel(), before[rows, columns].ravel())[0, 1] > 0.9  # pixels may be coarser
    assert page.locator("#stage canvas").count() == 2


def test_a_selected_patch_steps_forward(page: Page, server: FakeServer) -> None:
    page.locator(role("row", "[data-patch='board 9']")).click()
    until(page, "skin.selected === 'default/sheet/can0/board 9'")
    assert tell(page, "[39, 40, 79, 80].map(i => skin.stateOf(0, i).dimmed)") == [True, False, False, True]
    page.keyboard.press("Escape")
    until(page, "skin.selected === null && !skin.stateOf(0, 0).dimmed")


def test_the_tree_is_walked_with_keys(page: Page) -> None:
    focused = "document.activeElement.dataset.key"
    page.locator(role("row")).first.focus()
    for key, row in (
        ("ArrowDown", "default/sheet/can0"),
        ("End", "default/sheet/can0/board 11"),
        ("ArrowLeft", "default/sheet/can0"),
        ("ArrowLeft", "default/sheet/can0"),
        ("ArrowDown", "default/sheet/can0"),
        ("ArrowRight", "default/sheet/can0"),
        ("ArrowRight", "default/sheet/can0/board 8"),
    ):
        page.keyboard.press(key)
        assert tell(page, focused) == row
    page.keyboard.press("Enter")
    until(page, "skin.selected === 'default/sheet/can0/board 8'")
    assert page.locator("[role=treeitem][tabindex='0']").count() == 1


def test_taxels_are_read_and_pinned_without_a_mouse(page: Page, server: FakeServer) -> None:
    page.keyboard.press("j")
    page.keyboard.press("j")
    until(page, "'' + skin.hovered === '0,1'")
    until(page, "document.getElementById('tip').innerText.includes('board 8, triangle 0, taxel 1')")
    page.keyboard.press("p")
    until(page, "skin.pins.join() === '0,1'")
    assert asked(server, "exact")[-1]["sensors"] == [[0, 1]]
    wait_until(lambda: {"driver": 0, "position": 1} in asked(server, "plot")[-1]["lines"])
    until(page, "document.querySelector('[data-role=pin] path').getAttribute('d')")
    page.keyboard.press("Escape")
    until(page, "!skin.pins.length && skin.hovered === null")
    wait_until(lambda: asked(server, "exact")[-1]["sensors"] == [])


def test_pins_outlive_a_restart_of_the_driver(page: Page, server: FakeServer, driver: FakeDriver) -> None:
    for taxel in (5, 77):
        page.mouse.click(*tell(page, "skin.pixelOf(0, a[0])", taxel))
    until(page, "skin.pins.join() === '0,5,0,77'")
    server.drivers.clear()
    server.restructure()
    until(page, "!skin.drivers.length && !skin.pins.length")
    driver.generation = "2"
    server.drivers.append(driver)
    server.restructure()
    until(page, "skin.pins.join() === '0,5,0,77'")


def test_the_past_of_one_driver_outlives_the_start_of_another(page: Page, server: FakeServer) -> None:
    until(page, "skin.kept_bytes > 2000")
    kept = tell(page, "skin.kept_bytes")
    server.drivers.append(FakeDriver(1, "other", boards=1, triangles=1, placed=False))
    server.restructure()
    until(page, "skin.drivers.length === 2")
    assert tell(page, "skin.kept_bytes") >= kept


def test_a_dead_driver_is_old_at_once_and_first_in_the_list(page: Page, server: FakeServer, driver: FakeDriver) -> None:
    driver.state = "dead"
    driver.problems = [{"severity": "error", "driver": 0, "text": "its process is gone"}]
    until(page, "skin.stateOf(0, 0).mark === 'stale'")
    assert page.locator(role("problems")).inner_text().count("sheet: its process is gone") == 1
    row = page.locator(role("row")).first
    assert "dead" in row.inner_text()
    assert "✕" in row.inner_text()  # told without colour


def test_recordings_are_controlled_together_or_alone(page: Page, server: FakeServer) -> None:
    assert not page.locator(role("replay")).is_visible()
    how: dict[str, Any] = {"paused": False, "loop": False, "speed": 1.5}
    server.extra["replays"] = [
        {"file": "x.mcap", "title": "x", "time_s": 3.0, "duration_s": 60.0, **how},
        {"file": "y.mcap", "title": "y", "time_s": 5.0, "duration_s": 50.0, **how},
    ]
    mark = {"event": "mark", "text": "slip", "time_s": 30.0}
    outline: dict[str, Any] = {
        "until_s": 60,
        "samples": [9] * 60,
        "missed": [0, 7] + [0] * 58,
        "contacts": [2] * 60,
        "events": [mark],
    }
    server.extra["outlines"] = [outline, {}]
    panel = page.locator(role("replay"))
    panel.wait_for()
    assert not page.locator("#rewind").is_visible()
    assert "0:03.0 of 1:00.0" in panel.inner_text()
    for name in ("Pause", "Back", "Step", "Loop"):
        panel.get_by_role("button", name=name).click()
    assert panel.get_by_label("Speed").input_value() == "1.5"
    panel.get_by_label("Speed").select_option("4")
    first, second = panel.get_by_role("slider").all()
    width = int((first.bounding_box() or {"width": 0})["width"])
    first.hover(position={"x": width // 2 + 3, "y": 15})
    assert first.inner_text() == "0:30.0 slip, 2 contacts"
    first.hover(position={"x": width / 60 * 1.5, "y": 15})
    assert "7 samples missed" in first.inner_text()
    first.click(position={"x": width // 2 + 3, "y": 15})
    second.click(position={"x": width // 2, "y": 15}, modifiers=["Shift"])
    second.press("End")
    wait_until(lambda: len(asked(server, "replay")) == 11)
    orders = [(one["action"], one["value"], one["number"]) for one in asked(server, "replay")]
    assert orders[:6] == [
        ("resume", None, None),  # of the page itself, from the begin on
        ("pause", None, None),
        ("step", -1, None),
        ("step", 1, None),
        ("loop", True, None),
        ("speed", 4, None),
    ]
    assert orders[6:8] == [("seek", 30, 0), ("seek", 32, 1)]  # at the mark, and as far on
    assert (orders[8][0], orders[8][2]) == ("seek", 1)
    assert abs(orders[8][1] - 25) < 0.2
    assert orders[9:] == [("seek", 48, 0), ("seek", 50, 1)]


def test_a_wipe_test_lists_what_was_not_touched(page: Page, server: FakeServer, driver: FakeDriver) -> None:
    driver.levels[:] = 250
    driver.levels[[3, 141]] = [249, 0]
    server.look["mode"] = "wipe"
    page.locator(role("mode", "[data-mode=wipe]")).click()
    until(page, f"skin.untouched.join() === '0,3,0,141' && skin.stateOf({DRIVER}, 3).name")
    with page.expect_download() as download:
        page.keyboard.press("l")
    lines = download.value.path().read_text().splitlines()
    assert lines[0].startswith("# 158 of 160 touched")
    assert lines[2:] == [
        "sheet\t3\t0x70003\tboard 8, triangle 0, taxel 3",
        "sheet\t141\t0x7008d\tboard 11, triangle 2, taxel 1",
    ]


def test_a_picture_shows_what_the_page_shows(page: Page, driver: FakeDriver) -> None:
    with page.expect_download() as download:
        page.locator(role("picture")).click()
    data = download.value.path().read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert len(data) > 3000


def test_figures_of_contacts_and_regions_do_not_wrap(page: Page, server: FakeServer, driver: FakeDriver) -> None:
    """Also where their units differ, and are told beside each."""
    contact = {"kind": "sliding", "load": 12345.6, "speed": 0.1234, "age_s": 0.456, "taxels": 9}
    place = {"position": driver.position[20].tolist(), "normal": [0.0, 0.0, 1.0], "area_m2": 4e-4}
    driver.contacts = [{"id": i, "unit": unit} | contact | place for i, unit in ((8, "counts"), (1234, "N"))]
    driver.regions = [
        {"name": name, "value": 12345.6, "unit": "counts", "speed": 0.0, "touched": True}
        for name in ("palm", "the whole of the left forearm")
    ]
    until(page, "skin.contacts.length === 2")
    until(page, "document.querySelector('#contacts').innerText.includes('12,346 counts')")
    assert "12,346\t" in page.locator("#regions").inner_text()
    assert "counts" in page.locator("#regions thead").inner_text()
    until(page, "document.querySelectorAll('#contacts tbody tr').length === 2")
    heights = tell(page, "[...document.querySelectorAll('#contacts tbody td, th')].map(cell => cell.clientHeight)")
    assert max(heights) < 30  # a line has 18


def test_contacts_and_shear_are_drawn(page: Page, server: FakeServer, driver: FakeDriver) -> None:
    driver.shear = np.zeros((driver.n, 2), np.int8)
    before = look(page)
    driver.shear[60:70] = 100
    contact = {"id": 12, "kind": "hold", "load": 31.5, "unit": "counts", "speed": 0.0, "age_s": 2.0, "area_m2": 4e-4}
    place = {"position": driver.position[20].tolist(), "normal": [0.0, 0.0, 1.0], "taxels": 9}
    driver.contacts = [contact | place]
    until(page, "skin.contacts.length === 1 && skin.contacts[0].id === 12")
    until(page, "document.querySelector('#contacts').innerText.includes('load, counts')")
    assert "load, counts\tmm/s\ts" in page.locator("#contacts").inner_text()
    assert "12\thold\t31.5\t0\t2" in page.locator("#contacts").inner_text()
    page.wait_for_timeout(200)
    after = look(page)
    for taxel in (20, 65):
        x, y = (round(c) for c in tell(page, "skin.pixelOf(0, a[0])", taxel))
        assert abs(after[y - 12 : y + 12, x - 12 : x + 12] - before[y - 12 : y + 12, x - 12 : x + 12]).max() > 60


def stl(*corners: tuple[float, float, float]) -> bytes:
    """A mesh of one triangle, in the binary form."""
    triangle = np.array([(0, 0, 1), *corners], "<f4").tobytes()
    return bytes(80) + (1).to_bytes(4, "little") + triangle + bytes(2)


def test_meshes_of_links_stand_behind_taxels(page: Page, server: FakeServer, driver: FakeDriver) -> None:
    """One that cannot be read is told, and does not hide the others."""
    middle = driver.position.mean(axis=0)
    size = float(np.ptp(driver.position[:, 0]))
    server.files["/mesh/0"] = stl((0, 0, 0), (size, 0, 0), (0, size, 0))
    pose = [1, 0, 0, middle[0] - size / 3, 0, 1, 0, middle[1] - size / 3, 0, 0, 1, -0.01, 0, 0, 0, 1]
    server.links = [
        {"frame": "broken", "mesh": "mesh/1", "pose": pose},
        {"frame": "plate", "mesh": "mesh/0", "pose": [float(x) for x in pose]},
    ]
    server.links[0]["pose"] = server.links[1]["pose"]
    server.files["/mesh/1"] = b"solid nothing"
    x, y = (round(c) for c in tell(page, "skin.pixelOf(0, 80)"))
    before = look(page)
    server.restructure()
    until(page, "skin.meshes === 1")
    page.wait_for_timeout(300)
    assert (abs(look(page) - before) > 8).mean() > 0.02
    assert look(page)[y, x] == pytest.approx(before[y, x], abs=8)


def test_a_fixed_scale_is_asked_for_and_forgotten(page: Page, server: FakeServer) -> None:
    page.locator("#low").fill("10")
    page.locator("#high").fill("90.5")
    page.keyboard.press("Enter")
    wait_until(lambda: server.look.get("scale") == [10, 90.5])
    until(page, "location.hash.includes('scale=10')")
    page.keyboard.press("Tab")
    page.locator("#auto").click()
    wait_until(lambda: server.look["scale"] is None)


@pytest.fixture
def in_newtons(server: FakeServer, driver: FakeDriver) -> FakeDriver:
    """A second driver, of another type and unit."""
    second = FakeDriver(1, "finger", boards=1, triangles=4, placed=False)
    second.position += driver.position.max(axis=0)
    second.type, second.unit, second.scale = "force_z", "N", (0, 1.5)
    server.drivers.append(second)
    return second


def test_the_legend_is_of_what_is_shown(page: Page, server: FakeServer, in_newtons: FakeDriver) -> None:
    """Each scale has its own unit; of a selected driver, only its own; of one type, only that of the type."""
    assert page.locator("#scale").is_visible()
    server.restructure()
    until(page, f"{LEGEND}.includes('finger force_z')")
    rows = page.locator("#scales > .scale")
    assert [row.split() for row in rows.all_inner_texts()] == [
        ["0", "250", "counts", "sheet", "pressure"],
        ["0", "1.5", "N", "finger", "force_z"],
    ]
    assert not page.locator("#scale").is_visible()  # no numbers hold for both units
    page.get_by_text("finger", exact=True).first.click()
    until(page, f"!{LEGEND}.includes('sheet')")
    assert rows.all_inner_texts()[0].split() == ["0", "1.5", "N", "finger", "force_z"]
    page.keyboard.press("Escape")
    page.locator("#types select").select_option("force_z")
    page.locator("#scale").wait_for(state="visible")
    assert page.locator("#unit").inner_text() == "N"
    assert page.locator("#high").input_value() == "1.5"


def test_a_scale_that_was_chosen_does_not_outlive_its_unit(
    page: Page, server: FakeServer, in_newtons: FakeDriver
) -> None:
    page.locator("#low").fill("10")
    page.locator("#high").fill("90")
    page.keyboard.press("Enter")
    wait_until(lambda: server.look.get("scale") == [10, 90])
    server.restructure()
    wait_until(lambda: server.look["scale"] is None)


def test_drivers_of_one_unit_and_different_ends(page: Page, server: FakeServer, driver: FakeDriver) -> None:
    """Both scales are shown, and one for both can be chosen."""
    second = FakeDriver(1, "other", boards=1, triangles=4, placed=False)
    second.scale = (0, 4095)
    server.drivers.append(second)
    server.restructure()
    until(page, f"{LEGEND}.includes('4095 counts')")
    assert page.locator("#low").input_value() == page.locator("#high").input_value() == ""
    driver.scale = second.scale
    until(page, f"!{LEGEND}.includes('other')")
    assert page.locator("#high").input_value() == "4095"


def test_an_address_of_another_skin_shows_this_one(server: FakeServer, open_page: OpenPage) -> None:
    page = open_page(f"{server.url}#type=force&mode=dream&selected=default/gone&pin=default/gone:force:1&pin=x")
    until(page, f"{READY} && skin.type === 'pressure' && skin.mode === 'raw'")
    assert tell(page, "[skin.pixelOf(0, 0).length, skin.stateOf(0, 0).dimmed, skin.pins.length]") == [2, False, 0]
    wait_until(lambda: asked(server, "look")[-1]["type"] is None)


def test_a_malformed_turn_is_survived(page: Page, server: FakeServer, troubles: Troubles) -> None:
    """The page says nothing of it and connects again; it does not go blank for ever."""
    troubles.expected = ("uncaught",)
    server.extra["skin"] = {"drivers": [{"id": 0}]}
    page.wait_for_timeout(300)
    del server.extra["skin"]
    server.restructure()
    until(page, f"{READY} && skin.stateOf(0, 0)?.mark === 'fresh'")


def test_everything_has_a_name_and_is_reached_by_keys(server: FakeServer, open_page: OpenPage) -> None:
    """Buttons, fields and rows: what a screen reader says of them is never empty."""
    for size in ((1100, 700), PHONE):
        page = open_page(server.url, size)
        until(page, READY)
        unnamed = """[...document.querySelectorAll('button, input, select, [role]')].filter(one =>
            one.checkVisibility() && one.role !== 'status'
            && !(one.ariaLabel || one.innerText?.trim() || one.labels?.length)
        ).map(one => one.outerHTML.slice(0, 80))"""
        assert tell(page, unnamed) == []
        reached = set()
        for _ in range(18):
            page.keyboard.press("Tab")
            reached.add(tell(page, "document.activeElement.dataset.role ?? document.activeElement.id"))
        assert {"mode", "record", "row", "stage", "pause", "past", "help"} <= reached
