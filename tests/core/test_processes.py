"""Whether a process has ended: known, or left to the lock where it cannot be known."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from skinware.memory import locks
from skinware.memory.locks import ENDED, UNKNOWN, Descriptor, Process, ProcessWatch, has_ended, this_process


def test_a_process_that_runs_has_not_ended() -> None:
    watch = ProcessWatch(this_process())
    assert not watch.has_ended()
    assert watch.fd_for_c >= 0
    watch.close()
    assert (watch.has_ended(), watch.fd_for_c) == (False, UNKNOWN)


def test_a_process_has_ended_before_its_parent_waits_for_it_and_after() -> None:
    ready, go = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        os.write(ready[1], repr(tuple(this_process())).encode())
        os.read(go[0], 1)
        os._exit(0)
    process = Process(*map(int, os.read(ready[0], 100).decode().strip("()").split(",")))
    watch = ProcessWatch(process)
    assert not watch.has_ended()
    os.write(go[1], b"x")
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    assert watch.has_ended()  # a zombie
    assert has_ended(process)
    os.waitpid(child, 0)
    assert watch.has_ended()
    assert ProcessWatch(process).fd_for_c == ENDED
    watch.close()
    for fd in (*ready, *go):
        os.close(fd)


def test_a_number_that_another_process_has_now_is_of_one_that_ended() -> None:
    mine = this_process()
    assert has_ended(mine._replace(start_ticks=mine.start_ticks - 1))


@pytest.mark.parametrize("pid", [0, 1 << 31, (1 << 64) - 1])
def test_of_impossible_numbers_nothing_is_known(pid: int) -> None:
    assert not has_ended(this_process()._replace(pid=pid))


def test_of_other_pid_namespaces_and_without_rights_nothing_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = this_process()._replace(start_ticks=1)
    assert has_ended(ended)
    assert not has_ended(ended._replace(pid_namespace=ended.pid_namespace + 1))
    assert not has_ended(ended._replace(start_ticks=0))
    monkeypatch.setattr(locks, "_start_ticks", lambda _: 0)  # hidepid
    assert not has_ended(ended)


def test_nothing_is_closed_while_another_thread_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its number may be another file's the next moment."""
    asked, answer, closed = threading.Event(), threading.Event(), threading.Event()

    def slow_fcntl(fd: int, command: int, argument: bytes) -> bytes:
        asked.set()
        answer.wait()
        os.fstat(fd)
        return argument

    def close() -> None:
        descriptor.close()
        closed.set()

    monkeypatch.setattr(fcntl, "fcntl", slow_fcntl)
    with ThreadPoolExecutor() as pool:
        descriptor = Descriptor(os.open(tmp_path, os.O_RDONLY))
        answers = pool.submit(descriptor.is_locked)
        asked.wait()
        pool.submit(close)
        assert not closed.wait(0.05)
        answer.set()
        answers.result()
        assert closed.wait(60)
    assert (descriptor.fd, descriptor.is_locked()) == (-1, False)


@pytest.mark.thorough
@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, for pid namespaces")
def test_a_proc_of_another_pid_namespace_makes_no_process_dead() -> None:
    program = """
from skinware.memory.locks import Process, has_ended, this_process
mine = this_process()
assert mine.pid < 10, mine  # its own numbers, and the /proc of its parent
print(has_ended(mine))
"""
    result = subprocess.run(
        ["unshare", "--pid", "--fork", sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    if "unshare" in result.stderr:
        pytest.skip(result.stderr)
    assert result.stdout == "False\n", result.stderr


def test_several_threads_may_ask_at_once() -> None:
    watch = ProcessWatch(this_process())
    with ThreadPoolExecutor(4) as threads:
        answers = [threads.submit(lambda: [watch.has_ended() for _ in range(20_000)]) for _ in range(4)]
        assert not any(any(each.result()) for each in answers)
    watch.close()
