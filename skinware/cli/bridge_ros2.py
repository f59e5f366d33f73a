"""``skin-bridge ros2``: drivers in a ROS 2 graph."""

from __future__ import annotations

import contextlib
import os
from dataclasses import asdict
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    from collections.abc import Callable

    from skinware.ros2.serving import Ros2Server
    from skinware.ros2.transport import Identity, Node


@click.command(
    "ros2",
    context_settings=CONTEXT_SETTINGS,
    epilog=examples(
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
    help="What carries the graph's messages: zenoh for nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp.",
)
@click.option(
    "--connect",
    multiple=True,
    metavar="ENDPOINT",
    help="A router, with --rmw zenoh: tcp/HOST:PORT.  [default: tcp/localhost:7447]",
)
@click.option(
    "--interface",
    "interfaces",
    multiple=True,
    metavar="NAME",
    help="A network to use, over DDS: eth0, or an address of this machine; may be repeated.  [default: $CYCLONEDDS_URI,"
    " else this machine alone]",
)
@click.option(
    "--domain",
    type=int,
    metavar="N",
    envvar="ROS_DOMAIN_ID",
    default=0,
    help="Which graph.  [default: $ROS_DOMAIN_ID, else 0]",
)
@click.option("--ros-namespace", metavar="NAME", default="/", show_default=True, help="Before all topics: /robot_1.")
@click.option(
    "--distro",
    type=click.Choice(["humble", "jazzy"]),
    default=lambda: "humble" if os.environ.get("ROS_DISTRO") == "humble" else "jazzy",
    help="Who is to understand it: Humble, or Jazzy and all from Iron on.  [default: as $ROS_DISTRO, else jazzy]",
)
@click.option(
    "--rate", type=float, default=20.0, show_default=True, metavar="HZ", help="Of point clouds and images, at most."
)
@click.option(
    "--root-frame",
    default="",
    metavar="NAME",
    help="Publish /tf_static: all coordinate frames of the drivers at the origin of NAME, unturned; where no other node"
    " publishes where they are.",
)
@click.option("--tare", "with_tare", is_flag=True, help="Offer a service NAME/tare to everyone in the graph.")
@namespace_option
@json_option
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
    """Have drivers NAME..., or all there are and come, in a ROS 2 graph. ROS need not be installed.

    The node publishes each driver's frames, point clouds, images and diagnostics. The graph can only read,
    unless you give --tare. Subscribers that are slow, stopped or gone cost the drivers nothing.

    Exit status: 0 interrupted, 1 failed, 2 wrong usage.
    """
    from skinware.memory.namespace import Namespace, check_name
    from skinware.ros2.serving import Ros2Server
    from skinware.ros2.transport import Distro, Identity

    if connect and rmw != "zenoh":
        raise click.UsageError("--connect is for --rmw zenoh: over DDS, nodes find each other without routers")
    if interfaces and rmw != "dds":
        raise click.UsageError("--interface is for --rmw dds: over zenoh, --connect says where the router is")
    for name in names:
        check_name(name, "driver")
    place = Namespace(namespace)
    identity = Identity(f"skinware_{_plain(place.name)}", ros_namespace, domain, Distro(distro))
    with contextlib.closing(_node(rmw, identity, connect, interfaces, _Router(as_json).tell)) as node:
        server = Ros2Server(
            node,
            place,
            names,
            prefix=identity.prefix,
            rate_hz=rate,
            root_frame=root_frame,
            with_tare=with_tare,
            trouble=warn,
        )
        with contextlib.closing(server), signals_end(server.stop):
            where = f"{identity.prefix}/{identity.name}"
            if as_json:
                told = {"rmw": rmw, "domain": domain, "node": where, "namespace": place.name}
                print_json({"event": "ready", **told})
            else:
                echo(f"node {where} in domain {domain} of ROS 2: namespace {place.name!r} (Ctrl-C ends)")
            status = _Status(server, as_json)
            server.run(status.tell)


def _node(
    rmw: str,
    identity: Identity,
    connect: tuple[str, ...],
    interfaces: tuple[str, ...],
    tell: Callable[[bool, str], None],
) -> Node:
    if rmw == "zenoh":
        from skinware.ros2.rmw_zenoh import ROUTER, ZenohNode

        return ZenohNode(identity, connect=connect or (ROUTER,), router_changed=tell)
    from skinware.ros2.dds import DdsNode

    return DdsNode(identity, interfaces)


def _plain(name: str) -> str:
    from skinware.conversion.showing import in_topic

    return in_topic(name)


class _Router:
    """Tells whether there is one."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json

    def tell(self, is_there: bool, line: str) -> None:
        if self._as_json:
            print_json({"event": "router", "is_there": is_there, "why": line})
        elif is_there:
            echo(line)
        else:
            warn(line)


class _Status:
    """Tells each second what was told."""

    def __init__(self, server: Ros2Server, as_json: bool) -> None:
        self._server, self._as_json = server, as_json
        self._known: dict[str, str] = {}

    def tell(self) -> None:
        drivers = self._server.drivers()
        if self._as_json:
            print_json({"event": "status", "drivers": {name: asdict(told) for name, told in drivers.items()}})
        for name, told in drivers.items():
            if not self._as_json and self._known.get(name) != told.state:
                echo(f"{name}: {told.state}")
            self._known[name] = told.state
