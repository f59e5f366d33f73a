"""Calls of libraries that may take long, or never come back: they hold up nothing but a thread of their own."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable


class SlowCall:
    """A call that has begun, in a thread that a program need not wait for when it ends.

    Args:
        name: of the thread.
        call: what to do there.
    """

    def __init__(self, name: str, call: Callable[[], object]) -> None:
        self._call = call
        self._afterwards: Callable[[], object] | None = None
        self._lock = threading.Lock()
        self._has_returned = False
        self._loop = asyncio.get_running_loop()
        self._over: asyncio.Future[Exception | None] = self._loop.create_future()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    async def is_over(self, patience_s: float) -> bool:
        """Whether it comes back within a time, s."""
        over, _ = await asyncio.wait([self._over], timeout=patience_s)
        if over:
            self._thread.join()  # which has nothing left to do
        return bool(over)

    def check(self) -> None:
        """Once it is over: raise what it raised."""
        error = self._over.result()
        if error is not None:
            raise error

    def leave(self, afterwards: Callable[[], object]) -> bool:
        """Leave it to itself, if it is not over; something is done in its thread when it has come back after all.

        Returns:
            Whether it was left; False: it is over, and nothing is done.
        """
        with self._lock:
            if not self._has_returned:
                self._afterwards = afterwards
            return not self._has_returned

    def _work(self) -> None:
        failure = None
        try:
            self._call()
        except Exception as error:  # noqa: BLE001  (for whoever asks)
            failure = error
        with self._lock:
            self._has_returned = True
        if self._afterwards is not None:
            with contextlib.suppress(Exception):
                self._afterwards()
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody asks any more
            self._loop.call_soon_threadsafe(self._over.set_result, failure)
