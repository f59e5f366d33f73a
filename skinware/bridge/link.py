"""Carry bytes under keys, questions and answers over zenoh; count what is malformed and never end for it."""

from __future__ import annotations

import contextlib
import json
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import zenoh

from skinware.bridge.endpoints import Endpoints
from skinware.errors import BridgeError, SkinwareError
from skinware.limits import LIMITS

LEASE_MS = 2000
"""A peer that says nothing for so long is gone."""
_RETRY_MS = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 2}
_FOREVER_MS = -1
_BATCHES = 4
"""Of 64 KiB, that may wait to be sent: a frame of 30,848 sensors takes three, and who puts it waits for none."""
_LONGEST_MESSAGE = 1 << 26
"""Bytes that are put together of the parts of a message of somebody else."""
_OS_ERROR = re.compile(r"([A-Z][\w ]+) \(os error \d+\)")

Payload = bytes


class Question(Protocol):
    """What somebody asks; exactly one of the answers is given, from any thread."""

    @property
    def key(self) -> str:
        """Under which it was asked."""

    @property
    def parameters(self) -> Mapping[str, str]:
        """Of it."""

    @property
    def payload(self) -> Payload:
        """What came with it."""

    def reply(self, payload: Payload) -> None:
        """The answer."""

    def fail(self, error: Payload) -> None:
        """It cannot be answered."""


@dataclass(frozen=True)
class Reply:
    """What came back of a question.

    Attributes:
        payload: the answer; None if there is none.
        error: what the other end says went wrong.
    """

    payload: Payload | None
    error: Payload | None = None


class Priority:
    """What goes before what on a link that is full."""

    CLOCK = zenoh.Priority.REAL_TIME
    CALLS = zenoh.Priority.INTERACTIVE_HIGH
    FRAMES = zenoh.Priority.DATA
    PULLED = zenoh.Priority.DATA_LOW


class _Question:
    def __init__(self, query: zenoh.Query) -> None:
        self._query = query
        self.key = str(query.key_expr)
        self.payload = query.payload.to_bytes() if query.payload is not None else b""

    @property
    def parameters(self) -> Mapping[str, str]:
        text = str(self._query.parameters)
        return dict(part.partition("=")[::2] for part in text.split(";")) if text else {}

    def reply(self, payload: Payload) -> None:
        with contextlib.suppress(zenoh.ZError), self._query:
            self._query.reply(self.key, payload)

    def fail(self, error: Payload) -> None:
        with contextlib.suppress(zenoh.ZError), self._query:
            self._query.reply_err(error)


def open_session(endpoints: Endpoints) -> zenoh.Session:
    """A session that shares nothing but what it is told to; it connects again for ever.

    Raises:
        BridgeError: it cannot be opened; the message says why.
    """
    try:
        return zenoh.open(_configuration(endpoints))
    except zenoh.ZError as error:
        raise BridgeError(f"{endpoints}: {_reason(error)}") from None


def directly(call: Callable[[Any], None], over: Callable[[], None] | None = None) -> Any:
    """A callback in the thread that receives: every hand-over to another thread takes 0.1 ms."""
    return zenoh.handlers.Callback(call, over, indirect=False)


class Sender:
    """Sends bytes to all who listen, and waits for nobody: a receiver that is too slow loses some.

    Args:
        publisher: of zenoh.
        close: ends it.

    Attributes:
        close: ends it.
    """

    def __init__(self, publisher: zenoh.Publisher, close: Callable[[], None]) -> None:
        self._publisher, self.close = publisher, close

    def __call__(self, payload: Payload) -> None:
        with contextlib.suppress(zenoh.ZError):  # closed
            self._publisher.put(payload)

    @property
    def is_heard(self) -> bool:
        try:
            status: Any = self._publisher.matching_status
        except zenoh.ZError:  # closed
            return False
        return bool(status.matching)


class Link:
    """A session of zenoh.

    Args:
        endpoints: where it listens and connects.

    Raises:
        BridgeError: it cannot be opened; the message says what to do.
    """

    def __init__(self, endpoints: Endpoints) -> None:
        self._session = open_session(endpoints)
        self._declared: list[Any] = []

    def sender(self, key: str) -> Sender:
        """What sends bytes to all who listen to a key."""
        publisher = self._session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK_FIRST,
            priority=Priority.FRAMES,
            express=True,
        )
        return Sender(publisher, self._undeclaring(publisher))

    def tell(self, key: str, payload: Payload, priority: zenoh.Priority = Priority.CALLS) -> None:
        """Send something small, before any frames."""
        with contextlib.suppress(zenoh.ZError):
            self._session.put(key, payload, priority=priority, express=True)

    def listen(self, key: str, heard: Callable[[str, Payload], None]) -> Callable[[], None]:
        """Have (key, bytes) of what is sent under keys, in the thread that receives; what ends it."""

        def hear(sample: zenoh.Sample) -> None:
            heard(str(sample.key_expr), sample.payload.to_bytes())

        return self._undeclaring(self._session.declare_subscriber(key, directly(hear)))

    def answer(self, key: str, asked: Callable[[Question], None]) -> Callable[[], None]:
        """Have the questions under keys; what ends it."""
        return self._undeclaring(self._session.declare_queryable(key, directly(lambda query: asked(_Question(query)))))

    def ask(
        self,
        key: str,
        answered: Callable[[Reply], None],
        *,
        timeout_s: float,
        priority: zenoh.Priority,
        parameters: Mapping[str, object] | None = None,
        payload: Payload = b"",
        is_large: bool = False,
    ) -> None:
        """Ask whoever answers under a key; ``answered`` is called for each answer, and once with none if none came.

        What does not fit on a slow link soon is left out, unless the answer is known to be large.
        """
        text = ";".join(f"{name}={value}" for name, value in (parameters or {}).items())
        got: list[bool] = []

        def hear(reply: zenoh.Reply) -> None:
            got.append(True)
            if reply.ok is not None:
                answered(Reply(reply.ok.payload.to_bytes()))
            elif reply.err is not None:
                answered(Reply(None, reply.err.payload.to_bytes()))

        def over() -> None:
            if not got:
                answered(Reply(None))

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
            answered(Reply(None))

    def be_there(self, key: str) -> None:
        """Others see a key for as long as this is open."""
        self._declared.append(self._session.liveliness().declare_token(key))

    def watch(self, key: str, changed: Callable[[str, bool], None]) -> None:
        """Have (key, whether somebody is there) of all who are, come and go."""
        self._declared.append(
            self._session.liveliness().declare_subscriber(
                key, lambda sample: changed(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT), history=True
            )
        )

    def close(self) -> None:
        """End it. Idempotent."""
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def _undeclaring(self, declared: Any) -> Callable[[], None]:
        self._declared.append(declared)

        def undeclare() -> None:
            if declared in self._declared:
                self._declared.remove(declared)
                with contextlib.suppress(zenoh.ZError):
                    declared.undeclare()

        return undeclare


def _configuration(endpoints: Endpoints) -> zenoh.Config:
    config: dict[str, object] = {
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
        "transport/link/tx/lease": str(LEASE_MS),
        "transport/link/tx/queue/size/data": str(_BATCHES),
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": str(round(endpoints.patience_us)),
        "adminspace/enabled": "false",
    }
    made = zenoh.Config()
    for path, value in {**config, **endpoints.security}.items():
        made.insert_json5(path, str(value))
    return made


def _reason(error: Exception) -> str:
    """What zenoh says: the system's own words if it has them, and not where in its sources."""
    of_system = _OS_ERROR.search(str(error))
    return of_system[1] if of_system else str(error).partition(" at ")[0].partition(" - ")[0]


_LONGEST = 160
_MOST_KINDS = 256


class Guard:
    """Counts messages that cannot be taken.

    Args:
        report: gets (kind of message, why) of the first of each kind, in the thread that found it.

    Attributes:
        count: messages that could not be taken so far.
        last: kind and reason of the last one; empty: none so far.
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
            self.last = f"{kind}: {why}"[:_LONGEST]
            is_new = kind not in self._reported and len(self._reported) < _MOST_KINDS
            if is_new:
                self._reported.add(kind)
        if is_new:
            self._report(kind, why)

    def run(self, kind: str, work: Callable[..., object], *arguments: object) -> bool:
        """Do what a message asks for; one that cannot be taken is counted.

        Returns:
            Whether it was done.
        """
        try:
            work(*arguments)
        except Exception as error:  # noqa: BLE001, whatever others send ends nothing here
            self.refuse(kind, _text(error))
            return False
        return True

    def of_messages(self, kind: str, heard: Callable[[str, bytes], None]) -> Callable[[str, bytes], None]:
        def guarded(key: str, payload: bytes) -> None:
            self.run(kind, heard, key, payload)

        return guarded

    def of_questions(self, kind: str, asked: Callable[[Question], None]) -> Callable[[Question], None]:
        """What answers questions, guarded: one that cannot be taken is answered with that."""

        def guarded(question: Question) -> None:
            if not self.run(kind, asked, question):
                question.fail(b"the question cannot be understood")

        return guarded


class Room:
    """Memory for what a robot has, shared by its services.

    Args:
        most: bytes for all of them.
    """

    def __init__(self, most: int = LIMITS.robot_size) -> None:
        self._most = most
        self._taken: dict[str, int] = {}

    def take(self, name: str, size: int) -> None:
        """Have ``size`` bytes for a service, in the place of what it had.

        Raises:
            BridgeError: that is more than the robot may have; nothing has changed.
        """
        others = sum(taken for one, taken in self._taken.items() if one != name)
        if others + size > self._most:
            raise BridgeError(
                f"it needs {size / 1e6:.1f} MB of memory, beside {others / 1e6:.1f} MB of other services; a robot may"
                f" have {self._most / 1e6:.0f} MB"
            )
        self._taken[name] = size

    def give_back(self, name: str) -> None:
        self._taken.pop(name, None)


def _text(error: Exception) -> str:
    if isinstance(error, SkinwareError):
        return str(error)
    return f"{type(error).__name__}: {error}"
