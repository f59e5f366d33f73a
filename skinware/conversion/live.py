"""Show drivers live in other people's viewers: Rerun and Foxglove."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection
from threading import Event
from typing import TYPE_CHECKING, Protocol

import numpy as np

from skinware.conversion.showing import Showing
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.views.following import Follower, Origin, ShownDriver
from skinware.views.live import places_of
from skinware.views.looks import Look
from skinware.views.scene import Scene

if TYPE_CHECKING:
    import foxglove
    import rerun

log = logging.getLogger(__name__)

_RAMP = "352b5c 40407f 3b5b8e 2f738e 23898e 22a085 44bb72 7fd150 c2df2c fde725"
"""Colours from the lowest to the highest level, those of the page."""
_NO_VALUE = (96, 96, 96)
_ANCHORS = np.array([list(bytes.fromhex(colour)) for colour in _RAMP.split()], np.float64)
_AT = np.linspace(0, len(_ANCHORS) - 1, 251)
_COLOURS = np.array([np.interp(_AT, range(len(_ANCHORS)), channel) for channel in _ANCHORS.T]).T.round()
_COLOURS = np.concatenate([_COLOURS, np.tile(_NO_VALUE, (5, 1))]).astype(np.uint8)
"""(256, 3) by level; see :mod:`skinware.views.quantities`."""


class Sink(Protocol):
    def arrange(self, scene: Scene, drivers: Collection[ShownDriver]) -> None:
        """Take the places of all taxels, whenever drivers or structures change."""

    def show(self, driver: ShownDriver, wall_ns: int) -> None:
        """Show the newest snapshot of a driver, published at this time of day, ns."""


def stream(namespace: Namespace, names: Collection[str], sink: Sink, rate_hz: float, stop: Event) -> None:
    """Show drivers, also later ones, until ``stop`` is set.

    Args:
        names: of the drivers; empty: all.
    """
    calm = None if namespace.name == namespace.calm_name else Namespace(namespace.calm_name)
    follower, edition = Follower(Origin(namespace, tuple(names), calm)), 0
    problem: str | None = None
    try:
        while not stop.wait(0.25 / rate_hz):
            newer = follower.take(round(NS_PER_S / rate_hz))
            if follower.problem != problem:
                problem = follower.problem
                log.warning("%s", problem or "the drivers can be read now")
            if follower.edition != edition:
                edition = follower.edition
                sink.arrange(follower.scene, follower.drivers)
            for driver in newer:
                if driver.frame is not None:
                    sink.show(driver, driver.frame.published_ns + time.time_ns() - now_ns())
    finally:
        follower.close()


class RerunSink:
    """Logs taxels as points, with their ``value`` in the unit of their type and their ``status``, and contacts."""

    def __init__(self, recording: rerun.RecordingStream) -> None:
        import rerun

        self._rerun, self._recording, self._look = rerun, recording, Look()
        self._scene: Scene | None = None

    def arrange(self, scene: Scene, drivers: Collection[ShownDriver]) -> None:
        self._scene = scene
        for driver in drivers:
            for quantity in driver.quantities:
                placed = scene.of(driver.name, quantity.name)
                points = self._rerun.Points3D(placed.position, radii=0.44 * placed.spacing_m)
                self._recording.log(f"skin/{driver.name}/{quantity.name}", points, static=True)

    def show(self, driver: ShownDriver, wall_ns: int) -> None:
        rerun, newest = self._rerun, driver.newest
        if newest is None:
            return
        self._recording.set_time("time", timestamp=np.datetime64(wall_ns, "ns"))
        for quantity in driver.quantities:
            self._look.quantity = quantity.name
            picture = self._look.picture(driver)
            if picture is not None:
                values = rerun.AnyValues(value=newest.physical(quantity), status=newest.status[quantity.where])
                colours = rerun.Points3D.from_fields(colors=_COLOURS[picture.levels])
                self._recording.log(f"skin/{driver.name}/{quantity.name}", colours, values)
        if newest.contacts is not None and self._scene is not None:
            places = places_of(newest.contacts, driver.structure)
            poses = [self._scene.pose(driver.name, place.contact.frame) for place in places]
            at = [pose[:3, :3] @ place.contact.cop_m + pose[:3, 3] for pose, place in zip(poses, places, strict=True)]
            labels = [f"{place.contact.id}: {place.contact.load:.4g} {place.unit}" for place in places]
            loads = rerun.AnyValues(load=[place.contact.load for place in places])
            self._recording.log(f"skin/{driver.name}/contacts", rerun.Points3D(at, labels=labels), loads)


class FoxgloveSink:
    """Logs the point clouds, images and states that recordings for Foxglove have."""

    def __init__(self, context: foxglove.Context) -> None:
        import foxglove

        self._foxglove, self._context = foxglove, context
        self._showing: dict[str, Showing] = {}
        self._channels: dict[str, foxglove.Channel] = {}

    def arrange(self, scene: Scene, drivers: Collection[ShownDriver]) -> None:  # noqa: ARG002 - topics have frames
        self._showing = {driver.name: Showing(driver.name, driver.structure) for driver in drivers}

    def show(self, driver: ShownDriver, wall_ns: int) -> None:
        if driver.frame is None:
            return
        for topic, encoding, schema, data in self._showing[driver.name].messages(driver.frame, wall_ns):
            if topic not in self._channels:
                described = self._foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
                self._channels[topic] = self._foxglove.Channel(
                    topic, schema=described, message_encoding=encoding, context=self._context
                )
            self._channels[topic].log(data, log_time=wall_ns)
