"""Programs beside a page: run ``skin-record`` and ``skin-doctor``, and control a replay by ``skin-replay``."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from skinware.errors import ConfigurationError, ServiceError
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import PendingRequest
from skinware.service.messages import OPERATIONS
from skinware.state import DEAD
from skinware.views.following import ShownDriver

RECORD = (sys.executable, "-m", "skinware.cli.record", "--until-eof")
_AGAIN_NS, _SOON_NS = 30 * NS_PER_S, 5 * NS_PER_S
"""Between two examinations while problems stay as they are, and when they change."""
_END_S = 10.0
"""Time for a recording to complete its file."""


class RecordingProgram:
    """Run ``skin-record``, one at a time.

    Args:
        program: that records until its standard input is closed, with the arguments of ``skin-record``.

    Attributes:
        problem: why the last recording ended by itself; None: it did not.
    """

    def __init__(
        self, program: Sequence[str], namespace: str, names: Sequence[str] = (), folder: Path | None = None
    ) -> None:
        self.problem: str | None = None
        self._program, self._namespace, self._names = program, namespace, names
        self._folder = folder or Path.cwd()
        self._file = Path()
        self._begin_s = 0.0
        self._report: dict[str, Any] = {}
        self._running: asyncio.Task[None] | None = None
        self._process: asyncio.subprocess.Process | None = None

    @property
    def state(self) -> dict[str, Any] | None:
        """The file, its size, losses and duration; None while nothing is recorded."""
        if self._running is None:
            return None
        figures = {name: self._report.get(name, 0) for name in ("bytes", "missed")}
        return {"file": str(self._file), **figures, "s": round(time.monotonic() - self._begin_s, 1)}

    def start(self) -> None:
        if self._running is None:
            self.problem, self._report, self._begin_s = None, {}, time.monotonic()
            self._file = self._folder / time.strftime("skin-%Y%m%d-%H%M%S.mcap")
            self._running = asyncio.create_task(self._run())

    def stop(self) -> None:
        """End the recording in good order; ``state`` is None when the file is complete."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    def mark(self, text: str, time_ns: int) -> bool:
        """Write an event that happened at a time, CLOCK_MONOTONIC, into the recording; return whether there is one."""
        process = self._process
        if process is None or process.stdin is None or process.stdin.is_closing():
            return False
        process.stdin.write(json.dumps({"text": text, "time_ns": time_ns}).encode() + b"\n")
        return True

    async def close(self) -> None:
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
            assert process.stdout is not None and process.stderr is not None  # noqa: S101, PT018 - they are pipes
            errors = asyncio.create_task(process.stderr.read())
            async for line in process.stdout:
                self._report = json.loads(line)
            if await process.wait():
                text = (await errors).decode(errors="replace")
                self.problem = text.strip().rpartition("\n")[2] or "the recording ended by itself"
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
            self._running = self._process = None


class DoctorProgram:
    """Run ``skin-doctor``, one at a time.

    Args:
        program: that prints findings, with the arguments of ``skin-doctor``; empty: none.

    Attributes:
        findings: those of the last examination, as ``skin-doctor --json`` has them; empty while there are no problems.
    """

    def __init__(self, program: Sequence[str], namespace: str) -> None:
        self.findings: list[dict[str, Any]] = []
        self._command = [*program, "--json", "-T", "2", "--namespace", namespace] if program else []
        self._running: asyncio.Task[None] | None = None
        self._seen: frozenset[object] = frozenset()
        self._begun_ns = -_AGAIN_NS

    def follow(self, problems: Collection[object]) -> None:
        """Examine if problems have changed, or stay; without problems there are no findings."""
        seen = frozenset(problems)
        if not seen:
            self.findings, self._seen = [], seen
            return
        due_ns = self._begun_ns + (_AGAIN_NS if seen == self._seen else _SOON_NS)
        if self._command and self._running is None and now_ns() >= due_ns:
            self._begun_ns, self._seen = now_ns(), seen
            self._running = asyncio.create_task(self._examine())

    async def _examine(self) -> None:
        pipe, nothing = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
        process = await asyncio.create_subprocess_exec(*self._command, stdin=nothing, stdout=pipe, stderr=nothing)
        try:
            told, _ = await process.communicate()
            with contextlib.suppress(ValueError, KeyError, TypeError):  # it failed
                self.findings = json.loads(told)["findings"] if self._seen else []
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
            self._running = None

    async def close(self) -> None:
        if self._running is not None:
            self._running.cancel()
            await asyncio.wait({self._running})
            self._running = None


_STATE = "replay"
"""Operation of every service of a replay that returns its state; the other operations return it too."""
REPLAY_VALUES = {"pause": None, "resume": None, "step": "frames", "seek": "time_s", "speed": "factor", "loop": "on"}
"""The operations, each with the name of its argument."""
_ASK_EVERY_NS = NS_PER_S // 4
_PATIENCE_NS = 2 * NS_PER_S


class ReplayControl:
    def __init__(self) -> None:
        self.state: dict[str, Any] | None = None
        self._replayed: ShownDriver | None = None
        self._others: dict[str, int] = {}  # drivers of no replay, and their generations
        self._asked: _Question | None = None
        self._acts: list[_Question] = []
        self._next_ns = 0

    def follow(self, drivers: Sequence[ShownDriver]) -> None:
        self._acts = [act for act in self._acts if not act.is_done()]
        if self._asked is not None and self._asked.is_done():
            self._asked = None
        if self._replayed not in drivers:
            self._replayed = self.state = None
        if self._asked is not None or now_ns() < self._next_ns:
            return
        self._next_ns = now_ns() + _ASK_EVERY_NS
        candidates = (
            driver
            for driver in drivers
            if driver.life != DEAD and self._others.get(driver.name) != driver.live.reader.generation
        )
        driver = self._replayed or next(candidates, None)
        if driver is None:
            return
        is_known = driver is self._replayed
        operation, hear = (_STATE, self._hear) if is_known else (OPERATIONS, partial(self._learn, driver))
        self._asked = _Question(driver, operation, {}, hear, lambda _: self._forget(driver))

    def act(self, action: str, value: int | float | bool | None, complain: Callable[[str], object]) -> None:
        if self._replayed is None:
            raise ConfigurationError("no replay is shown")
        name = REPLAY_VALUES[action]
        arguments = {} if name is None or value is None else {name: value}
        self._acts.append(_Question(self._replayed, action, arguments, self._hear, complain))

    def _learn(self, driver: ShownDriver, operations: dict[str, str]) -> None:
        if _STATE in operations and operations.keys() >= REPLAY_VALUES.keys():
            self._replayed, self._next_ns = driver, 0
        else:
            self._forget(driver)

    def _forget(self, driver: ShownDriver) -> None:
        self._others[driver.name] = driver.live.reader.generation
        self._replayed = self.state = None

    def _hear(self, state: dict[str, Any]) -> None:
        self.state = state


class _Question:
    def __init__(
        self,
        driver: ShownDriver,
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
        """Return whether the answer or an error came; the function for it has been called then."""
        if self._pending is None:
            return True
        if not self._pending.done() and now_ns() < self._late_ns:
            return False
        try:
            self._then(self._pending.result(0.0).result)
        except ServiceError as error:
            self._fail(str(error))
        return True
