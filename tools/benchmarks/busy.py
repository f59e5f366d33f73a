"""What a reader at 1 kHz loses beside a Python thread that computes, in the same process.

A writer publishes a frame of 64 values a millisecond into a ring of 8 slots, and a reader in another process takes
every frame, in order. In turns: alone; beside a thread that does nothing but compute; and beside it with the
interpreter's turns of 5 ms that Python has by itself, which loops over frames shorten to 0.1 ms while they run.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import threading
from multiprocessing.connection import Connection

import numpy as np
from processes import Processes, answer, own_namespace

from skinware import Namespace, ServiceReader, ServiceWriter
from skinware.realtime import NS_PER_S, now_ns

WAYS = {"alone": False, "beside a busy thread": True, "beside it, turns of 5 ms": True}
_PYTHONS_TURN_S = 0.005
_RATE_HZ = 1000
_OVER = 1


def write(pipe: Connection, namespace: Namespace, slots: int, seconds: float) -> None:
    """Publish at 1 kHz until the time is over; the last frame says so."""
    with ServiceWriter("busy", {"values": (np.int64, 64)}, namespace=namespace, slots=slots) as writer:
        pipe.send("ready")
        pipe.recv()
        end_ns = now_ns() + round(seconds * NS_PER_S)
        for columns in writer.periodic(_RATE_HZ):
            columns["values"][:] = now_ns() < end_ns
            if not columns["values"][0]:
                break
        writer.begin()
        writer.commit(now_ns(), _OVER)
        pipe.send((writer.sequence, writer.missed_periods))
        pipe.recv()


def read(pipe: Connection, namespace: Namespace, way: str) -> None:
    """Take every frame, and tell how many, how many were lost, and their ages in ns."""
    ages_ns: list[int] = []
    with ServiceReader("busy", namespace=namespace, timeout_s=20) as reader:
        if WAYS[way]:
            threading.Thread(target=_compute, daemon=True).start()
        pipe.send("ready")
        for frame in reader.in_order(timeout_s=20):
            if not ages_ns and way.endswith("5 ms"):
                sys.setswitchinterval(_PYTHONS_TURN_S)
            if frame.flags == _OVER:
                break
            ages_ns.append(now_ns() - frame.acquired_ns)
        pipe.send((len(ages_ns), reader.missed, ages_ns))


def _compute() -> None:
    number = 0
    while True:
        number += 1


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=4.0, help="each run")
    parser.add_argument("--slots", type=int, default=8)
    arguments = parser.parse_args()
    runs: dict[str, list[tuple[int, int, float, float]]] = {way: [] for way in WAYS}
    for _ in range(arguments.rounds):
        for way, figures in runs.items():
            with own_namespace() as namespace, Processes() as processes:
                writer = processes.start(write, namespace, arguments.slots, arguments.seconds)
                answer(writer, 20)
                reader = processes.start(read, namespace, way)
                answer(reader, 20)
                writer.send("go")
                answer(writer, 60 + arguments.seconds)
                taken, lost, ages_ns = answer(reader, 60)
                ages_us = np.array(ages_ns) / 1e3
                figures.append((taken, lost, float(np.median(ages_us)), float(np.percentile(ages_us, 99))))
                writer.send("end")
    print(f"a ring of {arguments.slots} slots, 1 kHz, {arguments.rounds} rounds of {arguments.seconds:g} s\n")
    print("| a reader | frames | lost | age, median / p99, µs |\n|---|---|---|---|")
    for way, figures in runs.items():
        taken, lost = sum(run[0] for run in figures), sum(run[1] for run in figures)
        median, p99 = (statistics.median(run[column] for run in figures) for column in (2, 3))
        print(f"| {way} | {taken + lost} | {lost} | {median:.0f} / {p99:.0f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
