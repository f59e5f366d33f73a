"""Read the driver of a command, for as long as a person does something with the skin."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable, Iterator

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError, ServiceNotFound, ServiceTimeout
from skinware.memory.namespace import Namespace
from skinware.skin import Skin

_WAIT_S = 0.1
_SILENT_S = 5.0


def reader_of(namespace: Namespace, driver: str | None, how: str) -> DriverReader:
    """Return a reader of a driver, or of the only one that runs.

    Args:
        driver: its name; None: the only one.
        how: the way to choose one, for the message.

    Raises:
        ServiceNotFound: it does not run, or none does.
        ConfigurationError: several run.
    """
    if driver is None:
        with Skin(namespace) as skin:
            drivers = skin.refresh().drivers
        if not drivers:
            raise ServiceNotFound(f"no driver runs in namespace {namespace.name!r}")
        if len(drivers) > 1:
            raise ConfigurationError(f"several drivers run: choose one with {how}: {', '.join(drivers)}")
        driver = drivers[0]
    return DriverReader(driver, namespace=namespace)


def frames_until(reader: DriverReader, is_over: Callable[[], bool]) -> Iterator[DriverSnapshot]:
    """Yield the driver's newest snapshots, each once.

    Args:
        is_over: called before each snapshot, and ten times a second while none arrives; True ends it.

    Raises:
        ServiceTimeout: no snapshot arrived for 5 s.
        StructureChanged: the driver has other sensors now.
    """
    newest: DriverSnapshot | None = None
    heard_s = time.monotonic()
    while not is_over():
        try:
            newest = reader.read(newer_than=newest, timeout_s=_WAIT_S)
        except ServiceTimeout:
            if time.monotonic() - heard_s > _SILENT_S:
                raise
            continue
        heard_s = time.monotonic()
        yield newest


def after(seconds: float) -> Callable[[], bool]:
    """Return a function that returns whether this time has passed since now."""
    end_s = time.monotonic() + seconds
    return lambda: time.monotonic() >= end_s


def enter_pressed() -> bool:
    """Return whether Enter was pressed at the terminal, and read the line; False without a terminal."""
    if sys.stdin is None or not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0)[0]:
        return False
    sys.stdin.readline()
    return True
