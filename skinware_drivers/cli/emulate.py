"""``skin-emulate``: emulated skin patches on a bus that other programs use.

The command line is the emulator's options beside a few of its own; :mod:`.emulation` does the work.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import click

from skinware.errors import BusNotAvailable, ConfigurationError, SkinwareError

if TYPE_CHECKING:
    from skinware_drivers.options import Option

_DEFAULT_DRIVER = "roboskin"
_EMULATED = "skin-emulate.options"
_LONGEST_COMMAND = {"can": 8, "serial": 4096}
_EXIT_FAILED, _EXIT_CONFIGURATION, _EXIT_NO_BUS = 1, 2, 3


class EmulateCommand(click.Command):
    """The command with the options of the chosen emulator beside its own."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse a command line; whose options it may hold has to be found out first."""
        from skinware_drivers.options import describe_options
        from skinware_drivers.virtual.hardware import load_emulator

        try:
            emulator = load_emulator(_driver_in(args))
        except ConfigurationError as error:
            raise click.UsageError(str(error), ctx) from None
        ctx.meta[_EMULATED] = [_click_option(option) for option in describe_options(emulator.Options)]
        return super().parse_args(ctx, args)

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The command's own options, then the emulator's; an emulator cannot replace one of ours."""
        ours = super().get_params(ctx)
        taken = {flag for parameter in ours for flag in parameter.opts}
        return ours + [option for option in ctx.meta.get(_EMULATED, []) if not taken & set(option.opts)]


@click.command(cls=EmulateCommand, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--bus", "bus_name", metavar="NAME", required=True, help="Bus to live on, as vcan0.")
@click.option("--driver", metavar="NAME", default=_DEFAULT_DRIVER, show_default=True, help="Whose devices to emulate.")
@click.option("--log", "log_path", metavar="FILE", help="Write every injected fault to FILE, as JSON lines.")
@click.option("--json", "as_json", is_flag=True, help="Print the state every second, as JSON lines.")
@click.option(
    "-T", "--timeout", "duration_s", type=click.FloatRange(min=0), metavar="SECONDS", help="Stop after SECONDS."
)
def emulate(
    bus_name: str,
    driver: str,
    log_path: str | None,
    as_json: bool,
    duration_s: float | None,
    **texts: str | bool | None,
) -> None:
    """Emulate skin patches on a bus, with faults if wanted, until interrupted.

    Exit status: 0 done or interrupted, 1 failed, 2 usage or bad configuration, 3 bus not available.
    """
    try:
        _emulate(bus_name, driver, log_path, as_json, duration_s, texts)
    except ConfigurationError as error:
        _fail(error, _EXIT_CONFIGURATION)
    except BusNotAvailable as error:
        _fail(error, _EXIT_NO_BUS)
    except SkinwareError as error:
        _fail(error, _EXIT_FAILED)


def _emulate(
    bus_name: str,
    driver: str,
    log_path: str | None,
    as_json: bool,
    duration_s: float | None,
    texts: dict[str, str | bool | None],
) -> None:
    from skinware_drivers.cli.emulation import Emulation, HumanReport, JsonReport, SignalWatch
    from skinware_drivers.options import options_from_strings
    from skinware_drivers.registry import make_bus, parse_bus_name
    from skinware_drivers.virtual.events import JsonLinesLog
    from skinware_drivers.virtual.hardware import load_emulator, medium_of

    if parse_bus_name(bus_name).interface == "virtual":
        raise ConfigurationError(
            f"--bus {bus_name}: nobody else can open it; give vcan0 or pty:./port, or none: skin-driver --bus virtual"
        )
    emulator = load_emulator(driver)
    given = {name: _text(value) for name, value in texts.items() if value is not None}
    options = options_from_strings(emulator.Options, given)
    medium = medium_of(emulator)
    bus = make_bus(bus_name, payload_size=getattr(emulator, "payload_size", _LONGEST_COMMAND[medium]))
    if bus.medium not in (None, medium):
        where = "a CAN bus; give vcan0 or can0" if medium == "can" else "serial lines; give pty:./port or a port"
        raise ConfigurationError(f"--bus {bus_name}: devices of {driver} hang on {where}")
    log = JsonLinesLog(log_path) if log_path else None
    try:
        report = JsonReport(sys.stdout) if as_json else HumanReport(sys.stdout)
        emulation = Emulation(bus, emulator(options, log=log), report)
        with SignalWatch() as signals:
            emulation.run(signals, bus_name=bus_name, driver=driver, options=options, duration_s=duration_s)
    finally:
        if log is not None:
            log.close()


def _driver_in(args: list[str]) -> str:
    """The driver that a command line names; its options must be known before it can be parsed."""
    for at, word in enumerate(args):
        if word.startswith("--driver="):
            return word.removeprefix("--driver=")
        if word == "--driver" and at + 1 < len(args):
            return args[at + 1]
    return _DEFAULT_DRIVER


def _click_option(option: Option) -> click.Option:
    text = f"{option.description[:1].upper()}{option.description[1:]}."
    if option.kind == "yes/no":
        names = [f"{_flag(option.name)}/--no-{option.name.replace('_', '-')}", option.name]
        return click.Option(names, default=option.default == "yes", help=text)
    return click.Option(
        [_flag(option.name), option.name],
        metavar=option.kind,
        required=option.required,
        default=option.default or None,
        help=text,
        show_default=True,
    )


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _text(value: str | bool) -> str:
    return ("yes" if value else "no") if isinstance(value, bool) else value


def _fail(error: Exception, status: int) -> None:
    click.echo(f"skin-emulate: {error}", err=True)
    raise SystemExit(status)


def main() -> None:
    """Entry point of ``skin-emulate``."""
    emulate()


if __name__ == "__main__":
    main()
