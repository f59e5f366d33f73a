"""Begin and end recordings from a page, and control a replay."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from skinware.errors import ConfigurationError, ServiceError
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import PendingRequest
from skinware.service.messages import OPERATIONS
from skinware.state import DEAD
from skinware.views.following import Followed

_END_S = 10.0
"""How long it may take to complete its file."""


class Recording:
    """Runs ``skin-record``, once at a time.

    Args:
        program: that records until its standard input is closed; takes arguments as ``skin-record`` does.
        namespace: of what is recorded.
        names: of the drivers; default: everything.
        folder: where the files go.

    Attributes:
        problem: why the last one ended by itself; None: it did not.
    """

    def __init__(
        self, program: Sequence[str], namespace: str, names: Sequence[str] = (), folder: Path | None = None
    ) -> None:
        self.problem: str | None = None
        self._program, self._namespace, self._names = program, namespace, names
        self._folder = folder or Path.cwd()
        self._file = Path()
        self._begin_s = 0.0
        self._told: dict[str, Any] = {}
        self._running: asyncio.Task[None] | None = None
        self._process: asyncio.subprocess.Process | None = None

    @property
    def state(self) -> dict[str, Any] | None:
        """How it goes; None while nothing is recorded."""
        if self._running is None:
            return None
        told = {name: self._told.get(name, 0) for name in ("bytes", "lost")}
        return {"file": str(self._file), **told, "s": round(time.monotonic() - self._begin_s, 1)}

    def start(self) -> None:
        """Begin to record, if it does not go on already."""
        if self._running is None:
            self.problem, self._told, self._begin_s = None, {}, time.monotonic()
            self._file = self._folder / time.strftime("skin-%Y%m%d-%H%M%S.mcap")
            self._running = asyncio.create_task(self._run())

    def stop(self) -> None:
        """End it in good order; ``state`` is None when the file is complete."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    async def close(self) -> None:
        """End it, and wait for that."""
        if self._running is None:
            return
        self.stop()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._running, _END_S)

    async def _run(self) -> None:
        arguments = [*self._names, "--namespace", self._namespace, "-o", str(self._file), "--json"]
        process = self._process = await asyncio.create_subprocess_exec(
            *self._program,
            *arguments,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            _, errors = await asyncio.gather(self._listen(process), _all_of(process.stderr))
            if await process.wait():
                self.problem = errors.strip().rpartition("\n")[2] or "the recording ended by itself"
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
            self._running = self._process = None

    async def _listen(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None  # noqa: S101 - it is a pipe
        async for line in process.stdout:
            self._told = json.loads(line)


async def _all_of(stream: asyncio.StreamReader | None) -> str:
    return "" if stream is None else (await stream.read()).decode(errors="replace")


_TELL = "replay"
"""Operation of every service of a replay: how it goes; the answer of the others is the same."""
_VALUES = {"pause": None, "resume": None, "step": "frames", "seek": "time_s", "speed": "factor", "loop": "on"}
"""The operations, with the name of the argument that each has."""
_ASK_EVERY_NS = NS_PER_S // 4
_PATIENCE_NS = 2 * NS_PER_S


class ReplayControl:
    """Looks whether a driver is one of a replay, and has it do what viewers ask for.

    Attributes:
        state: how the replay goes; None: what is shown is none.
    """

    def __init__(self) -> None:
        self.state: dict[str, Any] | None = None
        self._replayed: Followed | None = None
        self._others: dict[str, int] = {}  # drivers that are of no replay, and their generations
        self._asked: _Asked | None = None
        self._acts: list[_Asked] = []
        self._next_ns = 0

    def follow(self, drivers: Sequence[Followed]) -> None:
        """Take the answers that have come, and ask again; never waits."""
        self._acts = [act for act in self._acts if not act.is_done()]
        if self._asked is not None and self._asked.is_done():
            self._asked = None
        if self._replayed not in drivers:
            self._replayed = self.state = None
        if self._asked is not None or now_ns() < self._next_ns:
            return
        self._next_ns = now_ns() + _ASK_EVERY_NS
        driver = self._replayed or next((driver for driver in drivers if self._may_be(driver)), None)
        if driver is None:
            return
        if driver is self._replayed:
            self._asked = _Asked(driver, _TELL, {}, self._hear, lambda _: self._forget(driver))
        else:
            self._asked = _Asked(
                driver, OPERATIONS, {}, lambda found: self._learn(driver, found), lambda _: self._forget(driver)
            )

    def act(self, action: str, value: int | float | bool | None, complain: Callable[[str], object]) -> None:
        """Have the replay do something.

        Args:
            action: an operation.
            value: of its argument; None: as it has it.
            complain: called with why it was not done.

        Raises:
            ConfigurationError: what is shown is no replay, or no such operation.
        """
        if self._replayed is None or action not in _VALUES:
            raise ConfigurationError("what is shown is no replay")
        name = _VALUES[action]
        arguments = {} if name is None or value is None else {name: value}
        self._acts.append(_Asked(self._replayed, action, arguments, self._hear, complain))

    def _may_be(self, driver: Followed) -> bool:
        return driver.life != DEAD and self._others.get(driver.name) != driver.live.reader.generation

    def _learn(self, driver: Followed, operations: dict[str, str]) -> None:
        if _TELL in operations and operations.keys() >= _VALUES.keys():
            self._replayed, self._next_ns = driver, 0
        else:
            self._forget(driver)

    def _forget(self, driver: Followed) -> None:
        self._others[driver.name] = driver.live.reader.generation
        self._replayed = self.state = None

    def _hear(self, told: dict[str, Any]) -> None:
        self.state = told


class _Asked:
    """Something that a driver was asked for."""

    def __init__(
        self,
        driver: Followed,
        operation: str,
        arguments: dict[str, Any],
        then: Callable[[Any], object],
        fail: Callable[[str], object],
    ) -> None:
        self._then, self._fail = then, fail
        self._late_ns = now_ns() + _PATIENCE_NS
        self._pending: PendingRequest | None = None
        try:
            self._pending = driver.live.reader.ask(operation, **arguments)
        except ServiceError as error:
            fail(str(error))

    def is_done(self) -> bool:
        """Whether it was answered, one way or another; who asked was told then."""
        if self._pending is None:
            return True
        if not self._pending.done() and now_ns() < self._late_ns:
            return False
        try:
            self._then(self._pending.result(0.0).result)
        except ServiceError as error:
            self._fail(str(error))
        return True
