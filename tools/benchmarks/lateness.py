"""How late a periodic loop wakes up: a plain sleep loop, and ``Periodic`` without and with real-time profiles.

Each loop runs in a process of its own, at 100 and 1000 Hz, on a machine that is left alone and on one with a normal
process on every CPU that computes without pause. All take turns, for several rounds. Lateness is the time from the
deadline to the loop's first instruction after it; the plain loop (``time.sleep(period)``) has no deadlines, so there it
is the time slept beyond the period, and what that adds up to is its drift.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from skinware.errors import RealtimeRefused
from skinware.realtime import NS_PER_S, Periodic, Profile, now_ns

RATES_HZ = (100, 1000)
LOADS = ("idle", "busy")
LOOPS = ("time.sleep", "Periodic", "Periodic, normal", "Periodic, fifo")
FIFO_PRIORITY = 50


class Sample(NamedTuple):
    """One run of one loop."""

    late_ns: list[int]
    """Lateness of every wake-up."""
    missed: int
    """Periods that passed unused."""
    drift_ns: int
    """How far the last wake-up was from where the first deadline and the count of periods put it."""


def sleep_loop(rate_hz: float, seconds: float) -> Sample:
    """What one writes without thinking."""
    period_s = 1 / rate_hz
    late_ns: list[int] = []
    begin_ns = now_ns()
    for _ in range(round(rate_hz * seconds)):
        before_ns = now_ns()
        time.sleep(period_s)
        late_ns.append(now_ns() - before_ns - round(period_s * NS_PER_S))
    return Sample(late_ns, 0, now_ns() - begin_ns - round(len(late_ns) * period_s * NS_PER_S))


def periodic_loop(rate_hz: float, seconds: float) -> Sample:
    """Absolute deadlines."""
    late_ns: list[int] = []
    timer = Periodic(rate_hz)
    begin_ns = timer.deadline_ns - timer.period_ns
    while len(late_ns) + timer.missed < rate_hz * seconds:
        deadline_ns = timer.deadline_ns
        timer.wait()
        late_ns.append(now_ns() - deadline_ns)
    return Sample(late_ns, timer.missed, now_ns() - begin_ns - (len(late_ns) + timer.missed) * timer.period_ns)


def measure_here(loop: str, rate_hz: float, seconds: float) -> None:
    """Run one loop in this process and print the sample; what is refused is told and ends it."""
    profile = {"Periodic, normal": Profile.normal(), "Periodic, fifo": Profile.fifo(FIFO_PRIORITY)}.get(loop)
    if profile is not None:
        try:
            profile.apply(strict=True)
        except RealtimeRefused as error:
            sys.exit(str(error))
    run = sleep_loop if loop == "time.sleep" else periodic_loop
    run(rate_hz, 0.1)  # what the first periods touch for the first time is not what a long run is like
    print(json.dumps(run(rate_hz, seconds)))


def measure(loop: str, rate_hz: float, seconds: float) -> Sample | None:
    """Run one loop in a process of its own; None if its profile is refused, which is told."""
    arguments = [sys.executable, __file__, "--loop", loop, "--rate", str(rate_hz), "--seconds", str(seconds)]
    done = subprocess.run(arguments, capture_output=True, text=True)
    if done.returncode != 0:
        print(f"{loop}: {done.stderr.strip()}", file=sys.stderr)
        return None
    return Sample(*json.loads(done.stdout))


@contextmanager
def load(kind: str) -> Iterator[None]:
    """Competition for every CPU, or none."""
    count = len(os.sched_getaffinity(0)) if kind == "busy" else 0
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def print_table(samples: dict[tuple[str, int, str], list[Sample]], seconds: float) -> None:
    """A row for each load, rate and loop, over all rounds."""
    print(
        "\n| load | rate | loop | median | p99 | p99.9 | max | missed | drift |\n|---|---|---|---|---|---|---|---|---|"
    )
    for (kind, rate_hz, loop), rounds in samples.items():
        late_us = np.concatenate([sample.late_ns for sample in rounds]) / 1e3
        median, p99, p999 = np.percentile(late_us, (50, 99, 99.9))
        missed = sum(sample.missed for sample in rounds)
        drift_ms = np.median([sample.drift_ns for sample in rounds]) / 1e6 / seconds
        print(
            f"| {kind} | {rate_hz} Hz | {loop} | {median:.0f} | {p99:.0f} | {p999:.0f} | {late_us.max():.0f}"
            f" | {missed} of {missed + len(late_us)} | {drift_ms:.2f} |"
        )
    print("\nLateness in us, drift in ms per second (median of the rounds).")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=4.0, help="length of one loop's turn")
    parser.add_argument("--loop", choices=LOOPS, help=argparse.SUPPRESS)
    parser.add_argument("--rate", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.loop:
        measure_here(arguments.loop, arguments.rate, arguments.seconds)
        return
    kernel = os.uname()
    print(f"{len(os.sched_getaffinity(0))} CPUs, Linux {kernel.release} {kernel.version}", flush=True)
    samples: dict[tuple[str, int, str], list[Sample]] = defaultdict(list)
    for number in range(arguments.rounds):
        for kind in LOADS:
            with load(kind):
                for rate_hz in RATES_HZ:
                    for loop in LOOPS:
                        if (sample := measure(loop, rate_hz, arguments.seconds)) is not None:
                            samples[kind, rate_hz, loop].append(sample)
        print(f"round {number + 1} of {arguments.rounds} done, load average {os.getloadavg()[0]:.1f}", flush=True)
    print_table(samples, arguments.seconds)


if __name__ == "__main__":
    main()
