"""A server of the view in a thread of the test, and drivers that nothing makes look silent."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from skinware import Namespace
from skinware.views.access import Access
from skinware.views.following import Follower, Origin
from skinware.views.programs import RecordingProgram
from skinware.views.robot import Robot
from skinware.views.server import ViewServer
from skinware.views.shows import RecordingFiles
from skinware_drivers.testing.waiting import wait_until

INDEX = "<!doctype html><title>skin</title>"
Serve = Callable[..., AbstractContextManager[str]]


@pytest.fixture
def page_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "page"
    (folder / "vendor").mkdir(parents=True)
    (folder / "index.html").write_text(INDEX)
    (folder / "vendor/three.min.js").write_text("export {}")
    (tmp_path / "secret.txt").write_text("secret")
    return folder


@pytest.fixture
def serving(namespace: Namespace, page_folder: Path) -> Serve:
    """Serves a namespace; gives the address."""

    @contextmanager
    def serve(
        names: tuple[str, ...] = (),
        calm: Namespace | None = None,
        *,
        token: str | None = None,
        robot: Robot | None = None,
        files: RecordingFiles | None = None,
        program: tuple[str, ...] = (sys.executable, "-m", "skinware.cli.record", "--until-eof"),
    ) -> Iterator[str]:
        follower = Follower(Origin(namespace, names, calm), robot=robot)
        found: list[Any] = []
        failed: list[BaseException] = []

        async def run() -> None:
            stop = asyncio.Event()
            recording = RecordingProgram(program, namespace.name, names, page_folder)
            server = ViewServer(follower, Access("127.0.0.1", token), recording, page_folder, files=files)
            loop = asyncio.get_running_loop()
            await server.show("127.0.0.1", 0, lambda port: found.append((port, loop, stop)), stop)

        def run_all() -> None:
            try:
                asyncio.run(run())
            except BaseException as error:  # noqa: BLE001 - the test tells
                failed.append(error)

        thread = threading.Thread(target=run_all)
        thread.start()
        try:
            wait_until(lambda: bool(found or failed))
            yield f"http://127.0.0.1:{found[0][0]}/" + (f"?token={token}" if token else "")
        finally:
            if found:
                _, loop, stop = found[0]
                if not failed:
                    loop.call_soon_threadsafe(stop.set)
            thread.join()
            follower.close()
        assert not failed, failed

    return serve
