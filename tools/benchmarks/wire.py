"""What it costs a driver that what goes over its wire is recorded: processor time of its thread, in turns.

A CAN bus of so many frames a second, of which the driver knows all (datagrams of the loopback stand in for CAN), read
in C and in Python, while nobody asks for the wire, and while ``skin-record --wire`` does.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from skinware import Namespace
from skinware_drivers.bus import FrameBatch
from skinware_drivers.native.structs import Source
from skinware_drivers.options import NoOptions
from skinware_drivers.testing.driving import Driving, driving_lines
from skinware_drivers.testing.waiting import wait_until
from tests.can.rig import TIP_IDENTIFIER, Tip
from tests.sdk.cable import Cable
from tests.sdk.test_flow import EndOfCable

_BURST_S = 0.005


class _ForPython(EndOfCable):
    def hand_over(self, batch: FrameBatch, source: Source) -> bool:  # noqa: ARG002
        return False


@contextmanager
def _sending(out: socket.socket, rate_hz: float) -> Iterator[None]:
    """Another process that sends."""
    child = os.fork()
    if not child:
        frame = struct.pack("=IB3x8s", TIP_IDENTIFIER, 8, b"ABCDEFGH")
        due_s = time.monotonic()
        while True:
            for _ in range(round(rate_hz * _BURST_S)):
                out.send(frame)
            due_s += _BURST_S
            time.sleep(max(0.0, due_s - time.monotonic()))
    try:
        yield
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _load(driver: Driving, duration_s: float) -> float:
    """Percent of a core that the driver's thread takes."""
    clock = time.pthread_getcpuclockid(driver._thread.ident or 0)
    before_s, begin_s = time.clock_gettime(clock), time.monotonic()
    time.sleep(duration_s)
    return 100 * (time.clock_gettime(clock) - before_s) / (time.monotonic() - begin_s)


def _measure(kind: type[EndOfCable], rate_hz: float, turns: int, duration_s: float) -> None:
    folder = Path(tempfile.mkdtemp())
    cable = Cable()
    bus = kind(cable.end)
    loads: dict[str, list[float]] = {"nobody asks": [], "recorded": []}
    lost = size = 0
    with driving_lines([(Tip(NoOptions()), bus)], "tip", wait=False) as driver, _sending(cable.out, rate_hz):
        driver.wait()
        for turn in range(turns):
            wait_until(lambda: not bus.tap.is_open)
            loads["nobody asks"].append(_load(driver, duration_s))
            file = folder / f"{turn}.mcap"
            command = [str(Path(sys.executable).with_name("skin-record")), "--wire", "-o", str(file)]
            with subprocess.Popen(command, stdout=subprocess.DEVNULL) as recorder:
                wait_until(lambda: bus.tap.is_open)
                before = bus.counters.frames
                loads["recorded"].append(_load(driver, duration_s))
                frames = bus.counters.frames - before
                lost += bus.tap.missed
                recorder.send_signal(signal.SIGINT)
            size += file.stat().st_size
    cable.close()
    shutil.rmtree(folder)
    figures = "  ".join(f"{name} {statistics.median(values):.2f} %" for name, values in loads.items())
    way = "Python" if kind is _ForPython else "C"
    per_frame = size / turns / (frames or 1)
    print(f"{rate_hz:6.0f} frames/s, {way:6}: {figures} of a core; about {per_frame:.1f} bytes a frame; {lost} lost")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--duration", type=float, default=3.0, metavar="S")
    arguments = parser.parse_args()
    os.environ["SKINWARE_NAMESPACE"] = f"wire-{os.getpid()}"
    try:
        for rate_hz in (1000, 8000):
            for kind in (EndOfCable, _ForPython):
                _measure(kind, rate_hz, arguments.turns, arguments.duration)
    finally:
        shutil.rmtree(Namespace().path, ignore_errors=True)


if __name__ == "__main__":
    main()
