"""The programs that docs/how-to/c-and-cpp.md shows, compiled and run."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from skinware import BusState, DriverReader, DriverWriter, PatchState
from skinware.realtime import now_ns
from tests.compiling import compiled
from tests.core.c_programs import structure

EXAMPLES = Path(__file__).parents[2] / "examples"


@contextmanager
def lines_of(*words: object) -> Iterator[Iterator[str]]:
    process = subprocess.Popen([str(word) for word in words], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield iter(process.stdout)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def publish(writer: DriverWriter, value: int) -> None:
    columns = writer.begin()
    columns["values"][:] = value
    columns["status"][:] = 0
    columns["status"][0] = 2  # the first pressure sensor is stale
    columns["module_time_ns"][:] = now_ns()
    writer.commit(1)


@pytest.mark.thorough
@pytest.mark.parametrize("language", ["c99", "c++11"])
def test_the_reading_program(language: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    program = compiled(EXAMPLES / "touch.c", language, tmp_path_factory)
    assert subprocess.run([program, "torso"], capture_output=True).returncode == 1
    writer = DriverWriter("torso", structure(), rate_hz=0.1)
    publish(writer, 10)
    with lines_of(program, "torso") as lines:
        assert next(lines) == "frame 1: 2.0 Pa over 17 of 18 taxels\n"
        publish(writer, 20)
        assert next(lines) == "frame 2: 7.0 Pa over 17 of 18 taxels\n"
        writer.close()
        with DriverWriter("torso", structure(), rate_hz=0.1) as writer:
            publish(writer, 30)
            assert next(lines) == "frame 1: 12.0 Pa over 17 of 18 taxels\n"
            writer.restructure(structure(n_modules=2))
            publish(writer, 40)
            assert next(lines) == "frame 1: 17.0 Pa over 5 of 6 taxels\n"


@pytest.mark.thorough
def test_the_writing_program(tmp_path_factory: pytest.TempPathFactory) -> None:
    options = ["-D_POSIX_C_SOURCE=200809L", "-shared", "-fPIC"]
    library = compiled(EXAMPLES / "fingers.c", "c99", tmp_path_factory, options)
    with lines_of(sys.executable, EXAMPLES / "fingers.py", library), DriverReader("fingers", timeout_s=60) as reader:
        frames = reader.in_order(timeout_s=60)
        taken = [next(frames) for _ in range(50)]
        for before, frame in pairwise(taken):
            assert frame.values.tolist() == (np.arange(16) + frame.sequence - 1).tolist()
            assert frame.acquired_ns > before.acquired_ns
            assert frame.module_time_ns.tolist() == [frame.acquired_ns]
            assert (frame.status == 0).all()
            assert frame.patch_state.tolist() == [PatchState.LIVE]
            assert frame.bus_state.tolist() == [BusState.LIVE]
    with DriverWriter("fingers", structure()):  # what the killed script left is taken over and removed
        pass
