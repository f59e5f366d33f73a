"""A node of a ROS 2 graph over DDS, for peers with rmw_cyclonedds or rmw_fastrtps.

Cyclone DDS gets messages as bytes: its own way, from Python objects, takes a hundred times as long for a point cloud.
No thread of DDS calls back: it would wait for the interpreter.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cache
from importlib.util import find_spec
from typing import Any

from skinware.errors import BridgeError, MissingExtra
from skinware.ros2 import messages
from skinware.ros2.messages import DISCOVERY_TOPIC, PARTICIPANT_DATA, endpoint_data, entities
from skinware.ros2.transport import Cdr, Handler, MessageType, NodeIdentity, Qos, ServiceType, TopicPublisher

if find_spec("cyclonedds") is None:
    raise MissingExtra.of("ROS 2 over DDS", "skinware[ros2]")

from cyclonedds.core import DDSException
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.qos import Qos as DdsQos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from skinware.ros2 import cyclone
from skinware.ros2.cyclone import WaitingThread, join, reason, struct_type
from skinware.ros_types import Definitions

_SERVICE_QOS = Qos(depth=10)
_REQUESTS_AT_ONCE = 16
_ENCAPSULATION = 4
_REQUEST_ID = {"guid": idl.uint64, "sequence": idl.int64}
_AFTER_ID = _ENCAPSULATION + 16
"""End of the header that rmw_cyclonedds writes before requests and responses."""


class DdsNode:
    """A :class:`skinware.ros2.transport.Node`.

    Args:
        interfaces: networks to use, by the name or address of an interface of this machine; empty: as
            ``CYCLONEDDS_URI`` says, or loopback alone if that is not set.

    Raises:
        ConfigurationError: ``interfaces`` are given and ``CYCLONEDDS_URI`` is set.
        BridgeError: the domain cannot be joined; the message says why.
    """

    def __init__(self, identity: NodeIdentity, interfaces: Sequence[str] = ()) -> None:
        self._identity = identity
        self._domain, self._participant = join(identity.domain, interfaces, DdsQos(Policy.Userdata(PARTICIPANT_DATA)))
        self._lock = threading.RLock()
        self._writers: list[_DdsWriter] = []
        self._services: list[_DdsService] = []
        self._answering = threading.Lock()
        self._waiting: WaitingThread | None = None
        self._info = self._writer(DISCOVERY_TOPIC, messages.PARTICIPANT, Qos(depth=1, latched=True), is_listed=False)
        self._publish_endpoints()

    def publisher(self, topic: str, message_type: MessageType, qos: Qos) -> TopicPublisher:
        writer = self._writer(f"rt{topic}", message_type, qos)
        self._publish_endpoints()
        return writer

    def service(self, name: str, service_type: ServiceType, handler: Handler) -> Callable[[], None]:
        with self._lock:
            reader = self._declare(DataReader, f"rq{name}Request", service_type.request, _SERVICE_QOS, with_id=True)
            writer = self._writer(f"rr{name}Reply", service_type.response, _SERVICE_QOS, with_id=True)
            if self._waiting is None:
                self._waiting = WaitingThread(self._participant, self._answer)
            service = _DdsService(reader, writer, handler)
            del reader  # or ``end`` would keep it
            with self._answering:
                self._services.append(service)
            self._waiting.watch(service.reader)
            self._publish_endpoints()

        def end() -> None:
            with self._lock:
                if service in self._services and self._waiting is not None:
                    with self._answering:
                        self._services.remove(service)
                    self._waiting.forget(service.reader)
                    service.close()
                    self._publish_endpoints()

        return end

    def close(self) -> None:
        with self._lock:
            if self._waiting is not None:
                self._waiting.close()
            for service in self._services:
                service.close()
            for writer in list(self._writers):
                writer.close()
            self._services.clear()
            self._info.close()
            self._participant = self._domain = self._waiting = None

    def _answer(self) -> None:
        with self._answering:
            for service in self._services:
                if self._waiting is not None and not self._waiting.is_over:
                    service.answer()

    def _writer(
        self,
        topic: str,
        message_type: MessageType,
        qos: Qos,
        *,
        with_id: bool = False,
        is_listed: bool = True,
    ) -> _DdsWriter:
        with self._lock:
            declared = self._declare(DataWriter, topic, message_type, qos, with_id=with_id)
            writer = _DdsWriter(declared, self._closed if is_listed else lambda _: None, qos.latched)
            if is_listed:
                self._writers.append(writer)
            return writer

    def _declare(
        self,
        kind: type[DataReader[Any] | DataWriter[Any]],
        topic: str,
        message_type: MessageType,
        qos: Qos,
        *,
        with_id: bool,
    ) -> Any:
        policies = DdsQos(
            Policy.Reliability.Reliable(max_blocking_time=0) if qos.reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if qos.latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(qos.depth),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(endpoint_data(message_type.hash, self._identity.distro)),
        )
        try:
            return kind(self._participant, Topic(self._participant, topic, _type(message_type, with_id)), policies)
        except DDSException as error:
            raise BridgeError(f"{topic}: {reason(error)}") from None

    def _closed(self, writer: _DdsWriter) -> None:
        with self._lock:
            if writer in self._writers:
                self._writers.remove(writer)
                self._publish_endpoints()

    def _publish_endpoints(self) -> None:
        with self._lock:
            if self._participant is not None:
                readers = [service.id for service in self._services]
                writers = [writer.id for writer in self._writers]
                self._info.publish(entities(self._identity, self._participant.guid.bytes, readers, writers))


class _DdsWriter:
    def __init__(self, writer: DataWriter[Any], closed: Callable[[_DdsWriter], None], is_latched: bool) -> None:
        self._writer: DataWriter[Any] | None = writer
        self._ref: int = writer._ref  # noqa: SLF001, for writing bytes
        self._closed, self._is_latched = closed, is_latched
        self._buffer = bytearray()
        self.id: bytes = writer.guid.bytes

    @property
    def is_wanted(self) -> bool:
        if self._writer is None:
            return False
        return self._is_latched or self._writer.get_publication_matched_status().current_count > 0

    def publish(self, message: Cdr) -> bool:
        writer = self._writer
        if writer is None:
            return False
        if cyclone.write_bytes is not None:
            return cyclone.write_bytes(self._ref, self._padded(message)) >= 0
        try:
            writer.write(writer.data_type.deserialize(message))
        except DDSException:
            return False
        return True

    def _padded(self, message: Cdr) -> bytes | bytearray:
        """Return it in whole words, in memory that is kept: a fresh copy of a large message takes ten times as long."""
        size = len(message) + -len(message) % 4
        if size == len(message):
            return message
        if len(self._buffer) != size:
            self._buffer = bytearray(size)
        self._buffer[: len(message)] = message
        return self._buffer

    def close(self) -> None:
        if self._writer is not None:
            self._writer = None  # which deletes it
            self._closed(self)


class _DdsService:
    def __init__(self, reader: DataReader[Any], writer: _DdsWriter, handler: Handler) -> None:
        self.reader, self._writer, self._handler = reader, writer, handler
        self.id: bytes = reader.guid.bytes

    def answer(self) -> None:
        try:
            requests = self.reader.take(_REQUESTS_AT_ONCE)
        except DDSException:
            return
        for request in requests:
            if isinstance(request, IdlStruct):  # otherwise the peer is gone
                asked = request.serialize()
                reply = self._handler(asked[:_ENCAPSULATION] + asked[_AFTER_ID:])
                self._writer.publish(reply[:_ENCAPSULATION] + asked[_ENCAPSULATION:_AFTER_ID] + reply[_ENCAPSULATION:])

    def close(self) -> None:
        del self.reader
        self._writer.close()


@cache
def _type(message_type: MessageType, with_id: bool = False) -> type[IdlStruct]:
    return struct_type(Definitions(message_type.name, messages.TEXTS), before=_REQUEST_ID if with_id else {})
