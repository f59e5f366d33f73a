"""A node of a ROS 2 graph over zenoh, for peers with rmw_zenoh.

Nodes are peers of zenoh: each listens on this machine only and connects to a router, through which they discover each
other. Messages on one machine then go straight to their subscribers; the router passes on those for other machines.

Source of keys, tokens and attachments: the design document of rmw_zenoh (ros2/rmw_zenoh, docs/design.md), from versions
0.1.2 (Humble) and 0.2.4 (Jazzy) on.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import re
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

from skinware.bridge.endpoints import DEFAULT_ROUTER, Endpoints, endpoints
from skinware.errors import BridgeError, MissingExtra
from skinware.ros2.transport import Cdr, Distro, Handler, MessageType, NodeIdentity, Qos, ServiceType, TopicPublisher

if find_spec("zenoh") is None or find_spec("xxhash") is None:
    raise MissingExtra.of("ROS 2 over zenoh", "skinware[ros2-zenoh]")

import xxhash
import zenoh
import zenoh.ext

from skinware.bridge.link import directly, open_session

_LISTEN = "tcp/127.0.0.1:0"
_SETTINGS = {
    "scouting/gossip/enabled": "true",
    "scouting/gossip/target": '{ router: ["router", "peer"], peer: ["router"] }',
    "timestamping/enabled": "true",
}
"""As nodes of rmw_zenoh; late subscribers get only messages with time stamps."""
_SERVICES = Qos(depth=10)
_MOST_REQUESTS = 10
"""Requests that may wait, as in a node of ROS."""
_LOOK_S = 1.0
"""Time between two looks for the router."""
PUBLISHER, SUBSCRIPTION, SERVICE = "MP", "MS", "SS"
"""Kinds of endpoints."""


def graph_endpoints(connect: Sequence[str]) -> Endpoints:
    """Return the settings of a peer in a graph, with endpoints of routers; ConfigurationError: one is malformed."""
    return replace(endpoints(connect=connect), listen=(_LISTEN,), security=_SETTINGS)


class ZenohNode:
    """A :class:`skinware.ros2.transport.Node`.

    It can publish without a router. Others discover it as soon as there is one, and again after the router was away.

    Args:
        connect: endpoints of routers, ``tcp/HOST:PORT``.
        router_changed: called with (is there, line for people) when the router goes or comes back, and a second after
            the start if there is none; in a thread of the node.

    Attributes:
        is_seen: there was a router at the last look; nodes that start without one do not discover this one.

    Raises:
        ConfigurationError: an endpoint is malformed.
        BridgeError: there cannot be such a node; the message says why.
    """

    def __init__(
        self,
        identity: NodeIdentity,
        *,
        connect: Sequence[str] = (DEFAULT_ROUTER,),
        router_changed: Callable[[bool, str], None] = lambda _is_there, _line: None,
    ) -> None:
        places = graph_endpoints(connect)
        self._identity, self._router_changed = identity, router_changed
        self._at = ", ".join(places.connect)
        self._session = open_session(places)
        self._zid = str(self._session.info.zid())
        self._numbers = itertools.count(1)
        self._endpoints: set[_ZenohPublisher | _ZenohService] = set()
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._answering = threading.RLock()
        self.is_seen: bool = True
        self._worker = threading.Thread(target=self._work, name=f"node {identity.name}")
        try:
            self._token = self._announce(node_token(identity, self._zid))
        except BridgeError:
            self._close_session()
            raise
        self._worker.start()

    def publisher(self, topic: str, message_type: MessageType, qos: Qos) -> TopicPublisher:
        at = key(self._identity, topic, message_type)
        token = endpoint_token(self._identity, self._zid, next(self._numbers), PUBLISHER, topic, message_type, qos)
        with _as_bridge_error(topic):
            declared = _declare_publisher(self._session, at, qos)
        made = _ZenohPublisher(declared, self._announce(token), gid(token), qos, self._endpoints.discard)
        self._endpoints.add(made)
        return made

    def service(self, name: str, service_type: ServiceType, handler: Handler) -> Callable[[], None]:
        at = key(self._identity, name, service_type)
        token = endpoint_token(self._identity, self._zid, next(self._numbers), SERVICE, name, service_type, _SERVICES)
        made = _ZenohService(at, handler, self._answering, self._endpoints.discard)
        with _as_bridge_error(name):
            asked = directly(lambda query: self._asked(made, query))
            made.declared.append(self._session.declare_queryable(at, asked, complete=True))
        made.declared.append(self._announce(token))
        self._endpoints.add(made)
        return made.close

    def close(self) -> None:
        for endpoint in tuple(self._endpoints):
            endpoint.close()
        self._jobs.put(None)
        if self._worker is not threading.current_thread():
            self._worker.join()
        self._close_session()

    def _announce(self, token: str) -> zenoh.LivelinessToken:
        with _as_bridge_error(token):
            return self._session.liveliness().declare_token(token)

    def _asked(self, service: _ZenohService, query: zenoh.Query) -> None:
        if self._jobs.qsize() < _MOST_REQUESTS:
            self._jobs.put(lambda: service.answer(query))
        else:
            _refuse(query, "too many requests wait")

    def _work(self) -> None:
        look_s = time.monotonic() + _LOOK_S
        while True:
            try:
                job = self._jobs.get(timeout=max(0.0, look_s - time.monotonic()))
            except queue.Empty:
                look_s = time.monotonic() + _LOOK_S
                self._look()
                continue
            if job is None:
                return
            job()

    def _look(self) -> None:
        is_seen = bool(self._session.info.routers_zid())
        if is_seen == self.is_seen:
            return
        self.is_seen, name = is_seen, self._identity.name
        if is_seen:
            line = f"the zenoh router at {self._at} is there: nodes find {name}"
        else:
            start_one = "start one with: ros2 run rmw_zenoh_cpp rmw_zenohd"
            line = f"no zenoh router at {self._at}: nodes that start now do not find {name}; {start_one}"
        self._router_changed(is_seen, line)

    def _close_session(self) -> None:
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]


class _ZenohPublisher:
    def __init__(
        self,
        publisher: Any,
        token: zenoh.LivelinessToken,
        identity: bytes,
        qos: Qos,
        closed: Callable[[_ZenohPublisher], None],
    ) -> None:
        self._publisher, self._token, self._gid, self._qos, self._closed = publisher, token, identity, qos, closed
        self._sequence = 0
        self._is_open = True

    @property
    def is_wanted(self) -> bool:
        return self._is_open and (self._qos.latched or bool(self._publisher.matching_status.matching))

    def publish(self, message: Cdr) -> bool:
        if not self._is_open:
            return False
        self._sequence += 1
        attachment = packed_attachment(self._sequence, time.time_ns(), self._gid)
        try:
            self._publisher.put(message, attachment=attachment)
        except zenoh.ZError:  # the session is closed
            return False
        return True

    def close(self) -> None:
        if self._is_open:
            self._is_open = False
            _undeclare(self._token, self._publisher)
            self._closed(self)


class _ZenohService:
    """Answers requests under a key, one at a time of all services that share a lock."""

    def __init__(
        self, at: str, handler: Handler, answering: threading.RLock, closed: Callable[[_ZenohService], None]
    ) -> None:
        self._at, self._handler, self._answering, self._closed = at, handler, answering, closed
        self._is_open = True
        self.declared: list[Any] = []

    def answer(self, query: zenoh.Query) -> None:
        with self._answering:
            if not self._is_open:
                return _refuse(query, "the service ended")
            try:
                sequence, _, asker = read_attachment(_bytes(query.attachment))
            except ValueError as error:
                return _refuse(query, str(error))
            response = self._handler(_bytes(query.payload))
        attachment = packed_attachment(sequence, time.time_ns(), asker)
        with contextlib.suppress(zenoh.ZError), query:
            query.reply(self._at, response, attachment=attachment, express=True)
        return None

    def close(self) -> None:
        was_open, self._is_open = self._is_open, False
        with self._answering:
            if was_open:
                _undeclare(*reversed(self.declared))
                self._closed(self)


def _declare_publisher(session: zenoh.Session, at: str, qos: Qos) -> Any:
    """Declare a publisher that hardly waits for slow subscribers; one of a latched topic keeps messages for late ones.

    Unlike rmw_zenoh it sends no heartbeats: they wait for a peer that hangs, and hold up all other messages.
    """
    how: dict[str, Any] = {
        "congestion_control": zenoh.CongestionControl.DROP,
        "reliability": zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
        "express": True,
    }
    if not qos.latched:
        return session.declare_publisher(at, **how)
    cache = zenoh.ext.CacheConfig(max_samples=qos.depth)
    return zenoh.ext.declare_advanced_publisher(session, at, **how, cache=cache, publisher_detection=True)


def _undeclare(*declared: Any) -> None:
    for one in declared:
        with contextlib.suppress(zenoh.ZError):  # the session is closed
            one.undeclare()


def _refuse(query: zenoh.Query, why: str) -> None:
    with contextlib.suppress(zenoh.ZError), query:
        query.reply_err(why.encode())


def _bytes(data: zenoh.ZBytes | None) -> bytes:
    return b"" if data is None else data.to_bytes()


@contextlib.contextmanager
def _as_bridge_error(what: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise BridgeError(f"{what}: {error}") from None


_NO_HASH = "TypeHashNotSupported"
_NAME = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16
_DEFAULT_DEPTH = 42
"""Depth that is not written."""


def packed_attachment(sequence: int, time_ns: int, gid: bytes) -> bytes:
    """Return the attachment of a message, a request or a response, 33 bytes.

    Args:
        sequence: number of the message, by its sender, from 1 on; a response has that of its request.
        time_ns: when it was sent, ns since 1970.
        gid: identity of the sender, 16 bytes; a response has that of its request.
    """
    return _ATTACHMENT.pack(sequence, time_ns, _GID_BYTES, gid)


def read_attachment(data: bytes) -> tuple[int, int, bytes]:
    """Return the sequence, time and gid of an attachment, see :func:`packed_attachment`.

    Raises:
        ValueError: it is malformed.
    """
    try:
        sequence, time_ns, gid_bytes, gid = _ATTACHMENT.unpack(data)
    except struct.error:
        raise ValueError(f"an attachment has {_ATTACHMENT.size} bytes, not {len(data)}") from None
    if gid_bytes != _GID_BYTES:
        raise ValueError(f"an identity has {_GID_BYTES} bytes, not {gid_bytes}")
    return sequence, time_ns, gid


def key(identity: NodeIdentity, name: str, of_type: MessageType) -> str:
    """Return the key of the messages of a topic, or of the requests to a service.

    Raises:
        BridgeError: ``name`` is no absolute name of ROS.
    """
    if not _NAME.fullmatch(name):
        raise BridgeError(f"{name!r} is no absolute name of a topic or service in ROS 2, as /skin/arm/points is")
    return f"{identity.domain}{name}/{of_type.dds_name}/{_hash(identity, of_type)}"


def place_token(identity: NodeIdentity, session: str, number: int, kind: str) -> str:
    """Return how a token begins: session, number and kind of an endpoint (0 and NN: the node itself), and its node."""
    namespace = identity.namespace.replace("/", "%")
    return f"@ros2_lv/{identity.domain}/{session}/0/{number}/{kind}/%/{namespace}/{identity.name}"


def node_token(identity: NodeIdentity, session: str) -> str:
    """Return the token of the only node in a session of zenoh."""
    return place_token(identity, session, 0, "NN")


def endpoint_token(
    identity: NodeIdentity, session: str, endpoint: int, kind: str, name: str, of_type: MessageType, qos: Qos
) -> str:
    """Return the token of a publisher or a service, which has a number of its own in the session, from 1 on."""
    place = place_token(identity, session, endpoint, kind)
    return "/".join((place, name.replace("/", "%"), of_type.dds_name, _hash(identity, of_type), qos_text(qos)))


def qos_text(qos: Qos) -> str:
    """Return reliability, durability, history, deadline, lifespan and liveliness; defaults are not written."""
    reliability = "" if qos.reliable else "2"
    durability = "1" if qos.latched else ""
    depth = "" if qos.depth == _DEFAULT_DEPTH else qos.depth
    return f"{reliability}:{durability}:,{depth}:,:,:,,"


def gid(token: str) -> bytes:
    """Return the identity of the endpoint with a token, 16 bytes; all nodes compute the same."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


def _hash(identity: NodeIdentity, of_type: MessageType) -> str:
    return _NO_HASH if identity.distro is Distro.HUMBLE else of_type.hash
