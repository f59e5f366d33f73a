"""``skin-config``: set up what is attached to a bus, through its running driver or without one."""

from __future__ import annotations

import asyncio
import inspect
import socket
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json
from skinware.errors import BusNotAvailable, ConfigurationError, SkinwareError
from skinware.text import nearest_name
from skinware_drivers.bus_names import BusName

if TYPE_CHECKING:
    from skinware_drivers.adapter import AnyAdapter
    from skinware_drivers.description import Patch
    from skinware_drivers.finding.running import RunningDriver

_OWN_PARAMETERS = 3


class Declined(SkinwareError):
    """The user did not confirm."""


@cli.command(
    "skin-config",
    "skin-config can0                        list the operations for can0",
    "skin-config can0 versions               boards and their firmware",
    "skin-config torso rebaseline            for the boards of a running driver",
    "skin-config torso rate hz=50 --yes      without confirmation",
    "skin-config can0 set_address address=9 patch='board 7'",
    no_args_is_help=True,
)
@click.argument("target", metavar="NAME_OR_BUS")
@click.argument("operation", required=False)
@click.argument("arguments", nargs=-1, metavar="[KEY=VALUE]...")
@click.option(
    "--driver",
    "driver_name",
    metavar="DRIVER",
    help="Name or file of the driver, if none runs on the bus.  [default: roboskin]",
)
@click.option("--option", "options", multiple=True, metavar="KEY=VALUE", help="Option of that driver.")
@click.option("--config", metavar="FILE", type=cli.FILE, help="TOML file of that driver.")
@click.option("--timeout", "timeout_s", metavar="SECONDS", type=cli.seconds, default="10", help="Wait for a driver.")
@click.option("--yes", is_flag=True, help="Do not ask for confirmation.")
@click.option("--force", is_flag=True, help="Make changes even if something is sending on the bus.")
@cli.namespace_option
@cli.json_option
def command(
    target: str,
    operation: str | None,
    arguments: tuple[str, ...],
    driver_name: str | None,
    options: tuple[str, ...],
    config: Path | None,
    timeout_s: float,
    yes: bool,
    force: bool,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Carry out an OPERATION on the boards of the running driver NAME, or of a BUS.

    If a running driver uses the BUS, the operation goes through that driver. Otherwise it is done directly, if nothing
    is sending on the BUS. Without OPERATION: list the operations.

    Values are JSON (hz=50, on=false) or plain text. patch=NAME selects one patch.

    Exit status: 0 done, 1 failed or declined, 2 wrong usage or configuration.
    """
    from skinware.memory.namespace import Namespace
    from skinware_drivers.finding.running import driver_on, running_drivers

    place = Namespace(namespace)
    given = {key: _value(text) for key, text in cli.pairs(arguments, "KEY=VALUE", with_empty=True).items()}
    drivers, of_bus = running_drivers(), None
    owner = next((each for each in drivers if (each.name, each.namespace) == (target, place.name)), None)
    if owner is None and (owner := driver_on(target, drivers)) is not None:
        of_bus = owner.bus_named(target)
    if owner is not None:
        if driver_name or options or config or force:
            raise click.UsageError(
                f"{owner} runs: its own options hold, so --driver, --option, --config, --force do not apply"
            )
        outcome = _through_driver(owner, of_bus, operation, given, timeout_s, yes)
    else:
        names = [driver.name for driver in drivers if driver.namespace == place.name]
        no_driver = f"no driver {target!r} runs in namespace {place.name!r}{nearest_name(target, names)}"
        driver_type, adapter = _adapter(target, driver_name, options, config)
        outcome = _without_driver(target, no_driver, driver_type, adapter, operation, given, yes, force)
    if as_json:
        print_json({"target": target, "driver": owner, "operation": operation, **outcome})
    else:
        echo("\n".join(_lines(outcome["operations" if operation is None else "results"])))


def _through_driver(
    owner: RunningDriver,
    bus: str | None,
    operation: str | None,
    arguments: dict[str, Any],
    timeout_s: float,
    yes: bool,
) -> dict[str, Any]:
    from skinware import DriverReader
    from skinware_drivers.operations import operations_of
    from skinware_drivers.registry import load_driver

    with DriverReader(owner.name, namespace=owner.namespace, announce=False) as reader:
        offered = reader.operations(timeout_s=timeout_s)
        if operation is None:
            return {"operations": offered}
        try:
            declared = operations_of(load_driver(owner.driver_type), alone=True)
        except ConfigurationError:  # a driver that is not installed here
            declared = {}
        known = declared.get(operation)
        if operation not in offered:
            if known is not None and known.alone:
                raise ConfigurationError(f"{operation} needs the bus without a driver: end {owner} first")
            raise ConfigurationError(
                f"{owner} has no operation {operation!r}{nearest_name(operation, sorted(offered))}"
            )
        if bus is not None:
            arguments = {**arguments, "bus": bus}
        if known is None or not known.looks:
            on = " ".join(f"{key}={value}" for key, value in arguments.items())
            _confirm(f"{owner}: {operation} {on}".rstrip(), offered[operation], yes)
        return {"results": reader.call(operation, timeout_s=timeout_s, **arguments)}


def _without_driver(
    bus_name: str,
    no_driver: str,
    driver_type: str,
    adapter: AnyAdapter,
    operation: str | None,
    arguments: dict[str, Any],
    yes: bool,
    force: bool,
) -> dict[str, Any]:
    from skinware_drivers.finding.running import driver_on, running_drivers
    from skinware_drivers.finding.without_driver import carry_out
    from skinware_drivers.operations import operations_of
    from skinware_drivers.registry import make_bus

    declared = operations_of(type(adapter), alone=True)
    if operation is None:
        if bus_name in declared:
            raise click.UsageError(f"{bus_name} is an operation: name the driver or the bus before it")
        named, interfaces = BusName.of(bus_name), [name for _, name in socket.if_nameindex()]
        if named.interface == "socketcan" and named.channel not in interfaces:
            raise BusNotAvailable(f"{no_driver}; no bus has this name either")
        return {"operations": {name: _description(one.method) for name, one in declared.items()}}

    def agree(patches: Sequence[Patch]) -> None:
        names = ", ".join(patch.name for patch in patches)
        _confirm(f"{bus_name}: {operation} of {names}", _description(declared[str(operation)].method), yes)
        owner = driver_on(bus_name, running_drivers())
        if owner is not None:
            raise ConfigurationError(f"{owner} was started meanwhile; nothing was changed")

    bus = make_bus(bus_name, payload_size=adapter.payload_size, driver=driver_type)
    try:
        result = asyncio.run(carry_out(bus, bus_name, adapter, operation, arguments, agree=agree, force=force))
    except BusNotAvailable as error:
        if ":" in bus_name:
            raise
        raise BusNotAvailable(f"{no_driver}; as a bus: {error}") from None
    return {"results": {bus_name: result}}


def _adapter(
    bus_name: str, driver_name: str | None, options: tuple[str, ...], config: Path | None
) -> tuple[str, AnyAdapter]:
    from skinware_drivers.cli.driver_setup import ConfigFile
    from skinware_drivers.registry import DEFAULT_DRIVER, NamedBus, load_driver

    file = ConfigFile(config)
    driver_type = driver_name or file.settings.driver or DEFAULT_DRIVER
    driver = load_driver(driver_type)
    given = cli.pairs(options, "--option KEY=VALUE", with_empty=True)
    adapter_class = NamedBus(bus_name, driver_type).choose(driver)
    return driver_type, adapter_class(file.options_of_bus(driver.Options, bus_name, given))


def _confirm(what: str, description: str, yes: bool) -> None:
    if yes:
        return
    if not sys.stdin.isatty():
        raise ConfigurationError(
            f"{what}: this makes changes, and there is no terminal to ask for confirmation; add --yes"
        )
    echo(f"{what}\n  {description}", err=True)
    if not click.confirm("Go on?", err=True):
        raise Declined("nothing was changed")


def _value(text: str) -> Any:
    import msgspec

    try:
        return msgspec.json.decode(text)
    except msgspec.DecodeError:
        return text


def _description(method: Any) -> str:
    first = (inspect.getdoc(method) or "").partition("\n")[0]
    takes = ", ".join(map(str, list(inspect.signature(method).parameters.values())[_OWN_PARAMETERS:]))
    return f"{first} Takes {takes.replace(chr(39), '')}" if takes else first


def _lines(value: dict[str, Any], indent: str = "") -> list[str]:
    lines = []
    for key, one in value.items():
        if isinstance(one, dict) and any(isinstance(inner, dict | None) for inner in one.values()):
            lines += [f"{indent}{key}:", *_lines(one, indent + "  ")]
        elif isinstance(one, dict):
            lines.append(f"{indent}{key}: {', '.join(f'{name} {inner}' for name, inner in one.items())}")
        else:
            nothing = "no answer" if indent else "done"
            lines.append(f"{indent}{key}: {nothing if one is None else one}")
    return lines


main = partial(cli.run, command)
