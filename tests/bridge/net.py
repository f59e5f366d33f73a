"""A network in this process, in the place of zenoh's: what goes over it can be held up, lost and cut."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any

from skinware.bridge.link import Link, Payload, Reply, Sender


def _match(one: str, other: str) -> bool:
    """Whether two keys have something in common; ``*`` stands for anything between two slashes."""
    parts = one.split("/"), other.split("/")
    return len(parts[0]) == len(parts[1]) and all(a == b or "*" in (a, b) for a, b in zip(*parts, strict=True))


class _Asked:
    def __init__(self, net: Net, key: str, parameters: Mapping[str, str], payload: bytes, to: Callable[..., None]):
        self.key, self.parameters, self.payload = key, parameters, payload
        self._net, self._to, self._done = net, to, False

    def reply(self, payload: Payload) -> None:
        self._answer(Reply(payload))

    def fail(self, error: Payload) -> None:
        self._answer(Reply(None, error))

    def _answer(self, reply: Reply) -> None:
        assert not self._done
        self._done = True
        self._net.answered.append((self.key, reply))
        self._net.carry("reply", self.key, lambda: self._to(reply))


class Net:
    """Carries messages between links, in a thread of its own and in order.

    Attributes:
        loses: (kind, key) -> whether a message is lost; kinds: ``frame``, ``told``, ``question``, ``reply``.
        is_cut: nothing goes over it.
        flows: where it is cleared, what goes over it waits, and arrives when it is set again.
        offered: frames that were sent, whether they got lost or not.
        answered: (key, answer) of questions, likewise.
    """

    def __init__(self) -> None:
        self.loses: Callable[[str, str], bool] = lambda _kind, _key: False
        self.is_cut = False
        self.flows = threading.Event()
        self.flows.set()
        self.offered = 0
        self.answered: list[tuple[str, Reply]] = []
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self.listeners: list[tuple[str, Callable[[str, Payload], None]]] = []
        self.answerers: list[tuple[str, Callable[[Any], None]]] = []
        self.tokens: set[str] = set()
        self.watchers: list[tuple[str, Callable[[str, bool], None]]] = []
        self._thread = threading.Thread(target=self._run, name="net")
        self._thread.start()

    def carry(self, kind: str, key: str, job: Callable[[], None]) -> None:
        """Have something arrive, unless it is lost."""
        if not self.is_cut and not self.loses(kind, key):
            self._jobs.put(job)
        self.offered += kind == "frame"

    def idle(self) -> None:
        """Wait until what was sent so far has arrived."""
        arrived = threading.Event()
        self._jobs.put(arrived.set)
        arrived.wait()

    def close(self) -> None:
        """End it."""
        self.flows.set()
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            self.flows.wait()
            job()


class _Sender(Sender):
    def __init__(self, net: Net, key: str) -> None:
        self._net, self._key = net, key

    def __call__(self, payload: Payload) -> None:
        for heard in self._listeners():
            self._net.carry("frame", self._key, lambda heard=heard: heard(self._key, payload))  # type: ignore[misc]

    def close(self) -> None:
        pass

    @property
    def is_heard(self) -> bool:
        return bool(self._listeners())

    def _listeners(self) -> list[Callable[[str, Payload], None]]:
        return [heard for pattern, heard in list(self._net.listeners) if _match(self._key, pattern)]


class NetLink(Link):
    """An end of a :class:`Net`."""

    def __init__(self, net: Net) -> None:
        self._net = net
        self._own: list[str] = []
        self._ends: list[Callable[[], None]] = []

    def sender(self, key: str) -> Sender:
        return _Sender(self._net, key)

    def tell(self, key: str, payload: Payload, priority: object = None) -> None:
        for pattern, heard in list(self._net.listeners):
            if _match(key, pattern):
                self._net.carry("told", key, lambda heard=heard: heard(key, payload))  # type: ignore[misc]

    def listen(self, key: str, heard: Callable[[str, Payload], None]) -> Callable[[], None]:
        return self._entered(self._net.listeners, (key, heard))

    def answer(self, key: str, asked: Callable[[Any], None]) -> Callable[[], None]:
        return self._entered(self._net.answerers, (key, asked))

    def ask(
        self,
        key: str,
        answered: Callable[[Reply], None],
        *,
        timeout_s: float,
        priority: object,
        parameters: Mapping[str, object] | None = None,
        payload: Payload = b"",
        is_large: bool = False,
    ) -> None:
        texts = {name: str(value) for name, value in (parameters or {}).items()}
        for pattern, asked in list(self._net.answerers):
            if _match(key, pattern):
                question = _Asked(self._net, key, texts, payload, answered)
                self._net.carry("question", key, lambda asked=asked, question=question: asked(question))  # type: ignore[misc]

    def be_there(self, key: str) -> None:
        self._own.append(key)
        self._net.tokens.add(key)
        self._tell_watchers(key, True)

    def watch(self, key: str, changed: Callable[[str, bool], None]) -> None:
        self._entered(self._net.watchers, (key, changed))
        for token in list(self._net.tokens):
            if _match(token, key):
                self._net.carry("token", token, lambda token=token: changed(token, True))  # type: ignore[misc]

    def close(self) -> None:
        for key in self._own:
            self._net.tokens.discard(key)
            self._tell_watchers(key, False)
        self._own.clear()
        for end in list(self._ends):
            end()

    def _entered(self, entries: list[Any], entry: tuple[str, Callable[..., None]]) -> Callable[[], None]:
        entries.append(entry)

        def leave() -> None:
            if entry in entries:
                entries.remove(entry)
                self._ends.remove(leave)

        self._ends.append(leave)
        return leave

    def _tell_watchers(self, key: str, there: bool) -> None:
        for pattern, changed in list(self._net.watchers):
            if _match(key, pattern):
                self._net.carry("token", key, lambda changed=changed: changed(key, there))  # type: ignore[misc]
