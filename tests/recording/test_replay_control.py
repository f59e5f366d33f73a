"""A replay under control: whatever is asked for, its services are what was recorded of that moment."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import skinware.recording
from skinware import DriverReader, Namespace, Sample, ServiceReader
from skinware.errors import Paused, RequestFailed, RequestRefused, ServiceNotFound
from skinware.recording.replaying import Replayer
from skinware.service import ServiceWriter
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill
from tests.recording.rig import (
    contents_of,
    has,
    pose_service,
    publish_pose,
    recording,
    replaying,
    two_drivers_and_a_service,
)

SERVICES = ("arm", "pose", "torso")


@pytest.fixture
def file(made: dict[str, bytes], tmp_path: Path) -> Path:
    """75 frames of a driver, 26 each of another and of a service, in a second."""
    if "skins" not in made:
        two_drivers_and_a_service(tmp_path / "skins.mcap")
        made["skins"] = (tmp_path / "skins.mcap").read_bytes()
    path = tmp_path / "walk.mcap"
    path.write_bytes(made["skins"])
    return path


@contextmanager
def controlling(file: Path, **options: Any) -> Iterator[ServiceReader[Sample]]:
    """A replay that waits, and a reader of whichever of its services is there first."""
    with replaying(file, paused=True, **options) as replayer:
        wait_until(lambda: bool(replayer.frames))
        with ServiceReader[Sample](next(iter(replayer.frames)), timeout_s=30) as reader:
            yield reader


def values(frame: Sample) -> dict[str, bytes]:
    """What does not depend on when it is replayed."""
    contents = contents_of(frame)
    return {name: value for name, value in contents.items() if name not in ("times", "module_time_ns", "bus_since_ns")}


def there() -> dict[str, dict[str, bytes]]:
    """What every service tells now."""
    found = {}
    for name in Namespace().services():
        with ServiceReader[Sample](name, announce=False) as reader:
            if reader.alive:
                found[name] = values(reader.read())
    return found


def recorded(file: Path) -> list[tuple[float, str, dict[str, bytes]]]:
    """All frames of a recording, by time."""
    with skinware.recording.open(file) as opened:
        return [(m.time_s, m.service, values(m.frame)) for m in opened.moments() if m.frame is not None]


def newest(frames: list[tuple[float, str, dict[str, bytes]]]) -> dict[str, dict[str, bytes]]:
    return {service: contents for _, service, contents in frames}


@pytest.mark.thorough
def test_steps_to_and_fro_show_what_was_there(file: Path) -> None:
    frames = recorded(file)
    shown, steps = 1, random.Random(2)
    with controlling(file) as reader:
        for _ in range(60):
            count = steps.choice((1, 1, 1, -1, -1, 3, -2, 17, -16, 40, -40, 200, -200))
            told = reader.call("step", frames=count)
            shown = min(max(shown + count, 0), len(frames))
            assert told["paused"]
            state, expected = there(), newest(frames[:shown])
            assert {name: state[name] for name in expected} == expected, (count, shown)
            if shown:
                assert told["time_s"] == frames[shown - 1][0]


def test_seeking_shows_what_was_newest_then(file: Path) -> None:
    frames = recorded(file)
    with controlling(file) as reader:
        for time_s in [random.Random(3).uniform(0, 1.2) for _ in range(20)] + [0.0, 1e9, -5]:
            told = reader.call("seek", time_s=time_s)
            assert told["time_s"] == min(max(time_s, 0.0), told["duration_s"])
            expected = newest([frame for frame in frames if frame[0] <= told["time_s"]])  # the last one, too
            state = there()
            assert {name: state[name] for name in expected} == expected


def test_no_sample_of_a_paused_replay_is_seen_in_a_service_that_goes_on(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit, paused = ServiceWriter.commit, []

    def committed(writer: ServiceWriter, acquired_ns: int, flags: int = 0) -> int:
        paused.append(writer.paused)
        return commit(writer, acquired_ns, flags)

    monkeypatch.setattr(ServiceWriter, "commit", committed)
    with controlling(file) as reader:
        reader.call("seek", time_s=0.5)
        reader.call("step", frames=3)
    assert len(paused) > 5
    assert all(paused)


def test_playing_goes_on_from_there_without_a_gap(file: Path) -> None:
    frames = recorded(file)
    middle_s = frames[len(frames) // 2][0]
    expected = [contents for time_s, service, contents in frames if service == "torso" and time_s > middle_s]
    with controlling(file, stays=True) as control:
        control.call("seek", time_s=middle_s)
        with ServiceReader[Sample]("torso") as torso:
            last = torso.read()
            control.call("resume")
            found = []
            for frame in torso.in_order(timeout_s=30):
                if frame.position > last.position:
                    found.append(values(frame))
                if len(found) == len(expected):
                    break
            assert found == expected
            assert torso.missed == 0
            wait_until(lambda: control.call("replay")["paused"])  # it stays, at its end
            told = control.call("replay")
            assert told["time_s"] == told["duration_s"] >= frames[-1][0]
            assert torso.paused


def test_readers_see_a_pause_and_programs_end_it(file: Path) -> None:
    with controlling(file, speed=0.25) as reader:
        assert reader.paused
        with pytest.raises(Paused):
            reader.request()
        before = reader.read()
        assert not reader.call("resume")["paused"]
        assert not reader.paused
        assert reader.read(newer_than=before, timeout_s=30).sequence > before.sequence
        at_s = reader.call("pause")["time_s"]
        time.sleep(0.1)
        assert reader.call("replay")["time_s"] == at_s
        assert reader.call("resume")["time_s"] >= at_s


def test_programs_can_know_that_it_is_a_recording_and_call_nothing_else(file: Path) -> None:
    with controlling(file) as reader:
        assert list(reader.operations()) == ["replay", "pause", "resume", "step", "seek", "speed", "loop"]
        assert all(reader.operations().values())
        told = reader.call("replay")
        assert (told["file"], told["speed"], told["loop"], told["paused"]) == (str(file), 1.0, False, True)
        reader.call("resume")
        with pytest.raises(RequestRefused, match=r"no operation 'tare' \(this is a recording\); there are: replay, "):
            reader.call("tare", samples=20)


@pytest.mark.parametrize(
    ("operation", "arguments", "words"),
    [
        ("step", {"frames": 0}, "give a whole number"),
        ("step", {"frames": 1.5}, "give a whole number"),
        ("step", {"frames": "all"}, "give a number"),
        ("seek", {"time_s": None}, "give a number"),
        ("seek", {}, "time_s"),
        ("speed", {"factor": 1e-300}, "a speed is at least 1e-06"),
        ("speed", {"factor": -1}, "a speed is at least"),
        ("speed", {"factor": True}, "give a number"),
        ("pause", {"now": True}, "now"),
    ],
)
def test_nonsense_is_refused_and_changes_nothing(
    file: Path, operation: str, arguments: dict[str, Any], words: str
) -> None:
    with controlling(file) as reader:
        before = reader.call("replay")
        with pytest.raises(RequestFailed, match=words):
            reader.call(operation, **arguments)
        assert reader.call("replay") == before


def test_a_speed_is_told_to_readers_as_a_rate(tmp_path: Path) -> None:
    file = tmp_path / "pose.mcap"
    with recording(file) as recorder, pose_service(rate_hz=50) as pose:
        has_all = lambda: recorder.messages.get("/skin/pose/frame", 0) == 20  # noqa: E731
        for number in range(20):
            publish_pose(pose, number)
            time.sleep(0.02)
        wait_until(has_all)
    with controlling(file) as reader:
        generation = reader.read().generation
        assert reader.read().period_ns == 20_000_000
        assert reader.call("speed", factor=4)["speed"] == 4
        reader.call("step")
        assert reader.read().period_ns == 5_000_000
        assert reader.read().generation > generation
        assert reader.read().column("count") == -1


def test_a_loop_begins_again_with_the_same_generation(file: Path) -> None:
    with replaying(file, speed=4.0) as replayer:
        wait_until(lambda: bool(replayer.frames))
        with ServiceReader[Sample]("torso", timeout_s=30) as torso:
            assert torso.call("loop")["loop"]
            first = torso.read()
            last = torso.read()
            for frame in torso.in_order(timeout_s=30):
                last = frame
                if frame.sequence > first.sequence + 160:
                    break
            assert last.generation == first.generation
            told = torso.call("loop", on=False)
            assert not told["loop"]
            wait_until(lambda: replayer.time_s == told["duration_s"])  # not again


def test_a_frame_on_request_is_one_that_is_acquired_later(file: Path) -> None:
    with replaying(file, speed=0.5, loop=True), DriverReader("torso", timeout_s=30) as torso:
        for _ in range(5):
            asked_ns = time.monotonic_ns()
            assert torso.request(timeout_s=30).acquired_ns >= asked_ns


def test_times_of_then_can_be_kept(file: Path) -> None:
    with skinware.recording.open(file) as opened:
        recorded_ns = {frame.sequence: frame.acquired_ns for frame in opened["torso"].samples()}
    with controlling(file, keeps_times=True) as control:
        control.call("seek", time_s=0.0)
        control.call("step", frames=10)
        with DriverReader("torso", timeout_s=30) as torso:
            frame = torso.read()
            assert frame.acquired_ns == recorded_ns[frame.sequence]
            assert (frame.column("module_time_ns") <= frame.acquired_ns).all()
            before_ns = time.monotonic_ns()
            assert before_ns <= frame.acquired_ns + frame.age_ns <= time.monotonic_ns()
            assert frame.published_ns > frame.acquired_ns


@pytest.mark.thorough
def test_pauses_and_deaths_are_as_they_were(tmp_path: Path, namespace: Namespace) -> None:
    file = tmp_path / "skin.mcap"
    with recording(file) as recorder, FakeSkin("torso", fake_structure(1)) as torso:
        torso.publish(3)
        has(recorder, "torso")
        with fake_process("arm", "--rate", "50", "--patches", "1") as process:
            wait_until(lambda: recorder.messages.get("/skin/arm/frame", 0) > 5)
            torso.writer.pause()
            kill(process)
            wait_until(lambda: recorder.messages.get("/skin/events", 0) >= 4)
        torso.writer.resume()
        torso.publish(3)
        wait_until(lambda: recorder.messages.get("/skin/torso/frame", 0) == 6)
        time.sleep(0.5)  # what is told later
    with skinware.recording.open(file) as opened:
        told = [(event["event"], event["service"]) for event in opened.events]
    assert {("paused", "torso"), ("dead", "arm")} <= set(told)
    with controlling(file) as control:
        control.call("resume")
        with DriverReader("arm", timeout_s=30) as arm:
            wait_until(lambda: not arm.alive)
            assert arm.read().stale
            assert "arm" in namespace.services()
    assert namespace.services() == []
    again = tmp_path / "again.mcap"
    with recording(again) as recorder, replaying(file, stays=True):
        wait_until(lambda: recorder.messages.get("/skin/torso/frame", 0) == 6)
        time.sleep(0.5)
    with skinware.recording.open(again) as opened:
        told_again = [(event["event"], event["service"]) for event in opened.events]
        assert {("paused", "torso"), ("dead", "arm")} <= set(told_again)
    with pytest.raises(ServiceNotFound):
        DriverReader("arm")


def test_who_is_held_up_goes_on_from_there_and_counts(file: Path) -> None:
    with skinware.recording.open(file) as opened:
        replayer = Replayer(opened)
        held = iter([0.4])

        def hold() -> None:
            if replayer.frames["torso"] > 20:
                time.sleep(next(held, 0.0))

        try:
            begun_s = time.monotonic()
            replayer.run(hold, 0.01)
            assert time.monotonic() - begun_s >= opened.duration_s + 0.3  # it is not made up for
            assert replayer.late > 0
            assert replayer.frames == {"torso": 75, "arm": 26, "pose": 26}
        finally:
            replayer.close()
