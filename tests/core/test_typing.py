"""What strict mypy says of programs like those of the documentation."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

PROGRAM = """
from skinware import DriverReader, Sample, ServiceReader

reader = ServiceReader("arm", timeout_s=10.0)
reveal_type(reader)
reveal_type(reader.read())
for frame in reader.frames(rate_hz=30):
    reveal_type(frame)
reveal_type(DriverReader("skin").read())

def use(any_reader: ServiceReader) -> Sample:
    return any_reader.read()
"""


def test_a_reader_of_plain_frames_needs_no_annotation(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=110)
    revealed = [line.partition('type is "')[2].rstrip('"') for line in done.stdout.splitlines() if "Revealed" in line]
    assert done.returncode == 0, done.stdout
    assert revealed == [
        "skinware.service._reader.ServiceReader[skinware.memory.ring.Sample]",
        "skinware.memory.ring.Sample",
        "skinware.memory.ring.Sample",
        "skinware.driver_snapshot.DriverSnapshot",
    ]
