"""Tactile services: how well baselines hold beside the rules of others, and what they cost.

* speed: one frame of 30,848 taxels, for some patterns of touch; the rule of the iCub takes the same frames in turns.
* contacts: one frame of as many taxels through contacts, alone and after a baseline (contacts.py).
* health: what is found of planted faults, and what it costs beside the baseline (health.py).
* motion: how well strokes of known speed and direction are told (motion.py).
* service: ``skin-calm`` on a driver of 30,848 taxels with places at 50 Hz: processor time of its whole process, which
  publishes contacts too.
* calibration: the parts of an iCub, pressed and stroked, with many seeds (calibration.py).
* worlds: 25 minutes of drift and touches (``bench_world``), many worlds for each drift and rate.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import fields
from multiprocessing.connection import Connection
from pathlib import Path

import calibration
import contacts
import health
import motion
import numpy as np
import numpy.typing as npt
from processes import Processes, answer

from skinware import DriverReader, DriverWriter, Namespace, Structure
from skinware.sensor_types import PRESSURE
from skinware.tactile.baseline import Baseline
from skinware.tactile.calm_service import CalmService
from tests.tactile.judging import Marks, Ours, Worlds, judge, peers
from tests.tactile.peers import ICub
from tests.tactile.skins import placed, triangles

TAXELS = 30_848
RATE_HZ = 50
MODULE, PATCH = np.arange(TAXELS) // 12, np.arange(TAXELS) // 192
WARM_UP, FRAMES = 400, 1000
PARTS = ("speed", "contacts", "health", "motion", "service", "calibration", "worlds")


def blobs(random: np.random.Generator) -> npt.NDArray[np.bool_]:
    """20 contacts of 47 taxels."""
    touched = np.zeros(TAXELS, bool)
    for first in random.integers(0, TAXELS - 47, 20).tolist():
        touched[first : first + 47] = True
    return touched


PATTERNS: dict[str, Callable[[np.random.Generator], npt.NDArray[np.bool_]]] = {
    "nothing": lambda _random: np.zeros(TAXELS, bool),
    "20 contacts": blobs,
    "half, at random": lambda random: random.random(TAXELS) < 0.5,
    "all": lambda _random: np.ones(TAXELS, bool),
}


def speed() -> None:
    """Milliseconds of one frame, by pattern."""
    random = np.random.default_rng(1)
    idle = np.round(15 + 0.8 * random.standard_normal((50, TAXELS), np.float32))
    print(f"one frame of {TAXELS} taxels in {PATCH.max() + 1} patches, {FRAMES} frames at {RATE_HZ} Hz, ms")
    for name, pattern in PATTERNS.items():
        ours, icub = Baseline(MODULE, PATCH), ICub.as_shipped(RATE_HZ)
        load = (pattern(random) * 30).astype(np.float32)
        taken: list[list[float]] = [[], []]
        busy: list[float] = []
        for number in range(WARM_UP + FRAMES):
            frame = idle[number % 50] + load * (number >= WARM_UP and number % 100 < 50)
            rules: tuple[Callable[..., object], ...] = (ours.update, icub)
            for times, rule in zip(taken, rules, strict=True):
                begin, busy_since = time.perf_counter(), time.thread_time()
                rule((number + 1) * 20_000_000, frame)
                times.append(1e3 * (time.perf_counter() - begin))
                busy.append(1e3 * (time.thread_time() - busy_since))
        mine, theirs = (np.array(times[WARM_UP:]) for times in taken)
        p50, p99, most = np.percentile(mine, 50), np.percentile(mine, 99), mine.max()
        busy_p99 = np.percentile(busy[2 * WARM_UP :: 2], 99)
        ratio = statistics.median((mine / theirs).tolist())
        text = f"p50 {p50:.2f}  p99 {p99:.2f}  most {most:.2f}  p99 of processor time {busy_p99:.2f}"
        print(f"  {name:<16} {text}  {ratio:.1f} times the rule of the iCub")
        print(f"  {'':<16} the rest taken, once: {max(taken[0][:WARM_UP]):.1f}")


def service(seconds: float) -> None:
    """Processor time of a service, while 20 contacts come and go."""
    source, into = (Namespace(f"bench-{os.getpid()}-{what}") for what in ("source", "calm"))
    try:
        with tempfile.TemporaryDirectory() as folder, Processes() as processes:
            writer = processes.start(write, source)
            answer(writer, 30)
            calm = processes.start(calm_down, source, into, Path(folder) / "state.npz", seconds)
            answer(calm, 30)
            time.sleep(0.5)
            with DriverReader("skin", namespace=into, timeout_s=10) as reader:
                before = reader.read()
                busy_s, passed_s, frames = answer(calm, seconds + 60)
                after = reader.read(timeout_s=1)
            writer.send("stop")
        share, rate_hz = 100 * busy_s / passed_s, frames / passed_s
        print(f"skin-calm of {TAXELS} taxels at {rate_hz:.1f} Hz: {share:.1f} % of a core, its start left out")
        print(f"  {after.sequence - before.sequence} frames seen by a reader, {frames} taken")
    finally:
        for namespace in (source, into):
            shutil.rmtree(namespace.path, ignore_errors=True)


def write(pipe: Connection, namespace: Namespace) -> None:
    """A driver at 50 Hz, until something comes through the pipe."""
    random = np.random.default_rng(1)
    modules = TAXELS // 12 + (TAXELS % 12 > 0)
    structure = Structure(
        types=[PRESSURE.measured(unit="counts", scale=-1.0, offset=255.0, minimum=0.0, maximum=255.0)],
        buses=["bench"],
        patch_name=[f"board {number}" for number in range(modules // 16 + 1)],
        patch_bus=np.zeros(modules // 16 + 1, int),
        module_patch=np.arange(modules) // 16,
        module_kind=["triangle"] * modules,
        sensor_uid=np.arange(TAXELS),
        sensor_type=np.full(TAXELS, PRESSURE.id),
        sensor_module=MODULE,
        dtype="u1",
    )
    places = placed(triangles(176, 176)[:TAXELS])  # of type pressure, with uid from 0 on
    structure = structure.placed(places)
    idle = np.round(240 - 0.8 * random.standard_normal((50, TAXELS))).astype(np.uint8)
    touched = 60 * blobs(random).astype(np.uint8)
    with DriverWriter("skin", structure, namespace=namespace, rate_hz=RATE_HZ) as writer:
        next_s, number = time.monotonic(), 0
        while not pipe.poll():
            columns = writer.begin()
            for column in columns.values():
                column[:] = 0
            columns["values"][:] = idle[number % 50] - touched * (number > 400 and number % 100 < 50)
            columns["module_time_ns"][:] = time.monotonic_ns()
            columns["patch_state"][:] = columns["bus_state"][:] = 1
            writer.commit(time.monotonic_ns())
            if number == 0:
                pipe.send("published")
            number += 1
            next_s += 1 / RATE_HZ
            time.sleep(max(0.0, next_s - time.monotonic()))


def calm_down(pipe: Connection, source: Namespace, into: Namespace, state_path: Path, seconds: float) -> None:
    """The service, measured from the moment at which the rest is known."""
    begun: list[float] = []

    def look() -> None:
        ready = calm.status()["ready"].get("pressure", 0) == TAXELS
        if ready and not begun:
            begun.extend((time.monotonic(), time.process_time(), calm.frames))
        elif begun and time.monotonic() - begun[0] > seconds:
            calm.stop()

    calm = CalmService("skin", namespace=source, into=into, state_path=state_path)
    calm.run(look, every_s=0.2, on_ready=lambda: pipe.send("ready"))
    pipe.send((time.process_time() - begun[1], time.monotonic() - begun[0], calm.frames - begun[2]))


def worlds(count: int, rates: list[float]) -> None:
    """The marks of all rules."""
    for rate_hz in rates:
        seen = Worlds(rate_hz, count)
        found = judge({"skinware": Ours(seen), **peers(rate_hz)}, seen)
        for (name, drift), marks in found.items():
            print(f"{rate_hz:g} Hz, {drift:<4} {name:<14} {line(marks)}", flush=True)


def line(marks: Marks) -> str:
    """Worst and best of each mark over the worlds."""
    texts = []
    for field in fields(marks):
        values = getattr(marks, field.name)
        unit = 1 if field.name.endswith("_s") else 100
        low, high = unit * values.min(), unit * values.max()
        texts.append(f"{field.name} {low:.3g}" + (f" to {high:.3g}" if high - low > 5e-3 * abs(high) else ""))
    return ", ".join(texts)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", nargs="*", choices=(*PARTS, []), help="default: all")
    parser.add_argument("--worlds", type=int, default=20, help="of each drift, at each rate")
    parser.add_argument("--rates", default="20,50,100", help="Hz")
    parser.add_argument("--seeds", type=int, default=20, help="of each part, for calibration")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long the service is measured")
    arguments = parser.parse_args()
    parts = arguments.part or PARTS
    if "speed" in parts:
        speed()
    if "contacts" in parts:
        contacts.speed()
    if "health" in parts:
        health.speed()
        health.found()
    if "motion" in parts:
        motion.main()
    if "service" in parts:
        service(arguments.seconds)
    if "calibration" in parts:
        calibration.calibrate(arguments.seeds)
    if "worlds" in parts:
        worlds(arguments.worlds, [float(rate) for rate in arguments.rates.split(",")])


if __name__ == "__main__":
    main()
