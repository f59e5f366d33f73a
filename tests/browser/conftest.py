"""One browser for all tests of this folder in a process; a page of its own for whoever asks, watched for trouble."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from skinware.memory.namespace import Namespace
from tests.browser.browsing import DESKTOP, PATIENCE_MS, Troubles, viewing
from tests.browser.chromium import PACKAGE, chromium, program
from tests.browser.sleeve import Sleeve
from tests.cli.fake_skin import publishing

HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker("browser")


@pytest.fixture(scope="package")  # while it runs, asyncio.run cannot be used: no longer than needed
def browser() -> Iterator[Browser]:
    if program() is None:
        pytest.skip(f"there is no Chromium (Debian: apt install {PACKAGE})")
    with chromium() as browser:
        yield browser


@pytest.fixture
def troubles() -> Troubles:
    """Of all pages of the test: those that it provokes it takes away."""
    return Troubles()


@pytest.fixture
def open_page(browser: Browser, namespace: Namespace, troubles: Troubles) -> Iterator[Callable[..., Page]]:
    """``open_page(url, size, **options of a context)``: in a window of its own, which shares nothing with others."""
    with ExitStack() as contexts:

        def open_page(url: str, size: tuple[int, int] = DESKTOP, **options: Any) -> Page:
            context = browser.new_context(viewport={"width": size[0], "height": size[1]}, **options)
            contexts.callback(context.close)
            context.set_default_timeout(PATIENCE_MS)
            troubles.watch(context)
            page = context.new_page()
            page.goto(url)
            return page

        yield open_page
    assert troubles.found == []


@pytest.fixture
def sleeve(namespace: Namespace) -> Iterator[Sleeve]:
    """A driver that publishes what the test sets."""
    skin = Sleeve()
    with publishing(skin, 50):
        yield skin
    del skin.writer  # and its memory: pytest keeps the skin a little longer


@pytest.fixture
def address(namespace: Namespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Of the page of a skin-view that runs in the test's folder, and outlives all pages."""
    monkeypatch.chdir(tmp_path)
    with viewing() as (_, url):
        yield url
