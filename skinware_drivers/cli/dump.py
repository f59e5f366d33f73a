"""``skin-dump``: print the snapshots of a driver, or with ``--raw`` the frames of a CAN bus."""

from __future__ import annotations

import contextlib
import math
import select
import time
from collections.abc import Iterator
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json
from skinware_drivers.bus_names import NETWORKS

if TYPE_CHECKING:
    from skinware._columns import Index
    from skinware.driver_service import DriverReader
    from skinware.driver_snapshot import DriverSnapshot
    from skinware.memory.namespace import Namespace
    from skinware_drivers.bus import Bus, FrameBatch

_LOOK_EVERY_S = 0.1
_SILENCE_S = 1.0
"""A driver that publishes nothing for so long, or for three periods, is silent."""
_CALMED = ("uncertainty", "why")
"""Columns of drivers that skin-calm publishes."""
_CAN_PAYLOAD, _CLASSIC_PAYLOAD = 64, 8
_FD_FLAGS = 0x03
_SERIAL = ("serial", "pty", *NETWORKS)
_SHARED = ("socketcan", "udp_multicast", "virtual")
"""Interfaces on which two programs can listen."""


@cli.command(
    "skin-dump",
    "skin-dump -n 3                              three snapshots",
    "skin-dump --timeout 2 --type pressure       fail when nothing comes for 2 s",
    "skin-dump --json --rate 10 > frames.jsonl   at most ten snapshots a second",
    "skin-dump --raw can0 -n 1000 > can.log      for canplayer -I can.log",
)
@click.argument("name", required=False)
@click.option(
    "-n", "count", type=click.IntRange(min=1), metavar="COUNT", help="End after COUNT snapshots, or frames of --raw."
)
@click.option(
    "--timeout",
    "timeout_s",
    metavar="SECONDS",
    type=cli.seconds,
    help="Fail after SECONDS without one; also wait for the driver.",
)
@cli.type_option("Only the sensors of one type, such as pressure.")
@click.option(
    "--rate", "rate_hz", type=float, metavar="HZ", help="Only the newest snapshot, at most HZ times a second."
)
@click.option("--counts", is_flag=True, help="Raw counts, as the hardware sends them, instead of physical values.")
@cli.namespace_option
@cli.json_option
@click.option("--raw", metavar="BUS", help="Print the frames of a CAN bus instead, as candump -L; sends nothing.")
def command(
    name: str | None,
    count: int | None,
    timeout_s: float | None,
    type_name: str | None,
    rate_hz: float | None,
    counts: bool,
    namespace: str | None,
    as_json: bool,
    raw: str | None,
) -> None:
    """Print the snapshots of driver NAME, or of the only one, each once and in order.

    Values are physical, in the unit of their type, as skin-top shows them.

    A line of text has the minimum, maximum and mean of the fresh sensors of each type. JSON has everything.
    """
    from skinware.cli._terminal import terminal_width
    from skinware.errors import ConfigurationError, StructureError
    from skinware.memory.namespace import Namespace
    from skinware.text import wrapped

    if raw is not None:
        cli.refuse_others("--raw", {"count", "timeout_s", "as_json"})
        dump_bus(raw, count, timeout_s, as_json)
        return
    with _attach(Namespace(namespace), name, timeout_s) as reader:
        try:
            if type_name is not None:
                reader.structure.type(type_name)
        except StructureError as error:
            raise ConfigurationError(str(error)) from None
        for frame in islice(_frames(reader, rate_hz, timeout_s), count):
            if as_json:
                print_json(as_data(reader, frame, type_name, counts))
            else:
                missed = f"  missed {reader.missed}" if reader.missed and rate_hz is None else ""
                line = f"{reader.name} {as_line(frame, type_name, counts)}{missed}"
                echo("\n".join(wrapped(line, terminal_width())))


def as_data(reader: DriverReader, frame: DriverSnapshot, type_name: str | None, counts: bool) -> dict[str, Any]:
    """Return a snapshot for JSON; with ``type_name`` only those sensors, with their uids."""
    index: Index = slice(None) if type_name is None else frame.structure.index(type_name)
    values = (frame.values if counts else frame.physical_values())[index]
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

    parts = [f"#{frame.sequence}", f"age {age_text(frame.age_ns)}"]
    all_values = frame.values if counts else frame.physical_values()
    not_fresh = 0
    for sensor_type in frame.structure.types:
        if type_name in (None, sensor_type.name):
            index = frame.structure.index(sensor_type.name)
            fresh = frame.fresh(sensor_type.name)
            not_fresh += int(np.count_nonzero(~fresh))
            values = all_values[index][fresh]
            figures, mean = NO_VALUE, ""
            if len(values):
                least, most, middle = (figure_text(float(of(values)), 5) for of in (np.min, np.max, np.mean))
                figures, mean = f"{least} to {most}", f" (mean {middle})"
            parts.append(f"{sensor_type.name} {figures} {'raw' if counts else sensor_type.unit}{mean}")
    return "  ".join([*parts, f"{not_fresh} not fresh"])


def _attach(namespace: Namespace, name: str | None, timeout_s: float | None) -> DriverReader:
    from skinware.driver_service import DriverReader

    end_s = time.monotonic() + (timeout_s or 0.0)
    if name is None:
        name = _only_driver(namespace, end_s)
    reader = DriverReader(name, namespace=namespace, timeout_s=max(0.0, end_s - time.monotonic()))
    if not reader.alive:
        cli.warn(f"driver {name!r} is dead; this is its last snapshot. Waiting for it to come back")
    return reader


def _only_driver(namespace: Namespace, end_s: float) -> str:
    """Return the only living driver, or else the only dead one."""
    from skinware.errors import ConfigurationError, ServiceNotFound
    from skinware.views.live import LiveDrivers

    with contextlib.closing(LiveDrivers(namespace)) as drivers:
        while True:
            found = drivers.look()
            candidates = [driver.name for driver in found if driver.reader.alive] or [driver.name for driver in found]
            if len(candidates) == 1:
                return candidates[0]
            if candidates:
                raise ConfigurationError(
                    f"which driver? Namespace {namespace.name!r} has: {', '.join(candidates)}; give one as NAME"
                )
            if time.monotonic() >= end_s:
                raise ServiceNotFound(
                    f"no driver in namespace {namespace.name!r}; start one: skin-driver --bus virtual"
                    " (--timeout waits for one)"
                )
            time.sleep(_LOOK_EVERY_S)


def _frames(reader: DriverReader, rate_hz: float | None, timeout_s: float | None) -> Iterator[DriverSnapshot]:
    """Yield snapshots without end, also after silences and restarts of the driver, which are reported on stderr."""
    from skinware.errors import ServiceTimeout, StructureChanged
    from skinware.realtime import Periodic
    from skinware.text import plural

    generation, is_silent = reader.generation, not reader.alive  # which was reported
    timer = None if rate_hz is None else Periodic(rate_hz)
    silence_s = max(_SILENCE_S, 3 / (reader.rate_hz() or math.inf))
    while True:
        warns = not is_silent and (timeout_s is None or timeout_s > silence_s)
        frames = (reader.in_order if timer is None else reader.samples)(timeout_s=silence_s if warns else timeout_s)
        try:
            for frame in frames:
                if frame.generation != generation:
                    generation = frame.generation
                    cli.warn(f"driver {reader.name!r} was started again")
                yield frame
                if timer is not None:
                    timer.wait()
                if is_silent:
                    is_silent = False
                    break
        except ServiceTimeout as silence:
            if not warns:
                raise
            cli.warn(str(silence))
            is_silent = True
        except StructureChanged:
            _reattach(reader, timeout_s)
            generation = reader.generation
            sensors = plural(reader.structure.n_sensors, "sensor")
            cli.warn(f"driver {reader.name!r} came back with another structure: {sensors} now")


def _reattach(reader: DriverReader, timeout_s: float | None) -> None:
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


def dump_bus(bus_name: str, count: int | None, timeout_s: float | None, as_json: bool) -> None:
    from skinware.errors import ConfigurationError
    from skinware.realtime import now_ns
    from skinware.wire import EXTENDED, MASK, candump_line, channel_name
    from skinware_drivers.bus_names import parse_bus_name
    from skinware_drivers.finding.running import driver_on, running_drivers
    from skinware_drivers.registry import make_bus

    interface, channel, _ = parse_bus_name(bus_name)
    if interface in _SERIAL:
        raise ConfigurationError(
            f"{bus_name}: a serial line has one owner, so no other program can listen; to see the data of its driver:"
            " skin-dump NAME"
        )
    owner = None if interface in _SHARED else driver_on(bus_name, running_drivers())
    if owner is not None:
        raise ConfigurationError(
            f"{bus_name}: {owner} uses it, and no other program can listen; use skin-dump {owner.name}"
        )
    name = channel_name(interface, channel)
    bus = make_bus(bus_name, payload_size=_CAN_PAYLOAD, listen_only=True)
    left = count
    bus.open()
    try:
        for batch in _batches(bus, bus_name, timeout_s):
            offset_ns = time.time_ns() - now_ns()
            frames = list(frames_of(batch, offset_ns))[:left]
            for time_us, identifier, fd_flags, payload in frames if as_json else ():
                print_json(
                    {
                        "bus": name,
                        "time": time_us / 1e6,
                        "identifier": identifier & MASK,
                        "extended": bool(identifier & EXTENDED),
                        "fd": fd_flags is not None,
                        "data": payload.hex().upper(),
                    }
                )
            if not as_json and frames:
                lines = (candump_line(at_us, name, who, flags, data) for at_us, who, flags, data in frames)
                echo("\n".join(lines))
            if left is not None:
                left -= len(frames)
                if not left:
                    return
    finally:
        bus.close()
        _warn_of_missing(bus)


def frames_of(batch: FrameBatch, epoch_offset_ns: int) -> Iterator[tuple[int, int, int | None, bytes]]:
    """Yield time (us since 1970), identifier, flags of CAN FD (None: a classic frame) and payload of frames."""
    from skinware.wire import IS_FD

    rows = slice(batch.start, batch.stop)
    wire, times_ns = batch.wire[rows], batch.time_ns[rows].tolist()
    columns = (wire[name].tolist() for name in ("identifier", "length", "flags"))
    for time_ns, identifier, length, flags, payload in zip(times_ns, *columns, wire["payload"], strict=True):
        fd_flags = flags & _FD_FLAGS if length > _CLASSIC_PAYLOAD or flags & IS_FD else None
        yield (time_ns + epoch_offset_ns) // 1000, identifier, fd_flags, payload[:length].tobytes()


def _batches(bus: Bus, bus_name: str, timeout_s: float | None) -> Iterator[FrameBatch]:
    from skinware.errors import BusError
    from skinware_drivers.bus import FrameBatch

    batch = FrameBatch.for_buses(1, bus.payload_size)
    poll = select.poll()
    poll.register(bus.fileno(), select.POLLIN)
    end_s = None if timeout_s is None else time.monotonic() + timeout_s
    while True:
        poll.poll(None if end_s is None else max(0.0, end_s - time.monotonic()) * 1000)
        batch.clear()
        if bus.receive(batch, 0):
            yield batch
            end_s = None if timeout_s is None else time.monotonic() + timeout_s
        elif end_s is not None and time.monotonic() >= end_s:
            raise BusError(f"{bus_name}: no frame for {timeout_s:g} s")


def _warn_of_missing(bus: Bus) -> None:
    counters = bus.counters
    missing = {
        "dropped": counters.dropped,
        "error frames, not shown": counters.errors,
        "remote frames, not shown": counters.refused,
    }
    text = ", ".join(f"{count} {what}" for what, count in missing.items() if count)
    if text:
        cli.warn(text)


main = partial(cli.run, command)
