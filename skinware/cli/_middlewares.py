"""``skin-bridge ros2``, ``yarp``, ``rerun`` and ``foxglove``: publish drivers in middlewares and viewers of others."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json, say
from skinware.errors import ConfigurationError

if TYPE_CHECKING:
    from skinware.conversion.live import Sink
    from skinware.ros2.transport import Node
    from skinware.yarp.names import NameServer

log = logging.getLogger(__name__)


@click.command(
    "ros2",
    epilog=cli.examples(
        "skin-bridge ros2                                       then, where ROS is: ros2 topic list",
        "skin-bridge ros2 --rmw zenoh                           for nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp",
        "skin-bridge ros2 arm --domain 7 --ros-namespace /icub  /icub/skin/arm/points/pressure ... in domain 7",
    ),
)
@cli.names_argument
@click.option(
    "--rmw",
    type=click.Choice(["dds", "zenoh"]),
    default="dds",
    help="Middleware of the graph: zenoh for nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp.",
)
@click.option(
    "--connect",
    multiple=True,
    metavar="ENDPOINT",
    help="A router, with --rmw zenoh: tcp/HOST:PORT.  [default: tcp/127.0.0.1:7447]",
)
@click.option(
    "--interface",
    "interfaces",
    multiple=True,
    metavar="NAME",
    help="A network to use, with --rmw dds: eth0, or an address of this machine; may be repeated.  [default:"
    " $CYCLONEDDS_URI, else this machine alone]",
)
@click.option(
    "--domain",
    type=int,
    metavar="N",
    envvar="ROS_DOMAIN_ID",
    default=0,
    show_default=False,
    help="Id of the graph.  [default: $ROS_DOMAIN_ID, else 0]",
)
@click.option("--ros-namespace", metavar="NAME", default="/", help="Namespace of the topics: /robot_1.")
@click.option(
    "--distro",
    type=click.Choice(["humble", "jazzy"]),
    default=lambda: "humble" if os.environ.get("ROS_DISTRO") == "humble" else "jazzy",
    show_default=False,
    help="Release of the other nodes; jazzy: Iron and later.  [default: $ROS_DISTRO, else jazzy]",
)
@click.option("--rate", type=float, default=20.0, metavar="HZ", help="Highest rate of point clouds and images.")
@click.option("--tare", "with_tare", is_flag=True, help="Offer a service NAME/tare to everyone in the graph.")
@cli.namespace_option
@cli.json_option
def ros2(
    names: tuple[str, ...],
    rmw: str,
    connect: tuple[str, ...],
    interfaces: tuple[str, ...],
    domain: int,
    ros_namespace: str,
    distro: str,
    rate: float,
    with_tare: bool,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Publish drivers NAME..., or all, also later ones, in a ROS 2 graph. ROS need not be installed.

    The node publishes samples, point clouds, images and diagnostics of each driver. The graph can only read, unless you
    give --tare. Subscribers that are slow, stopped or gone cost the drivers nothing.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.conversion.showing import in_topic
    from skinware.memory.namespace import Namespace, check_name
    from skinware.ros2.serving import Ros2Server
    from skinware.ros2.transport import Distro, NodeIdentity

    if connect and rmw != "zenoh":
        raise click.UsageError("--connect is for --rmw zenoh: over DDS, nodes find each other without routers")
    if interfaces and rmw != "dds":
        raise click.UsageError("--interface is for --rmw dds: over zenoh, --connect says where the router is")
    for name in names:
        check_name(name, "driver")
    place = Namespace(namespace)
    identity = NodeIdentity(f"skinware_{in_topic(place.name)}", ros_namespace, domain, Distro(distro))
    shown: dict[str, str] = {}

    def report_router(is_there: bool, line: str) -> None:
        if as_json:
            print_json({"event": "router", "is_there": is_there, "why": line})
        else:
            (echo if is_there else cli.warn)(line)

    def report() -> None:
        drivers = server.drivers()
        if as_json:
            print_json({"event": "status", "drivers": {name: asdict(driver) for name, driver in drivers.items()}})
        else:
            cli.echo_changes(shown, {name: driver.state for name, driver in drivers.items()})

    if rmw == "zenoh":
        from skinware.bridge.endpoints import DEFAULT_ROUTER
        from skinware.ros2.rmw_zenoh import ZenohNode

        node: Node = ZenohNode(identity, connect=connect or (DEFAULT_ROUTER,), router_changed=report_router)
    else:
        from skinware.ros2.dds import DdsNode

        node = DdsNode(identity, interfaces)
    with contextlib.closing(node):
        server = Ros2Server(
            node,
            place,
            names,
            prefix=identity.prefix,
            rate_hz=rate,
            with_tare=with_tare,
            trouble=cli.warn,
        )
        with contextlib.closing(server), cli.signals_end(server.stop):
            where = f"{identity.prefix}/{identity.name}"
            ready = {"event": "ready", "rmw": rmw, "domain": domain, "node": where, "namespace": place.name}
            say(as_json, ready, f"node {where} in domain {domain} of ROS 2: namespace {place.name!r} (Ctrl-C ends)")
            server.run(report)


@click.command(
    "yarp",
    epilog=cli.examples(
        "skin-bridge yarp torso --yarp 4               then, with YARP: yarp read ... /skinware/torso",
        "skin-bridge yarp --yarp 3 --namespace calm --prefix /icub/skin --regions skin/left_arm.regions.toml",
        "skin-bridge yarp --yarp 4 --server 10.0.0.1:10000 --host 10.0.0.7   for a robot's network",
    ),
)
@cli.names_argument
@click.option("--prefix", default="/skinware", metavar="/P", help="Prefix of all port names.")
@click.option("--type", "type_name", default="pressure", metavar="TYPE", help="Sensor type.")
@click.option(
    "--full-scale",
    type=click.FloatRange(min=0, min_open=True),
    metavar="X",
    help="Physical value that becomes 255.  [default: the maximum of the type]",
)
@cli.regions_option("Make a port of each region of FILE; skin-import writes those of a robot; may be repeated.")
@click.option(
    "--server", metavar="HOST:PORT", help="YARP's name server.  [default: as yarp.conf says, else 127.0.0.1:10000]"
)
@click.option(
    "--yarp",
    "yarp",
    type=click.Choice(["3", "4"]),
    help="Major version of the YARP of binary readers; without it, only text readers are served.",
)
@click.option("--host", default="127.0.0.1", metavar="HOST", help="Address to listen at.")
@cli.namespace_option
@cli.json_option
def yarp(
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
    """Publish drivers NAME..., or all, also later ones, as ports of YARP.

    Each sample is a vector of doubles, 0 to 255. A reader that is slow, stopped or gone misses vectors, and costs
    neither drivers nor other readers anything. YARP has no authentication: all programs that reach a port can read it,
    and can make it call other ports.

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
    yarp_server = YarpServer(place, settings, known_by, print_json if as_json else _show_port)
    with contextlib.closing(yarp_server), cli.signals_end(yarp_server.stop):
        address = f"{known_by.host}:{known_by.port}"
        ready = {"event": "ready", "namespace": place.name, "server": address, "listen": host}
        say(as_json, ready, f"namespace {place.name!r} as ports {settings.prefix}/..., {known_by} (Ctrl-C ends)")
        before: dict[str, int] = {}

        def report() -> None:
            ports = {}
            for name, port in yarp_server.ports().items():
                count = port.pop("messages")
                ports[name] = {"rate_hz": count - before.get(name, 0), **port}
                before[name] = count
            print_json({"event": "status", "missed": yarp_server.missed, "ports": ports})

        yarp_server.run(report if as_json else lambda: None)


def _name_server(text: str | None) -> NameServer:
    from skinware.yarp.names import DEFAULT_PORT, NameServer, configured_server

    if text is None:
        return NameServer(*configured_server())
    host, port = text.rsplit(":", 1) if ":" in text else (text, str(DEFAULT_PORT))
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise ConfigurationError(f"--server {text}: write HOST:PORT, such as 10.0.0.1:10000")
    return NameServer(host, int(port))


def _show_port(event: dict[str, Any]) -> None:
    if event["event"] == "trouble":
        cli.warn(f"{event['about']}: {event['why']}")
    else:
        echo(f"{event['port']}: driver {event['driver']}")


_RERUN, _FOXGLOVE = "rerun+http://127.0.0.1:9876/proxy", "tcp/127.0.0.1:8765"
_STOP_S, _BACKLOG = 3.0, 128
"""How long the end of a connection is waited for, and the messages that wait for a slow client at most."""

_rate_option = click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(0.1, 1000),
    default=30.0,
    metavar="HZ",
    help="Highest rate of snapshots.",
)


@click.command(
    "rerun",
    epilog=cli.examples(
        "skin-bridge rerun                 into the viewer that runs: rerun",
        "skin-bridge rerun arm -o arm.rrd  into a file",
    ),
)
@cli.names_argument
@click.option("--connect", metavar="URL", default=_RERUN, help="Viewer or server.")
@cli.output_option("Write this file instead.", name="file")
@_rate_option
@cli.namespace_option
@cli.json_option
def rerun(
    names: tuple[str, ...], connect: str, file: Path | None, rate_hz: float, namespace: str | None, as_json: bool
) -> None:
    """Show drivers NAME..., or all, also later ones, in Rerun: taxels with values and status, and contacts.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.conversion.tables import package

    rerun = package("rerun", "this", extra="rerun")  # before the sink, which imports it
    from skinware.conversion.live import RerunSink

    recording = rerun.RecordingStream("skinware")
    if file is None:
        recording.connect_grpc(connect)
        place = urlsplit(connect)
        try:
            socket.create_connection((place.hostname or "", place.port or 0), _STOP_S).close()
        except OSError as error:
            why = error.strerror or error
            log.warning("no viewer at %s yet (%s): start one, as with: rerun", connect, why)
    else:
        recording.save(file)
    _run(RerunSink(recording), names, rate_hz, namespace, as_json, connect if file is None else str(file))
    if file is None:
        _end(recording.disconnect)
    else:
        recording.disconnect()


@click.command(
    "foxglove",
    epilog=cli.examples("skin-bridge foxglove   then, in Foxglove: open a connection to ws://127.0.0.1:8765"),
)
@cli.names_argument
@click.option(
    "--listen",
    default=_FOXGLOVE,
    metavar="ENDPOINT",
    help="Where viewers connect: tcp/HOST:PORT, port 0: any that is free; anybody who reaches it sees the skin.",
)
@_rate_option
@cli.namespace_option
@cli.json_option
def foxglove(names: tuple[str, ...], listen: str, rate_hz: float, namespace: str | None, as_json: bool) -> None:
    """Show drivers NAME..., or all, also later ones, in Foxglove: point clouds, images and states.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.bridge.endpoints import split_endpoint
    from skinware.conversion.tables import package

    protocol, host, port = split_endpoint(listen, least_port=0)
    if protocol != "tcp":
        raise ConfigurationError(f"{listen!r}: viewers connect without TLS: give tcp/HOST:PORT")
    foxglove = package("foxglove", "this", extra="foxglove")  # before the sink, which imports it
    from skinware.conversion.live import FoxgloveSink

    context = foxglove.Context()
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # else a client that leaves costs many lines
    try:
        server = foxglove.start_server(
            name="skinware", host=host, port=port, context=context, message_backlog_size=_BACKLOG
        )
    except RuntimeError as error:
        raise click.ClickException(f"{listen}: {error}") from None
    where = f"ws://{f'[{host}]' if ':' in host else host}:{server.port}"
    try:
        _run(FoxgloveSink(context), names, rate_hz, namespace, as_json, where)
    finally:
        _end(server.stop)


def _end(stop: Callable[[], object]) -> None:
    """End a connection, or the program without it: other ends that say nothing are waited for without end."""
    ending = Thread(target=stop, daemon=True)
    ending.start()
    ending.join(_STOP_S)
    if ending.is_alive():
        os._exit(cli.EXIT_DONE)


def _run(sink: Sink, names: tuple[str, ...], rate_hz: float, namespace: str | None, as_json: bool, where: str) -> None:
    from skinware.conversion.live import stream
    from skinware.memory.namespace import Namespace, check_name

    for name in names:
        check_name(name, "driver")
    place, stop = Namespace(namespace), Event()
    with cli.signals_end(stop.set):
        ready = {"event": "ready", "to": where, "namespace": place.name}
        say(as_json, ready, f"namespace {place.name!r} to {where} (Ctrl-C ends)")
        stream(place, names, sink, rate_hz, stop)
