"""skin-prove: a program does what it asks for, line by line, and the files that it leaves."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import skinware.recording
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
                values = rest.copy()
                values[2] = PRESSED
                skin.values = values
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


def test_without_a_driver_it_says_so() -> None:
    missed = run("skin-prove")
    assert missed.returncode == 1
    assert missed.stderr.startswith("skin-prove: no driver runs in namespace")
