"""``skin-driver``: run a driver until it is interrupted."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json
from skinware.errors import ConfigurationError, DriverError, SkinwareError
from skinware.text import plural
from skinware_drivers.cli.hardware_options import HardwareCommand, hardware_values

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping

    import msgspec

    from skinware_drivers.running.news import PatchChange
    from skinware_drivers.running.runner import Runner

log: logging.Logger = logging.getLogger("skinware.driver")

UNIT_FILE = "skinware@.service"
_UNIT_PROGRAM = "/opt/skinware/bin/skin-driver"
"""Stands in that file for this program."""


def _options_of(given: Mapping[str, Any]) -> tuple[str, type[msgspec.Struct]]:
    from skinware_drivers.cli.capturing import driver_of_recording
    from skinware_drivers.cli.driver_setup import ConfigFile
    from skinware_drivers.loading import short_name
    from skinware_drivers.registry import DEFAULT_DRIVER, load_driver

    name = given.get("driver")
    if not name and given.get("config"):
        name = ConfigFile(Path(given["config"])).settings.driver
    if not name:
        with contextlib.suppress(SkinwareError):  # the bus raises it again when it is made
            name = driver_of_recording(given.get("buses", ()))
    name = name or DEFAULT_DRIVER
    return short_name(name), load_driver(name).Options


def _print_unit(context: click.Context, _parameter: click.Parameter, wanted: bool) -> None:
    """Print the systemd unit that comes with this package, for this very program."""
    if not wanted:
        return
    from importlib.resources import files

    text = (files("skinware_drivers") / "data" / UNIT_FILE).read_text()
    echo(text.replace(_UNIT_PROGRAM, str(Path(sys.argv[0]).absolute())), nl=False)
    context.exit()


@cli.command(
    "skin-driver",
    "skin-driver --bus virtual                  emulated boards, no hardware",
    "skin-driver --bus can0                     ROBOSKIN boards on CAN",
    "skin-driver --bus can0 --boards 7,8,9,10   only these boards",
    "skin-driver --bus can0 --listen-only       send nothing",
    "skin-driver --bus can0 --realtime fifo:50  real-time scheduling, if allowed",
    "skin-driver --driver xela --help           the options of another driver",
    "skin-driver --bus can0 --driver ./my.py    your own driver, in this file",
    "skin-driver --bus can0 --capture it.mcap   make a capture for a bug report",
    "skin-driver --bus replay:it.mcap           decode it again, with the recorded driver and options",
    cls=HardwareCommand,
    options_of=_options_of,
)
@click.option(
    "--bus",
    "buses",
    multiple=True,
    metavar="BUS",
    help="Bus that the skin is attached to: can0, /dev/ttyUSB0, virtual ...; may be repeated.",
)
@click.option(
    "--driver",
    metavar="DRIVER",
    help="Driver of the hardware: roboskin, xela, anyskin ..., or the file of your own.  [default: roboskin]",
)
@click.option("--name", metavar="NAME", help="Name of the skin for programs.  [default: the driver's name]")
@click.option(
    "--config",
    metavar="FILE",
    type=cli.FILE,
    help="TOML file with any of these options, also for each bus.",
)
@click.option("--listen-only", is_flag=True, help="Send nothing; learn from the frames which devices there are.")
@click.option("--wait", is_flag=True, help="If no bus is available yet, wait for one.")
@click.option(
    "--publish",
    type=click.Choice(["cycle", "rate", "request"]),
    help="When every patch has delivered, at the driver's rate, or on request.  [default: as the driver]",
)
@click.option(
    "--slots",
    type=click.IntRange(2, 64),
    help="Ring size: how many snapshots slow programs may fall behind, 2-64.  [default: a second, at least 8, 16 MiB]",
)
@click.option(
    "--latency",
    "latency_ms",
    type=click.FloatRange(0, 1000),
    metavar="MS",
    help="Longest time that frames wait to be taken together; less costs processor time.  [default: period / 4, 1-20]",
)
@click.option(
    "--geometry",
    metavar="FILE",
    type=click.Path(),
    help="TOML file with the positions of the sensors, which the driver publishes.",
)
@cli.group_option
@click.option("--realtime", metavar="PROFILE", help="normal, or fifo:PRIORITY with 1 to 99: scheduling and memory.")
@click.option("--cpus", metavar="LIST", help="CPUs to run on, such as 1,2-3.")
@click.option(
    "--capture",
    metavar="FILE",
    type=cli.FILE,
    help="Record all frames on the buses, and the decoded values, into a new file, such as for a bug report.",
)
@click.option(
    "--systemd",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_unit,
    help="Print a systemd unit that runs this program as a service, and end.",
)
@cli.namespace_option
@cli.json_option
@cli.verbose_option
def command(
    buses: tuple[str, ...],
    config: Path | None,
    namespace: str | None,
    as_json: bool,
    verbose: bool,
    capture: Path | None,
    **given: Any,
) -> None:
    """Run a driver: skin hardware on one or more buses into one stream of snapshots for any program.

    With several buses, the driver starts with those that are available; the others join when they appear.

    On SIGHUP, a listener adds the modules that it has heard since it started, and the buses of the --config file are
    read again: new buses join, removed ones leave, those with changed options are opened again, the others continue.
    So is the geometry file.
    Closing the terminal also sends SIGHUP; the driver then ends.

    Exit status: 0 interrupted, 1 it failed or its capture ended early, 2 wrong usage or configuration.
    """
    from skinware_drivers.cli.driver_setup import DriverConfig, DriverSetup
    from skinware_drivers.running.generation import FlowLoop

    cli.log_to_stderr(verbose)
    own = {name: given.pop(name) for name in DriverConfig.__struct_fields__ if name in given}
    hardware = hardware_values(given)
    setup = DriverSetup(own, buses=buses, hardware=hardware, config=config, namespace=namespace)
    runner = setup.make_runner(
        on_ready=lambda: print_ready(runner, as_json),
        on_patches=lambda change: print_patches(runner, change) if as_json else None,
    )
    result: dict[str, Any] = {}
    with contextlib.ExitStack() as beside:
        if capture is not None:
            from skinware_drivers.cli.capturing import captured

            done = partial(print_capture, capture, as_json)
            result = beside.enter_context(captured(capture, setup.name, setup.namespace.name, done))
        if setup.profile is not None:  # not for the recorder
            setup.profile.apply()
        with asyncio.Runner(loop_factory=FlowLoop) as loop:
            loop.run(_run(runner, as_json, partial(setup.read_again, runner)))
    if result.get("problem"):
        click.get_current_context().exit(cli.EXIT_FAILED)


async def _run(runner: Runner, as_json: bool, read_files: Callable[[], Coroutine[Any, Any, None]]) -> None:
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(runner.ending.handle)
    reading: set[asyncio.Task[None]] = set()

    async def read_again() -> None:
        try:
            await read_files()
        except (ConfigurationError, DriverError) as error:
            if isinstance(error, DriverError) and not error.bus:
                runner.ending.fail(error)
            else:
                log.error("buses and places stay as they are: %s", error)

    had_terminal = _has_terminal()

    def on_hangup() -> None:
        if had_terminal and not _has_terminal():
            runner.stop()
            return
        runner.join()
        task = loop.create_task(read_again())
        reading.add(task)
        task.add_done_callback(reading.discard)

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, runner.stop)
    loop.add_signal_handler(signal.SIGHUP, on_hangup)
    reporting = asyncio.create_task(report(runner)) if as_json else None
    if reporting is not None:
        reporting.add_done_callback(lambda task: None if task.cancelled() else task.result())
    try:
        await runner.run()
    finally:
        for task in reading:
            task.cancel()
        await asyncio.gather(*reading, return_exceptions=True)
        if reporting is not None:
            reporting.cancel()
            await asyncio.gather(reporting, return_exceptions=True)
        if as_json:
            with contextlib.suppress(BrokenPipeError):
                print_json({"event": "stopped", "name": runner.identity.name, **runner.status()})


def _has_terminal() -> bool:
    """Return whether this process is attached to a terminal, wherever its input and output go."""
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


main = partial(cli.run, command, goes_on=True)


def print_ready(runner: Runner, as_json: bool) -> None:
    if runner.builder.generation is None:
        return
    structure = runner.builder.generation.tables.structure
    buses = [line.name for line in runner.lines]
    if as_json:
        types = {t.name: int((structure.sensor_type == t.id).sum()) for t in structure.types}
        counts = {"sensors": structure.n_sensors, "modules": structure.n_modules, "patches": structure.n_patches}
        identity = {"driver": runner.identity.driver_type, "name": runner.identity.name}
        ready: dict[str, Any] = {"event": "ready", **identity, **counts}
        latency_ms = int(runner.builder.generation.publisher.latency_ns[0]) / 1e6
        print_json({**ready, "types": types, "buses": buses, "latency_ms": latency_ms})
    else:
        patches, modules = plural(structure.n_patches, "patch", "patches"), plural(structure.n_modules, "module")
        what = f"{patches}, {modules}, {plural(structure.n_sensors, 'sensor')} on {', '.join(buses)}"
        echo(f"{runner.identity.name}: {what}; publishing (skin-top shows it, Ctrl-C ends)")


def print_patches(runner: Runner, change: PatchChange) -> None:
    """Print for programs that patches fell silent, or are live again; people see it in the log."""
    if runner.ready:
        print_json({"event": "patches", "name": runner.identity.name, **change._asdict()})


def print_capture(path: Path, as_json: bool, result: Mapping[str, Any]) -> None:
    with contextlib.suppress(BrokenPipeError):
        if as_json:
            print_json({"event": "captured", "file": str(path), **result})
        elif result["problem"]:
            echo(f"{path}: ended early: {result['problem']}", err=True)
        else:
            missed = f", {plural(result['missed'], 'sample')} missed" if result["missed"] else ""
            size = result["bytes"] / 1e6
            echo(f"{path}: {size:.1f} MB{missed}; skin-driver --bus replay:{path} decodes it again")


async def report(runner: Runner) -> None:
    while True:
        await asyncio.sleep(1)
        if runner.ready:
            try:
                print_json({"event": "status", "name": runner.identity.name, **runner.status()})
            except BrokenPipeError:
                runner.stop()
                return
