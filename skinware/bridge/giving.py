"""Frames of one service, or of a part of one, for whoever listens and whoever asks."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from skinware.bridge.link import Question, Sender
from skinware.bridge.messages import RAW, coded_message, raw_message
from skinware.memory.ring import Frame
from skinware.realtime import NS_PER_S, now_ns
from skinware.transfer.codec import CodedColumn, Encoder

_HELD_NS = NS_PER_S // 2
"""How long a question for the newest frame waits for one."""
_GONE_NS = 10 * NS_PER_S
"""Who has not asked for so long has to be given a whole frame first."""


@dataclass(frozen=True)
class _Form:
    """How the frames of a generation are given.

    Attributes:
        generation: its number.
        columns: of their slots.
        made_of: makes what is given of a frame.
    """

    generation: int
    columns: Sequence[CodedColumn]
    made_of: Callable[[Frame], Frame]


@dataclass
class _Puller:
    """Somebody who asks for frames one by one.

    Attributes:
        encoder: of those frames.
        generation, sequence: of the last one.
        asked_ns: when that was asked for.
    """

    encoder: Encoder
    generation: int
    sequence: int = 0
    asked_ns: int = 0


class Stream:
    """Gives frames to all.

    Args:
        send: to who listens.
        soon: has something done in a single thread, for who asks.

    Attributes:
        frames: that were given.
    """

    def __init__(self, send: Sender, soon: Callable[..., None]) -> None:
        self._send, self._soon = send, soon
        self._lock = threading.Lock()
        self._form = _Form(0, (), _as_it_is)
        self._newest: Frame | None = None
        self._asked: list[tuple[int, Question]] = []  # who wait for a newer frame, and since when
        self._pullers: dict[str, _Puller] = {}
        self.frames: int = 0

    @property
    def newest(self) -> Frame | None:
        """The frame that was taken last, of this generation."""
        return self._newest

    @property
    def n_pullers(self) -> int:
        """How many ask for single frames."""
        return len(self._pullers)

    def begin(
        self, generation: int, columns: Sequence[CodedColumn], made_of: Callable[[Frame], Frame] | None = None
    ) -> None:
        """Another generation begins.

        Args:
            generation: its number.
            columns: of the slots of frames that are given.
            made_of: makes those of the frames that are taken; None: they are the same.
        """
        with self._lock:
            self._form, self._newest = _Form(generation, columns, made_of or _as_it_is), None
            self._pullers.clear()

    def take(self, frame: Frame) -> None:
        """A frame; those of other generations, and older ones than the newest, are left out."""
        with self._lock:
            form, before = self._form, self._newest
            if frame.generation != form.generation or (before is not None and frame.position <= before.position):
                return
            self._newest = frame
            asked, self._asked = self._asked, []
        if self._send.is_heard:
            self._send(raw_message(form.made_of(frame)))
        self.frames += 1
        for _, question in asked:
            self._soon(self._give, form, frame, question)

    def asked(self, question: Question) -> None:
        """Somebody asks for the newest frame."""
        known = _number_in(question, "generation"), _number_in(question, "sequence")
        with self._lock:
            form, newest = self._form, self._newest
            if newest is None or newest.position <= known:
                self._asked.append((now_ns(), question))
                return
        self._soon(self._give, form, newest, question)

    def let_go(self) -> None:
        """Of questions that no frame comes for, and of those who ask no more."""
        time_ns = now_ns()
        until_ns = time_ns - _HELD_NS
        with self._lock:
            for who in [who for who, puller in self._pullers.items() if time_ns - puller.asked_ns > _GONE_NS]:
                del self._pullers[who]
            late = [question for since_ns, question in self._asked if since_ns < until_ns]
            self._asked = [(since_ns, question) for since_ns, question in self._asked if since_ns >= until_ns]
        for question in late:
            question.reply(b"")

    def close(self) -> None:
        """Nothing is given any more."""
        self._send.close()
        with self._lock:
            asked, self._asked = self._asked, []
        for _, question in asked:
            question.reply(b"")

    def _give(self, form: _Form, frame: Frame, question: Question) -> None:
        """A frame to who asked for one."""
        given = form.made_of(frame)
        if question.parameters.get("form") == str(RAW):
            question.reply(raw_message(given))
            return
        who = question.parameters.get("who", "")
        base = _number_in(question, "base")
        with self._lock:
            puller = self._pullers.get(who)
            if puller is None or puller.generation != given.generation:
                puller = self._pullers[who] = _Puller(Encoder(form.columns), given.generation)
            puller.asked_ns = now_ns()
        if not base or base != puller.sequence or given.sequence <= base:
            puller.encoder.next_is_key()
        puller.sequence = given.sequence
        question.reply(coded_message(puller.encoder.encode(given)))


def _as_it_is(frame: Frame) -> Frame:
    return frame


def _number_in(question: Question, name: str) -> int:
    """A parameter of a question that is a number from 0 on; 0 if there is none."""
    text = question.parameters.get(name, "")
    return int(text) if text.isdigit() else 0


__all__ = ["Stream"]
