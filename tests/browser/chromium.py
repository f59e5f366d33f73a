"""The machine's own Chromium, headless, driven by playwright, with WebGL in software; nothing of it is left behind.

``python -m tests.browser.chromium`` prints which program that is; exit status 1: there is none.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from playwright.sync_api import Browser, sync_playwright

from skinware_drivers.testing.waiting import wait_until

PROGRAMS = ("chromium", "google-chrome")
PACKAGE = "chromium"
"""Debian's; it brings SwiftShader, and through fontconfig a font."""
FLAGS = (
    "--no-sandbox",  # which root cannot have, and a container has not
    "--disable-gpu",  # as where there is no graphics card: its own picture without GL, that of WebGL by SwiftShader
    "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1 , EXCLUDE localhost",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-domain-reliability",
    "--disable-quic",
    "--disable-sync",
    "--no-first-run",
)


def program() -> str | None:
    """The path of the first program that is there."""
    return next((path for name in PROGRAMS if (path := shutil.which(name))), None)


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser; no process and no temporary file of it outlives the block."""
    with tempfile.TemporaryDirectory(prefix="chromium-") as folder:  # short: there will be a socket in it
        with mock.patch.dict(os.environ, {"TMPDIR": folder}):
            playwright = sync_playwright().start()
        try:
            browser = playwright.chromium.launch(executable_path=program(), args=FLAGS)
            session = os.getsid(process_of(browser))
            try:
                yield browser
            finally:
                browser.close()
        finally:
            playwright.stop()
        wait_until(lambda: not processes_of(session))
        wait_until(lambda: not os.listdir(folder))


def process_of(browser: Browser) -> int:
    """The number of its first process, which leads a session."""
    found = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
    return next(int(process["id"]) for process in found if process["type"] == "browser")


def processes_of(session: int) -> list[int]:
    """The processes of a session that still run."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, _parent, _group, its_session = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
            except OSError:
                continue  # it has ended meanwhile
            if int(its_session) == session and state != "Z":
                found.append(int(entry.name))
    return found


if __name__ == "__main__":
    if (path := program()) is None:
        sys.exit(1)
    print(path)
