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
from tests.commands import Running, running

PATIENCE_MS = 20_000 * SLOWER
DESKTOP, PHONE = (1100, 700), (390, 844)
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


def look(page: Page, place: tuple[float, float] | None = None, half: int = 6) -> Grey:
    """What is on the screen, in grey, 0 to 255: (height, width), or (2 half, 2 half) about a place in CSS pixels."""
    clip = place and {"x": round(place[0]) - half, "y": round(place[1]) - half, "width": 2 * half, "height": 2 * half}
    with Image.open(io.BytesIO(page.screenshot(clip=clip))) as image:  # type: ignore[arg-type]
        return np.asarray(image.convert("L"), np.float64)
