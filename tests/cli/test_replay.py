"""skin-replay as people and scripts use it."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import pytest

import skinware.recording
from skinware import DriverReader, Namespace
from skinware.cli._command import exit_status
from skinware_drivers.cli.replay import command as replay
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin
from tests.commands import refused, run, running
from tests.recording.rig import has, recording


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Half a second of a driver, which was there before and after."""
    path = tmp_path / "walk.mcap"
    with FakeSkin("torso") as torso, recording(path) as recorder:
        torso.publish()
        has(recorder, "torso")
        for _ in range(49):
            torso.publish()
            time.sleep(0.01)
        wait_until(lambda: recorder.messages.get("/skin/torso/frame", 0) == 50)
    return path


@pytest.mark.thorough
def test_others_see_what_was_recorded(file: Path, namespace: Namespace) -> None:
    with running("skin-replay", str(file), "--loop", "--speed", "0.5") as player:
        ready = player.wait_for("ready")
        assert (ready["namespace"], ready["names"], ready["is_whole"]) == (namespace.name, ["torso"], True)
        player.wait_for("status", lambda status: status["frames"].get("torso", 0) > 0)
        dumped = run("skin-dump", "torso", "-n", "60", "--json")  # further than the end
        frames = [json.loads(line) for line in dumped.stdout.splitlines()]
        assert [f["sequence"] for f in frames] == list(range(frames[0]["sequence"], frames[0]["sequence"] + 60))
        stopped = player.stop()
        assert stopped["frames"]["torso"] > 60
        assert player.process.returncode == 0
    assert namespace.services() == []


def test_a_name_in_use_is_one_line(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("torso"):
        assert exit_status(replay, [str(file), "--namespace", Namespace().name]) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("skin-replay: a running driver or service is called 'torso'")


def test_it_does_not_publish_beside_living_drivers_unless_it_is_asked_to(
    file: Path, namespace: Namespace, capsys: pytest.CaptureFixture[str]
) -> None:
    with FakeSkin("arm"):
        assert exit_status(replay, [str(file)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"arm runs in namespace '{namespace.name}': give another one with --namespace" in line
        assert exit_status(replay, [str(file), "--namespace", namespace.name, "--end", "0.1"]) == 0
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"skin-replay: arm runs in namespace '{namespace.name}' too")


@pytest.mark.thorough
def test_two_replays_at_once_have_a_namespace_each(file: Path, namespace: Namespace) -> None:
    with running("skin-replay", str(file), "--loop") as first:
        first.wait_for("status", lambda status: status["frames"].get("torso", 0) > 0)
        second = refused("skin-replay", str(file))
        assert second.returncode == 2
        assert f"torso runs in namespace '{namespace.name}': give another one with --namespace" in second.stderr
        other = Namespace(f"{namespace.name}-two")
        with running("skin-replay", str(file), "--loop", "--namespace", other.name) as beside:
            beside.wait_for("status", lambda status: status["frames"].get("torso", 0) > 0)
            first.wait_for("status", lambda status: status["frames"].get("torso", 0) > 0)
            assert beside.errors == ""
            assert namespace.services() == other.services() == ["torso"]
    shutil.rmtree(other.path)


@pytest.mark.thorough
def test_it_waits_for_programs_and_stays_at_its_end(file: Path, namespace: Namespace) -> None:
    options = "--paused", "--stay", "--times", "recorded"
    with skinware.recording.open(file) as opened:
        acquired_ns = opened["torso"].read(["status"]).acquired_ns.tolist()
    with running("skin-replay", str(file), *options) as player:
        assert player.wait_for("status", lambda status: bool(status["frames"]))["paused"]
        with DriverReader("torso") as torso:
            found = [torso.read().acquired_ns]
            torso.call("speed", factor=0.5)
            torso.call("resume")
            for frame in torso.in_order(timeout_s=30):
                if frame.acquired_ns > found[-1]:
                    found.append(frame.acquired_ns)
                if len(found) == len(acquired_ns):
                    break
            assert found == acquired_ns
            assert player.wait_for("status", lambda status: status["paused"])["speed"] == 0.5
        told = player.stop()
        assert told["time_s"] == pytest.approx(told["duration_s"])
    assert namespace.services() == []


def test_it_ends_with_the_recording(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(replay, [str(file), "torso", "--speed", "4"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"{file}, ")
    assert lines[0].endswith(f"s: torso in namespace '{Namespace().name}' (Ctrl-C ends)")
    assert lines[-1].startswith("50 frames published")
    assert exit_status(replay, [str(file), "--start", "1000", "--loop"]) == 0  # there is nothing
    assert capsys.readouterr().out.splitlines()[-1] == "0 frames published"
    file.write_bytes(file.read_bytes()[:-100])
    assert exit_status(replay, [str(file), "--start", "1000"]) == 0
    assert "s (cut off or damaged): torso in" in capsys.readouterr().out


def test_without_a_namespace_it_stays_away_from_the_robot(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("SKINWARE_NAMESPACE")
    assert exit_status(replay, [str(file), "--start", "1000", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[0])["namespace"] == "replay"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["nothing.mcap"], 2, "nothing.mcap: No such file or directory"),
        (["text.mcap"], 2, "text.mcap: not a recording (not an MCAP file)"),
        (["walk.mcap", "arm"], 2, "no service 'arm' in walk.mcap; there are: torso"),
        (["walk.mcap", "--speed", "1e-300"], 2, "a speed is at least 1e-06"),
        (["walk.mcap", "--namespace", "a b"], 2, "namespace name 'a b'"),
    ],
)
def test_mistakes_are_one_line(
    file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    words: str,
) -> None:
    monkeypatch.chdir(file.parent)
    Path("text.mcap").write_text("time,pressure")
    assert exit_status(replay, arguments) == code
    errors = capsys.readouterr().err
    assert words in errors.splitlines()[-1]
    assert "Traceback" not in errors
