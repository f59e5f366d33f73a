"""``skin-bridge ros2``: publish drivers in a ROS 2 graph."""

from __future__ import annotations

import contextlib
import os
from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from skinware.cli import _command as cli
from skinware.cli._terminal import echo, print_json

if TYPE_CHECKING:
    from collections.abc import Callable

    from skinware.ros2.serving import Ros2Server
    from skinware.ros2.transport import Node, NodeIdentity


@click.command(
    "ros2",
    epilog=cli.examples(
        "skin-bridge ros2                                       then, where ROS is: ros2 topic list",
        "skin-bridge ros2 --rmw zenoh                           for nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp",
        "skin-bridge ros2 arm --domain 7 --ros-namespace /icub  /icub/skin/arm/points/pressure ... in domain 7",
    ),
)
@click.argument("names", metavar="[NAME]...", nargs=-1)
@click.option(
    "--rmw",
    type=click.Choice(["dds", "zenoh"]),
    default="dds",
    show_default=True,
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
    help="A network to use, with --rmw dds: eth0, or an address of this machine; repeatable.  [default:"
    " $CYCLONEDDS_URI, else this machine alone]",
)
@click.option(
    "--domain",
    type=int,
    metavar="N",
    envvar="ROS_DOMAIN_ID",
    default=0,
    help="Id of the graph.  [default: $ROS_DOMAIN_ID, else 0]",
)
@click.option(
    "--ros-namespace", metavar="NAME", default="/", show_default=True, help="Namespace of the topics: /robot_1."
)
@click.option(
    "--distro",
    type=click.Choice(["humble", "jazzy"]),
    default=lambda: "humble" if os.environ.get("ROS_DISTRO") == "humble" else "jazzy",
    help="Release of the other nodes; jazzy: Iron and later.  [default: $ROS_DISTRO, else jazzy]",
)
@click.option(
    "--rate", type=float, default=20.0, show_default=True, metavar="HZ", help="Highest rate of point clouds and images."
)
@click.option(
    "--root-frame",
    default="",
    metavar="NAME",
    help="Publish /tf_static, if no other node does: all coordinate frames of the drivers at the origin of NAME,"
    " without rotation.",
)
@click.option("--tare", "with_tare", is_flag=True, help="Offer a service NAME/tare to everyone in the graph.")
@cli.namespace_option
@cli.json_option
def command(
    names: tuple[str, ...],
    rmw: str,
    connect: tuple[str, ...],
    interfaces: tuple[str, ...],
    domain: int,
    ros_namespace: str,
    distro: str,
    rate: float,
    root_frame: str,
    with_tare: bool,
    namespace: str | None,
    as_json: bool,
) -> None:
    """Publish drivers NAME..., or all, also later ones, in a ROS 2 graph. ROS need not be installed.

    The node publishes frames, point clouds, images and diagnostics of each driver. The graph can only read, unless you
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
    with contextlib.closing(_node(rmw, identity, connect, interfaces, _router_report(as_json))) as node:
        server = Ros2Server(
            node,
            place,
            names,
            prefix=identity.prefix,
            rate_hz=rate,
            root_frame=root_frame,
            with_tare=with_tare,
            trouble=cli.warn,
        )
        with contextlib.closing(server), cli.signals_end(server.stop):
            where = f"{identity.prefix}/{identity.name}"
            if as_json:
                print_json({"event": "ready", "rmw": rmw, "domain": domain, "node": where, "namespace": place.name})
            else:
                echo(f"node {where} in domain {domain} of ROS 2: namespace {place.name!r} (Ctrl-C ends)")
            server.run(_status(server, as_json))


def _node(
    rmw: str,
    identity: NodeIdentity,
    connect: tuple[str, ...],
    interfaces: tuple[str, ...],
    router_changed: Callable[[bool, str], None],
) -> Node:
    if rmw == "zenoh":
        from skinware.ros2.rmw_zenoh import ROUTER, ZenohNode

        return ZenohNode(identity, connect=connect or (ROUTER,), router_changed=router_changed)
    from skinware.ros2.dds import DdsNode

    return DdsNode(identity, interfaces)


def _router_report(as_json: bool) -> Callable[[bool, str], None]:
    def report(is_there: bool, line: str) -> None:
        if as_json:
            print_json({"event": "router", "is_there": is_there, "why": line})
        else:
            (echo if is_there else cli.warn)(line)

    return report


def _status(server: Ros2Server, as_json: bool) -> Callable[[], None]:
    shown: dict[str, str] = {}

    def report() -> None:
        drivers = server.drivers()
        if as_json:
            print_json({"event": "status", "drivers": {name: asdict(driver) for name, driver in drivers.items()}})
            return
        cli.echo_changes(shown, {name: driver.state for name, driver in drivers.items()})

    return report
