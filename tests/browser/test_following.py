"""What happens to drivers and to the command is on the page at once, and the page goes on by itself."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Page

from skinware.memory.namespace import Namespace
from tests.browser.browsing import DRIVER, RAW_SCALE, Troubles, level, role, tell, until, viewing
from tests.browser.sleeve import Sleeve
from tests.cli.fake_skin import kill, publishing

OpenPage = Callable[..., Page]
ROOT = Path(__file__).parents[2]
STATE = "skin.drivers[0]?.state"
SHOWN_WITHIN_S = 1.0


def published_by_a_process() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "tests.browser.sleeve", "sleeve"], cwd=ROOT)


@pytest.mark.quick
def test_a_killed_driver_is_shown_within_a_second(namespace: Namespace, address: str, open_page: OpenPage) -> None:
    """Of three kills at least one: a machine that is busy may keep the page waiting, but not each time."""
    page = open_page(address)
    took_s: list[float] = []
    while len(took_s) < 3 and not any(took < SHOWN_WITHIN_S for took in took_s):
        process = published_by_a_process()
        try:
            until(page, f"{STATE} === 'live'")
        finally:
            kill(process)
        killed_s = time.monotonic()
        until(page, f"{STATE} === 'dead'")
        took_s.append(time.monotonic() - killed_s)
        until(page, "skin.problems.some(text => text.includes('sleeve'))")
    namespace.ring_path("sleeve").unlink()
    assert min(took_s) < SHOWN_WITHIN_S


def test_what_comes_goes_and_comes_back_changed_is_followed(address: str, open_page: OpenPage) -> None:
    page = open_page(f"{address}#{RAW_SCALE}")
    until(page, "skin.connected && skin.drivers.length === 0")
    for patches in (4, 4, 2, 5):
        with publishing(Sleeve(patches=patches), 50) as skin:
            assert isinstance(skin, Sleeve)
            last = int(skin.taxels[-1])
            skin.press(last)
            until(page, f"{level(last)} > 200 && {STATE} === 'live'")
            assert tell(page, f"skin.stateOf({DRIVER}, a[0])", skin.structure.n_sensors) is None
        until(page, "!skin.drivers.length")
    with publishing(Sleeve("one"), 50), publishing(Sleeve("two"), 50):
        until(page, "skin.drivers.map(driver => driver.name).sort().join() === 'one,two'")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_the_page_connects_again_to_a_command_that_was_started_again(
    namespace: Namespace, open_page: OpenPage, troubles: Troubles, sleeve: Sleeve, number: int
) -> None:
    troubles.expected = ("ERR_CONNECTION_", "ERR_EMPTY_RESPONSE", "WebSocket connection")  # also while it answers
    with viewing() as (view, address):
        page = open_page(f"{address}#{RAW_SCALE}")
        until(page, f"skin.connected && {STATE} === 'live'")
        view.stop(number)
        until(page, "!skin.connected")
        assert "old" in page.locator(role("lost")).inner_text()
    taxel = int(sleeve.taxels[7])
    sleeve.press(taxel)
    with viewing("--port", str(urlsplit(address).port)):
        until(page, f"skin.connected && {STATE} === 'live' && {level(taxel)} > 200")
        assert not page.locator(role("lost")).is_visible()
    for left in (namespace.path / "readers").glob("sleeve.*"):  # by the one that was killed
        left.unlink()
