"""``skin-bridge yarp``: publish drivers as ports of YARP."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json
from skinware.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable

    from skinware.yarp.names import NameServer
    from skinware.yarp.serving import YarpServer


@click.command(
    "yarp",
    epilog=cli.examples(
        "skin-bridge yarp torso --yarp 4               then, with YARP: yarp read ... /skinware/torso",
        "skin-bridge yarp --yarp 3 --namespace calm --prefix /icub/skin --regions skin/left_arm.regions.toml",
        "skin-bridge yarp --yarp 4 --server 10.0.0.1:10000 --listen 10.0.0.7   for a robot's network",
    ),
)
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option("--prefix", default="/skinware", show_default=True, metavar="/P", help="Prefix of all port names.")
@click.option("--type", "type_name", default="pressure", show_default=True, metavar="TYPE", help="Sensor type.")
@click.option(
    "--full-scale",
    type=click.FloatRange(min=0, min_open=True),
    metavar="X",
    help="Physical value that becomes 255.  [default: the maximum of the type]",
)
@click.option(
    "--regions",
    "region_files",
    metavar="FILE",
    multiple=True,
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="Make a port of each region of FILE; skin-import writes the regions of a robot's ports; repeatable.",
)
@click.option(
    "--server", metavar="HOST:PORT", help="YARP's name server.  [default: as yarp.conf says, else 127.0.0.1:10000]"
)
@click.option(
    "--yarp",
    "yarp",
    type=click.Choice(["3", "4"]),
    help="Major version of the YARP of binary readers; without it, only text readers are served.",
)
@click.option(
    "--listen", "host", default="127.0.0.1", show_default=True, metavar="HOST", help="Address at which ports listen."
)
@cli.namespace_option
@cli.json_option
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
    """Publish drivers NAME..., or all, also later ones, as ports of YARP: for each frame a vector of doubles, 0 to 255.

    A reader that is slow, stopped or gone misses vectors, and costs neither drivers nor other readers anything. YARP
    has no authentication: all programs that reach a port can read it, and can make it call other ports.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.memory.namespace import Namespace, check_name
    from skinware.tactile.regions import read_regions
    from skinware.yarp.serving import Settings, YarpServer

    for name in names:
        check_name(name, "service")
    regions = tuple(read_regions(*region_files)) if region_files else ()
    settings = Settings(names, prefix.rstrip("/"), type_name, full_scale, regions, host, int(yarp) if yarp else None)
    place, known_by = Namespace(namespace), _name_server(server)
    yarp_server = YarpServer(place, settings, known_by, print_json if as_json else _show_event)
    with contextlib.closing(yarp_server), cli.signals_end(yarp_server.stop):
        if as_json:
            address = f"{known_by.host}:{known_by.port}"
            print_json({"event": "ready", "namespace": place.name, "server": address, "listen": host})
            yarp_server.run(_status(yarp_server))
        else:
            echo(f"namespace {place.name!r} as ports {settings.prefix}/..., {known_by} (Ctrl-C ends)")
            yarp_server.run()


def _name_server(text: str | None) -> NameServer:
    from skinware.yarp.names import DEFAULT_PORT, NameServer, configured_server

    if text is None:
        return NameServer(*configured_server())
    host, port = text.rsplit(":", 1) if ":" in text else (text, str(DEFAULT_PORT))
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise ConfigurationError(f"--server {text}: write HOST:PORT, such as 10.0.0.1:10000")
    return NameServer(host, int(port))


def _show_event(event: dict[str, Any]) -> None:
    if event["event"] == "trouble":
        cli.warn(f"{event['about']}: {event['why']}")
    else:
        echo(f"{event['port']}: driver {event['driver']}")


def _status(server: YarpServer) -> Callable[[], None]:
    before: dict[str, int] = {}

    def report() -> None:
        ports = {}
        for name, port in server.ports().items():
            count = port.pop("messages")
            ports[name] = {"rate_hz": count - before.get(name, 0), **port}
            before[name] = count
        print_json({"event": "status", "missed": server.missed, "ports": ports})

    return report
