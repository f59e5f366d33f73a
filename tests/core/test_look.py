"""A look at a whole skin in one call of C, beside the same in Python: both see the same, whatever happens."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from skinware import DriverWriter, Skin, Snapshot
from skinware.errors import Closed, ServiceTimeout
from skinware.memory.ring_reader import Take
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import fake_structure
from tests.core.services import kill

STRUCTURES = [fake_structure(1, 1), fake_structure(1, 2), fake_structure(2, 2)]
NAMES = "abc"


@pytest.fixture
def skins() -> Iterator[dict[str, Skin]]:
    """A skin that leaves its looks to C, and one that does not."""
    made = {way: LookingIn(way) for way in ("C", "Python")}
    yield dict(made)
    for skin in made.values():
        skin.close()


class LookingIn(Skin):
    def __init__(self, way: str) -> None:
        super().__init__()
        self.way = way

    def _leave_to_c(self, snapshot: Snapshot) -> None:
        if self.way == "C":
            super()._leave_to_c(snapshot)


def publish(writer: DriverWriter, value: int) -> None:
    columns = writer.begin()
    columns["values"][:] = value % 251
    columns["status"][:] = value % 3
    writer.commit(value)


def clear_away(name: str) -> None:
    """What a killed driver left."""
    DriverWriter(name, STRUCTURES[0]).close()


def seen(snapshot: Snapshot) -> list[tuple[Any, ...]]:
    return [
        (name, *frame.position, frame.acquired_ns, frame.published_ns, frame.stale, frame.structure.n_sensors)
        for name, frame in zip(snapshot.layout.drivers, snapshot.samples, strict=True)
    ]


def is_whole(snapshot: Snapshot) -> bool:
    return all(
        (frame.values == frame.acquired_ns % 251).all()
        and (frame.status == frame.acquired_ns % 3).all()
        and len(frame.values) == frame.structure.n_sensors
        for frame in snapshot.samples
    )


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(6))
def test_both_ways_see_the_same_whatever_happens(seed: int, skins: dict[str, Skin]) -> None:
    """Drivers publish, fall silent, close, are killed, come back with the same structure or another."""
    chance = random.Random(seed)
    writers: dict[str, DriverWriter] = {}
    newest: dict[str, tuple[int, int]] = {}
    known: dict[str, Snapshot] = {}
    in_c = 0

    def both_have_it() -> bool:
        for path, skin in skins.items():
            known[path] = skin.read()
            assert is_whole(known[path])
        return all(
            {name: frame.position for name, frame in zip(one.layout.drivers, one.samples, strict=True)} == newest
            for one in known.values()
        )

    try:
        for value in range(1, 120):
            name = chance.choice(NAMES)
            writer = writers.get(name)
            what = chance.choices(("publish", "close", "kill", "restructure"), (12, 1, 1, 1))[0]
            if writer is None:
                writers[name] = writer = DriverWriter(name, chance.choice(STRUCTURES), slots=chance.choice((2, 3, 8)))
            elif what == "restructure":
                writer.restructure(chance.choice(STRUCTURES))
            elif what != "publish" and len(writers) > 1:
                kill(writer) if what == "kill" else writer.close()
                del writers[name], newest[name]
                wait_until(both_have_it)
                continue
            for _ in range(chance.choice((1, 1, 1, 2, 9))):
                publish(writer, value)
            newest[name] = writer.position
            wait_until(both_have_it)
            in_c += isinstance(skins["C"]._in_c, Take)
            assert seen(known["C"]) == seen(known["Python"])
            for path, skin in skins.items():
                with pytest.raises(ServiceTimeout):
                    skin.read(newer_than=known[path], timeout_s=0.0)
    finally:
        for writer in writers.values():
            writer.close()
        for name in NAMES:
            clear_away(name)
    assert in_c > 60
    assert skins["Python"]._in_c is None


def test_both_ways_count_the_same(skins: dict[str, Skin]) -> None:
    with DriverWriter("a", STRUCTURES[0], slots=4) as a, DriverWriter("b", STRUCTURES[1], slots=4) as b:
        publish(a, 1)
        publish(b, 1)
        known = {path: skin.read() for path, skin in skins.items()}
        for value, burst in enumerate((1, 2, 1, 7, 3, 1, 1, 9, 1, 300), 2):
            for _ in range(burst):
                publish(a if value % 3 else b, value)
            known = {path: skin.read(newer_than=known[path]) for path, skin in skins.items()}
            assert seen(known["C"]) == seen(known["Python"])
            for skin in skins.values():
                skin.read()
        for name in "ab":
            counts = {}
            for path, skin in skins.items():
                told = skin.reader(name).statistics
                counts[path] = told.frames, told.missed, told.overruns, told.age.total, told.wall.count, told.cpu.count
            assert counts["C"] == counts["Python"]
            assert counts["C"][0] == 21


def test_more_looks_than_are_noted_at_once_are_all_counted(skins: dict[str, Skin]) -> None:
    with DriverWriter("a", STRUCTURES[0]) as a:
        publish(a, 1)
        for _ in range(700):
            skins["C"].read()
        told = skins["C"].reader("a").statistics
        assert (told.frames, told.age.total, told.missed) == (700, 700, 0)


# -- memory that is used again -------------------------------------------------------------------------------------


def test_what_anybody_still_has_is_never_filled_again(skins: dict[str, Skin]) -> None:
    keep: list[tuple[int, Any]] = []
    ways: list[Callable[[Snapshot], Any]] = [
        lambda snapshot: snapshot,
        lambda snapshot: snapshot.samples,
        lambda snapshot: snapshot.samples[1],
        lambda snapshot: snapshot.samples[0].values,
        lambda snapshot: snapshot.of("b").values[3:9][::2].reshape(1, -1),
        lambda snapshot: memoryview(snapshot.of("a").values.data),
        lambda snapshot: None,
    ]
    with DriverWriter("a", STRUCTURES[0]) as a, DriverWriter("b", STRUCTURES[1]) as b:
        for value in range(1, 100):
            publish(a, value)
            publish(b, value)
            keep.append((value, ways[value % len(ways)](skins["C"].read())))
    for value, thing in keep:
        frames = thing.samples if isinstance(thing, Snapshot) else thing if isinstance(thing, tuple) else ()
        for frame in frames:
            assert frame.sequence == value
            assert (frame.values == value).all()
        if thing is not None and not frames:
            array = thing.values if hasattr(thing, "values") else np.asarray(thing)
            assert (array == value).all()


def test_snapshots_that_nobody_has_are_filled_again(skins: dict[str, Skin]) -> None:
    with DriverWriter("a", STRUCTURES[0]) as a:
        publish(a, 1)
        seen = set()
        for value in range(2, 12):
            publish(a, value)
            snapshot = skins["C"].read()
            assert is_whole(snapshot)
            seen.add(snapshot.samples[0].values.ctypes.data)
        assert len(seen) <= 4  # those of the first look, in Python, among them


# -- whoever reads one of its drivers besides ----------------------------------------------------------------------


def test_readers_of_single_drivers_do_not_confuse_the_skin(skins: dict[str, Skin]) -> None:
    with DriverWriter("a", STRUCTURES[0]) as a, DriverWriter("b", STRUCTURES[1]) as b:
        publish(a, 1)
        publish(b, 1)
        for value in range(2, 30):
            for skin in skins.values():
                skin.read()
            publish(a, value)
            if value % 4 == 0:
                loops = {path: skin.reader("a").samples(timeout_s=5) for path, skin in skins.items()}
                for loop in loops.values():
                    assert next(loop).acquired_ns == value
                publish(a, value)
                publish(b, value)
                for loop in loops.values():
                    next(loop)
            found = {path: seen(skin.read()) for path, skin in skins.items()}
            assert found["C"] == found["Python"]
        for name in "ab":
            told = [skin.reader(name).statistics for skin in skins.values()]
            assert told[0].frames == told[1].frames
            assert told[0].missed == told[1].missed


# -- whoever ends a wait -------------------------------------------------------------------------------------------


@contextmanager
def two_drivers() -> Iterator[tuple[Skin, DriverWriter]]:
    """A skin after a look that has all there is, and one of its two drivers."""
    with DriverWriter("a", STRUCTURES[0]) as a, DriverWriter("b", STRUCTURES[1]) as b, Skin() as skin:
        publish(a, 1)
        publish(b, 1)
        skin.read()
        assert skin._in_c is not None
        yield skin, a


def test_a_publication_ends_a_wait() -> None:
    with two_drivers() as (skin, writer):
        snapshot = skin.read()
        for value in range(2, 12):
            publisher = threading.Timer(0.02, publish, (writer, value))
            publisher.start()
            snapshot = skin.read(newer_than=snapshot, timeout_s=20)
            publisher.join()
            assert snapshot.of("a").sequence == value
            assert is_whole(snapshot)


def test_a_signal_ends_a_wait() -> None:
    class Rang(Exception):
        pass

    def ring(*_: object) -> None:
        raise Rang

    with two_drivers() as (skin, writer):
        snapshot = skin.read()
        before = signal.signal(signal.SIGALRM, ring)
        try:

            def wait() -> None:
                signal.setitimer(signal.ITIMER_REAL, 0.02)  # it may ring before the wait begins
                skin.read(newer_than=snapshot, timeout_s=20)

            with pytest.raises(Rang):
                wait()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
        publish(writer, 2)
        assert skin.read(newer_than=snapshot).of("a").sequence == 2


def test_another_thread_stops_a_wait() -> None:
    with two_drivers() as (skin, _):
        snapshot = skin.read()
        stopper = threading.Timer(0.02, skin.stop)
        stopper.start()
        with pytest.raises(Closed):
            skin.read(newer_than=snapshot, timeout_s=20)
        stopper.join()


def test_a_deadline_holds() -> None:
    with two_drivers() as (skin, _):
        snapshot = skin.read()
        for timeout_s in (0.0, 0.01, 0.12, 0.3):
            begun_ns = time.monotonic_ns()
            with pytest.raises(ServiceTimeout, match="published anything newer: a, b"):
                skin.read(newer_than=snapshot, timeout_s=timeout_s)
            assert time.monotonic_ns() - begun_ns >= timeout_s * 1e9


def test_a_killed_driver_ends_a_wait() -> None:
    with two_drivers() as (skin, writer):
        snapshot = skin.read()
        kill(writer)
        snapshot = skin.read(newer_than=snapshot, timeout_s=20)
        assert snapshot.layout.drivers == ("b",)
        clear_away("a")


def test_the_child_of_a_fork_has_no_skin() -> None:
    with two_drivers() as (skin, writer):
        snapshot = skin.read()
        publish(writer, 2)
        child = os.fork()
        if child == 0:
            try:
                for _ in range(2000):
                    skin.read()
                    time.sleep(0.01)
            except Closed:
                os._exit(7)
            finally:
                os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        assert skin.read(newer_than=snapshot).of("a").sequence == 2
