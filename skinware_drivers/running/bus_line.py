"""One bus of a running driver: opened, asked, set up, lost and found again."""

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
from skinware_drivers.running.guard import Backoff, SlowCall, bus_failure, hook
from skinware_drivers.running.news import WORDS, BusLimits, BusNews, PatchNews, reason_text

log: logging.Logger = logging.getLogger("skinware.driver")

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 4.0
_FIRST_PAUSE_ASIDE_S, _LONGEST_PAUSE_ASIDE_S = 1.0, 60.0
_STOP_TIMEOUT_S = 0.8
_OPENING_S = 10.0
"""How long an interface may take to be opened before somebody says that it hangs."""
_CHECK_PAUSE_NS = NS_PER_S // 2
_NEVER_NS = 1 << 63


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
        reason: why, or what is wrong with it though frames come.
        limits: how close it is to what it can carry.
        patch_news: which of its patches fell silent, or are live again.
        since_ns: since when both have been so, CLOCK_MONOTONIC ns.
        heard_ns: when it last delivered frames.
        opened_ns: when it was last opened.
        started: its devices have been told to send, or may have been.
        is_aside: the driver's own code failed on it, and has not succeeded since.
        aside: how long it is left alone then.
        lost: set while it is away.
        needs_care: set when it was lost, or a patch on it does not deliver.
        suspects: keys of the patches that report errors.
        revived_ns: when one of its patches was last set up anew.
        set_up_ns: when all of it was last set up.
        busy: held while its devices are being set up or asked to do something, and may be silent for it.
    """

    def __init__(self, name: str, ordinal: int, adapter: AnyAdapter, bus: Bus, epoll: select.epoll) -> None:
        self.name = name
        self.ordinal = ordinal
        self.adapter = adapter
        self.bus = bus
        adapter.fit(bus)
        self.link: Link = Link(bus, adapter.pace_per_ms)
        self.patches: Sequence[Patch] | None = None
        self.state: BusState = BusState.CONNECTING
        self.reason: BusReason = BusReason.NONE
        self.since_ns: int = now_ns()
        self.heard_ns = 0
        self.opened_ns: int = 0
        self.started: bool = False
        self.is_aside: bool = False
        self.aside: Backoff = Backoff(_FIRST_PAUSE_ASIDE_S, _LONGEST_PAUSE_ASIDE_S)
        self.lost: asyncio.Event = asyncio.Event()
        self.needs_care: asyncio.Event = asyncio.Event()
        self.busy: asyncio.Lock = asyncio.Lock()
        self.suspects: set[int] = set()
        self.revived_ns = 0
        self.set_up_ns = 0
        self._epoll = epoll
        self.limits: BusLimits = BusLimits(name, bus)
        self.patch_news: PatchNews = PatchNews(name)
        self._news = BusNews()
        self._noted = ""
        self._checked_ns = 0
        self._speaks_from_ns = 0 if bus.listen_only else _NEVER_NS  # before, it only answers
        self._has_spoken = False
        self._reopening = _attempts()
        self._opening: SlowCall | None = None

    async def open(self) -> None:
        """Open the bus.

        Raises:
            BusNotAvailable: it cannot be opened now, or takes long.
            ConfigurationError: it can never be opened like this.
            PlatformError: this system cannot.
        """
        try:
            await self._open_bus()
            self._is_open()
        except (BusNotAvailable, ConfigurationError, PlatformError):
            raise
        except Exception as error:
            raise bus_failure(self.name, "open", error) from error

    async def _open_bus(self) -> None:
        """Open the bus itself; if that hangs, the next attempt waits for the same one to end."""
        if not self.bus.opens_slowly:
            self.bus.open()
            return
        if self._opening is None:
            self._opening = SlowCall(f"bus {self.name}, opening", self.bus.open)
        if not await self._opening.is_over(_OPENING_S):
            why = f"bus {self.name} is not open after {_OPENING_S:g} s: its interface hangs"
            raise BusNotAvailable(why, reason=BusReason.FAILED)
        opening, self._opening = self._opening, None
        opening.check()

    def _is_open(self) -> None:
        self._epoll.register(self.bus.fileno(), select.EPOLLIN)
        self._become(BusState.SILENT, self.bus.reason(now_ns()))
        self.opened_ns = now_ns()
        self.lost.clear()
        if self.bus.note and self.bus.note != self._noted:
            log.warning("%s", self.bus.note)
            self._noted = self.bus.note

    def lose(self, error: BusNotAvailable) -> None:
        """Close it because it went away; ``reopen`` waits for it."""
        self._let_go()
        self._is_away(error)

    def _let_go(self) -> None:
        if self.bus.fileno() >= 0:
            with contextlib.suppress(OSError):
                self._epoll.unregister(self.bus.fileno())
        self._close_bus()
        self.lost.set()
        self.needs_care.set()

    def _close_bus(self) -> None:
        opening, self._opening = self._opening, None
        if opening is None or not opening.leave(self.bus.close):
            self.bus.close()
        else:
            log.warning("bus %s: its interface is still being opened, and is left to itself", self.name)

    async def close(self, patience_s: float) -> None:
        """Close the bus for good. One that hangs is left to itself after this time, and holds up no other meanwhile."""
        if self._opening is not None:
            await self._opening.is_over(patience_s)
        if not self.bus.opens_slowly or self._opening is not None:
            self._close_bus()
        elif not await SlowCall(f"bus {self.name}, closing", self.bus.close).is_over(patience_s):
            log.warning("bus %s: its interface hangs while it is closed, and is left to itself", self.name)

    async def reopen(self) -> None:
        """Wait until a lost bus is back."""
        if now_ns() - self.opened_ns > self._reopening.longest_s * NS_PER_S:
            self._reopening.begin_again()  # it was there for a while, and not for a moment again and again
        while True:
            if self._opening is None:
                await asyncio.sleep(self._reopening.next_s())
            self._news.catch_up()
            try:
                await self._open_again()
            except Exception as error:  # noqa: BLE001  (what buses raise, they may also raise later)
                self._is_away(error if isinstance(error, ConfigurationError) else bus_failure(self.name, "open", error))
            else:
                return

    async def _open_again(self) -> None:
        was_there = self.opened_ns
        await self._open_bus()
        self._is_open()
        self._news.log(f"bus {self.name} is {'back' if was_there else 'there'}")

    def _is_away(self, error: Exception) -> None:
        if self._opening is not None:
            state, reason = BusState.CONNECTING, BusReason.FAILED
        elif isinstance(error, BusNotAvailable):
            state, reason = (BusState.DOWN if error.is_down else BusState.GONE), error.reason
        else:
            state, reason = BusState.GONE, BusReason.FAILED
        if self._become(state, reason):
            self._news.log(f"{error}; waiting for it to {'come back' if self.opened_ns else 'appear'}")

    @property
    def is_in_order(self) -> bool:
        """Whether it delivered frames, and had nothing wrong, when it was last looked at."""
        return self.state is BusState.LIVE and not self.reason

    @property
    def geometry(self) -> Geometry | None:
        """Where the sensors on it are: what the bus knows, or else its driver."""
        of_bus = self.bus.geometry
        return self.adapter.geometry if of_bus is None else of_bus

    @property
    def losses(self) -> tuple[int, ...]:
        """Changes whenever it is known that frames were lost: dropped, not received by the controller, or not heard."""
        counters = self.bus.counters
        return counters.lost, counters.overflows, counters.bus_offs, self.opened_ns

    def excuse(self, since_ns: int, silence_ns: int) -> None:
        """Count silence from now on, if frames came until this process was held up."""
        if since_ns - self.heard_ns <= max(NS_PER_S // 2, silence_ns):
            self.heard_ns = now_ns()

    def look(self, silence_ns: int) -> None:
        if self.bus.fileno() < 0 or self.lost.is_set():
            return
        time_ns = now_ns()
        self._news.catch_up()
        self.limits.look()
        before, reason = (self.state, self.reason), self.bus.reason(time_ns)
        if reason == BusReason.BUS_OFF:
            self._become(BusState.DOWN, reason)
        elif time_ns - self.heard_ns > max(NS_PER_S // 2, silence_ns):
            self._become(BusState.SILENT, reason or BusReason.NOTHING_HEARD)
        else:
            self._become(BusState.LIVE, reason)
        if before != (self.state, self.reason):
            self._tell(*before)
        self._has_spoken |= self.heard_ns > self._speaks_from_ns
        if self.state != BusState.LIVE or self.reason:
            self._check(time_ns)

    def _check(self, time_ns: int) -> None:
        """Ask a bus that is not in order whether it is still there, now and then."""
        if time_ns - self._checked_ns < _CHECK_PAUSE_NS or self.lost.is_set():
            return
        self._checked_ns = time_ns
        try:
            self.bus.check()
        except Exception as error:  # noqa: BLE001  (whatever it is: the bus cannot be trusted any more)
            self.lose(bus_failure(self.name, "check", error))

    def _become(self, state: BusState, reason: BusReason) -> bool:
        if (state, reason) == (self.state, self.reason):
            return False
        self.state, self.reason, self.since_ns = state, reason, now_ns()
        return True

    def _tell(self, state: BusState, reason: BusReason) -> None:
        if self.reason == BusReason.NOTHING_HEARD:
            if state == BusState.LIVE and self._has_spoken:
                self._news.log(f"bus {self.name}: {WORDS[self.reason]}")
        elif self.reason:
            if self.reason != reason:
                self._news.log(f"bus {self.name}: {WORDS[self.reason]}")
        elif reason == BusReason.NOTHING_HEARD:
            if self._has_spoken:
                self._news.log(f"bus {self.name}: frames come again")
        elif reason:
            self._news.log(f"bus {self.name}: in order again (was {reason_text(reason)})")

    async def describe(self, described: Callable[[], Awaitable[None]]) -> None:
        """Ask what is attached to it, for as long as it takes.

        Args:
            described: called after every answer, also after an empty one.
        """
        told, attempts = False, _attempts()
        while True:
            await asyncio.sleep(attempts.next_s())
            if self.lost.is_set():
                await self.reopen()
            found: Sequence[Patch] = ()
            try:
                with hook("describe", self.name):
                    found = are_patches(await self.adapter.describe(self.link))
                why = "no patch is heard, and nobody may be asked" if self.bus.listen_only else "no patch answers"
            except BusError as error:
                why = str(error)
                self._check(now_ns())
            self.patches = found or self.patches or ()  # what was known of a bus that was set aside stays
            await described()
            if found:
                return
            if not told:
                log.warning("%s: %s; waiting for one to appear", self.name, why)
                told = True

    async def set_up(self) -> None:
        """Set its devices up and make them send, for as long as it takes."""
        attempts = _attempts()
        while True:
            await asyncio.sleep(attempts.next_s())
            if self.lost.is_set():
                await self.reopen()
            self.started = True  # devices may begin to send at any moment of it
            try:
                async with self.busy:
                    with hook("configure", self.name):
                        await self.adapter.configure(self.link)
                    with hook("start", self.name):
                        await self.adapter.start(self.link)
            except BusError as error:
                self._news.log(f"{self.name}: set-up failed: {error}; trying again")
                self._check(now_ns())
            else:
                self.set_up_ns = self._speaks_from_ns = now_ns()
                return

    def begin_lost(self, error: BusNotAvailable | None = None) -> None:
        """Wait for a bus that nobody has opened yet as for one that was lost; nothing is attached to it so far.

        Args:
            error: why it could not be opened; None: nobody has tried.
        """
        self.patches = ()
        self.lost.set()
        self.needs_care.set()
        if error is not None:
            self._is_away(error)

    def remove(self) -> None:
        self._let_go()
        self.patches = ()
        self._become(BusState.GONE, BusReason.REMOVED)

    async def set_aside(self, error: Exception) -> None:
        """Stop its devices and close it, because the driver's own code failed on it; ``reopen`` opens it again."""
        self.is_aside = True
        with contextlib.suppress(DriverError):  # which failed already
            await self.stop()
        self._let_go()
        self.patches = self.patches or ()
        self._become(BusState.DOWN, BusReason.SET_ASIDE)
        self._news.log(f"{error}; bus {self.name} is set aside, and tried again later")

    async def stop(self) -> None:
        """Make its devices silent, if they may have been told to send and it can be done now.

        Raises:
            DriverError: the driver's own code failed.
        """
        if not self.started or self._opening is not None or self.bus.fileno() < 0:
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
    """Open what is there, all at once: one that takes its time holds up no other. Those that are not are waited for.

    Args:
        lines: all buses of a driver.
        wait_for_one: also if not one is there.

    Raises:
        BusNotAvailable: not one is there, or this user may not open one.
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
    """What ``describe`` or ``join`` of an adapter returned.

    Raises:
        TypeError: these are no patches.
    """
    patches = []
    for patch in found:
        if not isinstance(patch, Patch):
            raise TypeError(f"it returned {patch!r} among its patches; a sequence of Patch is needed")
        patches.append(patch)
    return patches


def _attempts() -> Backoff:
    return Backoff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S, at_once=True)
