"""Somebody in the namespace's group tries to stop or to deceive the others."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import grp
import itertools
import os
import random
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from skinware import Namespace, Sample, ServiceReader
from skinware.memory import file_layout
from skinware.memory.announcement import _SIZE, living_readers, sweep
from skinware.memory.locks import _FLOCK
from skinware_drivers.testing.waiting import wait_until
from tests.core.services import connect
from tests.core.users import (
    ANSWERS,
    CONTROL,
    FRAMES,
    GROUP,
    MEMBER,
    MISSED,
    OWNER,
    READY,
    STALE,
    STOP,
    Users,
    become,
    own,
)
from tests.core.workers import PATIENCE_S, Board, seeded

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="only root can be several users"),
    pytest.mark.usefixtures("process_server"),
]


def reads_on(users: Users, work: Callable[..., Any], *arguments: Any) -> tuple[Any, int, int]:
    """The owner's own reader and requester go on while somebody else does something: (its result, frames, answers)."""
    users.board.rows[2] = 0
    reading = users.crew.start(read_and_ask, users.board.path)
    wait_until(lambda: users.board.rows[2, FRAMES] > 3 and users.board.rows[2, ANSWERS] > 3, PATIENCE_S)
    before = users.board.rows[2].copy()
    published, missed = users.board.rows[0, FRAMES : MISSED + 1].tolist()
    result = users.ask(MEMBER, work, *arguments)
    frames, answers = (users.board.rows[2] - before)[[FRAMES, ANSWERS]].tolist()
    published, missed = (users.board.rows[0, FRAMES : MISSED + 1] - (published, missed)).tolist()
    print(f"{work.__name__}: {published} published, {missed} missed, {frames} read, {answers} answered, {result}")
    after = int(users.board.rows[2, ANSWERS])
    wait_until(lambda: users.board.rows[2, ANSWERS] > after, PATIENCE_S)
    users.board.rows[2, STOP] = 1
    users.crew.finish(reading)
    return result, frames, answers


def read_and_ask(board: Path) -> None:
    mine = Board(board).rows[2]
    become(OWNER, [])
    with ServiceReader[Sample]("x", timeout_s=PATIENCE_S) as reader:
        while not mine[STOP]:
            frame = reader.request(timeout_s=PATIENCE_S)
            assert (frame.column("values") == frame.sequence).all()
            mine[ANSWERS] += 1
            for frame in itertools.islice(reader.samples(timeout_s=PATIENCE_S), 3):
                mine[FRAMES] += 1
                mine[STALE] += frame.stale


def turns_of_an_attack(board: Path, at_least: int = 0) -> Iterator[int]:
    """For two seconds, and then until those who are attacked have done what no attacker may keep them from."""
    rows = Board(board).rows
    before = rows.copy()
    begin = time.monotonic()
    for turn in itertools.count():
        yield turn
        passed_s = time.monotonic() - begin
        done = rows - before
        published, missed = done[0, FRAMES], done[0, MISSED] - done[CONTROL, MISSED]  # more: it was brought down
        go_on = done[2, FRAMES] > 5 and done[2, ANSWERS] > 0 and published > 3 * missed
        if go_on and passed_s > 2.0 and turn >= at_least:
            return
        assert passed_s < PATIENCE_S / 2, f"{published} published, {missed} missed, {done[2, FRAMES]} read"


ASK = b'{"id":1,"operation":"echo","arguments":{"value":1}}'
BAD_PACKETS = [
    b"x",
    b"\xff\xfe",
    b'{"id":1,"operation":"\xff\xfe"}',
    b'{"id":1,"operation":"\\ud800"}',
    b"[" * 60000,
    b'{"id":1,"operation":"x","y":' + b"[" * 60000,
    b'{"id":1,"operation":"echo","arguments":{"value":' + b"[" * 900 + b"]" * 900 + b"}}",
    b'{"id":1,"operation":"echo","arguments":{"value":' + b"9" * 4299 + b"}}",
    b'{"id":' + b"9" * 4299 + b',"operation":"echo","arguments":{"value":1}}',
    b'{"id":-1,"operation":"' + b"x" * 60000 + b'"}',
    b'{"id":1,"operation":"echo","arguments":{"value":"' + b"\\u0000" * 9000 + b'"}}',
    b'{"id":1,"operation":"echo","arguments":{"nobody":1}}',
    b'{"id":1,"operation":"acquire","arguments":{"nobody":1}}',
    b'{"id":1,"operation":"cancel"}',
    b'{"id":null,"operation":"echo"}',
    ASK[:-5],
]


def garbage(board: Path, seed: int) -> int:
    """Everything that is no request, and requests with bytes changed."""
    dice = random.Random(seed)
    sent = 0
    for turn in turns_of_an_attack(board, 600):
        try:
            with connect() as peer:
                packet = bytearray(BAD_PACKETS[turn % len(BAD_PACKETS)] if turn < 200 else ASK)
                for _ in range(dice.randint(0, 3) if turn >= 200 else 0):
                    packet[dice.randrange(len(packet))] = dice.randrange(256)
                peer.send(packet)
                sent += 1
                time.sleep(0.001 * (turn % 3))
        except OSError:
            time.sleep(0.005)
    return sent


def flood(board: Path) -> int:
    """As many connections as possible, all asking without an end; half of them read no answer."""
    peers: list[socket.socket] = []
    sent = 0
    for _ in turns_of_an_attack(board):
        if len(peers) < 200:
            try:
                peers.append(connect())
            except OSError:
                time.sleep(0.001)
        for number, peer in enumerate(peers):
            try:
                for _ in range(20):
                    peer.send(ASK)
                    sent += 1
                    if number % 2:
                        peer.recv(1 << 16)
            except BlockingIOError:
                pass
            except OSError:
                peer.close()
        peers = [peer for peer in peers if peer.fileno() >= 0]
    return sent


def wake_ups(board: Path) -> int:
    """Wake all readers without an end, and move them to a futex that nobody wakes."""
    with ServiceReader[Sample]("x", announce=False) as reader:
        start = reader._ring.segment.data.ctypes.data
        address, elsewhere = start + file_layout.WAKE_WORD_OFFSET, start + file_layout.STATISTICS_OFFSET
        libc = ctypes.CDLL(None)
        moved = 0
        for _ in turns_of_an_attack(board):
            for _ in range(100):
                libc.syscall(202, ctypes.c_void_p(address), 1, 1)  # FUTEX_WAKE
                moved += libc.syscall(202, ctypes.c_void_p(address), 3, 0, 1000, ctypes.c_void_p(elsewhere))  # REQUEUE
        return moved


def locks() -> int:
    """Hold every lock that a reader may."""
    place = Namespace()
    descriptor = os.open(place.ring_path("x"), os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    read_lock(descriptor)
    return descriptor


def read_lock(descriptor: int) -> None:
    with contextlib.suppress(BlockingIOError):  # granted only when the writer is dead
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, _FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, 0, 0, 0))


def fakes() -> int:
    """Announcements that are none, that never end, that want to command a terminal."""
    import zlib

    place = Namespace()
    folder = place.readers_path
    texts = [
        b"",
        b"x" * 5000,
        b'{"service":"x","pid":1,"program":"\\u001b[2J\\u009b2J\\n\\u202e","kind":"a\\u001b]0;x\\u0007"}',
        b'{"service":"x","pid":1,"program":"y","kind":"z","other":' + b"[" * 1900,
        b'{"service":"\xff","pid":1,"program":"y","kind":"z"}',
        b'{"service":"x","pid":' + b"9" * 1800 + b',"program":"y","kind":"z"}',
    ]
    for number, text in enumerate(texts):
        descriptor = os.open(folder / f"x.{number}.fake", os.O_RDWR | os.O_CREAT, 0o644)
        padded = text.ljust(_SIZE - 9)
        os.write(descriptor, b"%08x " % zlib.crc32(padded[: _SIZE - 9]) + padded)
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0))
    os.mkfifo(folder / "x.fifo")
    (folder / "x.folder").mkdir()
    (folder / "x.link").symlink_to(place.ring_path("x"))
    (folder / "\x1b[2J\udcff").touch()
    sweep(place)
    for name in os.listdir(folder):
        if (folder / name).lstat().st_uid != MEMBER:
            with pytest.raises(PermissionError):
                (folder / name).unlink()
            with pytest.raises(PermissionError):
                os.rename(folder / name, folder / "stolen")
    return len(list(living_readers(place)))


@pytest.mark.alone
@pytest.mark.thorough
@pytest.mark.parametrize("attack", [flood, wake_ups])
def test_an_attacker_in_the_group_stops_nobody(users: Users, attack: Callable[[Path], int]) -> None:
    _, frames, answers = reads_on(users, attack, users.board.path)
    assert frames > 5
    assert answers > 0
    assert users.board.rows[2, STALE] == 0


@pytest.mark.alone
@pytest.mark.thorough
def test_garbage_on_the_socket_stops_nobody(users: Users, request: pytest.FixtureRequest) -> None:
    sent, _, answers = reads_on(users, garbage, users.board.path, seeded(request).getrandbits(32))
    assert sent > 100
    assert answers > 0


def hold(board: Path) -> None:
    rows = Board(board).rows
    become(MEMBER, [grp.getgrnam(GROUP).gr_gid])
    descriptor = locks()
    fakes()
    rows[3, READY] = 1
    while not rows[3, STOP]:
        read_lock(descriptor)
        time.sleep(0.001)
    os.close(descriptor)
    for path in Namespace().readers_path.iterdir():
        path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()


@pytest.mark.thorough
def test_locks_and_fake_announcements_neither_hide_a_death_nor_harm_who_looks(users: Users) -> None:
    holder = users.crew.start(hold, users.board.path)
    wait_until(lambda: bool(users.board.rows[3, READY]), PATIENCE_S)
    records = list(living_readers(Namespace()))
    assert records
    for record in records:
        assert (record.service + record.program + record.kind).isprintable()
    with ServiceReader[Sample]("x", announce=False) as reader:
        assert reader.alive
        users.crew.kill(users.driver)
        assert not reader.alive
        users.driver = users.crew.start(own, users.board.path)
        assert not reader.read(newer_than=reader.read(), timeout_s=PATIENCE_S).stale
    users.board.rows[3, STOP] = 1
    users.crew.finish(holder)
