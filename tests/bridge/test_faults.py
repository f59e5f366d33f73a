"""Ends that are killed, held up and cut off, one after the other at random: what readers see, and what they count."""

from __future__ import annotations

import errno
import os
import random
import resource
import shutil
import socket
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from skinware import DriverReader, DriverWriter
from skinware.bridge.messages import VERSION, About, generation_message
from skinware.errors import ServiceNotFound, ServiceTimeout, StructureChanged
from skinware.memory.namespace import Namespace
from skinware_drivers.testing.waiting import wait_until
from tests.bridge.net import Net, NetLink
from tests.bridge.rig import ROBOT, Ends, joined, joining, publish, serving, structure
from tests.commands import refused, run

SIZES = (64, 128)
SEEDS = (1, 2)
FAULTS = 8


class Driver:
    """A driver whose frames have their number, over all its lives, as their value; and each structure another size."""

    def __init__(self, namespace: Namespace, generator: random.Random) -> None:
        self._namespace, self._generator = namespace, generator
        self.number = 0
        self.sizes: dict[int, int] = {}
        self._writer: DriverWriter | None = None
        self.start()

    def start(self) -> None:
        """Begin to live."""
        size = self._generator.choice(SIZES)
        self._writer = DriverWriter("arm", structure(size), namespace=self._namespace, rate_hz=50)
        self._size = size

    def publish(self) -> None:
        """The next frame, if it lives."""
        if self._writer is not None:
            self.number += 1
            self.sizes[self.number] = self._size
            publish(self._writer, self.number)

    def end(self, *, is_killed: bool) -> None:
        """Be dead."""
        assert self._writer is not None
        writer, self._writer = self._writer, None
        if is_killed:
            writer.desert()
        else:
            writer.close()


class Witness:
    """Reads what comes, and asserts that it is of one structure, and that what is missing is counted.

    Attributes:
        taken: numbers of the frames that were read.
        is_fresh: whether the newest one was fresh at the last look.
    """

    def __init__(self, here: Namespace, driver: Driver) -> None:
        self._driver = driver
        self._reader = DriverReader("arm", namespace=here, timeout_s=30)
        self.taken: list[int] = []
        self.is_fresh = False

    def look(self) -> None:
        """Take the newest frame."""
        self.is_fresh = False
        try:
            if self._reader.refresh() is not None and self._reader.structure_changed:
                self._reader.reattach()
            frame = self._reader.read(timeout_s=0)
        except (ServiceTimeout, ServiceNotFound, StructureChanged):
            return
        number = int(frame.values[0])
        assert (frame.values == number).all()
        assert frame.structure.n_sensors == len(frame.values) == self._driver.sizes[number]
        if number not in self.taken[-1:]:
            self.taken.append(number)
        assert self.taken == sorted(self.taken)
        assert self._reader.missed + len(self.taken) == number - self.taken[0] + 1
        self.is_fresh = bool(frame.fresh("pressure").all())

    def close(self) -> None:
        self._reader.close()


class Bridge:
    """A driver, both ends of a bridge, and what lies between."""

    def __init__(self, there: Namespace, mode: str, generator: random.Random) -> None:
        self.net, self._there, self._mode, self._generator = Net(), there, mode, generator
        self.driver = Driver(there, generator)
        self._serve, self._join = ExitStack(), ExitStack()
        self.start_serve()
        self.start_join()

    def start_serve(self) -> None:
        self._serve.enter_context(serving(self.net, self._there))

    def start_join(self) -> None:
        self._join.enter_context(joining(self.net, self._there, self._mode, is_killed=True))

    def break_(self) -> Callable[[], None]:
        """Something goes wrong; what makes it good again."""
        kind = self._generator.choice(["cut", "held", "serve", "join", "driver killed", "driver ended", "both"])
        if kind == "cut":
            self.net.is_cut = True

            def heal() -> None:
                self.net.is_cut = False

            return heal
        if kind == "held":
            self.net.flows.clear()
            return self.net.flows.set
        if kind in ("serve", "both"):
            self._serve.close()
        if kind in ("join", "both"):
            self._join.close()
        if kind.startswith("driver"):
            self.driver.end(is_killed=kind == "driver killed")
            return self.driver.start
        return lambda: self._start_again(kind)

    def _start_again(self, kind: str) -> None:
        if kind != "serve":
            self.start_join()
        if kind != "join":
            self.start_serve()

    def close(self) -> None:
        self.net.flows.set()
        self.net.is_cut = False
        self._join.close()
        self._serve.close()
        self.driver.end(is_killed=False)
        self.net.close()


@contextmanager
def bridged(there: Namespace, mode: str, generator: random.Random) -> Iterator[tuple[Bridge, Witness]]:
    here = Namespace(f"{there.name}-here")
    bridge = Bridge(there, mode, generator)
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, here.path, ignore_errors=True)  # joiners that were killed leave their files
        stack.callback(bridge.close)

        def has_appeared() -> bool:
            bridge.driver.publish()
            return "arm" in here.services()

        wait_until(has_appeared)
        witness = Witness(here, bridge.driver)
        stack.callback(witness.close)
        yield bridge, witness


@pytest.mark.thorough
@pytest.mark.parametrize("mode", ["push", "pull"])
@pytest.mark.parametrize("seed", SEEDS)
def test_whatever_breaks_readers_know_and_it_comes_back(namespace: Namespace, mode: str, seed: int) -> None:
    generator = random.Random(seed)
    with bridged(namespace, mode, generator) as (bridge, witness):

        def until(condition: Callable[[], bool]) -> None:
            """Frames are published and read meanwhile."""

            def goes_on() -> bool:
                bridge.driver.publish()
                witness.look()
                return condition()

            wait_until(goes_on)

        for _ in range(FAULTS):
            heal = bridge.break_()
            until(lambda: not witness.is_fresh)
            heal()
            begin = bridge.driver.number
            until(lambda begin=begin: bool(witness.taken) and witness.taken[-1] > begin and witness.is_fresh)  # type: ignore[misc]


# -- what is told ---------------------------------------------------------------------------------------------------


def until_told(ends: Ends, words: str, writer: DriverWriter | None = None) -> None:
    """Until the joiner has told of some trouble, once."""

    def is_told() -> bool:
        if writer is not None:
            publish(writer)
        return any(words in event.get("why", "") for event in ends.events)

    wait_until(is_told)
    assert sum(words in event.get("why", "") for event in ends.events) == 1


def test_a_full_shared_memory_is_told_once_and_all_comes_when_there_is_room(
    namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    fallocate, is_full = os.posix_fallocate, True

    def on_full_disk(fd: int, offset: int, size: int) -> None:
        if is_full and "-here" in os.readlink(f"/proc/self/fd/{fd}"):
            raise OSError(errno.ENOSPC, "No space left on device")
        fallocate(fd, offset, size)

    monkeypatch.setattr("os.posix_fallocate", on_full_disk)
    with (
        joined(namespace, "push") as ends,
        serving(ends.net, namespace),
        DriverWriter("arm", structure(), namespace=namespace, rate_hz=50) as writer,
    ):
        until_told(ends, "service 'arm' cannot appear here: cannot make", writer)
        assert any("No space left on device" in event.get("why", "") for event in ends.events)
        is_full = False

        def has_come() -> bool:
            publish(writer)
            return {"arm", f"{ROBOT}-bridge"} <= set(ends.here.services())

        wait_until(has_come)


@pytest.mark.parametrize(("ours", "theirs"), [(VERSION, VERSION + 1), (VERSION + 1, VERSION)])
def test_another_version_is_told_whichever_is_older(
    namespace: Namespace, monkeypatch: pytest.MonkeyPatch, ours: int, theirs: int
) -> None:
    monkeypatch.setattr("skinware.bridge.peer.VERSION", ours)
    monkeypatch.setattr("skinware.bridge.messages.VERSION", ours)
    with joined(namespace) as ends:
        other = NetLink(ends.net)
        other.declare_token(f"skinware/live/{ROBOT}/{theirs}/abcd")
        until_told(ends, f"robot {ROBOT} is served by version {theirs} of the bridge; this one is {ours}: install")
        other.close()


def test_a_robot_whose_files_are_of_another_version_is_told(
    namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def of_another(about: About, packed: bytes) -> bytes:
        raw = zlib.decompress(packed)
        return generation_message(about, zlib.compress(raw[:8] + bytes([9]) + raw[9:]))

    monkeypatch.setattr("skinware.bridge.serving.generation_message", of_another)
    with (
        joined(namespace, "push") as ends,
        serving(ends.net, namespace),
        DriverWriter("arm", structure(), namespace=namespace, rate_hz=50) as writer,
    ):
        until_told(ends, "service 'arm' cannot be read: service 'arm': layout version 9.0, this program reads", writer)


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (("serve", "--robot", "a/b"), 2, "robot 'a/b': give 1 to 47 letters"),
        (("serve", "--robot", "r", "--listen", "tcp/0.0.0.0:1"), 2, "give --tls DIR, or --insecure"),
        (("serve", "--robot", "r", "--tls", "/nowhere"), 2, "/nowhere/ca.pem: No such file"),
        (("join", "r", "--connect", "here"), 2, "'here' is no endpoint"),
        (("join", "r", "--connect", "tcp/127.0.0.1:1", "--into", "a b"), 2, "namespace name 'a b'"),
    ],
)
def test_commands_that_cannot_be_carried_out_say_why_in_a_line(
    arguments: tuple[str, ...], status: int, line: str
) -> None:
    done = refused("skin-bridge", *arguments)
    assert (done.returncode, done.stdout) == (status, "")
    assert done.stderr.startswith("skin-bridge: ")
    assert line in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.thorough
def test_too_few_files_are_an_error_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (10, 10))
    ended = refused("skin-bridge", "serve", "--robot", ROBOT, "--listen", "tcp/127.0.0.1:7448")
    assert ended.returncode == 1
    assert "may open 10: raise `ulimit -n`" in ended.stderr


def test_a_port_that_is_in_use_is_told_in_a_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = run("skin-bridge", "serve", "--robot", "r", "--listen", f"tcp/127.0.0.1:{port}")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"skin-bridge: listening at tcp/127.0.0.1:{port}: Address already in use\n"
