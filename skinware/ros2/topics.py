"""The topics of a node: those of each driver, over all of its generations, and ``/tf_static``."""

from __future__ import annotations

import time

import numpy as np

from skinware.conversion import ros_messages
from skinware.conversion.showing import Showing, in_topic
from skinware.conversion.tables import sensor_names
from skinware.driver_snapshot import DriverSnapshot
from skinware.realtime import now_ns
from skinware.ros2 import messages
from skinware.ros2.transport import Node, Qos, TopicPublisher
from skinware.status import Status
from skinware.structure import Structure

_LATCHED = Qos(depth=1, latched=True)
_STALE = np.uint8(Status.STALE)


class DriverTopics:
    """The topics of a driver, which begin with ``base``.

    Attributes:
        left_out: number of those that were not sent, because a subscriber is too slow.
    """

    def __init__(self, node: Node, prefix: str, name: str) -> None:
        self._node, self._prefix, self._name = node, prefix, name
        self.base: str = f"{prefix}/skin/{in_topic(name)}"
        self.messages = self.left_out = 0
        self._structure: Structure | None = None
        self._generation = 0
        self._showing: Showing | None = None
        self._pictures: dict[str, TopicPublisher] = {}
        self._frames = node.publisher(f"{self.base}/frame", messages.SKIN_FRAME, Qos())
        self._sensors = node.publisher(f"{self.base}/sensors", messages.SENSORS, _LATCHED)

    @property
    def wants_frames(self) -> bool:
        """Whether there are subscribers that want each frame."""
        return self._frames.is_wanted

    def publish(self, frame: DriverSnapshot, *, with_pictures: bool, is_last: bool = False) -> None:
        """Publish a frame under all topics that have subscribers.

        Args:
            is_last: no newer frame comes for now: all sensors are stale.
        """
        time_ns = time.time_ns() - (now_ns() - frame.published_ns)
        status = frame.status | _STALE if is_last else frame.status
        if frame.generation != self._generation:
            self._begin(frame, time_ns)
        if self._frames.is_wanted:
            self._send(self._frames, ros_messages.skin_frame(frame, time_ns, status))
        if with_pictures and self._showing is not None:
            wanted = {topic for topic, picture in self._pictures.items() if picture.is_wanted}
            for message in self._showing.pictures(frame, time_ns, status=status, wanted=wanted.__contains__):
                self._send(self._pictures[message.topic], message.data)

    def close(self) -> None:
        for publisher in (self._frames, self._sensors, *self._pictures.values()):
            publisher.close()

    def _begin(self, frame: DriverSnapshot, time_ns: int) -> None:
        """Publish the sensors of a new generation; open and close topics of pictures."""
        structure, self._generation = frame.structure, frame.generation
        if structure is not self._structure:
            self._structure, self._showing = structure, Showing(self._name, structure)
            topics = self._showing.topics
            for topic in self._pictures.keys() - topics.keys():
                self._pictures.pop(topic).close()
            for topic, schema in topics.items():
                if topic not in self._pictures:
                    message_type = messages.OF_SCHEMAS[schema.name]
                    self._pictures[topic] = self._node.publisher(self._prefix + topic, message_type, Qos())
        sensors = ros_messages.sensors(structure, sensor_names(structure), frame.generation, time_ns)
        self._send(self._sensors, sensors)

    def _send(self, publisher: TopicPublisher, message: bytes) -> None:
        if publisher.publish(message):
            self.messages += 1
        else:
            self.left_out += 1


class Transforms:
    """Publishes a static transform from a root to each coordinate frame: at its origin, without rotation.

    Skinware does not know where coordinate frames are relative to each other.
    """

    def __init__(self, node: Node, root: str) -> None:
        self._root = root
        self._frames: set[str] = set()
        self._publisher = node.publisher("/tf_static", messages.TRANSFORMS, _LATCHED)

    def add(self, structure: Structure) -> None:
        """Publish the frames of a driver's sensors together with those of other drivers, if any is new."""
        geometry = structure.geometry
        new = set() if geometry is None else set(geometry.frame[geometry.known].tolist()) - {"", self._root}
        if new - self._frames:
            self._frames |= new
            self._publisher.publish(messages.transforms(self._root, sorted(self._frames), time.time_ns()))

    def close(self) -> None:
        self._publisher.close()
