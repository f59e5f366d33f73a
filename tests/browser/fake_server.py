"""A server for the page alone: it says what a test wants, in the protocol of skin-view, and notes what it is asked."""

from __future__ import annotations

import json
import math
import mimetypes
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

import skinware
from skinware.state import GOOD, OLD, badness

PAGE = Path(skinware.__file__).parent / "views" / "page"
MONOTONIC_NS = 1_000_000_000_000
Header = dict[str, Any]


def turn_bytes(header: Header) -> bytes:
    """A turn as the server sends it; arrays anywhere in the header become blobs."""
    blobs: list[bytes] = []
    at = 0

    def placed(value: Any) -> Any:
        nonlocal at
        if isinstance(value, np.ndarray):
            data = value.tobytes()
            where = [at, len(data)]
            blobs.append(data + bytes(-len(data) % 8))
            at += len(blobs[-1])
            return where
        if isinstance(value, dict):
            return {key: placed(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [placed(inner) for inner in value]
        return value

    text = json.dumps(placed(header)).encode()
    text += b" " * (-(4 + len(text)) % 8)
    return len(text).to_bytes(4, "little") + text + b"".join(blobs)


class FakeDriver:
    """A driver with ``boards`` patches of ``triangles`` triangles of ten taxels, rolled to a forearm or flat.

    Attributes:
        type: name of the sensor type.
        unit, scale: of the values.
        levels: (n,) uint8, what is felt; tests write into it.
        status: (n,) uint8; tests write into it.
        state: of the driver in the tree.
    """

    def __init__(
        self, number: int, name: str, boards: int = 4, triangles: int = 16, *, placed: bool = True, shear: bool = False
    ) -> None:
        self.number, self.name, self.boards, self.triangles, self.placed = number, name, boards, triangles, placed
        self.n = boards * triangles * 10
        self.levels = np.zeros(self.n, np.uint8)
        self.status = np.zeros(self.n, np.uint8)
        self.shear = np.zeros((self.n, 2), np.int8) if shear else None
        self.type, self.unit, self.is_touch = "pressure", "counts", True
        self.scale: tuple[float, float] = (0, 250)
        self.state = "live"
        self.generation = "1"
        self.problems: list[Header] = []
        self.contacts: list[Header] = []
        self.regions: list[Header] = []
        self.position, self.normal = self._places()

    def _places(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        modules = self.boards * self.triangles
        columns = max(1, round(math.sqrt(modules * 2.2)))
        triangle = [(5, 2), (6, 3), (4, 3), (3, 2), (2, 3), (0, 3), (1, 2), (2, 1), (3, 0), (4, 1)]
        flat = np.empty((self.n, 2))
        for module in range(modules):
            row, column = divmod(module, columns)
            for i, (half, line) in enumerate(triangle):
                up = (module + row) % 2 == 0
                y = line if up else 3.4 - line
                flat[module * 10 + i] = (column * 4.1 + half / 2) * 6.5e-3, (row * 4.3 + y) * 5.8e-3
        if not self.placed:
            return (
                np.column_stack([flat, np.zeros(self.n)]).astype(np.float32),
                np.tile([0, 0, 1], (self.n, 1)).astype(np.float32),
            )
        height = flat[:, 1].max() + 6e-3
        radius = height / 4.6
        angle = flat[:, 1] / radius - 2.3
        normal = np.column_stack([np.zeros(self.n), np.sin(angle), np.cos(angle)])
        position = np.column_stack([flat[:, 0], radius * np.sin(angle), radius * np.cos(angle)])
        return position.astype(np.float32), normal.astype(np.float32)

    def told(self) -> Header:
        modules = self.boards * self.triangles
        kind: Header = {
            "name": self.type,
            "unit": self.unit,
            "touch": self.is_touch,
            "n": self.n,
            "index": np.arange(self.n, dtype=np.uint32),
            "uid": np.arange(self.n, dtype=np.uint64) + 0x70000,
            "patch": (np.arange(self.n) // (10 * self.triangles)).astype(np.uint16),
            "module": (np.arange(self.n) // 10).astype(np.uint16),
            "position": self.position,
            "normal": self.normal,
            "placed": self.placed,
            "neighbour_spacing_m": 0.0065,
        }
        return {
            "id": self.number,
            "name": self.name,
            "namespace": "default",
            "generation": self.generation,
            "type": self.name,
            "types": [kind],
            "buses": ["can0"],
            "patches": [{"name": f"board {8 + i}", "bus": 0} for i in range(self.boards)],
            "modules": [
                {"name": f"triangle {i % self.triangles}", "patch": i // self.triangles} for i in range(modules)
            ],
        }

    def picture(self) -> Header:
        picture: Header = {
            "driver": self.number,
            "type": self.type,
            "generation": self.generation,
            "scale": list(self.scale),
            "levels": self.levels,
            "contacts": self.contacts,
            "regions": self.regions,
            "status": self.status,
        }
        if self.shear is not None:
            picture["shear"] = self.shear
        return picture

    def told_state(self) -> Header:
        alive = self.state == "live"
        fresh = int((self.status == 0).sum()) if alive else 0
        patches = []
        for i in range(self.boards):
            of = self.status[i * 10 * self.triangles : (i + 1) * 10 * self.triangles]
            is_stale = bool((of & 2).all())
            state = ("stale" if is_stale else "live") if alive else f"was {'stale' if is_stale else 'live'}"
            patches.append(
                {
                    "name": f"board {8 + i}",
                    "state": state,
                    "bad": badness(state),
                    "age_ms": 840.0 if is_stale else 4.2,
                    "fresh": int((of == 0).sum()) if alive else 0,
                    "sensors": len(of),
                    "rate_hz": 0.0 if is_stale else 50.0,
                }
            )
        return {
            "id": self.number,
            "state": self.state,
            "shown": self.state,
            "bad": badness(self.state),
            "rate_hz": 50.0 if alive else 0.0,
            "age_ms": 4.2 if alive else 1840.0,
            "fresh": fresh,
            "sensors": self.n,
            "dropped": 0,
            "load": 0.31,
            "buses": [{"state": "live" if alive else "was live", "bad": GOOD if alive else OLD, "load": 0.31}],
            "patches": patches,
        }


class FakeServer:
    """Serves the page and one kind of turns to each that asks.

    Attributes:
        ops: what the pages asked for besides turns, oldest first.
        extra: added to every turn.
        muted: it answers nothing.
        links: meshes of the structure.
        files: more that it serves, by path.
        before_turn: called before each turn is made, for tests that move things.
    """

    def __init__(self, drivers: list[FakeDriver], *, port: int = 0) -> None:
        self.drivers = drivers
        self.ops: list[Header] = []
        self.extra: Header = {}
        self.before_turn: Callable[[], None] = lambda: None
        self.look: Header = {"mode": "raw"}
        self.version = 0
        self.turns = 0
        self.muted = False
        self.links: list[Header] = []
        self.names: list[str] = []
        self.posed = False
        self.findings: list[Header] = []
        self.files: dict[str, bytes] = {}
        self._server = serve(
            self._talk, "127.0.0.1", port, process_request=self._file, compression=None, ping_interval=None
        )
        self.port = self._server.socket.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join(5)

    def restructure(self) -> None:
        """Tell every viewer the structure again."""
        self.version += 1

    def _file(self, connection: ServerConnection, request: Request) -> Response | None:
        path = request.path.split("?")[0]
        if path == "/live":
            return None
        if path in self.files:
            return Response(200, "OK", Headers({"Content-Length": str(len(self.files[path]))}), self.files[path])
        file = (PAGE / (path.lstrip("/") or "index.html")).resolve()
        if not file.is_relative_to(PAGE) or not file.is_file():
            return connection.respond(HTTPStatus.NOT_FOUND, "no such file\n")
        body = file.read_bytes()
        kind = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
        headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store"})
        return Response(200, "OK", headers, body)

    def _talk(self, connection: ServerConnection) -> None:
        told, state_at, number, last = -1, 0.0, 0, 0.0
        answers: Header = {}
        try:
            for text in connection:
                op = json.loads(text)
                if op["op"] != "next":
                    self.ops.append(op)
                    answers.update(self._answer(op))
                    continue
                time.sleep(max(0.0, last + 1 / 30 - time.monotonic()))
                last = time.monotonic()
                if self.muted:
                    continue
                self.before_turn()
                number += 1
                self.turns += 1
                header: Header = {"turn": number, "now_ns": str(MONOTONIC_NS + time.monotonic_ns())}
                if told != self.version:
                    told = self.version
                    drivers = [d.told() for d in self.drivers]
                    header["skin"] = {"namespaces": ["default"], "drivers": drivers, "links": self.links}
                    header["skin"] |= {"names": self.names, "posed": self.posed}
                header["mode"] = self.look["mode"]
                header["pictures"] = [d.picture() for d in self.drivers if d.state == "live"]
                if last - state_at > 0.5:
                    state_at = last
                    header["state"] = {
                        "drivers": [d.told_state() for d in self.drivers],
                        "problems": [p for d in self.drivers for p in d.problems],
                        "recording": self.extra.get("recording"),
                        "findings": self.findings,
                    }
                header.update({k: v for k, v in self.extra.items() if k != "recording"})
                header.update(answers)
                if "exact" in answers:
                    header["exact"] = [self._exact(*pair) for pair in answers["exact"]]
                connection.send(turn_bytes(header))
                answers = {k: v for k, v in answers.items() if k == "exact"}
        except ConnectionClosed:
            pass

    def _answer(self, op: Header) -> Header:
        driver = self.drivers[op["driver"]] if "driver" in op else None
        if op["op"] == "look":
            self.look.update(op)
        if op["op"] == "exact":
            return {"exact": op["sensors"]}
        if op["op"] == "names" and driver is not None:
            names = [
                f"board {8 + i // (10 * driver.triangles)}, triangle {i // 10 % driver.triangles}, taxel {i % 10}"
                for i in range(driver.n)
            ]
            return {"names": {"driver": op["driver"], "type": op["type"], "of": names}}
        if op["op"] == "plot":
            t = np.linspace(-10, 0, 500)
            value = np.repeat(40 + 30 * np.sin(t) ** 8 + 1.5 * np.sin(37 * t), len(op["lines"]))
            time_ns = MONOTONIC_NS + time.monotonic_ns() + (1e9 * t).astype(np.int64)
            block = {"number": op["number"], "of": "driver", "lines": list(range(len(op["lines"])))}
            return {"plots": {"missed": 0, "blocks": [block | {"time_ns": time_ns, "values": value}]}}
        return {}

    def _exact(self, number: int, position: int) -> Header:
        driver = self.drivers[number]
        return {
            "driver": number,
            "position": position,
            "value": float(driver.levels[position]),
            "raw": int(driver.levels[position]),
            "age_ms": 4.2,
            "status": int(driver.status[position]),
        }
