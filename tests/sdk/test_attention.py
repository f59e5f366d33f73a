"""When this process was held up, and what that excuses."""

from __future__ import annotations

import numpy as np
import pytest

from skinware import PatchState
from skinware.realtime import NS_PER_S
from skinware_drivers.running import data_loop
from skinware_drivers.running.data_loop import Attention
from tests.sdk.test_publisher import Desk

MS = 1_000_000


class Clocks:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns, self.slept_ns = 10 * NS_PER_S, 0
        monkeypatch.setattr(data_loop, "now_ns", lambda: self.now_ns)
        monkeypatch.setattr(data_loop, "_slept_ns", lambda: self.slept_ns)


def test_being_late_is_being_held_up(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    clocks = Clocks(monkeypatch)
    process, begun_ns = Attention(), clocks.now_ns
    clocks.now_ns += 500 * MS
    assert process.look(None) is None
    assert process.look(clocks.now_ns - 90 * MS) is None
    since_ns, due_ns = clocks.now_ns, clocks.now_ns + 500 * MS
    clocks.now_ns += 5500 * MS
    assert process.look(due_ns) == (since_ns, 0)
    clocks.now_ns += 5500 * MS
    clocks.slept_ns += 9_500  # two clocks are never read at the same moment
    assert process.look(due_ns) == (since_ns + 5500 * MS, 0)
    assert process.look(due_ns) is None  # it was looked at
    assert "held up for 5.0 s" in caplog.text
    assert begun_ns < since_ns


def test_a_suspended_machine_is_noticed_though_its_clock_stood(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    clocks = Clocks(monkeypatch)
    process = Attention()
    clocks.slept_ns += 60 * NS_PER_S
    assert process.look(clocks.now_ns) == (clocks.now_ns, 60 * NS_PER_S)
    assert process.look(clocks.now_ns) is None
    assert "suspended for 60.0 s" in caplog.text


def test_patches_that_lived_are_excused_and_values_of_before_are_old(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(monkeypatch)
    desk.feed(desk.burst(1))
    before_ns = desk.clock.now_ns
    desk.clock.now_ns += 5 * NS_PER_S
    desk.publisher.excuse(before_ns, 0)
    desk.publisher.publish_if_due(desk.clock.now_ns)
    frame = desk.reader.read()
    assert frame.patch_state.tolist() == [PatchState.LIVE]
    assert not frame.fresh("pressure", at_ns=desk.clock.now_ns).any()
    assert desk.publisher.silent_ns(0) < 0
    desk.clock.now_ns += NS_PER_S
    desk.publisher.publish_if_due(desk.clock.now_ns)
    assert desk.reader.read().patch_state.tolist() == [PatchState.STALE]
    desk.publisher.excuse(desk.clock.now_ns, 0)  # it was silent before
    desk.publisher.publish()
    assert desk.reader.read().patch_state.tolist() == [PatchState.STALE]
    desk.close()


def test_silence_counts_only_while_this_process_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(monkeypatch)
    desk.feed(desk.burst(1))
    desk.clock.now_ns += 60 * NS_PER_S
    desk.publisher.patches.counts_from_ns[0] = desk.clock.now_ns
    assert desk.publisher.silent_ns(0) == 0
    desk.clock.now_ns += 40 * MS
    ran_ns = desk.clock.now_ns
    for _ in range(3):  # held up again and again
        desk.clock.now_ns += 5 * NS_PER_S
        desk.publisher.excuse(ran_ns, 0)
        ran_ns = desk.clock.now_ns
    assert desk.publisher.silent_ns(0) == 40 * MS
    desk.publisher.publish_if_due(desk.clock.now_ns)
    assert desk.reader.read().patch_state.tolist() == [PatchState.STALE]
    desk.close()


def test_what_was_heard_before_the_machine_slept_is_not_fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(monkeypatch)
    desk.feed(desk.burst(1))
    assert desk.reader.read().fresh("pressure", at_ns=desk.clock.now_ns)[:180].all()
    desk.publisher.excuse(desk.clock.now_ns, 60 * NS_PER_S)
    desk.publisher.publish()
    frame = desk.reader.read()
    assert not frame.fresh("pressure", at_ns=desk.clock.now_ns).any()
    assert (frame.module_time_ns > 0).sum() == np.count_nonzero(desk.publisher.state.group_time_ns)
    desk.close()
