"""A second implementation of the protocol of skin-view, for tests: what a page gets, taken apart by other means."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
from websockets.sync.client import ClientConnection, connect

from tests.commands import PATIENCE_S

Array = npt.NDArray[Any]


class Turn:
    """One message of the server."""

    def __init__(self, data: bytes) -> None:
        (length,) = struct.unpack("<I", data[:4])
        assert (4 + length) % 8 == 0
        assert len(data) % 8 == 0
        self.header: dict[str, Any] = json.loads(data[4 : 4 + length])
        self._blobs = data[4 + length :]

    def __getitem__(self, key: str) -> Any:
        return self.header[key]

    def __contains__(self, key: object) -> bool:
        return key in self.header

    def array(self, where: list[int], code: str) -> Array:
        """A blob, as values that ``struct`` calls by this letter."""
        offset, size = where
        assert offset % 8 == 0
        assert 0 <= offset <= offset + size <= len(self._blobs)
        count = size // struct.calcsize(code)
        return np.array(struct.unpack(f"<{count}{code}", self._blobs[offset : offset + size]))

    def picture(self, driver: int = 0) -> dict[str, Any] | None:
        """Of a driver, with its arrays; None where there is none in this turn."""
        for told in self.header.get("pictures", ()):
            if told["driver"] == driver:
                arrays = {"levels": "B", "status": "B", "shear": "b", "totals": "f", "between": "f"}
                found = {name: self.array(told[name], code) for name, code in arrays.items() if name in told}
                if "shear" in found:
                    found["shear"] = found["shear"].reshape(-1, 2)
                return {**told, **found}
        return None


class Page:
    """One viewer, as far as the server can tell.

    Args:
        connection: to the server.
    """

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.skin: dict[str, Any] = {}
        self.state: dict[str, Any] = {}
        self.replays: list[dict[str, Any]] = []
        self.outlines: list[dict[str, Any]] = []
        self.status: dict[tuple[int, str], Array] = {}
        self._number = 0

    def say(self, op: str, **arguments: Any) -> None:
        """Send an operation."""
        self.connection.send(json.dumps({"op": op, **arguments}))

    def pull(self) -> Turn:
        """The next turn."""
        self.say("next")
        data = self.connection.recv(timeout=PATIENCE_S)
        assert isinstance(data, bytes)
        turn = Turn(data)
        assert turn["turn"] == self._number + 1
        self._number += 1
        self.skin = turn.header.get("skin", self.skin)
        self.state = turn.header.get("state", self.state)
        self.replays = turn.header.get("replays", self.replays)
        self.outlines = turn.header.get("outlines", self.outlines)
        for told in turn.header.get("pictures", ()):
            driver = next(driver for driver in self.skin["drivers"] if driver["id"] == told["driver"])
            shown = next(shown for shown in driver["types"] if shown["name"] == told["type"])
            assert told["generation"] == driver["generation"]
            assert told["levels"][1] == shown["n"]
            if "status" in told:
                self.status[told["driver"], told["type"]] = turn.array(told["status"], "B")
        return turn

    def pull_until(self, condition: Callable[[Turn], Any], within_s: float = 30.0) -> Turn:
        """The next turn that fulfils a condition."""
        end_s = time.monotonic() + within_s
        while True:
            turn = self.pull()
            if condition(turn):
                return turn
            assert time.monotonic() < end_s, f"not within {within_s} s; last: {json.dumps(turn.header)[:2000]}"

    def pull_picture(self, driver: int = 0, condition: Callable[[dict[str, Any]], Any] = bool) -> dict[str, Any]:
        """The next picture of a driver that fulfils a condition."""
        found: list[dict[str, Any]] = []

        def is_it(turn: Turn) -> bool:
            picture = turn.picture(driver)
            if picture is None or not condition(picture):
                return False
            found.append(picture)
            return True

        self.pull_until(is_it)
        return found[0]


@contextmanager
def page_of(url: str, **options: Any) -> Iterator[Page]:
    """A viewer of the server at an address."""
    where, _, query = url.partition("?")
    address = where.replace("http", "ws", 1) + "live" + (f"?{query}" if query else "")
    with connect(address, compression=None, max_size=None, ping_interval=None, **options) as connection:
        yield Page(connection)
