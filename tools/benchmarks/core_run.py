"""One run of ``core``: a writer and its readers, each in a process of its own, for a product, a size and a rate."""

from __future__ import annotations

import os
import secrets
import subprocess
import time
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection

import numpy as np
import numpy.typing as npt
from core_products import Product, SkinwareInC
from processes import READY, CpuShare, Processes, RunFailed, answer, use_fifo

from skinware.realtime import Periodic, now_ns

WARM_UP, MEASURED, OVER = range(3)  # phases, as the messages carry them
_WARM_UP_S = 0.25
_LAST_MESSAGES = 3
_LAST_PAUSE_S = 0.03
_WRITER_PRIORITY, _READER_PRIORITY = 50, 40


@dataclass(frozen=True)
class Cell:
    """What is measured: how many sensors and readers, how often, with which scheduling (``normal``, ``fifo``)."""

    sensors: int
    readers: int
    rate_hz: int
    profile: str = "normal"


@dataclass(frozen=True)
class Result:
    """Figures of one run; times in us, CPU in % of one core, ``torn`` is a count of incoherent messages."""

    publish_us: float
    publish_p99_us: float
    age_us: float
    age_p99_us: float
    age_max_us: float
    lost_percent: float
    torn: int
    writer_cpu_percent: float
    reader_cpu_percent: float

    def row(self) -> dict[str, float]:
        """By name."""
        return asdict(self)


def measure(product: Product, cell: Cell, seconds: float) -> Result:
    """Run a cell once.

    Raises:
        RunFailed: a process died, failed or hung.
    """
    topic = f"bench-{os.getpid()}-{secrets.token_hex(4)}"
    count = max(10, round(cell.rate_hz * seconds))
    with Processes() as processes:
        writer = processes.start(_write, product, topic, cell, count)
        answer(writer, 20)
        readers = [processes.start(_read, product, topic, cell) for _ in range(cell.readers)]
        for reader in readers:
            answer(reader, 30)
        writer.send(READY)
        limit_s = seconds + 30
        publish_ns, writer_cpu = answer(writer, limit_s)
        found = [answer(reader, limit_s) for reader in readers]
        writer.send(OVER)
    ages_us = np.concatenate([ages for ages, _, _ in found]) / 1000
    if not len(ages_us):
        raise RunFailed("no message came")
    lost = count * cell.readers - len(ages_us)
    publish_us = publish_ns / 1000
    return Result(
        publish_us=float(np.median(publish_us)),
        publish_p99_us=float(np.percentile(publish_us, 99)),
        age_us=float(np.median(ages_us)),
        age_p99_us=float(np.percentile(ages_us, 99)),
        age_max_us=float(ages_us.max()),
        lost_percent=100 * lost / (count * cell.readers),
        torn=sum(torn for _, torn, _ in found),
        writer_cpu_percent=100 * writer_cpu,
        reader_cpu_percent=100 * float(np.mean([cpu for _, _, cpu in found])),
    )


def _write(pipe: Connection, product: Product, topic: str, cell: Cell, count: int) -> None:
    use_fifo(_WRITER_PRIORITY if cell.profile == "fifo" else None)
    publisher = product.publisher(topic, cell.sensors)
    values = np.zeros(cell.sensors, np.uint16)
    pipe.send(READY)
    pipe.recv()
    publish_ns = np.zeros(count, np.int64)
    sequence = 0

    def publish(phase: int) -> int:
        nonlocal sequence
        sequence += 1
        values.fill(sequence & 0xFFFF)
        begin_ns = now_ns()
        publisher.publish(phase, sequence, values)
        return now_ns() - begin_ns

    timer = Periodic(cell.rate_hz)
    for _ in range(max(5, round(cell.rate_hz * _WARM_UP_S))):
        timer.wait()
        publish(WARM_UP)
    share = CpuShare()
    for i in range(count):
        timer.wait()
        publish_ns[i] = publish(MEASURED)
    cpu = share.so_far()
    for _ in range(_LAST_MESSAGES):
        time.sleep(_LAST_PAUSE_S)
        publish(OVER)
    pipe.send((publish_ns, cpu))
    pipe.recv()  # until the readers have it all
    publisher.close()


def _read(pipe: Connection, product: Product, topic: str, cell: Cell) -> None:
    use_fifo(_READER_PRIORITY if cell.profile == "fifo" else None)
    if isinstance(product, SkinwareInC):
        _read_in_c(pipe, product.reader_command(topic))
        return
    subscriber = product.subscriber(topic, cell.sensors)
    pipe.send(READY)
    ages: list[int] = []
    torn, share, cpu = 0, None, 0.0
    for phase, sequence, stamp_ns, values in subscriber.messages():
        age_ns = now_ns() - stamp_ns
        if phase == MEASURED:
            if share is None:
                share = CpuShare()
            ages.append(age_ns)
            torn += int(values[0]) != sequence & 0xFFFF or int(values[-1]) != sequence & 0xFFFF
        elif phase == OVER:
            break
    if share is not None:
        cpu = share.so_far()
    received: npt.NDArray[np.int64] = np.array(ages, np.int64)
    pipe.send((received, torn, cpu))
    subscriber.close()


def _read_in_c(pipe: Connection, command: list[str]) -> None:
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "ready\n"
        pipe.send(READY)
        cpu, torn, *ages = program.stdout.read().split()
    pipe.send((np.array(ages, np.int64), int(torn), float(cpu)))
