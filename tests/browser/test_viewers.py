"""Several people look at once: a slow one delays nobody, and each looks at what it likes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from statistics import median
from threading import Event
from typing import Any

import pytest
from playwright.sync_api import Page, WebSocket

from skinware import DriverReader
from skinware.memory.namespace import Namespace
from tests.browser.browsing import tell, until
from tests.browser.sleeve import Sleeve
from tests.cli.fake_skin import publishing

OpenPage = Callable[..., Page]
NS_PER_S = 1e9


class Turns:
    """The turns that a page gets which is not loaded yet.

    Attributes:
        ages_s: of every picture, as it came.
    """

    def __init__(self, page: Page) -> None:
        self.ages_s: list[float] = []
        page.on("websocket", self._listen)

    def _listen(self, socket: WebSocket) -> None:
        socket.on("framereceived", self._take)

    def _take(self, message: Any) -> None:
        now_ns = time.monotonic_ns()
        if isinstance(message, bytes):
            header = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
            self.ages_s += [(now_ns - int(picture["acquired_ns"])) / NS_PER_S for picture in header.get("pictures", [])]


def pass_by(page: Page, condition: Callable[[], bool]) -> None:
    """Let pages run until a condition is true."""
    for _ in range(2000):
        if condition():
            return
        page.wait_for_timeout(20)
    pytest.fail(f"never true: {condition}")


@pytest.fixture
def large(namespace: Namespace) -> Iterator[None]:
    """2,560 taxels."""
    with publishing(Sleeve(patches=16), 50):
        yield


def throttle(page: Page) -> None:
    """40 kB/s, 100 ms away, a processor 6 times slower."""
    devtools = page.context.new_cdp_session(page)
    devtools.send("Network.enable")
    slow = {"offline": False, "latency": 100, "downloadThroughput": 40_000, "uploadThroughput": 40_000}
    devtools.send("Network.emulateNetworkConditions", slow)
    devtools.send("Emulation.setCPUThrottlingRate", {"rate": 6})


def count_until(enough: Event, reader: DriverReader) -> int:
    """How many frames a reader takes until it is enough."""
    count = 0
    for count, _frame in enumerate(reader.in_order(), 1):  # noqa: B007 - the last
        if enough.is_set():
            break
    return count


def test_a_slow_page_delays_nobody(large: None, address: str, open_page: OpenPage) -> None:
    """It gets fewer pictures, none of them older and older; a quick page and a reader notice nothing."""
    quick, slow = (open_page("about:blank") for _ in range(2))
    quick_turns, slow_turns = Turns(quick), Turns(slow)
    for page in (quick, slow):
        page.goto(address)
        until(page, "skin.connected && skin.drivers.length")
    with DriverReader("sleeve") as reader, ThreadPoolExecutor() as beside:
        enough = Event()
        frames = beside.submit(count_until, enough, reader)
        throttle(slow)
        for turns in (quick_turns, slow_turns):
            turns.ages_s.clear()
        pass_by(slow, lambda: len(slow_turns.ages_s) >= 24)
        beside_s = median(quick_turns.ages_s)
        assert len(quick_turns.ages_s) > len(slow_turns.ages_s)
        early_s, late_s = median(slow_turns.ages_s[:12]), median(slow_turns.ages_s[12:])
        assert late_s < 3 * early_s  # nothing queues
        enough.set()
        assert frames.result() > 50
        assert reader.missed == 0
    slow.close()
    quick_turns.ages_s.clear()
    pass_by(quick, lambda: len(quick_turns.ages_s) >= 50)
    assert beside_s < 3 * median(quick_turns.ages_s)


def test_two_people_look_at_different_things(large: None, address: str, open_page: OpenPage) -> None:
    one, other = open_page(f"{address}#type=pressure&mode=raw"), open_page(f"{address}#type=temperature&mode=peak")
    until(one, "skin.connected && skin.type === 'pressure' && skin.drawnMode === 'raw'")
    until(other, "skin.connected && skin.type === 'temperature' && skin.drawnMode === 'peak'")
    assert tell(one, "[skin.type, skin.mode]") == ["pressure", "raw"]
    tell(one, "document.activeElement.blur()")
    one.keyboard.press("Space")
    until(one, "skin.paused")
    assert not tell(other, "skin.paused")
