"""``skin-dump``: print the snapshots of a driver, or with ``--raw`` the frames of a CAN bus."""

from __future__ import annotations

import select
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json
from skinware.cli.dump import print_snapshots
from skinware_drivers.bus_names import NETWORKS

if TYPE_CHECKING:
    from skinware_drivers.bus import Bus, FrameBatch

_CAN_PAYLOAD, _CLASSIC_PAYLOAD = 64, 8
_FD_FLAGS = 0x03
_SERIAL = ("serial", "pty", *NETWORKS)
_SHARED = ("socketcan", "udp_multicast", "virtual")
"""Interfaces on which two programs can listen."""


@cli.command(
    "skin-dump",
    "skin-dump -n 3                              three frames",
    "skin-dump -T 2 --type pressure              fail when nothing comes for 2 s",
    "skin-dump --json --rate 10 > frames.jsonl   at most ten frames a second",
    "skin-dump --raw can0 -n 1000 > can.log      for canplayer -I can.log",
)
@click.argument("name", required=False)
@click.option("-n", "count", type=click.IntRange(min=1), metavar="COUNT", help="End after COUNT frames.")
@cli.timeout_option("Fail after SECONDS without a frame; also wait for the driver.")
@cli.type_option("Only the sensors of one type, such as pressure.")
@click.option("--rate", "rate_hz", type=float, metavar="HZ", help="Only the newest frame, at most HZ times a second.")
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
    """Print the frames of driver NAME, or of the only one, each once and in order.

    Values are physical, in the unit of their type, as skin-top shows them.

    A line of text has the minimum, maximum and mean of the fresh sensors of each type. JSON has everything.
    """
    from skinware.memory.namespace import Namespace

    if raw is not None:
        cli.refuse_others("--raw", {"count", "timeout_s", "as_json"})
        dump_bus(raw, count, timeout_s, as_json)
        return
    print_snapshots(
        Namespace(namespace),
        name,
        count=count,
        timeout_s=timeout_s,
        type_name=type_name,
        rate_hz=rate_hz,
        counts=counts,
        as_json=as_json,
    )


def dump_bus(bus_name: str, count: int | None, timeout_s: float | None, as_json: bool) -> None:
    """Print the frames of a CAN bus as they come; nothing is sent.

    Raises:
        ConfigurationError: not a CAN bus, or a driver has it and no other program can listen.
        BusNotAvailable: the bus cannot be opened, or went away.
        BusError: no frame came for ``timeout_s``.
    """
    from skinware.realtime import now_ns
    from skinware.wire import EXTENDED, MASK, candump_line, channel_name
    from skinware_drivers.bus_names import parse_bus_name
    from skinware_drivers.registry import make_bus

    interface, channel, _ = parse_bus_name(bus_name)
    _refuse_owned(bus_name, interface)
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
    """Yield time (microseconds since 1970), identifier, flags of CAN FD (None: a classic frame) and payload of frames.

    Args:
        epoch_offset_ns: time since 1970 minus CLOCK_MONOTONIC, ns.
    """
    from skinware.wire import IS_FD

    rows = slice(batch.start, batch.stop)
    wire, times_ns = batch.wire[rows], batch.time_ns[rows].tolist()
    columns = (wire[name].tolist() for name in ("identifier", "length", "flags"))
    for time_ns, identifier, length, flags, payload in zip(times_ns, *columns, wire["payload"], strict=True):
        fd_flags = flags & _FD_FLAGS if length > _CLASSIC_PAYLOAD or flags & IS_FD else None
        yield (time_ns + epoch_offset_ns) // 1000, identifier, fd_flags, payload[:length].tobytes()


def _refuse_owned(bus_name: str, interface: str) -> None:
    from skinware.errors import ConfigurationError
    from skinware_drivers.finding.running import driver_on, running_drivers

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


def main() -> None:
    cli.run(command)
