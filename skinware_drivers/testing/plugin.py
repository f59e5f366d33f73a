"""The pytest plug-in: fixtures for tests of drivers and of programs that read skins.

pytest loads it wherever Skinware is installed. It imports nothing of Skinware before a fixture is used, so that tests
of other projects do not change.
"""

from __future__ import annotations

import gc
import itertools
import multiprocessing
import os
import secrets
import shutil
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from skinware.memory.namespace import Namespace
    from skinware_drivers.testing.driving import EmulatedSkin


class Belongings:
    """The threads, descriptors and processes of this process at one moment."""

    def __init__(self) -> None:
        gc.freeze()  # makes the collection after each test fast: older objects are not searched
        self._threads = set(threading.enumerate())
        self._descriptors = _descriptors()

    def left_since(self) -> list[str]:
        """Return in words what was made since then and still exists."""
        gc.collect()
        gc.unfreeze()
        left = [f"thread {thread.name!r}" for thread in set(threading.enumerate()) - self._threads]
        left += [f"descriptor {number} ({target})" for number, target in sorted(_descriptors() - self._descriptors)]
        left += [f"process {process.name}" for process in multiprocessing.active_children()]
        return left


def files_left(namespace: Path) -> list[str]:
    """Return in words the files of services and readers that are left in a namespace."""
    return [f"file {path}" for path in namespace.rglob("*") if path.suffix != ".lock" and path != namespace / "readers"]


def _descriptors() -> set[tuple[str, str]]:
    found = set()
    for number in os.listdir("/proc/self/fd"):
        try:
            target = os.readlink(f"/proc/self/fd/{number}")
        except FileNotFoundError:
            continue
        if not target.startswith(("/proc", "/dev/null", "pipe:[")):  # pytest's own capturing and multiprocessing's
            found.add((number, target))
    return found


_CAN_FIXTURES = {"vcan", "can_pair"}
_NO_CAN = (
    "this kernel has no CAN, or you may not make interfaces: run as root where the modules can and vcan are, or with"
    " `pytest --skin-can-lab`, which runs these tests in a virtual machine that has CAN"
)
_numbers = itertools.count()
_failed = pytest.StashKey[bool]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--skin-can-lab``."""
    parser.getgroup("skinware").addoption(
        "--skin-can-lab",
        action="store_true",
        help="run the tests marked `can`, and no others, in a virtual machine that has CAN"
        " (needs QEMU, virtme-ng and an installed kernel with CAN modules; says what is missing)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the mark ``can``."""
    config.addinivalue_line("markers", "can: needs a kernel with CAN; tests that use `vcan` or `can_pair` have it")


def pytest_cmdline_main(config: pytest.Config) -> int | None:
    """Run the tests in the lab if ``--skin-can-lab`` is given and this kernel has no CAN."""
    if not config.getoption("--skin-can-lab") or has_can():
        return None
    import sys

    from skinware_drivers.testing import lab

    arguments = [argument for argument in config.invocation_params.args if argument != "--skin-can-lab"]
    here = config.invocation_params.dir
    # the guest sees this machine's files read-only
    command = [sys.executable, "-m", "pytest", "-m", "can", "-p", "no:cacheprovider", *arguments]
    return lab.run("plain", command, 1800.0, here)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that need CAN."""
    for item in items:
        if _CAN_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker("can")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    """Keep for the fixtures whether the test itself failed."""
    if call.when == "call":
        item.stash[_failed] = call.excinfo is not None


def has_can() -> bool:
    """Return whether this kernel has CAN, and this process may make interfaces."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return os.geteuid() == 0


def ip(*arguments: str) -> None:
    """Run the command ``ip``."""
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@pytest.fixture
def namespace(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Namespace]:
    """Make a new namespace, also for child processes; fail if a process, thread, descriptor or file is left.

    A test that failed is not checked, because pytest's report of the failure keeps its objects.
    """
    from skinware.memory.namespace import Namespace

    monkeypatch.setenv("SKINWARE_NAMESPACE", f"test-{os.getpid()}-{secrets.token_hex(4)}")
    place = Namespace()
    before = Belongings()
    yield place
    try:
        left = before.left_since() + files_left(place.path)
        if left and not request.node.stash.get(_failed, False):
            pytest.fail(f"the test left behind: {', '.join(left)}", pytrace=False)
    finally:
        shutil.rmtree(place.path, ignore_errors=True)


@pytest.fixture
def emulated_skin(namespace: Namespace) -> Iterator[Callable[..., EmulatedSkin]]:  # noqa: ARG001 - for its effect
    """Return a function that starts a driver on emulated devices in this process: ``emulated_skin("xela")``.

    Its arguments are those of :func:`skinware_drivers.testing.driving.emulated_skin`. All are stopped at the end.
    """
    from skinware_drivers.testing import driving

    with ExitStack() as running:
        yield lambda driver, emulator=None, **more: running.enter_context(
            driving.emulated_skin(driver, emulator, **more)
        )


@pytest.fixture
def pty_patch() -> Iterator[Callable[..., str]]:
    """Return a function that emulates devices on a pseudo terminal: ``pty_patch("my_driver")`` is its path.

    Its arguments are an emulator's class or registered name, and the emulator's options. All are stopped at the end.
    """
    from skinware_drivers.testing.driving import emulated_on_a_pty

    with ExitStack() as running:
        yield lambda emulator, **options: running.enter_context(emulated_on_a_pty(emulator, **options))


@pytest.fixture
def tcp_patch() -> Iterator[Callable[..., str]]:
    """Return a function that emulates devices behind TCP: ``tcp_patch("my_driver")`` is their ``HOST:PORT``.

    Its arguments are those of ``pty_patch``. All are stopped at the end.
    """
    from skinware_drivers.testing.driving import emulated_over_tcp

    with ExitStack() as running:
        yield lambda emulator, **options: running.enter_context(emulated_over_tcp(emulator, **options))


@pytest.fixture
def vcan() -> Iterator[Callable[[], str]]:
    """Return a function that makes a virtual CAN interface, and its name; skip the test on a kernel without CAN."""
    if not has_can():
        pytest.skip(_NO_CAN)
    made: list[str] = []

    def make() -> str:
        name = f"vc{os.getpid() % 10000}x{next(_numbers)}"
        try:
            ip("link", "add", "dev", name, "type", "vcan")
        except (OSError, subprocess.CalledProcessError) as error:
            if os.environ.get("SKINWARE_CAN_LAB") == "1":
                raise  # the lab must have it
            pytest.skip(f"no vcan ({getattr(error, 'stderr', None) or error}): {_NO_CAN}")
        made.append(name)
        ip("link", "set", name, "up")
        return name

    yield make
    for name in made:
        subprocess.run(["ip", "link", "del", name], capture_output=True)


@pytest.fixture
def can_pair() -> Iterator[tuple[str, str]]:
    """Set up two CAN controllers on one wire at 1 Mbit/s, can0 and can1 of the lab; skip the test elsewhere."""
    if os.environ.get("SKINWARE_CAN_LAB") != "1":
        pytest.skip("two CAN controllers on one wire exist only in the CAN lab: `pytest --skin-can-lab`")
    pair = ("can0", "can1")
    for name in pair:
        ip("link", "set", name, "type", "can", "bitrate", "1000000")
        ip("link", "set", name, "up")
    yield pair
    for name in pair:
        ip("link", "set", name, "down")
