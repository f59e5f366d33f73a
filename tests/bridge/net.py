"""A network in this process, in the place of zenoh's: what goes over it can be held up, lost and cut."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any

from skinware.bridge.link import Question, Sender, ZenohLink


def _match(one: str, other: str) -> bool:
    """Whether two keys have something in common; ``*`` stands for anything between two slashes."""
    parts = one.split("/"), other.split("/")
    return len(parts[0]) == len(parts[1]) and all(a == b or "*" in (a, b) for a, b in zip(*parts, strict=True))


class Net:
    """Carries messages between links, in a thread of its own and in order.

    Attributes:
        loses: (kind, key) -> whether a message is lost; kinds: ``frame``, ``put``, ``question``, ``reply``.
        is_cut: nothing goes over it.
        flows: where it is cleared, what goes over it waits, and arrives when it is set again.
        offered: frames that were sent, whether they got lost or not.
        answered: (key, answer) of questions; the answer is None if there is none.
    """

    def __init__(self) -> None:
        self.loses: Callable[[str, str], bool] = lambda _kind, _key: False
        self.is_cut = False
        self.flows = threading.Event()
        self.flows.set()
        self.offered = 0
        self.answered: list[tuple[str, bytes | None]] = []
        self._jobs: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self.listeners: list[tuple[str, Callable[[str, bytes], object]]] = []
        self.answerers: list[tuple[str, Callable[[Any], None]]] = []
        self.tokens: set[str] = set()
        self.watchers: list[tuple[str, Callable[[str, bool], object]]] = []
        self._thread = threading.Thread(target=self._run, name="net")
        self._thread.start()

    def carry(self, kind: str, key: str, job: Callable[[], object]) -> None:
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

    def __call__(self, payload: bytes) -> None:
        for heard in self._listeners():
            self._net.carry("frame", self._key, lambda heard=heard: heard(self._key, payload))  # type: ignore[misc]

    def close(self) -> None:
        pass

    @property
    def is_heard(self) -> bool:
        return bool(self._listeners())

    def _listeners(self) -> list[Callable[[str, bytes], object]]:
        return [heard for pattern, heard in list(self._net.listeners) if _match(self._key, pattern)]


class NetLink(ZenohLink):
    def __init__(self, net: Net) -> None:
        self._net = net
        self._own: list[str] = []
        self._ends: list[Callable[[], None]] = []

    def sender(self, key: str) -> Sender:
        return _Sender(self._net, key)

    def put(self, key: str, payload: bytes, priority: object = None) -> None:
        for pattern, heard in list(self._net.listeners):
            if _match(key, pattern):
                self._net.carry("put", key, lambda heard=heard: heard(key, payload))  # type: ignore[misc]

    def listen(self, key: str, heard: Callable[[str, bytes], object]) -> Callable[[], None]:
        return self._entered(self._net.listeners, (key, heard))

    def answer(self, key: str, asked: Callable[[Any], None]) -> Callable[[], None]:
        return self._entered(self._net.answerers, (key, asked))

    def ask(
        self,
        key: str,
        answered: Callable[[bytes | None], None],
        *,
        timeout_s: float,
        priority: object,
        parameters: Mapping[str, object] | None = None,
        payload: bytes = b"",
        is_large: bool = False,
    ) -> None:
        texts = {name: str(value) for name, value in (parameters or {}).items()}
        for pattern, asked in list(self._net.answerers):
            if _match(key, pattern):
                question = self._question(key, texts, payload, answered)
                self._net.carry("question", key, lambda asked=asked, question=question: asked(question))  # type: ignore[misc]

    def declare_token(self, key: str) -> None:
        self._own.append(key)
        self._net.tokens.add(key)
        self._show_token(key, True)

    def watch_tokens(self, key: str, changed: Callable[[str, bool], object]) -> None:
        self._entered(self._net.watchers, (key, changed))
        for token in list(self._net.tokens):
            if _match(token, key):
                self._net.carry("token", token, lambda token=token: changed(token, True))  # type: ignore[misc]

    def _question(
        self, key: str, parameters: Mapping[str, str], payload: bytes, answered: Callable[[bytes | None], None]
    ) -> Question:
        is_done = False

        def reply(answer: bytes | None) -> None:
            nonlocal is_done
            assert not is_done
            is_done = True
            self._net.answered.append((key, answer))
            self._net.carry("reply", key, lambda: answered(answer))

        return Question(key, parameters, payload, reply, lambda _error: reply(None))

    def close(self) -> None:
        for key in self._own:
            self._net.tokens.discard(key)
            self._show_token(key, False)
        self._own.clear()
        for end in list(self._ends):
            end()

    def _entered(self, entries: list[Any], entry: tuple[str, Callable[..., object]]) -> Callable[[], None]:
        entries.append(entry)

        def leave() -> None:
            if entry in entries:
                entries.remove(entry)
                self._ends.remove(leave)

        self._ends.append(leave)
        return leave

    def _show_token(self, key: str, there: bool) -> None:
        for pattern, changed in list(self._net.watchers):
            if _match(key, pattern):
                self._net.carry("token", key, lambda changed=changed: changed(key, there))  # type: ignore[misc]
