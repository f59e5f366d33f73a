"""Programs of every kind see the same of a replay as of life: each is run on both, and what it tells is compared."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware import BusReason, BusState, DriverReader, Namespace, Sample, ServiceReader, Skin, aio, threads
from skinware.errors import ServiceNotFound, ServiceTimeout, StructureChanged
from skinware.geometry import Geometry
from skinware.memory.announcement import living_readers
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure
from tests.commands import run
from tests.compiling import compiled
from tests.core.c_programs import SOURCE
from tests.core.c_programs import run as run_c
from tests.recording.rig import contents_of, has, pose_service, publish_pose, recording, replaying

FRAMES = 20
PLACED = fake_structure(2)
PLACES = Geometry.unknown(["pressure"] * 320, PLACED.sensor_uid[PLACED.index("pressure")])
PLACES.position_m[:], PLACES.frame[:] = np.arange(960).reshape(320, 3) / 1000, "chest"
PLACED = PLACED.placed(PLACES)
LIVES = (PLACED, PLACED, fake_structure(3, 4, dtype="<i4"))
"""Of the driver torso, which restarts, and then comes back with other sensors."""
TIMES = ("module_time_ns", "bus_since_ns", "times")
OF_THE_MOMENT = {
    *("generation", "published_before", "acquired_ns", "published_ns", "module_time_ns", "bus_since_ns"),
    *("age_ms", "state_age_s", "rate_hz", "statistics", "readers"),
}
"""What tells when something was published, what that cost, and who reads it; nothing else differs."""

Told = dict[str, list[Any]]


def ages(frame: Sample) -> Any:
    """Which times there are, and how far they are apart."""
    if "module_time_ns" not in frame._columns:
        return frame.flags
    since = [frame.acquired_ns - frame.column(name) for name in TIMES[:2]]
    there = [frame.column(name) != 0 for name in TIMES[:2]]
    return [np.where(known, age, -1).tolist() for known, age in zip(there, since, strict=True)], frame.flags


def told_by(frame: Sample) -> Any:
    """All that is in a frame, but the moment."""
    contents = {name: data for name, data in contents_of(frame).items() if name not in TIMES}
    return contents, ages(frame), frame.sequence, frame.stale, frame.period_ns


class Programs:
    """Programs that read all services in several ways until they are stopped, and what each was told."""

    def __init__(self) -> None:
        self.told: Told = {}
        self.errors: list[BaseException] = []
        self._stopping = False
        self._workers = [threading.Thread(target=self._guarded, args=(work,)) for work in self._all()]
        for worker in self._workers:
            worker.start()
        self._callback = threads.start_reader(
            DriverReader("torso", timeout_s=60), self._list("thread", told_by), in_order=True
        )

    def close(self) -> None:
        self._stopping = True
        for worker in self._workers:
            worker.join()
        self._callback.stop()
        assert self.errors == []

    def _all(self) -> list[Callable[[], None]]:
        return [
            lambda: self._in_order(DriverReader("torso", timeout_s=60), "torso"),
            lambda: self._in_order(DriverReader("arm", timeout_s=60), "arm"),
            lambda: self._in_order(ServiceReader[Sample]("pose", timeout_s=60), "pose"),
            self._skin,
            lambda: asyncio.run(self._aio()),
        ]

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001, told by close
            self.errors.append(error)

    def _list(self, name: str, what: Callable[[Any], Any]) -> Callable[[Any], None]:
        told = self.told.setdefault(name, [])
        return lambda frame: told.append(what(frame))

    def _in_order(self, reader: ServiceReader[Any], name: str) -> None:
        tell = self._list(name, told_by)
        with reader:
            while not self._stopping:
                try:
                    for frame in reader.in_order(timeout_s=0.2):
                        tell(frame)
                except ServiceTimeout:
                    continue
                except StructureChanged:
                    reader.reattach()
                    self.told[name].append("another structure")
            self.told[f"{name}, lost"] = [reader.missed]

    def _skin(self) -> None:
        tell = self._list("skin", lambda snapshot: [told_by(frame) for frame in snapshot.samples])
        with Skin() as skin:
            while not self._stopping:
                try:
                    tell(skin.read(newer_than=None, timeout_s=0.2))
                except ServiceTimeout:
                    continue
                time.sleep(0.002)

    async def _aio(self) -> None:
        tell = self._list("aio", told_by)
        with ServiceReader[Sample]("pose", timeout_s=60) as pose:
            async with aio.Reader(pose) as reader:
                frame = None
                while not self._stopping:
                    try:
                        frame = await reader.read(newer_than=frame, timeout_s=0.2)
                    except ServiceTimeout:
                        continue
                    tell(frame)


@contextmanager
def programs(namespace: Namespace) -> Iterator[Programs]:
    """Programs that have begun: all of them are known as readers."""
    begun = Programs()
    try:
        wait_until(lambda: len(list(living_readers(namespace))) >= 6)
        time.sleep(0.2)
        yield begun
    finally:
        begun.close()


def live(recorder: Any, begin: Callable[[], Any], look: Callable[[], None]) -> None:
    """Two drivers and a service: one restarts, comes back changed, and is paused in the end."""
    with FakeSkin("arm", fake_structure(1)) as arm, pose_service(rate_hz=50, slots=64) as pose:
        number = 0
        for life, structure in enumerate(LIVES):
            with FakeSkin("torso", structure) as torso:
                torso.bus_counters[:] = life
                torso.bus_since_ns[:] = time.monotonic_ns() - 5_000_000_000
                torso.bus_state[:], torso.bus_reason[:] = BusState.LIVE, BusReason.ERROR_PASSIVE
                for _ in range(FRAMES):
                    number += 1
                    torso.publish()
                    publish_pose(pose, number)
                    arm.publish()
                    if number == 1:
                        for name in ("arm", "pose", "torso"):
                            has(recorder, name)
                        begin()
                    if number % FRAMES == 7:
                        torso.break_some()
                    time.sleep(0.01)
                wait_until(lambda number=number: recorder.messages.get("/skin/torso/frame", 0) == number)  # type: ignore[misc]
                if structure is LIVES[-1]:
                    torso.writer.pause()
                    wait_until(lambda: recorder.messages.get("/skin/events", 0) >= 6)
                    look()


def looked_at(program: Path) -> dict[str, Any]:
    """What programs that look once tell of a paused driver, a driver and a service."""
    with DriverReader("arm") as arm:
        wait_until(lambda: arm.read().age_ns > 2_000_000_000)  # all are silent, and known to be
    told: dict[str, Any] = {f"c {name}": run_c(program, "describe", name) for name in ("torso", "arm", "pose")}
    told["skin-info"] = json.loads(run("skin-info", "--json").stdout)
    told["skin-top"] = json.loads(run("skin-top", "--json", "-T", "0.1").stdout.splitlines()[0])
    told["skin-dump"] = json.loads(
        run("skin-dump", "torso", "-n", "1", "--timeout", "1", "--json").stdout.splitlines()[0]
    )
    with DriverReader("torso") as reader:
        told["structure"] = (reader.structure, reader.driver_type, reader.schema)
        told["counters"] = reader.bus_counters(reader.read()), reader.patch_counters(reader.read())
    return told


def is_paused() -> bool:
    try:
        with DriverReader("torso", announce=False) as torso:
            return torso.paused and torso.read().sequence == FRAMES
    except ServiceNotFound:  # between two of its generations
        return False


def differences(one: Any, other: Any, where: str) -> Iterator[str]:
    """Where two answers of a program differ, but for the moment."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in (one.keys() | other.keys()) - OF_THE_MOMENT:
            yield from differences(one.get(name), other.get(name), f"{where}.{name}")
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        for number, pair in enumerate(zip(one, other, strict=True)):
            yield from differences(*pair, f"{where}[{number}]")
    elif one != other:
        yield f"{where}: {one!r} in life, {other!r} in the replay"


@pytest.mark.thorough
def test_programs_cannot_tell_a_replay_from_life(
    tmp_path: Path, namespace: Namespace, tmp_path_factory: pytest.TempPathFactory
) -> None:
    program = compiled(SOURCE, "c99", tmp_path_factory)
    file = tmp_path / "life.mcap"
    seen: dict[str, tuple[Told, Any]] = {}
    with recording(file) as recorder:
        running: list[Any] = []

        def begin() -> None:
            running.append(programs(namespace))
            running.append(running[0].__enter__())

        def look() -> None:
            once = looked_at(program)
            running[0].__exit__(None, None, None)
            seen["life"] = running[1].told, once

        live(recorder, begin, look)
    with replaying(file, paused=True) as replayer:
        wait_until(lambda: bool(replayer.frames))
        with ServiceReader[Sample](next(iter(replayer.frames)), announce=False) as control:
            while replayer.frames.keys() != {"arm", "pose", "torso"}:
                control.call("step")
            with programs(namespace) as running_now:
                control.call("resume")
                wait_until(is_paused)
                control.call("speed", factor=0.001)  # it has the time that looking takes
                once = looked_at(program)
        seen["replay"] = running_now.told, once
    (life, life_once), (replay, replay_once) = seen["life"], seen["replay"]
    for name in ("torso", "arm", "pose", "thread", "torso, lost", "arm, lost", "pose, lost"):
        assert replay[name] == life[name], name
    assert len([told for told in life["torso"] if told != "another structure"]) == 3 * FRAMES
    assert life["torso, lost"] == [0]
    for name in ("skin", "aio"):
        assert replay[name][-1] == life[name][-1]
    assert list(differences(life_once, replay_once, "")) == []
