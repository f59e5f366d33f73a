"""One bus of a running driver: opened, asked, set up, lost and found again."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import select
from collections.abc import Awaitable, Callable, Iterator, Sequence

from skinware.errors import BusError, BusNotAvailable
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusState
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.description import Patch
from skinware_drivers.link import Link

log = logging.getLogger("skinware.driver")

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 4.0
_STOP_TIMEOUT_S = 2.0


class BusLine:
    """A bus with the driver's object for it.

    Args:
        name: as the user wrote it.
        ordinal: its place among the driver's buses.
        adapter: the driver's object for this bus.
        bus: the bus itself, not open.
        epoll: where its descriptor is registered as long as it is open.

    Attributes:
        link: handshakes on it.
        patches: what was found on it, None until it was asked.
        state: what the bus is doing.
        heard_ns: when it last delivered frames.
        opened_ns: when it was last opened.
        started: its devices have been told to send.
        lost: set while it is away.
        suspects: keys of the patches that report errors.
        revived_ns: when one of its patches was last set up anew.
        busy: held while its devices are being set up or asked to do something, and may be silent for it.
    """

    def __init__(self, name: str, ordinal: int, adapter: AnyAdapter, bus: Bus, epoll: select.epoll) -> None:
        self.name = name
        self.ordinal = ordinal
        self.adapter = adapter
        self.bus = bus
        adapter.fit(bus)
        self.link = Link(bus)
        self.patches: Sequence[Patch] | None = None
        self.state = BusState.CONNECTING
        self.heard_ns = 0
        self.opened_ns = 0
        self.started = False
        self.lost = asyncio.Event()
        self.busy = asyncio.Lock()
        self.suspects: set[int] = set()
        self.revived_ns = 0
        self._epoll = epoll

    def open(self) -> None:
        """Open the bus.

        Raises:
            BusNotAvailable: it cannot be opened now.
        """
        self.bus.open()
        self._epoll.register(self.bus.fileno(), select.EPOLLIN)
        self.state = BusState.SILENT
        self.opened_ns = now_ns()
        self.lost.clear()
        if self.bus.note:
            log.warning("%s", self.bus.note)

    def lose(self, error: BusNotAvailable) -> None:
        """Close it because it went away; ``reopen`` waits for it."""
        self.state = BusState.DOWN if error.is_down else BusState.GONE
        log.warning("%s; waiting for it to come back", str(error))  # a record that kept the error would keep us
        with contextlib.suppress(OSError):
            self._epoll.unregister(self.bus.fileno())
        self.bus.close()
        self.lost.set()

    async def reopen(self) -> None:
        """Wait until a lost bus is back."""
        for pause_s in _pauses():
            await asyncio.sleep(pause_s)
            try:
                self.open()
            except BusNotAvailable as error:
                self.state = BusState.DOWN if error.is_down else BusState.GONE
            else:
                log.warning("bus %s is back", self.name)
                return

    def look(self, silence_ns: int) -> None:
        """Tell a living bus from one that says nothing."""
        if self.bus.fileno() >= 0:
            silent = now_ns() - self.heard_ns > max(NS_PER_S // 2, silence_ns)
            self.state = BusState.SILENT if silent else BusState.LIVE

    async def describe(self, described: Callable[[], Awaitable[None]]) -> None:
        """Ask what hangs on it, for as long as it takes.

        Args:
            described: called after every answer, also after an empty one.
        """
        told = False
        for pause_s in _pauses():
            await asyncio.sleep(pause_s)
            if self.lost.is_set():
                await self.reopen()
            try:
                self.patches = await self.adapter.describe(self.link)
                why = "no patch answers"
            except BusError as error:
                self.patches = ()
                why = str(error)
            await described()
            if self.patches:
                return
            if not told:
                log.warning("%s: %s; waiting for one to appear", self.name, why)
                told = True

    async def set_up(self) -> None:
        """Set its devices up and make them send, for as long as it takes."""
        for pause_s in _pauses():
            await asyncio.sleep(pause_s)
            if self.lost.is_set():
                await self.reopen()
            try:
                async with self.busy:
                    await self.adapter.configure(self.link)
                    await self.adapter.start(self.link)
            except BusError as error:
                log.warning("%s: set-up failed: %s; trying again", self.name, str(error))
            else:
                self.started = True
                return

    async def stop(self) -> None:
        """Make its devices silent, if they were told to send and it can be done now."""
        if not self.started or self.bus.fileno() < 0:
            return
        try:
            await asyncio.wait_for(self.adapter.stop(self.link), _STOP_TIMEOUT_S)
        except BusError as error:
            log.warning("%s: not stopped in good order: %s", self.name, str(error))
        except TimeoutError:
            log.warning("%s: not stopped in good order: it took too long", self.name)


def _pauses() -> Iterator[float]:
    """What to wait before each attempt, s: nothing first, then longer and longer."""
    yield 0.0
    pause_s = _FIRST_PAUSE_S
    while True:
        yield pause_s
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
