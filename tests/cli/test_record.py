"""skin-record and skin-recover as people and scripts use them; and what a killed recorder leaves."""

from __future__ import annotations

import fcntl
import functools
import json
import os
import random
import resource
import signal
import subprocess
import termios
import time
from pathlib import Path

import numpy as np
import pytest

import skinware.recording
from skinware import DriverReader, Namespace
from skinware.cli._command import exit_status
from skinware.cli.record import command as record
from skinware.cli.record import past, size
from skinware.cli.recover import command as recover
from skinware.memory.announcement import living_readers, sweep
from skinware.recording.mcap_writing import MAGIC
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import BIN, PATIENCE_S, running
from tests.recording.rig import Contents, contents_of
from tests.unprivileged import without_rights_to_all_files

KILLS = 3


@pytest.mark.parametrize(
    "number", [signal.SIGHUP, signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.thorough)]
)
def test_it_records_what_comes_and_ends_whole(tmp_path: Path, namespace: Namespace, number: int) -> None:
    file = tmp_path / "skin.mcap"
    with running("skin-record", str(file)) as recorder:
        ready = recorder.wait_for("ready")
        assert (ready["file"], ready["namespace"], ready["names"]) == (str(file), namespace.name, [])
        with publishing(FakeSkin("torso")) as skin:
            recorder.wait_for("status", lambda status: status["messages"].get("/skin/torso/frame", 0) > 20)
        stopped = recorder.stop(number)
        assert recorder.process.returncode == 0
    assert stopped["event"] == "stopped"
    assert (stopped["file"], stopped["files"]) == (str(file), [str(file)])
    assert stopped["messages"]["/skin/torso/frame"] + stopped["missed"] == skin.writer.sequence
    assert stopped["bytes"] == file.stat().st_size
    with skinware.recording.open(file) as opened:
        assert opened.is_whole
        sequence = opened["torso"].read(["status"]).sequence
    assert len(set(sequence.tolist())) == stopped["messages"]["/skin/torso/frame"]
    assert sequence[-1] == skin.writer.sequence


@pytest.mark.thorough
def test_a_recording_of_nothing_is_whole_too(tmp_path: Path) -> None:
    file = tmp_path / "skin.mcap"
    with running("skin-record", "-o", str(file)) as recorder:
        recorder.wait_for("ready")
        stopped = recorder.stop()
    assert (stopped["event"], stopped["file"], stopped["missed"]) == ("stopped", str(file), 0)
    with skinware.recording.open(file) as opened:
        assert opened.is_whole
        assert opened.services == ()


@pytest.mark.thorough
def test_a_deleted_file_is_said_at_once(tmp_path: Path, namespace: Namespace) -> None:
    del namespace
    file = tmp_path / "skin.mcap"
    with publishing(FakeSkin("torso")), running("skin-record", "-o", str(file)) as recorder:
        recorder.wait_for("status", lambda status: status["messages"].get("/skin/torso/frame", 0) > 5)
        file.unlink()
        stopped = recorder.wait_for("stopped")
        assert recorder.process.wait(PATIENCE_S) == 1
        recorder.stop()
        assert recorder.errors == f"skin-record: {file}: deleted while it was recorded: what was in it is gone\n"
    assert (stopped["is_complete"], stopped["files"], stopped["file"]) == (False, [], "")
    assert list(tmp_path.iterdir()) == []


def test_for_people(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with publishing(FakeSkin("torso")):
        assert exit_status(record, ["torso", "tosro", "-T", "2.2"]) == 0
    (file,) = tmp_path.iterdir()
    out, err = capsys.readouterr()
    assert err == f"skin-record: tosro did not appear in namespace '{Namespace().name}'\n"
    assert out.startswith(
        f"recording torso, tosro of namespace '{Namespace().name}' into {file.name} (Ctrl-C ends)\n00:00:01  "
    )
    assert " MB, nothing missed\n" in out
    assert "/skin/torso/frame: " in out
    data = file.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    assert exit_status(recover, ["cut.mcap"]) == 0
    assert capsys.readouterr().out.endswith("cut.recovered.mcap: written; cut.mcap was cut off\n")
    assert exit_status(recover, [file.name, "-o", "again.mcap"]) == 0
    assert capsys.readouterr().out.endswith(f"again.mcap: written; {file.name} was whole\n")


@pytest.mark.parametrize("as_json", [False, True])
def test_a_recording_of_nothing_has_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str], as_json: bool) -> None:
    arguments = ["tosro", "-T", "0.2", "-o", str(tmp_path / "walk.mcap"), *(["--json"] * as_json)]
    with publishing(FakeSkin("torso")):
        assert exit_status(record, arguments) == 1
    out, err = capsys.readouterr()
    assert err.endswith(f"skin-record: tosro did not appear in namespace '{Namespace().name}'\n")
    assert "complete," not in out
    assert ('"event":"stopped"' in out) == as_json


@pytest.mark.thorough
def test_a_signal_saves_the_past(tmp_path: Path) -> None:
    file = tmp_path / "fall.mcap"
    with publishing(FakeSkin("torso")), running("skin-record", "--last", "5s", "-o", str(file)) as recorder:
        recorder.wait_for("status", lambda status: "/skin/torso/frame" in status["messages"])
        assert not file.exists()
        recorder.process.send_signal(signal.SIGUSR1)
        wait_until(file.exists)
        assert recorder.stop()["files"] == [str(file), str(tmp_path / "fall-2.mcap")]


@pytest.mark.thorough
def test_enter_saves_the_past(tmp_path: Path) -> None:
    ours, terminal = os.openpty()
    command = [str(BIN / "skin-record"), "--last", "5s", "-o", "fall.mcap"]
    try:
        with publishing(FakeSkin("torso")):
            with subprocess.Popen(
                command,
                stdin=terminal,
                stdout=subprocess.PIPE,
                text=True,
                cwd=tmp_path,
                preexec_fn=functools.partial(take_terminal, terminal),
            ) as process:
                assert process.stdout is not None
                assert process.stdout.readline().endswith("into fall.mcap (Enter saves, Ctrl-C ends)\n")
                while "torso" not in process.stdout.readline():
                    pass
                os.write(ours, b"\n")
                while process.stdout.readline() != "saved fall.mcap\n":
                    assert process.poll() is None
                os.write(ours, b"\n")
                while process.stdout.readline() != "saved fall-2.mcap\n":
                    assert process.poll() is None
                process.send_signal(signal.SIGINT)
                assert "fall-3.mcap: complete" in process.communicate(timeout=PATIENCE_S)[0]
            assert process.returncode == 0
    finally:
        os.close(ours)
        os.close(terminal)
    for name in ("fall.mcap", "fall-2.mcap", "fall-3.mcap"):
        with skinware.recording.open(tmp_path / name) as opened:
            assert opened.is_whole
            assert len(opened["torso"].read(["status"])) > 10


def take_terminal(terminal: int) -> None:
    """In a child: be in the foreground of a terminal."""
    os.setsid()
    fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)


@pytest.mark.thorough
def test_no_permission_is_one_line(tmp_path: Path) -> None:
    run = functools.partial(
        subprocess.run, capture_output=True, text=True, timeout=PATIENCE_S, preexec_fn=without_rights_to_all_files
    )
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    done = run([BIN / "skin-record", "-o", closed / "x.mcap"])
    assert (done.returncode, done.stderr) == (1, f"skin-record: {closed}/x.mcap: Permission denied\n")
    assert list(closed.iterdir()) == []
    unreadable = tmp_path / "unreadable.mcap"
    unreadable.write_bytes(MAGIC)
    unreadable.chmod(0)
    done = run([BIN / "skin-recover", unreadable])
    assert (done.returncode, done.stderr) == (1, f"skin-recover: {unreadable}: Permission denied\n")


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["-o", "there.mcap"], 2, "there.mcap: exists already: give another name, or remove it"),
        (["-o", "nowhere/x.mcap"], 2, "skin-record: there is no folder nowhere"),
        (["-o", "/proc/x.mcap"], 2, "/proc/x.mcap: No such file or directory"),
        (["-o", "x.mcap", "to rso"], 2, "service name 'to rso'"),
        (["x.mcap", "-o", "y.mcap"], 2, "one file is written, and 2 are given: y.mcap, x.mcap"),
        (["-o", "x.mcap", "--split", "much"], 2, "'much' is not a size"),
        (["-o", "x.mcap", "--last", "0"], 2, "'0' is not a time"),
        (["-o", "x.mcap", "--last", "5s", "--split", "1MB"], 2, "--last keeps the past in memory"),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.mcap").write_text("mine")
    assert exit_status(record, arguments) == code
    errors = capsys.readouterr().err
    assert words in errors.splitlines()[-1]
    assert "Traceback" not in errors
    assert [path.name for path in tmp_path.iterdir()] == ["there.mcap"]
    assert Path("there.mcap").read_text() == "mine"


@pytest.mark.parametrize(
    ("contents", "words"),
    [
        (None, "x.mcap: No such file or directory"),
        (b"", "empty, so not a recording"),
        (b"hello world, hello world", "not a recording (not an MCAP file)"),
        (MAGIC, "nothing in it can be used"),
    ],
)
def test_what_cannot_be_recovered_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], contents: bytes | None, words: str
) -> None:
    file = tmp_path / "x.mcap"
    if contents is not None:
        file.write_bytes(contents)
    before = list(tmp_path.iterdir())
    assert exit_status(recover, [str(file)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert list(tmp_path.iterdir()) == before


@pytest.mark.thorough
def test_a_file_that_may_not_grow_ends_the_recording_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")  # or the limit cuts off the bytecode of what is imported
    file = tmp_path / "skin.mcap"
    limit = 40_000
    with publishing(FakeSkin("torso")) as skin:
        done = subprocess.run(
            [BIN / "skin-record", "-o", file, "--json"],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        )
        end = skin.writer.sequence
    assert done.returncode == 1
    assert done.stderr == f"skin-record: {file}: File too large\n"
    assert json.loads(done.stdout.splitlines()[-1])["event"] == "stopped"
    assert 0 < file.stat().st_size <= limit
    with skinware.recording.open(file) as opened:
        sequence = opened["torso"].read(["status"]).sequence
        assert 20 < len(sequence) < end
        assert sequence.tolist() == list(range(int(sequence[0]), int(sequence[-1]) + 1))


@pytest.mark.thorough
@pytest.mark.parametrize("sensors", ["few", "many"])
def test_a_kill_costs_no_frame_that_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sensors: str) -> None:
    topic, skin = "/skin/torso/frame", FakeSkin("torso", fake_structure(*((2, 4) if sensors == "few" else (64, 16))))
    seen: Contents = {}

    def publish() -> None:
        FakeSkin.publish(skin)
        frame = reader.read()
        seen[frame.position] = contents_of(frame)

    with DriverReader("torso", announce=False) as reader, monkeypatch.context() as patched, publishing(skin, 50):
        patched.setattr(skin, "publish", publish)
        for number in range(KILLS):
            file, whole = tmp_path / f"{number}.mcap", tmp_path / f"{number}.whole.mcap"
            with running("skin-record", "-o", str(file)) as recorder:
                status = recorder.wait_for("status", lambda status: status["messages"].get(topic, 0) > 20)
                time.sleep(random.uniform(0, 0.5))
                recorder.stop(signal.SIGKILL)
            assert exit_status(recover, [str(file), "-o", str(whole)]) == 0
            with skinware.recording.open(whole) as opened:
                frames = list(opened["torso"].samples())
            assert len(frames) >= status["messages"][topic]
            assert all(contents_of(frame) == seen[frame.position] for frame in frames)
            assert (np.diff([frame.sequence for frame in frames]) > 0).all()
        sweep(Namespace())  # what the killed recorders told as readers


def test_sizes_and_times() -> None:
    sizes = {"1": 1, "2kB": 2000, "1.5MB": 1_500_000, "1GiB": 1 << 30, "3 MiB": 3 << 20, "2G": 2 * 10**9}
    assert {text: size(text) for text in sizes} == sizes
    assert [past(text) for text in ("60", "60s", "0.5s", "5min")] == [60, 60, 0.5, 300]


@pytest.mark.thorough
def test_recorders_are_readers_that_others_see(tmp_path: Path) -> None:
    with publishing(FakeSkin("torso")), running("skin-record", "-o", str(tmp_path / "x.mcap")) as recorder:
        recorder.wait_for("status", lambda status: "/skin/torso/frame" in status["messages"])
        wait_until(lambda: any(reader.kind == "in order" for reader in living_readers(Namespace())))
        (reader,) = living_readers(Namespace())
        assert (reader.pid, reader.service) == (recorder.process.pid, "torso")
        assert os.path.basename(reader.program) == "skin-record"
