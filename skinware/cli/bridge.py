"""``skin-bridge``: a namespace of one machine on another, in a ROS 2 graph, and as ports of YARP."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from skinware.cli import bridge_ros2, bridge_yarp
from skinware.cli._command import (
    CONTEXT_SETTINGS,
    caller_option,
    examples,
    insecure_option,
    json_option,
    namespace_option,
    run,
    signals_end,
    tls_option,
    version_option,
    warn,
)
from skinware.cli._regions import regions_asked_for, regions_option
from skinware.cli._robots import list_robots, route
from skinware.cli._terminal import echo, print_json

if TYPE_CHECKING:
    from skinware.bridge import Server, Wish
    from skinware.bridge_state import BridgeState

_PORT = 7448


@click.group("skin-bridge", context_settings=CONTEXT_SETTINGS)
@version_option
def command() -> None:
    """Have the drivers and services of one machine on another, as if they ran there; or in a ROS 2 graph, or in YARP.

    On the robot: skin-bridge serve. Elsewhere: skin-bridge join. For many robots: skin-bridge list, skin-bridge route.
    For ROS 2: skin-bridge ros2. For YARP: skin-bridge yarp.
    """


for _each in (route, list_robots, bridge_ros2.command, bridge_yarp.command):
    command.add_command(_each)


@command.command(
    "serve",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-bridge serve --robot icub                                     for programs of this machine",
        "skin-bridge serve --robot icub --listen tcp/0.0.0.0:7448 --insecure  for all in a network that is trusted",
        "skin-bridge serve --robot icub --listen tls/0.0.0.0:7448 --tls certs  for all with a certificate",
    ),
)
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option("--robot", required=True, metavar="R", help="What others call this robot.")
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help=f"Where others connect: tcp/HOST:PORT.  [default: tcp/127.0.0.1:{_PORT}]",
)
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="A router to connect to, instead of being called.")
@tls_option
@caller_option
@insecure_option
@namespace_option
@json_option
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
    """Let other machines join drivers and services NAME..., or all there are and come.

    A receiver that is slow, stopped or gone costs neither the drivers nor other receivers anything.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.bridge import DEFAULT_LISTEN, Link, Rules, Server, endpoints
    from skinware.bridge.messages import Keys
    from skinware.memory.namespace import Namespace, check_name

    for name in names:
        check_name(name, "service")
    Keys(robot)  # what is no name is refused before anything is opened
    place = Namespace(namespace)
    places = endpoints(
        listen=listen or (() if connect else (DEFAULT_LISTEN,)),
        connect=connect,
        tls=tls,
        rules=Rules(callers),
        insecure=insecure,
    )
    with contextlib.closing(Link(places)) as link:
        server = Server(robot, link, place, names or None, callers=callers)
        with contextlib.closing(server), signals_end(server.stop):
            if as_json:
                told = {"robot": robot, "namespace": place.name}
                print_json({"event": "ready", **told, "listen": list(places.listen), "connect": list(places.connect)})
            else:
                echo(f"robot {robot}: namespace {place.name!r}, {places} (Ctrl-C ends)")
            status = _Serving(server, as_json)
            server.run(status.tell)


class _Serving:
    """Tells each second what was sent."""

    def __init__(self, server: Server, as_json: bool) -> None:
        self._server, self._as_json = server, as_json
        self._before: dict[str, int] = {}
        self._known: dict[str, str] = {}

    def tell(self) -> None:
        frames = self._server.frames()
        if self._as_json:
            services = {
                name: {"state": state, "rate_hz": count - self._before.get(name, 0), "pulled_by": pullers}
                for name, (state, count, pullers) in frames.items()
            }
            guard = self._server.guard
            counts = {"lost": self._server.lost, "refused": guard.count, "last_refused": guard.last or None}
            print_json({"event": "status", **counts, "services": services})
        for name, (state, count, _) in frames.items():
            if not self._as_json and self._known.get(name) != state:
                echo(f"{name}: {state}")
            self._known[name], self._before[name] = state, count


@command.command(
    "join",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
        "skin-bridge join icub --connect tcp/192.168.1.10:7448     then: skin-top --namespace icub",
        "skin-bridge join icub --connect tls/icub.local:7448 --tls certs --into default",
        "skin-bridge join icub --connect tcp/192.168.1.10:7448 --region palm --into palm   only those sensors travel",
    ),
)
@click.argument("robot", metavar="R")
@click.option("--connect", multiple=True, required=True, metavar="ENDPOINT", help="Where it is: tcp/HOST:PORT.")
@click.option("--into", metavar="NAMESPACE", help="Namespace in which its services appear.  [default: R]")
@tls_option
@click.option(
    "--mode",
    type=click.Choice(["auto", "push", "pull"]),
    default="auto",
    show_default=True,
    help="Every frame as it comes, or only the newest as fast as the link takes them.",
)
@click.option("--patch", "patches", metavar="PATCH", multiple=True, help="Only sensors of PATCH; may be repeated.")
@click.option(
    "--region", "in_regions", metavar="REGION", multiple=True, help="Only sensors in REGION; may be repeated."
)
@regions_option
@json_option
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
    """Have the services of robot R here: same names, structures, states and operations, for all programs and readers.

    Times are moved to the clock of this machine. What the link cannot take is left out, and counted as lost. With
    --patch or --region only those sensors of its drivers travel, and no other services.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.bridge import Joiner, Link, endpoints
    from skinware.bridge.endpoints import why_unreachable
    from skinware.bridge.messages import Keys
    from skinware.memory.namespace import Namespace

    wish = _wish(patches, in_regions, region_files)
    Keys(robot)  # likewise
    place = Namespace(into or robot)
    places = endpoints(connect=connect, tls=tls)
    with contextlib.closing(Link(places)) as link:
        status = _Joined(as_json)
        joiner = Joiner(
            robot,
            link,
            place,
            mode=None if mode == "auto" else mode,
            wish=wish,
            why_not=lambda: " ".join(filter(None, (why_unreachable(at, tls) for at in places.connect))),
            on_event=status.happened,
        )
        with contextlib.closing(joiner), signals_end(joiner.stop):
            if as_json:
                print_json({"event": "ready", "robot": robot, "namespace": place.name, "connect": list(places.connect)})
            else:
                echo(f"robot {robot} appears in namespace {place.name!r}, {places} (Ctrl-C ends)")
            joiner.run(status.tell)


def _wish(patches: tuple[str, ...], in_regions: tuple[str, ...], region_files: tuple[Path, ...]) -> Wish | None:
    """Which sensors are wanted; None: all, and all services."""
    from skinware.bridge import Wish

    regions = regions_asked_for(in_regions, region_files)
    return Wish(patches, in_regions, tuple(regions)) if patches or in_regions else None


class _Joined:
    """Tells each second what came, and what happens at once."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._known: dict[str, tuple[str, str]] = {}

    def happened(self, event: dict[str, Any]) -> None:
        if self._as_json:
            print_json(event)
        elif event["event"] == "trouble":
            warn(event["why"])
        elif event["event"] == "mode":
            echo(f"{event['service']}: {_MODES[event['mode']]}")
        else:
            echo(f"robot {event['robot']}: {event['event']}{': ' + event['why'] if 'why' in event else ''}")

    def tell(self, bridge: BridgeState) -> None:
        from skinware.views.bridges import as_data

        for name, service in bridge.services.items():
            shown = service.state, service.mode
            if not self._as_json and self._known.get(name) != shown:
                echo(f"{name}: {service.state}")
            self._known[name] = shown
        if self._as_json:
            print_json({"event": "status"} | as_data(bridge))


_MODES = {
    "push": "the link is fast: every frame comes as it is published",
    "pull": "frames wait on the link: the newest are asked for, as many as it takes",
}


def main() -> None:
    run(command, goes_on=True)
