"""Both ends of a bridge in this process."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skinware import DriverWriter, Structure
from skinware.bridge.joining import Joiner
from skinware.bridge.messages import Wish
from skinware.bridge.serving import Server
from skinware.memory.namespace import Namespace
from skinware.realtime import now_ns
from skinware.sensor_types import PRESSURE
from skinware_drivers.testing.plugin import files_left
from tests.bridge.net import Net, NetLink

ROBOT = "walle"


def structure(sensors: int = 64, dtype: str = "u2") -> Structure:
    """A patch of modules of eight sensors; the last may have fewer."""
    modules = -(-sensors // 8)
    return Structure(
        types=[PRESSURE.measured(unit="counts")],
        buses=["can0"],
        patch_name=["palm"],
        patch_bus=[0],
        module_patch=[0] * modules,
        module_kind=["triangle"] * modules,
        sensor_uid=np.arange(sensors),
        sensor_type=[PRESSURE.id] * sensors,
        sensor_module=np.arange(sensors) // 8,
        dtype=dtype,
    )


def publish(writer: DriverWriter, value: int | None = None) -> int:
    """A frame of one value in all sensors, its sequence by default; its sequence."""
    if value is None:
        value = writer.sequence + 1
    columns = writer.begin(from_last=True)
    time_ns = now_ns()
    columns["values"][:] = value
    columns["status"][:] = 0
    columns["module_time_ns"][:] = time_ns
    writer.commit(time_ns)
    return writer.sequence


@dataclass
class Ends:
    """What runs.

    Attributes:
        net: between them.
        there: namespace of the robot.
        here: the one in which its services appear.
        events: what the joiner told.
    """

    net: Net
    there: Namespace
    here: Namespace
    joiner: Joiner
    events: list[dict[str, Any]] = field(default_factory=list)


@contextmanager
def serving(net: Net, namespace: Namespace, robot: str = ROBOT) -> Iterator[Server]:
    link = NetLink(net)
    server = Server(robot, link, namespace)
    thread = threading.Thread(target=server.run, name="serve")
    thread.start()
    try:
        yield server
    finally:
        server.stop()
        thread.join()
        link.close()
        server.close()


@contextmanager
def network() -> Iterator[Net]:
    net = Net()
    try:
        yield net
    finally:
        net.close()


@contextmanager
def joined(namespace: Namespace, mode: str | None = None, robot: str = ROBOT) -> Iterator[Ends]:
    """A joiner of what is served over a new network, into a namespace of its own."""
    with network() as net, joining(net, namespace, mode, robot) as ends:
        yield ends


@contextmanager
def joining(
    net: Net,
    namespace: Namespace,
    mode: str | None = None,
    robot: str = ROBOT,
    *,
    wish: Wish | None = None,
    into: str = "here",
    is_killed: bool = False,
) -> Iterator[Ends]:
    """A joiner of what is served over a network, into a namespace of its own.

    One that is killed in the end leaves there what it has published.
    """
    here = Namespace(f"{namespace.name}-{into}")
    events: list[dict[str, Any]] = []
    link = NetLink(net)
    joiner = Joiner(robot, link, here, mode=mode, wish=wish, on_event=events.append)
    thread = threading.Thread(target=joiner.run, name="join")
    thread.start()
    try:
        yield Ends(net, namespace, here, joiner, events)
    finally:
        joiner.stop()
        thread.join()
        link.close()
        net.idle()
        if is_killed:
            _desert(joiner)
        joiner.close()
    if not is_killed:
        left = files_left(here.path)
        shutil.rmtree(here.path, ignore_errors=True)
        assert not left


def _desert(joiner: Joiner) -> None:
    """Leave its files as the kernel does if its process is killed."""
    mirror = joiner._mirror
    for service in mirror._services.values():
        service.writer.desert()
    mirror._services.clear()
    mirror._deserted.clear()
    if joiner._state_writer is not None:
        joiner._state_writer.desert()
