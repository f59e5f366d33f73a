"""``skin-top``: a skin live in the terminal, or a line a second for pipes."""

from __future__ import annotations

import math
import sys
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import are_terminals, echo, print_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from skinware.memory.namespace import Namespace
    from skinware.views.live import LiveDriver, Overview

_LINE_PERIOD_S = 1.0
_TAKE_PERIOD_S = 0.1
_NEEDED = "textual>=8"
"""The package of the extra ``top``; installing it alone works however this package was installed."""


@cli.command(
    "skin-top",
    "skin-top                    in the terminal",
    "skin-top torso              one driver of several",
    "skin-top --type proximity   draw another type of sensors",
    "skin-top --region palm      draw a region of regions.toml",
    "skin-top --plain -T 10      ten seconds of plain lines",
)
@cli.names_argument
@click.option(
    "--plain", is_flag=True, help="Print one line per second for each driver; the default without a terminal."
)
@cli.duration_option()
@cli.type_option("Sensors to draw first.  [default: normal force or pressure, else another touch]")
@click.option(
    "--scale",
    "scale_name",
    type=click.Choice(["change", "range", "raw"]),
    default="change",
    help="Colour scale at the start: change from the baseline, range of the type, or raw counts.",
)
@click.option("--region", metavar="NAME", help="Draw only sensors in this region at first.")
@cli.regions_option()
@cli.namespace_option
@cli.json_option
@click.pass_context
def command(
    context: click.Context,
    names: tuple[str, ...],
    plain: bool,
    duration_s: float | None,
    type_name: str | None,
    scale_name: str,
    region: str | None,
    region_files: tuple[Path, ...],
    namespace: str | None,
    as_json: bool,
) -> None:
    """Show drivers live, all or those with NAME: states, rates, ages, losses, and a picture of the skin.

    Contacts are shown too where a service publishes them, as skin-calm does.
    """
    from skinware.memory.namespace import Namespace, check_name

    for name in names:
        check_name(name, "driver")
    if plain or as_json:
        cli.refuse_others("--plain" if plain else "--json", {"names", "plain", "as_json", "duration_s", "namespace"})
    place = Namespace(namespace)
    wanted = () if region is None else (region,)
    regions = cli.regions_of(region_files, wanted) if wanted or region_files else None
    if not plain and not as_json and are_terminals(sys.stdin, sys.stdout, sys.stderr):  # Textual draws on stderr
        if find_spec("textual") is not None:
            from skinware.cli._top_app import SkinTop

            app = SkinTop(place, names, type_name, duration_s, scale_name=scale_name, regions=regions, region=region)
            app.run()
            context.exit(app.return_code or 0)
        cli.warn(f"for the live view: {sys.executable} -m pip install '{_NEEDED}'. Going on with plain lines")
    show_lines(place, duration_s, as_json, names)


def show_lines(
    namespace: Namespace, duration_s: float | None, as_json: bool = False, names: Sequence[str] = ()
) -> None:
    from skinware.cli import _top_rows  # noqa: F401 - before the first look, whose samples would age meanwhile
    from skinware.views.live import Overview

    overview = Overview(namespace, names)
    lines_at_s = time.monotonic()
    end_s = math.inf if duration_s is None else lines_at_s + duration_s
    try:
        while True:
            drivers = overview.look()
            if time.monotonic() >= lines_at_s:
                _print_lines(overview, drivers, as_json)
                lines_at_s = max(lines_at_s + _LINE_PERIOD_S, time.monotonic())
            if time.monotonic() >= end_s:
                return
            next_s = min(time.monotonic() + _TAKE_PERIOD_S, lines_at_s, end_s)
            time.sleep(max(0.0, next_s - time.monotonic()))
    finally:
        overview.close()


def _print_lines(overview: Overview, drivers: Sequence[LiveDriver], as_json: bool) -> None:
    from skinware import bridge_state
    from skinware.cli._top_rows import as_data, contact_data, contact_text, plain_line

    for driver in drivers:
        places = overview.contacts_on(driver) or []
        if as_json:
            print_json(as_data(driver.report(), [contact_data(place) for place in places]))
        else:
            for line in (plain_line(driver.report()), *map(contact_text, places)):
                echo(line)
    if as_json:
        return
    if not drivers:
        echo(f"{overview.nothing}; start one: skin-driver --bus virtual")
    for bridge in overview.bridges.states():
        echo(bridge_state.summary(bridge.robot, bridge_state.as_data(bridge)))


main = partial(cli.run, command)
