"""Serve the page of ``skin-view`` from inside a program, for a cell of a notebook."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import SupportsFloat
from urllib.parse import urlencode

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import MissingExtra, ServiceTimeout
from skinware.memory.namespace import Namespace
from skinware.views.access import Access
from skinware.views.following import Follower, Origin, PlotFunction
from skinware.views.shows import SUFFIX, RecordingFiles

_START_S = 10.0


class View:
    """A page that this process serves to its own account, until ``close`` or its end. In a notebook it shows itself.

    Its recordings are in the folder in which this process runs.

    Args:
        names: of drivers, or files of recordings (``.mcap``); none: all drivers.
        namespace: of the drivers; default: the one of ``SKINWARE_NAMESPACE``.
        height: of the page in a notebook, pixels.

    Attributes:
        url: its address, for a browser on this machine.
    """

    def __init__(self, *names: str | Path, namespace: Namespace | str | None = None, height: int = 600) -> None:
        if find_spec("websockets") is None:
            raise MissingExtra.of("views", "skinware[view]")
        files = [Path(name) for name in names if str(name).endswith(SUFFIX)]
        drivers = [str(name) for name in names if not str(name).endswith(SUFFIX)]
        place = Namespace.of(namespace)
        calm = None if place.name == place.calm_name else Namespace(place.calm_name)
        self._height, self._files = height, RecordingFiles(files, names=drivers)
        self._follower = Follower(Origin(place, tuple(drivers), calm))
        self._port = 0
        self._failed: BaseException | None = None
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._is_ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skinware view", daemon=True)
        self._thread.start()
        if not self._is_ready.wait(_START_S):
            raise ServiceTimeout(f"the page is not served within {_START_S:g} s")
        if self._failed is not None:
            raise self._failed
        query = urlencode([("recording", str(file)) for file in files], safe="/")
        self.url: str = f"http://127.0.0.1:{self._port}/" + (f"?{query}" if query else "")

    def plot(
        self,
        name: str,
        function: Callable[[DriverSnapshot], SupportsFloat],
        *,
        driver: str | None = None,
        unit: str = "",
    ) -> None:
        """Plot a function of each snapshot of a driver in all pages; again to replace it.

        Args:
            name: of the line.
            function: called in another thread, for every snapshot; NaN: no value. If it raises, the page says so.
            driver: its name; default: the first by name.
            unit: of its values.
        """
        self._follower.functions[name] = PlotFunction(function, driver, unit)

    def close(self) -> None:
        """End the page."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join()

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self._height}px; border: 0"
        return f'<iframe src="{escape(self.url)}" title="skin-view" style="{style}"></iframe>'

    def _run(self) -> None:
        from skinware.views.programs import RECORD, RecordingProgram
        from skinware.views.server import ViewServer

        def ready(port: int) -> None:
            self._port = port
            self._is_ready.set()

        (origin,) = self._follower.origins
        recording = RecordingProgram(RECORD, origin.namespace.name, origin.names)
        server = ViewServer(self._follower, Access("127.0.0.1"), recording, files=self._files, is_framed=True)
        try:
            self._loop.run_until_complete(server.show("127.0.0.1", 0, ready, self._stop))
        except OSError as error:
            self._failed = error
            self._is_ready.set()
        finally:
            self._loop.run_until_complete(self._loop.shutdown_default_executor())  # recordings may be closing in it
            self._follower.close()
            self._loop.close()
