"""Whole drivers of serial lines, damaged a little, always in the same way; ``tools/fuzz lines`` goes further."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.thorough
def test_damaged_lines_of_drivers() -> None:
    drivers = ("flexitac", "flexitac:firmware=text,rows=16,columns=16", "ability_hand", "tactile_glove")
    command = [
        sys.executable,
        str(ROOT / "tools" / "fuzzing" / "lines.py"),
        *drivers,
        "--bytes",
        "100000",
        "--seed",
        "1",
    ]
    done = subprocess.run(command, text=True, capture_output=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert [line.split()[2] for line in done.stdout.splitlines()] == [f"{name.partition(':')[0]}:" for name in drivers]
