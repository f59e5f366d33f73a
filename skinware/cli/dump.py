"""Print the snapshots of a driver, for ``skin-dump``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json

if TYPE_CHECKING:
    from skinware._columns import Index
    from skinware.driver_service import DriverReader
    from skinware.driver_snapshot import DriverSnapshot
    from skinware.memory.namespace import Namespace
    from skinware.structure import Structure

_LOOK_EVERY_S = 0.1
_CALMED = ("uncertainty", "why")
"""Columns of drivers that skin-calm publishes."""


def print_snapshots(
    namespace: Namespace,
    name: str | None,
    *,
    count: int | None = None,
    timeout_s: float | None = None,
    type_name: str | None = None,
    rate_hz: float | None = None,
    counts: bool = False,
    as_json: bool = False,
) -> None:
    """Print the snapshots of a driver, or of the only one; the arguments are the options of ``skin-dump``."""
    from skinware.cli._terminal import terminal_width
    from skinware.text import wrapped

    taken = 0
    with _attach(namespace, name, timeout_s) as reader:
        _check_type(reader.structure, type_name)
        for frame in _frames(reader, rate_hz, timeout_s):
            if as_json:
                print_json(as_data(reader, frame, type_name, counts))
            else:
                missed = f"  missed {reader.missed}" if reader.missed and rate_hz is None else ""
                line = f"{reader.name} {as_line(frame, type_name, counts)}{missed}"
                echo("\n".join(wrapped(line, terminal_width())))
            taken += 1
            if taken == count:
                return


def as_data(reader: DriverReader, frame: DriverSnapshot, type_name: str | None, counts: bool) -> dict[str, Any]:
    """Return a snapshot for JSON; with ``type_name`` only those sensors, with their uids."""
    from skinware.views.quantities import physical_values

    index: Index = slice(None) if type_name is None else frame.structure.index(type_name)
    values = (frame.values if counts else physical_values(frame))[index]
    data = {
        "driver": reader.name,
        "sequence": frame.sequence,
        "acquired_ns": frame.acquired_ns,
        "age_ms": round(frame.age_ns / 1e6, 3),
        "missed": reader.missed,
        "values": values.tolist(),
        "status": frame.status[index].tolist(),
    }
    data |= {name: frame.column(name)[index].tolist() for name in _CALMED if name in reader.schema.columns}
    if type_name is not None:
        data["uids"] = frame.structure.sensor_uid[index].tolist()
    return data


def as_line(frame: DriverSnapshot, type_name: str | None, counts: bool) -> str:
    """Return a snapshot for people: least, greatest and mean value of the fresh sensors of each type."""
    import numpy as np

    from skinware.text import NO_VALUE, age_text, figure_text
    from skinware.views.quantities import physical_values

    parts = [f"#{frame.sequence}", f"age {age_text(frame.age_ns)}"]
    all_values = frame.values if counts else physical_values(frame)
    not_fresh = 0
    for sensor_type in frame.structure.types:
        if type_name in (None, sensor_type.name):
            index = frame.structure.index(sensor_type.name)
            fresh = frame.status[index] == 0
            not_fresh += int(np.count_nonzero(~fresh))
            values = all_values[index][fresh]
            figures, mean = NO_VALUE, ""
            if len(values):
                figures, mean = (
                    f"{figure_text(values.min(), 5)} to {figure_text(values.max(), 5)}",
                    f" (mean {figure_text(values.mean(), 5)})",
                )
            parts.append(f"{sensor_type.name} {figures} {'raw' if counts else sensor_type.unit}{mean}")
    return "  ".join([*parts, f"{not_fresh} not fresh"])


def _check_type(structure: Structure, type_name: str | None) -> None:
    from skinware.errors import ConfigurationError, StructureError

    try:
        if type_name is not None:
            structure.type(type_name)
    except StructureError as error:
        raise ConfigurationError(str(error)) from None


def _attach(namespace: Namespace, name: str | None, timeout_s: float | None) -> DriverReader:
    from skinware.driver_service import DriverReader

    end_s = time.monotonic() + (timeout_s or 0.0)
    if name is None:
        name = _only_driver(namespace, end_s)
    reader = DriverReader(name, namespace=namespace, timeout_s=max(0.0, end_s - time.monotonic()))
    if not reader.alive:
        cli.warn(f"driver {name!r} is dead; this is its last frame. Waiting for it to come back")
    return reader


def _only_driver(namespace: Namespace, end_s: float) -> str:
    """Return the only living driver, or else the only dead one.

    Raises:
        ConfigurationError: there are several.
        ServiceNotFound: there is none by ``end_s`` of CLOCK_MONOTONIC.
    """
    from skinware.errors import ConfigurationError, ServiceNotFound

    while True:
        living = _drivers(namespace)
        candidates = [name for name, alive in living.items() if alive] or list(living)
        if len(candidates) == 1:
            return candidates[0]
        if candidates:
            raise ConfigurationError(
                f"which driver? Namespace {namespace.name!r} has: {', '.join(candidates)}; give one as NAME"
            )
        if time.monotonic() >= end_s:
            raise ServiceNotFound(
                f"no driver in namespace {namespace.name!r}; start one: skin-driver --bus virtual (-T waits for one)"
            )
        time.sleep(_LOOK_EVERY_S)


def _drivers(namespace: Namespace) -> dict[str, bool]:
    from skinware.driver_service import KIND
    from skinware.errors import BadServiceFile, ConfigurationError, ServiceNotFound
    from skinware.memory.ring import Sample
    from skinware.service import ServiceReader

    found = {}
    for name in namespace.services():
        try:
            with ServiceReader[Sample](name, namespace=namespace, announce=False) as service:
                if service.kind == KIND:
                    found[name] = service.alive
        except (BadServiceFile, ConfigurationError, ServiceNotFound):
            continue  # it cannot be read, or was just withdrawn
    return found


def _frames(reader: DriverReader, rate_hz: float | None, timeout_s: float | None) -> Iterator[DriverSnapshot]:
    """Yield snapshots without end, also after restarts of the driver, which are reported on stderr."""
    from skinware.errors import StructureChanged
    from skinware.text import plural

    generation = reader.generation
    while True:
        try:
            frames = reader.in_order(timeout_s=timeout_s) if rate_hz is None else _sampled(reader, rate_hz, timeout_s)
            for frame in frames:
                if frame.generation != generation:
                    generation = frame.generation
                    cli.warn(f"driver {reader.name!r} was started again")
                yield frame
        except StructureChanged:
            _reattach(reader, timeout_s)
            generation = reader.generation
            sensors = plural(reader.structure.n_sensors, "sensor")
            cli.warn(f"driver {reader.name!r} came back with another structure: {sensors} now")


def _reattach(reader: DriverReader, timeout_s: float | None) -> None:
    """Read the driver's new structure, and wait for a driver that is gone again.

    Raises:
        ServiceNotFound: it was gone for ``timeout_s``.
    """
    from skinware.errors import ServiceNotFound

    end_s = None if timeout_s is None else time.monotonic() + timeout_s
    while True:
        try:
            reader.reattach()
            return
        except ServiceNotFound:
            if end_s is not None and time.monotonic() >= end_s:
                raise
        time.sleep(_LOOK_EVERY_S)


def _sampled(reader: DriverReader, rate_hz: float, timeout_s: float | None) -> Iterator[DriverSnapshot]:
    """Yield the newest snapshot at the deadlines of a rate, each once.

    Raises:
        StructureChanged: the driver came back with another structure.
        ServiceTimeout: no newer snapshot for ``timeout_s``.
    """
    from skinware.realtime import Periodic

    timer = Periodic(rate_hz)
    newest: DriverSnapshot | None = None
    while True:
        newest = reader.read(newer_than=newest, timeout_s=timeout_s)
        yield newest
        timer.wait()
