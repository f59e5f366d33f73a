"""The benchmarks run, and write what they say."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
BENCHMARKS = ROOT / "tools" / "benchmarks"
SHARED = Path("/dev/shm")
PROGRAM = """
import json, sys
from pathlib import Path
from typing import Any
import paper, paper_run
from skinware import Namespace
trials = paper.grid((2,), (3,), (1,), 1) + [paper_run.Trial(0, 2, 3, 1, mode) for mode in sys.argv[2:]]
for _ in range(2):  # the second run finds everything done
    paper.run(trials, Path(sys.argv[1]), 1.0, Namespace())
print(json.dumps(paper_run.COLUMNS))
"""


@pytest.mark.thorough
def test_the_papers_experiment_writes_one_row_per_trial(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    modes = ["asap", "skin", *(["c asap", "c skin"] if shutil.which("cc") else [])]
    path_of_modules = os.pathsep.join(filter(None, (str(BENCHMARKS), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path_of_modules}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, path, *modes],
        env=environment,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    assert reader.fieldnames == json.loads(done.stdout)
    assert [row["readers"] for row in rows] == ["periodic", *modes]
    for row in rows:
        assert (row["drivers"], row["buffers"], row["users"], row["torn"]) == ("2", "3", "1", "0")
        assert 0 < float(row["reader_mean_us"]) <= float(row["reader_worst_us"])
        assert 0 < float(row["writer_mean_us"]) <= float(row["writer_worst_us"])
        assert 0 < float(row["age_p50_us"]) <= float(row["age_max_us"])
    assert float(rows[0]["skin_cpu_us"]) > float(rows[0]["reader_mean_us"])


def scale(*options: str, status: int = 0, path: str | None = None) -> tuple[list[dict[str, Any]], str]:
    """What the benchmark of large skins and fleets says with tiny numbers, and its messages; it leaves nothing."""
    command = [sys.executable, str(BENCHMARKS / "scale.py"), *options, "--seconds", "0.3", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": os.environ["PATH"] if path is None else path}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        out, messages = process.communicate(timeout=100)
    assert process.returncode == status, out + messages
    assert not list(SHARED.glob(f"skinware.bench-{process.pid}*"))
    return [json.loads(line) for line in out.splitlines()], messages


@pytest.mark.thorough
def test_a_large_skin_over_a_slow_link_is_one_row() -> None:
    options = ("--sensors", "64", "--link", "slow", "--mode", "pull", "--loopback")
    ((row,), _) = scale("sizes", *options)
    assert (row["sensors"], row["robots"], row["mode"], row["link"]) == (64, 1, "pull", "proxy 16 Mbit/s")
    assert row["arrived_hz"] > 0
    assert 0 < row["age_p50_ms"] <= row["age_p99_ms"]


@pytest.mark.thorough
def test_a_fleet_where_no_machines_can_be_made_is_on_the_loopback(tmp_path: Path) -> None:
    options = ("--robots", "2", "--robot-sensors", "32", "--link", "fast", "--mode", "push")
    ((row,), messages) = scale("robots", *options, path=str(tmp_path))
    assert "no links between machines (ip is not installed): all on the loopback" in messages
    assert (row["sensors"], row["robots"], row["link"]) == (32, 2, "loopback")
    assert row["arrived_hz"] > 0
    assert row["serve_us"] > 0


@pytest.mark.thorough
def test_a_row_that_does_not_work_says_why_and_ends() -> None:
    options = ("--sensors", "24", "--link", "fast", "--mode", "push", "--loopback")
    ((row,), _) = scale("sizes", *options, status=1)
    assert "StructureError" in row["failed"]


@pytest.mark.thorough
def test_a_skin_goes_through_the_whole_chain() -> None:
    figures, _ = scale("chain", "--sensors", "64", "--loopback")
    told = {figure["step"]: figure["value"] for figure in figures}
    assert told["recorded"] > 0
    assert told["frames there"] > 0
