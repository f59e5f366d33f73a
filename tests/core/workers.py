"""Child processes of the proofs: made quickly, watched through a board of numbers, killed at any line they run.

Sizes and seeds of the proofs can be given: SKINWARE_TEST_SEED (printed by each run that has one), SKINWARE_TEST_KILLS
(500), SKINWARE_TEST_EXAMPLES (of hypothesis, per test).
"""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.forkserver
import os
import random
import secrets
import signal
import sys
import types
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import skinware
from tests.specification import ring as specification

PATIENCE_S = 60.0
"""How long anything may take on a machine that others use too."""
PRODUCT = str(Path(skinware.__file__).parent)
PROCESSES = multiprocessing.get_context("forkserver")


def seeded(request: pytest.FixtureRequest) -> random.Random:
    """A generator whose seed is printed when the test fails; SKINWARE_TEST_SEED repeats it."""
    seed = int(os.environ.get("SKINWARE_TEST_SEED") or secrets.randbits(32))
    print(f"{request.node.name}: SKINWARE_TEST_SEED={seed}")
    return random.Random(seed)


@contextlib.contextmanager
def process_server(module: str) -> Iterator[None]:
    """Children are forked from a small process that has imported everything, this module of tests, too.

    It ends with the tests of the module.
    """
    PROCESSES.set_forkserver_preload(["tests.core.workers", "skinware.driver_service", module])
    try:
        yield
    finally:
        multiprocessing.forkserver._forkserver._stop()  # type: ignore[attr-defined]


class Board:
    """Rows of int64 numbers in a file that all processes of a test map; each row has one writer."""

    def __init__(self, path: Path, rows: int = 0, columns: int = 8) -> None:
        self.path = path
        if rows:
            np.zeros((rows, columns), np.int64).tofile(path)
        self.rows: npt.NDArray[np.int64] = np.memmap(path, np.int64, "r+").reshape(-1, columns)


class Crew:
    """Processes of one test; whatever happens, none is left."""

    def __init__(self) -> None:
        self._members: list[BaseProcess] = []

    def start(self, work: Callable[..., None], *arguments: Any) -> BaseProcess:
        """Run a function of a module in a process of its own."""
        process = PROCESSES.Process(target=_work_in, args=(_environment(), work, *arguments))
        process.start()
        self._members.append(process)
        return process

    def finish(self, process: BaseProcess, expected: int | None = 0) -> None:
        """Wait for its end."""
        process.join(PATIENCE_S)
        assert process.exitcode is not None, f"{process} did not end"
        assert expected is None or process.exitcode == expected, f"{process} ended with {process.exitcode}"
        self._members.remove(process)
        process.close()

    def kill(self, process: BaseProcess) -> None:
        """SIGKILL, also if it is dead already."""
        process.kill()
        self.finish(process, None)

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *_: object) -> None:
        for process in list(self._members):
            self.kill(process)


@contextlib.contextmanager
def running(work: Callable[..., None], *arguments: Any) -> Iterator[BaseProcess]:
    """A function in a process of its own, which is killed at the end, unless it was before."""
    with Crew() as crew:
        yield crew.start(work, *arguments)


def kill(process: BaseProcess) -> None:
    """SIGKILL, and wait until it is dead."""
    process.kill()
    process.join(PATIENCE_S)


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name.startswith("SKINWARE_")}


def _work_in(environment: dict[str, str], work: Callable[..., None], *arguments: Any) -> None:
    os.environ.pop(specification.VARIABLE, None)  # the process server has the environment of the test that started it
    os.environ.update(environment)
    specification.use_ring_of_environment()
    work(*arguments)


class Bomb:
    """SIGKILL of this process at the n-th line of the product that it runs while the bomb is armed.

    Args:
        state: what the process must be doing.
        lines: n; if the doing ends before, it ends with the kill.
    """

    def __init__(self, state: str, lines: int) -> None:
        self._state = state
        self._left = lines

    @contextlib.contextmanager
    def armed(self, state: str, *, last_chance: bool = True) -> Iterator[None]:
        """Around everything that the process does."""
        if state != self._state:
            yield
            return
        sys.settrace(self._trace)
        try:
            yield
        finally:
            sys.settrace(None)
        if last_chance:
            self._explode()

    def _trace(self, frame: types.FrameType, event: str, _argument: object) -> Any:
        if not frame.f_code.co_filename.startswith(PRODUCT):
            return None
        if event == "line":
            self._left -= 1
            if self._left <= 0:
                self._explode()
        return self._trace

    @staticmethod
    def _explode() -> None:
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("survived SIGKILL")
