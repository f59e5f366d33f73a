"""One trial of the paper's experiment: drivers, users and their readers, as in section 4 of the Skinware 2.0 article.

Every driver and every user is a process. A user has one thread with one reader per driver, as the C library does
(``periodic``, ``asap``), or one thread that reads the whole skin at once (``skin``). Execution time is the thread's
CPU time of one turn of its loop, sleep and wake-up included; age is from publication to the user holding its copy.
Programs of ``skinware.h`` (paper_reader.c) do the same as ``asap`` and ``skin``: ``c asap``, ``c skin``.
"""

from __future__ import annotations

import functools
import os
import random
import secrets
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import numpy.typing as npt
from processes import READY, CpuShare, Processes, answer, use_fifo

import skinware
from skinware import BusState, DriverReader, DriverSnapshot, DriverWriter, Namespace, PatchState, Skin, Structure
from skinware.realtime import NS_PER_S, Periodic, now_ns
from skinware.sensor_types import PRESSURE

SENSORS = 30_848  # 1 square metre of ROBOSKIN, by the article
MODES = ("periodic", "asap", "skin", "c asap", "c skin")
_PER_MODULE = 16
_WRITER_HZ, _READER_HZ = (30.0, 50.0), (10.0, 100.0)
_SETTLE_NS, _LINGER_NS = 3 * NS_PER_S // 10, NS_PER_S // 10
_WRITER_PRIORITY, _READER_PRIORITY = 50, 40


@dataclass(frozen=True)
class Trial:
    """What is tried: drivers, slots of their rings, users, and how these read (one of :data:`MODES`)."""

    repetition: int
    drivers: int
    buffers: int
    users: int
    readers: str = "periodic"


@dataclass(frozen=True)
class Figures:
    """What came out. Times in us; CPU of all writers or all users in % of one core; the rest are counts.

    Worst values are the worst of all threads; ``reader_worst_median_us`` is the median of the readers' worst ones,
    ``age_p50_us`` the median of the readers' medians, ``age_p99_us`` the largest of their 99th percentiles.
    ``skin_cpu_us`` is what reading all sensors once costs a user.
    """

    seconds: float
    writer_mean_us: float
    writer_worst_us: float
    reader_mean_us: float
    reader_worst_us: float
    reader_worst_median_us: float
    skin_cpu_us: float
    age_mean_us: float
    age_p50_us: float
    age_p99_us: float
    age_max_us: float
    reads_per_s: float
    lost: int
    torn: int
    missed_periods: int
    writers_cpu_percent: float
    users_cpu_percent: float


COLUMNS = tuple(field.name for kind in (Trial, Figures) for field in fields(kind))
"""Columns of the CSV."""


def row(trial: Trial, figures: Figures) -> dict[str, object]:
    """One row of the CSV."""
    values: dict[str, int | float] = asdict(figures)
    return {**asdict(trial), **{name: round(value, 2) for name, value in values.items()}}


@dataclass
class Readings:
    """What one reader saw."""

    age_ns: list[int]
    cpu_ns: list[int]
    lost: int = 0
    torn: int = 0


def measure(trial: Trial, namespace: Namespace, seconds: float, *, seed: int = 0, fifo: bool = False) -> Figures:
    """Run a trial. Rates are random, the same for the same trial and seed, whoever reads.

    Raises:
        RunFailed: a process died, failed or hung.
    """
    chance = random.Random(f"{seed} {replace(trial, readers='')}")
    program = c_program() if trial.readers.startswith("c ") else None
    prefix = f"paper-{os.getpid()}-{secrets.token_hex(3)}"
    names = [f"{prefix}-{driver}" for driver in range(trial.drivers)]
    with Processes() as processes:
        writers = []
        for driver, name in enumerate(names):
            rate_hz = chance.uniform(*_WRITER_HZ)
            structure = part_of_skin(driver, trial.drivers)
            writers.append(processes.start(_drive, namespace, name, structure, trial.buffers, rate_hz, fifo))
        for writer in writers:
            answer(writer, 30)
        users = []
        for _ in range(trial.users):
            rates_hz = [chance.uniform(*_READER_HZ) for _ in names]
            if program is None:
                users.append(processes.start(_use, namespace, names, trial.readers, rates_hz, fifo))
            else:
                rate_hz = rates_hz[0] if trial.readers == "c skin" else 0.0
                users.append(processes.start(_use_c, program, namespace, names, rate_hz, fifo))
        for user in users:
            answer(user, 30)
        begin_ns = now_ns() + _SETTLE_NS
        window = begin_ns, begin_ns + round(seconds * NS_PER_S)
        for pipe in (*writers, *users):
            pipe.send(window)
        used = [answer(user, seconds + 60) for user in users]
        for writer in writers:
            writer.send(READY)
        wrote = [answer(writer, 60) for writer in writers]
    return _figures(trial, seconds, wrote, used)


def part_of_skin(part: int, parts: int) -> Structure:
    """One driver's share of all sensors, in whole modules."""
    modules = SENSORS // _PER_MODULE
    first, last = part * modules // parts, (part + 1) * modules // parts
    count = last - first
    return Structure(
        types=[PRESSURE],
        buses=["virtual"],
        patch_name=["patch"],
        patch_bus=[0],
        module_patch=np.zeros(count, np.uint32),
        module_kind=["module"] * count,
        sensor_uid=np.arange(first * _PER_MODULE, last * _PER_MODULE),
        sensor_type=np.full(count * _PER_MODULE, PRESSURE.id),
        sensor_module=np.repeat(np.arange(count), _PER_MODULE),
        dtype="<u2",
    )


def publish(writer: DriverWriter, sequence: int) -> None:
    """Fill one whole frame with its sequence and hand it out."""
    acquired_ns = now_ns()
    columns = writer.begin()
    columns["values"].fill(sequence & 0xFFFF)
    columns["status"].fill(0)
    columns["module_time_ns"].fill(acquired_ns)
    columns["patch_state"].fill(PatchState.LIVE)
    columns["bus_state"].fill(BusState.LIVE)
    writer.commit(acquired_ns)


def is_torn(frame: DriverSnapshot) -> bool:
    """Whether a frame of :func:`publish` is not whole, by its first and last sensor."""
    values, expected = frame.values, frame.sequence & 0xFFFF
    return int(values[0]) != expected or int(values[-1]) != expected


def _drive(
    pipe: Connection,
    namespace: Namespace,
    name: str,
    structure: Structure,
    buffers: int,
    rate_hz: float,
    fifo: bool,
) -> None:
    use_fifo(_WRITER_PRIORITY if fifo else None)
    with DriverWriter(name, structure, namespace=namespace, slots=buffers, rate_hz=rate_hz) as writer:
        publish(writer, 1)
        pipe.send(READY)
        begin_ns, end_ns = pipe.recv()
        cpu_ns: list[int] = []
        timer, share, cpu = Periodic(rate_hz), CpuShare(), 0.0
        while not pipe.poll():
            timer.wait()
            before_ns = time.thread_time_ns()
            publish(writer, writer.sequence + 1)
            spent_ns = time.thread_time_ns() - before_ns
            time_ns = now_ns()
            if begin_ns <= time_ns < end_ns:
                cpu_ns.append(spent_ns)
                cpu = share.so_far()
        pipe.recv()
        pipe.send((cpu_ns, timer.missed, cpu))


def _use(
    pipe: Connection, namespace: Namespace, names: list[str], mode: str, rates_hz: list[float], fifo: bool
) -> None:
    def attend(reader: DriverReader, rate_hz: float) -> Readings:
        use_fifo(_READER_PRIORITY if fifo else None)
        frames = reader.samples(rate_hz if mode == "periodic" else None, timeout_s=10)
        found = _attend(((frame,) for frame in frames), *window)
        found.lost = reader.missed if mode == "asap" else 0  # a periodic reader means to leave some out
        return found

    if mode == "skin":
        use_fifo(_READER_PRIORITY if fifo else None)
        with Skin(namespace) as skin:
            while len(skin.refresh().drivers) < len(names):
                time.sleep(0.01)
            pipe.send(READY)
            window = pipe.recv()
            share = CpuShare()
            found = [_attend((snapshot.samples for snapshot in skin.samples(rates_hz[0], timeout_s=10)), *window)]
    else:
        readers = [DriverReader(name, namespace=namespace, timeout_s=10) for name in names]
        with ThreadPoolExecutor(len(names)) as pool:
            pipe.send(READY)
            window = pipe.recv()
            share = CpuShare()
            found = list(pool.map(attend, readers, rates_hz))
        for reader in readers:
            reader.close()
    pipe.send((found, share.so_far()))


def has_compiler() -> bool:
    """Whether programs in C can be made here."""
    return shutil.which("cc") is not None


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory()


@functools.cache
def c_program() -> Path:
    """paper_reader.c, compiled."""
    program = Path(_folder().name) / "paper_reader"
    source = Path(__file__).with_name("paper_reader.c")
    subprocess.run(["cc", "-O2", "-pthread", f"-I{skinware.get_include()}", "-o", program, source], check=True)
    return program


def _use_c(pipe: Connection, program: Path, namespace: Namespace, names: list[str], rate_hz: float, fifo: bool) -> None:
    use_fifo(_READER_PRIORITY if fifo else None)
    command = [str(program), namespace.name, f"{rate_hz}", *names]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        pipe.send(READY)
        begin_ns, end_ns = pipe.recv()
        told, _ = process.communicate(f"{begin_ns} {end_ns}\n")
    numbers = iter([[int(word) for word in line.split()] for line in told.splitlines()])
    found = []
    for turns, torn in numbers:
        times = [next(numbers) for _ in range(turns)]
        found.append(Readings([age_ns for age_ns, _ in times], [cpu_ns for _, cpu_ns in times], torn=torn))
    cpu_s = sum(sum(readings.cpu_ns) for readings in found) / NS_PER_S
    pipe.send((found, cpu_s * NS_PER_S / (end_ns - begin_ns)))


def _attend(turns: Iterator[tuple[DriverSnapshot, ...]], begin_ns: int, end_ns: int) -> Readings:
    """Take what comes until the end; ``turns`` yields the frames of one turn of the loop."""
    found = Readings([], [])
    before_ns = time.thread_time_ns()
    for frames in turns:
        time_ns = now_ns()
        spent_ns = time.thread_time_ns()
        if time_ns >= end_ns:
            break
        if time_ns >= begin_ns:
            found.age_ns.append(time_ns - min(frame.published_ns for frame in frames))
            found.cpu_ns.append(spent_ns - before_ns)
            found.torn += sum(is_torn(frame) for frame in frames)
        before_ns = time.thread_time_ns()
    return found


def _figures(
    trial: Trial,
    seconds: float,
    wrote: list[tuple[list[int], int, float]],
    used: list[tuple[list[Readings], float]],
) -> Figures:
    readers = [readings for found, _ in used for readings in found]
    ages = [_us(reader.age_ns) for reader in readers]
    read = [_us(reader.cpu_ns) for reader in readers]
    written = [_us(cpu_ns) for cpu_ns, _, _ in wrote]
    all_ages, all_read, all_written = (np.concatenate(parts) for parts in (ages, read, written))
    reader_mean_us = float(all_read.mean())
    return Figures(
        seconds=seconds,
        writer_mean_us=float(all_written.mean()),
        writer_worst_us=float(all_written.max()),
        reader_mean_us=reader_mean_us,
        reader_worst_us=float(all_read.max()),
        reader_worst_median_us=float(np.median([one.max() for one in read])),
        skin_cpu_us=reader_mean_us * (1 if trial.readers.endswith("skin") else trial.drivers),
        age_mean_us=float(all_ages.mean()),
        age_p50_us=float(np.median([np.median(one) for one in ages])),
        age_p99_us=float(max(np.percentile(one, 99) for one in ages)),
        age_max_us=float(all_ages.max()),
        reads_per_s=len(all_ages) / seconds,
        lost=sum(reader.lost for reader in readers),
        torn=sum(reader.torn for reader in readers),
        missed_periods=sum(missed for _, missed, _ in wrote),
        writers_cpu_percent=100 * sum(cpu for _, _, cpu in wrote),
        users_cpu_percent=100 * sum(cpu for _, cpu in used),
    )


def _us(times_ns: list[int]) -> npt.NDArray[np.float64]:
    return np.array(times_ns or [0], np.float64) / 1000
