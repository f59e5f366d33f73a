"""What a driver on a line of 3 Mbaud costs: beside the least that a C program could do, in turns.

The wire and the skin are those of serial_line.py; its ``main`` calls ``compare``. The driver is the product, its event
loop and ring included. The C loop (serial_loop.c) reads the same bytes from the same kind of port, takes the stuffing
out, looks up whose they are and copies their values; it compares no checksum, publishes nothing, and rests as long as
the driver may. Run as a program it is the driver: ``serial_rest.py PATH LATENCY_MS SECONDS``.
"""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import tty
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from can_receivers import LOOK_S, QUIET_S, Measured
from rest import compile_program
from serial_line import NAME, PACED_B_S, Skin, frames_of

from skinware import Namespace
from skinware_drivers.options import NoOptions
from skinware_drivers.running.generation import FlowLoop
from skinware_drivers.running.runner import Runner
from skinware_drivers.serial.bus import SerialBus

TICK_S = 0.001
GRACE_S = 10.0


def write_paced(fd: int, seconds: float) -> int:
    """Send so many seconds of what 3 Mbaud carry, once a millisecond; how many frames that were."""
    stream, n_frames = frames_of(NAME, 1 << 16)
    begin, due, sent = time.monotonic(), 0.0, 0
    total = round(seconds * PACED_B_S / len(stream)) * len(stream)
    while sent < total:
        wanted = min(total, round((time.monotonic() - begin) * PACED_B_S))
        while sent < wanted:
            at = sent % len(stream)
            try:
                sent += os.write(fd, stream[at : at + wanted - sent])
            except BlockingIOError:  # the receiver is behind: more next time
                break
        due += TICK_S
        time.sleep(max(0.0, due - (time.monotonic() - begin)))
    return total // len(stream) * n_frames


def run(command: Sequence[str | Path], latency_ms: float, seconds: float) -> tuple[int, dict[str, Any]]:
    """Frames sent to a receiver, and what it says."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    settings = os.ttyname(slave), str(latency_ms), str(seconds + GRACE_S)
    receiver = subprocess.Popen([*command, *settings], stdout=subprocess.PIPE, text=True)
    try:
        assert receiver.stdout is not None
        receiver.stdout.readline()
        time.sleep(1.0)  # the driver builds its tables
        sent = write_paced(master, seconds)
        result = json.loads(receiver.stdout.readline())
        receiver.wait(30)
    finally:
        receiver.kill()
        os.close(master)
        os.close(slave)
    return sent, result


def compare(rounds: int, seconds: float, latency_ms: float) -> None:
    """Driver and C loop in turns; the last line has the medians."""
    print(f"\nthe whole driver at 3 Mbaud ({PACED_B_S / 1e6} MB/s), the longest rest {latency_ms:g} ms", flush=True)
    os.environ["SKINWARE_NAMESPACE"] = f"bench-{os.getpid()}"
    shares: dict[str, list[float]] = {"driver": [], "C loop": []}
    with tempfile.TemporaryDirectory() as folder:
        commands: list[list[str | Path]] = [[sys.executable, __file__], [compile_program("serial_loop", folder)]]
        try:
            for _ in range(rounds):
                for name, command in zip(shares, commands, strict=True):
                    sent, result = run(command, latency_ms, seconds)
                    shares[name].append(100 * result["cpu_s"] / result["wall_s"])
                    print(
                        f"{name}: {sent:,} frames sent, {sent - sum(result['frames'])} lost,"
                        f" {shares[name][-1]:.2f} % of a core",
                        flush=True,
                    )
        finally:
            shutil.rmtree(Namespace().path, ignore_errors=True)
    driver, c_loop = map(statistics.median, shares.values())
    ratio = statistics.median(a / b for a, b in zip(*shares.values(), strict=True))
    print(f"driver {driver:.2f} % of a core, C loop {c_loop:.2f} %, ratio {ratio:.2f}")


async def drive(bus: SerialBus, latency_ms: float, measured: Measured) -> None:
    """The product on a line, until nothing comes any more."""
    runner = Runner("bench", [("line", Skin(NoOptions()), bus)], name="bench", latency_s=latency_ms / 1e3)
    running = asyncio.create_task(runner.run())
    last, since = 0, time.monotonic()
    while not (running.done() or measured.is_over) and (not last or time.monotonic() - since < QUIET_S):
        await asyncio.sleep(LOOK_S)
        if bus.counters.frames != last:
            last, since = bus.counters.frames, time.monotonic()
            measured.note()
    runner.stop()
    await running


def main() -> None:
    """The driver, in a process of its own."""
    path, latency_ms, seconds = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
    bus, measured = SerialBus(path, payload_size=Skin(NoOptions()).payload_size), Measured(seconds)
    print("ready", flush=True)
    with asyncio.Runner(loop_factory=FlowLoop) as loop:
        loop.run(drive(bus, latency_ms, measured))
    measured.report([bus.counters.frames], bus.counters.dropped)


if __name__ == "__main__":
    main()
