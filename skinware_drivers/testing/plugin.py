"""The pytest plug-in: fixtures for tests of drivers and of programs that read skins. pytest finds it by itself.

Nothing of Skinware is imported before a fixture is used: test runs of others that have it installed stay as they are.
"""

from __future__ import annotations

import itertools
import os
import secrets
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from skinware.memory.namespace import Namespace
    from skinware_drivers.testing.driving import EmulatedSkin

_CAN_FIXTURES = {"vcan", "can_pair"}
_NO_CAN = (
    "this kernel has no CAN, or you may not make interfaces: run as root where the modules can and vcan are, or with"
    " `pytest --skin-can-lab`, which runs these tests in a virtual machine that has CAN"
)
_numbers = itertools.count()
_failed = pytest.StashKey[bool]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--skin-can-lab``."""
    parser.getgroup("skinware").addoption(
        "--skin-can-lab",
        action="store_true",
        help="run the tests marked `can`, and no others, in a virtual machine that has CAN"
        " (needs QEMU, virtme-ng and an installed kernel with CAN modules; says what is missing)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Make the mark known."""
    config.addinivalue_line("markers", "can: needs a kernel with CAN; tests that use `vcan` or `can_pair` have it")


def pytest_cmdline_main(config: pytest.Config) -> int | None:
    """Run in the lab instead of here, if that was asked for."""
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
    """Remember whether the test itself failed."""
    if call.when == "call":
        item.stash[_failed] = call.excinfo is not None


def has_can() -> bool:
    """Whether this kernel has CAN, and we may make interfaces."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return os.geteuid() == 0


def ip(*arguments: str) -> None:
    """The command ``ip``."""
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@pytest.fixture
def namespace(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Namespace]:
    """A fresh namespace, also for child processes; afterwards no process, thread, descriptor or file may be left.

    After a test that failed, nobody looks: the report of the failure keeps what the test had.
    """
    from skinware.memory.namespace import Namespace
    from skinware_drivers.testing.leaks import Belongings, files_left

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
    """Makes drivers that run on emulated devices in this process: ``emulated_skin("xela")``, and a reader for each.

    The arguments are those of :func:`skinware_drivers.testing.driving.emulated_skin`. All are stopped at the end.
    """
    from skinware_drivers.testing import driving

    with ExitStack() as running:
        yield lambda driver, emulator=None, **more: running.enter_context(
            driving.emulated_skin(driver, emulator, **more)
        )


@pytest.fixture
def pty_patch() -> Iterator[Callable[..., str]]:
    """Makes emulated devices on pseudo terminals: ``pty_patch("my_driver")`` is the path of a serial port.

    The arguments are an emulator's class or registered name, and its options. All are gone at the end.
    """
    from skinware_drivers.testing.carrying import emulated_on_a_pty

    with ExitStack() as running:
        yield lambda emulator, **options: running.enter_context(emulated_on_a_pty(emulator, **options))


@pytest.fixture
def tcp_patch() -> Iterator[Callable[..., str]]:
    """Makes emulated devices that are called over TCP: ``tcp_patch("my_driver")`` is their ``HOST:PORT``.

    The arguments are as those of ``pty_patch``. All are gone at the end.
    """
    from skinware_drivers.testing.carrying import emulated_over_tcp

    with ExitStack() as running:
        yield lambda emulator, **options: running.enter_context(emulated_over_tcp(emulator, **options))


@pytest.fixture
def vcan() -> Iterator[Callable[[], str]]:
    """Makes virtual CAN interfaces of unique names, up; they are deleted at the end. Skips where there is no CAN."""
    if not has_can():
        pytest.skip(_NO_CAN)
    made: list[str] = []

    def make() -> str:
        name = f"vc{os.getpid() % 10000}x{next(_numbers)}"
        try:
            ip("link", "add", "dev", name, "type", "vcan")
        except (OSError, subprocess.CalledProcessError) as error:
            if os.environ.get("SKINWARE_CAN_LAB") == "1":
                raise  # there is nothing better
            pytest.skip(f"no vcan ({getattr(error, 'stderr', None) or error}): {_NO_CAN}")
        made.append(name)
        ip("link", "set", name, "up")
        return name

    yield make
    for name in made:
        subprocess.run(["ip", "link", "del", name], capture_output=True)


@pytest.fixture
def can_pair() -> Iterator[tuple[str, str]]:
    """Two CAN controllers on one wire, at 1 Mbit/s and up: can0 and can1 of the lab. Skips elsewhere."""
    if os.environ.get("SKINWARE_CAN_LAB") != "1":
        pytest.skip("two CAN controllers on one wire are in the CAN lab: `pytest --skin-can-lab`")
    pair = ("can0", "can1")
    for name in pair:
        ip("link", "set", name, "type", "can", "bitrate", "1000000")
        ip("link", "set", name, "up")
    yield pair
    for name in pair:
        ip("link", "set", name, "down")
