"""One bus of a running driver: opened, asked what is attached to it, set up, lost and found again."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import select
from collections.abc import Awaitable, Callable, Iterable, Sequence

from skinware.errors import BusError, BusNotAvailable, ConfigurationError, DriverError, PlatformError
from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusReason, BusState
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.description import Patch
from skinware_drivers.link import Link
from skinware_drivers.running.connection import Connection
from skinware_drivers.running.guard import Backoff, cause, hook
from skinware_drivers.running.news import WORDS, BusLimits, BusNews, PatchNews, reason_text

log: logging.Logger = logging.getLogger("skinware.driver")

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 4.0
_STOP_TIMEOUT_S = 0.8
_CHECK_PAUSE_NS = NS_PER_S // 2
_NEVER_NS = 1 << 63


class BusCondition:
    """The state of a bus; changes are logged.

    Attributes:
        since_ns: when both became so, CLOCK_MONOTONIC ns.
        heard_ns: when the bus last delivered frames.
        checked_ns: when the bus was last asked whether it is still there.
        speaks_from_ns: from when on its devices send of themselves; before, they only answer.
    """

    def __init__(self, name: str, bus: Bus) -> None:
        self._name, self._bus = name, bus
        self.state: BusState = BusState.CONNECTING
        self.reason: BusReason = BusReason.NONE
        self.since_ns: int = now_ns()
        self.heard_ns: int = 0
        self.speaks_from_ns: int = 0 if bus.listen_only else _NEVER_NS
        self.checked_ns: int = 0
        self._has_spoken = False
        self.limits: BusLimits = BusLimits(name, bus)
        self.news: BusNews = BusNews()

    @property
    def is_in_order(self) -> bool:
        """Whether it delivered frames, and had nothing wrong, when it was last looked at."""
        return self.state is BusState.LIVE and not self.reason

    def become(self, state: BusState, reason: BusReason) -> bool:
        """Enter a state; return whether it is another one."""
        if (state, reason) == (self.state, self.reason):
            return False
        self.state, self.reason, self.since_ns = state, reason, now_ns()
        return True

    def excuse(self, since_ns: int, silence_ns: int) -> None:
        """Count silence from now on, if frames came until this process was held up."""
        if since_ns - self.heard_ns <= max(NS_PER_S // 2, silence_ns):
            self.heard_ns = now_ns()

    def look(self, silence_ns: int) -> None:
        """Look at the open bus, which counts as silent after this time, ns."""
        time_ns = now_ns()
        self.news.catch_up()
        self.limits.look()
        before, reason = (self.state, self.reason), self._bus.reason(time_ns)
        if reason == BusReason.BUS_OFF:
            self.become(BusState.DOWN, reason)
        elif time_ns - self.heard_ns > max(NS_PER_S // 2, silence_ns):
            self.become(BusState.SILENT, reason or BusReason.NOTHING_HEARD)
        else:
            self.become(BusState.LIVE, reason)
        if before == (self.state, self.reason):
            news = ""
        elif self.reason == BusReason.NOTHING_HEARD:
            news = WORDS[self.reason] if before[0] == BusState.LIVE and self._has_spoken else ""
        elif self.reason:
            news = WORDS[self.reason] if self.reason != before[1] else ""
        elif before[1] == BusReason.NOTHING_HEARD:
            news = "frames come again" if self._has_spoken else ""
        else:
            news = f"in order again (was {reason_text(before[1])})" if before[1] else ""
        if news:
            self.news.log(f"bus {self._name}: {news}")
        self._has_spoken |= self.heard_ns > self.speaks_from_ns


class BusLine:
    """A bus with the driver's object for it.

    Args:
        ordinal: its place among the driver's buses.
        bus: the bus itself, not open.

    Attributes:
        patches: found on it, None until it was asked.
        patch_news: logs which of its patches fell silent, or are live again.
        suspects: keys of the patches that report errors.
        started: its devices may have begun to send.
        set_up_ns: when all of it was last set up, CLOCK_MONOTONIC ns.
        needs_care: set when it was lost, or a patch on it does not deliver.
        busy: held while its devices are being set up or asked to do something, and may be silent for it.
    """

    def __init__(self, name: str, ordinal: int, adapter: AnyAdapter, bus: Bus, epoll: select.epoll) -> None:
        adapter.fit(bus)
        self.name, self.ordinal, self.adapter, self.bus = name, ordinal, adapter, bus
        self.link: Link = Link(bus, adapter.pace_per_ms)
        self.connection: Connection = Connection(name, bus, epoll, _attempts())
        self.condition: BusCondition = BusCondition(name, bus)
        self.patches: Sequence[Patch] | None = None
        self.patch_news: PatchNews = PatchNews(name)
        self.suspects: set[int] = set()
        self.started: bool = False
        self.set_up_ns = 0
        self.needs_care: asyncio.Event = asyncio.Event()
        self.busy: asyncio.Lock = asyncio.Lock()

    @property
    def is_removed(self) -> bool:
        return self.condition.reason == BusReason.REMOVED

    @property
    def geometry(self) -> Geometry | None:
        """Positions of the sensors on it: those that the bus knows, or else its driver."""
        of_bus = self.bus.geometry
        return self.adapter.geometry if of_bus is None else of_bus

    @property
    def losses(self) -> tuple[int, ...]:
        """Numbers that change whenever frames are known to be lost: dropped, or not received."""
        counters = self.bus.counters
        return counters.dropped, counters.overflows, counters.bus_offs, self.connection.opened_ns

    async def open(self) -> None:
        """Open the bus.

        Raises:
            BusNotAvailable: it cannot be opened now, or takes long.
            ConfigurationError: it can never be opened like this.
            PlatformError: this system cannot open it.
        """
        try:
            await self.connection.open()
            self.condition.become(BusState.SILENT, self.bus.reason(now_ns()))
        except (BusNotAvailable, ConfigurationError, PlatformError):
            raise
        except Exception as error:
            raise _failure(self.name, "open", error) from error

    async def reopen(self) -> None:
        """Wait until a lost bus is back."""
        is_first = True
        while True:
            await self.connection.pause(is_first=is_first)
            is_first = False
            self.condition.news.catch_up()
            was_there = self.connection.opened_ns
            try:
                await self.open()
            except (BusNotAvailable, ConfigurationError, PlatformError) as error:
                self._is_away(error)
            else:
                self.condition.news.log(f"bus {self.name} is {'back' if was_there else 'there'}")
                return

    def lose(self, method: str, error: Exception) -> None:
        """Close the bus because one of its methods failed, whatever it raised; ``reopen`` waits for the bus."""
        self._drop()
        self._is_away(_failure(self.name, method, error))

    def _drop(self) -> None:
        self.connection.drop()
        self.needs_care.set()

    def _is_away(self, error: Exception) -> None:
        if self.connection.opening is not None:
            state, reason = BusState.CONNECTING, BusReason.FAILED
        elif isinstance(error, BusNotAvailable):
            state, reason = (BusState.DOWN if error.is_down else BusState.GONE), error.reason
        else:
            state, reason = BusState.GONE, BusReason.FAILED
        if self.condition.become(state, reason):
            waits = "come back" if self.connection.opened_ns else "appear"
            self.condition.news.log(f"{error}; waiting for it to {waits}")

    def look(self, silence_ns: int) -> None:
        """Look after the bus, which counts as silent after this time, ns."""
        if not self.connection.is_open or self.connection.lost.is_set():
            return
        self.condition.look(silence_ns)
        if not self.condition.is_in_order:
            self._check()

    def _check(self) -> None:
        """Ask a bus that is not in order whether it is still there, now and then."""
        time_ns = now_ns()
        if self.connection.lost.is_set() or time_ns - self.condition.checked_ns < _CHECK_PAUSE_NS:
            return
        self.condition.checked_ns = time_ns
        try:
            self.bus.check()
        except Exception as error:  # noqa: BLE001  (the bus cannot be trusted any more)
            self.lose("check", error)

    async def describe(self, described: Callable[[], Awaitable[None]]) -> None:
        """Ask for the patches on the bus until there are some; call ``described`` after every answer, also without."""
        is_logged, attempts = False, _attempts()
        while True:
            await asyncio.sleep(attempts.next_s())
            if self.connection.lost.is_set():
                await self.reopen()
            found: Sequence[Patch] = ()
            try:
                with hook("describe", self.name):
                    found = are_patches(await self.adapter.describe(self.link))
                why = "no patch is heard, and no device may be asked" if self.bus.listen_only else "no patch answers"
            except BusError as error:
                why = str(error)
                self._check()
            self.patches = found or self.patches or ()  # those of a bus that was set aside stay
            await described()
            if found:
                return
            if not is_logged:
                log.warning("%s: %s; waiting for one to appear", self.name, why)
                is_logged = True

    async def set_up(self) -> None:
        """Set its devices up and start them, until that succeeds."""
        attempts = _attempts()
        while True:
            await asyncio.sleep(attempts.next_s())
            if self.connection.lost.is_set():
                await self.reopen()
            self.started = True  # devices may begin to send at any moment of it
            try:
                async with self.busy:
                    with hook("configure", self.name):
                        await self.adapter.configure(self.link)
                    with hook("start", self.name):
                        await self.adapter.start(self.link)
            except BusError as error:
                self.condition.news.log(f"{self.name}: set-up failed: {error}; trying again")
                self._check()
            else:
                self.set_up_ns = self.condition.speaks_from_ns = now_ns()
                return

    def begin_lost(self, error: BusNotAvailable | None = None) -> None:
        """Wait for a bus that was never open as for one that was lost; nothing is attached to it so far."""
        self.patches = ()
        self.connection.lost.set()
        self.needs_care.set()
        if error is not None:
            self._is_away(error)

    def remove(self) -> None:
        self._drop()
        self.patches = ()
        self.condition.become(BusState.GONE, BusReason.REMOVED)

    async def set_aside(self, error: Exception) -> None:
        """Stop its devices and close it after a failure of the driver's own code; ``reopen`` opens it again."""
        with contextlib.suppress(DriverError):  # which failed already
            await self.stop()
        self._drop()
        self.patches = self.patches or ()
        self.condition.become(BusState.DOWN, BusReason.SET_ASIDE)
        self.condition.news.log(f"{error}; bus {self.name} is set aside, and tried again later")

    async def stop(self) -> None:
        """Stop its devices, if they may send and the bus is open; raise ``DriverError`` if the driver's code fails."""
        if not self.started or self.connection.opening is not None or not self.connection.is_open:
            return
        try:
            async with asyncio.timeout(_STOP_TIMEOUT_S):
                with hook("stop", self.name):
                    await self.adapter.stop(self.link)
        except (BusError, ConfigurationError) as error:
            log.warning("%s: not stopped in good order: %s", self.name, str(error))
        except TimeoutError:
            log.warning("%s: not stopped in good order: it took too long", self.name)


async def open_buses(lines: Sequence[BusLine], *, wait_for_one: bool) -> None:
    """Open all available buses at once: a slow one holds up no other. The others are waited for.

    Args:
        wait_for_one: wait also if none is available.

    Raises:
        BusNotAvailable: none is available, or this user may not open one.
        ConfigurationError, PlatformError: one can never be opened like this.
    """
    opened = await asyncio.gather(*(line.open() for line in lines), return_exceptions=True)
    absent: dict[BusLine, BusNotAvailable] = {}
    for line, error in zip(lines, opened, strict=True):
        if isinstance(error, BusNotAvailable) and error.reason != BusReason.REFUSED:
            absent[line] = error
        elif error is not None:
            raise error
    if len(absent) == len(lines) and not wait_for_one:
        raise absent[lines[0]]
    for line, why in absent.items():
        line.begin_lost(why)


def are_patches(found: Iterable[object]) -> Sequence[Patch]:
    """Return the patches that ``describe`` or ``join`` of an adapter returned; raise a TypeError if they are none."""
    patches = []
    for patch in found:
        if not isinstance(patch, Patch):
            raise TypeError(f"it returned {patch!r} among its patches; a sequence of Patch is needed")
        patches.append(patch)
    return patches


def _attempts() -> Backoff:
    return Backoff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S, free=1)


def _failure(bus: str, method: str, error: Exception) -> BusNotAvailable:
    """Return the loss of a bus whose own code failed."""
    if isinstance(error, BusNotAvailable):
        return error
    return BusNotAvailable(f"bus {bus}: `{method}` failed: {cause(error)}", reason=BusReason.FAILED)
