"""Whatever is killed at whatever moment, the living do not notice, and the dead leave nothing that matters."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import RequestError
from skinware.memory.announcement import living_readers
from skinware_drivers.testing.waiting import wait_until
from tests.core.workers import PATIENCE_S, Board, Bomb, Crew, seeded

KILLS = int(os.environ.get("SKINWARE_TEST_KILLS") or 500)
LIVE_AGAIN_S = 10.0
"""The issue's ceiling for a reader to be live again; how long it takes is a figure of the benchmarks."""
COLUMNS = {"values": ("<u4", 2000)}
SERVICES = ["a", "b"]
ROUTINE = "routine"
"""Killed from outside, at any moment of the daily round."""
STATES = {
    "driver": ["creating", "filling", "publishing", "waiting", "answering", "restructuring", "closing", ROUTINE],
    "reader": ["attaching", "reading", "waiting", "leaving", ROUTINE],
    "requester": ["attaching", "asking", "waiting", ROUTINE],
}
GENERATION, SEQUENCE, MISSED, BEGUN, TORN, STOP, PID, WON = range(8)

pytestmark = pytest.mark.usefixtures("process_server", "ring")


# -- those who are killed ----------------------------------------------------------------------------------------


def victim_driver(
    name: str,
    board: Path,
    row: int,
    state: str,
    lines: int,
    fork_until: Path | None = None,
    fork: Callable[[], int] = os.fork,
) -> None:
    """Everything that a driver does, until it is killed in the given state."""
    mine = Board(board).rows[row]
    bomb = Bomb(state, lines)
    with bomb.armed("creating"):
        writer = ServiceWriter(name, COLUMNS, slots=3)
        writer.request_server()
    mine[GENERATION] = writer.generation
    if fork_until is not None and fork() == 0:
        outlive_the_parent(fork_until)
    for turn in range(1_000_000):
        with bomb.armed("filling", last_chance=turn > 20):
            columns = writer.begin()
            columns["values"][:1000] = writer.sequence + 1
            columns["values"][1000:] = writer.sequence + 1
        with bomb.armed("publishing", last_chance=turn > 20):
            writer.commit(time.monotonic_ns())
        mine[BEGUN] = turn
        with bomb.armed("waiting", last_chance=turn > 20):
            requests = writer.requests(0.002)
        with bomb.armed("answering", last_chance=turn > 20):
            for request in requests:
                request.reply(position=writer.position)
        if turn >= 5:
            with bomb.armed("closing"):
                writer.close() if state == "closing" else None
            with bomb.armed("restructuring"):
                writer.restructure(COLUMNS) if state == "restructuring" else None


def outlive_the_parent(until: Path) -> None:
    for number in os.listdir("/proc/self/fd"):  # all but the pipes by which the parent's death is known
        with contextlib.suppress(OSError):
            if os.readlink(f"/proc/self/fd/{number}").startswith("pipe:"):
                os.close(int(number))
    end = time.monotonic() + 2 * PATIENCE_S
    while not until.exists() and time.monotonic() < end:
        time.sleep(0.01)
    os._exit(0)


def victim_reader(name: str, state: str, lines: int) -> None:
    bomb = Bomb(state, lines)
    with bomb.armed("attaching"):
        reader = ServiceReader[Sample](name, timeout_s=PATIENCE_S)
    for _ in range(1_000_000):
        frame = None
        for _ in range(5):
            with bomb.armed("reading", last_chance=False):
                reader.read(timeout_s=PATIENCE_S)
            with bomb.armed("waiting", last_chance=False):
                frame = reader.read(newer_than=frame, timeout_s=PATIENCE_S)
        with bomb.armed("leaving"):
            reader.close() if state == "leaving" else None


def victim_requester(name: str, state: str, lines: int) -> None:
    bomb = Bomb(state, lines)
    with bomb.armed("attaching"):
        reader = ServiceReader[Sample](name, timeout_s=PATIENCE_S)
    for _ in range(1_000_000):
        try:
            with bomb.armed("asking", last_chance=False):
                pending = reader.ask("acquire")
            with bomb.armed("waiting", last_chance=False):
                pending.result(PATIENCE_S)
        except RequestError:  # its driver was killed
            time.sleep(0.002)


VICTIMS = {"reader": victim_reader, "requester": victim_requester}


# -- those who live ----------------------------------------------------------------------------------------------


def survivor(name: str, board: Path, row: int, way: str) -> None:
    """Reads on through all deaths of a driver, and tells what it sees."""
    rows = Board(board).rows
    mine = rows[row]
    with ServiceReader[Sample](name, timeout_s=PATIENCE_S) as reader:
        frames = {
            "asap": reader.samples(timeout_s=PATIENCE_S),
            "in order": reader.in_order(timeout_s=PATIENCE_S),
            "periodic": reader.samples(200, timeout_s=PATIENCE_S),
        }[way]
        while not rows[0, STOP]:
            frame = next(frames)
            values = frame.column("values")
            mine[TORN] += not (values == frame.sequence).all()
            mine[SEQUENCE], mine[GENERATION] = frame.sequence, 0 if frame.stale else frame.generation


def steady_writer(name: str, board: Path, row: int) -> None:
    rows = Board(board).rows
    with ServiceWriter(name, COLUMNS, rate_hz=200) as writer:
        rows[row, GENERATION] = writer.generation
        for columns in writer.periodic(200):
            columns["values"][:] = writer.sequence + 1
            rows[row, SEQUENCE], rows[row, MISSED] = writer.sequence, writer.missed_periods
            if rows[0, STOP] == 2:
                break


# -- the test ----------------------------------------------------------------------------------------------------


class Victim:
    """A process that will be killed, or kills itself, in a state."""

    def __init__(self, kind: str, state: str, process: BaseProcess, due_s: float) -> None:
        self.kind, self.state, self.process = kind, state, process
        self.due_s = time.monotonic() + due_s
        self.returned_s: float | None = None
        self.readers_live = False


class Chaos:
    """Drivers, readers and requesters come and are killed, while others live."""

    N_OTHERS = 3

    def __init__(self, crew: Crew, board: Board, dice: random.Random, folder: Path) -> None:
        self.crew, self.board, self.dice, self.folder = crew, board, dice, folder
        self.killed: Counter[str] = Counter()
        self.lives = 0
        self.steady = [crew.start(steady_writer, name, board.path, row) for row, name in ((1, "steady"), (2, "alone"))]
        self.drivers = {name: self.new_driver(name, ROUTINE) for name in SERVICES}
        self.survivors = [
            crew.start(survivor, name, board.path, row, way)
            for name in SERVICES
            for row, way in zip(self.reader_rows(name), ("asap", "in order", "periodic"), strict=True)
        ]
        self.others: list[Victim] = []
        wait_until(self.all_live, PATIENCE_S)
        wait_until(lambda: bool(board.rows[1:3, SEQUENCE].all()), PATIENCE_S)

    def driver_row(self, name: str) -> int:
        return 3 + 4 * SERVICES.index(name)

    def reader_rows(self, name: str) -> list[int]:
        return [self.driver_row(name) + n for n in (1, 2, 3)]

    def new_driver(self, name: str, state: str) -> Victim:
        row = self.driver_row(name)
        self.board.rows[row] = 0
        fork_until = self.folder / "stop" if state == ROUTINE and self.dice.random() < 0.2 else None
        lines = self.dice.randint(1, 500 if state in ("creating", "restructuring") else 60)
        process = self.crew.start(victim_driver, name, self.board.path, row, state, lines, fork_until)
        return Victim("driver", state, process, self.dice.uniform(0.02, 0.1))

    def new_other(self) -> Victim:
        kind = self.dice.choice(list(VICTIMS))
        state, name = self.dice.choice(STATES[kind]), self.dice.choice(["steady", *SERVICES])
        process = self.crew.start(VICTIMS[kind], name, state, self.dice.randint(1, 150))
        return Victim(kind, state, process, self.dice.uniform(0, 0.1))

    def is_over(self, victim: Victim) -> bool:
        """Kill it if its time has come; whether it is dead."""
        if victim.state == ROUTINE and time.monotonic() > victim.due_s:
            self.crew.kill(victim.process)
        elif victim.process.exitcode is not None:
            self.crew.finish(victim.process, -signal.SIGKILL)
        else:
            assert time.monotonic() < victim.due_s + PATIENCE_S, f"{victim.kind} {victim.state} lives on"
            return False
        self.killed[f"{victim.kind} {victim.state}"] += 1
        return True

    def look_at_readers(self, name: str) -> bool:
        """Whether every reader has a frame of the driver's present life; they must within their time."""
        driver = self.drivers[name]
        generation = int(self.board.rows[self.driver_row(name), GENERATION])
        if generation and not driver.readers_live:
            driver.returned_s = driver.returned_s or time.monotonic()
            seen = self.board.rows[self.reader_rows(name), GENERATION]
            driver.readers_live = bool((seen >= generation).all())
            late_s = time.monotonic() - driver.returned_s
            self.lives += driver.readers_live
            assert driver.readers_live or late_s < LIVE_AGAIN_S, f"readers of {name} see {seen}, not {generation}"
        return driver.readers_live

    def run(self, kills: int) -> None:
        while self.killed.total() < kills:
            for name, driver in self.drivers.items():
                if not self.look_at_readers(name) and driver.state == ROUTINE:
                    continue  # killed when its readers have seen it
                if self.is_over(driver):
                    self.drivers[name] = self.new_driver(name, self.dice.choice(STATES["driver"]))
            self.others = [other for other in self.others if not self.is_over(other)]
            if len(self.others) < self.N_OTHERS:
                self.others.append(self.new_other())
            time.sleep(0.001)

    def all_live(self) -> bool:
        return sum(self.look_at_readers(name) for name in SERVICES) == len(SERVICES)

    def end(self) -> None:
        """After a last return of both drivers, the survivors leave in good order, and all others are killed."""
        for victim in (*self.others, *self.drivers.values()):
            self.crew.kill(victim.process)
        self.drivers = {name: self.new_driver(name, ROUTINE) for name in SERVICES}
        wait_until(self.all_live, PATIENCE_S)
        (self.folder / "stop").touch()
        self.board.rows[0, STOP] = 1
        for process in self.survivors:
            self.crew.finish(process)
        for driver in self.drivers.values():
            self.crew.kill(driver.process)
        self.board.rows[0, STOP] = 2
        for process in self.steady:
            self.crew.finish(process)


@pytest.mark.alone
@pytest.mark.thorough
def test_killed_drivers_readers_and_requesters(
    tmp_path: Path, namespace: Namespace, request: pytest.FixtureRequest
) -> None:
    board = Board(tmp_path / "board", 12)
    with Crew() as crew:
        chaos = Chaos(crew, board, seeded(request), tmp_path)
        before = board.rows[1:3].copy()
        begin = time.monotonic()
        chaos.run(KILLS)
        read, alone = (board.rows[1:3] - before).tolist()
        took_s = time.monotonic() - begin
        chaos.end()
    print(f"{KILLS} kills in {took_s:.1f} s: {dict(sorted(chaos.killed.items()))}")
    print(f"{chaos.lives} times, all readers were live again after their driver's return")
    print(
        f"writer with victims: {read[SEQUENCE]} frames, {read[MISSED]} missed periods;"
        f" alone: {alone[SEQUENCE]}, {alone[MISSED]}"
    )
    assert chaos.lives > KILLS // 20
    assert board.rows[:, TORN].sum() == 0
    assert read[SEQUENCE] > 0.9 * alone[SEQUENCE]
    assert list(living_readers(namespace)) == []
    for name in SERVICES:
        ServiceWriter(name, COLUMNS).close()
    left = {str(path.relative_to(namespace.path)) for path in namespace.path.rglob("*")}
    assert left == {"readers", *(f"{name}.lock" for name in (*SERVICES, "steady", "alone"))}
    if KILLS >= 500:
        expected = {f"{kind} {state}" for kind, states in STATES.items() for state in states}
        assert set(chaos.killed) == expected
