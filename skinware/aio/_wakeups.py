"""Waiting for shared memory in event loops: one thread for the whole process, asleep until a writer publishes."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import time
from collections.abc import Sequence

import numpy as np

from skinware.memory import futex
from skinware.realtime import NS_PER_S, now_ns

WakeWord = tuple[futex.Word, int]
"""A futex word, and the value that it had."""

_POLL_NS = 1_000_000
"""Where the kernel cannot wait for several words, or not for that many."""
_LOOK_NS = NS_PER_S
"""After this at the latest, memory that nobody waits for any more is let go."""
_LONG_NS = 3600 * NS_PER_S


class _Wait:
    """One coroutine that waits for any of some words to change."""

    def __init__(self, words: Sequence[WakeWord]) -> None:
        self.words = words
        self._loop = asyncio.get_running_loop()
        self.future: asyncio.Future[None] = self._loop.create_future()

    @property
    def is_over(self) -> bool:
        return any(word.value != known for word, known in self.words)

    def end(self) -> None:
        """Let it go on; from any thread."""
        with contextlib.suppress(RuntimeError):  # its loop was closed
            self._loop.call_soon_threadsafe(self.finish)

    def finish(self) -> None:
        if not self.future.done():
            self.future.set_result(None)


class Wakeups:
    """What all coroutines of this process wait for, in one system call of one thread.

    The thread runs as long as somebody uses it, and sleeps unless a word changes or a wait for a new one begins.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._waits: list[_Wait] = []
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
        wait = _Wait(words)
        timer = asyncio.get_running_loop().call_later(timeout_s, wait.finish)
        with self._lock:
            self._waits.append(wait)
            is_new = any((word.address, known) not in self._watched for word, known in words)
            self._changes += is_new
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="skinware wake-ups", daemon=True)
                self._thread.start()
        if is_new:
            self._changed.wake_all()
        try:
            await wait.future
        finally:
            timer.cancel()
            with self._lock:
                self._waits = [other for other in self._waits if other is not wait]

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
        """Let those go on whose words have changed; what the others wait for, each place once."""
        with self._lock:
            over = [wait for wait in self._waits if wait.is_over]
            self._waits = [wait for wait in self._waits if wait not in over]
            words = {word.address: (word, known) for wait in self._waits for word, known in wait.words}
            self._watched = {(address, known) for address, (_, known) in words.items()}
        for wait in over:
            wait.end()
        return list(words.values())


_of_process = Wakeups()


def wakeups() -> Wakeups:
    """Those of this process, in use from now on until ``leave``."""
    _of_process.enter()
    return _of_process


def _begin_anew() -> None:
    global _of_process
    _of_process = Wakeups()


os.register_at_fork(after_in_child=_begin_anew)
