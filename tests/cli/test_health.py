from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from skinware import DriverReader, Structure
from skinware import state as state_module
from skinware.memory.ring import Sample
from skinware.state import (
    GONE,
    GOOD,
    ODD,
    OLD,
    badness,
    count_reasons,
    count_statuses,
    life_of,
    patch_ages_ns,
    rate_now_hz,
    report_of,
    settling,
    state_name,
    status_now,
)
from skinware.status import BusState, PatchState, Status, Why
from tests.cli.fake_skin import FakeSkin, fake_structure

SECOND = 1_000_000_000
NOW_NS = 10**17


def life(silence_s: float | None, rate_hz: float | None = 20.0, *, alive: bool = True, paused: bool = False) -> str:
    """Life of a service whose newest frame came ``silence_s`` ago (None: none came)."""
    service = SimpleNamespace(alive=alive, paused=paused, rate_hz=lambda: rate_hz)
    published_ns = NOW_NS - round((silence_s or 0) * SECOND)
    frame = None if silence_s is None else SimpleNamespace(published_ns=published_ns)
    return life_of(cast(Any, service), cast(Sample | None, frame))


@pytest.fixture
def frozen_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_module, "now_ns", lambda: NOW_NS)
    monkeypatch.setattr(state_module, "_LEAST_SILENCE_NS", SECOND)


def test_what_became_too_old_since_is_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    """The status is as of the frame: a driver that hangs leaves it at 0."""
    with FakeSkin("a", fake_structure(1, 1)) as skin, DriverReader("a") as reader:
        skin.status[3] = Status.OUT_OF_RANGE
        skin.publish()
        frame = reader.read()
        assert status_now("live", frame).tolist() == [0] * 3 + [Status.OUT_OF_RANGE] + [0] * 8
        monkeypatch.setattr(Structure, "age_limits_ns", lambda self, _: np.full(self.n_sensors, SECOND))
        later = status_now("live", frame, frame.published_ns + 2 * SECOND)
        assert later.tolist() == [Status.STALE] * 3 + [Status.OUT_OF_RANGE] + [Status.STALE] * 8


@pytest.mark.usefixtures("frozen_clock")
def test_lives() -> None:
    assert life(None) == "starting"
    assert life(None, alive=False) == "dead"
    assert life(0.1) == "live"
    assert life(0.1, alive=False) == "dead"
    assert life(0.1, paused=True) == "paused"


@pytest.mark.usefixtures("frozen_clock")
@pytest.mark.parametrize(
    ("rate_hz", "silence_s", "expected"),
    [
        (1000.0, 0.99, "live"),  # never before a second has passed
        (1000.0, 1.01, "silent"),
        (None, 1.01, "silent"),
        (2.0, 2.49, "live"),  # and never within five periods
        (2.0, 2.51, "silent"),
    ],
)
def test_a_held_lock_is_no_progress(rate_hz: float | None, silence_s: float, expected: str) -> None:
    assert life(silence_s, rate_hz) == expected


def test_nothing_comes_from_who_is_not_live() -> None:
    assert rate_now_hz("live", 20.0) == 20.0
    assert rate_now_hz("live", None) is None
    assert [rate_now_hz(life, 20.0) for life in ("silent", "paused", "dead", "starting")] == [0.0] * 4


def test_statuses_are_counted_by_bit() -> None:
    status = np.array([0, 0, Status.STALE, Status.STALE | Status.SUSPECT, Status.MASKED], np.uint8)
    counts = count_statuses(status)
    assert list(counts)[:2] == ["fresh", "stale"]
    assert {name: count for name, count in counts.items() if count} == {
        "fresh": 2,
        "stale": 2,
        "suspect": 1,
        "masked": 1,
    }


def test_states_of_a_later_version_stay_numbers() -> None:
    assert [state_name(PatchState, state) for state in (0, 3, 9)] == ["expected", "restarted", "9"]
    assert [state_name(BusState, state) for state in (0, 4, 9)] == ["connecting", "gone", "9"]


def test_a_driver_in_a_few_figures() -> None:
    with FakeSkin("a", fake_structure(2, 4)) as skin, DriverReader("a") as reader:
        assert report_of(reader, None, None).life == "starting"
        skin.break_some()
        skin.publish()
        report = report_of(reader, reader.read(), 19.5)
    assert (report.name, report.life, report.rate_hz, report.sensors) == ("a", "live", 19.5, 96)
    assert report.statuses["fresh"] == 48 - 7
    assert report.patch_states == {"live": 1, "stale": 1}
    assert report.counters == {"frames": 5156, "dropped": 2, "errors": 0, "unknown": 7, "orphans": 3, "updates": 640}


def test_a_calmed_driver_settles() -> None:
    why = np.full(24, int(Why.RELEARNING), np.uint8)
    why[20:] = Why.REST, Why.HELD, Why.HELD, Why.DOUBTED
    with FakeSkin("a", fake_structure(1, 2), why=why) as skin, DriverReader("a") as reader:
        skin.status[:20] = Status.NEVER_SEEN
        skin.publish()
        frame = reader.read()
        report = report_of(reader, frame, 20.0)
        assert settling(frame).tolist() == [True] * 20 + [False] * 4
        assert count_reasons(frame.why) == {"rest": 1, "held": 2, "relearning": 20, "doubted": 1}
        assert (report.statuses["settling"], report.statuses["never_seen"]) == (20, 0)
        assert (report.state, report.state_of(report.patches[0]), report.worst) == ("live", "live", GOOD)
        skin.status[20:] = Status.NOT_CONNECTED
        skin.publish()
        report = report_of(reader, reader.read(newer_than=frame), 20.0)
        assert (report.state, report.state_of(report.patches[0]), report.worst) == ("settling", "settling", ODD)


def test_the_worst_states_are_known() -> None:
    states = ["live", "starting", "settling", "stale", "was live", "was gone", "not fresh", "silent", "down", "dead"]
    assert [badness(state) for state in states] == [GOOD, ODD, ODD, OLD, OLD, OLD, OLD, OLD, GONE, GONE]


def test_nothing_is_fresh_in_the_last_frame_of_a_driver_that_is_gone() -> None:
    skin = FakeSkin("a", fake_structure(1, 2))
    skin.publish()
    with DriverReader("a") as reader:
        frame = reader.read()
        skin.close()
        report = report_of(reader, frame, 20.0)
    assert (report.life, report.rate_hz) == ("dead", 0.0)
    assert (report.statuses["fresh"], report.statuses["stale"]) == (0, 24)
    assert report.patch_states == {"was live": 1}


def test_a_patch_is_as_old_as_its_newest_module(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_module, "now_ns", lambda: 5000)
    structure = fake_structure(3, 2)
    frame = SimpleNamespace(structure=structure, group_time_ns=np.array([1000, 4000, 0, 2000, 0, 0]))
    assert patch_ages_ns(cast(Any, frame)) == [1000, 3000, None]
