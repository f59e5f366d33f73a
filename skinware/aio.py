"""Reading in asyncio programs and notebooks.

::

    import skinware.aio

    async with skinware.aio.Skin() as skin:
        async for snapshot in skin:
            print(snapshot.physical("pressure").max())

The calls are those of :class:`skinware.Skin` and :class:`skinware.ServiceReader`, awaited. They may be cancelled at any
time. However many of them wait, one thread of the process waits for all of shared memory, asleep until a writer
publishes. One coroutine at a time per reader or skin: make as many as you like.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import time
from collections.abc import AsyncIterator, Sequence
from typing import Any, Generic, Self

import numpy as np

import skinware.skin
from skinware.errors import RequestTimeout, ServiceTimeout
from skinware.memory import futex
from skinware.memory.ring import SampleT
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, Periodic, now_ns
from skinware.service import Position, ServiceReader
from skinware.service._reader import wake_word_of
from skinware.snapshot import Snapshot

__all__ = ["Reader", "Skin"]

_ANSWER_POLL_S = 0.005

WakeWord = tuple[futex.Word, int]
"""A futex word, and the value that it had."""

_POLL_NS = 1_000_000
"""Where the kernel cannot wait for several words, or not for that many."""
_LOOK_NS = NS_PER_S
"""After this at the latest, memory that no coroutine waits for is released."""
_LONG_NS = 3600 * NS_PER_S


def _finish(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


class Wakeups:
    """Wait for the memory that all coroutines of this process wait for, in one system call of one thread.

    The thread runs as long as it is used, and sleeps unless a word changes or a wait for a new one begins.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._waits: list[tuple[Sequence[WakeWord], asyncio.Future[None]]] = []
        self._watched: set[tuple[int, int]] = set()  # address and value of the words that the thread sleeps on
        memory = np.zeros(4, np.uint8)
        self._changes = memory.view(np.uint32)  # how often there was something new for the thread
        self._changed = futex.Word(memory, 0)
        self._thread: threading.Thread | None = None

    def enter(self) -> None:
        with self._lock:
            self._users += 1

    def leave(self) -> None:
        """Use it no more; after the last one the thread has ended."""
        with self._lock:
            self._users -= 1
            thread = None if self._users else self._thread
            if thread is None:
                return
            self._thread = None
            self._changes += 1
        self._changed.wake_all()
        thread.join()

    async def wait(self, words: Sequence[WakeWord], timeout_s: float) -> None:
        """Come back when one of the words is another than it was, or the time is up; may come back early."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[None] = loop.create_future()
        timer = loop.call_later(timeout_s, _finish, future)
        with self._lock:
            self._waits.append((words, future))
            is_new = any((word.address, known) not in self._watched for word, known in words)
            self._changes += is_new
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="skinware wake-ups", daemon=True)
                self._thread.start()
        if is_new:
            self._changed.wake_all()
        try:
            await future
        finally:
            timer.cancel()
            with self._lock:
                self._waits = [(words, other) for words, other in self._waits if other is not future]

    def _run(self) -> None:
        while True:
            changes = int(self._changes[0])
            words = self._look()
            if self._thread is not threading.current_thread():
                return
            if not words:
                self._changed.wait(changes, _LONG_NS)
                continue
            until_ns = now_ns() + (_POLL_NS if len(words) >= futex.MAX_WORDS else _LOOK_NS)
            if not futex.wait_any([(self._changed, changes), *words[: futex.MAX_WORDS - 1]], until_ns):
                time.sleep(_POLL_NS / NS_PER_S)

    def _look(self) -> list[WakeWord]:
        """Wake the coroutines whose words have changed; return what the others wait for, each place once."""
        with self._lock:
            over = [future for words, future in self._waits if any(word.value != known for word, known in words)]
            self._waits = [(words, future) for words, future in self._waits if future not in over]
            waited_for = {word.address: (word, known) for words, _ in self._waits for word, known in words}
            self._watched = {(address, known) for address, (_, known) in waited_for.items()}
        for future in over:
            with contextlib.suppress(RuntimeError):  # its loop was closed
                future.get_loop().call_soon_threadsafe(_finish, future)
        return list(waited_for.values())


_of_process = Wakeups()


def _start_again() -> None:
    global _of_process
    _of_process = Wakeups()


os.register_at_fork(after_in_child=_start_again)


class _Awaited:
    """Share the thread that waits with all other objects of this kind, until ``close``."""

    sync: ServiceReader[Any] | skinware.skin.Skin

    def __init__(self) -> None:
        _of_process.enter()
        self._wakeups = _of_process
        self._closed = False

    def close(self) -> None:
        self.sync.close()
        if not self._closed:
            self._closed = True
            self._wakeups.leave()

    async def _read(self, timeout_s: float | None, **how: Any) -> Any:
        deadline_ns = None if timeout_s is None else now_ns() + round(timeout_s * NS_PER_S)
        while True:
            words = self._words()
            try:
                return self.sync.read(timeout_s=0, **how)
            except ServiceTimeout:
                remaining_ns = WAIT_SLICE_NS if deadline_ns is None else min(WAIT_SLICE_NS, deadline_ns - now_ns())
                if remaining_ns <= 0:
                    raise
            await self._wakeups.wait(words, remaining_ns / NS_PER_S)

    def _words(self) -> list[WakeWord]:
        raise NotImplementedError

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


class Reader(_Awaited, Generic[SampleT]):
    """A reader of one service for asyncio.

    Args:
        reader: from now on used and closed by this object.

    Attributes:
        sync: that reader, for everything that does not wait.
    """

    def __init__(self, reader: ServiceReader[SampleT]) -> None:
        self.sync: ServiceReader[SampleT] = reader
        super().__init__()

    async def read(
        self,
        *,
        newer_than: SampleT | Position | None = None,
        max_age_s: float | None = None,
        timeout_s: float | None = 5.0,
    ) -> SampleT:
        """As :meth:`skinware.ServiceReader.read`; it raises the same."""
        frame: SampleT = await self._read(timeout_s, newer_than=newer_than, max_age_s=max_age_s)
        return frame

    async def samples(
        self, rate_hz: float | None = None, *, max_age_s: float | None = None, timeout_s: float | None = None
    ) -> AsyncIterator[SampleT]:
        """As :meth:`skinware.ServiceReader.samples`; it raises the same."""
        frame: SampleT | None = None
        timer = None if rate_hz is None else Periodic(rate_hz)
        while timer is None or await _deadline(timer):
            newer_than = frame if timer is None or self.sync.structure_changed else None
            frame = await self.read(newer_than=newer_than, max_age_s=max_age_s, timeout_s=timeout_s)
            yield frame

    def __aiter__(self) -> AsyncIterator[SampleT]:
        return self.samples()

    def _words(self) -> list[WakeWord]:
        self.sync.refresh()
        return [wake_word_of(self.sync)]

    async def request(self, *, timeout_s: float = 5.0) -> SampleT:
        """As :meth:`skinware.ServiceReader.request`; it raises the same."""
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        answer = await self._ask("acquire", {}, timeout_s)
        left_s = max(0.0, (deadline_ns - now_ns()) / NS_PER_S)
        return await self.read(newer_than=(answer.generation, answer.sequence - 1), timeout_s=left_s)

    async def call(self, operation: str, /, *, timeout_s: float = 5.0, **arguments: Any) -> Any:
        """As :meth:`skinware.ServiceReader.call`; it raises the same."""
        return (await self._ask(operation, arguments, timeout_s)).result

    async def _ask(self, operation: str, arguments: dict[str, Any], timeout_s: float) -> Any:
        pending = self.sync.ask(operation, **arguments)
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        try:
            while not pending.done():
                if now_ns() >= deadline_ns:
                    raise RequestTimeout(f"{self.sync.name}: no answer to {operation!r} within {timeout_s:g} s")
                await asyncio.sleep(_ANSWER_POLL_S)
            return pending.result(0.0)
        finally:
            pending.cancel()  # if it was not answered


class Skin(_Awaited):
    """All running drivers as one skin, for asyncio.

    Args:
        skin: from now on used and closed by this object. Default: ``skinware.Skin()``.

    Attributes:
        sync: that skin, for everything that does not wait.
    """

    def __init__(self, skin: skinware.skin.Skin | None = None) -> None:
        self.sync: skinware.skin.Skin = skinware.skin.Skin() if skin is None else skin
        super().__init__()

    async def read(
        self,
        *,
        newer_than: Snapshot | None = None,
        max_age_s: float | None = None,
        align: bool = False,
        timeout_s: float | None = 5.0,
    ) -> Snapshot:
        """As :meth:`skinware.Skin.read`; it raises the same."""
        snapshot: Snapshot = await self._read(timeout_s, newer_than=newer_than, max_age_s=max_age_s, align=align)
        return snapshot

    async def samples(
        self,
        rate_hz: float | None = None,
        *,
        max_age_s: float | None = None,
        align: bool = False,
        timeout_s: float | None = None,
    ) -> AsyncIterator[Snapshot]:
        """As :meth:`skinware.Skin.samples`; it raises the same."""
        snapshot: Snapshot | None = None
        timer = None if rate_hz is None else Periodic(rate_hz)
        while timer is None or await _deadline(timer):
            newer_than = snapshot if timer is None else None
            snapshot = await self.read(newer_than=newer_than, max_age_s=max_age_s, align=align, timeout_s=timeout_s)
            yield snapshot

    def __aiter__(self) -> AsyncIterator[Snapshot]:
        return self.samples()

    def _words(self) -> list[WakeWord]:
        return [wake_word_of(self.sync.reader(driver)) for driver in self.sync.layout.drivers]


async def _deadline(timer: Periodic) -> bool:
    await asyncio.sleep(max(0.0, (timer.deadline_ns - now_ns()) / NS_PER_S))
    timer.advance(now_ns())
    return True
