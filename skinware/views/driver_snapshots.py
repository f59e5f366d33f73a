"""The driver that a command is about, and its frames for as long as somebody does something with the skin."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError, ServiceNotFound, ServiceTimeout
from skinware.memory.namespace import Namespace
from skinware.skin import Skin

_WAIT_S = 0.1
_SILENT_S = 5.0


def reader_of(namespace: Namespace, driver: str | None, how: str) -> DriverReader:
    """A reader of a driver, or of the only one that runs.

    Args:
        namespace: of the driver.
        driver: its name; None: the only one.
        how: how to choose one, for the message.

    Raises:
        ServiceNotFound: it does not run, or none does.
        ConfigurationError: several do.
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
    """The driver's newest frames, each once.

    Args:
        reader: of the driver.
        is_over: asked before each frame, and ten times a second where none comes.

    Raises:
        ServiceTimeout: no frame came for 5 s.
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


def physical_of(frame: DriverSnapshot, type_name: str) -> npt.NDArray[np.float32]:
    """(n_sensors,) float32: the physical values of the sensors of a type; 0 for those of other types."""
    physical = np.zeros(frame.structure.n_sensors, np.float32)
    physical[frame.structure.index(type_name)] = frame.physical(type_name)
    return physical


def after(seconds: float) -> Callable[[], bool]:
    """Whether so much time has passed since this call."""
    end_s = time.monotonic() + seconds
    return lambda: time.monotonic() >= end_s


def enter_pressed() -> bool:
    """Whether somebody has pressed Enter at the terminal; takes the line. Never without a terminal."""
    if sys.stdin is None or not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0)[0]:
        return False
    sys.stdin.readline()
    return True
