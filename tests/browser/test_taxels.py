"""What is on the screen is what the skin feels: the right taxels, at the right brightness, with the right marks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt
import pytest
from playwright.sync_api import Page

from skinware import Status, Structure
from skinware.memory.namespace import Namespace
from skinware.sensor_types import FORCE
from tests.browser.browsing import DRIVER, RAW_SCALE, READY, Grey, let_settle, look, places, tell, until
from tests.browser.sleeve import IDLE, PRESSED, Sleeve
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing

OpenPage = Callable[..., Page]

THEMES = ("dark", "light")
VIEWS = ("solid", "flat")
MARGIN = 30
HALF = 11
"""Of what is looked at about taxels, and about one, pixels."""
MARKS = {
    Status.NEVER_SEEN: "never seen",
    Status.STALE: "stale",
    Status.OUT_OF_RANGE: "out of range",
    Status.NO_ACK: "no answer",
    Status.NOT_CONNECTED: "not connected",
    Status.MASKED: "switched off",
    Status.SUSPECT: "suspect",
    Status.UNHEALTHY: "unhealthy",
}


def seen(page: Page, position: int, condition: str) -> None:
    """Wait until the page has a taxel in a state ``s``."""
    until(page, f"(s => s && {condition})(skin.stateOf({DRIVER}, a[0]))", position)


def brightness(screen: Grey, at: npt.NDArray[np.float64]) -> Grey:
    """(n,): grey of the pixels at some places."""
    x, y = at.round().astype(int).T
    grey: Grey = screen[y, x]
    return grey


def shapes(screen: Grey, at: npt.NDArray[np.float64]) -> Grey:
    """(n, 2 HALF, 2 HALF): the pixels about some places, without their brightness and their contrast."""
    x, y = at.round().astype(int).T
    reach = np.arange(-HALF, HALF)
    about: Grey = screen[y[:, None, None] + reach[:, None], x[:, None, None] + reach]
    about -= about.mean(axis=(1, 2), keepdims=True)
    about /= about.std(axis=(1, 2), keepdims=True)
    return about


def apart(some: Grey, others: Grey) -> Grey:
    """(n, m): how far each shape is from each other one, 0 to 2."""
    likeness = some.reshape(len(some), -1) @ others.reshape(len(others), -1).T / some[0].size
    distance: Grey = np.sqrt(2 * np.clip(1 - likeness, 0, None))
    return distance


def loneliness(found: Grey) -> Grey:
    """(n,): how far each shape is from the one that is most like it."""
    distances = apart(found, found)
    np.fill_diagonal(distances, np.inf)
    nearest: Grey = distances.min(axis=1)
    return nearest


def come(page: Page, at: npt.NDArray[np.float64], happens: Callable[[], object]) -> npt.NDArray[np.float64]:
    """(m, 2): pixels about some places that are others after something has happened, once they stay; CSS pixels."""
    left, top = (at.min(axis=0) - MARGIN).astype(int).tolist()
    right, bottom = (at.max(axis=0) + MARGIN).astype(int).tolist()
    before = look(page, left, top, right, bottom)
    happens()
    last = before
    for _ in range(200):
        now = look(page, left, top, right, bottom)
        y, x = np.nonzero(abs(now - before) > 40)
        if len(x) and (now == last).all():
            return np.column_stack((x + left, y + top))
        last = now
    pytest.fail("nothing comes onto the screen, or it does not stay as it is")


@pytest.mark.quick
@pytest.mark.parametrize("view", VIEWS)
def test_a_press_moves_over_the_right_taxels(sleeve: Sleeve, address: str, open_page: OpenPage, view: str) -> None:
    page = open_page(f"{address}#{RAW_SCALE}&theme=dark{'&flat=1' * (view == 'flat')}")
    seen(page, int(sleeve.taxels[0]), "s.level < 50")
    assert tell(page, "skin.flat") == (view == "flat")
    at = places(page, sleeve.taxels)
    assert len(np.unique(at.round(), axis=0)) == len(at)
    middles = sleeve.taxels[[205, 328, 451]]
    for middle in middles:
        pressed = np.isin(sleeve.taxels, sleeve.about(middle))
        assert pressed.sum() == 5
        sleeve.press(*sleeve.taxels[pressed])
        seen(page, int(middle), "s.level > 200")
        grey = brightness(look(page), at)
        assert grey[pressed].min() > grey[~pressed].max() + 50
        levels = np.array(
            tell(page, "a[0].map(i => skin.stateOf(skin.drivers[0].id, i).level)", sleeve.taxels.tolist())
        )
        assert levels[pressed] == pytest.approx(250 * (255 - PRESSED) / 255, abs=1)
        assert levels[~pressed] == pytest.approx(250 * (255 - IDLE) / 255, abs=1)


@pytest.mark.parametrize("theme", THEMES)
def test_more_is_farther_from_the_ground(sleeve: Sleeve, address: str, open_page: OpenPage, theme: str) -> None:
    """In grey, as who sees no colours has it."""
    page = open_page(f"{address}#{RAW_SCALE}&theme={theme}")
    assert sleeve.values is not None
    raw = np.linspace(255, 0, len(sleeve.taxels)).round()
    sleeve.values[sleeve.taxels] = raw
    seen(page, int(sleeve.taxels[-1]), "s.level === 250")
    screen = look(page)
    ground = np.median(screen[:, screen.shape[1] // 2])
    distance = abs(brightness(screen, places(page, sleeve.taxels)) - ground)
    steps = [distance[raw == value].mean() for value in np.unique(raw)[::-8]]
    assert (np.diff(steps) > 0).all(), steps
    assert steps[0] > 8  # the least is seen too


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("view", VIEWS)
def test_a_dead_taxel_is_found_by_its_mark(
    sleeve: Sleeve, address: str, open_page: OpenPage, theme: str, view: str
) -> None:
    """Whatever its value and those of the others, and without colour: its shape is like no other."""
    assert sleeve.values is not None
    sleeve.values[sleeve.taxels] = np.random.default_rng(4).integers(0, 256, len(sleeve.taxels))
    dead = int(sleeve.taxels[300])
    sleeve.status[dead] = Status.NOT_CONNECTED
    page = open_page(f"{address}#{RAW_SCALE}&theme={theme}{'&flat=1' * (view == 'flat')}", (1600, 900))
    seen(page, dead, "s.mark === 'not connected'")
    found = loneliness(shapes(look(page), places(page, sleeve.taxels)))
    assert sleeve.taxels[found.argmax()] == dead
    assert found.max() > 2 * np.sort(found)[-2]


@pytest.mark.parametrize("theme", THEMES)
def test_every_status_has_a_shape_of_its_own(sleeve: Sleeve, address: str, open_page: OpenPage, theme: str) -> None:
    assert sleeve.values is not None
    marked = sleeve.taxels[np.arange(len(MARKS)) * 3 + 205]
    sleeve.values[sleeve.taxels] = 100
    sleeve.status[marked] = list(MARKS)
    page = open_page(f"{address}#{RAW_SCALE}&theme={theme}", (1600, 900))
    seen(page, int(marked[-1]), "s.mark === 'unhealthy'")
    assert tell(page, "a[0].map(i => skin.stateOf(skin.drivers[0].id, i).mark)", marked.tolist()) == list(
        MARKS.values()
    )
    screen = look(page)
    ordinary = shapes(screen, places(page, np.setdiff1d(sleeve.taxels, marked)))
    found = shapes(screen, places(page, marked))
    nearest = np.minimum(loneliness(found), apart(found, ordinary).min(axis=1))
    assert nearest.min() > 2 * np.quantile(loneliness(ordinary), 0.99), nearest.round(2).tolist()


def test_a_skin_without_places_is_laid_out_flat(address: str, open_page: OpenPage) -> None:
    with publishing(FakeSkin("fake", fake_structure(2, 8)), 50) as skin:
        taxels = np.arange(skin.structure.n_sensors)[skin.structure.index("pressure")]
        skin.values = np.full(skin.structure.n_sensors, 240)
        skin.values[taxels[33]] = 40
        page = open_page(f"{address}#{RAW_SCALE}&theme=dark")
        seen(page, int(taxels[33]), "s.level > 200")
        at = places(page, taxels)
        assert len(np.unique(at.round(), axis=0)) == len(at)
        assert taxels[brightness(look(page), at).argmax()] == taxels[33]


def test_what_is_stale_steps_back(sleeve: Sleeve, address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#{RAW_SCALE}&theme=dark")
    stale, fresh = map(int, sleeve.taxels[[202, 206]])
    sleeve.press(stale, fresh)
    sleeve.status[stale] = Status.STALE
    seen(page, stale, "s.mark === 'stale' && s.level > 200")
    of_stale, of_fresh = brightness(look(page), places(page, [stale, fresh]))
    assert of_stale < 0.6 * of_fresh


def test_shear_is_an_arrow_where_it_is_and_where_it_points(
    namespace: Namespace, address: str, open_page: OpenPage
) -> None:
    taxels = 16
    structure = Structure(
        types=FORCE,
        buses=["can0"],
        patch_name=["finger"],
        patch_bus=[0],
        module_patch=[0],
        module_kind=["4x4"],
        sensor_uid=np.tile(np.arange(taxels), 3),
        sensor_type=np.repeat([axis.id for axis in FORCE], taxels),
        sensor_module=np.zeros(3 * taxels, int),
        dtype="f4",
    )
    with publishing(FakeSkin("finger", structure), 50) as skin:
        skin.values = np.zeros(3 * taxels)
        page = open_page(f"{address}#type=force&scale=0,10&theme=dark&sharp=1", (800, 500))
        until(page, READY)
        let_settle(page, skin)
        at = places(page, 2 * taxels + np.arange(taxels))
        pointed = []
        for taxel, axis, force in ((5, 0, 5.0), (6, 0, -5.0), (9, 1, 5.0)):
            arrow = come(page, at, partial(skin.values.put, axis * taxels + taxel, force))
            arrow = arrow - at[taxel]
            assert np.hypot(*arrow.T).min() < 5
            pointed.append(arrow.mean(axis=0) / np.hypot(*arrow.mean(axis=0)))
        assert pointed[0] @ pointed[1] < -0.9
        assert abs(pointed[0] @ pointed[2]) < 0.3
