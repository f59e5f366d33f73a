"""``skin-driver``: run a driver until it is interrupted."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli._command import (
    CONTEXT_SETTINGS,
    examples,
    group_option,
    json_option,
    log_to_stderr,
    namespace_option,
    run,
    verbose_option,
    version_option,
)
from skinware.cli._terminal import echo, print_json
from skinware.errors import ConfigurationError, DriverError, SkinwareError
from skinware_drivers.cli.driver_events import print_capture, print_patches, print_ready, report
from skinware_drivers.cli.hardware_options import HardwareCommand, hardware_values, value_of

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    import msgspec

    from skinware.geometry import Geometry
    from skinware.realtime import Profile
    from skinware_drivers.adapter import AnyAdapter
    from skinware_drivers.bus import Bus
    from skinware_drivers.bus_names import BusPlace
    from skinware_drivers.options.file import ConfigFile, DriverConfig
    from skinware_drivers.running.runner import PublishMode, Runner

log: logging.Logger = logging.getLogger("skinware.driver")

UNIT_FILE = "skinware@.service"
_UNIT_PROGRAM = "/opt/skinware/bin/skin-driver"
"""Stands in that file for this program."""


class DriverCommand(HardwareCommand):
    """A command that also takes the options of the driver it is asked to run."""

    def options_class(self, args: list[str]) -> tuple[str, type[msgspec.Struct]]:
        from skinware_drivers.cli.capturing import driver_of_recording
        from skinware_drivers.loading import short_name
        from skinware_drivers.registry import DEFAULT_DRIVER, load_driver

        config = value_of("--config", args)
        name = value_of("--driver", args)
        if not name and config:
            name = _read(Path(config)).settings.driver
        if not name:
            with contextlib.suppress(SkinwareError):  # which the bus says again when it is made
                name = driver_of_recording([value_of("--bus", args) or ""])
        name = name or DEFAULT_DRIVER
        return short_name(name), load_driver(name).Options

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse; explain a word that is not an option."""
        ctx.allow_extra_args = True
        left = super().parse_args(ctx, args)
        if left:
            raise click.UsageError(f"{left[0]!r} is not an option; name a driver with --driver, a bus with --bus", ctx)
        return left


def _print_unit(context: click.Context, _parameter: click.Parameter, wanted: bool) -> None:
    """Print the systemd unit that comes with this package, for this very program."""
    if not wanted:
        return
    from importlib.resources import files

    text = (files("skinware_drivers") / "data" / UNIT_FILE).read_text()
    echo(text.replace(_UNIT_PROGRAM, str(Path(sys.argv[0]).absolute())), nl=False)
    context.exit()


@click.command(
    "skin-driver",
    cls=DriverCommand,
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-driver --bus virtual                  emulated boards, no hardware",
        "skin-driver --bus can0                     ROBOSKIN boards on CAN",
        "skin-driver --bus can0 --boards 7,8,9,10   only these boards",
        "skin-driver --bus can0 --listen-only       send nothing",
        "skin-driver --bus can0 --realtime fifo:50  real-time scheduling, if allowed",
        "skin-driver --driver xela --help           the options of another driver",
        "skin-driver --bus can0 --driver ./my.py    your own driver, in this file",
        "skin-driver --bus can0 --capture it.mcap   make a capture for a bug report",
        "skin-driver --bus replay:it.mcap           decode it again, with the recorded driver and options",
    ),
)
@click.option(
    "--bus",
    "buses",
    multiple=True,
    metavar="BUS",
    help="Bus that the skin is attached to: can0, /dev/ttyUSB0, virtual ...; repeat it for several.",
)
@click.option(
    "--driver",
    "driver_name",
    metavar="DRIVER",
    help="Driver of the hardware: roboskin, xela, anyskin ..., or the file of your own.  [default: roboskin]",
)
@click.option("--name", metavar="NAME", help="Name of the skin for programs.  [default: the driver's name]")
@click.option(
    "--config",
    metavar="FILE",
    type=click.Path(path_type=Path),
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
    help="Ring size: how many frames slow programs may fall behind, 2-64.  [default: a second, at least 8, 16 MiB]",
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
    "geometry_file",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="TOML file with the positions of the sensors, which the driver publishes.",
)
@group_option
@click.option("--realtime", metavar="PROFILE", help="normal, or fifo:PRIORITY with 1 to 99: scheduling and memory.")
@click.option("--cpus", metavar="LIST", help="CPUs to run on, such as 1,2-3.")
@click.option(
    "--capture",
    metavar="FILE",
    type=click.Path(path_type=Path),
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
@namespace_option
@json_option
@version_option
@verbose_option
def command(
    buses: tuple[str, ...],
    driver_name: str | None,
    name: str | None,
    config: Path | None,
    listen_only: bool,
    wait: bool,
    publish: PublishMode | None,
    slots: int | None,
    latency_ms: float | None,
    geometry_file: Path | None,
    group: str | None,
    realtime: str | None,
    cpus: str | None,
    capture: Path | None,
    namespace: str | None,
    as_json: bool,
    verbose: bool,
    **driver_options: str | None,
) -> None:
    """Run a driver: skin hardware on one or more buses into one stream of frames for any program.

    With several buses, the driver starts with those that are available; the others join when they appear.

    On SIGHUP, a listener adds the modules that it has heard since it started, and the buses of the --config file are
    read again: new buses join, removed ones leave, those with changed options are opened again, the others continue.
    So is the geometry file.
    Closing the terminal also sends SIGHUP; the driver then ends.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage or configuration.
    """
    from skinware.geometry import read_geometry
    from skinware.memory.namespace import Namespace
    from skinware_drivers.bus import kind_of_bus
    from skinware_drivers.cli.capturing import driver_of_recording, only_listened, options_of_recording
    from skinware_drivers.loading import short_name
    from skinware_drivers.registry import DEFAULT_DRIVER, class_for, load_driver, make_bus
    from skinware_drivers.running.flow import FlowLoop
    from skinware_drivers.running.guard import hook
    from skinware_drivers.running.runner import Runner

    log_to_stderr(verbose)
    file = _read(config)
    settings = file.settings
    profile = _profile(settings.realtime if realtime is None else realtime, cpus, settings.cpus)
    bus_names = list(buses) or [bus.name for bus in settings.bus]
    is_of_file, driver_name = not driver_name, driver_name or settings.driver or driver_of_recording(bus_names)
    is_named, driver_name = bool(driver_name), driver_name or DEFAULT_DRIVER
    driver_type = short_name(driver_name)
    driver = load_driver(driver_name)
    latency_ms = settings.latency_ms if latency_ms is None else latency_ms
    listen_only = listen_only or settings.listen_only or only_listened(bus_names)
    if not bus_names:
        raise ConfigurationError("which bus? give --bus (vcan0, can0, virtual ...) or a --config with one")
    _refuse_twice(bus_names)
    _check_own_options(buses, settings)
    given = hardware_values(driver_options)

    def adapter_of(bus_name: str, file: ConfigFile) -> AnyAdapter:
        options = file.options_of_bus(driver.Options, bus_name, given, options_of_recording(bus_name, driver_type))
        with file.blamed_for(bus_name):
            adapter_class = class_for(driver, bus_name, driver_name)
            with hook("__init__", bus_name):
                adapter = adapter_class(options)
            adapter.check()
        return adapter

    def bus_of(bus_name: str, adapter: AnyAdapter, file: ConfigFile) -> Bus:
        with file.blamed_for(bus_name):
            bus = make_bus(bus_name, payload_size=adapter.payload_size, listen_only=listen_only, driver=driver_name)
            if not is_named and not bus.fits(adapter.medium):
                raise ConfigurationError(
                    f"{bus.name} is {kind_of_bus(bus.medium)}: give its driver with --driver. Without it, that is"
                    f" {driver_name}, on {kind_of_bus(adapter.medium)}{bus.instead(adapter.medium)}"
                )
            return bus

    def geometry_of(settings: DriverConfig) -> Geometry | None:
        path = geometry_file or settings.geometry
        return read_geometry(path) if path else None

    async def read_again() -> None:
        new = _read(config)
        geometry = geometry_of(new.settings)  # with a mistake in it, nothing is changed
        if config is not None and not buses:  # buses of the command line do not change
            wanted_driver = new.settings.driver or DEFAULT_DRIVER
            if is_of_file and wanted_driver != driver_name:
                raise ConfigurationError(
                    f"{config}: driver = {wanted_driver!r}, and {driver_name!r} is running: stop it and start it again"
                )
            _refuse_twice([bus.name for bus in new.settings.bus])
            wanted = {bus.name: adapter_of(bus.name, new) for bus in new.settings.bus}
            await runner.buses.change_to(wanted, lambda name, adapter: bus_of(name, adapter, new))
        await runner.change_geometry(geometry)

    adapters = [adapter_of(bus_name, file) for bus_name in bus_names]
    name, place = name or settings.name or driver_type, Namespace(namespace)
    runner = Runner(
        driver_type,
        [(name, adapter, bus_of(name, adapter, file)) for name, adapter in zip(bus_names, adapters, strict=True)],
        name=name,
        listen_only=listen_only,
        wait_for_buses=wait or settings.wait,
        publish=publish or settings.publish or None,
        latency_s=None if latency_ms is None else latency_ms / 1e3,
        namespace=place,
        slots=slots,
        group=group,
        geometry=geometry_of(settings),
        on_ready=lambda: print_ready(runner, as_json),
        on_patches=lambda change: print_patches(runner, change) if as_json else None,
    )
    with contextlib.ExitStack() as beside:
        if capture is not None:
            from skinware_drivers.cli.capturing import captured

            beside.enter_context(captured(capture, name, place.name, lambda done: print_capture(done, as_json)))
        if profile is not None:  # not for the recorder
            profile.apply()
        with asyncio.Runner(loop_factory=FlowLoop) as loop:
            loop.run(_run(runner, as_json, read_again))


async def _run(runner: Runner, as_json: bool, read_files: Callable[[], Coroutine[Any, Any, None]]) -> None:
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda _, context: _end(runner, context))  # which would only be logged by default
    reading: set[asyncio.Task[None]] = set()

    async def read_again() -> None:
        try:
            await read_files()
        except (ConfigurationError, DriverError) as error:
            if isinstance(error, DriverError) and not error.bus:
                runner.fail(error)
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
                print_json({"event": "stopped", "name": runner.name, **runner.status()})


def _end(runner: Runner, context: dict[str, Any]) -> None:
    """End the driver with an exception that nothing else caught in the event loop."""
    error = context.get("exception")
    if error is None:
        log.warning("%s", context["message"])
    else:
        runner.fail(error)


def _has_terminal() -> bool:
    """Return whether this process is attached to a terminal, wherever its input and output go."""
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


def _profile(realtime: str | None, cpus: str | None, configured_cpus: Sequence[int]) -> Profile | None:
    """Return the requested real-time profile; with CPUs alone, the normal one."""
    from skinware.realtime import Profile, cpus_from_text

    chosen = configured_cpus if cpus is None else cpus_from_text(cpus)
    if realtime is None and not chosen:
        return None
    return Profile.from_text("normal" if realtime is None else realtime, cpus=chosen)


def _check_own_options(buses: Sequence[str], settings: DriverConfig) -> None:
    """Refuse a bus without options, if the file has options for other buses only."""
    known = [bus.name for bus in settings.bus]
    for name in buses:
        if name not in known and any(bus.options for bus in settings.bus):
            raise ConfigurationError(
                f"--bus {name}: the file has options for {', '.join(known)} and none for this bus;"
                " change the name there"
            )


def _refuse_twice(bus_names: Sequence[str]) -> None:
    """Refuse a bus that is named twice: its boards would be set up twice."""
    from skinware_drivers.bus_names import parse_bus_name, place_of_bus

    seen: dict[BusPlace, str] = {}
    for name in bus_names:
        parse_bus_name(name)  # refuses bad names
        place = place_of_bus(name)
        if place in seen:
            also = f", also as {seen[place]}" if seen[place] != name else ""
            raise ConfigurationError(f"bus {name} is named twice{also}; name each bus once")
        seen[place] = name


def _read(path: Path | None) -> ConfigFile:
    from skinware_drivers.options.file import ConfigFile

    return ConfigFile(path)


def main() -> None:
    run(command, goes_on=True)
