"""What a driver is in a ROS 2 graph: its topics, over all of its generations."""

from __future__ import annotations

import time

import numpy as np

from skinware.conversion import ros_messages
from skinware.conversion.showing import Showing, in_topic
from skinware.conversion.tables import sensor_names
from skinware.driver_snapshot import DriverSnapshot
from skinware.realtime import now_ns
from skinware.ros2 import types
from skinware.ros2.transport import Node, Publisher, Qos
from skinware.status import Status
from skinware.structure import Structure

_LATCHED = Qos(depth=1, latched=True)
_STALE = np.uint8(Status.STALE)


class DriverTopics:
    """The topics of a driver.

    Args:
        node: that tells them.
        prefix: before all topics: empty or ``/robot_1``.
        name: of the driver.

    Attributes:
        messages: that were sent.
        left_out: that were not, since a subscriber is too slow.
    """

    def __init__(self, node: Node, prefix: str, name: str) -> None:
        self._node, self._prefix, self._name = node, prefix, name
        self.messages = self.left_out = 0
        self._structure: Structure | None = None
        self._generation = 0
        self._showing: Showing | None = None
        self._pictures: dict[str, Publisher] = {}
        self._frames = node.publisher(f"{self.base}/frame", types.SKIN_FRAME, Qos())
        self._sensors = node.publisher(f"{self.base}/sensors", types.SENSORS, _LATCHED)

    @property
    def base(self) -> str:
        return f"{self._prefix}/skin/{in_topic(self._name)}"

    @property
    def wants_frames(self) -> bool:
        return self._frames.is_wanted

    def tell(self, frame: DriverSnapshot, *, with_pictures: bool, is_last: bool = False) -> None:
        """Send what somebody wants of a frame.

        Args:
            frame: it.
            with_pictures: point clouds and images, too.
            is_last: nothing newer comes for now: all of it is stale.
        """
        time_ns = time.time_ns() - (now_ns() - frame.published_ns)
        status = frame.status | _STALE if is_last else frame.status
        if frame.generation != self._generation:
            self._take_generation(frame, time_ns)
        if self._frames.is_wanted:
            self._send(self._frames, ros_messages.skin_frame(frame, time_ns, status))
        if with_pictures and self._showing is not None:
            wanted = {topic for topic, picture in self._pictures.items() if picture.is_wanted}
            for message in self._showing.pictures(frame, time_ns, status=status, wanted=wanted.__contains__):
                self._send(self._pictures[message.topic], message.data)

    def close(self) -> None:
        for publisher in (self._frames, self._sensors, *self._pictures.values()):
            publisher.close()

    def _take_generation(self, frame: DriverSnapshot, time_ns: int) -> None:
        structure, self._generation = frame.structure, frame.generation
        if structure is not self._structure:
            self._structure, self._showing = structure, Showing(self._name, structure)
            topics = self._showing.topics
            for topic in self._pictures.keys() - topics.keys():
                self._pictures.pop(topic).close()
            for topic, schema in topics.items():
                if topic not in self._pictures:
                    message_type = types.OF_SCHEMAS[schema.name]
                    self._pictures[topic] = self._node.publisher(self._prefix + topic, message_type, Qos())
        told = ros_messages.sensors(structure, sensor_names(structure), frame.generation, time_ns)
        self._send(self._sensors, told)

    def _send(self, publisher: Publisher, message: bytes) -> None:
        if publisher.publish(message):
            self.messages += 1
        else:
            self.left_out += 1
