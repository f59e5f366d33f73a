"""What is published is in the file, whatever comes, dies, comes back changed and goes."""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path

import numpy as np
import pytest

import skinware.recording
from skinware import Namespace
from skinware.errors import StructureError
from skinware.recording.files import Files, Past
from skinware.recording.recorder import Recorder
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill, publishing
from tests.recording.rig import Contents, contents_of, has, pose_service, publish, publish_pose, recording


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "skin.mcap"


def recorded(opened: skinware.recording.Recording, service: str) -> Contents:
    return {frame.position: contents_of(frame) for frame in opened[service].frames()}


def test_a_driver_and_a_service_that_come_later_are_recorded_whole(path: Path, namespace: Namespace) -> None:
    with recording(path) as recorder:
        wait_until(lambda: bool(recorder.messages))  # it runs, and there is not even a namespace
        with FakeSkin("torso") as skin, pose_service(slots=64) as pose:
            skin.break_some()
            for number in range(1, 61):
                publish_pose(pose, number)
                time.sleep(0.002)
            seen = publish(skin, 60)
            wait_until(lambda: recorder.messages.get("/skin/torso/frame") == 60)
        assert recorder.lost == 0
    with skinware.recording.open(path) as opened:
        assert opened.is_whole
        assert (opened.services, opened.drivers, opened.lost, opened.problems) == (("pose", "torso"), ("torso",), 0, [])
        assert recorded(opened, "torso") == seen
        torso, pose_track = opened["torso"], opened["pose"]
        assert torso.structure == skin.structure
        assert [frame.sequence for frame in pose_track.frames()] == list(range(1, 61))
        series = pose_track.read()
        assert series.column("angle").shape == (60, 2, 3)
        assert series.column("joint")["name"][6].tolist() == [b"j7"] * 4
        assert series.column("count").tolist() == [-number for number in range(1, 61)]
        assert [frame.flags for frame in pose_track.frames()] == list(range(1, 61))
        (generation,) = pose_track.generations
        assert generation.static()["names"].tolist() == [b"a", b"b"]
        assert recorder.messages == {**dict.fromkeys(recorder.messages, 0), **recorder.messages}
        assert recorder.messages["/skin/pose/frame"] == 60


def test_restarts_and_another_structure_are_followed(path: Path) -> None:
    seen: list[Contents] = []
    with recording(path) as recorder:
        for patches in (4, 4, 2):
            with FakeSkin("torso", fake_structure(patches)) as skin:
                seen.append(publish(skin, 20))
                number = sum(map(len, seen))
                wait_until(lambda number=number: recorder.messages.get("/skin/torso/frame", 0) == number)  # type: ignore[misc]
        assert recorder.lost == 0
    with skinware.recording.open(path) as opened:
        torso = opened["torso"]
        assert recorded(opened, "torso") == seen[0] | seen[1] | seen[2]
        assert len(torso.generations) == 3
        first, second = torso.parts
        assert (len(first.read()), len(second.read())) == (40, 20)
        assert first.structure == fake_structure(4)
        assert second.structure == fake_structure(2)
        with pytest.raises(StructureError, match="use its parts"):
            torso.read()
        assert [event["event"] for event in opened.events if event["event"] in ("found", "restarted")] == [
            "found",
            "restarted",
            "restarted",
        ]
        layouts = []
        for snapshot in opened.snapshots():
            if snapshot.layout not in layouts:
                layouts.append(snapshot.layout)
        assert [layout.structures[0].n_patches for layout in layouts][-1] == 2


def test_a_killed_driver_is_told(path: Path) -> None:
    with recording(path) as recorder:
        with fake_process("torso", "--rate", "50") as process:
            has(recorder, "torso")
            wait_until(lambda: recorder.messages.get("/skin/torso/frame", 0) > 5)
            kill(process)
            time.sleep(0.5)
    with skinware.recording.open(path) as opened:
        assert [event["event"] for event in opened.events] == ["found", "dead"]
        assert list(opened.snapshots())[-1].layout.drivers == ("torso",)


def test_what_could_not_be_taken_is_told(path: Path) -> None:
    with FakeSkin("torso", slots=4) as skin, recording(path) as recorder:
        skin.publish()
        has(recorder, "torso")
        for _ in range(30):
            skin.publish(40)  # at once: the ring has 4 slots
            time.sleep(0.01)
        wait_until(lambda: recorder.messages.get("/skin/torso/frame", 0) + recorder.lost == 1201)
    with skinware.recording.open(path) as opened:
        sequence = opened["torso"].read(["status"]).sequence.astype(int)
        assert opened.lost == recorder.lost > 0
        told = {event["before"]: event["count"] for event in opened.events if event["event"] == "lost"}
        gaps = np.diff(sequence, prepend=0)  # the first one of all may be lost too
        assert {int(sequence[at]): int(gaps[at]) - 1 for at in np.flatnonzero(gaps > 1)} == told


def test_only_what_was_asked_for(path: Path) -> None:
    with FakeSkin("torso") as torso, FakeSkin("arm") as arm, recording(path, names=["arm"]) as recorder:
        arm.publish()
        torso.publish()
        wait_until(lambda: "/skin/arm/frame" in recorder.messages)
    with skinware.recording.open(path) as opened:
        assert opened.services == ("arm",)


def test_the_past_is_kept_and_saved_when_it_is_wanted(path: Path) -> None:
    target = Past(path, 0.6)
    with recording(path, target) as recorder, publishing(FakeSkin("torso")):
        has(recorder, "torso")
        time.sleep(1.5)
        assert not path.exists()
        recorder.save()
        wait_until(lambda: len(target.paths) == 1 and path.exists())
    assert target.paths == [path, path.with_name("skin-2.mcap")]
    for file in target.paths:
        with skinware.recording.open(file) as opened:
            assert opened.is_whole
            assert 0.3 < opened.duration_s < 1.5
            sequence = opened["torso"].read(["status"]).sequence
            assert sequence[0] > 1
            assert (np.diff(sequence) == 1).all()


def test_files_of_a_size_each_complete_and_the_oldest_removed(path: Path) -> None:
    target = Files(path, split_size=30_000, max_size=100_000)
    with FakeSkin("torso") as skin, recording(path, target) as recorder:
        for _ in range(60):
            publish(skin, 10, 0.0)
            time.sleep(0.02)
        wait_until(lambda: len(target.paths) > 1)
    assert target.size <= 100_000 + 30_000
    assert sorted(path.parent.iterdir()) == target.paths
    following = None
    for file in target.paths:
        with skinware.recording.open(file) as opened:
            sequence = opened["torso"].read(["status"]).sequence
            assert following in (None, sequence[0])
            following = sequence[-1] + 1
    assert recorder.lost == 0
    assert following == 601


def test_a_size_at_which_it_ends(path: Path) -> None:
    target = Files(path, max_size=20_000)
    with publishing(FakeSkin("torso")), recording(path, target) as recorder:
        has(recorder, "torso")
        wait_until(lambda: target.is_full)
    assert path.stat().st_size < 60_000
    with skinware.recording.open(path) as opened:
        assert opened.is_whole


@pytest.mark.parametrize("how", ["nearly full", "full", "full to the last byte", "full for good"])
def test_a_full_disk_costs_nothing_that_was_written(path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    room = 40_000
    write, failed = os.write, False

    def on_full_disk(fd: int, data: memoryview) -> int:
        if path.exists() and os.path.samestat(os.fstat(fd), path.stat()):
            left = room - os.fstat(fd).st_size
            nonlocal failed
            if left <= 0 or (how == "full" and len(data) > left) or (failed and how == "full for good"):
                failed = True
                raise OSError(errno.ENOSPC, "No space left on device")
            return write(fd, data[:left])
        return write(fd, data)

    def free(fd: int) -> os.statvfs_result:
        left = max(0, room + 70_000 - os.fstat(fd).st_size) if how == "nearly full" else 1 << 30
        return os.statvfs_result((1, 1, left, left, left, 0, 0, 0, 0, 255))

    monkeypatch.setattr("skinware.recording.mcap_writing.os.write", on_full_disk if how != "nearly full" else write)
    monkeypatch.setattr("skinware.recording.mcap_writing.os.fstatvfs", free)
    with publishing(FakeSkin("torso")):
        recorder = Recorder(Files(path))
        with pytest.raises(OSError, match="No space left on device") as raised:
            recorder.run()
    assert raised.value.filename == str(path)
    monkeypatch.undo()
    with skinware.recording.open(path) as opened:
        if how in ("nearly full", "full for good"):  # otherwise there may be just room for the summary
            assert opened.is_whole == (how == "nearly full")
        assert len(opened["torso"].read(["values"])) == recorder.messages["/skin/torso/frame"] > 20
        assert opened.problems == []
