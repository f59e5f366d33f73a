"""CAN: what receiving costs and loses; many buses into one writer buffer; a whole skin; what cost grows with.

    tools/bench can [receive] [buses] [skin] [scaling]     default: all four

The buses are stand-ins (see can_traffic.py); the driver is the product, its event loop and ring included. A column
"cpu" is processor time of the receiving process against wall time: 100 % is one core. With a busy thread in the
process it says nothing, and is left out.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from skinware import DriverReader, Namespace
from skinware.errors import ServiceTimeout

HERE = Path(__file__).parent
KINDS = ("ours", "recv", "notifier", "socket")
NAMES = {"ours": "driver", "recv": "python-can recv", "notifier": "python-can Notifier", "socket": "socket.recv"}
GRACE_S = 10.0  # for what is received after the last frame was sent
SPAWN = multiprocessing.get_context("spawn")


class Result(NamedTuple):
    """One run."""

    sent: int
    received: int
    counted_lost: int
    cpu: float
    us_per_frame: float

    @property
    def lost_percent(self) -> float:
        """Of what was sent."""
        return 100 * (self.sent - self.received) / max(1, self.sent)


def run(
    kind: str, rate_hz: float, seconds: float, busy: bool, n_buses: int, n_boards: int, latency_ms: float = 5.0
) -> Result:
    """Send to a receiver, one of ``KINDS`` or a program of the same form, and ask it what it got."""
    command = [sys.executable, HERE / "can_receivers.py", kind, "busy" if busy else "idle"] if kind in KINDS else [kind]
    settings = map(str, (n_buses, n_boards, latency_ms, seconds + GRACE_S))
    receiver = subprocess.Popen([*command, *settings], stdout=subprocess.PIPE, text=True)
    assert receiver.stdout is not None
    ports = receiver.stdout.readline().split()
    time.sleep(1.0)  # the driver builds its tables
    sent = subprocess.run(
        [sys.executable, HERE / "can_traffic.py", str(rate_hz), str(seconds), str(n_boards), *ports],
        capture_output=True,
        text=True,
        check=True,
    )
    result = json.loads(receiver.stdout.readline())
    receiver.wait(30)
    total, received = sum(json.loads(sent.stdout)), sum(result["frames"])
    cpu = result["cpu_s"] / max(result["wall_s"], 1e-9)
    return Result(total, received, result["lost"], cpu, result["cpu_s"] / max(1, received) * 1e6)


def compare_receivers(arguments: argparse.Namespace) -> None:
    """Loss and cost of every way to receive."""
    print("\nreceive: one bus, loss in % of what was sent; us of processor time a frame\n")
    print(f"{'':22}" + "".join(f"{rate / 1e3:>8.0f} k/s{'':9}" for rate in arguments.rates) + "  busy thread:")
    for kind in KINDS:
        row = f"{NAMES[kind]:22}"
        for busy in (False, True):
            for rate in arguments.rates:
                results = [run(kind, rate, arguments.seconds, busy, 1, 7) for _ in range(arguments.rounds)]
                lost = statistics.median(result.lost_percent for result in results)
                cost = "" if busy else f"{statistics.median(r.us_per_frame for r in results):6.2f} us"
                row += f"{lost:7.2f} %{cost:>11}" if not busy else f"{lost:9.2f} %"
        print(row, flush=True)


def many_buses(arguments: argparse.Namespace) -> None:
    """Thirty buses into one writer buffer."""
    print("\nbuses: 30 buses x 8,000 frames/s (14 boards each) into one writer buffer")
    for latency_ms in [5.0, 20.0] * arguments.rounds:
        result = run("ours", 8000, arguments.seconds, False, 30, 14, latency_ms)
        print(
            f"  --latency {latency_ms:2.0f}: {result.sent:,} sent, {result.sent - result.received} lost"
            f" ({result.counted_lost} counted), cpu {100 * result.cpu:.0f} %, {result.us_per_frame:.2f} us/frame",
            flush=True,
        )


def read_ages(namespace: str, ages: Any) -> None:
    """A reader: age of each frame when it has it, ms."""
    with DriverReader("bench", namespace=Namespace(namespace), timeout_s=30) as reader:
        last = first = newest_ns = taken = 0
        found: list[float] = []
        try:
            for frame in reader.samples(timeout_s=2.5):
                taken += 1
                if frame.acquired_ns > newest_ns:  # others tell that boards went silent
                    found.append((time.monotonic_ns() - frame.acquired_ns) / 1e6)
                    newest_ns = frame.acquired_ns
                first, last = first or frame.sequence, frame.sequence
        except ServiceTimeout:
            pass
    ages.put((found[5:-3], last - first + 1, taken))


def whole_skin(arguments: argparse.Namespace) -> None:
    """A square metre of skin, from the wire to two readers."""
    boards, buses = 14, 12
    sensors = boards * buses * 192
    print(f"\nskin: {sensors:,} sensors ({buses} buses x {boards} boards x 16 x 12) into two readers")
    for hz in (20, 50):
        ages: Any = SPAWN.Queue()
        readers = [SPAWN.Process(target=read_ages, args=(os.environ["SKINWARE_NAMESPACE"], ages)) for _ in range(2)]
        for reader in readers:
            reader.start()
        result = run("ours", boards * 32 * hz, arguments.seconds, False, buses, boards)
        found = [ages.get(timeout=60) for _ in readers]
        for reader in readers:
            reader.join()
        every = np.concatenate([age for age, _, _ in found])
        there, got = (sum(counts) for counts in zip(*((a, b) for _, a, b in found), strict=True))
        print(
            f"  {hz} Hz: {result.sent:,} frames, {result.sent - result.received} lost, cpu {100 * result.cpu:.0f} %,"
            f" {result.us_per_frame:.2f} us/frame; readers got {got} of {there},"
            f" age median {np.median(every):.1f} ms, p99 {np.percentile(every, 99):.1f} ms",
            flush=True,
        )


def scaling(arguments: argparse.Namespace) -> None:
    """What cost grows with."""
    print("\nscaling: boards at 20 Hz; cpu, and us of processor time a frame")
    for buses in (1, 4, 12, 30):
        for boards in (1, 7, 14):
            result = run("ours", boards * 32 * 20, arguments.seconds, False, buses, boards)
            print(
                f"  {buses:2} buses x {boards:2} boards = {buses * boards * 192:6,} sensors,"
                f" {buses * boards * 640:8,} frames/s: cpu {100 * result.cpu:5.1f} %, {result.us_per_frame:5.2f}"
                f" us/frame, {result.sent - result.received} lost",
                flush=True,
            )


PARTS = {"receive": compare_receivers, "buses": many_buses, "skin": whole_skin, "scaling": scaling}


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="default: all")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long each run sends")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--rates", type=int, nargs="+", default=[8000, 50000, 200000], help="frames/s of one bus")
    arguments = parser.parse_args()
    os.environ["SKINWARE_NAMESPACE"] = f"bench-{os.getpid()}"
    try:
        for part in arguments.parts or PARTS:
            PARTS[part](arguments)
    finally:
        shutil.rmtree(Namespace().path, ignore_errors=True)


if __name__ == "__main__":
    main()
