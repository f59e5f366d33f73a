"""Another node of a graph of rmw_zenoh: written from its design document, it shares no code with ours."""

from __future__ import annotations

import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import xxhash
import zenoh
import zenoh.ext

from skinware_drivers.testing.waiting import wait_until
from tests.ros2.router import settings

GID = bytes(range(16))


@dataclass(frozen=True)
class Found:
    """What a token tells.

    Attributes:
        token: it.
        kind: ``NN``, ``MP`` or ``SS`` ...
        node: namespace and name of the node.
        name: of the topic or service.
        type_name: of its messages, as DDS has it.
        type_hash: likewise.
        qos: six parts.
    """

    token: str
    kind: str
    node: str
    name: str = ""
    type_name: str = ""
    type_hash: str = ""
    qos: tuple[str, ...] = ()

    @property
    def gid(self) -> bytes:
        """What the graph calls it: the hash of its token, low half first."""
        value = xxhash.xxh3_128_intdigest(self.token.encode())
        return struct.pack("<QQ", value & (1 << 64) - 1, value >> 64)


@dataclass(frozen=True)
class Message:
    """What came.

    Attributes:
        payload: the message.
        sequence: in its attachment.
        time_ns: likewise.
        gid: likewise.
    """

    payload: bytes
    sequence: int
    time_ns: int
    gid: bytes


@dataclass
class Heard:
    messages: list[Message] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.messages)


class GraphPeer:
    """Sees the graph, hears topics and calls services.

    Args:
        endpoint: of the router.
        domain: of the graph.
        mode: ``peer``, or ``client`` that has all from the router, as those on other machines.
    """

    def __init__(self, endpoint: str, domain: int = 0, mode: str = "peer") -> None:
        listen = ["tcp/127.0.0.1:0"] if mode == "peer" else []
        places = {"mode": mode, "connect/endpoints": [endpoint], "listen/endpoints": listen}
        retries = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2}
        self._session = zenoh.open(settings(**places, **{"connect/retry": retries}))
        self._domain = domain
        self._tokens: set[str] = set()
        self._lock = threading.Lock()
        self._declared: list[Any] = [
            self._session.liveliness().declare_subscriber(f"@ros2_lv/{domain}/**", self._change, history=True)
        ]

    def found(self, kind: str) -> dict[str, Found]:
        """What is there of a kind, by the name of the topic or service; nodes by their own."""
        with self._lock:
            told = [_found(token) for token in self._tokens]
        return {one.name or one.node: one for one in told if one.kind == kind}

    def wait_for(self, kind: str, name: str) -> Found:
        """Something, as soon as it is there."""
        wait_until(lambda: name in self.found(kind))
        return self.found(kind)[name]

    def hear(self, topic: Found, *, late: bool = False) -> Heard:
        """The messages of a topic from now on; with ``late``, as who wants those from before, too."""
        heard = Heard()

        def hear(sample: zenoh.Sample) -> None:
            assert sample.attachment is not None
            heard.messages.append(Message(sample.payload.to_bytes(), *_attachment(sample.attachment.to_bytes())))

        at = self._key(topic)
        if late:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            declared: Any = zenoh.ext.declare_advanced_subscriber(self._session, at, hear, history=history)
        else:
            declared = self._session.declare_subscriber(at, hear)
        self._declared.append(declared)
        return heard

    def stop_hearing(self) -> None:
        """End all topics."""
        while len(self._declared) > 1:
            self._declared.pop().undeclare()

    def call(self, service: Found, request: bytes, sequence: int = 1, *, attachment: bytes | None = None) -> Any:
        """The answer to a request: a message, or the text of an error.

        It asks again while nobody answers: a token may be known before the service itself.

        Args:
            service: of it.
            request: the message.
            sequence: of the request.
            attachment: what goes with it, if not what should.
        """
        replies: list[Any] = []

        def is_answered() -> bool:
            replies.extend(self.ask(service, request, sequence, attachment=attachment))
            return bool(replies)

        wait_until(is_answered)
        (reply,) = replies
        if reply.err is not None:
            return reply.err.payload.to_string()
        return Message(reply.ok.payload.to_bytes(), *_attachment(reply.ok.attachment.to_bytes()))

    def ask(self, service: Found, request: bytes, sequence: int = 1, *, attachment: bytes | None = None) -> Any:
        """Answers to a request, as they come."""
        usual = struct.pack("<qq", sequence, time.time_ns()) + b"\x10" + GID
        return self._session.get(
            self._key(service),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            payload=request,
            attachment=usual if attachment is None else attachment or None,
            timeout=30.0,
        )

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]

    def _key(self, one: Found) -> str:
        return f"{self._domain}/{one.name.strip('/')}/{one.type_name}/{one.type_hash}"

    def _change(self, sample: zenoh.Sample) -> None:
        change = self._tokens.add if sample.kind == zenoh.SampleKind.PUT else self._tokens.discard
        with self._lock:
            change(str(sample.key_expr))


def _found(token: str) -> Found:
    _, _, _, _, _, kind, _, namespace, name, *rest = token.split("/")
    node = f"{namespace.replace('%', '/').rstrip('/')}/{name}"
    if kind == "NN":
        return Found(token, kind, node)
    topic, type_name, type_hash, qos = rest
    return Found(token, kind, node, topic.replace("%", "/"), type_name, type_hash, tuple(qos.split(":")))


def _attachment(data: bytes) -> tuple[int, int, bytes]:
    sequence, time_ns = struct.unpack_from("<qq", data)
    assert data[16] == len(data) - 17 == 16
    return sequence, time_ns, data[17:]


@contextmanager
def peer(endpoint: str, domain: int = 0, mode: str = "peer") -> Iterator[GraphPeer]:
    one = GraphPeer(endpoint, domain, mode)
    try:
        yield one
    finally:
        one.close()


def main(endpoint: str, domain: str, topic: str) -> None:
    """Hear a topic until the standard input ends; says when it has heard something."""
    with peer(endpoint, int(domain)) as one:
        heard = one.hear(one.wait_for("MP", topic))
        wait_until(lambda: len(heard) > 0)
        print("heard", flush=True)
        sys.stdin.read()
