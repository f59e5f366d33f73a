"""Reflexes: how late a reader learns of a touch, through skin-calm, beside busy processes.

A driver of some taxels is pressed twice a second. The time is measured from the commit of the second touched frame, in
which a touch can be found, to the event in the reader: that of skinware.tactile, or examples/reflex.c. Driver, service
and reader are a process each; with the real-time profile they are ahead of everything else.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import tempfile
import time
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from processes import Processes, answer

from skinware import DriverWriter, Namespace, Structure
from skinware.realtime import Periodic, Profile, now_ns
from skinware.sensor_types import PRESSURE
from skinware.tactile.calm_service import CalmService
from skinware.tactile.contacts_service import ContactsReader
from skinware.tactile.onsets import EventKind
from tests.tactile.skins import placed, triangles

ROOT = Path(__file__).resolve().parents[2]
SIDE, SETTLED_S, EVERY_S, PRESS_S = 32, 8.0, 0.5, 0.2
LOAD = 8.0


def structure() -> Structure:
    n = SIDE * SIDE
    made = Structure(
        types=[PRESSURE.measured(unit="counts", scale=1.0, offset=0.0, minimum=0.0, maximum=255.0)],
        buses=["bench"],
        patch_name=[f"board {number}" for number in range(n // 128)],
        patch_bus=np.zeros(n // 128, int),
        module_patch=np.arange(n // 16) // 8,
        module_kind=["square"] * (n // 16),
        sensor_uid=np.arange(n),
        sensor_type=np.full(n, PRESSURE.id),
        sensor_module=np.arange(n) // 16,
        dtype="u1",
    )
    return made.placed(placed(triangles(SIDE, SIDE)))


def drive(pipe: Connection, namespace: Namespace, rate_hz: float, profile: Profile | None) -> None:
    """A driver that is pressed now and then, until something comes through the pipe; then the times of its touches, ns.

    That of a touch is the commit of its second frame.
    """
    apply(profile)
    touches_ns: list[int] = []
    pressed = 0
    random = np.random.default_rng(1)
    idle = np.round(15 + 0.8 * random.standard_normal((50, SIDE * SIDE))).astype(np.uint8)
    with DriverWriter("skin", structure(), namespace=namespace, rate_hz=rate_hz) as writer:
        pipe.send("ready")
        begin_s = time.monotonic()
        for number, _ in enumerate(Periodic(rate_hz=rate_hz)):
            if pipe.poll():
                pipe.send(touches_ns)
                return
            passed_s = time.monotonic() - begin_s - SETTLED_S
            columns = writer.begin()
            for column in columns.values():
                column[:] = 0
            columns["values"][:] = idle[number % 50]
            pressed = pressed + 1 if passed_s > 0 and passed_s % EVERY_S < PRESS_S else 0
            if pressed:
                first = 33 * (1 + int(passed_s / EVERY_S) % 20)
                columns["values"][[first, first + 1, first + SIDE]] += np.uint8(LOAD)
            columns["module_time_ns"][:] = now_ns()
            columns["patch_state"][:] = columns["bus_state"][:] = 1
            time_ns = now_ns()
            writer.commit(time_ns)
            touches_ns += [time_ns] if pressed == 2 else []


def calm_down(pipe: Connection, source: Namespace, into: Namespace, profile: Profile | None) -> None:
    """The service, until something comes through the pipe."""
    apply(profile)
    service = CalmService("skin", namespace=source, into=into)
    service.run(lambda: service.stop() if pipe.poll() else None, every_s=0.2, on_ready=lambda: pipe.send("ready"))


def react(pipe: Connection, into: Namespace, seconds: float, profile: Profile | None) -> None:
    """A reader, and the times of its onsets, ns."""
    apply(profile)
    onsets_ns = []
    with ContactsReader(namespace=into, timeout_s=30) as contacts:
        end_ns = now_ns() + round((SETTLED_S + seconds) * 1e9)
        for event in contacts.events(timeout_s=30):
            if event.kind is EventKind.ONSET:
                onsets_ns.append(now_ns())
            if now_ns() > end_ns:
                break
    pipe.send(onsets_ns)


def react_in_c(pipe: Connection, into: Namespace, seconds: float, profile: Profile | None) -> None:
    """The reader in C, and the times of its onsets, ns: those of their samples, and the ages that it prints."""
    apply(profile)
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder, "reflex")
        include = ROOT / "skinware" / "include"
        source = ROOT / "examples" / "reflex.c"
        subprocess.run(["cc", "-O2", "-std=c11", f"-I{include}", "-o", str(program), str(source)], check=True)
        with subprocess.Popen([program, into.name], stdout=subprocess.PIPE, text=True) as reader:
            try:
                time.sleep(SETTLED_S + seconds)
            finally:
                reader.terminate()
            lines = reader.communicate()[0].splitlines()
    onsets = [line.split() for line in lines if line.startswith("onset")]
    pipe.send([int(sample_ns) + 1000 * int(age_us) for _, _, age_us, _, sample_ns, _ in onsets])


def compute(pipe: Connection) -> None:
    """Keep a processor busy."""
    while not pipe.poll():
        sum(range(100_000))


def apply(profile: Profile | None) -> None:
    if profile is not None:
        for refusal in profile.apply():
            print(f"  {refusal}")


def run(rate_hz: float, seconds: float, busy: int, priority: int, *, in_c: bool) -> None:
    """One line."""
    source, into = (Namespace(f"bench-{os.getpid()}-{what}") for what in ("source", "calm"))
    profiles = [Profile.fifo(priority + step) if priority else None for step in (0, 1, 2)]
    try:
        with Processes() as processes:
            computing = [processes.start(compute) for _ in range(busy)]
            driver = processes.start(drive, source, rate_hz, profiles[0])
            answer(driver, 30)
            service = processes.start(calm_down, source, into, profiles[1])
            answer(service, 30)
            reader = processes.start(react_in_c if in_c else react, into, seconds, profiles[2])
            onsets_ns = answer(reader, seconds + 60)
            for pipe in (driver, service, *computing):
                pipe.send("stop")
            touches_ns = answer(driver, 30)
        late_ms = lateness(touches_ns, onsets_ns)
        p50, p99 = np.percentile(late_ms, [50, 99])
        how = f"fifo:{priority}" if priority else "no profile"
        text = f"p50 {p50:.2f}  p99 {p99:.2f}  most {max(late_ms):.2f}"
        reader_in = "C" if in_c else "Python"
        found = f"{len(late_ms)} onsets of {len(touches_ns)} touches"
        print(f"  {rate_hz:g} Hz, {busy} busy, {how:<10}, {reader_in:<6}: {text} ms; {found}", flush=True)
    finally:
        for namespace in (source, into):
            shutil.rmtree(namespace.path, ignore_errors=True)


def lateness(touches_ns: list[int], onsets_ns: list[int]) -> list[float]:
    """Return how long after each touch its onset was known, ms; a touch without one before the next has none."""
    late_ms = []
    for touch_ns, next_ns in pairwise([*touches_ns, 1 << 62]):
        after = [onset_ns for onset_ns in onsets_ns if touch_ns <= onset_ns < next_ns]
        late_ms += [(after[0] - touch_ns) / 1e6] if after else []
    return late_ms


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=200.0, help="Hz")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long each run is measured")
    parser.add_argument("--priority", type=int, default=40, help="of the driver; service and reader are 1 and 2 above")
    arguments = parser.parse_args()
    print(f"from the second frame of a touch to its onset in a reader, {SIDE * SIDE} taxels")
    for busy in (0, os.cpu_count() or 1):
        for priority in (0, arguments.priority):
            for in_c in (False, True):
                run(arguments.rate, arguments.seconds, busy, priority, in_c=in_c)


if __name__ == "__main__":
    main()
