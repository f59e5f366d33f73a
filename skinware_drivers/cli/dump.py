"""``skin-dump``: print snapshots of drivers (``skinware.cli.dump``), or with ``--raw`` the frames of a CAN bus."""

from __future__ import annotations

import select
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from skinware.cli._command import CONTEXT_SETTINGS, examples, run, warn
from skinware.cli._terminal import echo, print_json
from skinware.cli.dump import command as frames_command
from skinware_drivers.bus_names import NETWORKS

if TYPE_CHECKING:
    from skinware_drivers.bus import Bus, FrameBatch

_CAN_PAYLOAD = 64
_SERIAL = ("serial", "pty", *NETWORKS)
_SHARED = ("socketcan", "udp_multicast", "virtual")
"""Interfaces on which two programs can listen."""
_OF_DRIVERS = {"name": "NAME", "type_name": "--type", "rate_hz": "--rate", "counts": "--counts"}


def dump(raw: str | None, **options: Any) -> None:
    if raw is None:
        click.get_current_context().invoke(frames_command, **options)
        return
    for option, flag in _OF_DRIVERS.items():
        if options[option]:
            raise click.UsageError(f"{flag} is about the frames of a driver, --raw about those of a bus")
    dump_bus(raw, options["count"], options["timeout_s"], options["as_json"])


def dump_bus(bus_name: str, count: int | None, timeout_s: float | None, as_json: bool) -> None:
    """Print the frames of a CAN bus as they come; nothing is sent.

    Raises:
        ConfigurationError: not a CAN bus, or a driver has it and no other program can listen.
        BusNotAvailable: the bus cannot be opened, or went away.
        BusError: no frame came for ``timeout_s``.
    """
    from skinware.realtime import now_ns
    from skinware.wire import channel_name
    from skinware_drivers.bus_names import parse_bus_name
    from skinware_drivers.can.candump import text_frames
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
            frames = list(text_frames(batch, offset_ns))[:left]
            for frame in frames if as_json else ():
                print_json(
                    {
                        "bus": name,
                        "time": frame.time_us / 1e6,
                        "identifier": frame.identifier,
                        "extended": frame.extended,
                        "fd": frame.fd is not None,
                        "data": frame.payload.hex().upper(),
                    }
                )
            if not as_json and frames:
                echo("\n".join(frame.line(name) for frame in frames))
            if left is not None:
                left -= len(frames)
                if not left:
                    return
    finally:
        bus.close()
        _warn_of_missing(bus)


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
        warn(text)


command: click.Command = click.Command(
    "skin-dump",
    context_settings=CONTEXT_SETTINGS,
    callback=dump,
    params=[
        *frames_command.params,
        click.Option(
            ["--raw"], metavar="BUS", help="Print the frames of a CAN bus instead, as candump -L; sends nothing."
        ),
    ],
    help=frames_command.help,
    epilog=examples(
        "skin-dump -n 3                              three frames",
        "skin-dump -T 2 --type pressure              fail when nothing comes for 2 s",
        "skin-dump --json --rate 10 > frames.jsonl   at most ten frames a second",
        "skin-dump --raw can0 -n 1000 > can.log      for canplayer -I can.log",
    ),
)


def main() -> None:
    run(command)
