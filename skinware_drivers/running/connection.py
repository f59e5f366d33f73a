"""The connection to a bus: opened, closed and opened again, although its interface may hang."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import select
import threading
from collections.abc import Callable

from skinware.errors import BusNotAvailable
from skinware.realtime import now_ns
from skinware.status import BusReason
from skinware_drivers.bus import Bus
from skinware_drivers.running.guard import Backoff

log: logging.Logger = logging.getLogger("skinware.driver")

_OPENING_S = 10.0
"""Time in which an interface must open; after it, the log says that the interface hangs."""


class SlowCall:
    """A call in a thread that does not keep the program from ending."""

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
        """Wait for the call to return, at most for a time, s; return whether it did."""
        over, _ = await asyncio.wait([self._over], timeout=patience_s)
        if over:
            self._thread.join()  # which has nothing left to do
        return bool(over)

    def check(self) -> None:
        """Raise what the call raised; to be called once it is over."""
        error = self._over.result()
        if error is not None:
            raise error

    def leave(self, afterwards: Callable[[], object]) -> bool:
        """Stop waiting for the call; if it returns after all, ``afterwards`` is called in its thread.

        Returns:
            False: the call is already over, and nothing is done.
        """
        with self._lock:
            if not self._has_returned:
                self._afterwards = afterwards
            return not self._has_returned

    def _work(self) -> None:
        failure = None
        try:
            self._call()
        except Exception as error:  # noqa: BLE001  (``check`` raises it)
            failure = error
        with self._lock:
            self._has_returned = True
        if self._afterwards is not None:
            with contextlib.suppress(Exception):
                self._afterwards()
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._over.set_result, failure)


class Connection:
    """The connection to one bus.

    Attributes:
        lost: set while there is none.
        opened_ns: when the bus was last opened, CLOCK_MONOTONIC ns; 0: never.
    """

    def __init__(self, name: str, bus: Bus, epoll: select.epoll, pauses: Backoff) -> None:
        self._name, self._bus, self._epoll, self._pauses = name, bus, epoll, pauses
        self.lost: asyncio.Event = asyncio.Event()
        self.opened_ns: int = 0
        self._noted = ""
        self.opening: SlowCall | None = None

    @property
    def is_open(self) -> bool:
        """Whether the bus has a descriptor."""
        return self._bus.fileno() >= 0

    async def open(self) -> None:
        """Open the bus; raise whatever it raises, and ``BusNotAvailable`` if its interface hangs."""
        if self._bus.opens_slowly:
            if self.opening is None:  # or the call of the last attempt has not returned yet
                self.opening = SlowCall(f"bus {self._name}, opening", self._bus.open)
            if not await self.opening.is_over(_OPENING_S):
                why = f"bus {self._name} is not open after {_OPENING_S:g} s: its interface hangs"
                raise BusNotAvailable(why, reason=BusReason.FAILED)
            opening, self.opening = self.opening, None
            opening.check()
        else:
            self._bus.open()
        self.opened()

    async def pause(self, *, is_first: bool) -> None:
        """Let the pause before the next attempt to open the bus pass, or the first one after a loss."""
        if is_first:
            self._pauses.begin_again_after(now_ns() - self.opened_ns)
        if self.opening is None:
            await asyncio.sleep(self._pauses.next_s())

    def opened(self) -> None:
        """Register the open bus."""
        self._epoll.register(self._bus.fileno(), select.EPOLLIN)
        self.opened_ns = now_ns()
        self.lost.clear()
        if self._bus.note and self._bus.note != self._noted:
            log.warning("%s", self._bus.note)
            self._noted = self._bus.note

    def drop(self) -> None:
        """Close the bus, without waiting for anything."""
        if self.is_open:
            with contextlib.suppress(OSError):
                self._epoll.unregister(self._bus.fileno())
        self._close()
        self.lost.set()

    async def close(self, patience_s: float) -> None:
        """Close the bus for good. If its interface hangs, stop waiting after this time, s."""
        if self.opening is not None:
            await self.opening.is_over(patience_s)
        if not self._bus.opens_slowly or self.opening is not None:
            self._close()
        elif not await SlowCall(f"bus {self._name}, closing", self._bus.close).is_over(patience_s):
            log.warning("bus %s: its interface hangs while it is closed, and is left to itself", self._name)

    def _close(self) -> None:
        opening, self.opening = self.opening, None
        if opening is None or not opening.leave(self._bus.close):
            self._bus.close()
        else:
            log.warning("bus %s: its interface is still being opened, and is left to itself", self._name)
