"""skin-prove with a program that does each step, and the files that it writes."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import select
import signal
import socket
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import skinware.recording
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import BIN, children_of, is_there, refused, run
from tests.proving.rig import EmulatedHand, PressingPerson, hand, straight

STRUCTURE = fake_structure(1, 2)
MATRICES = fake_structure(1, 2, kind="2x5")
REST, PRESSED = 240, 150


@pytest.mark.thorough
def test_a_program_presses_and_skips(tmp_path: Path) -> None:
    stem = tmp_path / "proof"
    with publishing(FakeSkin("hand", STRUCTURE)) as skin:
        rest = skin.values = STRUCTURE.sensor_uid * 0 + REST
        prove = subprocess.Popen(
            [BIN / "skin-prove", "hand", "--json", "--rest", "1", "--timeout", "30", "-o", str(stem)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert prove.stdin is not None
        assert prove.stdout is not None
        steps, done = [], {}
        for line in prove.stdout:
            event = json.loads(line)
            if event["event"] == "done":
                done = event
                break
            steps.append((event["wanted"], event["module"]))
            if event["wanted"] == "press" and event["module"].endswith("0"):
                skin.values = pressed(rest, 2)
            elif event["wanted"] == "let go":
                skin.values = rest
            elif event["wanted"] == "press":
                prove.stdin.write("skip\n")
                prove.stdin.flush()
        prove.stdin.close()
        prove.stdout.close()
        assert prove.wait(60) in (0, 1)  # 1: the machine was too busy for the rate
    first, second = (f"board 7, triangle {number}" for number in range(2))
    assert steps == [("rest", ""), ("press", first), ("let go", first), ("press", second)]
    verdicts = {(check["what"], check["where"]): check["verdict"] for check in done["checks"]}
    assert (verdicts["right module", first], verdicts["right module", second]) == ("passed", "skipped")
    assert done["files"] == [f"{stem}.{ending}" for ending in ("md", "json", "mcap")]
    told: dict[str, Any] = json.loads((tmp_path / "proof.json").read_text())
    assert told == {key: value for key, value in done.items() if key not in ("event", "files")}
    report = (tmp_path / "proof.md").read_text()
    assert report.startswith("# Driver fake: ")
    assert f"| passed | right module | {first} |" in report
    assert "verified against" in report
    with skinware.recording.open(tmp_path / "proof.mcap") as recording:
        assert recording.is_whole
        assert recording.drivers == ("hand",)


@pytest.mark.thorough
def test_it_starts_a_driver_and_captures_its_first_byte(tmp_path: Path) -> None:
    stem = tmp_path / "proof"
    own = ("--rest", "0.3", "--timeout", "0.2", "--only", "palm", "-o", str(stem))
    missed = run("skin-prove", *own, "--", "--driver", "weiss_wts", "--bus", "virtual")
    assert missed.returncode == 1
    assert "no module of weiss_wts has such a name" in missed.stderr
    with skinware.recording.open(tmp_path / "proof.mcap") as recording:
        (wire,) = recording.wires
        assert next(wire.items()).is_sent
        assert recording.about("weiss_wts")["driver_type"] == "weiss_wts"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("interrupted", "number"),
    [
        ("start", signal.SIGINT),
        ("rest", signal.SIGINT),
        ("press", signal.SIGTERM),
        ("press", signal.SIGHUP),  # its terminal is closed
        ("let go", signal.SIGINT),
        ("stroke down", signal.SIGINT),
    ],
)
def test_whatever_it_asks_for_it_can_be_interrupted(tmp_path: Path, interrupted: str, number: int) -> None:
    """Interrupted twice, it ends with a report of the checks so far."""
    stem = tmp_path / "proof"
    with publishing(FakeSkin("hand", MATRICES)) as skin, contextlib.ExitStack() as beside:
        rest = skin.values = STRUCTURE.sensor_uid * 0 + REST
        own = ["--json", "--rest", "30" if interrupted == "rest" else "0.5", "--timeout", "60", "-o", str(stem)]
        nobody = beside.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1]
        silent = ["--", "--driver", "weiss_wts", "--bus", f"tcp://127.0.0.1:{nobody}"]
        prove = subprocess.Popen(
            [BIN / "skin-prove", *([*own, *silent] if interrupted == "start" else ["hand", *own])],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert prove.stdout is not None
        event: dict[str, Any] = {}
        for line in () if interrupted == "start" else prove.stdout:
            event = json.loads(line)
            if event["wanted"] == interrupted:
                break
            skin.values = rest if event["wanted"] in ("rest", "let go") else pressed(rest, 2)
        if interrupted == "stroke down":
            skin.values = pressed(rest, 2)  # the finger is on its way
        wait_until(lambda: bool(children_of(prove.pid)))
        if interrupted == "start":
            wait_until(lambda: (tmp_path / "proof.mcap").exists())  # the driver has begun
        started = children_of(prove.pid)
        os.kill(prove.pid, number)
        os.kill(prove.pid, number)
        rest_of_it = prove.stdout.read()
        status = prove.wait(60)
        prove.stdout.close()
    wait_until(lambda: not any(map(is_there, started)))
    done = json.loads(rest_of_it.splitlines()[-1])
    assert done["event"] == "done"
    failures = any(check["verdict"] == "failed" for check in done["checks"])  # of the rate: the machine was too busy
    was_pressed = interrupted in ("let go", "stroke down")
    is_proven = was_pressed and not failures
    assert (done["is_proven"], status) == (is_proven, int(not is_proven))
    told = json.loads((tmp_path / "proof.json").read_text())
    assert told == {key: value for key, value in done.items() if key not in ("event", "files")}
    assert (tmp_path / "proof.md").read_text().startswith("# Driver ")
    verdicts = [check["verdict"] for check in told["checks"] if check["what"] == "right module"]
    assert verdicts == (["passed"] if was_pressed else [])
    meanwhile = "" if interrupted == "start" else f", while it asked: {event['text']}"
    assert told["about"]["ended early"] == f"interrupted{meanwhile}"
    with skinware.recording.open(tmp_path / "proof.mcap") as recording:
        assert recording.is_whole


@pytest.mark.thorough
def test_interrupted_while_it_tares_or_writes_it_ends_with_a_report(tmp_path: Path) -> None:
    """The driver does not come to an end with taring; then the report goes into a pipe that nobody reads yet."""
    report, is_taring, may_end = tmp_path / "proof.md", threading.Event(), threading.Event()

    def tare(_hand: EmulatedHand) -> None:
        is_taring.set()
        may_end.wait(60)

    with hand(PressingPerson(), straight(), (), tare):
        own = ("--json", "--tare", "--rest", "0.5", "--timeout", "0.1", "--only", "index", "-o", f"{tmp_path}/proof")
        prove = subprocess.Popen(
            [BIN / "skin-prove", "hand", *own], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        )
        try:
            assert is_taring.wait(60)
            os.mkfifo(report)
            os.kill(prove.pid, signal.SIGINT)
            wait_until(lambda: not children_of(prove.pid))  # the capture is complete: it writes now
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
                os.kill(prove.pid, number)
            reading = os.open(report, os.O_RDONLY | os.O_NONBLOCK)
            os.set_blocking(reading, True)
            wait_until(lambda: bool(select.select([reading], [], [], 0.1)[0]) or prove.poll() is not None)
            with os.fdopen(reading, encoding="utf-8") as text:
                assert text.read().startswith("# Driver hand: not proven")
            said, _ = prove.communicate(timeout=60)
        finally:
            may_end.set()
    assert prove.returncode == 1
    done = json.loads(said.splitlines()[-1])
    assert done["about"]["ended early"] == "interrupted, while it asked: leave the device alone"
    assert json.loads((tmp_path / "proof.json").read_text())["checks"] == done["checks"]
    with skinware.recording.open(tmp_path / "proof.mcap") as recording:
        assert recording.is_whole


@pytest.mark.thorough
def test_a_driver_that_dies_a_full_disk_and_a_lost_report_are_told_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checks so far are shown, even if the files cannot be written."""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")  # or the limit cuts off the bytecode of what is imported
    with publishing(FakeSkin("hand", STRUCTURE)) as skin:
        skin.values = STRUCTURE.sensor_uid * 0 + REST
        own = ("--json", "--rest", "0.5", "--timeout", "60", "-o", str(tmp_path / "proof"))
        prove = subprocess.Popen(
            [BIN / "skin-prove", "hand", *own],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert prove.stdout is not None
        while json.loads(prove.stdout.readline())["wanted"] != "press":
            pass
        (tmp_path / "proof.md").mkdir()
        (capture,) = children_of(prove.pid)
        resource.prlimit(capture, resource.RLIMIT_FSIZE, (1, 1))  # as a full disk
        wait_until(lambda: not is_there(capture))
    said, errors = prove.communicate(timeout=60)
    done = json.loads(said.splitlines()[-1])
    assert prove.returncode == 1
    assert done["about"]["ended early"].startswith("no newer sample of 'hand': its writer")
    assert "; ended early: File too large" in done["about"]["capture"]
    assert f"{tmp_path / 'proof.md'}: Is a directory" in errors
    assert f"skin-record: {tmp_path / 'proof.mcap'}: File too large" in errors
    assert str(tmp_path / "proof.json") in done["files"]
    assert json.loads((tmp_path / "proof.json").read_text())["checks"] == done["checks"]


def test_what_cannot_be_written_is_said_before_somebody_walks(tmp_path: Path) -> None:
    missing = refused("skin-prove", "-o", str(tmp_path / "no" / "proof"))
    assert (missing.returncode, missing.stderr) == (
        2,
        f"skin-prove: -o {tmp_path / 'no' / 'proof'}: there is no folder {tmp_path / 'no'}\n",
    )
    (tmp_path / "proof.json").touch()
    there = refused("skin-prove", "-o", str(tmp_path / "proof"), "--", "--bus", "virtual")
    assert there.returncode == 2
    assert f"{tmp_path / 'proof.json'}: exists already" in there.stderr


@pytest.mark.thorough
def test_a_driver_whose_author_prints_is_heard_nevertheless(tmp_path: Path, tcp_patch: Callable[..., str]) -> None:
    (tmp_path / "noisy.py").write_text(
        "from skinware_drivers.serial.weiss import WeissWtsDriver\n\n\n"
        "class Noisy(WeissWtsDriver):\n"
        "    def __init__(self, options):\n"
        "        print('here I am')\n"
        "        print(4)\n"
        "        super().__init__(options)\n"
    )
    own = ("--rest", "0.3", "--timeout", "0.2", "--only", "palm", "-o", str(tmp_path / "proof"))
    bus = f"tcp://{tcp_patch('weiss_wts')}"
    missed = run("skin-prove", *own, "--", "--driver", str(tmp_path / "noisy.py"), "--bus", bus)
    assert missed.returncode == 1
    assert "no module of noisy has such a name" in missed.stderr


def pressed(rest: Any, taxel: int) -> Any:
    values = rest.copy()
    values[taxel] = PRESSED
    return values


@pytest.mark.thorough
def test_without_a_driver_it_says_so() -> None:
    missed = run("skin-prove")
    assert missed.returncode == 1
    assert missed.stderr.startswith("skin-prove: no driver runs in namespace")
