"""When frames are published, with a clock that the test owns."""

from __future__ import annotations

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, PatchState, Status
from skinware_drivers.counters import BusCounters
from skinware_drivers.decoding.decoder import PATCH_COUNTERS
from skinware_drivers.polling import Watch
from skinware_drivers.running import publisher as publisher_module
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS
from tests.sdk.test_roboskin_wire import MS, Rig, Wire, halves
from tests.specification import publishing
from tests.specification.publishing import SpecifiedPublisher

PERIOD_S = 0.05
SLOTS = 8


class Clock:
    now_ns = 10_000 * MS


class Desk:
    """A publisher of one board, or more, in front of a real ring; ``watched`` as the driver watches them."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        boards: tuple[int, ...] = (7,),
        *,
        watched: bool = False,
        slots: int = SLOTS,
    ) -> None:
        self.clock = clock = Clock()
        for module in (publisher_module, publishing):
            monkeypatch.setattr(module, "now_ns", lambda: clock.now_ns)
        self.rig = Rig(boards=boards)
        tables = self.rig.decoder.tables
        self.writer = DriverWriter(
            "desk", tables.structure, bus_counters=ALL_BUS_COUNTERS, patch_counters=PATCH_COUNTERS, slots=slots
        )
        self.watch = self.rig.driver.watch(tables) if watched else Watch(tables)
        self.publisher = SpecifiedPublisher(self.writer, self.rig.decoder, self.watch, PERIOD_S, True)
        self.reader = DriverReader("desk")

    def feed(self, frames: list[Wire]) -> None:
        decoder, batch = self.rig.decoder, self.rig.batch
        decoder.put_back(batch)
        for time_ns, identifier, payload in frames:
            batch.append(0, time_ns, identifier, payload)
        updates, foreign = decoder.decode(batch)
        decoder.count_unknown(batch, foreign)
        self.publisher.take(updates)

    def burst(self, value: int, triangles: range = range(16), board: int = 7) -> list[Wire]:
        frames = []
        for triangle in triangles:
            frames += halves(triangle, value, time_ns=self.clock.now_ns + triangle * 260_000, board=board)
        return frames

    def close(self) -> None:
        self.reader.close()
        self.writer.close()


def test_the_first_burst_of_a_patch_is_not_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(monkeypatch)
    desk.clock.now_ns += 600 * MS  # set-up takes longer than a patch may be silent
    desk.feed(desk.burst(1, range(3)))
    assert desk.writer.sequence == 0
    desk.feed(desk.burst(1, range(3, 16)))
    assert desk.writer.sequence == 1
    frame = desk.reader.read()
    assert not frame.status.any()
    assert set(frame.values.tolist()) == {1}
    desk.close()


def test_a_cycle_with_a_lost_module_is_published_before_the_next_one_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(monkeypatch)
    desk.feed(desk.burst(1))
    desk.clock.now_ns += 50 * MS
    desk.feed(desk.burst(2, range(15)))  # both halves of triangle 15 got lost
    assert desk.writer.sequence == 1
    desk.clock.now_ns += 50 * MS
    desk.feed(desk.burst(3))
    assert desk.writer.sequence == 3
    frames = [desk.reader._ring.copy(sequence) for sequence in (2, 3)]
    assert [set(f.values[:180].tolist()) for f in frames if f] == [{2}, {3}]
    old_ns = [f.module_time_ns[14] - f.module_time_ns[15] for f in frames if f]
    assert old_ns[0] > 40 * MS >= old_ns[1]  # its data is as old as it is, which is not too old yet
    assert [set(f.status.tolist()) for f in frames if f] == [{0}, {0}]
    desk.close()


def test_a_board_that_sends_halves_only_is_not_live(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(monkeypatch)
    for value in range(10):
        desk.clock.now_ns += 50 * MS
        desk.feed(desk.burst(value)[::2])
    desk.publisher.publish()
    assert desk.reader.read().patch_state.tolist() == [PatchState.EXPECTED]
    desk.feed(desk.burst(1))
    assert desk.reader.read().patch_state.tolist() == [PatchState.LIVE]
    desk.close()


def test_many_cycles_at_once_become_a_frame_each(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(monkeypatch)
    frames: list[Wire] = []
    for value in range(1, 6):
        desk.clock.now_ns += 50 * MS
        frames += desk.burst(value)
    desk.feed(frames)
    assert desk.writer.sequence == 5
    copies = [desk.reader._ring.copy(sequence) for sequence in range(1, 6)]
    assert [set(f.values.tolist()) for f in copies if f] == [{1}, {2}, {3}, {4}, {5}]
    desk.close()


@pytest.mark.parametrize("triangles", [range(16), range(3, 4)])
def test_a_take_publishes_no_more_than_the_ring_holds_and_counts_what_it_skips(
    monkeypatch: pytest.MonkeyPatch, triangles: range
) -> None:
    """What is overwritten before anybody could read it costs time, in which the driver does nothing else."""
    desk = Desk(monkeypatch)
    desk.feed(desk.burst(1, triangles))
    counters = [BusCounters()]
    desk.publisher.buses.counters = counters
    before, taken = desk.writer.sequence, 40
    frames: list[Wire] = []
    for value in range(1, taken + 1):
        desk.clock.now_ns += 50 * MS
        frames += desk.burst(value, triangles)
    desk.feed(frames)
    published = desk.writer.sequence - before
    assert 2 <= published <= SLOTS
    if desk.publisher.state.updated.any():  # the last one waits for the others of its board
        desk.clock.now_ns += 100 * MS
        desk.publisher.publish_if_due(desk.clock.now_ns)
        published = desk.writer.sequence - before
    frame = desk.reader.read()
    values = frame.values.reshape(16, 12)[triangles]
    assert set(values.ravel().tolist()) == {taken}  # the newest
    first = 0 if before else 1  # the update before these
    assert counters[0].updates_skipped == (taken + first - published) * len(triangles)
    desk.close()


def test_a_missing_board_holds_nothing_up_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(monkeypatch, boards=(7, 8))
    desk.feed(desk.burst(1))
    assert desk.writer.sequence == 0
    assert desk.publisher.deadline_ns - desk.clock.now_ns == 75 * MS
    for value in range(2, 10):
        desk.clock.now_ns += 50 * MS
        desk.feed(desk.burst(value))
    assert desk.writer.sequence >= 7  # at first it is waited for, then it does not count as living
    assert np.all(desk.reader.read().status[192:] == Status.NEVER_SEEN)
    before = desk.writer.sequence
    desk.clock.now_ns += 50 * MS
    desk.feed(desk.burst(10))
    assert desk.writer.sequence == before + 1
    assert set(desk.reader.read().values[:192].tolist()) == {10}  # shown when it is whole, not when the next begins
    desk.close()


def test_boards_that_send_together_are_shown_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever was heard first, a frame ends before the pause, not behind it."""
    desk = Desk(monkeypatch, (7, 9))
    for period in range(10):
        for board, pause_ms in ((9, 45), (7, 5)):
            desk.feed(desk.burst(period, board=board))
            desk.clock.now_ns += pause_ms * MS
    frames = [desk.reader._ring.copy(sequence) for sequence in range(1, desk.writer.sequence + 1)]
    shown = [(bool(np.ptp(frame.module_time_ns) > 40 * MS), set(frame.values.tolist())) for frame in frames if frame]
    assert shown[:2] == [(True, {2}), (True, {3})]
    assert shown[2:] == [(False, {value - 1, value}) for value in range(4, 10)]  # without a period left out
    desk.close()


def test_what_arrived_and_was_not_taken_yet_may_belong_to_the_burst(monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver that was held up between its take and its look at the clock would cut all bursts from then on."""
    desk = Desk(monkeypatch)
    desk.feed(desk.burst(3))
    desk.clock.now_ns += 50 * MS
    burst, before = desk.burst(4), desk.writer.sequence
    desk.feed(burst[:12])
    read_ns = burst[11][0]
    desk.clock.now_ns += 200 * MS
    desk.publisher.publish_if_due(read_ns)
    assert desk.writer.sequence == before
    desk.feed(burst[12:])
    desk.publisher.publish_if_due(desk.clock.now_ns)
    frame = desk.reader.read()
    assert frame.sequence == before + 1
    assert set(frame.values.tolist()) == {4}
    assert not frame.status.any()
    desk.feed(desk.burst(5)[:12])
    desk.clock.now_ns += 200 * MS
    desk.publisher.publish_if_due(desk.clock.now_ns)  # nothing more has come: the burst is over
    assert desk.writer.sequence == before + 2
    desk.close()
