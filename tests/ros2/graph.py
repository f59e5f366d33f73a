"""A ROS 2 graph in this process: who listens, what comes, and what is asked."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from skinware.conversion.ros_messages import Cdr
from skinware.memory.namespace import Namespace
from skinware.ros2.serving import Ros2Server
from skinware.ros2.transport import Handler, MessageType, Qos, ServiceType
from tests.ros2.store import typestore

_REQUEST = Cdr().numbers("B", 0).done()


class FakePublisher:
    """See :class:`skinware.ros2.transport.TopicPublisher`."""

    def __init__(self, graph: Graph, topic: str, message_type: MessageType, qos: Qos) -> None:
        self._graph, self.topic, self.type, self.qos = graph, topic, message_type, qos

    @property
    def is_wanted(self) -> bool:
        return self.topic in self._graph.wanted or self.qos.latched

    def publish(self, message: bytes) -> bool:
        if self.topic in self._graph.slow:
            return False
        self._graph.add(self.topic, self._graph.store.deserialize_cdr(message, self.type.name))
        return True

    def close(self) -> None:
        self._graph.publishers.pop(self.topic, None)


class Graph:
    """A graph with one node.

    Attributes:
        wanted: topics that somebody listens to.
        slow: those whose subscribers take no more.
        publishers: by topic.
        services: handlers by name.
    """

    def __init__(self) -> None:
        self.store = typestore()
        self.wanted: set[str] = set()
        self.slow: set[str] = set()
        self.publishers: dict[str, FakePublisher] = {}
        self.services: dict[str, Handler] = {}
        self._heard: dict[str, list[Any]] = defaultdict(list)
        self._lock = threading.Lock()

    def publisher(self, topic: str, message_type: MessageType, qos: Qos) -> FakePublisher:
        assert topic not in self.publishers
        self.publishers[topic] = FakePublisher(self, topic, message_type, qos)
        return self.publishers[topic]

    def service(self, name: str, service_type: ServiceType, handler: Handler) -> Callable[[], None]:
        assert service_type.name == "std_srvs/srv/Trigger"
        self.services[name] = handler

        def end() -> None:
            self.services.pop(name, None)

        return end

    def close(self) -> None:
        """Nothing is to be left by who used it."""
        assert not self.publishers
        assert not self.services

    def add(self, topic: str, message: Any) -> None:
        with self._lock:
            self._heard[topic].append(message)

    def heard(self, topic: str) -> list[Any]:
        """All messages of a topic so far."""
        with self._lock:
            return list(self._heard[topic])

    def call(self, name: str) -> Any:
        """The answer of a service."""
        return self.store.deserialize_cdr(self.services[name](_REQUEST), "std_srvs/srv/Trigger_Response")


@contextmanager
def served(namespace: Namespace, *names: str, **options: Any) -> Iterator[tuple[Graph, Ros2Server]]:
    graph = Graph()
    server = Ros2Server(graph, namespace, names, **options)
    thread = threading.Thread(target=server.run, name="ros2")
    thread.start()
    try:
        yield graph, server
    finally:
        server.stop()
        thread.join()
        server.close()
        graph.close()
