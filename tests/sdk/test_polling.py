"""Devices that only answer are asked at absolute deadlines."""

from __future__ import annotations

import asyncio
import itertools
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from itertools import dropwhile, pairwise
from typing import cast

import numpy as np
import pytest

from skinware import BusState, DriverReader
from skinware.errors import BusSendError, ConfigurationError
from skinware.realtime import now_ns
from skinware.sensor_types import PRESSURE
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can import CanAdapter
from skinware_drivers.counters import BusCounters
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Bits, Identifier, Match, Reply
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.options import NoOptions
from skinware_drivers.polling import Poll, check_polls
from skinware_drivers.running.poller import Poller
from skinware_drivers.testing.waiting import run_in_its_time, wait_until
from skinware_drivers.virtual.hand_clock import HandClock
from skinware_drivers.virtual.hardware import WireFrame
from tests.sdk.driving import TroubledBus, driving_lines, read_until

MS = 1_000_000
ASK = Poll(0x100, b"\x01", 0.02)


class Answering(CanAdapter[NoOptions]):
    """A sensor that says how often it was asked."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    patches = (Patch("patch", [Module(taxels(1))]),)
    layout = Layout([Frame("answer", [Identifier(0x101)], (2,), Values(0, "<u2", 1))])
    polls = (ASK,)


class Device:
    """Answers at once; notes when it was asked."""

    def __init__(self) -> None:
        self.asked_ns: list[int] = []
        self._answers: list[WireFrame] = []

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        if (identifier, payload) == (0x100, b"\x01"):
            self.asked_ns.append(now_ns)
            self._answers.append(WireFrame(now_ns, 0x101, len(self.asked_ns).to_bytes(2, "little")))

    def next_due_ns(self) -> int | None:
        return self._answers[0].time_ns if self._answers else None

    def emit(self, now_ns: int) -> list[WireFrame]:
        answers, self._answers = self._answers, []
        return answers

    def skip(self, now_ns: int) -> int:
        return len(self.emit(now_ns))

    def totals(self) -> dict[str, int]:
        return {}


def bus_with(device: Device, *, listen_only: bool = False) -> TroubledBus:
    return TroubledBus("", hardware=device, listen_only=listen_only)


def test_answers_to_polls_are_published_one_by_one_at_absolute_deadlines() -> None:
    device = Device()
    with driving_lines([(Answering(NoOptions()), bus_with(device))], "answering") as running:
        with DriverReader("answering") as reader:
            fresh = dropwhile(lambda frame: bool(frame.status.any()), reader.in_order(timeout_s=30))
            values = [int(next(fresh).values[0]) for _ in range(20)]
        asked_ns = device.asked_ns.copy()
        missed = running.status()["buses"][0]["polls_missed"]  # by then, and perhaps a few since
    assert all(0 <= b - a <= 1 + reader.missed for a, b in pairwise(values))  # a reader that was held up misses some
    # no drift: polls lie on one grid of 20 ms, but for how late each was sent; what it lacks was counted
    deadlines = [(asked - asked_ns[0]) / (20 * MS) for asked in asked_ns]
    assert max(round(d) for d in deadlines) <= len(deadlines) - 1 + missed + 1


def test_a_listener_asks_nothing() -> None:
    device = Device()
    bus = bus_with(device, listen_only=True)
    with driving_lines([(Answering(NoOptions()), bus)], "answering", listen_only=True):
        pass
    assert device.asked_ns == []
    assert bus.counters.sent == bus.counters.send_failures == 0


def test_polls_stop_with_a_lost_bus_and_go_on_when_it_is_back() -> None:
    device = Device()
    bus = bus_with(device)
    with driving_lines([(Answering(NoOptions()), bus)], "answering") as running, DriverReader("answering") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(bus.go_down)
        read_until(reader, lambda f: f.bus_state[0] == BusState.DOWN)
        asked, failures = len(device.asked_ns), bus.counters.polls_missed
        wait_until(lambda: len(bus.opened_at_s) >= 3)  # it tried twice to open it: some periods have passed
        assert (len(device.asked_ns), bus.counters.polls_missed) == (asked, failures)
        bus.down = False
        read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE and not f.status.any())
        wait_until(lambda: len(device.asked_ns) > asked + 3)


class Line:
    """A line that takes what it wants to, and notes what was sent and when."""

    listen_only = narrows = False
    medium = "can"
    name = channel = "line"

    def __init__(self, clock: Callable[[], int] = now_ns, takes: Callable[[], bool] = lambda: True) -> None:
        self.sent: list[tuple[float, int, bytes]] = []
        self.now_ns, self._takes = clock, takes

    def send(self, identifier: int, payload: bytes) -> None:
        if not self._takes():
            raise BusSendError("queue full")
        self.sent.append((self.now_ns() / 1e9, identifier, payload))

    @property
    def times_s(self) -> list[float]:
        return [time_s for time_s, _, _ in self.sent]

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, _, payload in self.sent]


class Polling:
    """A poller on a line, in time of its own; what the line says back is up to the test."""

    def __init__(self, clock: HandClock, polls: Callable[[], Sequence[Poll]]) -> None:
        self.line = Line(clock)
        self.link = Link(self.line)  # type: ignore[arg-type]
        self.counters = BusCounters()
        self._polls = polls

    def hear(self, identifier: int, payload: bytes) -> None:
        batch = FrameBatch(1)
        batch.append(0, self.line.now_ns(), identifier, payload)
        self.link.hear(batch, np.arange(1))

    async def for_s(self, duration_s: float) -> None:
        task = asyncio.create_task(Poller(self.link, self.counters).run(self._polls, lambda: False))
        await asyncio.sleep(duration_s)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def poll_for(
    duration_s: float,
    polls: Callable[[], Sequence[Poll]],
    answering: Callable[[Polling], Coroutine[None, None, None]] | None = None,
) -> Polling:
    clock = HandClock()
    polling = Polling(clock, polls)

    async def scenario() -> None:
        other = asyncio.create_task(answering(polling)) if answering is not None else None
        await polling.for_s(duration_s)
        if other is not None:
            other.cancel()
            await asyncio.gather(other, return_exceptions=True)

    run_in_its_time(clock, scenario)
    return polling


async def _answer_after(polling: Polling, delay_s: float, deaf: bytes = b"") -> None:
    """Devices that answer after a while, each with its own identifier; one does not."""
    answered = 0
    while True:
        await asyncio.sleep(0.0005)
        while len(polling.line.sent) > answered:
            _, identifier, payload = polling.line.sent[answered]
            answered += 1
            if payload != deaf:
                await asyncio.sleep(delay_s)
                polling.hear(identifier + 1, payload)


def test_a_bus_that_takes_nothing_is_not_flooded_and_every_miss_is_counted() -> None:
    bus, counters = Line(takes=iter([True] + [False] * 1000).__next__), BusCounters()

    async def scenario() -> None:
        poller = Poller(Link(bus), counters)  # type: ignore[arg-type]
        task = asyncio.create_task(poller.run(lambda: [replace(ASK, period_s=0.01)], lambda: False))
        async with asyncio.timeout(30):
            while counters.polls_missed < 5:  # noqa: ASYNC110
                await asyncio.sleep(0.001)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(scenario())
    assert len(bus.sent) == 1


def test_other_polls_are_taken_up_while_running() -> None:
    """Another period counts from the last question on, not from the next."""
    first, second = replace(ASK, period_s=0.01), replace(ASK, identifier=0x102, period_s=0.005)
    sent: list[int] = []

    def polls() -> list[Poll]:
        sent.append(0)
        return [first] if len(sent) <= 3 else [second]

    line = poll_for(0.0399, polls).line
    assert [identifier for _, identifier, _ in line.sent] == [0x100] * 3 + [0x102] * 2
    assert np.diff(line.times_s) == pytest.approx([0.01, 0.01, 0.01, 0.005])


def test_a_changing_payload_keeps_the_period() -> None:
    """The poll is known by its place, not by what it says: each period one question, and `polls` is called once."""
    numbers = itertools.count()
    line = poll_for(1.005, lambda: [replace(ASK, payload=bytes([next(numbers)]), period_s=0.01)]).line
    assert line.payloads == [bytes([number]) for number in range(101)]
    assert np.diff(line.times_s) == pytest.approx(0.01)


def test_no_polls_are_a_pause() -> None:
    paused = [False]

    async def pause(polling: Polling) -> None:
        await asyncio.sleep(0.105)
        paused[0] = True
        await asyncio.sleep(1.0)
        paused[0] = False

    line = poll_for(2.0, lambda: () if paused[0] else (replace(ASK, period_s=0.01),), pause).line
    pauses_s = np.diff(line.times_s)
    assert ((pauses_s > 0.9) & (pauses_s < 1.1)).sum() == 1
    assert len(line.sent) > 90


def test_what_polls_raises_ends_the_asking_and_it_can_begin_anew() -> None:
    """Whoever runs the poller decides what comes next; questions that are no polls are told, too."""
    line = Line()
    steps: list[list[Poll] | Exception] = [[ASK], ZeroDivisionError(), [cast(Poll, 7)], [ASK], MemoryError()]
    answers = iter(steps)
    poller = Poller(Link(line), BusCounters())  # type: ignore[arg-type]

    def polls() -> Sequence[Poll]:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    for error in (ZeroDivisionError, AttributeError, MemoryError):
        with pytest.raises(error):
            asyncio.run(poller.run(polls, lambda: False))
    assert len(line.sent) == 2


IN_STEP = [
    replace(ASK, payload=bytes([node]), period_s=0.02, answer=Match(0x101), timeout_s=0.01) for node in (1, 2, 3)
]


def test_the_next_question_waits_for_the_answer() -> None:
    line = poll_for(0.0999, lambda: IN_STEP, lambda p: _answer_after(p, 0.004)).line
    assert line.payloads == [b"\1", b"\2", b"\3"] * 5
    steps_s = np.diff(line.times_s).reshape(-1)
    assert (steps_s > 0.0039).all()
    assert np.diff(line.times_s[::3]) == pytest.approx(0.02)  # no drift


def test_a_device_that_does_not_answer_costs_its_timeout() -> None:
    polling = poll_for(0.0599, lambda: IN_STEP, lambda p: _answer_after(p, 0.001, deaf=b"\2"))
    assert polling.line.payloads == [b"\1", b"\2", b"\3"] * 3
    assert polling.counters.polls_unanswered == 3
    times_s = polling.line.times_s
    assert [times_s[i + 1] - times_s[i] for i in range(1, 9, 3)] == pytest.approx([0.01] * 3)


@pytest.mark.thorough
def test_a_device_that_never_answers_is_asked_more_and_more_rarely_and_the_others_as_ever() -> None:
    polling = poll_for(9.99, lambda: IN_STEP, lambda p: _answer_after(p, 0.001, deaf=b"\2"))
    times_s = {payload: [t for t, _, sent in polling.line.sent if sent == payload] for payload in (b"\1", b"\2", b"\3")}
    assert len(times_s[b"\1"]) == len(times_s[b"\3"]) == 500
    assert np.diff(times_s[b"\2"]) == pytest.approx([0.02, 0.02, 0.26, 0.52, 1.02] + [2.02] * 4, abs=0.011)
    assert polling.counters.polls_unanswered == len(times_s[b"\2"])
    assert polling.counters.polls_missed == 0


@pytest.mark.thorough
def test_a_device_that_answers_again_is_asked_as_often_as_before() -> None:
    deaf = [True]

    async def answer(polling: Polling) -> None:
        answered = 0
        while True:
            await asyncio.sleep(0.0005)
            for _, identifier, payload in polling.line.sent[answered:]:
                answered += 1
                if payload != b"\2" or not deaf[0]:
                    polling.hear(identifier + 1, payload)

    async def come_back(polling: Polling) -> None:
        answering = asyncio.create_task(answer(polling))
        await asyncio.sleep(1.5)
        deaf[0] = False
        await answering

    line = poll_for(9.99, lambda: IN_STEP, come_back).line
    times_s = np.array([time_s for time_s, _, payload in line.sent if payload == b"\2"])
    pauses_s = np.diff(times_s)
    back = np.flatnonzero(times_s > 1.5 + times_s[0])[0]
    assert times_s[back] - times_s[0] < 1.5 + 2.1
    assert pauses_s[back:] == pytest.approx(0.02, abs=0.002)


@pytest.mark.parametrize("polls", [IN_STEP[:1], [replace(ASK, payload=bytes([n])) for n in range(3)]])
def test_who_disturbs_nobody_is_asked_as_often_as_ever(polls: list[Poll]) -> None:
    """One that is alone on its line, and those that nobody waits for."""
    polling = poll_for(1.99, lambda: polls)
    assert len(polling.line.sent) == 100 * len(polls)
    assert polling.counters.polls_missed == 0


class Hand(CanAdapter[NoOptions]):
    """Three fingers that only answer."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    layout = Layout([Frame("answer", [Identifier(0x200, 0x7F0)], (2,), Values(0, "<u2", 1), patch=Bits(0, 4))])
    patches = tuple(Patch(f"finger {n}", [Module(taxels(1, first_uid=n))], key=n) for n in (1, 2, 3))
    polls = tuple(Poll(0x100 | n, b"", 0.02, answer=Match(0x200 | n), timeout_s=0.01) for n in (1, 2, 3))

    async def revive(self, link: Link, patch: Patch) -> None:
        """There is nothing to set up."""


class Fingers(Device):
    """Their other end; one can be pulled out.

    Attributes:
        out: which.
        asked: how often each was.
    """

    def __init__(self) -> None:
        super().__init__()
        self.out = 0
        self.asked = Counter[int]()

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        finger = identifier & 0xF
        self.asked[finger] += 1
        if finger != self.out:
            self._answers.append(WireFrame(now_ns, 0x200 | finger, self.asked[finger].to_bytes(4, "little")[:2]))


@pytest.mark.thorough
def test_a_finger_that_is_pulled_out_costs_the_others_little_and_comes_back() -> None:
    fingers = Fingers()
    with driving_lines([(Hand(NoOptions()), bus_with(fingers))], "hand") as running, DriverReader("hand") as reader:
        read_until(reader, lambda f: not f.status.any())
        fingers.out = 2
        read_until(reader, lambda f: f.status.astype(bool).tolist() == [False, True, False])
        before = fingers.asked.copy()
        wait_until(lambda: fingers.asked[1] > before[1] + 100)
        assert 1 <= fingers.asked[2] - before[2] <= 10
        unanswered = running.status()["buses"][0]["polls_unanswered"]
        assert unanswered <= 3 + 10 + (fingers.asked[2] - before[2])
        fingers.out = 0
        read_until(reader, lambda f: not f.status.any())
        before = fingers.asked.copy()
        wait_until(lambda: fingers.asked[1] > before[1] + 50)
        assert fingers.asked[2] > before[2] + 40


def test_devices_too_slow_for_the_period_have_their_turns_and_it_is_counted() -> None:
    polling = poll_for(0.3, lambda: IN_STEP, lambda p: _answer_after(p, 0.009))
    shares = np.bincount([payload[0] for payload in polling.line.payloads])[1:]
    assert shares.min() > 8
    assert shares.max() - shares.min() <= 2
    assert polling.counters.polls_missed > 5
    assert polling.counters.polls_unanswered == 0


def test_a_handshake_and_a_poll_in_lock_step_never_ask_at_the_same_time() -> None:
    asked: list[Reply] = []

    async def ask_too(polling: Polling) -> None:
        answers = asyncio.create_task(_answer_after(polling, 0.003))
        await asyncio.sleep(0.0405)  # a poll is open
        request = asyncio.create_task(polling.link.request(0x7, b"?", Match(0x8), timeout_s=1))
        await asyncio.sleep(0.05)
        batch = FrameBatch(1)
        batch.append(0, 0, 0x8, b"!")
        polling.link.offer(batch, np.arange(1))
        asked.append(await request)
        await answers

    line = poll_for(0.2, lambda: IN_STEP, ask_too).line
    assert asked[0].payload == b"!"
    at = line.payloads.index(b"?")
    times_s = line.times_s
    assert times_s[at] - times_s[at - 1] > 0.0029  # the open one was answered first
    assert times_s[at + 1] - times_s[at] > 0.03  # and the next one waited for this one


def test_an_answer_is_heard_among_the_data(caplog: pytest.LogCaptureFixture) -> None:
    """A running driver: the answer belongs to the layout, and lets the next question out all the same."""
    slow = replace(ASK, period_s=0.002, answer=Match(0x101), timeout_s=20.0)

    class InStep(Answering):
        polls = (slow,)

    device = Device()
    with driving_lines([(InStep(NoOptions()), bus_with(device))], "in_step") as running:
        wait_until(lambda: len(device.asked_ns) > 20)
        assert running.status()["buses"][0]["polls_unanswered"] == 0
    assert not caplog.records


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Poll(0x100, b"", 0), "poll 100 every 0 s: give more than 0"),
        (lambda: Poll(0x100, b"", 1, timeout_s=1), "poll 100 has a timeout and no `answer`"),
        (lambda: Poll(0x100, b"", 1, Match(1), 0), "poll 100 waits 0 s for its answer"),
    ],
)
def test_polls_that_cannot_be_are_refused(make: Callable[[], Poll], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        make()


@pytest.mark.parametrize(
    ("polls", "wire_s", "words"),
    [
        (IN_STEP, 0.004, ""),
        (
            IN_STEP,
            0.007,
            "all questions and answers take 105 % of the time that their periods leave on the line: ask for",
        ),
        ([replace(ASK, payload=b"")] * 9, 0.003, "all questions and answers take 135 % of the time"),
        (
            [replace(p, timeout_s=0.03) for p in IN_STEP],
            0,
            "poll 100 waits 30 ms for its answer, longer than its period",
        ),
        ([replace(IN_STEP[0], timeout_s=0.03)], 0, ""),  # nobody waits for it
        ([replace(p, timeout_s=None) for p in IN_STEP], 0, ""),
    ],
)
def test_polls_that_are_too_much_for_the_line_are_told(polls: list[Poll], wire_s: float, words: str) -> None:
    doubt = check_polls(polls, lambda _: wire_s)
    assert doubt.startswith(words)
    assert bool(doubt) == bool(words)


def test_polls_that_cannot_be_answered_in_time_are_refused() -> None:
    words = "poll 100 waits 10 ms for its answer, but question and answer alone take 12 ms on the line: make timeout_s"
    with pytest.raises(ConfigurationError, match=words):
        check_polls(IN_STEP, lambda _: 0.012)


def test_polls_are_checked_when_their_times_change_and_not_before_each_question() -> None:
    checked: list[int] = []
    line, called = Line(), itertools.count()

    def polls() -> list[Poll]:
        number = next(called)
        return [replace(ASK, payload=bytes([number % 256]), period_s=0.001 if number < 20 else 0.0005)]

    async def scenario() -> None:
        poller = Poller(Link(line), BusCounters(), lambda polls: checked.append(len(polls)))  # type: ignore[arg-type]
        task = asyncio.create_task(poller.run(polls, lambda: False))
        async with asyncio.timeout(30):
            while len(line.sent) < 60:  # noqa: ASYNC110
                await asyncio.sleep(0.001)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(scenario())
    assert checked == [1, 1]


def test_late_answers_are_answers_and_devices_are_followed_at_their_pace(caplog: pytest.LogCaptureFixture) -> None:
    """Four devices on one line that answer 24 ms after they were asked, where the driver waits 20 ms."""
    polls = [Poll(16 * n, bytes([n]), 0.2, answer=Match(16 * n + 1), timeout_s=0.02) for n in range(1, 5)]
    polling = poll_for(3.0, lambda: polls, lambda polling: _answer_after(polling, 0.024))
    asked = Counter(polling.line.payloads)
    assert min(asked.values()) >= 14  # no pause grows
    assert polling.counters.polls_unanswered <= len(polls)  # once each, until it is known that they take longer
    assert polling.counters.polls_late >= len(polling.line.sent) - 2
    lines = [record.getMessage() for record in caplog.records if "after timeout_s = 20 ms" in record.getMessage()]
    assert len(lines) == len(polls)


def test_one_late_answer_does_not_hold_up_the_others_for_long() -> None:
    """A device that was late gets more time with the next question, and half of that with each one after."""
    polls = [Poll(16 * n, bytes([n]), 0.2, answer=Match(16 * n + 1), timeout_s=0.01) for n in (1, 2)]

    async def answering(polling: Polling) -> None:
        for number in itertools.count():
            while len(polling.line.sent) <= number:  # noqa: ASYNC110 - as _answer_after looks
                await asyncio.sleep(0.0005)
            if number == 0:
                await asyncio.sleep(0.09)  # both answers are late
            elif number == 20:
                continue  # lost
            _, identifier, payload = polling.line.sent[number]
            polling.hear(identifier + 1, payload)

    polling = poll_for(2.35, lambda: polls, answering)
    assert (polling.counters.polls_late, polling.counters.polls_unanswered) == (2, 3)
    times_s = polling.line.times_s
    assert times_s[21] - times_s[20] == pytest.approx(0.01, abs=0.001)


def test_a_late_answer_that_comes_after_the_next_question_is_of_its_own_device() -> None:
    polls = [Poll(16 * n, bytes([n]), 0.1, answer=Match(16 * n + 1), timeout_s=0.01) for n in (1, 2)]

    async def answering(polling: Polling) -> None:
        await asyncio.sleep(0.012)
        assert len(polling.line.sent) == 2
        polling.hear(17, b"\x01")  # while the second is asked
        await asyncio.sleep(0)
        assert polling.counters.polls_late == 1
        assert polling.counters.polls_unanswered == 1

    polling = poll_for(0.015, lambda: polls, answering)
    assert polling.counters.polls_late == 1
