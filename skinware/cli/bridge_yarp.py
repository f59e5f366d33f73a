"""``skin-bridge yarp``: drivers as ports of YARP."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli._command import (
    CONTEXT_SETTINGS,
    examples,
    json_option,
    namespace_option,
    signals_end,
    warn,
)
from skinware.cli._terminal import echo, print_json
from skinware.errors import ConfigurationError

if TYPE_CHECKING:
    from skinware.yarp.names import NameServer
    from skinware.yarp.outlet import Outlet


@click.command(
    "yarp",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-bridge yarp torso --yarp 4               then, with YARP: yarp read ... /skinware/torso",
        "skin-bridge yarp --yarp 3 --namespace calm --prefix /icub/skin --regions skin/left_arm.regions.toml",
        "skin-bridge yarp --yarp 4 --server 10.0.0.1:10000 --listen 10.0.0.7   for a robot's network",
    ),
)
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option("--prefix", default="/skinware", show_default=True, metavar="/P", help="What names of ports begin with.")
@click.option("--type", "type_name", default="pressure", show_default=True, metavar="TYPE", help="Type of sensors.")
@click.option(
    "--full-scale",
    type=click.FloatRange(min=0, min_open=True),
    metavar="X",
    help="Physical value that becomes 255.  [default: the greatest of the type]",
)
@click.option(
    "--regions",
    "region_files",
    metavar="FILE",
    multiple=True,
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="A port for each region of FILE, as skin-import writes them of a robot's ports; repeat it for several.",
)
@click.option(
    "--server", metavar="HOST:PORT", help="YARP's name server.  [default: as yarp.conf says, else 127.0.0.1:10000]"
)
@click.option(
    "--yarp",
    "yarp",
    type=click.Choice(["3", "4"]),
    help="Major version of the YARP whose programs read in binary; without it, only readers in text are served.",
)
@click.option(
    "--listen", "host", default="127.0.0.1", show_default=True, metavar="HOST", help="Address at which ports listen."
)
@namespace_option
@json_option
def command(
    names: tuple[str, ...],
    prefix: str,
    type_name: str,
    full_scale: float | None,
    region_files: tuple[Path, ...],
    server: str | None,
    yarp: str | None,
    host: str,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Serve drivers NAME..., or all there are and come, as ports of YARP: one vector of doubles, 0 to 255, a frame.

    A reader that is slow, stopped or gone misses vectors, and costs neither drivers nor other readers anything. YARP
    asks nobody who he is: whoever reaches a port can read it, and can have it call other ports.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.memory.namespace import Namespace, check_name
    from skinware.tactile.regions import read_regions
    from skinware.yarp.outlet import Outlet, Wanted

    for name in names:
        check_name(name, "service")
    regions = tuple(read_regions(*region_files)) if region_files else ()
    wanted = Wanted(names, prefix.rstrip("/"), type_name, full_scale, regions, host, int(yarp) if yarp else None)
    place, told = Namespace(namespace), _name_server(server)
    status = _Status(as_json)
    outlet = Outlet(place, wanted, told, status.happened)
    with contextlib.closing(outlet), signals_end(outlet.stop):
        if as_json:
            print_json(
                {"event": "ready", "namespace": place.name, "server": f"{told.host}:{told.port}", "listen": host}
            )
        else:
            echo(f"namespace {place.name!r} as ports {wanted.prefix}/..., {told} (Ctrl-C ends)")
        outlet.run(lambda: status.tell(outlet))


def _name_server(text: str | None) -> NameServer:
    from skinware.yarp.names import DEFAULT_PORT, NameServer, configured_server

    if text is None:
        return NameServer(*configured_server())
    host, port = text.rsplit(":", 1) if ":" in text else (text, str(DEFAULT_PORT))
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise ConfigurationError(f"--server {text}: write HOST:PORT, such as 10.0.0.1:10000")
    return NameServer(host, int(port))


class _Status:
    """Tells each second who reads what, and what happens at once."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._before: dict[str, int] = {}

    def happened(self, event: dict[str, Any]) -> None:
        if self._as_json:
            print_json(event)
        elif event["event"] == "trouble":
            warn(f"{event['about']}: {event['why']}")
        else:
            echo(f"{event['port']}: driver {event['driver']}")

    def tell(self, outlet: Outlet) -> None:
        ports = outlet.ports()
        if self._as_json:
            rates = {name: port["messages"] - self._before.get(name, 0) for name, port in ports.items()}
            shown = {
                name: {
                    "rate_hz": rates[name],
                    **{key: port[key] for key in ("driver", "registered", "values", "readers")},
                }
                for name, port in ports.items()
            }
            print_json({"event": "status", "lost": outlet.lost, "ports": shown})
        self._before = {name: port["messages"] for name, port in ports.items()}
