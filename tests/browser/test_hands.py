"""Hands in the page: each in its own place, with its unit, names, loads, peaks and arrows; for everybody who looks."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib.resources import files

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page

from skinware.geometry import Geometry
from skinware.memory.namespace import Namespace
from skinware.sensor_types import FORCE
from skinware_drivers import Module, Patch, taxels
from skinware_drivers.description import assemble
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.modbus.inspire import InspireDriver, InspireOptions
from tests.browser.browsing import DESKTOP, PHONE, let_settle, role, tell, until
from tests.cli.fake_skin import FakeSkin, publishing

OpenPage = Callable[..., Page]
READY = "window.skin?.connected && skin.drawn > 2 && skin.drivers.length === 2"
INK_X = """(() => {
  const {width, height} = document.querySelector('canvas.over');
  const data = document.querySelector('canvas.over').getContext('2d').getImageData(0, 0, width, height).data;
  const columns = Array.from({length: width}, (_, x) => x).filter((x) => {
    for (let y = 0; y < height; y++) if (data[4 * (y * width + x) + 3]) return true;
  });
  const left = document.getElementById('stage').getBoundingClientRect().left, ratio = width / stage.clientWidth;
  return [left + columns[0] / ratio, left + columns.at(-1) / ratio];
})()"""
"""JavaScript: where in the window, from left to right, anything is drawn over the taxels; undefined is NaN."""
LOADS = "[...document.querySelectorAll('#loads tbody tr')].map(row => [...row.cells].map(cell => cell.textContent))"
FORCES = (
    *(one.measured(scale=0.1, minimum=-12, maximum=12) for one in FORCE[:2]),
    FORCE[2].measured(scale=0.1, minimum=0),
)


class Hands:
    """A right hand of matrices in counts, and a left one of three fingertips with three axes, in newtons."""

    def __init__(self) -> None:
        driver = InspireDriver(InspireOptions())
        structure = assemble([("bus", driver.patches)], driver.types, driver.dtype).structure
        self.right = FakeSkin("right", structure.placed(driver.geometry or Geometry.joined([])))
        self.right.values = np.zeros(structure.n_sensors, int)
        fingers, hand, tip = ("thumb", "index", "middle"), Hand("left"), Grid(3, 2, 0.004)
        names = [one.name for one in FORCES]
        modules = [Module(taxels(6, *names, first_uid=8 * n), n, "tip", f"{of} tip") for n, of in enumerate(fingers)]
        tables = assemble([("bus", [Patch("left hand", modules)])], FORCES, np.int16)
        places = [tip.at(hand.down(of, [tip])[0], names, range(8 * n, 8 * n + 6)) for n, of in enumerate(fingers)]
        self.left = FakeSkin("left", tables.structure.placed(Geometry.joined(places)))
        self.left.values = np.zeros(tables.structure.n_sensors, int)

    def of(self, module: str) -> np.ndarray:
        """Sensors of a matrix of the right hand."""
        structure = self.right.structure
        number = [name.split(", ")[-1] for name in structure.module_names].index(module)
        return np.flatnonzero(structure.sensor_module == number)


@pytest.fixture
def hands(namespace: Namespace) -> Iterator[Hands]:
    hands = Hands()
    with ExitStack() as drivers:
        for skin in (hands.right, hands.left):
            drivers.enter_context(publishing(skin, 50))
        yield hands
    del hands.right.writer, hands.left.writer


def boxes(page: Page) -> dict[str, np.ndarray]:
    """(2, 2) of each hand: the least and the greatest x and y of its taxels, CSS pixels."""
    found = {}
    for one in tell(page, "skin.drivers"):
        at = tell(page, "Array.from({length: 1062}, (_, i) => skin.pixelOf(a[0], i)).filter(Boolean)", one["id"])
        found[one["name"]] = np.array([np.min(at, axis=0), np.max(at, axis=0)])
    return found


@pytest.mark.parametrize("flat", [0, 1], ids=["solid", "flat"])
def test_two_hands_have_their_own_places_units_and_arrows(
    hands: Hands, address: str, open_page: OpenPage, flat: int
) -> None:
    page = open_page(f"{address}#theme=dark&names=0&sharp=1&flat={flat}")
    until(page, READY)
    until(page, "document.querySelector('#scaling').innerText.includes('right pressure')")
    legend = page.locator("#scaling").inner_text().replace("\n", " ")
    assert "4096 counts" in legend
    assert "N left force" in legend
    box = boxes(page)
    assert box["left"][1, 0] + 10 < box["right"][0, 0]
    assert not np.isfinite(np.array(tell(page, INK_X), float)).all()
    assert hands.left.values is not None
    hands.left.values[hands.left.structure.index("force_x")] = 60
    until(page, f"{INK_X}[1] > 0")
    first, last = tell(page, INK_X)
    assert box["left"][0, 0] - 30 < first < last < box["right"][0, 0]
    right = "skin.drivers.find(({name}) => name === 'right').id"
    x, y = tell(page, f"skin.pixelOf({right}, a[0])", int(hands.of("palm")[0]))
    with Image.open(io.BytesIO(page.screenshot(clip={"x": x - 14, "y": y, "width": 1, "height": 1}))) as image:
        beside = image.convert("RGB").getpixel((0, 0))
    assert np.abs(np.array(beside) - [32, 36, 44]).max() <= 2  # the palm, not the ground


def test_loads_have_names_a_list_and_peaks(hands: Hands, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#theme=dark&sharp=1", (1400, 900))
    until(page, READY)
    let_settle(page, hands.right)
    assert hands.right.values is not None
    assert hands.left.values is not None
    hands.right.values[hands.of("index tip")] = 100
    hands.right.values[hands.of("index pad")[:10]] = 20
    hands.left.values[np.arange(54)[hands.left.structure.index("force_z")][:6]] = 5
    until(page, f"({LOADS}).some(row => row.join() === 'index,1100 counts,1100 counts')")
    rows = {name: (load, most) for name, load, most in tell(page, LOADS)}
    assert rows["index tip"] == ("900 counts", "900 counts")
    assert rows["palm"] == ("0 counts", "0 counts")
    assert ["thumb tip", "3 N", "3 N"] in tell(page, LOADS)
    assert list(rows).index("ring") < list(rows).index("ring tip")
    until(page, "skin.names.some(({text}) => text === 'index  1100 counts')")
    hands.right.values[:] = 0
    until(page, f"({LOADS}).some(row => row.join() === 'index,0 counts,1100 counts')")
    page.get_by_role("button", name="Reset").click()
    until(page, f"({LOADS}).some(row => row.join() === 'index,0 counts,0 counts')")
    page.keyboard.press("3")  # peaks, above rest, which follows a touch slowly
    hands.right.values[hands.of("index tip")] = 50
    is_peak = "skin.names.some(({text}) => text.startsWith('index  4'))"
    until(page, is_peak)
    hands.right.values[:] = 0
    until(page, f"({LOADS}).some(row => row[0] === 'index' && parseFloat(row[1]) < 100 && row[2].startsWith('4'))")
    assert tell(page, is_peak)


def test_names_stay_in_the_picture_and_are_dragged_into_a_plot(hands: Hands, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#theme=dark&sharp=1", (1400, 520))
    until(page, f"{READY} && skin.names.length > 4")
    stage = page.locator("#stage").bounding_box()
    assert stage is not None
    for name in tell(page, "skin.names"):
        assert name["y"] >= 7
        assert name["width"] / 2 <= name["x"] <= stage["width"] - name["width"] / 2
    name = next(one for one in tell(page, "skin.names") if one["text"] == "palm")
    page.mouse.move(stage["x"] + name["x"], stage["y"] + name["y"])
    page.locator("#grip").click()
    until(page, "skin.plots[0]?.lines[0].label === 'right, palm'")
    page.mouse.move(1, 1)
    until(page, "document.querySelector('#grip').hidden")
    page.locator("#stage").hover(position={"x": 3, "y": 3})
    stage = page.locator("#stage").bounding_box()
    name = next(one for one in tell(page, "skin.names") if one["text"].startswith("right"))
    assert stage is not None
    page.mouse.move(stage["x"] + name["x"], stage["y"] + name["y"])
    page.locator("#grip").drag_to(page.locator(role("strip-canvas")).first)
    until(page, "skin.plots.flatMap(({lines}) => lines).some(({label}) => label === 'right')")


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_axe_finds_nothing(hands: Hands, address: str, open_page: OpenPage, theme: str, size: tuple[int, int]) -> None:
    """The rules of axe-core for the page, with a plot, a problem and a pinned taxel, and for its dialog of keys."""
    assert hands.left.values is not None
    hands.left.status[:3] = 16
    page = open_page(f"{address}#theme={theme}&pins=default,left,force_z,3", size)
    until(page, f"{READY} && skin.problems.length")
    page.keyboard.press("j")
    page.keyboard.press("g")
    page.locator(role("strip-canvas")).wait_for()
    page.evaluate((files("axe_playwright_python") / "axe.min.js").read_text(encoding="utf-8"))
    for keys in ("", "?"):
        if keys:
            page.keyboard.press(keys)
            page.locator("dialog[open]").wait_for()
        found = page.evaluate("axe.run()")
        assert len(found["passes"]) > 15
        assert [(one["id"], [node["target"] for node in one["nodes"]]) for one in found["violations"]] == []


def test_two_fingers_zoom_the_skin_and_a_plot(hands: Hands, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#theme=dark&names=0", PHONE, has_touch=True)
    until(page, READY)
    touch = page.context.new_cdp_session(page)

    def pinch(selector: str) -> None:
        box = page.locator(selector).first.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        for kind, apart in (("touchStart", 30), ("touchMove", 45), ("touchMove", 60), ("touchMove", 75)):
            ends = [(x + side * apart, 1 + (side > 0)) for side in (-1, 1)]
            points = [{"x": at, "y": y, "id": number} for at, number in ends]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    away = "Math.hypot(...skin.camera.position.map((x, c) => x - skin.camera.target[c]))"
    before = tell(page, away)
    pinch("#stage")
    until(page, f"{away} < 0.6 * a[0]", before)
    page.keyboard.press("j")
    page.keyboard.press("g")
    until(page, "skin.plots[0]?.lines[0].times.length > 5")
    span_s = tell(page, "skin.plots[0].span_s")
    pinch(role("strip-canvas"))
    until(page, "skin.plots[0].span_s < 0.6 * a[0]", span_s)


def test_nothing_moves_by_itself_where_motion_is_to_be_reduced(hands: Hands, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#theme=dark&names=0", reduced_motion="reduce")
    until(page, READY)
    page.mouse.move(500, 300)
    page.mouse.down()
    page.mouse.move(600, 340, steps=5)
    page.mouse.up()
    drawn = tell(page, "skin.drawn")
    until(page, "skin.drawn > a[0] + 1", drawn)
    still, drawn = tell(page, "skin.camera"), tell(page, "skin.drawn")
    until(page, "skin.drawn > a[0] + 5", drawn)
    for part, place in tell(page, "skin.camera").items():
        assert place == pytest.approx(still[part], abs=1e-9)
    page.keyboard.press("r")
    until(page, "skin.recording")
    assert tell(page, "document.getAnimations().length") == 0


def test_levels_differ_in_brightness_for_every_eye(address: str, hands: Hands, open_page: OpenPage) -> None:
    """Also without one kind of cones (Vienot, Brettel, Mollon 1999) each level is further than the last."""
    page = open_page(address)
    until(page, READY)
    to_lms = np.array([[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]])
    without = {
        "none": np.eye(3),
        "protanopia": np.array([[0, 2.02344, -2.52581], [0, 1, 0], [0, 0, 1]]),
        "deuteranopia": np.array([[1, 0, 0], [0.494207, 0, 1.24827], [0, 0, 1]]),
    }
    for theme, sign in (("dark", 1), ("light", -1)):
        if tell(page, "skin.theme") != theme:
            page.keyboard.press("d")
        colours = np.array([tell(page, "skin.colourOf(a[0])", level) for level in range(0, 251, 10)]) / 255
        linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
        for eye in without.values():
            seen = np.clip(linear @ (np.linalg.inv(to_lms) @ eye @ to_lms).T, 0, 1)
            lightness = 116 * np.cbrt(seen @ [0.2126, 0.7152, 0.0722]) - 16
            assert (sign * np.diff(lightness) > 0.4).all()
            assert abs(lightness[-1] - lightness[0]) > 45
