"""A name has one owner at a time, whoever dies, forks or removes files."""

from __future__ import annotations

import contextlib
import ctypes
import grp
import os
import shutil
import signal
import time
from pathlib import Path
from unittest import mock

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import Closed, ConfigurationError, NameInUse, NamespaceError, PeerGone, ServiceTimeout
from skinware.memory.announcement import living_readers
from skinware.memory.locks import Descriptor, ForkGuard, is_locked
from skinware.memory.segments import living_inode
from skinware.service import RequestServer
from skinware_drivers.testing.waiting import wait_until
from tests.core.c_programs import run
from tests.core.test_chaos import BEGUN, COLUMNS, MISSED, PID, ROUTINE, TORN, WON, victim_driver
from tests.core.workers import PATIENCE_S, Board, Bomb, Crew

pytestmark = pytest.mark.usefixtures("process_server")


def fight_for_a_name(board: Path, row: int, wins: int) -> None:
    """Own the name again and again, each time without seeing anybody else own it."""
    rows = Board(board).rows
    while rows[row, WON] < wins:
        try:
            with ServiceWriter("x", COLUMNS):
                rows[0, PID] = os.getpid()
                time.sleep(0)
                rows[row, TORN] += rows[0, PID] != os.getpid()
                rows[row, WON] += 1
        except NameInUse:
            rows[row, MISSED] += 1


def test_two_drivers_never_both_own_a_name(tmp_path: Path, namespace: Namespace) -> None:
    board = Board(tmp_path / "board", 5)
    with Crew() as crew:
        fighters = [crew.start(fight_for_a_name, board.path, row, 50) for row in range(1, 5)]
        for process in fighters:
            crew.finish(process)
    assert board.rows[1:, WON].tolist() == [50] * 4
    assert board.rows[:, TORN].sum() == 0
    assert board.rows[:, MISSED].sum() > 0  # they did meet


def wait_forked(board: Path, until: Path) -> None:
    victim_driver("x", board, 0, ROUTINE, 0, until)


def test_a_forked_child_does_not_make_a_dead_driver_look_alive(tmp_path: Path, namespace: Namespace) -> None:
    board, until = Board(tmp_path / "board", 1), tmp_path / "stop"
    with Crew() as crew:
        process = crew.start(wait_forked, board.path, until)
        with ServiceReader[Sample]("x", timeout_s=PATIENCE_S) as reader:
            frame = reader.read(timeout_s=PATIENCE_S)
            wait_until(lambda: board.rows[0, BEGUN] > 2, PATIENCE_S)
            pending = reader.ask("acquire")
            pending.result(PATIENCE_S)
            crew.kill(process)
            assert not reader.alive
            last = reader.read()
            assert last.stale
            with pytest.raises(ServiceTimeout, match="dead"):
                reader.read(newer_than=last, timeout_s=0.1)
            with pytest.raises(PeerGone):
                reader.request()
            with ServiceWriter("x", COLUMNS) as again:
                again.begin()["values"][:] = 1
                again.commit(1)
                assert not reader.read(newer_than=frame).stale
        until.touch()


def fork_in_c() -> int:
    """No hook of Python's runs: the child keeps the locks and the connections for as long as it lives."""
    return int(ctypes.CDLL(None).fork())


def test_a_child_that_c_forked_keeps_neither_a_dead_driver_alive_nor_its_name(
    tmp_path: Path, namespace: Namespace, program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    board, until = Board(tmp_path / "board", 1), tmp_path / "stop"
    with Crew() as crew, contextlib.ExitStack() as at_end:
        at_end.callback(until.touch)
        process = crew.start(victim_driver, "x", board.path, 0, ROUTINE, 0, until, fork_in_c)
        with ServiceReader[Sample]("x", timeout_s=PATIENCE_S) as reader:
            wait_until(lambda: board.rows[0, BEGUN] > 2, PATIENCE_S)
            frames = reader.samples(timeout_s=PATIENCE_S)
            assert not any(next(frames).stale for _ in range(5))
            assert reader.alive
            assert living_inode(namespace, "x") is not None
            assert run(program, "describe", "x")["stale"] == 0
            crew.kill(process)
            with open(namespace.ring_path("x"), "rb") as ring, open(namespace.lock_path("x"), "rb") as lock:
                assert is_locked(ring.fileno())
                assert is_locked(lock.fileno())
            assert not reader.alive
            assert reader.read().stale
            assert living_inode(namespace, "x") is None
            assert run(program, "describe", "x")["stale"] == 1
            with pytest.raises(PeerGone):
                reader.request()
            last = reader.newest_position
            monkeypatch.setattr("skinware.service._ownership._ORPHAN_S", 0.0)
            with ServiceWriter("x", COLUMNS) as again:
                again.begin()["values"][:] = 1
                again.commit(1)
                assert not reader.read(newer_than=last, timeout_s=PATIENCE_S).stale
                with pytest.raises(NameInUse):
                    ServiceWriter("x", COLUMNS)


def fork_and_die() -> None:
    """The child has not yet given up what it inherited when its parent is dead."""

    def abandon_slowly(self: Descriptor) -> None:
        time.sleep(0.1)
        self.close()

    writer = ServiceWriter("x", COLUMNS)
    mock.patch.object(Descriptor, "abandon", abandon_slowly).start()
    if os.fork() == 0:
        os._exit(0)
    assert not writer.closed
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_driver_that_was_killed_while_it_forked_can_be_started_again_at_once(namespace: Namespace) -> None:
    with Crew() as crew:
        crew.finish(crew.start(fork_and_die), -signal.SIGKILL)
        with ServiceWriter("x", COLUMNS) as again:
            assert not again.closed


def make_namespace(lines: int) -> None:
    with Bomb("making", lines).armed("making"):
        Namespace().create()


def test_a_namespace_whose_maker_was_killed_at_any_line_is_made_whole_by_the_next(namespace: Namespace) -> None:
    with Crew() as crew:
        for lines in range(1, 60):
            crew.finish(crew.start(make_namespace, lines), -signal.SIGKILL)
            namespace.create()
            modes = {path: path.stat().st_mode & 0o7777 for path in (namespace.path, namespace.readers_path)}
            assert modes == {namespace.path: 0o2750, namespace.readers_path: 0o3770}, lines
            assert os.listdir(namespace.path) == ["readers"]
            assert not namespace.path.with_name(f".{namespace.path.name}").exists()
            shutil.rmtree(namespace.path)


def test_a_driver_whose_namespace_was_removed_gives_way_to_one_that_took_its_name(namespace: Namespace) -> None:
    with ServiceWriter("x", COLUMNS) as first, ServiceWriter("y", COLUMNS) as other:
        first.request_server()
        shutil.rmtree(namespace.path)
        with ServiceWriter("x", COLUMNS) as second, ServiceReader[Sample]("x") as reader:
            second.request_server()
            first._next_file_check_ns = other._next_file_check_ns = 0  # now instead of within a second
            with pytest.raises(NameInUse):
                first.begin()
            assert first.closed
            other.begin()
            other.commit(1)
            second.begin()["values"][:] = 7
            second.commit(1)
            assert reader.read().column("values")[0] == 7
            assert namespace.socket_path("x").exists()
            with pytest.raises(NameInUse):
                ServiceWriter("y", COLUMNS)


def test_a_forked_child_changes_nothing(namespace: Namespace) -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:
        writer.begin()
        writer.commit(1)
        generation = writer.generation
        writer.begin()
        answer = os.pipe()
        child = os.fork()
        if child == 0:
            refused = 0
            for change in (
                lambda: writer.commit(2),
                writer.begin,
                writer.pause,
                writer.requests,
                lambda: writer.restructure(COLUMNS),
                reader.read,
            ):
                try:
                    change()
                except Closed:
                    refused += 1
            writer.close()
            reader.close()
            os.write(answer[1], bytes([refused]))
            os._exit(0)
        os.waitpid(child, 0)
        assert os.read(answer[0], 1) == b"\x06"
        for fd in answer:
            os.close(fd)
        assert not reader.paused
        assert reader.read().position == (generation, 1)
        assert len(list(living_readers(namespace))) == 1
        writer.commit(2)
        assert reader.read().sequence == 2


class HalfBuilt(ForkGuard):
    """Lacks what it should close."""

    def abandon(self) -> None:
        raise AttributeError("it was never built")


def test_a_forked_child_gives_up_everything_though_something_cannot_be(namespace: Namespace) -> None:
    """One such guard must not keep all others alive in the child."""
    broken = [HalfBuilt() for _ in range(20)]  # in whatever order they are asked
    with ServiceWriter("x", COLUMNS) as writer, ServiceWriter("y", COLUMNS) as other:
        writer.request_server()
        answer, end = os.pipe(), os.pipe()
        errors = os.open(os.devnull, os.O_WRONLY)  # for what Python says of such a guard
        own = os.dup(2)
        os.dup2(errors, 2)
        child = os.fork()
        if child == 0:
            try:
                os.write(answer[1], bytes([writer.closed, other.closed]))
                os.read(end[0], 1)
            finally:
                os._exit(0)
        os.dup2(own, 2)
        try:
            assert os.read(answer[0], 2) == b"\x01\x01"
            writer.close()
            ServiceWriter("x", COLUMNS).close()  # the child does not hold its locks
        finally:
            os.write(end[1], b"x")
            os.waitpid(child, 0)
            for fd in (*answer, *end, errors, own):
                os.close(fd)
    del broken


def test_a_server_that_could_not_be_made_harms_no_fork(namespace: Namespace) -> None:
    known = set(ForkGuard._all)
    with ServiceWriter("x", COLUMNS) as writer:
        (namespace.path / ".x.sock").mkdir()
        with pytest.raises(NamespaceError) as kept:  # and with it the half-built server
            writer.request_server()
        assert not [guard for guard in set(ForkGuard._all) - known if isinstance(guard, RequestServer)]
        (namespace.path / ".x.sock").rmdir()
        del kept


@pytest.mark.thorough
def test_a_namespace_that_is_there_is_not_given_to_another_group(namespace: Namespace) -> None:
    namespace.create()
    own = namespace.path.stat().st_gid
    known = {group.gr_gid: group.gr_name for group in grp.getgrall()}
    another = next(name for group, name in known.items() if group != own)
    with pytest.raises(ConfigurationError, match=f"is one of .*, not of group {another}: "):
        namespace.create(another)
    with pytest.raises(ConfigurationError, match="not of group"):
        ServiceWriter("x", {"values": ("u1", 1)}, group=another)
    namespace.create(known[own])
    assert namespace.services() == []
