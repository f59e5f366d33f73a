"""Boards without a common clock: which of their bursts share a frame, however the stream is cut into batches."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skinware import Status
from tests.sdk.test_publisher import Desk
from tests.sdk.test_roboskin_wire import MS, Wire, halves

BOARDS = (7, 8, 9)
TRIANGLES = 16
N = 12  # bursts of each board


@dataclass(frozen=True)
class Sender:
    """A board's clock: when its bursts begin, and how long they take."""

    phase_ms: float
    period_ms: float
    burst_ms: float

    def frames(self, board: int, first_ns: int, missing: set[tuple[int, int]]) -> list[Wire]:
        """N bursts; those of number k carry the value k, from 1 on. Missing: (burst, triangle), from 1 and 0 on."""
        found: list[Wire] = []
        for burst in range(1, N + 1):
            begin_ns = first_ns + round((self.phase_ms + (burst - 1) * self.period_ms) * MS)
            for triangle in range(TRIANGLES):
                if (burst, triangle) in missing:
                    continue
                time_ns = begin_ns + round(triangle * self.burst_ms * MS / TRIANGLES)
                found += halves(triangle, burst, time_ns=time_ns, board=board)
        return found


class Recorder:
    """Plays a stream to a publisher in batches, on a clock of its own, and keeps what was published."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.shown: list[dict[int, list[int]]] = []  # per frame, per board: burst number of every fresh triangle
        self._times = np.zeros(len(BOARDS) * TRIANGLES, np.int64)
        publish = desk.publisher.publish
        desk.publisher.publish = lambda: self._publish(publish)  # type: ignore[method-assign]

    def _publish(self, publish: Callable[[], None]) -> None:
        publish()
        frame = self.desk.reader.read()
        fresh = np.flatnonzero(frame.module_time_ns != self._times)
        self._times = frame.module_time_ns.copy()
        values = frame.values.reshape(-1, 12)
        assert (values == values[:, :1]).all(), "a torn triangle"
        found: dict[int, list[int]] = {}
        for module in fresh.tolist():
            found.setdefault(BOARDS[module // TRIANGLES], []).append(int(values[module, 0]))
        self.shown.append(found)

    def play(self, stream: list[Wire], cuts: list[int]) -> None:
        stream = sorted(stream, key=lambda wire: wire[0])
        clock, publisher = self.desk.clock, self.desk.publisher
        edges = sorted({0, len(stream), *(cut % len(stream) for cut in cuts)})
        for begin, end in itertools.pairwise(edges):
            arrival_ns = stream[end - 1][0] + 100_000
            while publisher.deadline_ns < stream[begin][0]:  # later there is something to read, which comes first
                clock.now_ns = max(clock.now_ns, publisher.deadline_ns)
                publisher.publish_if_due(clock.now_ns)
            clock.now_ns = max(clock.now_ns, arrival_ns)
            self.desk.feed(stream[begin:end])
        for _ in range(3):
            clock.now_ns = max(clock.now_ns, publisher.deadline_ns)
            publisher.publish_if_due(clock.now_ns)

    def check(self, missing: dict[int, set[tuple[int, int]]]) -> None:
        """Every burst of every board is in exactly one frame, in order, with all its modules."""
        for board in BOARDS:
            bursts = [frame[board] for frame in self.shown if board in frame]
            assert [sorted(set(burst)) for burst in bursts] == [[k] for k in range(1, N + 1)], board
            sizes = [TRIANGLES - sum(b == k for b, _ in missing.get(board, ())) for k in range(1, N + 1)]
            assert [len(burst) for burst in bursts] == sizes, board


def senders(longest_burst_ms: float) -> st.SearchStrategy[Sender]:
    return st.builds(
        Sender,
        phase_ms=st.floats(0, 50),
        period_ms=st.floats(48, 52),
        burst_ms=st.floats(5, longest_burst_ms),
    )


batches = st.lists(st.integers(0, 10_000), min_size=60, max_size=200)


Missing = dict[int, set[tuple[int, int]]]


def check_bursts(
    monkeypatch: pytest.MonkeyPatch, clocks: tuple[Sender, ...], cuts: list[int], missing: Missing
) -> None:
    with monkeypatch.context() as patch:
        desk = Desk(patch, boards=BOARDS, slots=64)
        try:
            recorder = Recorder(desk)
            stream: list[Wire] = []
            for board, sender in zip(BOARDS, clocks, strict=True):
                stream += sender.frames(board, desk.clock.now_ns + 10 * MS, missing.get(board, set()))
            recorder.play(stream, cuts)
            recorder.check(missing)
        finally:
            desk.close()


@pytest.mark.thorough
@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(clocks=st.tuples(*[senders(40)] * 3), cuts=batches)
def test_a_frame_holds_whole_bursts_of_drifting_boards(
    monkeypatch: pytest.MonkeyPatch, clocks: tuple[Sender, Sender, Sender], cuts: list[int]
) -> None:
    check_bursts(monkeypatch, clocks, cuts, {})


@pytest.mark.thorough
@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    clocks=st.tuples(*[senders(30)] * 3),
    cuts=batches,
    lost=st.sets(st.tuples(st.sampled_from(BOARDS), st.integers(2, N), st.integers(0, TRIANGLES - 1)), max_size=6),
)
def test_lost_modules_mix_no_bursts(
    monkeypatch: pytest.MonkeyPatch,
    clocks: tuple[Sender, Sender, Sender],
    cuts: list[int],
    lost: set[tuple[int, int, int]],
) -> None:
    missing = {board: {(burst, triangle) for b, burst, triangle in lost if b == board} for board in BOARDS}
    check_bursts(monkeypatch, clocks, cuts, missing)


def test_one_board_begins_in_the_middle_of_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """The case in plain numbers: 8's second burst begins while 7 is half-way through its first."""
    desk = Desk(monkeypatch, boards=(7, 8))
    start_ns = desk.clock.now_ns
    first = [wire for t in range(16) for wire in halves(t, 1, time_ns=start_ns + t * MS, board=8)]
    slow = [wire for t in range(16) for wire in halves(t, 1, time_ns=start_ns + 20 * MS + t * MS, board=7)]
    second = [wire for t in range(16) for wire in halves(t, 2, time_ns=start_ns + 28 * MS + t * MS, board=8)]
    everything = sorted(first + slow + second, key=lambda wire: wire[0])
    middle = next(i for i, wire in enumerate(everything) if wire[0] > start_ns + 30 * MS)
    desk.clock.now_ns = start_ns + 30 * MS
    desk.feed(everything[:middle])
    assert desk.writer.sequence == 0  # neither cut off, nor overwritten
    desk.clock.now_ns = start_ns + 44 * MS
    desk.feed(everything[middle:])
    frame = desk.reader.read()
    assert desk.writer.sequence == 1
    assert set(frame.values.tolist()) == {1}
    assert not (frame.status & Status.STALE).any()
    desk.clock.now_ns += 26 * MS
    for triangle in range(16):
        desk.feed(halves(triangle, 2, time_ns=start_ns + 70 * MS + triangle * MS, board=7))
    frame = desk.reader.read()
    assert desk.writer.sequence == 2
    assert set(frame.values.tolist()) == {2}
    desk.close()
