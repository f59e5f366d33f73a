"""The benchmarks run, and write what they say."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parent.parent / "tools" / "benchmarks"
PROGRAM = """
import json, sys
from pathlib import Path
import paper, paper_run
from skinware import Namespace
trials = paper.grid((2,), (3,), (1,), 1) + [paper_run.Trial(0, 2, 3, 1, mode) for mode in sys.argv[2:]]
for _ in range(2):  # the second run finds everything done
    paper.run(trials, Path(sys.argv[1]), 1.0, Namespace())
print(json.dumps(paper_run.COLUMNS))
"""


def test_the_papers_experiment_writes_one_row_per_trial(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    modes = ["asap", "skin", *(["c asap", "c skin"] if shutil.which("cc") else [])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(BENCHMARKS), os.environ.get("PYTHONPATH", "")))}
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
