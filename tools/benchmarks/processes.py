"""Processes of a benchmark: forked, each with a pipe to its parent, and none of them left behind."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import resource
import shutil
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any, Self

from skinware import Namespace
from skinware.realtime import Profile

_FORK = multiprocessing.get_context("fork")  # everything is imported already: a child runs after a few ms
READY = "ready"


class RunFailed(Exception):
    """A process of this run died, or did not answer in time."""


class Processes:
    """The processes of one run. Leaving the block ends all that still run."""

    def __init__(self) -> None:
        self._processes: list[Any] = []

    def start(self, work: Callable[..., None], *arguments: Any) -> Connection:
        """Fork a process that runs ``work(pipe, *arguments)``.

        Returns:
            The parent's end of the pipe.
        """
        mine, theirs = _FORK.Pipe()
        process = _FORK.Process(target=_run, args=(work, theirs, mine, arguments))
        process.start()
        theirs.close()
        self._processes.append(process)
        return mine

    def kill_last(self) -> None:
        """SIGKILL to the process that was started last."""
        process = self._processes.pop()
        process.kill()
        process.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, failure: object, *_: object) -> None:
        deadline = time.monotonic() + (0 if failure else 10)
        for process in self._processes:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
            process.close()


def _run(work: Callable[..., None], pipe: Connection, parents: Connection, arguments: tuple[Any, ...]) -> None:
    parents.close()
    gc.freeze()
    try:
        work(pipe, *arguments)
    except (BrokenPipeError, KeyboardInterrupt):
        pass  # the parent was interrupted
    except Exception:  # noqa: BLE001 - the parent reports it
        with contextlib.suppress(OSError):
            pipe.send(RunFailed(traceback.format_exc()))


def answer(pipe: Connection, deadline_s: float) -> Any:
    """The next message of a process.

    Raises:
        RunFailed: it died, failed, or said nothing in time.
    """
    if not pipe.poll(deadline_s):
        raise RunFailed(f"no answer within {deadline_s:.0f} s")
    try:
        message = pipe.recv()
    except EOFError:
        raise RunFailed("a process of the run died") from None
    if isinstance(message, RunFailed):
        raise message
    return message


@contextlib.contextmanager
def within(limit_s: float) -> Iterator[None]:
    """A block that does not take longer, wherever it waits; for the main thread.

    Raises:
        RunFailed: it would have.
    """

    def late(*_: object) -> None:
        raise RunFailed(f"not done after {limit_s:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


class CpuShare:
    """CPU seconds of this process per second, from when this object was made."""

    def __init__(self) -> None:
        self._begin = self._now()

    @staticmethod
    def _now() -> tuple[float, float]:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return usage.ru_utime + usage.ru_stime, time.monotonic()

    def so_far(self) -> float:
        """1.0 is one core all the time."""
        cpu, passed = (now - begin for now, begin in zip(self._now(), self._begin, strict=True))
        return cpu / passed


def use_fifo(priority: int | None) -> None:
    """The real-time profile for this thread and those it starts later; None for the scheduling that there is."""
    if priority is not None:
        Profile.fifo(priority).apply(strict=True)


def may_use_fifo() -> bool:
    """Whether this user may use SCHED_FIFO; tried, then undone."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


@contextlib.contextmanager
def own_namespace(role: str = "") -> Iterator[Namespace]:
    """A namespace for this benchmark alone, removed afterwards; ``role`` tells several apart."""
    namespace = Namespace("-".join(filter(None, ("bench", str(os.getpid()), role))))
    try:
        yield namespace
    finally:
        shutil.rmtree(namespace.path, ignore_errors=True)
