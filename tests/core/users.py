"""A driver that belongs to one user, and what others do."""

from __future__ import annotations

import codecs
import contextlib
import grp
import itertools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from skinware import ServiceWriter
from skinware_drivers.testing.waiting import wait_until
from tests.core.workers import PATIENCE_S, Board, Crew

OWNER, MEMBER, STRANGER = 61001, 61002, 61003
GROUP = "games"
COLUMNS = {"values": ("<u4", 100)}
READY, STOP, FRAMES, MISSED, STALE, ANSWERS = range(6)
CONTROL = 4
"""Row of a driver like ``x`` that nobody attacks: what the machine does to one, it does to the other."""


def become(user: int, groups: list[int]) -> None:
    """Be another user from now on; what Python loads late is loaded now, from where that user may not look."""
    codecs.lookup("ascii")
    os.setgroups(groups)
    os.setgid(user)
    os.setuid(user)
    os.environ["SKINWARE_OWNER"] = str(OWNER)


def as_user(user: int, in_group: bool, answer: Path, work: Callable[..., Any], *arguments: Any) -> None:
    """In a child process: do something as a user, and leave what it returns in a file."""
    descriptor = os.open(answer, os.O_WRONLY | os.O_CREAT, 0o600)
    become(user, [grp.getgrnam(GROUP).gr_gid] if in_group else [])
    os.write(descriptor, repr(work(*arguments)).encode())


class Users:
    """Runs things as other users; the owner's driver ``x`` runs all the while."""

    def __init__(self, crew: Crew, folder: Path) -> None:
        folder.chmod(0o755)
        self.crew, self.folder = crew, folder
        self.numbers = itertools.count()
        self.board = Board(folder / "board", 5)
        self.board.path.chmod(0o666)
        self.driver = crew.start(own, self.board.path)
        self._control = crew.start(own, self.board.path, "control", CONTROL)
        wait_until(lambda: bool((self.board.rows[[0, CONTROL], FRAMES] > 3).all()), PATIENCE_S)

    def ask(self, user: int, work: Callable[..., Any], *arguments: Any) -> Any:
        """What a function returns as another user."""
        path = self.folder / f"answer{next(self.numbers)}"
        self.crew.finish(self.crew.start(as_user, user, user != STRANGER, path, work, *arguments))
        return eval(path.read_text())  # our own repr

    def stop(self) -> None:
        self.board.rows[1, STOP] = 1
        self.crew.finish(self.driver)
        self.crew.finish(self._control)


def own(board: Path, name: str = "x", row: int = 0) -> None:
    """The owner's driver: 100 Hz, a socket, and an operation."""
    rows = Board(board).rows
    become(OWNER, [grp.getgrnam(GROUP).gr_gid])

    def echo(value: object) -> object:
        """Say it again."""
        return value

    with ServiceWriter(name, COLUMNS, group=GROUP, operations={"echo": echo}) as writer:
        for columns in writer.periodic(100):
            columns["values"][:] = writer.sequence + 1
            rows[row, FRAMES], rows[row, MISSED] = writer.sequence, writer.missed_periods
            if rows[1, STOP]:
                break


@contextlib.contextmanager
def running_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Users]:
    monkeypatch.setenv("SKINWARE_OWNER", str(OWNER))
    for folder in itertools.takewhile(lambda path: path != Path("/tmp"), tmp_path.parents):
        folder.chmod(0o755)
    with Crew() as crew:
        made = Users(crew, tmp_path)
        yield made
        made.stop()
        made.board = None  # type: ignore[assignment]
