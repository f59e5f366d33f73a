"""``skin-prove --captured``: decode a capture again, and compare with the values that were decoded then."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from skinware.cli._terminal import echo, print_json, style
from skinware.errors import ConfigurationError
from skinware_drivers.cli.hardware_options import hardware_values, own_values

if TYPE_CHECKING:
    from skinware_drivers.adapter import AnyAdapter
    from skinware_drivers.proving.updates import Comparison


def compare_capture(capture: Path, arguments: Sequence[str], *, save: bool, as_json: bool) -> bool:
    """Compare, print the result, and return whether all values are equal.

    Args:
        arguments: of skin-driver: the driver and its own options.
        save: write the values that are decoded now beside the file, as the expected ones.

    Raises:
        BadRecording: the file is not a recording.
        ConfigurationError: the file cannot be read, has no wire, or wires of several drivers; or the arguments are
            wrong.
        DriverError: the driver failed.
    """
    from skinware_drivers.proving import updates
    from skinware_drivers.proving.captures import check_capture, decoded_now, expected_of

    driver, options = _chosen(capture, arguments)
    try:
        if save:
            now = decoded_now(capture, driver, options)
            if not now:
                raise ConfigurationError(f"{capture}: nothing in it is decoded, so there is nothing to save")
            updates.save(now, expected_of(capture))
        compared, now = check_capture(capture, driver, options)
    except OSError as error:
        raise ConfigurationError(f"{error.filename or capture}: {error.strerror}") from None
    if not compared.then:
        raise ConfigurationError(
            f"{capture}: nothing was decoded then, {compared.now} updates are now; if they are right: --save"
        )
    _print(capture, compared, as_json)
    return compared.difference is None


def _chosen(capture: Path, arguments: Sequence[str]) -> tuple[type[AnyAdapter] | None, Mapping[str, Any]]:
    """Return the chosen driver and its options; None: the recorded driver.

    Raises:
        ConfigurationError: there is no such driver, or it has no such option.
        UsageError: an option is not about decoding.
    """
    from skinware_drivers.cli.driver import command as driver_command
    from skinware_drivers.options import options_from_strings
    from skinware_drivers.proving.captures import driver_type_of
    from skinware_drivers.registry import load_driver

    if not arguments:
        return None, {}
    name = own_values(driver_command, arguments).get("driver_name") or driver_type_of(capture)
    context = driver_command.make_context("skin-driver", ["--driver", name, *arguments])
    driver = load_driver(name)
    chosen = {
        key: text
        for key, text in context.params.items()
        if context.get_parameter_source(key) is ParameterSource.COMMANDLINE and key != "driver_name"
    }
    for option in driver_command.params:
        if option.name in chosen:
            raise click.UsageError(f"--captured: {option.opts[0]} is not about decoding")
    given = hardware_values(chosen)
    options = options_from_strings(driver.Options, given) if given else None
    return driver, {key: getattr(options, key) for key in given}


def _print(capture: Path, compared: Comparison, as_json: bool) -> None:
    difference = compared.difference
    if as_json:
        print_json(
            {
                "event": "compared",
                "file": str(capture),
                "equal": difference is None,
                "compared": compared.compared,
                "then": compared.then,
                "now": compared.now,
                "difference": None if difference is None else asdict(difference),
            }
        )
        return
    counts = f"{compared.then} updates of modules then, {compared.now} now, {compared.compared} compared"
    echo(f"{capture}: {counts}")
    if difference is None:
        echo(style("equal", fg="green"))
    else:
        echo(f"{style('different', fg='red')} {difference}")
