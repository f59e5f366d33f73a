"""skin-prove: a program does what it asks for, line by line, and the files that it leaves."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
from pathlib import Path
from typing import Any

import pytest

import skinware.recording
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import BIN, run

STRUCTURE = fake_structure(1, 2)
REST, PRESSED = 240, 150


def test_a_program_presses_and_skips(tmp_path: Path) -> None:
    stem = tmp_path / "proof"
    with publishing(FakeSkin("hand", STRUCTURE)) as skin:
        rest = skin.values = STRUCTURE.sensor_uid * 0 + REST
        prove = subprocess.Popen(
            [BIN / "skin-prove", "hand", "--json", "--rest", "1", "--wait", "30", "-o", str(stem)],
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


def test_it_starts_a_driver_and_captures_its_first_byte(tmp_path: Path) -> None:
    stem = tmp_path / "proof"
    own = ("--rest", "0.3", "--wait", "0.2", "--only", "palm", "-o", str(stem))
    missed = run("skin-prove", *own, "--", "--driver", "weiss_wts", "--bus", "virtual")
    assert missed.returncode == 1
    assert "no module of weiss_wts is called so" in missed.stderr
    with skinware.recording.open(tmp_path / "proof.mcap") as recording:
        (wire,) = recording.wires
        assert next(wire.items()).is_sent
        assert recording.about("weiss_wts")["driver_type"] == "weiss_wts"


def children_of(pid: int) -> set[int]:
    """Processes that a process has started, and theirs."""
    found: set[int] = set()
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, task.read_text().split()):
            found |= {child, *children_of(child)}
    return found


def is_there(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


@pytest.mark.parametrize(
    ("interrupted", "number"),
    [("start", signal.SIGINT), ("rest", signal.SIGINT), ("press", signal.SIGTERM), ("let go", signal.SIGINT)],
)
def test_whatever_it_asks_for_it_can_be_interrupted(tmp_path: Path, interrupted: str, number: int) -> None:
    """Twice, as an impatient person does. There is a report of what was seen, which counts, and nothing goes on."""
    stem = tmp_path / "proof"
    with publishing(FakeSkin("hand", STRUCTURE)) as skin, contextlib.ExitStack() as beside:
        rest = skin.values = STRUCTURE.sensor_uid * 0 + REST
        own = ["--json", "--rest", "30" if interrupted == "rest" else "0.5", "--wait", "60", "-o", str(stem)]
        nobody = beside.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1]
        silent = ["--", "--driver", "weiss_wts", "--bus", f"tcp://127.0.0.1:{nobody}"]
        prove = subprocess.Popen(
            [BIN / "skin-prove", *([*own, *silent] if interrupted == "start" else ["hand", *own])],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert prove.stdout is not None
        started: set[int] = set()
        for line in () if interrupted == "start" else prove.stdout:
            event = json.loads(line)
            if event["wanted"] == interrupted:
                break
            skin.values = rest if event["wanted"] in ("rest", "let go") else pressed(rest, 2)
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
    is_proven = interrupted == "let go" and not failures
    assert (done["is_proven"], status) == (is_proven, int(not is_proven))
    told = json.loads((tmp_path / "proof.json").read_text())
    assert told == {key: value for key, value in done.items() if key not in ("event", "files")}
    assert (tmp_path / "proof.md").read_text().startswith("# Driver ")
    verdicts = [check["verdict"] for check in told["checks"] if check["what"] == "right module"]
    assert verdicts == (["passed"] if interrupted == "let go" else [])
    with skinware.recording.open(tmp_path / "proof.mcap") as recording:
        assert recording.is_whole


def pressed(rest: Any, taxel: int) -> Any:
    values = rest.copy()
    values[taxel] = PRESSED
    return values


def test_without_a_driver_it_says_so() -> None:
    missed = run("skin-prove")
    assert missed.returncode == 1
    assert missed.stderr.startswith("skin-prove: no driver runs in namespace")
