"""No reader ever sees half a frame, whatever way it reads, and no reader costs the writer anything."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy.typing as npt
import pytest

from skinware import Sample, ServiceReader, ServiceWriter
from skinware.errors import Overrun
from skinware.memory.ring import COPY_ATTEMPTS, slot_headers_of
from skinware.service import Columns
from skinware_drivers.testing.waiting import wait_until
from tests.core.workers import PATIENCE_S, Board, Crew
from tests.specification.ring import use_specification

COLUMNS: Columns = {"values": ("<u8", 509), "small": ("<u2", (7, 11)), "one": ("u1", 1)}
"""Odd lengths, so that columns and slots end anywhere."""
WAYS = ["asap", "periodic", "in order", "read", "view", "request", "on request"]
READERS = 4
N_FRAMES = {"asap": 65_000, "in order": 65_000, "read": 36_000, "view": 36_000, "periodic": 4_000}
"""Frames that each reader compares. Those of the first two are all different, in all more than a million with 3 and 8
slots; who reads at its own time may compare one more than once, and requests take longer."""
N_ANSWERS = 400
COMPARED, OVERRUNS, TORN, READY, LAST, FIRST, TAKEN, LOST = range(8)

pytestmark = pytest.mark.usefixtures("process_server", "ring")


def fill(columns: dict[str, npt.NDArray[Any]], sequence: int) -> None:
    columns["values"][:] = sequence
    columns["small"][:] = sequence & 0xFFFF
    columns["one"][:] = sequence & 0xFF


def is_whole(frame: Sample) -> bool:
    """Whether every number in it is of the same frame."""
    sequence = frame.sequence
    number = sequence.to_bytes(8, "little")  # comparing bytes takes a tenth of the time that numpy takes
    return (
        frame.acquired_ns == sequence == frame.flags
        and frame.column("values").tobytes() == number * 509
        and frame.column("small").tobytes() == number[:2] * 77
        and frame.column("one").tobytes() == number[:1]
    )


def write_flat_out(board: Path, slots: int) -> None:
    """Publish without a pause; answer requests now and then."""
    rows = Board(board).rows
    with ServiceWriter("flood", COLUMNS, slots=slots) as writer:
        writer.request_server()
        while not rows[0, LAST]:
            for _ in range(50):
                sequence = writer.sequence + 1
                fill(writer.begin(), sequence)
                writer.commit(sequence, sequence)
            for request in writer.requests():
                sequence = writer.sequence + 1
                fill(writer.begin(), sequence)
                writer.commit(sequence, sequence)
                request.reply(position=writer.position)
        rows[0, COMPARED] = writer.sequence


def write_on_request(board: Path, slots: int) -> None:
    rows = Board(board).rows
    with ServiceWriter("flood", COLUMNS, slots=slots) as writer:
        writer.request_server()
        fill(writer.begin(), 1)
        writer.commit(1, 1)  # whoever has seen this may ask
        while not rows[0, LAST]:
            waiting = writer.requests(0.05)
            for request in waiting:
                sequence = writer.sequence + 1
                fill(writer.begin(), sequence)
                writer.commit(sequence, sequence)
                request.reply(position=writer.position)
        rows[0, COMPARED] = writer.sequence


def taker(reader: ServiceReader[Sample], way: str) -> Callable[[], Sample]:
    if way == "asap":
        return partial(next, reader.samples(timeout_s=PATIENCE_S))
    if way == "periodic":
        return partial(next, reader.samples(2000, timeout_s=PATIENCE_S))
    if way == "in order":
        return partial(next, reader.in_order(timeout_s=PATIENCE_S))
    if way == "read":
        return partial(reader.read, timeout_s=PATIENCE_S)
    return partial(reader.request, timeout_s=PATIENCE_S)


def compare(board: Path, row: int, way: str, wanted: int) -> None:
    """Take frames and look at every number in them."""
    mine = Board(board).rows[row]
    with ServiceReader[Sample]("flood", timeout_s=PATIENCE_S) as reader:
        reader.read(timeout_s=PATIENCE_S)
        take = taker(reader, way)
        before = 0
        while mine[COMPARED] < wanted:
            try:
                if way == "view":
                    with reader.view() as frame:
                        whole = is_whole(frame)
                else:
                    frame = take()
                    whole = is_whole(frame)
            except Overrun:
                mine[OVERRUNS] += 1
                mine[COMPARED] += way != "view"  # an answer in bounded time, though no frame
                take = taker(reader, way)
                continue
            in_turn = frame.sequence > before or (way in ("read", "view", "periodic") and frame.sequence == before)
            mine[TORN] += not (whole and in_turn)
            mine[COMPARED] += 1
            before = frame.sequence
        assert reader.statistics.overruns == mine[OVERRUNS]


@pytest.mark.thorough
@pytest.mark.parametrize("slots", [2, 3, 8])
@pytest.mark.parametrize("way", WAYS)
def test_no_torn_frame_from_a_writer_flat_out(way: str, slots: int, tmp_path: Path) -> None:
    board = Board(tmp_path / "board", READERS + 1)
    wanted = N_FRAMES.get(way, N_ANSWERS) // (10 if slots == 2 else 1)
    with Crew() as crew:
        writer = crew.start(write_on_request if way == "on request" else write_flat_out, board.path, slots)
        readers = [crew.start(compare, board.path, row, way, wanted) for row in range(1, READERS + 1)]
        for process in readers:
            crew.finish(process)
        board.rows[0, LAST] = 1
        crew.finish(writer)
    done = board.rows[1:]
    print(
        f"{way}, {slots} slots: {board.rows[0, COMPARED]} published, {done[:, COMPARED].sum()} taken,"
        f" {done[:, OVERRUNS].sum()} overruns"
    )
    assert done[:, TORN].sum() == 0
    assert (done[:, COMPARED] == wanted).all()
    if slots > 2 and way != "view":  # what is viewed while a writer is flat out is overwritten now and then
        assert done[:, OVERRUNS].sum() == 0


@pytest.mark.parametrize("way", ["copy", "view", "in order", "asap"])
def test_a_slot_that_is_never_whole_is_an_overrun(way: str) -> None:
    with ServiceWriter("x", COLUMNS, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        in_order, asap = reader.in_order(timeout_s=PATIENCE_S), reader.samples(timeout_s=PATIENCE_S)
        takes: dict[str, Callable[[], Sample]] = {
            "copy": reader.read,
            "view": reader.view().__enter__,
            "in order": partial(next, in_order),
            "asap": partial(next, asap),
        }
        for sequence in (1, 2):
            fill(writer.begin(), sequence)
            writer.commit(sequence, sequence)
            if sequence == 1 and way != "view":
                assert is_whole(takes[way]())
        words = slot_headers_of(writer._ring.segment)
        words[0][0] = 0  # as if the writer had come past each time
        words[1][0] = 0
        with pytest.raises(Overrun, match=f"{COPY_ATTEMPTS} times"):
            takes[way]()
        assert reader.statistics.overruns == 1
        words[0][0] = 2
        assert is_whole(reader.read())


@pytest.mark.parametrize("way", ["copy", "view", "in order"])
def test_a_writer_that_is_always_faster_is_an_overrun_after_a_bounded_number_of_attempts(
    way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_specification(monkeypatch)  # C counts its attempts where no test can look
    with ServiceWriter("x", COLUMNS, slots=2) as writer, ServiceReader[Sample]("x") as reader:
        attempts = 0

        def publish() -> None:
            sequence = writer.sequence + 1
            fill(writer.begin(), sequence)
            writer.commit(sequence, sequence)

        class Overtaken(Sample):
            __slots__ = ()

            def __init__(self, *arguments: Any, **named: Any) -> None:
                nonlocal attempts
                super().__init__(*arguments, **named)
                attempts += 1
                publish()
                publish()

        publish()
        in_order = reader.in_order(timeout_s=PATIENCE_S)
        next(in_order)
        publish()
        reader._ring.frame_class = Overtaken
        takes: dict[str, Callable[[], Sample]] = {
            "copy": reader.read,
            "view": reader.view().__enter__,
            "in order": partial(next, in_order),
        }
        with pytest.raises(Overrun, match=f"{COPY_ATTEMPTS} times"):
            takes[way]()
        assert COPY_ATTEMPTS <= attempts <= COPY_ATTEMPTS + 1
        assert reader.statistics.overruns == 1
        reader._ring.frame_class = Sample
        assert is_whole(reader.read())


# -- what readers cost -------------------------------------------------------------------------------------------


def write_at_100_hz(board: Path, row: int) -> None:
    rows = Board(board).rows
    with ServiceWriter(f"steady{row}", COLUMNS, rate_hz=100) as writer:
        rows[row, READY] = 1
        for columns in writer.periodic(100):
            fill(columns, writer.sequence + 1)
            if rows[0, READY]:
                break
        rows[row, TAKEN], rows[row, LOST] = writer.sequence, writer.missed_periods


def sleep_in_the_loop(board: Path, row: int, way: str) -> None:
    """A reader that comes back twice a second and must know what it missed."""
    rows = Board(board).rows
    with ServiceReader[Sample]("steady1", timeout_s=PATIENCE_S) as reader:
        frames = reader.in_order(timeout_s=PATIENCE_S) if way == "in order" else reader.samples(timeout_s=PATIENCE_S)
        for frame in frames:
            rows[row, FIRST] = rows[row, FIRST] or frame.sequence
            rows[row, LAST], rows[row, TAKEN], rows[row, LOST] = frame.sequence, reader.statistics.frames, reader.missed
            if rows[0, LAST]:
                return
            time.sleep(0.5)


@pytest.mark.alone
@pytest.mark.thorough
def test_readers_that_sleep_half_a_second_cost_a_100_hz_writer_nothing(tmp_path: Path) -> None:
    """Beside it runs the same writer with no reader: what the machine does to one, it does to the other."""
    board = Board(tmp_path / "board", 7)
    with Crew() as crew:
        writers = [crew.start(write_at_100_hz, board.path, row) for row in (1, 2)]
        wait_until(lambda: bool(board.rows[1:3, READY].all()), PATIENCE_S)
        sleepers = [
            crew.start(sleep_in_the_loop, board.path, row, "in order" if row % 2 else "asap") for row in range(3, 7)
        ]
        taken, lost = board.rows[3:, TAKEN], board.rows[3:, LOST]
        wait_until(lambda: bool((taken >= 8).all() and (lost > 10 * taken).all()), PATIENCE_S)
        for flag, processes in ((LAST, sleepers), (READY, writers)):
            board.rows[0, flag] = 1
            for process in processes:
                crew.finish(process)
    (read, missed), (alone, missed_alone) = board.rows[1:3, TAKEN : LOST + 1].tolist()
    print(f"with sleepers {read} frames, {missed} missed; without {alone} frames, {missed_alone} missed")
    assert read > 0.9 * alone
    assert missed < missed_alone + 0.1 * alone
    for first, taken, lost, last in board.rows[3:, [FIRST, TAKEN, LOST, LAST]].tolist():
        assert taken + lost == last - first + 1
