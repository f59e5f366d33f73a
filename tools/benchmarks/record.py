"""Recording: what it costs, how large it is, what it loses, and what a killed recorder leaves; as people start it.

tools/bench record [cost|kills|convert|losses] [--viewers] [--seconds S] [--kills N] [--minutes M] [--busy N]
                    [--slots N] [--sensors N ...] [--pattern NAME ...] [--formats NAME ...]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import numpy.typing as npt
from processes import Processes, answer, own_namespace

import skinware.recording
from skinware import DriverReader, DriverWriter, Sample, Structure
from skinware.conversion import FORMATS
from skinware.geometry import Geometry
from skinware.memory.statistics import BUCKETS
from skinware.realtime import Periodic, now_ns
from skinware.recording.files import recover
from skinware.sensor_types import PRESSURE

BIN = Path(sys.executable).parent
RATE_HZ = 100
SMALL, LARGE = 768, 30_848
PATTERNS = ("analogue", "quiet")
FORMAT_OPTIONS = {name: [name] for name in FORMATS} | {
    "lerobot": ["lerobot", "--fps", "30"],
    "lerobot-windows": ["lerobot", "--fps", "30", "--window", "all"],
}
PER_MODULE, PER_PATCH = 16, 16
NOISE = 2.0
SHARE = 0.05
LEVELS = 20.0
"""Noise of every sensor, and how far the levels of untouched sensors are apart, counts; share of those that change by
one in each frame of a quiet skin."""
BUS_COUNTERS, PATCH_COUNTERS = 12, 8


def structure_of(sensors: int) -> Structure:
    modules = sensors // PER_MODULE
    patches = -(-modules // PER_PATCH)
    return Structure(
        types=[PRESSURE.measured(unit="counts")],
        buses=["can0"],
        patch_name=[f"board {n}" for n in range(patches)],
        patch_bus=[0] * patches,
        module_patch=np.arange(modules) // PER_PATCH,
        module_kind=["triangle"] * modules,
        sensor_uid=np.arange(sensors),
        sensor_type=[PRESSURE.id] * sensors,
        sensor_module=np.arange(sensors) // PER_MODULE,
        dtype="u2",
        geometry=_places(sensors),
    )


def _places(sensors: int) -> Geometry:
    """A plane of sensors."""
    places = Geometry.unknown([PRESSURE.name] * sensors, np.arange(sensors, dtype=np.uint64))
    places.position_m[:] = np.stack((*np.divmod(np.arange(sensors), 176), np.zeros(sensors)), axis=1) * 0.0065
    places.frame[:] = "chest"
    return places


def drive(pipe: Connection, namespace: str, sensors: int, pattern: str, slots: int | None) -> None:
    """Publish a skin at 100 Hz until the other end says enough; then how many frames."""
    structure = structure_of(sensors)
    generator = np.random.default_rng(1)
    level = np.round(generator.normal(2100, LEVELS, sensors)).astype(np.int64)
    noise = np.round(generator.normal(0, NOISE, (64, sensors))).astype(np.int64)
    place = np.arange(sensors)
    names = [f"counter {n}" for n in range(max(BUS_COUNTERS, PATCH_COUNTERS))]
    with DriverWriter(
        "large",
        structure,
        namespace=namespace,
        rate_hz=RATE_HZ,
        slots=slots,
        bus_counters=names[:BUS_COUNTERS],
        patch_counters=names[:PATCH_COUNTERS],
    ) as writer:
        first = writer.begin()
        for column in first.values():
            column[:] = 0
        writer.commit(now_ns())
        pipe.send("ready")
        timer, number = Periodic(RATE_HZ), 0
        values: npt.NDArray[np.int64] = level
        while not pipe.poll():
            timer.wait()
            number += 1
            columns = writer.begin(from_last=True)
            if pattern == "analogue":
                touch = 400 * np.exp(-(((place - number * 20 % sensors) / 60.0) ** 2))
                values = level + noise[generator.integers(64)] + touch.astype(np.int64)
            else:
                values = values + (generator.random(sensors) < SHARE) * generator.choice((-1, 1), sensors)
            columns["values"][:] = values
            time_ns = now_ns()
            patch_ns = generator.integers(0, 5_000_000, structure.n_patches)
            columns["module_time_ns"][:] = (
                time_ns - patch_ns[structure.module_patch] - place[: structure.n_modules] % 16 * 1000
            )
            columns["bus_counters"][:] += 500
            columns["patch_counters"].reshape(-1, PATCH_COUNTERS)[:, :2] += 16
            for counts, of_patches in (("patch_interval_counts", 24), ("patch_age_counts", 20)):
                columns[counts].reshape(-1, BUCKETS)[:, of_patches] += np.uint64(16)
            writer.commit(time_ns)
        pipe.send((writer.sequence, timer.missed))


@contextmanager
def driving(namespace: str, sensors: int, pattern: str, slots: int | None = None) -> Iterator[list[int]]:
    """A driver; at the end how many frames it published, and how many periods it missed."""
    told: list[int] = []
    with Processes() as processes:
        pipe = processes.start(drive, namespace, sensors, pattern, slots)
        answer(pipe, 30)
        try:
            yield told
        finally:
            pipe.send("enough")
            told += answer(pipe, 30)


def count(pipe: Connection) -> None:
    """Be busy until the other end says enough."""
    number = 0
    pipe.send("ready")
    while number % 4096 or not pipe.poll():
        number += 1


@contextmanager
def busy(number: int) -> Iterator[None]:
    """Programs that do nothing but count."""
    with Processes() as processes:
        pipes = [processes.start(count) for _ in range(number)]
        for pipe in pipes:
            answer(pipe, 30)
        try:
            yield
        finally:
            for pipe in pipes:
                pipe.send("enough")


def witness(pipe: Connection, namespace: str) -> None:
    """Take every frame until the other end says enough; then a digest of each, by sequence."""
    seen: dict[int, bytes] = {}
    with DriverReader("large", namespace=namespace) as reader:
        pipe.send("ready")
        for frame in reader.in_order():
            seen[frame.sequence] = digest(frame, reader.schema.columns)
            if pipe.poll():
                break
    pipe.send(seen)


def digest(frame: Sample, columns: Iterable[str]) -> bytes:
    state = hashlib.blake2b(struct.pack("<qQ", frame.acquired_ns, frame.flags), digest_size=16)
    for name in columns:
        state.update(frame.column(name).tobytes())
    return state.digest()


@contextmanager
def recording(namespace: str, file: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    command = [str(BIN / "skin-record"), "-o", str(file), "--namespace", namespace, "--json", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if json.loads(line).get("messages", {}).get("/skin/large/frame"):
                break
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        process.stdout.close()


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def cost(seconds: float, skins: list[int], patterns: list[str], folder: Path, *options: str) -> None:
    """Processor time, bytes a frame and losses, by skin and pattern."""
    print(f"{RATE_HZ} Hz, {seconds:g} s each; load {os.getloadavg()[0]:.1f}")
    for sensors in skins:
        for pattern in patterns:
            with own_namespace() as namespace:
                file = folder / f"{sensors}-{pattern}.mcap"
                with driving(namespace.name, sensors, pattern), recording(namespace.name, file, *options) as process:
                    begin_s, used_s, size = time.monotonic(), cpu_s(process.pid), file.stat().st_size
                    time.sleep(seconds)
                    share = (cpu_s(process.pid) - used_s) / (time.monotonic() - begin_s)
                    process.send_signal(signal.SIGINT)
                    assert process.stdout is not None
                    told = json.loads(process.stdout.read().splitlines()[-1])
            frames = told["messages"]["/skin/large/frame"]
            kb = told["bytes"] / frames / 1e3
            print(
                f"  {sensors:6} sensors, {pattern:<8}  {100 * share:5.1f} % of a core  {kb:6.2f} kB a frame"
                f"  {frames} frames, {told['missed']} lost  (file grew from {size / 1e6:.1f} MB)",
                flush=True,
            )
            read(file)


def read(file: Path) -> None:
    """How fast a recording is read, and made whole."""
    begin_s = time.perf_counter()
    with skinware.recording.open(file) as opened:
        series = opened["large"].read(["values"])
        columns_s = time.perf_counter() - begin_s
        begin_s, frames = time.perf_counter(), sum(1 for _ in opened["large"].samples())
        frames_s = time.perf_counter() - begin_s
    begin_s = time.perf_counter()
    recover(file, file.with_suffix(".whole.mcap"))
    recover_s = time.perf_counter() - begin_s
    raw_mb = len(series) * series.column("values").shape[1] * 3.5 / 1e6
    print(
        f"         read: values of all frames {1e3 * columns_s / len(series):.2f} ms a frame, as frames"
        f" {1e3 * frames_s / frames:.2f}; made whole at {raw_mb / recover_s:.0f} MB/s of raw frames",
        flush=True,
    )


def kills(number_of_kills: int, skins: list[int], folder: Path) -> None:
    """What is missing at the end of a recording whose recorder was killed at any moment, and what is wrong in it."""
    for sensors in skins:
        missing: list[float] = []
        recorded: list[dict[int, bytes]] = []
        with (
            own_namespace() as namespace,
            driving(namespace.name, sensors, "analogue"),
            DriverReader("large", namespace=namespace) as reader,
            Processes() as processes,
        ):
            pipe = processes.start(witness, namespace.name)
            answer(pipe, 30)
            for number in range(number_of_kills):
                file = folder / f"killed-{sensors}-{number}.mcap"
                with recording(namespace.name, file) as process:
                    time.sleep(random.uniform(0, 1.0))
                    process.kill()
                    newest_ns = reader.read().published_ns
                    process.wait()
                whole = file.with_suffix(".whole.mcap")
                recover(file, whole)
                columns = reader.schema.columns
                with skinware.recording.open(whole) as opened:
                    frames = list(opened["large"].samples())
                missing.append((newest_ns - frames[-1].published_ns) / 1e9)
                recorded.append({frame.sequence: digest(frame, columns) for frame in frames})
                file.unlink()
                whole.unlink()
            pipe.send("enough")
            seen = answer(pipe, 30)
        p50, most = np.median(missing), max(missing)
        both = sum(len(frames.keys() & seen.keys()) for frames in recorded)
        others = sum(seen.get(sequence, value) != value for frames in recorded for sequence, value in frames.items())
        gaps = sum(max(frames) - min(frames) + 1 - len(frames) for frames in recorded)
        print(
            f"  {sensors:6} sensors, {number_of_kills} kills: missing p50 {p50:.3f} s, most {most:.3f} s;"
            f" of {both} frames that a second reader took {others} differ, {gaps} missing within",
            flush=True,
        )


def losses(minutes: float, n_busy: int, slots: int | None, skins: list[int], patterns: list[str], folder: Path) -> None:
    """Frames that are lost in a long time, beside programs that keep the processors busy."""
    for sensors in skins:
        for pattern in patterns:
            file = folder / f"{sensors}-{pattern}-long.mcap"
            with own_namespace() as namespace:
                with (
                    driving(namespace.name, sensors, pattern, slots) as told,
                    busy(n_busy),
                    recording(namespace.name, file) as process,
                ):
                    time.sleep(60 * minutes)
                    process.send_signal(signal.SIGINT)
                    assert process.stdout is not None
                    stopped = json.loads(process.stdout.read().splitlines()[-1])
            lost = stopped["missed"]
            frames = stopped["messages"]["/skin/large/frame"] + lost
            print(
                f"  {sensors:6} sensors, {pattern:<8}  {minutes:g} min beside {n_busy} busy programs, load"
                f" {os.getloadavg()[0]:.1f}, {slots or 'default'} slots: lost {lost} of {frames}"
                f"  (the driver missed {told[1]} periods)",
                flush=True,
            )
            file.unlink()


def convert(seconds: float, skins: list[int], patterns: list[str], formats: list[str], folder: Path) -> None:
    """How long a conversion takes, how large its result is, and how much memory it had."""
    for sensors in skins:
        for pattern in patterns:
            file = folder / f"{sensors}-{pattern}.mcap"
            with own_namespace() as namespace, driving(namespace.name, sensors, pattern):
                options = ["-o", str(file), "--namespace", namespace.name, "-T", str(seconds)]
                subprocess.run([BIN / "skin-record", *options], check=True, stdout=subprocess.DEVNULL)
            with skinware.recording.open(file) as opened:
                frames = len(opened["large"].read(["latency_ns"]))
            print(f"  {sensors:6} sensors, {pattern}: {frames} frames", flush=True)
            for name in formats:
                target = folder / f"converted-{name}"
                begin_s = time.monotonic()
                process = subprocess.Popen(
                    [BIN / "skin-convert", file, "-o", target, "--to", *FORMAT_OPTIONS[name]],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
                _, status, usage = os.wait4(process.pid, 0)
                process.returncode = os.waitstatus_to_exitcode(status)
                passed_s = time.monotonic() - begin_s
                assert not process.returncode
                files = [target] if target.is_file() else [each for each in target.rglob("*") if each.is_file()]
                size = sum(each.stat().st_size for each in files)
                used_s = usage.ru_utime + usage.ru_stime
                print(
                    f"    {name:<16} {1e3 * passed_s / frames:6.2f} ms a frame, of a core {1e3 * used_s / frames:6.2f},"
                    f" {60 * RATE_HZ * used_s / frames:5.1f} s a minute, {size / frames / 1e3:6.1f} kB a frame,"
                    f" at most {usage.ru_maxrss / 1024:.0f} MiB",
                    flush=True,
                )
                shutil.rmtree(target) if target.is_dir() else target.unlink()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", choices=["cost", "kills", "convert", "losses"])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--minutes", type=float, default=10.0, help="of losses, for each skin and pattern")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="of losses: busy programs beside it")
    parser.add_argument("--slots", type=int, metavar="N", help="of losses: of the driver's ring")
    parser.add_argument("--sensors", type=int, nargs="+", default=[LARGE, SMALL], metavar="N")
    parser.add_argument("--pattern", nargs="+", choices=PATTERNS, default=list(PATTERNS))
    parser.add_argument("--formats", nargs="+", choices=FORMAT_OPTIONS, default=list(FORMAT_OPTIONS), help="of convert")
    parser.add_argument("--viewers", action="store_true", help="cost of a recorder with --viewers")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.what in (None, "cost"):
            more = ["--viewers"] * options.viewers
            cost(options.seconds, options.sensors, options.pattern, Path(folder), *more)
        if options.what in (None, "kills"):
            kills(options.kills, options.sensors, Path(folder))
        if options.what in (None, "convert"):
            convert(options.seconds, options.sensors, options.pattern, options.formats, Path(folder))
        if options.what == "losses":
            skins, patterns = options.sensors, options.pattern
            losses(options.minutes, options.busy, options.slots, skins, patterns, Path(folder))


if __name__ == "__main__":
    main()
