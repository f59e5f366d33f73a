"""``skin-new``: create a package for a new driver from the templates that come with this package.

A template is the file itself, with ``$name`` (of the driver and the package) and ``$Class`` (of the adapter) in it;
``$$`` is a dollar sign.
"""

from __future__ import annotations

import keyword
import os
import re
import shutil
import sys
from functools import partial
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from string import Template

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo
from skinware.errors import ConfigurationError, SkinwareError

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
    check_name(name)
    made = make_package(name, transport, Path.cwd())
    steps = [f"cd {name}", "pip install -e '.[test]'", "pytest", *_HOW_TO_RUN[transport]]
    echo(f"{name}/: {len(made)} files; next:")
    for step in steps:
        echo(f"  {step.format(name=name)}")
    echo(f"then make it the driver of your hardware: {name}/src/{name}/driver.py says where to begin")


main = partial(cli.run, command)


LONGEST_NAME = 20
"""With it, the lines of the templates stay short enough."""

_COMMON = {
    "gitignore": ".gitignore",
    "init.py": "src/$name/__init__.py",
    "py.typed": "src/$name/py.typed",
    "pyproject.toml": "pyproject.toml",
}
_OF_TRANSPORT = {
    "README.md": "README.md",
    "ci.yml": ".github/workflows/ci.yml",
    "driver.py": "src/$name/driver.py",
    "emulator.py": "src/$name/emulator.py",
    "test_driver.py": "tests/test_$name.py",
}
"""Template (without its ending) -> file of the package."""


def check_name(name: str) -> None:
    """Refuse what cannot be the name of a driver and of a Python package; propose a better one if possible."""
    from skinware_drivers.loading import registered
    from skinware_drivers.registry import DRIVERS
    from skinware_drivers.virtual.hardware import EMULATORS

    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        better = re.sub(r"\W+|_+", "_", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name), flags=re.ASCII).strip("_").lower()
        hint = f"; how about {better!r}?" if re.fullmatch(r"[a-z][a-z0-9_]*", better) else ""
        raise ConfigurationError(
            f"{name!r} cannot name a driver: use lower-case letters, digits and _, beginning with a letter{hint}"
        )
    if len(name) > LONGEST_NAME:
        raise ConfigurationError(f"{name!r} has {len(name)} letters, a driver's name at most {LONGEST_NAME}")
    if keyword.iskeyword(name):
        raise ConfigurationError(f"{name!r} is a word of Python and cannot name a package")
    for group, what in ((DRIVERS, "driver"), (EMULATORS, "emulator")):
        if (taken := registered(group).get(name)) is not None:
            raise ConfigurationError(f"there is {what} {name!r} already ({taken.value}): choose another name")
    if name in sys.stdlib_module_names or find_spec(name) is not None:
        raise ConfigurationError(f"there is a Python package {name!r} already, which yours would hide: choose another")


def make_package(name: str, transport: str, where: Path) -> list[Path]:
    """Make the package in ``where / name``, completely or not at all; return its files, relative to that."""
    folder = where / name
    if folder.exists() or folder.is_symlink():
        raise ConfigurationError(f"{folder} already exists; nothing was changed")
    words = {"name": name, "Class": "".join(part.capitalize() for part in name.split("_"))}
    unfinished = where / f".{name}.{os.getpid()}"
    made = []
    try:
        unfinished.mkdir()
        templates = files("skinware_drivers") / "templates"
        for folder_of, named in (("common", _COMMON), (transport, _OF_TRANSPORT)):
            for template, file in named.items():
                path = Path(Template(file).substitute(words))
                text = (templates / folder_of / f"{template}.template").read_text()
                (unfinished / path).parent.mkdir(parents=True, exist_ok=True)
                (unfinished / path).write_text(Template(text).substitute(words))
                made.append(path)
        unfinished.rename(folder)
    except OSError as error:
        raise SkinwareError(f"cannot make {folder}: {error.strerror}") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)  # there is none if all went well
    return made
