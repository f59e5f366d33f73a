"""Light robots: drivers that write frames made beforehand, with bridges that serve them, many in a process.

Nothing emulates a bus, so what is measured is the bridge.
"""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Self

import numpy as np
from links import descriptors, enter, memory_mb
from record import BUS_COUNTERS, LEVELS, NOISE, PATCH_COUNTERS, structure_of

from skinware import DriverWriter
from skinware.bridge.endpoints import Rules, endpoints
from skinware.bridge.joining import Joiner
from skinware.bridge.link import ZenohLink
from skinware.bridge.serving import Server
from skinware.bridge_state import ServiceState
from skinware.memory.namespace import Namespace
from skinware.memory.statistics import BUCKETS
from skinware.realtime import Periodic, now_ns

SERVICE = "large"
_FRAMES = 8
_LOOK_S = 0.05


class LightSkin:
    """A driver of sensors with analogue noise: eight frames, over and over, with the counters that drivers have.

    Args:
        namespace: where it publishes.
        sensors: how many.
        rate_hz: that it tells.
    """

    def __init__(self, namespace: Namespace | str, sensors: int, rate_hz: float) -> None:
        structure = structure_of(sensors)
        generator = np.random.default_rng(1)
        level = generator.normal(2100, LEVELS, sensors)
        self._frames = itertools.cycle(
            [np.round(level + generator.normal(0, NOISE, sensors)).astype(np.uint16) for _ in range(_FRAMES)]
        )
        patch_ns = generator.integers(0, 5_000_000, structure.n_patches)
        self._module_age_ns = patch_ns[structure.module_patch] + np.arange(structure.n_modules) % 16 * 1000
        self.writer = DriverWriter(
            SERVICE,
            structure,
            namespace=namespace,
            rate_hz=rate_hz,
            bus_counters=[f"counter {n}" for n in range(BUS_COUNTERS)],
            patch_counters=[f"counter {n}" for n in range(PATCH_COUNTERS)],
        )
        for column in self.writer.begin().values():
            column[:] = 0
        self.writer.commit(now_ns())

    def publish(self) -> None:
        """The next frame."""
        columns = self.writer.begin(from_last=True)
        columns["values"][:] = next(self._frames)
        time_ns = now_ns()
        np.subtract(time_ns, self._module_age_ns, out=columns["module_time_ns"])
        columns["bus_counters"][:] += 500
        columns["patch_counters"].reshape(-1, PATCH_COUNTERS)[:, :2] += 16
        for counts, bucket in (("patch_interval_counts", 24), ("patch_age_counts", 20)):
            columns[counts].reshape(-1, BUCKETS)[:, bucket] += np.uint64(16)
        self.writer.commit(time_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()


def drive(pipe: Connection, namespace: str, sensors: int, rate_hz: float) -> None:
    """Process of one light skin, until the other end says enough."""
    with LightSkin(namespace, sensors, rate_hz) as skin:
        pipe.send("ready")
        timer = Periodic(rate_hz)
        while not pipe.poll():
            timer.wait()
            skin.publish()


@dataclass(frozen=True)
class Robot:
    """A robot, as both ends know it.

    Attributes:
        name: of it.
        there: namespace of its driver.
        here: that in which it appears.
        listen: endpoint of its bridge.
        connect: endpoint by which that is reached.
    """

    name: str
    there: str
    here: str
    listen: str
    connect: str


@dataclass
class Account:
    """What a process did and took between "go" and "enough".

    Attributes:
        frames: published, by its drivers or by its joiners.
        lost: frames that did not come over the link.
        bytes: of the messages that came.
        ages_ns: of the frames that came, from their publication on the robot to the arrival here.
        cpu_s: processor time, without that of drivers.
        memory_mb: of the process.
        descriptors: that it has open.
    """

    frames: int = 0
    lost: int = 0
    bytes: int = 0
    ages_ns: list[int] = field(default_factory=list)
    cpu_s: float = 0.0
    memory_mb: float = 0.0
    descriptors: int = 0

    def add(self, other: Account) -> None:
        """What another process did and took."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


class WatchedJoiner(Joiner):
    """A joiner that keeps what came, which it forgets each second once it was told."""

    def __init__(self, robot: str, link: ZenohLink, namespace: Namespace, *, mode: str) -> None:
        super().__init__(robot, link, namespace, mode=mode)
        self._came = Account()

    def came(self) -> Account:
        """What came since the last call."""
        with self._mirror.lock:
            self._service_states()
            came, self._came = self._came, Account()
        return came

    def _service_states(self) -> dict[str, ServiceState]:
        for follower in self._followers.values():
            output = follower.output
            self._came.add(Account(output.frames, bytes=output.bytes, ages_ns=list(output.ages_ns)))
        return super()._service_states()


@contextmanager
def _running(thing: Server | Joiner) -> Iterator[None]:
    """A server or joiner in a thread of its own."""
    thread = threading.Thread(target=thing.run)
    thread.start()
    try:
        yield
    finally:
        thing.stop()
        thread.join()


def be_robots(pipe: Connection, place: str | None, robots: list[Robot], sensors: int, rate_hz: float) -> None:
    """Process of some robots, whose drivers publish one after the other, spread over the period."""
    enter(place)
    with ExitStack() as stack:
        skins = []
        for robot in robots:
            skins.append(stack.enter_context(LightSkin(robot.there, sensors, rate_hz)))
            link = stack.enter_context(
                closing(ZenohLink(endpoints(listen=[robot.listen], rules=Rules(), insecure=True)))
            )
            server = stack.enter_context(closing(Server(robot.name, link, Namespace(robot.there))))
            stack.enter_context(_running(server))
        pipe.send("ready")
        timer, begin_s, frames = Periodic(rate_hz * len(skins)), 0.0, 0
        for skin in itertools.cycle(skins):
            timer.wait()
            skin.publish()
            frames += 1
            if pipe.poll():
                if pipe.recv() == "enough":
                    break
                begin_s, frames = _bridges_cpu_s(), 0
        pipe.send(_weighed(Account(frames, cpu_s=_bridges_cpu_s() - begin_s)))
        pipe.recv()  # the desk is still looking


def be_desk(pipe: Connection, place: str | None, robots: list[Robot], mode: str) -> None:
    """Process of joiners, one for each robot; it is ready when a frame of each is here."""
    enter(place)
    with ExitStack() as stack:
        joiners: list[WatchedJoiner] = []
        for robot in robots:
            link = stack.enter_context(closing(ZenohLink(endpoints(connect=[robot.connect]))))
            joiner = stack.enter_context(closing(WatchedJoiner(robot.name, link, Namespace(robot.here), mode=mode)))
            stack.enter_context(_running(joiner))
            joiners.append(joiner)
        missing = set(joiners)
        while missing and not pipe.poll():
            time.sleep(_LOOK_S)
            missing -= {joiner for joiner in missing if joiner.came().frames}
        pipe.send("ready")
        if pipe.recv() != "go":
            return
        for joiner in joiners:
            joiner.came()
        begin_s = time.process_time()
        if pipe.recv() != "enough":
            return
        account = Account(cpu_s=time.process_time() - begin_s)
        for joiner in joiners:
            account.add(joiner.came())
        pipe.send(_weighed(account))


def _bridges_cpu_s() -> float:
    """Processor time of this process without that of this thread, which is the drivers'."""
    return time.process_time() - time.thread_time()


def _weighed(account: Account) -> Account:
    account.memory_mb, account.descriptors = memory_mb(os.getpid()), descriptors(os.getpid())
    return account
