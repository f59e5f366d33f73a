"""Contain failures: of hooks of an adapter, of attempts that are repeated, and of libraries that do not return."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from skinware.errors import BusError, BusNotAvailable, ConfigurationError, DriverError, SkinwareError
from skinware.status import BusReason

log: logging.Logger = logging.getLogger("skinware.driver")


@contextmanager
def hook(name: str, bus: str) -> Iterator[None]:
    """Call a hook of an adapter.

    Args:
        name: of the hook.
        bus: name of the bus that it is called for.

    Raises:
        BusError: as the hook raised it, or for an ``OSError``.
        ConfigurationError: as the hook raised it.
        DriverError: for anything else.
    """
    try:
        yield
    except (BusError, ConfigurationError):
        raise
    except OSError as error:
        raise BusError(f"bus {bus}: `{name}` failed: {_cause(error)}") from error
    except asyncio.CancelledError as error:
        task = asyncio.current_task()
        if task is None or task.cancelling():
            raise
        raise failure(name, f"bus {bus}", error, only=bus) from error  # of its own making: nobody asked for it
    except (Exception, SystemExit) as error:
        raise failure(name, f"bus {bus}", error, only=bus) from error


def failure(name: str, where: str, error: BaseException, *, only: str = "") -> DriverError:
    """What to raise for a hook that failed.

    Args:
        name: of the hook.
        where: the bus or buses that it was called for, for people.
        error: what it raised.
        only: name of the bus that the failure concerns, if it concerns no other.
    """
    log.info("%s: `%s` failed", where, name, exc_info=error)
    return DriverError(f"{where}: `{name}` failed: {_cause(error)}", bus=only)


def end_of_driver(error: BaseException) -> BaseException:
    """What a driver ends with when an error came out of its event loop."""
    if isinstance(error, (SkinwareError, BrokenPipeError)):  # nobody reads the output any more
        return error
    log.info("the driver failed", exc_info=error)
    ended = DriverError(f"the driver failed: {_cause(error)}")
    ended.__cause__ = error
    return ended


def bus_failure(bus: str, method: str, error: Exception) -> BusNotAvailable:
    """A bus whose own code failed counts as lost, and is opened again."""
    if isinstance(error, BusNotAvailable):
        return error
    return BusNotAvailable(f"bus {bus}: `{method}` failed: {_cause(error)}", reason=BusReason.FAILED)


def _cause(error: BaseException) -> str:
    """``KeyError: 'oops' (my.py, line 38)``: the error, and where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return "".join(traceback.format_exception_only(error)).strip().replace("\n", " ") + where


class Backoff:
    """Longer and longer pauses.

    Args:
        first_s: the first one; the next is twice as long, and so on.
        longest_s: the longest.
        at_once: no pause at all comes first.
    """

    def __init__(self, first_s: float, longest_s: float, *, at_once: bool = False) -> None:
        self._first_s = first_s
        self._longest_s = longest_s
        self._begin_s = 0.0 if at_once else first_s
        self._next_s = self._begin_s

    @property
    def longest_s(self) -> float:
        """The longest pause. What went well for that long is over: see ``begin_again``."""
        return self._longest_s

    def next_s(self) -> float:
        pause_s, self._next_s = self._next_s, min(2 * self._next_s or self._first_s, self._longest_s)
        return pause_s

    def begin_again(self) -> None:
        self._next_s = self._begin_s


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
