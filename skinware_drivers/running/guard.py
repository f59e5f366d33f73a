"""What happens when a driver's own code fails: one policy for all hooks of an adapter.

A hook is called under ``hook``. A ``BusError`` comes out of it as it is, an ``OSError`` (of a device's library, say)
becomes one, with the names of the bus and the hook: something is wrong with a device, and it is asked again later.
Anything else is a fault in the driver's code and becomes a ``DriverError``: its bus is set aside and tried again later
while others are served, else the driver ends.
"""

from __future__ import annotations

import asyncio
import logging
import traceback
from collections.abc import Iterator
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
