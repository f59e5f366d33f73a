"""Decide what a failure costs, by one rule.

* An ``Expand`` function fails: the frame is lost, and counted as bad content (``decoding.compiled``).
* A device fails (``BusError`` or ``OSError`` in a hook): the attempt is repeated, for its patch or its bus.
* A bus fails, whatever its methods raise: it is closed, and opened again (``BusLine.lose``).
* The driver's own code fails in a hook of one bus: that bus is set aside while another one is served (``Serving``).
* Anything else ends the driver (:class:`Ending`).
"""

from __future__ import annotations

import asyncio
import logging
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from skinware.errors import BusError, ConfigurationError, DriverError, SkinwareError
from skinware.realtime import NS_PER_S, now_ns

log: logging.Logger = logging.getLogger("skinware.driver")


@contextmanager
def hook(name: str, *buses: str, of_all: bool = False) -> Iterator[None]:
    """Call a hook of an adapter or of its watch.

    Args:
        of_all: it concerns all buses of the driver, also if it is called for one.

    Raises:
        BusError: as the hook raised it, or for an ``OSError``.
        ConfigurationError: as the hook raised it.
        DriverError: for anything else; ``bus`` is set if it concerns no other bus.
    """
    where = f"bus{'es' if len(buses) > 1 else ''} {', '.join(buses)}"
    try:
        yield
    except (BusError, ConfigurationError):
        raise
    except OSError as error:
        raise BusError(f"{where}: `{name}` failed: {cause(error)}") from error
    except (asyncio.CancelledError, Exception, SystemExit) as error:
        if isinstance(error, asyncio.CancelledError):
            task = asyncio.current_task()
            if task is None or task.cancelling():
                raise  # somebody else asked for it
        log.info("%s: `%s` failed", where, name, exc_info=error)
        only = "" if of_all else buses[0]
        raise DriverError(f"{where}: `{name}` failed: {cause(error)}", bus=only) from error


def cause(error: BaseException) -> str:
    """Return an error with the place where it was raised: ``KeyError: 'oops' (my.py, line 38)``."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return "".join(traceback.format_exception_only(error)).strip().replace("\n", " ") + where


class Ending:
    """Whether a driver is to end, and with which error.

    Attributes:
        error: the first error that ends it; None: there is none.
        has_come: set when it is to end.
    """

    def __init__(self) -> None:
        self.error: BaseException | None = None
        self.has_come = asyncio.Event()

    def fail(self, error: BaseException) -> None:
        """End the driver with an error; only the first one counts."""
        if self.error is None:
            self.error = error
            if not isinstance(error, (SkinwareError, BrokenPipeError)):  # the latter: nothing reads the output any more
                log.info("the driver failed", exc_info=error)
                self.error = DriverError(f"the driver failed: {cause(error)}")
                self.error.__cause__ = error
        self.has_come.set()

    def guard(self, callback: Callable[[], object]) -> Callable[[], None]:
        """Return a callback of the event loop that ends the driver if it fails, and does nothing afterwards."""

        def call() -> None:
            if self.error is not None:
                return
            try:
                callback()
            except (Exception, SystemExit) as error:  # noqa: BLE001  (the event loop would log it and go on)
                self.fail(error)

        return call

    def watch(self, task: asyncio.Task[Any]) -> None:
        """End the driver if this task fails; a callback for ``add_done_callback``."""
        error = None if task.cancelled() else task.exception()
        if error is not None:
            self.fail(error)

    def handle(self, _loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """End the driver with what failed outside of every guard; an exception handler for the event loop."""
        error = context.get("exception")
        if error is None:
            log.warning("%s", context["message"])
        else:
            self.fail(error)


class Backoff:
    """Pauses between attempts, each twice as long as the one before.

    Args:
        free: the first so many attempts need no pause.

    Attributes:
        begun: number of attempts since :meth:`begin_again`, where :meth:`begin` counts them.
        not_before_ns: when the next one is due, CLOCK_MONOTONIC ns.
    """

    def __init__(self, first_s: float, longest_s: float, *, free: int = 0) -> None:
        self._first_s, self._longest_s, self._free = first_s, longest_s, free
        self.begin_again()

    def begin_again(self) -> None:
        self._next_s, self._left = self._first_s, self._free
        self.begun = self.not_before_ns = 0

    def begin_again_after(self, passed_ns: int) -> None:
        """Begin again if it went well for a while, not only for moments again and again."""
        if passed_ns > self._longest_s * NS_PER_S:
            self.begin_again()

    def next_s(self) -> float:
        if self._left:
            self._left -= 1
            return 0.0
        pause_s, self._next_s = self._next_s, min(2 * self._next_s, self._longest_s)
        return pause_s

    @property
    def is_due(self) -> bool:
        return now_ns() >= self.not_before_ns

    def begin(self, time_ns: int | None = None) -> None:
        """Count an attempt, after which a pause begins: now, or at the time of a caller that reads no clock."""
        self.begun += 1
        self.not_before_ns = (now_ns() if time_ns is None else time_ns) + round(self.next_s() * NS_PER_S)


def pauses_of_device() -> Backoff:
    """Return the pauses of a device that is asked: from its third failure in a row on, it is asked less often."""
    return Backoff(0.25, 2.0, free=2)
