"""What only the ends of a ring in C can get wrong: memory that is used again, the library, races of the protocol."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from skinware import Sample, ServiceReader, ServiceWriter, native
from skinware.errors import Closed, PlatformError, ServiceTimeout
from skinware.memory.ring import RingWords
from skinware.memory.ring_reader import ReaderPlace, ReaderState, RingReader, TakeState
from skinware.memory.ring_writer import RingWriter, WriterState
from skinware.service import _attachment, _ownership
from skinware_drivers.testing.waiting import wait_until
from tests.compiling import compiled
from tests.specification.ring import SpecifiedReader, SpecifiedWriter

COLUMNS = {"values": ("<u8", 509), "odd": ("u1", 7)}
STRESS = Path(__file__).with_name("ring_stress.c")
WAYS = ["asap", "in order", "read"]


def publish(writer: ServiceWriter, value: int) -> None:
    for column in writer.begin().values():
        column[:] = value
    writer.commit(value, value)


def taking(reader: ServiceReader[Sample], way: str) -> Callable[[], Sample]:
    """How a loop takes its next frame."""
    if way == "read":
        return lambda: reader.read(newer_than=reader._last, timeout_s=20)
    frames = reader.samples(timeout_s=20) if way == "asap" else reader.in_order(timeout_s=20)
    return lambda: next(frames)


def is_whole(frame: Sample, value: int) -> bool:
    return bool(
        (frame.sequence, frame.acquired_ns, frame.flags) == (value, value, value)
        and (frame.column("values") == value).all()
        and (frame.column("odd") == value).all()
    )


# -- memory that is used again -------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
def test_what_anybody_still_has_is_never_filled_again(way: str) -> None:
    keep: list[tuple[int, Any]] = []
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:
        take = taking(reader, way)
        for value in range(1, 61):
            publish(writer, value)
            frame = take()
            kept: list[Callable[[Sample], Any]] = [
                lambda frame: frame,
                lambda frame: frame.column("values"),
                lambda frame: frame.column("values")[5:9][::2],
                lambda frame: memoryview(frame.column("odd").data),
                lambda frame: None,
                lambda frame: frame.column("values").reshape(1, -1).T.view(np.uint8),
            ]
            keep.append((value, kept[value % len(kept)](frame)))
    del frame
    gc.collect()
    for value, thing in keep:
        if isinstance(thing, Sample):
            assert is_whole(thing, value)
        elif thing is not None:
            array: npt.NDArray[Any] = np.asarray(thing)
            expected = (
                np.full(509, value, "<u8").view(np.uint8) if array.dtype == np.uint8 and array.size > 7 else value
            )
            assert (np.sort(array.ravel()) == np.sort(np.ravel(expected))).all()


def test_frames_that_nobody_has_are_filled_again() -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:
        take = taking(reader, "asap")
        seen = set()
        for value in range(1, 41):
            publish(writer, value)
            frame = take()
            assert is_whole(frame, value)
            seen.add(frame.column("values").ctypes.data)
        assert len(seen) == 2


def test_a_frame_of_a_dead_writer_is_stale_and_the_same_memory_afterwards_is_not() -> None:
    writer = ServiceWriter("x", COLUMNS)
    with ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        reader.read()
        reader.read()
        writer.close()
        assert reader.read().stale
        assert reader.read().stale
        with ServiceWriter("x", COLUMNS) as writer:
            publish(writer, 1)
            take = taking(reader, "asap")
            assert not take().stale
            publish(writer, 2)
            assert not take().stale


# -- beside the specification ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("writer_class", [RingWriter, SpecifiedWriter])
def test_readers_see_what_the_specification_sees(
    way: str, writer_class: type[RingWriter], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One writer of either kind and a reader of each, through losses and a restart; all that they count agrees."""
    monkeypatch.setattr(_ownership, "RingWriter", writer_class)
    writer = ServiceWriter("x", COLUMNS, slots=4)
    classes = {"ring": RingReader, "specification": SpecifiedReader}
    readers = {}
    for path, reader_class in classes.items():
        monkeypatch.setattr(_attachment, "RingReader", reader_class)
        readers[path] = ServiceReader[Sample]("x")
    takes = {path: taking(reader, way) for path, reader in readers.items()}
    seen: dict[str, list[tuple[int, ...]]] = {path: [] for path in takes}
    value = 0
    for burst in (1, 1, 2, 1, 7, 1, 3, -1, 1, 1, 9, 1):
        if burst < 0:
            writer.close()
            writer = ServiceWriter("x", COLUMNS, slots=4)
            value = 0
            continue
        for _ in range(burst):
            value += 1
            publish(writer, value)
        for path, take in takes.items():
            monkeypatch.setattr(_attachment, "RingReader", classes[path])  # it attaches again after a restart
            while not seen[path] or seen[path][-1][:2] != writer.position:
                frame = take()
                assert is_whole(frame, frame.sequence)
                times = frame.acquired_ns, frame.published_ns, frame.flags
                seen[path].append((frame.generation, frame.sequence, *times, frame.stale))
    assert seen["ring"] == seen["specification"]
    told = {path: reader.statistics for path, reader in readers.items()}
    counts = {path: (one.frames, one.missed, one.overruns, one.age.total, one.wall.count) for path, one in told.items()}
    assert counts["ring"] == counts["specification"]
    for reader in readers.values():
        reader.close()
    writer.close()


@pytest.mark.usefixtures("ring")
def test_a_writer_counts_its_publications() -> None:
    with ServiceWriter("x", COLUMNS, slots=3) as writer, ServiceReader[Sample]("x") as reader:
        now_ns = time.monotonic_ns()
        for acquired_ns in (-1, -(1 << 63), 0, now_ns, now_ns + (1 << 40), now_ns - 3_000_000):
            writer.begin()
            writer.commit(acquired_ns, (1 << 64) - 1)
        told = reader.writer_statistics
        assert (told.published, told.before_boot, told.ahead) == (6, 2, 1)
        assert told.wall.count == told.cpu.count == told.age.total == 6
        assert told.age.counts[0] >= 1  # what is newer than its publication
        assert sum(told.age.counts[22:]) >= 1  # 3 ms, and what the machine stood still
        assert 0 < told.wall.best_ns <= told.wall.mean_ns <= told.wall.worst_ns
        assert 0 <= told.cpu.best_ns <= told.cpu.worst_ns <= told.cpu.total_ns
        words = reader._ring._slot_words[6 % 3]
        assert words[3] == (1 << 64) - 1


# -- whoever ends a wait -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
def test_a_signal_ends_a_wait(way: str) -> None:
    class Rang(Exception):
        pass

    def ring(*_: object) -> None:
        raise Rang

    before = signal.signal(signal.SIGALRM, ring)
    try:
        with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:
            take = taking(reader, way)
            publish(writer, 1)
            take()

            def wait() -> None:
                signal.setitimer(signal.ITIMER_REAL, 0.02)  # it may ring before the wait begins
                take()

            with pytest.raises(Rang):
                wait()
            publish(writer, 2)
            frame = taking(reader, way)()  # a generator that raised is over
            assert is_whole(frame, 2)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("way", WAYS)
def test_another_thread_stops_a_wait(way: str) -> None:
    with ServiceWriter("x", COLUMNS) as writer:
        reader = ServiceReader[Sample]("x")
        take = taking(reader, way)
        publish(writer, 1)
        take()
        stopper = threading.Timer(0.02, reader.stop)
        stopper.start()
        with pytest.raises(Closed):
            take()
        stopper.join()
        reader.close()


@pytest.mark.parametrize("way", ["asap", "in order"])
def test_the_child_of_a_fork_has_no_reader(way: str) -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:
        take = taking(reader, way)
        for value in (1, 2):
            publish(writer, value)
            take()
        publish(writer, 3)
        child = os.fork()
        if child == 0:
            try:
                take()
            except Closed:
                os._exit(7)
            finally:
                os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        assert is_whole(take(), 3)


@pytest.mark.parametrize("way", ["asap", "in order"])
def test_a_deadline_holds_and_the_loop_goes_on_in_a_new_one(way: str) -> None:
    with ServiceWriter("x", COLUMNS) as writer, ServiceReader[Sample]("x") as reader:

        def frames() -> Iterator[Sample]:
            return reader.samples(timeout_s=0.01) if way == "asap" else reader.in_order(timeout_s=0.01)

        publish(writer, 1)
        loop = frames()
        next(loop)
        begun_ns = time.monotonic_ns()
        with pytest.raises(ServiceTimeout, match="is silent"):
            next(loop)
        assert time.monotonic_ns() - begun_ns >= 10_000_000
        publish(writer, 2)
        assert is_whole(next(frames()), 2)
        assert reader.statistics.frames == 2
        assert reader.missed == 0


def test_a_killed_writer_is_noticed_by_a_loop() -> None:
    writer = ServiceWriter("x", COLUMNS)
    with ServiceReader[Sample]("x") as reader:
        take = taking(reader, "asap")
        publish(writer, 1)
        take()
        publish(writer, 2)
        writer._ring.segment.descriptor.close()  # as if it were killed
        frame = take()
        assert is_whole(frame, 2)
        assert frame.stale
        writer._name_lock.close()
        with ServiceWriter("x", COLUMNS) as second:
            publish(second, 1)
            frame = take()
            assert (frame.generation, frame.sequence, frame.stale) == (second.generation, 1, False)


# -- the library ---------------------------------------------------------------------------------------------------


def test_a_library_compiled_with_other_headers_is_refused(tmp_path: Path) -> None:
    (tmp_path / "ring.h").write_text("struct ring { int64_t other; };")
    with pytest.raises(PlatformError, match="was compiled with other headers: install this package again"):
        native.load(native._CORE, (*native.FOLDERS, tmp_path))


def test_what_is_no_library_or_missing_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "libbroken.so"
    broken.write_bytes(b"no library")
    with pytest.raises(PlatformError, match=r"libbroken.so cannot be loaded .*: install this package again"):
        native.load(broken, native.FOLDERS)
    with pytest.raises(PlatformError, match="is missing: install this package again"):
        native.load(tmp_path / "libnothing.so", native.FOLDERS)


# -- the protocol under the checkers -------------------------------------------------------------------------------


@pytest.mark.thorough
@pytest.mark.parametrize("slots", [2, 3, 8])
@pytest.mark.parametrize("checked", ["c11", "c11 sanitized", "c11 races"])
def test_no_frame_is_torn_whatever_is_checked(
    checked: str, slots: int, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    program = compiled(STRESS, checked, tmp_path_factory)
    result = subprocess.run(
        [program, tmp_path / "ring", str(slots), "10000"], capture_output=True, text=True, timeout=110
    )
    assert result.returncode == 0, result.stderr
    assert not result.stderr
    told = json.loads(result.stdout)
    assert told["torn"] == 0
    assert told["timed"] == told["ages"] == 10000
    assert all(told[way] > 0 for way in ("turns", "in_order", "copies", "looks")), told
    structures = ReaderState, WriterState, TakeState
    assert told["sizes"] == [ctypes.sizeof(one) for one in structures]


def test_structures_have_the_fields_that_c_has() -> None:
    of_ring = [name for name, *_ in RingWords._fields_]
    for structure, file, name in (
        (RingWords, "../include/skinware.h", "skinware__ring"),
        (ReaderState, "take.c", "skinware_native_reader"),
        (ReaderPlace, "take.c", "place"),
        (TakeState, "take.c", "skinware_native_take"),
        (WriterState, "ring.h", "skinware_ring_writer"),
    ):
        text = (Path(native.__file__).parent / file).read_text()
        found = re.search(rf"typedef struct {name} {{(.*?)}} {name};", text, re.DOTALL)
        assert found is not None
        declared = re.sub(r"/\*.*?\*/", "", found[1], flags=re.DOTALL)
        in_c = re.findall(r"(\w+)(?:\[\w+\])?;", declared)
        expected = of_ring + in_c[1:] if in_c[0] == "ring" else in_c
        inherited = [] if structure.__base__ is ctypes.Structure else of_ring
        assert [*inherited, *(name for name, *_ in structure._fields_)] == expected


def test_a_reader_beside_a_thread_that_computes_gets_every_frame() -> None:
    """It lets go of the interpreter lock only to sleep, so that it catches up once it has it."""
    over = threading.Event()

    def compute() -> None:
        while not over.is_set():
            sum(range(1000))

    thread = threading.Thread(target=compute)
    with ServiceWriter("x", COLUMNS, slots=64) as writer, ServiceReader[Sample]("x") as reader:
        publish(writer, 1)
        take = taking(reader, "in order")
        take()
        thread.start()
        try:
            for value in range(2, 50):
                publish(writer, value)
            for value in range(2, 50):
                assert take().sequence == value
        finally:
            over.set()
            thread.join()
        assert reader.missed == 0
        wait_until(lambda: not thread.is_alive())
