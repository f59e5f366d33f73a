"""Ask ``skin-doctor`` for advice while drivers have problems."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Collection, Sequence
from typing import Any

from skinware.realtime import NS_PER_S, now_ns

_AGAIN_NS, _SOON_NS = 30 * NS_PER_S, 5 * NS_PER_S
"""Between two examinations while problems stay as they are, and when they change."""


class DoctorProgram:
    """Run ``skin-doctor``, one at a time.

    Args:
        program: that prints findings, with the arguments of ``skin-doctor``; empty: none.
        namespace: to examine.

    Attributes:
        findings: those of the last examination, as ``skin-doctor --json`` has them; empty while there are no problems.
    """

    def __init__(self, program: Sequence[str], namespace: str) -> None:
        self.findings: list[dict[str, Any]] = []
        self._command = [*program, "--json", "--seconds", "2", "--namespace", namespace] if program else []
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
        """End an examination."""
        if self._running is not None:
            self._running.cancel()
            await asyncio.wait({self._running})
            self._running = None
