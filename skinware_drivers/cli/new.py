"""``skin-new``: create a package for a new driver, ready to install, test and run."""

from __future__ import annotations

from pathlib import Path

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo

_HOW_TO_RUN = {
    "can": ("skin-driver --driver {name} --bus virtual",),
    "serial": (
        "skin-emulate --driver {name} --bus pty:port",
        "skin-driver --driver {name} --bus ./port       # in another terminal",
    ),
    "modbus": (
        "skin-emulate --driver {name} --bus modbus:tcp://127.0.0.1:5020",
        "skin-driver --driver {name} --bus modbus:tcp://127.0.0.1:5020    # in another terminal",
    ),
    "tcp": (
        "skin-emulate --driver {name} --bus tcp://127.0.0.1:5000",
        "skin-driver --driver {name} --bus tcp://127.0.0.1:5000    # in another terminal",
    ),
    "virtual": ("skin-driver --driver {name} --bus virtual",),
}
"""Commands to type for each transport."""


@cli.command(
    "skin-new",
    "skin-new fingertip --transport can     a driver for a device on a CAN bus",
    "skin-new forearm --transport serial    for a device on a serial line",
    "skin-new palm --transport modbus       for registers, behind TCP or on a serial line",
    "skin-new cuff --transport tcp          for a device behind a network, TCP or UDP",
    "skin-new dummy --transport virtual     for values that a program computes",
)
@click.argument("name")
@click.option(
    "--transport",
    type=click.Choice(list(_HOW_TO_RUN)),
    required=True,
    help="Where the data comes from: a CAN bus, a serial line, Modbus registers, a network, or the program itself.",
)
def command(name: str, transport: str) -> None:
    """Create a driver package in the new folder NAME: driver, emulated hardware, tests and instructions.

    It works at once, for a small imaginary device: replace this device by yours, step by step.

    For a first test you need no package: skin-driver --driver ./my_skin.py runs a driver in a file.
    """
    from skinware_drivers.new_package import check_name, make_package

    check_name(name)
    made = make_package(name, transport, Path.cwd())
    steps = [f"cd {name}", "pip install -e '.[test]'", "pytest", *_HOW_TO_RUN[transport]]
    echo(f"{name}/: {len(made)} files; next:")
    for step in steps:
        echo(f"  {step.format(name=name)}")
    echo(f"then make it the driver of your hardware: {name}/src/{name}/driver.py says where to begin")


def main() -> None:
    cli.run(command)
