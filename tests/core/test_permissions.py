"""What the namespace's owner, a member of its group and a stranger can do."""

from __future__ import annotations

import ctypes
import fcntl
import itertools
import mmap
import os
import signal
import socket
from collections.abc import Callable

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter, Skin
from skinware.errors import NamespaceError, SkinwareError
from skinware.memory.announcement import living_readers
from skinware.memory.locks import _FLOCK
from skinware_drivers.testing.waiting import wait_until
from tests.core.users import COLUMNS, FRAMES, GROUP, MEMBER, OWNER, STRANGER, Users
from tests.core.workers import PATIENCE_S

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="only root can be several users"),
    pytest.mark.usefixtures("process_server"),
]


def refusals(attempts: dict[str, Callable[[], object]]) -> dict[str, str]:
    """What came of each attempt: the error's name, or ``done``."""
    found = {}
    for name, attempt in attempts.items():
        try:
            attempt()
        except (OSError, SkinwareError) as error:
            found[name] = type(error).__name__
        else:
            found[name] = "done"
    return found


def take_part() -> tuple[int, bool, bool]:
    place = Namespace()
    with ServiceReader[Sample]("x", timeout_s=PATIENCE_S) as reader:
        frames = reader.in_order(timeout_s=PATIENCE_S)
        whole = all((frame.column("values") == frame.sequence).all() for frame in itertools.islice(frames, 20))
        seen = [record.pid for record in living_readers(place)] == [os.getpid()]
        asked = reader.call("echo", value=7)
    return asked, whole, seen


def test_a_member_of_the_group_reads_announces_itself_and_asks(users: Users) -> None:
    assert users.ask(MEMBER, take_part) == (7, True, True)


# -- what is refused ---------------------------------------------------------------------------------------------


def forbidden() -> dict[str, str]:
    """Every way to change what is the owner's."""
    place = Namespace()
    ring, lock, sock = place.ring_path("x"), place.lock_path("x"), place.socket_path("x")
    readable = os.open(ring, os.O_RDONLY)
    write_lock = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
    libc = ctypes.CDLL(None, use_errno=True)
    mapped = mmap.mmap(readable, 4096, prot=mmap.PROT_READ)

    def protect() -> None:
        with open("/proc/self/maps") as maps:
            address = next(int(line.split("-")[0], 16) for line in maps if "x.ring" in line)
        if libc.mprotect(ctypes.c_void_p(address), 4096, mmap.PROT_READ | mmap.PROT_WRITE) != 0:
            raise OSError(ctypes.get_errno(), "mprotect")

    driver = int(ServiceReader[Sample]("x", announce=False).writer_pid)
    attempts: dict[str, Callable[[], object]] = {
        f"open {path.name} {flags}": lambda path=path, flags=flags: os.open(path, flags)  # type: ignore[misc]
        for path in (ring, lock)
        for flags in (os.O_RDWR, os.O_WRONLY, os.O_WRONLY | os.O_TRUNC)
    }
    attempts |= {
        "open lock": lambda: os.open(lock, os.O_RDONLY),
        "reopen": lambda: os.open(f"/proc/self/fd/{readable}", os.O_RDWR),
        "map": lambda: mmap.mmap(readable, 4096),
        "mprotect": protect,
        "write": lambda: os.pwrite(readable, b"x", 0),
        "truncate": lambda: os.truncate(ring, 0),
        "lock": lambda: fcntl.fcntl(readable, fcntl.F_OFD_SETLK, write_lock),
        "process lock": lambda: fcntl.lockf(readable, fcntl.LOCK_EX | fcntl.LOCK_NB),
        "lease": lambda: fcntl.fcntl(readable, fcntl.F_SETLEASE, fcntl.F_WRLCK),
        "chmod": lambda: ring.chmod(0o666),
        "chmod namespace": lambda: place.path.chmod(0o777),
        "chown": lambda: os.chown(ring, MEMBER, -1),
        "unlink": ring.unlink,
        "unlink lock": lock.unlink,
        "unlink socket": sock.unlink,
        "rename": lambda: os.rename(ring, place.path / "y.ring"),
        "rename over": lambda: os.rename(place.readers_path, ring),
        "rename namespace": lambda: os.rename(place.path, "/dev/shm/skinware.stolen"),
        "remove readers": place.readers_path.rmdir,
        "make": lambda: (place.path / "y.ring").touch(),
        "make lock": lambda: (place.path / "y.lock").touch(),
        "symlink": lambda: (place.path / "y.ring").symlink_to(ring),
        "bind": lambda: socket.socket(socket.AF_UNIX).bind(f"{place.path}/y.sock"[-100:]),
        "take the name": lambda: ServiceWriter("x", COLUMNS),
        "another name": lambda: ServiceWriter("y", COLUMNS),
        "stop": lambda: os.kill(driver, signal.SIGSTOP),
        "utime": lambda: os.utime(ring, (0, 0)),
        "xattr": lambda: os.setxattr(ring, "user.x", b"y"),
    }
    found = refusals(attempts)
    mapped.close()
    return found


def test_a_member_of_the_group_can_change_nothing(users: Users) -> None:
    found = users.ask(MEMBER, forbidden)
    assert {name: what for name, what in found.items() if what == "done"} == {}
    assert found["take the name"] == found["another name"] == "NamespaceError"
    assert len(found) > 30
    before = int(users.board.rows[0, FRAMES])
    wait_until(lambda: users.board.rows[0, FRAMES] > before + 5, PATIENCE_S)


def reasons() -> list[str]:
    with pytest.raises(NamespaceError) as reading:
        Namespace().services()
    with pytest.raises(NamespaceError) as writing:
        ServiceWriter("x", COLUMNS)
    return [str(reading.value), str(writing.value)]


def test_a_stranger_reads_whom_to_ask(users: Users) -> None:
    folder = Namespace().path
    for advice in (f"ask user {OWNER} to add you to group {GROUP}", "start its drivers with --group and a group"):
        reading, writing = users.ask(STRANGER, reasons)
        assert reading.startswith(f"{folder} may not be read by user {STRANGER}; {advice}")
        assert f"belongs to user {OWNER}: drivers must run as that user" in writing
        os.chown(folder, -1, 0)  # as a driver of root makes it


@pytest.mark.usefixtures("users")
def test_what_may_not_be_trusted_is_not_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SKINWARE_OWNER", raising=False)
    with Skin() as skin, pytest.raises(NamespaceError, match=f"belongs to user {OWNER}, who is neither you nor root"):
        skin.refresh()


def strange() -> dict[str, str]:
    place = Namespace()
    attempts: dict[str, Callable[[], object]] = {
        "list": lambda: os.listdir(place.path),
        "services": place.services,
        "attach": lambda: ServiceReader[Sample]("x"),
        "write": lambda: ServiceWriter("x", COLUMNS),
        "open": lambda: os.open(place.ring_path("x"), os.O_RDONLY),
        "stat": lambda: os.stat(place.ring_path("x")),
        "readers": lambda: os.listdir(place.readers_path),
        "announce": lambda: (place.readers_path / "x.1.0").touch(),
        "connect": lambda: socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET).connect(str(place.socket_path("x"))),
    }
    assert list(living_readers(place)) == []
    return refusals(attempts)


@pytest.mark.thorough
def test_a_stranger_sees_nothing(users: Users) -> None:
    found = users.ask(STRANGER, strange)
    assert "done" not in found.values(), found
    assert found["services"] == found["write"] == "NamespaceError"
    assert found["attach"] == "BadServiceFile"
