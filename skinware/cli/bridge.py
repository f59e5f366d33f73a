"""``skin-bridge``: the services of one machine on another, in a ROS 2 graph, and as ports of YARP."""

from __future__ import annotations

import contextlib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import _command as cli
from skinware.cli._middlewares import foxglove, rerun, ros2, yarp
from skinware.cli._robots import connect_option, list_robots, route
from skinware.cli._terminal import echo, print_json, say

if TYPE_CHECKING:
    from skinware.bridge_state import BridgeState

_PORT = 7448
_MODES = {
    "push": "the link is fast: every sample is sent when it is published",
    "pull": "samples wait on the link: only the newest are asked for, as many as it takes",
}


@cli.group("skin-bridge")
def command() -> None:
    """Publish the drivers and services of one machine on another, in a ROS 2 graph, or as ports of YARP.

    On the robot: skin-bridge serve. On other machines: skin-bridge join. For many robots: skin-bridge list and
    skin-bridge route. For other middlewares: skin-bridge ros2 and skin-bridge yarp. For other viewers: skin-bridge
    rerun and skin-bridge foxglove.
    """


for _each in (route, list_robots, ros2, yarp, rerun, foxglove):
    command.add_command(_each)


@command.command(
    "serve",
    epilog=cli.examples(
        "skin-bridge serve --robot icub                                     for programs of this machine",
        "skin-bridge serve --robot icub --listen tcp/0.0.0.0:7448 --insecure  for all in a trusted network",
        "skin-bridge serve --robot icub --listen tls/0.0.0.0:7448 --tls certs  for all with a certificate",
    ),
)
@cli.names_argument
@click.option("--robot", required=True, metavar="R", help="Name of this robot.")
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help=f"Where peers connect: tcp/HOST:PORT.  [default: tcp/127.0.0.1:{_PORT}]",
)
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="Connect to a router instead.")
@cli.tls_option()
@cli.caller_option
@cli.insecure_option
@cli.namespace_option
@cli.json_option
def serve(
    names: tuple[str, ...],
    robot: str,
    listen: tuple[str, ...],
    connect: tuple[str, ...],
    tls: Path | None,
    callers: tuple[str, ...],
    insecure: bool,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Let other machines join drivers and services NAME..., or all, also later ones.

    A receiver that is slow, stopped or gone costs neither the drivers nor other receivers anything.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.bridge.endpoints import DEFAULT_LISTEN, Rules, endpoints
    from skinware.bridge.link import ZenohLink
    from skinware.bridge.messages import Keys
    from skinware.bridge.serving import Server
    from skinware.memory.namespace import Namespace, check_name

    for name in names:
        check_name(name, "service")
    Keys(robot)  # refuses a wrong name before anything is opened
    place = Namespace(namespace)
    places = endpoints(
        listen=listen or (() if connect else (DEFAULT_LISTEN,)),
        connect=connect,
        tls=tls,
        rules=Rules(callers),
        insecure=insecure,
    )
    with contextlib.closing(ZenohLink(places)) as link:
        server = Server(robot, link, place, names or None, callers=callers)
        with contextlib.closing(server), cli.signals_end(server.stop):
            ready = {"event": "ready", "robot": robot, "namespace": place.name}
            where = {"listen": list(places.listen), "connect": list(places.connect)}
            say(as_json, ready | where, f"robot {robot}: namespace {place.name!r}, {places} (Ctrl-C ends)")
            before: dict[str, int] = {}
            shown: dict[str, str] = {}

            def report() -> None:
                frames = server.frames()
                if not as_json:
                    cli.echo_changes(shown, {name: state for name, (state, _, _) in frames.items()})
                    return
                services = {}
                for name, (state, count, pullers) in frames.items():
                    services[name] = {"state": state, "rate_hz": count - before.get(name, 0), "pulled_by": pullers}
                    before[name] = count
                guard = server.guard
                counts = {"missed": server.missed, "refused": guard.count, "last_refused": guard.last or None}
                print_json({"event": "status", **counts, "services": services})

            server.run(report)


@command.command(
    "join",
    epilog=cli.examples(
        "skin-bridge join icub --connect tcp/192.168.1.10:7448     then: skin-top --namespace icub",
        "skin-bridge join icub --connect tls/icub.local:7448 --tls certs --into default",
        "skin-bridge join icub --connect tcp/192.168.1.10:7448 --region palm --into palm   only those sensors travel",
    ),
)
@click.argument("robot", metavar="R")
@connect_option
@click.option("--into", metavar="NAMESPACE", help="Namespace in which its services appear.  [default: R]")
@cli.tls_option()
@click.option(
    "--mode",
    type=click.Choice(["auto", "push", "pull"]),
    default="auto",
    help="Get every sample (push), or only the newest, as fast as the link takes them (pull).",
)
@cli.parts_options
@cli.json_option
def join(
    robot: str,
    connect: tuple[str, ...],
    into: str | None,
    tls: Path | None,
    mode: str,
    patches: tuple[str, ...],
    in_regions: tuple[str, ...],
    region_files: tuple[Path, ...],
    as_json: bool,
) -> None:
    """Publish the services of robot R here, with the same names, structures, states and operations.

    Times are moved to the clock of this machine. Samples that the link cannot take are counted as gaps. With --patch or
    --region only those sensors of its drivers travel, and no other services.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.bridge.endpoints import endpoints, why_unreachable
    from skinware.bridge.joining import Joiner
    from skinware.bridge.link import ZenohLink
    from skinware.bridge.messages import Keys, Wish
    from skinware.bridge_state import as_data
    from skinware.memory.namespace import Namespace

    regions = tuple(cli.regions_asked_for(in_regions, region_files))
    wish = Wish(patches, in_regions, regions) if patches or in_regions else None  # None: all sensors and services
    Keys(robot)  # refuses a wrong name before anything is opened
    place = Namespace(into or robot)
    places = endpoints(connect=connect, tls=tls)
    with contextlib.closing(ZenohLink(places)) as link:
        joiner = Joiner(
            robot,
            link,
            place,
            mode=None if mode == "auto" else mode,
            wish=wish,
            why_not=lambda: " ".join(filter(None, (why_unreachable(at, tls) for at in places.connect))),
            on_event=print_json if as_json else _show_event,
        )
        with contextlib.closing(joiner), cli.signals_end(joiner.stop):
            ready = {"event": "ready", "robot": robot, "namespace": place.name, "connect": list(places.connect)}
            say(as_json, ready, f"robot {robot} appears in namespace {place.name!r}, {places} (Ctrl-C ends)")
            shown: dict[str, str] = {}

            def report(bridge: BridgeState) -> None:
                if as_json:
                    print_json({"event": "status"} | as_data(bridge))
                else:
                    cli.echo_changes(shown, {name: service.state for name, service in bridge.services.items()})

            joiner.run(report)


def _show_event(event: dict[str, Any]) -> None:
    if event["event"] == "trouble":
        cli.warn(event["why"])
    elif event["event"] == "mode":
        echo(f"{event['service']}: {_MODES[event['mode']]}")
    else:
        echo(f"robot {event['robot']}: {event['event']}{': ' + event['why'] if 'why' in event else ''}")


main = partial(cli.run, command, goes_on=True)
