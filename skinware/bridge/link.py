"""Carry bytes under keys, and questions with their answers, over zenoh; count messages that cannot be read."""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from skinware.bridge.endpoints import Endpoints
from skinware.errors import BridgeError, MissingExtra, SkinwareError

if find_spec("zenoh") is None:
    raise MissingExtra.of("bridges", "skinware[zenoh]")

import zenoh

_LEASE_MS, _SIGNS_OF_LIFE = 5000, 10
"""A session without a byte for this long is over; how often a session shows in that time that it lives. The first sign
comes a round trip and such a pause after the session began: a link may have a round trip of 4 s.
"""
_RETRY_MS = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 2}
_FOREVER_MS = -1
_BATCHES = 4
"""Batches of 64 KiB that may wait to be sent: a frame of 30,848 sensors takes three, and its writer does not wait."""
_PATIENCE_US = 1000
"""How long a frame may wait for a slow receiver before that receiver misses it."""
_LONGEST_MESSAGE = 1 << 26
"""Bytes to which the fragments of a message may add up."""
_FILES = 24
"""Files that a session and the services of a bridge need; zenoh panics where it cannot open one."""
_OS_ERROR = re.compile(r"([A-Z][\w ]+) \(os error \d+\)")


@dataclass(frozen=True)
class Question:
    """A question of a peer. One of ``reply`` and ``fail``, which takes the reason, is called once, in any thread."""

    key: str
    parameters: Mapping[str, str]
    payload: bytes
    reply: Callable[[bytes], None]
    fail: Callable[[bytes], None]


class Priority:
    """Order of messages on a link that is full, the most urgent first."""

    CLOCK = zenoh.Priority.REAL_TIME
    CALLS = zenoh.Priority.INTERACTIVE_HIGH
    FRAMES = zenoh.Priority.DATA
    PULLED = zenoh.Priority.DATA_LOW


def open_session(endpoints: Endpoints) -> zenoh.Session:
    """Open a session that shares only what it declares, and that always connects again."""
    most, n_open = resource.getrlimit(resource.RLIMIT_NOFILE)[0], len(os.listdir("/proc/self/fd"))
    if resource.RLIM_INFINITY != most < n_open + _FILES:
        raise BridgeError(f"a bridge needs {_FILES} files beside {n_open}, and may open {most}: raise `ulimit -n`")
    settings: dict[str, object] = {
        "mode": json.dumps(endpoints.mode),
        "connect/endpoints": json.dumps(endpoints.connect),
        "connect/timeout_ms": json.dumps(_FOREVER_MS),
        "connect/exit_on_failure": "false",
        "connect/retry": json.dumps(_RETRY_MS),
        "listen/endpoints": json.dumps(endpoints.listen),
        "listen/exit_on_failure": "true",
        "scouting/multicast/enabled": "false",
        "scouting/gossip/enabled": "false",
        "transport/shared_memory/enabled": "false",
        "transport/link/rx/max_message_size": str(_LONGEST_MESSAGE),
        "transport/link/tx/lease": str(_LEASE_MS),
        "transport/link/tx/keep_alive": str(_SIGNS_OF_LIFE),
        "transport/link/tx/queue/size/data": str(_BATCHES),
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": str(_PATIENCE_US),
        "adminspace/enabled": "false",
        **endpoints.security,
    }
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, str(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        of_system = _OS_ERROR.search(str(error))  # without the place in zenoh's sources
        reason = of_system[1] if of_system else str(error).partition(" at ")[0].partition(" - ")[0]
        raise BridgeError(f"{endpoints}: {reason}") from None


def directly(call: Callable[[Any], object], over: Callable[[], None] | None = None) -> Any:
    """Return a callback that runs in the receiving thread: handing over to another thread takes 0.1 ms."""
    return zenoh.handlers.Callback(call, over, indirect=False)


class Sender:
    """Sends bytes to all listeners without waiting; a receiver that is too slow misses some."""

    def __init__(self, publisher: zenoh.Publisher, close: Callable[[], None]) -> None:
        self._publisher, self.close = publisher, close

    def __call__(self, payload: bytes) -> None:
        with contextlib.suppress(zenoh.ZError):  # closed
            self._publisher.put(payload)

    @property
    def is_heard(self) -> bool:
        try:
            status: Any = self._publisher.matching_status
        except zenoh.ZError:  # closed
            return False
        return bool(status.matching)


class ZenohLink:
    """A session of zenoh; BridgeError says why it cannot be opened."""

    def __init__(self, endpoints: Endpoints) -> None:
        self._session = open_session(endpoints)
        self.zid: str = str(self._session.info.zid())
        self._declared: list[Any] = []

    def sender(self, key: str) -> Sender:
        """Declare that frames are sent under a key, and return the sender."""
        publisher = self._session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK_FIRST,
            priority=Priority.FRAMES,
            express=True,
        )
        return Sender(publisher, self._end_of(publisher))

    def put(self, key: str, payload: bytes, priority: zenoh.Priority = Priority.CALLS) -> None:
        """Send a small message before any frames."""
        with contextlib.suppress(zenoh.ZError):
            self._session.put(key, payload, priority=priority, express=True)

    def listen(self, key: str, heard: Callable[[str, bytes], object]) -> Callable[[], None]:
        """Call ``heard(key, bytes)`` with messages in the receiving thread; return a function that ends it."""
        hear = directly(lambda sample: heard(str(sample.key_expr), sample.payload.to_bytes()))
        return self._end_of(self._session.declare_subscriber(key, hear))

    def listen_attached(self, key: str, heard: Callable[[str, bytes, bytes], object]) -> Callable[[], None]:
        """Call ``heard(key, attachment, bytes)`` as ``listen`` does."""

        def hear(sample: zenoh.Sample) -> None:
            attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
            heard(str(sample.key_expr), attachment, sample.payload.to_bytes())

        return self._end_of(self._session.declare_subscriber(key, directly(hear)))

    def answer(self, key: str, asked: Callable[[Question], None]) -> Callable[[], None]:
        """Call ``asked`` with questions under keys, in the receiving thread; return a function that ends it."""

        def ask(query: zenoh.Query) -> None:
            def reply(payload: bytes) -> None:
                with contextlib.suppress(zenoh.ZError), query:
                    query.reply(key, payload)

            def fail(error: bytes) -> None:
                with contextlib.suppress(zenoh.ZError), query:
                    query.reply_err(error)

            key, text = str(query.key_expr), str(query.parameters)
            parameters = dict(part.partition("=")[::2] for part in text.split(";")) if text else {}
            payload = query.payload.to_bytes() if query.payload is not None else b""
            asked(Question(key, parameters, payload, reply, fail))

        return self._end_of(self._session.declare_queryable(key, directly(ask)))

    def ask(
        self,
        key: str,
        answered: Callable[[bytes | None], None],
        *,
        timeout_s: float,
        priority: zenoh.Priority,
        parameters: Mapping[str, object] | None = None,
        payload: bytes = b"",
        is_large: bool = False,
    ) -> None:
        """Ask under a key; ``answered`` is called with each answer, or once with None if there is none.

        A slow link drops an answer that does not fit soon, unless ``is_large`` is set.
        """
        text = ";".join(f"{name}={value}" for name, value in (parameters or {}).items())
        is_answered = False

        def hear(reply: zenoh.Reply) -> None:
            nonlocal is_answered
            is_answered = True
            answered(None if reply.ok is None else reply.ok.payload.to_bytes())

        def over() -> None:
            if not is_answered:
                answered(None)

        try:
            self._session.get(
                f"{key}?{text}" if text else key,
                directly(hear, over),
                timeout=timeout_s,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.BLOCK if is_large else zenoh.CongestionControl.DROP,
                priority=priority,
                express=True,
                payload=payload or None,
            )
        except zenoh.ZError:
            answered(None)

    def declare_token(self, key: str) -> None:
        """Show a key to all who watch it, for as long as the link is open."""
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch_tokens(self, key: str, changed: Callable[[str, bool], object]) -> None:
        """Call ``changed(key, is_there)`` for all tokens under keys, and when they come and go."""
        self._declared.append(
            self._session.liveliness().declare_subscriber(
                key, lambda sample: changed(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT), history=True
            )
        )

    def close(self) -> None:
        """End it. Idempotent."""
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def _end_of(self, declared: Any) -> Callable[[], None]:
        self._declared.append(declared)

        def end() -> None:
            if declared in self._declared:
                self._declared.remove(declared)
                with contextlib.suppress(zenoh.ZError):
                    declared.undeclare()

        return end


_LONGEST_REASON = 160
_MOST_KINDS = 256


class Guard:
    """Counts messages that cannot be read or used.

    ``report`` gets (kind of message, reason) for the first message of each kind, in the thread that found it.
    """

    def __init__(self, report: Callable[[str, str], object] = lambda _kind, _why: None) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._reported: set[str] = set()
        self.count: int = 0
        self.last: str = ""

    def refuse(self, kind: str, why: str) -> None:
        with self._lock:
            self.count += 1
            self.last = f"{kind}: {why}"[:_LONGEST_REASON]
            is_new = kind not in self._reported and len(self._reported) < _MOST_KINDS
            if is_new:
                self._reported.add(kind)
        if is_new:
            self._report(kind, why)

    def run(self, kind: str, work: Callable[..., object], *arguments: object) -> bool:
        """Do what a message asks for, and count it if that fails; return whether it was done."""
        try:
            work(*arguments)
        except SkinwareError as error:
            self.refuse(kind, str(error))
            return False
        except Exception as error:  # noqa: BLE001, no message of a peer may end this program
            self.refuse(kind, f"{type(error).__name__}: {error}")
            return False
        return True
