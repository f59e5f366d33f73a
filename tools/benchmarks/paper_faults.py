"""Kills: how soon a driver's death is noticed, how soon its readers live again, and what dead readers cost a writer."""

from __future__ import annotations

import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np
from paper_run import part_of_skin, publish
from processes import READY, Processes, RunFailed, answer

from skinware import DriverReader, DriverWriter, Namespace, Skin, Structure
from skinware.errors import ServiceTimeout
from skinware.realtime import Periodic, now_ns

_RATE_HZ = 40.0
_READERS = 15
_DEAD_S = 0.3


@dataclass(frozen=True)
class FaultFigures:
    """Milliseconds, one per observation; ``publish_us`` by phase: medians of a writer's wall time per publication.

    Attributes:
        skin_notices_ms: from SIGKILL of a driver to a user's skin without it (another driver lives, at 1 Hz).
        reader_notices_ms: from SIGKILL to a reader of that driver being told that its writer is dead.
        returns_ms: from the new driver's first publication to an old reader holding that frame.
        restart_ms: from the order to start the new driver (a fork) to the last old reader holding a frame of it.
        publish_us: a writer's publication before and while its readers are killed.
        missed_periods: of that writer.
        survivor_lost: frames that a surviving reader lost meanwhile.
    """

    skin_notices_ms: list[float]
    reader_notices_ms: list[float]
    returns_ms: list[float]
    restart_ms: list[float]
    publish_us: Mapping[str, float]
    missed_periods: int
    survivor_lost: int

    def lines(self) -> list[str]:
        """In words, as Markdown table rows."""

        def spread(values: list[float]) -> str:
            return f"{np.median(values):.1f} / {max(values):.1f} ms ({len(values)} observations)"

        before, during = self.publish_us["before"], self.publish_us["during"]
        rows = (
            ("driver killed: a user's skin is without it after", spread(self.skin_notices_ms)),
            ("driver killed: a waiting reader (timeout 50 ms) is told after", spread(self.reader_notices_ms)),
            ("driver back: from its first publication to an old reader's frame", spread(self.returns_ms)),
            (f"driver back: from the order to start it to the last of {_READERS} readers", spread(self.restart_ms)),
            (
                f"{_READERS} readers killed: the writer's publication before, meanwhile",
                f"{before:.0f}, {during:.0f} µs",
            ),
            ("... periods that the writer missed", f"{self.missed_periods}"),
            ("... frames that a surviving reader lost", f"{self.survivor_lost}"),
        )
        return ["| event | median / worst |", "|---|---|", *(f"| {what} | {figure} |" for what, figure in rows)]


def measure_faults(namespace: Namespace, rounds: int) -> FaultFigures:
    """Kill drivers and readers.

    Raises:
        RunFailed: a process died that was not killed, failed or hung.
    """
    skin_ms: list[float] = []
    reader_ms: list[float] = []
    returns_ms: list[float] = []
    restart_ms: list[float] = []
    for _ in range(rounds):
        _kill_a_driver(namespace, skin_ms, reader_ms, returns_ms, restart_ms)
    publish_us, missed, lost = _kill_readers(namespace)
    return FaultFigures(skin_ms, reader_ms, returns_ms, restart_ms, publish_us, missed, lost)


def _kill_a_driver(
    namespace: Namespace,
    skin_ms: list[float],
    reader_ms: list[float],
    returns_ms: list[float],
    restart_ms: list[float],
) -> None:
    name, survivor = (f"fault-{secrets.token_hex(4)}-{what}" for what in ("a", "b"))
    with Processes() as processes:
        steady = processes.start(_drive, namespace, survivor, 1.0)
        answer(steady, 30)
        readers = [processes.start(_watch_driver, namespace, name) for _ in range(_READERS)]
        skin = processes.start(_watch_skin, namespace, 2)
        driver = processes.start(_drive, namespace, name, _RATE_HZ)
        answer(driver, 30)
        for pipe in (*readers, skin):
            answer(pipe, 30)
        time.sleep(0.2 + 0.05 * secrets.randbelow(1000) / 1000)
        killed_ns = now_ns()
        processes.kill_last()
        time.sleep(_DEAD_S)
        ordered_ns = now_ns()
        driver = processes.start(_drive, namespace, name, _RATE_HZ)
        answer(driver, 30)
        arrivals = []
        for pipe in readers:
            told_ns, arrived_ns, published_ns = answer(pipe, 30)
            reader_ms.append((told_ns - killed_ns) / 1e6)
            returns_ms.append((arrived_ns - published_ns) / 1e6)
            arrivals.append(arrived_ns)
        restart_ms.append((max(arrivals) - ordered_ns) / 1e6)
        skin_ms.append((answer(skin, 30) - killed_ns) / 1e6)
        for pipe in (driver, steady):
            pipe.send(READY)
            answer(pipe, 30)


def _small() -> Structure:
    return part_of_skin(0, 8)


def _drive(pipe: Connection, namespace: Namespace, name: str, rate_hz: float) -> None:
    """Publish until told to stop; then tell (begin, duration) of each publication in ns, and the missed periods."""
    times_ns: list[tuple[int, int]] = []
    with DriverWriter(name, _small(), namespace=namespace, rate_hz=rate_hz) as writer:
        publish(writer, 1)
        pipe.send(READY)
        timer = Periodic(rate_hz)
        while timer.wait(pipe.poll):
            begin_ns = now_ns()
            publish(writer, writer.sequence + 1)
            times_ns.append((begin_ns, now_ns() - begin_ns))
        pipe.recv()
        pipe.send((times_ns, timer.missed))


def _watch_driver(pipe: Connection, namespace: Namespace, name: str) -> None:
    with DriverReader(name, namespace=namespace, timeout_s=30) as reader:
        frame = reader.read()
        first = frame.generation
        pipe.send(READY)
        told_ns = 0
        while frame.generation == first:
            try:
                frame = reader.read(newer_than=frame, timeout_s=0.05)
            except ServiceTimeout:
                if not told_ns and not reader.alive:
                    told_ns = now_ns()
        pipe.send((told_ns, now_ns(), frame.published_ns))


def _watch_skin(pipe: Connection, namespace: Namespace, drivers: int) -> None:
    with Skin(namespace) as skin:
        snapshot = skin.read(timeout_s=30)
        while len(snapshot.layout.drivers) < drivers:
            snapshot = skin.read(newer_than=snapshot, timeout_s=30)
        pipe.send(READY)
        while len(snapshot.layout.drivers) == drivers:
            snapshot = skin.read(newer_than=snapshot, timeout_s=30)
        pipe.send(now_ns())


def _follow(pipe: Connection, namespace: Namespace, name: str) -> None:
    with DriverReader(name, namespace=namespace, timeout_s=30) as reader:
        pipe.send(READY)
        for _ in reader.samples(timeout_s=30):
            if pipe.poll():
                pipe.recv()
                pipe.send(reader.missed)
                return


def _kill_readers(namespace: Namespace) -> tuple[dict[str, float], int, int]:
    name = f"fault-{secrets.token_hex(4)}"
    with Processes() as processes:
        writer = processes.start(_drive, namespace, name, 100.0)
        answer(writer, 30)
        survivor = processes.start(_follow, namespace, name)
        victims = [processes.start(_follow, namespace, name) for _ in range(_READERS)]
        for pipe in (survivor, *victims):
            answer(pipe, 30)
        before_ns = now_ns()
        time.sleep(1.0)
        kills_ns = now_ns()
        for _ in victims:
            time.sleep(0.02 + 0.01 * secrets.randbelow(1000) / 1000)
            processes.kill_last()
        over_ns = now_ns()
        survivor.send(READY)
        lost = answer(survivor, 30)
        writer.send(READY)
        times_ns, missed = answer(writer, 30)
    spent: dict[str, list[int]] = {"before": [], "during": []}
    for begin_ns, duration_ns in times_ns:
        if before_ns <= begin_ns < over_ns:
            spent["before" if begin_ns < kills_ns else "during"].append(duration_ns)
    if not all(spent.values()):
        raise RunFailed("the writer did not publish while its readers were killed")
    return {phase: float(np.median(values)) / 1000 for phase, values in spent.items()}, missed, lost
