"""A recording that is published again is what was recorded, frame by frame; only the times are those of now."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

import skinware.recording
from skinware import DriverReader, Namespace, Sample, ServiceReader, Skin
from skinware.errors import NameInUse
from skinware.recording import Recording
from skinware.recording.replaying import Replayer
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure
from tests.recording.rig import contents_of, has, pose_service, publish_pose, recording, replaying

TIMES = ("module_time_ns", "bus_since_ns")


def record_two_lives(file: Path) -> None:
    """A driver that restarts, then comes back with other sensors, beside another and a service."""
    with recording(file) as recorder, FakeSkin("arm", fake_structure(1)) as arm, pose_service(rate_hz=50) as pose:
        total = 0
        for patches in (2, 2, 3):
            with FakeSkin("torso", fake_structure(patches)) as torso:
                torso.break_some()
                torso.bus_since_ns[:] = time.monotonic_ns() - 5_000_000_000
                torso.bus_counters[:] = patches
                for number in range(25):
                    torso.publish()
                    if number % 2:
                        arm.publish()
                        publish_pose(pose, number)
                    time.sleep(0.004)
                total += 25
                wait_until(lambda total=total: recorder.messages.get("/skin/torso/frame", 0) == total)  # type: ignore[misc]


def values_of(opened: Recording, name: str) -> list[dict[str, bytes]]:
    """Contents of all frames but times; and of times the ages."""
    found = []
    for frame in opened[name].samples():
        contents = contents_of(frame)
        contents["times"] = np.array([frame.age_ns // 50_000_000, frame.flags]).tobytes()
        for column in TIMES:
            if column in contents:
                times = frame.column(column)
                ages = np.where(times, frame.acquired_ns - times, -1)
                contents[column] = ages.tobytes()
        found.append(contents)
    return found


@pytest.mark.thorough
def test_record_replay_record_is_the_same(tmp_path: Path, namespace: Namespace) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    record_two_lives(first)
    with recording(second) as recorder, replaying(first) as replayer:
        wait_until(lambda: replayer.frames["torso"] == 75 and recorder.messages.get("/skin/torso/frame", 0) == 75)
        wait_until(lambda: recorder.messages.get("/skin/pose/frame", 0) == replayer.frames["pose"])
        wait_until(lambda: recorder.messages.get("/skin/arm/frame", 0) == replayer.frames["arm"])
    with skinware.recording.open(first) as then, skinware.recording.open(second) as now:
        assert then.services == now.services == ("arm", "pose", "torso")
        assert now.missed == 0
        for name in then.services:
            assert values_of(then, name) == values_of(now, name)
            pairs = list(zip(then[name].generations, now[name].generations, strict=True))
            assert len(pairs) == (3 if name == "torso" else 1)
            for before, after in pairs:
                assert before.digest == after.digest
                assert (before.kind, before.period_ns) == (after.kind, after.period_ns)
                assert before.context == after.context
        old, new = then["arm"].read(["status"]), now["arm"].read(["status"])
        assert new.published_ns[0] > old.published_ns[-1]
        assert np.abs((new.time_s - new.time_s[0]) - (old.time_s - old.time_s[0])).max() < 5
    assert namespace.services() == []


def test_readers_and_skins_read_it_as_if_it_lived(tmp_path: Path) -> None:
    file = tmp_path / "skin.mcap"
    with recording(file) as recorder, FakeSkin("torso") as torso:
        for _ in range(60):  # its ring has more slots: a recorder that is held up misses none
            torso.publish()
            time.sleep(0.01)
        wait_until(lambda: recorder.messages.get("/skin/torso/frame", 0) == 60)
    with Skin() as skin, replaying(file, speed=0.5, loop=True):
        snapshot = skin.read(timeout_s=30)
        assert snapshot.layout.drivers == ("torso",)
        assert snapshot.layout.structures == (torso.structure,)
        assert snapshot.fresh("pressure", at_ns=int(snapshot.acquired_ns.max())).all()
        with DriverReader("torso") as reader:
            assert reader.driver_type == "fake"
            assert reader.alive


def test_twice_as_fast_takes_half_the_time_and_keeps_ages(tmp_path: Path) -> None:
    file = tmp_path / "skin.mcap"
    with recording(file) as recorder, pose_service(rate_hz=20) as pose:
        has_begun = time.monotonic()
        for number in range(20):
            publish_pose(pose, number)
            time.sleep(0.05)
        lasted_s = time.monotonic() - has_begun
        has(recorder, "pose")
        wait_until(lambda: recorder.messages.get("/skin/pose/frame", 0) == 20)
    begun_s = time.monotonic()
    with replaying(file, speed=4.0) as replayer:
        with ServiceReader[Sample]("pose", timeout_s=30) as reader:
            assert reader.read().period_ns == 50_000_000 // 4
        wait_until(lambda: replayer.frames["pose"] == 20)
        assert time.monotonic() - begun_s > 0.9 * lasted_s / 4 * 19 / 20


def test_a_name_that_is_in_use_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "skin.mcap"
    with recording(file) as recorder, FakeSkin("torso") as torso:
        torso.publish()
        wait_until(lambda: "/skin/torso/frame" in recorder.messages)
    with FakeSkin("torso"), skinware.recording.open(file) as opened:
        replayer = Replayer(opened)
        with pytest.raises(NameInUse, match="'torso'"):
            replayer.run()
        replayer.close()


@pytest.mark.thorough
def test_frames_that_the_recording_lost_are_lost_in_the_replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    published = 0
    with recording(first) as recorder:
        for slots in (64, 4):  # it restarts in between
            with FakeSkin("torso", fake_structure(1), slots=slots) as torso:
                for count, room in ((1, 1 << 27), (151, 0), (1, 1 << 27)):
                    monkeypatch.setattr("skinware.recording.recorder._MOST_WAITING", room)
                    time.sleep(0.1)
                    torso.publish(count)
                    published += count
                    time.sleep(0.1)
                wait_until(
                    lambda published=published: (  # type: ignore[misc]
                        recorder.messages.get("/skin/torso/frame", 0) + recorder.missed == published
                    )
                )
        lost = recorder.missed
    assert lost > 200
    with recording(second) as recorder, replaying(first, speed=0.5):
        wait_until(lambda: recorder.messages.get("/skin/torso/frame", 0) + recorder.missed == published)
    with skinware.recording.open(first) as then, skinware.recording.open(second) as now:
        old, new = then["torso"].read(["status"]), now["torso"].read(["status"])
        assert new.sequence.tolist() == old.sequence.tolist()
        losses = [
            [(event["count"], event["before"]) for event in opened.events if event["event"] == "missed"]
            for opened in (then, now)
        ]
        assert losses[0] == losses[1]
        assert sum(count for count, _ in losses[0]) == lost == now.missed
