"""``skin-top``: a skin live in the terminal, or a line a second for pipes."""

from __future__ import annotations

import sys
import time
from importlib.util import find_spec
from typing import TYPE_CHECKING

import click

from skinware.cli._command import namespace_option, run

if TYPE_CHECKING:
    from skinware.memory.namespace import Namespace

_MAX_REDRAWS_HZ = 15


@click.command("skin-top")
@click.option("--plain", is_flag=True, help="One line a second for each driver; the default without a terminal.")
@click.option("-T", "duration_s", type=float, help="End after this many seconds.")
@click.option("--type", "type_name", metavar="TYPE", default="pressure", show_default=True, help="What to draw.")
@namespace_option
def command(plain: bool, duration_s: float | None, type_name: str, namespace: str | None) -> None:
    """Show the drivers of a namespace live: patches, states, ages, losses, and the touch itself."""
    from skinware.memory.namespace import Namespace

    place = Namespace(namespace)
    if not plain and sys.stdout.isatty():
        if find_spec("textual") is not None:
            from skinware.cli._top_app import SkinTop

            SkinTop(place, type_name, duration_s, _MAX_REDRAWS_HZ).run()
            return
        click.echo("skin-top: for the live view: pip install 'skinware[top]'", err=True)
    show_lines(place, duration_s)


def show_lines(namespace: Namespace, duration_s: float | None) -> None:
    """Print a line per driver each second."""
    from skinware.cli._skin_view import driver_line
    from skinware.errors import ServiceTimeout
    from skinware.skin import Skin

    end = None if duration_s is None else time.monotonic() + duration_s
    with Skin(namespace) as skin:
        while end is None or time.monotonic() < end:
            try:
                snapshot = skin.read(timeout_s=1.0)
            except ServiceTimeout as silence:
                click.echo(str(silence))
                continue
            for name, frame in zip(snapshot.layout.drivers, snapshot.frames, strict=True):
                click.echo(driver_line(skin.reader(name), frame))
            time.sleep(1 if end is None else max(0.0, min(1.0, end - time.monotonic())))


def main() -> None:
    """Entry point."""
    run(command)
