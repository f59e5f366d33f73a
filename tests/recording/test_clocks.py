"""A recording goes on by itself while the wall clock is set and the machine is suspended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

import skinware.recording
from skinware import Namespace
from skinware.conversion.tables import TIME, RecordedSource
from skinware.realtime import NS_PER_S
from skinware.recording.files import Past, Target
from skinware.recording.recorder import Clocks, Recorder, TimeAxis, read_clocks
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin
from tests.recording.rig import has, publish, recording, replaying

HOUR_NS = 3600 * NS_PER_S


class MovedClocks:
    """The clocks of the machine, moved as a test wants it."""

    def __init__(self) -> None:
        self.wall_ns = self.boot_ns = 0

    def __call__(self) -> Clocks:
        now = read_clocks()
        return now._replace(realtime_ns=now.realtime_ns + self.wall_ns, boottime_ns=now.boottime_ns + self.boot_ns)


@pytest.fixture(autouse=True)
def _looks_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware.recording.recorder._CLOCK_NS", NS_PER_S // 50)


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_an_axis_has_no_step(step_ns: int) -> None:
    clocks = Clocks(10 * NS_PER_S, 50 * HOUR_NS, 10 * NS_PER_S)
    axis = TimeAxis(lambda: clocks)
    assert axis.log_ns(12 * NS_PER_S) == axis.wall_ns(12 * NS_PER_S) == 50 * HOUR_NS + 2 * NS_PER_S
    assert axis.look() == []
    clocks = Clocks(11 * NS_PER_S, 50 * HOUR_NS + NS_PER_S + step_ns, 11 * NS_PER_S)
    assert axis.look() == [{"event": "clock_stepped", "service": "", "time_ns": 11 * NS_PER_S, "by_ns": step_ns}]
    assert axis.log_ns(12 * NS_PER_S) == 50 * HOUR_NS + 2 * NS_PER_S
    assert axis.wall_ns(12 * NS_PER_S) == 50 * HOUR_NS + 2 * NS_PER_S + step_ns
    assert axis.look() == []


def test_suspended_time_is_no_step_of_the_wall_clock() -> None:
    clocks = Clocks(NS_PER_S, HOUR_NS, 5 * NS_PER_S)
    axis = TimeAxis(lambda: clocks)
    clocks = Clocks(2 * NS_PER_S, HOUR_NS + 91 * NS_PER_S, 96 * NS_PER_S)
    assert axis.look() == [{"event": "suspended", "service": "", "time_ns": 2 * NS_PER_S, "for_ns": 90 * NS_PER_S}]


def with_a_step(path: Path, wall_ns: int, boot_ns: int = 0, target: Target | None = None) -> list[dict[str, Any]]:
    """Record a driver whose frames lie on both sides of a step of the clocks; what the recorder reports."""
    clocks = MovedClocks()
    with FakeSkin("torso") as skin, recording(path, target, clocks=clocks) as recorder:
        skin.publish()
        has(recorder, "torso")
        publish(skin, 30)
        before = _clocks_recorded(recorder)
        wait_until(lambda: _clocks_recorded(recorder) > before)
        clocks.wall_ns, clocks.boot_ns = wall_ns, boot_ns
        before = _clocks_recorded(recorder)
        wait_until(lambda: _clocks_recorded(recorder) > before + 1)
        publish(skin, 30)
        wait_until(lambda: recorder.messages.get("/skin/torso/frame") == 61)
    return recorder.news()


def _clocks_recorded(recorder: Recorder) -> int:
    return recorder.messages.get("/skin/clock", 0)


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_the_wall_clock_is_set(tmp_path: Path, calm_namespace: Namespace, step_ns: int) -> None:
    path = tmp_path / "walk.mcap"
    (news,) = with_a_step(path, step_ns)
    assert news["event"] == "clock_stepped"
    assert abs(news["by_ns"] - step_ns) < NS_PER_S
    with skinware.recording.open(path) as opened:
        series = opened["torso"].read(["status"])
        published_s = (series.published_ns - series.published_ns[0]) / NS_PER_S
        np.testing.assert_allclose(series.time_s - series.time_s[0], published_s, atol=1e-6)
        assert [moment.frame.sequence for moment in opened.moments() if moment.frame] == list(range(1, 62))
        assert opened.duration_s < 1800
        middle_s = float(series.time_s[40])
        assert [frame.sequence for frame in opened["torso"].samples(start_s=middle_s - 1e-6)] == list(range(41, 62))
        assert [event["event"] for event in opened.events] == ["found", "clock_stepped"]
        walls = [clock["realtime_ns"] - clock["monotonic_ns"] for clock in opened.clock]
        assert abs(walls[-1] - walls[0] - step_ns) < NS_PER_S
    table = RecordedSource(path, 0.0, None).tables[0]
    times = np.concatenate([block[TIME] for block in table.blocks([TIME])])
    assert (np.diff(times) > 0).all()
    assert times[-1] - times[0] < HOUR_NS // 2
    with replaying(path, namespace=calm_namespace, speed=20.0) as replayer:
        wait_until(lambda: replayer.frames["torso"] == 61)


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_other_readers_see_times_that_increase(tmp_path: Path, step_ns: int) -> None:
    path = tmp_path / "walk.mcap"
    with_a_step(path, step_ns)
    with path.open("rb") as file:
        messages = [message for _, _, message in make_reader(file).iter_messages(topics="/skin/torso/frame")]
    assert [message.sequence for message in messages] == list(range(1, 62))  # the package gives them by log_time
    log = np.array([message.log_time for message in messages], np.int64)
    label = np.array([message.publish_time for message in messages], np.int64)
    assert (np.diff(log) > 0).all()
    assert log[-1] - log[0] < HOUR_NS // 2
    assert abs(int((label - log)[-1] - (label - log)[0]) - step_ns) < NS_PER_S


def test_the_last_seconds_are_kept_over_a_step(tmp_path: Path) -> None:
    path = tmp_path / "fall.mcap"
    with_a_step(path, HOUR_NS, target=Past(path, 600.0))
    with skinware.recording.open(path) as opened:
        assert opened["torso"].read(["status"]).sequence.tolist() == list(range(1, 62))


def test_the_machine_is_suspended(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    (news,) = with_a_step(path, HOUR_NS, HOUR_NS)
    assert news["event"] == "suspended"
    assert abs(news["for_ns"] - HOUR_NS) < NS_PER_S
    with skinware.recording.open(path) as opened:
        assert [event["event"] for event in opened.events] == ["found", "suspended"]
        assert opened.duration_s < 1800
