"""What the other tests of this folder stand on: a browser with WebGL, in which trouble is noticed, and which ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable

import numpy as np
import pytest
from playwright.sync_api import Page

from skinware_drivers.testing.waiting import wait_until
from tests.browser import chromium
from tests.browser.browsing import PHONE, Troubles, look, tell, until


def document(text: str) -> str:
    return f"data:text/html,{text}"


def test_webgl_draws_what_is_looked_at(open_page: Callable[..., Page]) -> None:
    page = open_page(
        document(
            "<body style='margin:0'><canvas width=100 height=100></canvas><script>"
            "const gl = document.querySelector('canvas').getContext('webgl2');"
            "gl.clearColor(0, 1, 0, 1); gl.clear(gl.COLOR_BUFFER_BIT);</script>"
        )
    )
    assert np.allclose(look(page, 10, 10, 90, 90), 150, atol=2)  # green, in grey
    assert look(page, 150, 150, 200, 200).mean() == 255
    assert look(page).shape == (700, 1100)


def test_windows_have_their_own_size_and_state(open_page: Callable[..., Page]) -> None:
    large, small = (open_page(document(""), *size) for size in ((), (PHONE,)))
    assert [tell(page, "innerWidth") for page in (large, small)] == [1100, 390]
    tell(large, "window.mark = a[0]", 7)
    assert [tell(page, "window.mark ?? null") for page in (large, small)] == [7, None]


def test_what_never_comes_true_is_told(open_page: Callable[..., Page]) -> None:
    page = open_page(document("<script>setTimeout(() => { window.late = 3 }, 50)</script>"))
    until(page, "window.late === a[0]", 3)
    with pytest.raises(AssertionError, match=r"never true: window\.late === 4 .* no window\.skin"):
        until(page, "window.late === 4", within_ms=50)


@pytest.mark.parametrize(
    ("text", "trouble"),
    [
        ("<script>console.error('broken')</script>", "console: broken"),
        ("<script>setTimeout(() => { throw Error('thrown') })</script>", "uncaught: thrown"),
        ("<script>Promise.reject(Error('refused'))</script>", "uncaught: refused"),
        ("<img src='http://example.com/x.png'>", "request to another host: http://example.com/x.png"),
        ("<script>new WebSocket('ws://example.com/x')</script>", "request to another host: ws://example.com/x"),
    ],
    ids=["console", "error", "promise", "request", "socket"],
)
def test_trouble_is_noticed(open_page: Callable[..., Page], troubles: Troubles, text: str, trouble: str) -> None:
    page = open_page(document(text))
    while not any(trouble in found for found in troubles.found):
        page.wait_for_timeout(20)
    troubles.found.clear()
    troubles.expected = (trouble, "ERR_NAME_NOT_RESOLVED")
    page.reload()
    page.wait_for_timeout(100)
    assert troubles.found == []


PROGRAM = """
import os, sys
from tests.browser import chromium
with chromium.chromium() as browser:
    browser.new_page().goto("data:text/html,here")
    print(os.getsid(chromium.process_of(browser)), flush=True)
    sys.stdin.read()
"""


@pytest.mark.usefixtures("browser")
@pytest.mark.parametrize("number", [0, signal.SIGTERM, signal.SIGKILL])
def test_no_process_outlives_it(number: int) -> None:
    """Whatever becomes of the tests; of what is not killed, no file either."""
    with tempfile.TemporaryDirectory() as folder:
        with subprocess.Popen(
            [sys.executable, "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": folder},
        ) as process:
            assert process.stdout is not None
            session = int(process.stdout.readline())
            assert len(chromium.processes_of(session)) > 2
            if number:
                process.send_signal(number)
            process.communicate()
        assert process.returncode == -number
        wait_until(lambda: not chromium.processes_of(session))
        assert number or not os.listdir(folder)
