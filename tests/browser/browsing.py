"""skin-view as a person sees it: the command, its page in a browser, what is on the screen and what the page tells."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt
from PIL import Image
from playwright.sync_api import BrowserContext, ConsoleMessage, Error, Page, Request

from skinware_drivers.testing.waiting import SLOWER
from tests.cli.fake_skin import FakeSkin
from tests.commands import Running, running

PATIENCE_MS = 8_000 * SLOWER
DESKTOP, PHONE = (1100, 700), (390, 844)
DRIVER = "skin.drivers[0]?.id"
READY = "window.skin?.connected && skin.drawn > 2 && skin.drivers.length"
"""JavaScript: of the first driver that the page has; it has drawn one."""
RAW_SCALE = "mode=raw&scale=0,255&sharp=1&names=0"
"""Part of an address: physical values from 0 to 255, which the sleeve has for 255 to 0 raw; all pixels, however slow
the machine is."""
OURS = ("127.0.0.1", "localhost")
Grey = npt.NDArray[np.float64]


class Troubles:
    """What no page of ours may do: errors on its console, errors that nobody catches, requests to another host.

    Attributes:
        found: what it did, in words.
        expected: a part of what a test provokes; that is no trouble.
    """

    def __init__(self) -> None:
        self.found: list[str] = []
        self.expected: tuple[str, ...] = ()

    def watch(self, context: BrowserContext) -> None:
        """Watch all pages of a context."""
        context.on("console", self._console)
        context.on("weberror", lambda error: self._add(f"uncaught: {error.error}"))
        context.on("request", self._request)
        context.on("page", lambda page: page.on("websocket", lambda socket: self._address(socket.url)))

    def _console(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self._add(f"console: {message.text}")

    def _request(self, request: Request) -> None:
        self._address(request.url)

    def _address(self, address: str) -> None:
        parts = urlsplit(address)
        if parts.scheme not in ("data", "blob", "about") and parts.hostname not in OURS:
            self._add(f"request to another host: {address}")

    def _add(self, trouble: str) -> None:
        if not any(part in trouble for part in self.expected):
            self.found.append(trouble)


@contextmanager
def viewing(*arguments: str) -> Iterator[tuple[Running, str]]:
    """skin-view, and the address of its page."""
    with running("skin-view", "--no-browser", *arguments) as view:
        yield view, str(view.wait_for("ready")["url"])


def tell(page: Page, expression: str, *arguments: object) -> Any:
    """What an expression of JavaScript is in the page; ``a`` are the arguments."""
    return page.evaluate(f"(a) => ({expression})", list(arguments))


def until(page: Page, expression: str, *arguments: object, within_ms: float = PATIENCE_MS) -> None:
    """Wait until an expression of JavaScript is true in the page; says what it knows of itself if it never is."""
    try:
        page.wait_for_function(f"(a) => ({expression})", arg=list(arguments), timeout=within_ms)
    except Error as error:
        known = page.evaluate("() => window.skin ? Object.keys(window.skin) : 'no window.skin'")
        raise AssertionError(f"never true: {expression} with {arguments}; the page has {known}; {error}") from None


def let_settle(page: Page, skin: FakeSkin) -> None:
    """Wait until what is felt at rest is known: for frames of 1.2 s."""
    end = skin.writer.sequence + 60
    while skin.writer.sequence < end:
        page.wait_for_timeout(20)


def look(page: Page, left: int = 0, top: int = 0, right: int | None = None, bottom: int | None = None) -> Grey:
    """What is on the screen between these edges, CSS pixels, in grey, 0 to 255: (height, width)."""
    size = page.viewport_size or {"width": 0, "height": 0}
    width = (size["width"] if right is None else right) - left
    height = (size["height"] if bottom is None else bottom) - top
    with Image.open(io.BytesIO(page.screenshot(clip={"x": left, "y": top, "width": width, "height": height}))) as image:
        return np.asarray(image.convert("L"), np.float64)


def places(page: Page, positions: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(n, 2): where taxels of the first driver are on the screen, CSS pixels."""
    found = tell(page, f"a[0].map(position => skin.pixelOf({DRIVER}, position))", np.asarray(positions).tolist())
    return np.array(found, np.float64).reshape(-1, 2)


def states(page: Page, positions: npt.ArrayLike, what: str) -> list[Any]:
    """What the page has of taxels of the first driver: their ``level``, ``mark`` ..."""
    of_each = f"a[0].map(position => skin.stateOf({DRIVER}, position)[a[1]])"
    found: list[Any] = tell(page, of_each, np.asarray(positions).tolist(), what)
    return found


def level(position: int) -> str:
    """JavaScript: the level of a taxel of the first driver, as it is shown; undefined where there is none."""
    return f"skin.stateOf({DRIVER}, {position})?.level"


def role(name: str, more: str = "") -> str:
    """The selector of what has a role on the page."""
    return f"[data-role={name}]{more}"
