"""Send the frames of a service to peers: each one to those that listen, the newest to those that ask."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from skinware.bridge.link import Question, Sender
from skinware.bridge.messages import RAW, coded_message, number_in, raw_message
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, now_ns
from skinware.transfer.codec import CodedColumn, encoded

_HELD_NS = NS_PER_S // 2
"""How long a question waits for a newer frame."""
_GONE_NS = 10 * NS_PER_S
"""A puller that has not asked for this long is forgotten: it gets a whole frame first when it asks again."""
_KEY_NS, _KEY_FRAMES = NS_PER_S, 32
"""How long, and for how many frames at least, frames are differences to the same one: a puller that misses some can
still read the others."""
_MOST_KEPT = 2
_MOST_PULLERS = 64
_MOST_OPEN = 1024
"""Questions of one puller that wait for a frame."""
_LONGEST_NAME = 64


class _FrameForm(NamedTuple):
    """Form in which frames of a generation are sent; ``cut`` makes them of those that are taken, None: the same."""

    generation: int
    columns: Sequence[CodedColumn]
    cut: Callable[[Sample], Sample] | None

    def of(self, frame: Sample) -> Sample:
        return frame if self.cut is None else self.cut(frame)


@dataclass
class _Puller:
    """A receiver that asks for frames one by one.

    Attributes:
        open: questions that wait for a newer frame, each with the time at which it came; the oldest first.
        sent: position of the last frame that was sent.
        kept: frames of ``generation`` that the receiver keeps, by sequence; later ones may be differences to them.
        kept_ns, since: when the newest of those was sent, and the number of frames sent after it.
    """

    open: deque[tuple[int, Question]] = field(default_factory=deque)
    sent: tuple[int, int] = (0, 0)
    generation: int = 0
    kept: dict[int, Sample] = field(default_factory=dict)
    kept_ns: int = 0
    since: int = 0
    asked_ns: int = 0


class FrameStream:
    """Sends the frames of a service: each to listeners, the newest to pullers.

    ``soon`` calls a function in the only thread that codes.
    """

    def __init__(self, send: Sender, soon: Callable[..., None]) -> None:
        self._send, self._soon = send, soon
        self._lock = threading.Lock()
        self._form = _FrameForm(0, (), None)
        self._pullers: dict[str, _Puller] = {}
        self.newest: Sample | None = None
        self.frames: int = 0

    @property
    def n_pullers(self) -> int:
        return len(self._pullers)

    def begin(
        self, generation: int, columns: Sequence[CodedColumn], cut: Callable[[Sample], Sample] | None = None
    ) -> None:
        """Begin another generation; ``cut`` makes the frames that are sent of those that are taken."""
        with self._lock:
            self._form, self.newest = _FrameForm(generation, columns, cut), None

    def take(self, frame: Sample) -> None:
        """Send a frame, unless it is of another generation or not newer than the newest."""
        with self._lock:
            form, before = self._form, self.newest
            if frame.generation != form.generation or (before is not None and frame.position <= before.position):
                return
            self.newest = frame
            asked = [(puller, puller.open.popleft()[1]) for puller in self._pullers.values() if puller.open]
            for puller, _ in asked:
                puller.sent = frame.position
        if self._send.is_heard:
            self._send(raw_message(form.of(frame)))
        self.frames += 1
        for puller, question in asked:
            self._soon(self._send_coded, form, frame, question, puller)

    def asked(self, question: Question) -> None:
        """Answer a question for the newest frame, now or when there is a newer one."""
        numbers = {name: number_in(text) for name, text in question.parameters.items()}
        if question.parameters.get("form") == str(RAW):
            form, newest = self._form, self.newest
            if newest is None:
                question.reply(b"")
            else:
                self._soon(lambda: question.reply(raw_message(form.of(newest))))
            return
        known = numbers.get("generation", 0), numbers.get("sequence", 0)
        time_ns = now_ns()
        with self._lock:
            form, newest = self._form, self.newest
            puller = self._puller(question)
            puller.asked_ns = time_ns
            if numbers.get("others"):
                known = max(known, puller.sent)  # that one is on its way
            is_new = newest is not None and newest.position > known
            is_refused = not is_new and len(puller.open) >= _MOST_OPEN
            if is_new and newest is not None:
                puller.sent = newest.position
            elif not is_refused:
                puller.open.append((time_ns, question))
        if is_new:
            self._soon(self._send_coded, form, newest, question, puller)
        elif is_refused:
            question.fail(b"too many questions at once")

    def expire(self) -> None:
        time_ns = now_ns()
        late: list[Question] = []
        with self._lock:
            for who, puller in list(self._pullers.items()):
                while puller.open and puller.open[0][0] < time_ns - _HELD_NS:
                    late.append(puller.open.popleft()[1])
                if not puller.open and time_ns - puller.asked_ns > _GONE_NS:
                    del self._pullers[who]
        for question in late:
            question.reply(b"")

    def close(self) -> None:
        self._send.close()
        with self._lock:
            late = [question for puller in self._pullers.values() for _, question in puller.open]
            self._pullers.clear()
        for question in late:
            question.reply(b"")

    def _puller(self, question: Question) -> _Puller:
        """Return the puller that asks; if there are too many, the one that has been silent longest makes room."""
        who = question.parameters.get("who", "")[:_LONGEST_NAME]
        puller = self._pullers.get(who)
        if puller is None:
            if len(self._pullers) >= _MOST_PULLERS:
                idle = [name for name, one in self._pullers.items() if not one.open] or list(self._pullers)
                gone = self._pullers.pop(min(idle, key=lambda name: self._pullers[name].asked_ns))
                for _, open_ in gone.open:
                    self._soon(open_.fail, b"too many ask at once")
            puller = self._pullers[who] = _Puller()
        return puller

    def _send_coded(self, form: _FrameForm, frame: Sample, question: Question, puller: _Puller) -> None:
        """Answer a question with a frame; always in the same thread."""
        sent = form.of(frame)
        if puller.generation != sent.generation:
            puller.generation, puller.kept_ns = sent.generation, 0
            puller.kept.clear()
        before, time_ns = puller.kept.get(number_in(question.parameters.get("base", ""))), now_ns()
        puller.since += 1
        keeps = time_ns - puller.kept_ns > _KEY_NS and (before is None or puller.since > _KEY_FRAMES)
        if keeps:
            puller.kept_ns, puller.since = time_ns, 0
            puller.kept[sent.sequence] = sent
            for oldest in list(puller.kept)[:-_MOST_KEPT]:
                del puller.kept[oldest]
        question.reply(coded_message(encoded(sent, None if keeps else before, form.columns), keeps))
