"""Give the samples of a service to peers that listen or ask, and a summary of the robot each second."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from skinware.bridge.link import Question, Sender
from skinware.bridge.messages import (
    RAW,
    DriverSummary,
    State,
    Summary,
    coded_message,
    host_name,
    number_in,
    raw_message,
)
from skinware.driver_service import counters_of
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusState, PatchState, is_fresh
from skinware.structure import Structure
from skinware.transfer.codec import CodedColumn, encoded
from skinware.transfer.generation import Generation, RecordedDriverSnapshot

_HELD_NS = NS_PER_S // 2
"""How long a question for the newest frame waits for one."""
_GONE_NS = 10 * NS_PER_S
"""A puller that has not asked for so long is forgotten: it gets a whole frame first when it asks again."""
_KEY_NS, _KEY_FRAMES = NS_PER_S, 32
"""How long, and how many frames at least are the difference to the same one: who misses some can read all others."""
_MOST_KEPT = 2
_MOST_PULLERS = 64
_MOST_OPEN = 1024
"""Questions of one puller that wait for a frame."""
_LONGEST_NAME = 64


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
    made_of: Callable[[Sample], Sample]


@dataclass
class _Puller:
    """A receiver that asks for frames one by one.

    Attributes:
        open: questions that wait for a newer frame, with the time at which each came; the oldest first.
        sent: position of the last frame that was sent.
        kept: by sequence, the frames of ``generation`` that the receiver keeps, and to which others are the difference.
        kept_ns, since: when the newest of those was sent, and how many frames after it.
        asked_ns: when it asked last.
    """

    open: deque[tuple[int, Question]] = field(default_factory=deque)
    sent: tuple[int, int] = (0, 0)
    generation: int = 0
    kept: dict[int, Sample] = field(default_factory=dict)
    kept_ns: int = 0
    since: int = 0
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
        self._newest: Sample | None = None
        self._pullers: dict[str, _Puller] = {}
        self.frames: int = 0

    @property
    def newest(self) -> Sample | None:
        return self._newest

    @property
    def n_pullers(self) -> int:
        """How many ask for single frames."""
        return len(self._pullers)

    def begin(
        self, generation: int, columns: Sequence[CodedColumn], made_of: Callable[[Sample], Sample] | None = None
    ) -> None:
        """Another generation begins.

        Args:
            generation: its number.
            columns: of the slots of frames that are given.
            made_of: makes those of the frames that are taken; None: they are the same.
        """
        with self._lock:
            self._form, self._newest = _Form(generation, columns, made_of or _as_it_is), None

    def take(self, frame: Sample) -> None:
        """A frame; those of other generations, and older ones than the newest, are left out."""
        with self._lock:
            form, before = self._form, self._newest
            if frame.generation != form.generation or (before is not None and frame.position <= before.position):
                return
            self._newest = frame
            asked = [(puller, puller.open.popleft()[1]) for puller in self._pullers.values() if puller.open]
            for puller, _ in asked:
                puller.sent = frame.position
        if self._send.is_heard:
            self._send(raw_message(form.made_of(frame)))
        self.frames += 1
        for puller, question in asked:
            self._soon(self._give, form, frame, question, puller)

    def asked(self, question: Question) -> None:
        if question.parameters.get("form") == str(RAW):
            self._asked_raw(question)
            return
        known = _number_in(question, "generation"), _number_in(question, "sequence")
        time_ns = now_ns()
        with self._lock:
            form, newest = self._form, self._newest
            puller = self._puller(question)
            puller.asked_ns = time_ns
            if _number_in(question, "others"):
                known = max(known, puller.sent)  # what was sent is on its way
            is_new = newest is not None and newest.position > known
            if is_new and newest is not None:
                puller.sent = newest.position
            refused = question if not is_new and len(puller.open) >= _MOST_OPEN else None
            if not is_new and refused is None:
                puller.open.append((time_ns, question))
        if is_new:
            self._soon(self._give, form, newest, question, puller)
        if refused is not None:
            refused.fail(b"too many questions at once")

    def let_go(self) -> None:
        """Answer questions that no frame comes for, and forget pullers that ask no more."""
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
        """The one that asks; the one that has asked for the longest time goes where there are too many."""
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

    def _asked_raw(self, question: Question) -> None:
        form, newest = self._form, self._newest
        if newest is None:
            question.reply(b"")
        else:
            self._soon(lambda: question.reply(raw_message(form.made_of(newest))))

    def _give(self, form: _Form, frame: Sample, question: Question, puller: _Puller) -> None:
        """Answer a question for a frame; always in the same thread."""
        given = form.made_of(frame)
        if puller.generation != given.generation:
            puller.generation, puller.kept_ns = given.generation, 0
            puller.kept.clear()
        before, time_ns = puller.kept.get(_number_in(question, "base")), now_ns()
        puller.since += 1
        keeps = time_ns - puller.kept_ns > _KEY_NS and (before is None or puller.since > _KEY_FRAMES)
        if keeps:
            puller.kept_ns, puller.since = time_ns, 0
            puller.kept[given.sequence] = given
            for oldest in list(puller.kept)[:-_MOST_KEPT]:
                del puller.kept[oldest]
        message = encoded(given, None if keeps else before, form.columns)
        question.reply(coded_message(message, keeps))


def _as_it_is(frame: Sample) -> Sample:
    return frame


def _number_in(question: Question, name: str) -> int:
    """A parameter of a question that is a number from 0 on; 0 if there is none."""
    return number_in(question.parameters.get(name, ""))


_MOST_NAMES = 4
"""Names of silent patches in a message; all are counted."""


@dataclass(frozen=True)
class Summarised:
    """A driver that is told of.

    Attributes:
        name: of it.
        state: ``live``, ``paused``, ``closed`` or ``dead``.
        generation: the present one.
        stream: of its frames.
    """

    name: str
    state: State
    generation: Generation
    stream: Stream


class Summaries:
    """Sends how a robot is, for as long as anybody listens.

    Args:
        namespace: that is served.
        send: sends it.
    """

    def __init__(self, namespace: str, send: Sender) -> None:
        self._namespace, self._host, self._send_bytes = namespace, host_name(), send
        self._frames: dict[str, int] = {}
        self._counted_ns = now_ns()
        self._rates_hz: dict[str, float] = {}

    @property
    def is_wanted(self) -> bool:
        return self._send_bytes.is_heard

    def count(self, frames: dict[str, int]) -> None:
        """How many frames of each service there were so far, about once a second."""
        time_ns = now_ns()
        seconds = (time_ns - self._counted_ns) / NS_PER_S
        new = {name: count - self._frames.get(name, 0) for name, count in frames.items()}
        self._rates_hz = {name: round(count / seconds, 1) for name, count in new.items()}
        self._frames, self._counted_ns = frames, time_ns

    def send(self, drivers: Iterable[Summarised], services: int, lost: int) -> None:
        """Send it.

        Args:
            drivers: all there are.
            services: how many others there are.
            lost: frames that the bridge could not take from their rings.
        """
        told = {driver.name: self._of(driver) for driver in drivers}
        self._send_bytes(msgspec.json.encode(Summary(self._namespace, told, services, lost, self._host)))

    def _of(self, driver: Summarised) -> DriverSummary:
        structure = driver.generation.context
        assert isinstance(structure, Structure)  # noqa: S101 - it is a driver
        newest = driver.stream.newest
        is_live = driver.state == "live"
        age_ms, lost, fresh, problems = None, 0, 0, int(not is_live)
        silent: list[str] = []
        if newest is not None and newest.generation == driver.generation.generation:
            frame = RecordedDriverSnapshot(driver.generation, newest.slot)
            time_ns = now_ns()
            age_ms = round((time_ns - frame.acquired_ns) / 1e6, 3)
            fresh = _fresh(frame, structure, time_ns, is_live)
            names, counts = counters_of(frame, driver.generation.static(), "bus", len(structure.buses))
            lost = int(counts[:, names.index("lost")].sum()) if "lost" in names else 0
            if is_live:
                rows = np.flatnonzero(frame.patch_state != PatchState.LIVE).tolist()
                silent = [structure.patch_names[row] for row in rows]
                problems += len(silent) + int(np.count_nonzero(frame.bus_state != BusState.LIVE))
        return DriverSummary(
            driver.state,
            self._rates_hz.get(driver.name, 0.0),
            age_ms,
            lost,
            structure.n_sensors,
            fresh,
            structure.n_patches,
            tuple(silent[:_MOST_NAMES]),
            len(silent),
            problems,
        )


def _fresh(frame: RecordedDriverSnapshot, structure: Structure, time_ns: int, is_live: bool) -> int:
    """How many sensors can be trusted now."""
    fresh = is_fresh(
        frame.status,
        frame.sensor_time_ns,
        at_ns=time_ns,
        max_age_ns=structure.age_limits_ns(frame.period_ns),
        alive=is_live,
    )
    return int(np.count_nonzero(fresh))
