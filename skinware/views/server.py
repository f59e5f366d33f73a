"""Serve ``skin-view``: the page's files by HTTP, and its turns by a web socket at ``/live``."""

from __future__ import annotations

import asyncio
import contextlib
import mimetypes
import ssl
import time
from collections import deque
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware.views import looks
from skinware.views.access import Access, AccessRefused
from skinware.views.following import Follower
from skinware.views.programs import DoctorProgram, RecordingProgram
from skinware.views.shows import RecordingFiles, Show
from skinware.views.tree import NOTE, problem_of_all
from skinware.views.turns import PROTOCOL, Viewer

PAGE = Path(__file__).parent / "page"
"""The files that the browser runs."""

_TICK_S = 0.01
"""Between two looks for a snapshot that a viewer waits for."""
_LONGEST_S = 0.2
"""Between two looks while no viewer waits: the next one looks by itself when it asks."""
_LONGEST_TURN_S = 0.5
_PLOTS_EVERY_S = 0.09
"""Between two draws of plots by the page: what is no picture is followed as rarely, unless a ring is too short."""
_EARLY_S = 0.005
"""A turn may be sent this much earlier than the pace asks for."""
_MOST_VIEWERS = 32
_MOST_MARKS = 64
_LONGEST_OPERATION = 1 << 16
_RECORDINGS = "/recordings/"
_CLOSE_TIMEOUT_S = 1.0
"""Time for a viewer to close its connection."""
_SOURCES = "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'"
_NOTEBOOKS = "'self' http://localhost:* http://127.0.0.1:* https://localhost:* https://127.0.0.1:* vscode-webview:"
_HEADERS = {
    "Cache-Control": "no-cache",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_TYPES = {".js": "text/javascript", ".html": "text/html", ".css": "text/css", ".svg": "image/svg+xml"}


class ViewServer:
    """Show drivers to any number of viewers; each gets as much as it asks for.

    Args:
        follower: of the drivers; used in the event loop's thread only.
        recording: that viewers may begin and end; None: they may not record.
        doctor: that is asked for advice; None: without it.
        files: recordings that viewers may see instead; each plays them for itself.
        is_framed: pages of this machine, such as notebooks, may contain the page.
    """

    def __init__(
        self,
        follower: Follower,
        access: Access,
        recording: RecordingProgram | None = None,
        page: Path = PAGE,
        doctor: DoctorProgram | None = None,
        files: RecordingFiles | None = None,
        *,
        is_framed: bool = False,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._follower, self._access, self._recording, self._page = follower, access, recording, page
        self._live, self._files = Show(follower), files or RecordingFiles()
        self._doctor = doctor or DoctorProgram((), follower.origins[0].namespace.name)
        self._viewers: dict[Viewer, ServerConnection] = {}
        self._marks: deque[dict[str, Any]] = deque(maxlen=_MOST_MARKS)
        self._frames, self._tls = _NOTEBOOKS if is_framed else "'none'", tls

    async def show(self, host: str, port: int, ready: Callable[[int], object], stop: asyncio.Event) -> None:
        """Serve until ``stop`` is set; at the end, disconnect all viewers, and end the recording that they began.

        Args:
            port: to listen at; 0: any.
        """
        server = await serve(
            self._attend,
            host,
            port,
            process_request=self._answer,
            compression=None,
            max_size=_LONGEST_OPERATION,
            server_header=None,
            close_timeout=_CLOSE_TIMEOUT_S,
            ssl=self._tls,
        )
        self._failure: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        stopping = asyncio.create_task(stop.wait())
        try:
            self._follow()
            ready(int(next(iter(server.sockets)).getsockname()[1]))
            await asyncio.wait([self._failure, stopping], return_when=asyncio.FIRST_COMPLETED)
        finally:
            stopping.cancel()
            self._timer.cancel()
            server.close()
            with contextlib.suppress(TimeoutError):  # of connections that stay silent
                await asyncio.wait_for(server.wait_closed(), 2 * _CLOSE_TIMEOUT_S)
            await self._doctor.close()
            if self._recording is not None:
                await self._recording.close()
        if self._failure.done():
            self._failure.result()

    def _follow(self) -> None:
        """Take what is new while there are viewers, send turns that are due, and come again in time."""
        try:
            for show in {viewer.show for viewer in self._viewers}:
                self._take(show)
            for viewer in filter(self._is_due, self._viewers):
                self._send(viewer)
        except Exception as error:  # noqa: BLE001 - show() raises it
            self._failure.set_exception(error)
        else:
            self._come_again()

    def _come_again(self) -> None:
        """Follow once it is worth it: when a turn is due, and before a ring has lost what a plot wants."""
        pause_s = _LONGEST_S
        for viewer in self._viewers:
            pause_s = min(pause_s, viewer.show.slack_s / 2)
            if viewer.wanted:
                pause_s = min(pause_s, _next_s(viewer) - time.monotonic())
        self._timer = asyncio.get_running_loop().call_later(max(pause_s, _TICK_S), self._follow)

    def _take(self, show: Show) -> None:
        viewers = [viewer for viewer in self._viewers if viewer.show is show]
        for driver in show.follower.take(round(NS_PER_S / max(viewer.look.fps for viewer in viewers))):
            for viewer in viewers:
                viewer.look.follow(driver)
        if time.monotonic() < show.due_s:
            return
        show.slack_s = show.follower.slack_s
        show.due_s = time.monotonic() + min(_PLOTS_EVERY_S, show.slack_s / 4)
        for viewer in viewers:
            viewer.plots.take()
        show.follow()
        if show is self._live:
            problems = [problem for driver in self._follower.drivers for problem in driver.since_ns]
            self._doctor.follow([problem for problem in problems if NOTE not in problem])

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        try:
            self._access.check_account(connection.remote_address[:2], connection.local_address[:2])
            self._access.check(request.path, request.headers)
            path = unquote(urlsplit(request.path).path)
            if path == "/live":
                return None
            response = self._file(path, request)
            response.headers["Content-Security-Policy"] = f"{_SOURCES}; frame-ancestors {self._frames}"
            return response
        except AccessRefused as refused:
            return _response(refused.status, f"{refused}\n".encode(), "text/plain")
        except ValueError:  # the path cannot be an address
            return _response(HTTPStatus.BAD_REQUEST, b"", "text/plain")

    def _file(self, path: str, request: Request) -> Response:
        if path.startswith(_RECORDINGS):  # a page asks whether a file that was dropped on it is here too
            recording = self._files.find(path.removeprefix(_RECORDINGS))
            size = -1 if recording is None else recording.stat().st_size
            return _response(HTTPStatus.OK, f"{size}".encode(), "text/plain")
        if path == "/" and self._access.has_token(request.path):  # kept by the browser, and out of the address
            response = _response(HTTPStatus.SEE_OTHER, b"", "text/plain")
            response.headers["Location"] = "/" + self._access.without_token(request.path)
            response.headers["Set-Cookie"] = self._access.cookie
            return response
        files = {f"/{file.relative_to(self._page).as_posix()}": file for file in self._page.rglob("*")}
        files |= {f"/mesh/{number}": mesh.file for number, mesh in enumerate(self._follower.robot.meshes)}
        file = files.get("/index.html" if path == "/" else path)
        if file is None or not file.is_file():
            raise AccessRefused(HTTPStatus.NOT_FOUND, "there is no such file")
        kind = _TYPES.get(file.suffix) or mimetypes.guess_type(file.name)[0] or "application/octet-stream"
        return _response(HTTPStatus.OK, file.read_bytes(), kind)

    async def _attend(self, connection: ServerConnection) -> None:
        if len(self._viewers) >= _MOST_VIEWERS:
            await connection.close(1013, "too many viewers")
            return
        address = urlsplit(connection.request.path if connection.request else "")
        recordings = parse_qs(address.query).get("recording", [])
        show = await asyncio.to_thread(self._files.open, recordings) if recordings else self._live
        show.follower.functions = self._follower.functions
        viewer = Viewer(show)
        self._viewers[viewer] = connection
        try:
            with contextlib.suppress(ConnectionClosed):
                await self._serve(viewer, connection)
        finally:
            del self._viewers[viewer]
            if show is self._live:
                viewer.plots.close()
            else:  # files may wait for what is being read
                await asyncio.shield(asyncio.gather(*map(asyncio.to_thread, (viewer.plots.close, show.close))))

    async def _serve(self, viewer: Viewer, connection: ServerConnection) -> None:
        """Carry out the operations of a viewer; it gets a turn for each one that it asks for."""
        async for text in connection:
            try:
                self._do(viewer, looks.operation_of(text))
            except ConfigurationError as error:
                viewer.refuse(str(error))
            self._timer.cancel()
            if self._is_due(viewer):
                self._follow()
            else:
                self._come_again()

    def _is_due(self, viewer: Viewer) -> bool:
        """Return whether a viewer waits for a turn, has taken the last one, and its pace allows the next."""
        is_in_time = time.monotonic() >= _next_s(viewer) - _EARLY_S
        return is_in_time and viewer.wanted > 0 and not self._viewers[viewer].transport.get_write_buffer_size()

    def _send(self, viewer: Viewer) -> None:
        """Send a viewer its next turn if something is new, or nothing has been for long."""
        if viewer.has_news or time.monotonic() >= viewer.sent_s + _LONGEST_TURN_S:
            viewer.wanted, viewer.sent_s = viewer.wanted - 1, time.monotonic()
            broadcast([self._viewers[viewer]], viewer.turn(self._besides(viewer.show)))

    def _do(self, viewer: Viewer, operation: looks.Operation) -> None:
        match operation:
            case looks.Next():
                viewer.wanted += 1
                if operation.protocol not in (None, PROTOCOL):
                    raise ConfigurationError(f"this server speaks {PROTOCOL}: reload the page")
            case looks.Mark() if viewer.show.is_live:
                time_ns = now_ns()
                in_recording = self._recording is not None and self._recording.mark(operation.text, time_ns)
                self._marks.append({"time_ns": str(time_ns), "text": operation.text, "is_recorded": in_recording})
            case looks.Record() if self._recording is not None and viewer.show.is_live:
                if operation.action == "start":
                    self._recording.start()
                else:
                    self._recording.stop()
            case _ if not viewer.obey(operation):
                raise ConfigurationError("this server cannot do that")

    def _besides(self, show: Show) -> dict[str, Any]:
        besides: dict[str, Any] = {"recording": None}
        functions, drivers = show.follower.functions, show.follower.drivers
        besides["functions"] = [
            {"name": name, "driver": driver.number, "unit": function.unit}
            for name, function in functions.items()
            if (driver := next((d for d in drivers if function.driver in (None, d.name)), None)) is not None
        ]
        besides["problems"] = [
            problem_of_all(f"{name}: {function.problem}") for name, function in functions.items() if function.problem
        ]
        if not show.is_live:
            return besides
        besides["marks"] = list(self._marks)
        besides["findings"] = self._doctor.findings
        if self._recording is not None:
            besides["recording"] = self._recording.state
            if self._recording.problem is not None:
                besides["problems"].append(problem_of_all(f"recording: {self._recording.problem}"))
        return besides


def _next_s(viewer: Viewer) -> float:
    """Return when the next turn of a viewer keeps its pace, CLOCK_MONOTONIC."""
    return viewer.sent_s + 1 / viewer.look.fps


def _response(status: HTTPStatus, body: bytes, content_type: str) -> Response:
    own = {"Content-Type": f"{content_type}; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
    return Response(status.value, status.phrase, Headers(own | _HEADERS), body)
