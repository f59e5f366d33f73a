"""``skin-press``: press an emulated skin, in any process."""

from __future__ import annotations

import contextlib
from functools import partial
from typing import TYPE_CHECKING

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json
from skinware.errors import ConfigurationError, ServiceNotFound, SkinwareError

if TYPE_CHECKING:
    from skinware.memory.namespace import Namespace

_OPERATION = "press"
_ASK_S = 1.0


@cli.command(
    "skin-press",
    "skin-driver --bus virtual                       an emulated forearm and hand, in another terminal",
    "skin-press 0.07 0.0225 0                        for one second",
    "skin-press 0.19 0 -0.0125 --seconds 60          its palm, for a minute",
    "skin-press 0.07 0 0.02 --newtons 6 --radius 0.01  hard, with a thumb",
    context_settings={"ignore_unknown_options": True},
)
@click.argument("x", type=float)
@click.argument("y", type=float)
@click.argument("z", type=float)
@click.option("--newtons", "force_n", type=float, metavar="N", default=3.0, help="Force of the press.")
@click.option(
    "--radius",
    "radius_m",
    type=float,
    metavar="M",
    default=0.006,
    help="Radius of the touch, metres.",
)
@click.option("--seconds", type=float, metavar="S", default=1.0, help="Duration; the command does not wait.")
@click.option("--name", metavar="NAME", help="Driver or emulator.  [default: the only one that can be pressed]")
@cli.namespace_option
@cli.json_option
def command(
    x: float,
    y: float,
    z: float,
    force_n: float,
    radius_m: float,
    seconds: float,
    name: str | None,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Press an emulated skin at a place: X, Y and Z in metres, in the coordinate frame of its geometry.

    The skin belongs to "skin-driver --bus virtual" or "skin-emulate --name NAME": emulated ROBOSKIN boards that cover a
    forearm along x from 0 to 0.14, and a hand from there to 0.23. Other emulated devices and hands cannot be pressed at
    a place; they feel six touches of their own in half a minute.

    Exit status: 0 pressed, 1 nothing would feel it or no such skin runs, 2 wrong usage.
    """
    from skinware.memory.namespace import Namespace
    from skinware.service import ServiceReader

    place = Namespace(namespace)
    name = name or _the_only_one(place)
    with ServiceReader(name, namespace=place, announce=False) as reader:
        if _OPERATION not in reader.operations():
            raise ConfigurationError(f"{name} cannot be pressed: it is no emulated skin with places")
        pressed = reader.call(_OPERATION, at_m=(x, y, z), force_n=force_n, radius_m=radius_m, seconds=seconds)
    if as_json:
        print_json({"name": name, "pressed": pressed})
        return
    for bus, nearest in pressed.items():
        distance_m = nearest.pop("distance_m")
        place_of = [*(f"{key} {value}" for key, value in nearest.items()), f"{1e3 * distance_m:.1f} mm away"]
        echo(f"{name} on {bus}: {force_n:g} N for {seconds:g} s; the nearest taxel: {', '.join(place_of)}")


def _the_only_one(namespace: Namespace) -> str:
    from skinware.service import ServiceReader

    able = []
    for name in namespace.services():
        # one may be dead, hanging, just withdrawn, not readable, or without requests
        with contextlib.suppress(SkinwareError), ServiceReader(name, namespace=namespace, announce=False) as reader:
            able += [name] if _OPERATION in reader.operations(timeout_s=_ASK_S) else []
    if not able:
        raise ServiceNotFound(
            f"nothing in the namespace {namespace.name!r} can be pressed: only emulated ROBOSKIN boards can,"
            " those of skin-driver --bus virtual or skin-emulate --name. Other emulated devices and hands feel"
            " touches of their own"
        )
    if len(able) > 1:
        raise ConfigurationError(f"several can be pressed; give --name: {', '.join(able)}")
    return able[0]


main = partial(cli.run, command)
