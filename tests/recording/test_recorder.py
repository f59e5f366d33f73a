"""What is published is in the file, whatever comes, dies, comes back changed and goes."""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

import skinware.recording
from skinware import Namespace
from skinware.errors import NamespaceError, StructureError
from skinware.realtime import NS_PER_S
from skinware.recording.files import Files, Past
from skinware.recording.mcap_reading import McapSource
from skinware.recording.mcap_writing import McapFile, OpenChunk
from skinware.recording.recorder import Recorder
from skinware.recording.topics import CLOCK, Channels
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill, publishing
from tests.commands import BIN, PATIENCE_S
from tests.recording.rig import Contents, contents_of, has, pose_service, publish, publish_pose, recording


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "skin.mcap"


def recorded(opened: skinware.recording.Recording, service: str) -> Contents:
    return {frame.position: contents_of(frame) for frame in opened[service].samples()}


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
        assert recorder.missed == 0
    with skinware.recording.open(path) as opened:
        assert opened.is_whole
        assert (opened.services, opened.drivers) == (("pose", "torso"), ("torso",))
        assert (opened.missed, opened.problems) == (0, [])
        assert recorded(opened, "torso") == seen
        torso, pose_track = opened["torso"], opened["pose"]
        assert torso.structure == skin.structure
        assert [frame.sequence for frame in pose_track.samples()] == list(range(1, 61))
        series = pose_track.read()
        assert series.column("angle").shape == (60, 2, 3)
        assert series.column("joint")["name"][6].tolist() == [b"j7"] * 4
        assert series.column("count").tolist() == [-number for number in range(1, 61)]
        assert [frame.flags for frame in pose_track.samples()] == list(range(1, 61))
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
        assert recorder.missed == 0
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


@pytest.mark.thorough
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


@pytest.mark.thorough
def test_what_could_not_be_taken_is_told(path: Path) -> None:
    with FakeSkin("torso", slots=4) as skin, recording(path) as recorder:
        skin.publish()
        has(recorder, "torso")
        for _ in range(30):
            skin.publish(40)  # at once: the ring has 4 slots
            time.sleep(0.01)
        wait_until(lambda: recorder.messages.get("/skin/torso/frame", 0) + recorder.missed == 1201)
    with skinware.recording.open(path) as opened:
        sequence = opened["torso"].read(["status"]).sequence.astype(int)
        assert opened.missed == recorder.missed > 0
        told = {event["before"]: event["count"] for event in opened.events if event["event"] == "missed"}
        gaps = np.diff(sequence, prepend=0)  # the first one of all may be lost too
        assert {int(sequence[at]): int(gaps[at]) - 1 for at in np.flatnonzero(gaps > 1)} == told


def test_only_what_was_asked_for(path: Path) -> None:
    with FakeSkin("torso") as torso, FakeSkin("arm") as arm, recording(path, names=["arm"]) as recorder:
        arm.publish()
        torso.publish()
        wait_until(lambda: "/skin/arm/frame" in recorder.messages)
    with skinware.recording.open(path) as opened:
        assert opened.services == ("arm",)


class TimedSkin(FakeSkin):
    """Notes when each of its samples was published: before and after."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.times_ns: list[tuple[int, int]] = []

    def publish(self, count: int = 1) -> None:
        for _ in range(count):
            before_ns = time.monotonic_ns()
            super().publish()
            self.times_ns.append((before_ns, time.monotonic_ns()))


def test_what_came_is_in_the_file_a_quarter_of_a_second_later(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    time_ns = time.monotonic_ns()
    monkeypatch.setattr("skinware.recording.recorder.now_ns", lambda: time_ns)
    with recording(path) as recorder, FakeSkin("torso") as skin:
        skin.publish()
        wait_until(lambda: recorder._coder.bytes_done > 0)
        time_ns += NS_PER_S // 4
        wait_until(lambda: recorder.messages.get("/skin/torso/frame") == 1)


def test_the_past_is_kept_and_saved_when_it_is_wanted(path: Path) -> None:
    target, skin = Past(path, 0.6), TimedSkin("torso")
    with recording(path, target) as recorder, publishing(skin):
        has(recorder, "torso")
        time.sleep(1.5)
        assert not path.exists()
        recorder.save()
        wait_until(lambda: len(target.paths) == 1 and path.exists())
    assert target.paths == [path, path.with_name("skin-2.mcap")]
    for file in target.paths:
        with skinware.recording.open(file) as opened:
            assert opened.is_whole
            sequence = opened["torso"].read(["status"]).sequence
            assert sequence[0] > 1
            assert (np.diff(sequence) == 1).all()
            dropped_ns, newest_ns = skin.times_ns[sequence[0] - 2][0], skin.times_ns[sequence[-1] - 1][1]
            assert newest_ns - dropped_ns > 500_000_000, "all samples of the last 0.6 s are kept"


@pytest.mark.thorough
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
    assert recorder.missed == 0
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


def _delete(path: Path) -> None:
    path.unlink()


def _replace(path: Path) -> None:
    path.with_name("other").write_bytes(b"another file")
    path.with_name("other").rename(path)


def _move(path: Path) -> None:
    path.rename(path.with_name("moved.mcap"))


def _truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


@pytest.mark.parametrize(
    ("disturb", "says"),
    [
        (_delete, "deleted while it was recorded"),
        (_replace, "deleted while it was recorded"),
        (_move, r"all until then is in .*/moved\.mcap"),
        (_truncate, "changed by another program"),
    ],
)
@pytest.mark.parametrize("comes", [True, False], ids=["frames come", "nothing comes"])
def test_a_file_that_is_disturbed_ends_the_recording(
    path: Path, monkeypatch: pytest.MonkeyPatch, disturb: Callable[[Path], None], says: str, *, comes: bool
) -> None:
    monkeypatch.setattr("skinware.recording.recorder._CLOCK_NS", NS_PER_S // 5)
    target = Files(path)
    disturbed = False

    def tell() -> None:
        nonlocal disturbed
        if not disturbed and target.counts.total() > 4:
            disturb(path)
            disturbed = True

    monkeypatch.setattr("skinware.recording.recorder._REPORT_NS", NS_PER_S // 50)
    with publishing(FakeSkin("torso")) if comes else nullcontext(), pytest.raises(OSError, match=says) as raised:
        Recorder(target).run(report=tell)
    assert raised.value.filename == str(path)
    assert target.paths == [path] * (disturb is _truncate)  # nothing else of ours is there
    if disturb is _move:
        with skinware.recording.open(path.with_name("moved.mcap")) as opened:
            assert opened.is_whole
    if disturb is _replace:
        assert path.read_bytes() == b"another file"


def test_what_a_program_left_of_a_file_is_recovered(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware.recording.recorder._REPORT_NS", NS_PER_S // 50)
    target = Files(path)

    def tell() -> None:
        if target.counts.total() > 100 and path.stat().st_size == target.size:  # once
            _truncate(path)

    with publishing(FakeSkin("torso")), pytest.raises(OSError, match="changed by another program"):
        Recorder(target).run(report=tell)
    with skinware.recording.open(path) as opened:
        assert not opened.is_whole
        sequence = opened["torso"].read(["status"]).sequence
        assert sequence.tolist() == list(range(sequence[0], sequence[-1] + 1))  # from the recorder's beginning on


@pytest.mark.thorough
def test_a_long_file_needs_no_more_memory_than_a_short_one(path: Path) -> None:
    file, channels = McapFile(path), Channels()
    for number in range(2000):
        chunk = OpenChunk()
        chunk.add(*channels.of_all(CLOCK), number, number, b"{}")
        file.add(chunk.close())
    assert not isinstance(file._index._file, io.BytesIO)
    file.finish()
    assert [entry for entry in path.parent.iterdir() if entry != path] == []
    with McapSource(path) as source:
        assert source.is_whole
        assert len(source.chunks) == 2000
    with path.open("rb") as stream:
        assert sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == 2000


def test_a_summary_that_cannot_wait_on_the_disk_ends_the_recording(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("skinware.recording.mcap_writing._SPOOL_BYTES", 200)
    monkeypatch.setattr("skinware.recording.mcap_writing.tempfile.TemporaryFile", full)
    with publishing(FakeSkin("torso")), pytest.raises(OSError, match="No space left on device") as raised:
        Recorder(Files(path)).run()
    assert raised.value.filename == str(path)
    with skinware.recording.open(path) as opened:
        assert opened.is_whole


@pytest.mark.thorough
@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("unshare") is None, reason="only root may mount a small disk")
def test_a_real_full_disk(path: Path) -> None:
    disk = path.parent / "disk"
    disk.mkdir()
    script = f"""
        mount --make-rprivate / && mount -t tmpfs -o size=1m small {disk} || exit 77
        {BIN}/skin-record --json -o {disk}/full.mcap; status=$?
        cp {disk}/full.mcap {path}; exit $status
    """
    with publishing(FakeSkin("torso", fake_structure(200))):
        done = subprocess.run(
            ["unshare", "-m", "sh", "-c", script], capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
    if done.returncode == 77 or "unshare failed" in done.stderr:
        pytest.skip(f"no disk can be mounted here: {done.stderr.strip()}")
    stopped = json.loads(done.stdout.splitlines()[-1])
    assert (done.returncode, stopped["event"], stopped["is_complete"]) == (1, "stopped", False)
    assert done.stderr == f"skin-record: {disk}/full.mcap: No space left on device\n"
    with skinware.recording.open(path) as opened:
        assert opened.is_whole
        assert len(opened["torso"].read(["status"])) == stopped["messages"]["/skin/torso/frame"] > 0


def test_a_namespace_that_may_not_be_read_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_: Namespace) -> dict[str, int]:
        raise NamespaceError("the folder may not be read")

    monkeypatch.setattr(Namespace, "service_inodes", refuse)
    Recorder(Files(tmp_path / "a.mcap")).run(0.1)
    assert caplog.messages == ["the folder may not be read"]
