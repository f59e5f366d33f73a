"""Coordinate frames of a skin's sensors, as ``/tf_static`` publishes them below a frame that the user names."""

from __future__ import annotations

import time
from collections.abc import Iterable

from skinware.conversion.ros_messages import Cdr
from skinware.ros2 import types
from skinware.ros2.transport import Node, Qos
from skinware.structure import Structure

TOPIC = "/tf_static"
_AT_ITS_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""x, y, z (m), and the quaternion x, y, z, w of no rotation."""


class Transforms:
    """Publishes a static transform from a root to each coordinate frame: without turn, at its origin.

    Skinware does not know where coordinate frames are to each other.

    Args:
        node: publishes them.
        root: name of the parent of all frames.
    """

    def __init__(self, node: Node, root: str) -> None:
        self._root = root
        self._frames: set[str] = set()
        self._publisher = node.publisher(TOPIC, types.TRANSFORMS, Qos(depth=1, latched=True))

    def add(self, structure: Structure) -> None:
        """Publish the frames of a driver's sensors, with those of other drivers, if any is new."""
        geometry = structure.geometry
        new = set() if geometry is None else set(geometry.frame[geometry.known].tolist()) - {"", self._root}
        if new - self._frames:
            self._frames |= new
            self._publisher.publish(message(self._root, sorted(self._frames), time.time_ns()))

    def close(self) -> None:
        self._publisher.close()


def message(root: str, frames: Iterable[str], time_ns: int) -> bytes:
    """Make a ``tf2_msgs/TFMessage`` of frames that coincide with their parent, in CDR.

    Args:
        root: name of the parent.
        frames: names of its children.
        time_ns: wall clock.
    """
    children = list(frames)
    cdr = Cdr().numbers("I", len(children))
    for child in children:
        cdr.header(time_ns, root).text(child).numbers("d", *_AT_ITS_ORIGIN)
    return cdr.done()
