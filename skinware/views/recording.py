"""A recording that a viewer begins and ends: in a process of its own, which cannot hold up the view."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

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
