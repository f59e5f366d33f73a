"""``skin-emulate``: emulate skin patches on a bus that other programs use.

It takes the emulator's options beside a few of its own; ``skinware_drivers.virtual.emulation`` does the work.
"""

from __future__ import annotations

import contextlib
import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TextIO

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import json_text, shown
from skinware.errors import ConfigurationError
from skinware_drivers.cli.hardware_options import HardwareCommand, hardware_values

if TYPE_CHECKING:
    from collections.abc import Mapping

    import msgspec

    from skinware_drivers.virtual.emulation import Report
    from skinware_drivers.virtual.hardware import EmulatedHardware, PlacedHardware

_DEFAULT_DRIVER = "roboskin"
_LONGEST_COMMAND = {"can": 8, "serial": 4096, "modbus": 4096}


def _options_of(given: Mapping[str, Any]) -> tuple[str, type[msgspec.Struct]]:
    from skinware_drivers.loading import short_name
    from skinware_drivers.virtual.hardware import load_emulator

    driver = given.get("driver") or _DEFAULT_DRIVER
    return f"emulated {short_name(driver)}", load_emulator(driver).Options


@cli.command(
    "skin-emulate",
    "skin-emulate --bus vcan0 --boards 7,8                  ROBOSKIN boards",
    "skin-emulate --bus vcan0 --lose 0.01 --restart 7       with faults",
    "skin-emulate --driver openpatch --bus pty:/tmp/skin    on a serial line",
    "skin-emulate --driver skintalk --bus tcp://:5000       as a TCP server",
    "skin-emulate --driver xela --help                      options of another",
    cls=HardwareCommand,
    options_of=_options_of,
)
@click.option("--bus", "bus_name", metavar="BUS", required=True, help="Bus to use: vcan0, pty:/tmp/skin ...")
@click.option(
    "--driver",
    metavar="DRIVER",
    default=_DEFAULT_DRIVER,
    help="Driver whose devices are emulated, or a file with an emulator.",
)
@click.option("--log", "log_path", metavar="FILE", help="Write every injected fault to FILE, as JSON lines.")
@click.option(
    "--geometry",
    "geometry_path",
    metavar="FILE",
    type=cli.FILE,
    help="Write the places of the emulated sensors to FILE, for skin-driver --geometry FILE.",
)
@click.option(
    "--name", metavar="NAME", help="Publish a service by which programs press the skin (skin-press).  [default: none]"
)
@cli.namespace_option
@click.option("--json", "as_json", is_flag=True, help="Print the state every second, as JSON lines.")
@cli.duration_option()
def command(
    bus_name: str,
    driver: str,
    log_path: str | None,
    geometry_path: Path | None,
    name: str | None,
    namespace: str | None,
    as_json: bool,
    duration_s: float | None,
    **hardware_options: str | None,
) -> None:
    """Emulate skin patches on a bus, with faults on request, until interrupted.

    Exit status: 0 done or interrupted, 1 failed, 2 wrong usage or configuration.
    """
    from skinware.geometry import geometry_to_toml
    from skinware.memory.namespace import Namespace
    from skinware_drivers.bus import kind_of_bus
    from skinware_drivers.bus_names import parse_bus_name
    from skinware_drivers.loading import short_name
    from skinware_drivers.options import options_from_strings
    from skinware_drivers.registry import load_driver, make_bus
    from skinware_drivers.virtual.emulation import Emulation, PressingService
    from skinware_drivers.virtual.hardware import JsonLinesLog, load_emulator, medium_of

    if parse_bus_name(bus_name).interface == "virtual":
        raise ConfigurationError(
            f"--bus {bus_name}: no other program can open it; give vcan0 or pty:./port,"
            " or do without: skin-driver --bus virtual"
        )
    emulator = load_emulator(driver)
    options = options_from_strings(emulator.Options, hardware_values(hardware_options))
    medium = medium_of(emulator)
    longest = getattr(emulator, "payload_size", _LONGEST_COMMAND[medium])
    bus = make_bus(bus_name, payload_size=longest, for_devices=True)
    if not bus.fits("serial" if medium == "modbus" else medium):  # the bytes of both are the same
        such_as = "vcan0 or can0" if medium == "can" else "pty:./port, a port that is there, or tcp://127.0.0.1:5000"
        raise ConfigurationError(
            f"--bus {bus_name}: devices of {short_name(driver)} are attached to {kind_of_bus(medium)}; give {such_as}"
        )
    if hasattr(bus, "topics"):
        bus.topics = getattr(load_driver(driver), "topics", ())
    with contextlib.ExitStack() as open_things:
        log = open_things.enter_context(contextlib.closing(JsonLinesLog(log_path))) if log_path else None
        hardware = emulator(options, log=log)
        if geometry_path is not None:
            groups = _placed(hardware, "--geometry").geometry().to_groups()
            geometry_path.write_text(geometry_to_toml(groups, f"the sensors of an emulated {short_name(driver)}"))
        pressing = None
        if name is not None:
            service = PressingService(name, _placed(hardware, "--name"), bus_name, Namespace(namespace))
            pressing = open_things.enter_context(contextlib.closing(service))
        emulation = Emulation(bus, hardware, report_to(sys.stdout, as_json=as_json), pressing=pressing)
        signals = open_things.enter_context(SignalWatch())
        emulation.run(signals, bus_name=bus_name, driver=short_name(driver), options=options, duration_s=duration_s)


def report_to(stream: TextIO, *, as_json: bool) -> Report:
    """Return a function that prints events: all of them for programs, without ``status`` for people."""

    def report(name: str, **facts: Any) -> None:
        if as_json or name != "status":
            stream.write((json_text({"event": name, **facts}) if as_json else shown(_in_words(name, facts))) + "\n")
            stream.flush()

    return report


def _in_words(name: str, facts: Mapping[str, Any]) -> str:
    if name == "ready":
        note = f" ({facts['note']})" if facts.get("note") else ""
        return f"emulating {facts['driver']} on {facts['bus']}{note}; Ctrl-C stops"
    if name == "stopped":
        return "stopped: " + ", ".join(f"{key} {value}" for key, value in facts.items())
    return f"{name.replace('_', ' ')}: {facts.get('reason', '')}".rstrip(": ")


class SignalWatch:
    """Turn SIGINT and SIGTERM into a readable descriptor, so that no wait needs to be interrupted."""

    def __init__(self) -> None:
        self.stopped: bool = False
        self._bell = os.eventfd(0, os.EFD_CLOEXEC)
        self._handlers = cli.signals_end(self._stop)

    def __enter__(self) -> Self:
        self._handlers.__enter__()
        return self

    def __exit__(self, *raised: object) -> None:
        self._handlers.__exit__(None, None, None)
        os.close(self._bell)

    def fileno(self) -> int:
        return self._bell

    def _stop(self) -> None:
        self.stopped = True
        os.eventfd_write(self._bell, 1)


def _placed(hardware: EmulatedHardware, option: str) -> PlacedHardware:
    from skinware_drivers.virtual.hardware import PlacedHardware

    if not isinstance(hardware, PlacedHardware):
        raise ConfigurationError(f"{option}: these emulated devices have no places")
    return hardware


main = partial(cli.run, command, goes_on=True)
