"""A soak: boards stream at 60 % load of a 1 Mbit/s bus for ten minutes, between two controllers on one wire.

    tools/bench soak [--minutes 10] [--load 0.6]       in the CAN lab: its controllers are emulated SJA1000

The driver is ``skin-driver`` on the one, listening only; the boards are frames sent at a steady rate on the other.
Every frame that was sent is received, or the receiving controller reports an overflow; the driver's memory and open
files do not grow. Ends with status 1 if that does not hold.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

from can_traffic import Sender, burst_frames

from skinware import DriverReader, Namespace

BOARDS = 7
BITS_PER_FRAME = 1.1 * (47 + 64)  # 8 bytes of payload, one stuff bit in ten bits
BIT_RATE = 1_000_000
TICK_S = 0.002
SETTLED_S = 30.0  # tables, caches and arenas are there by then
QUIET_S = 5.0
LARGEST_BURST = 20  # frames sent at once: what a late tick makes up for
ALLOWED_GROWTH_KIB = 512


class Seen(NamedTuple):
    """The driver, its controller and what was sent, at one moment."""

    sent: int
    received: int
    dropped: int
    overflows: int
    told_overflows: int
    memory_kib: int
    files: int

    def __str__(self) -> str:
        return (
            f"{self.sent:,} sent, {self.received:,} received, {self.dropped} dropped by the kernel, controller"
            f" overflowed {self.overflows} times (driver: {self.told_overflows}), {self.memory_kib:,} KiB,"
            f" {self.files} files"
        )


class Traffic:
    """Boards that stream: a thread that sends at a steady rate.

    Args:
        interface: where.
        rate_hz: frames/s.
    """

    def __init__(self, interface: str, rate_hz: float) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self._socket.bind((interface,))
        self._sender = Sender(self._socket, burst_frames(BOARDS))
        self._rate_hz = rate_hz
        self._flowing, self._stopping = threading.Event(), threading.Event()
        self._flowing.set()
        self._thread = threading.Thread(target=self._send)
        self._thread.start()

    @property
    def sent(self) -> int:
        """Frames so far."""
        return self._sender.sent

    def pause(self) -> None:
        """Send nothing until ``resume``, and wait until what was sent is received."""
        self._flowing.clear()
        time.sleep(QUIET_S)

    def resume(self) -> None:
        """Go on."""
        self._flowing.set()

    def stop(self) -> None:
        """Send no more."""
        self._stopping.set()
        self._flowing.set()
        self._thread.join()
        self._socket.close()

    def _send(self) -> None:
        due = 0.0
        before = time.monotonic()
        while not self._stopping.wait(TICK_S):
            now = time.monotonic()
            if self._flowing.is_set():
                due = min(due + (now - before) * self._rate_hz, LARGEST_BURST)  # no more is made up for at once
                self._sender.send(int(due))
                due -= int(due)
            before = now


def look(reader: DriverReader, process: subprocess.Popen[bytes], traffic: Traffic, interface: str) -> Seen:
    """What the driver and its controller have counted."""
    counters = reader.bus_counters(reader.read(newer_than=reader.read(), timeout_s=60))[0]
    shown: Any = json.loads(subprocess.check_output(["ip", "-json", "-statistics", "link", "show", interface]))
    status = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    memory_kib = next(int(line.split()[1]) for line in status if line.startswith("VmRSS:"))
    files = len(os.listdir(f"/proc/{process.pid}/fd"))
    overflows = shown[0]["stats64"]["rx"]["over_errors"]
    received, dropped, told = counters["frames"], counters["dropped"], counters["overflows"]
    return Seen(traffic.sent, received, dropped, overflows, told, memory_kib, files)


def watch(
    reader: DriverReader, driver: subprocess.Popen[bytes], traffic: Traffic, interface: str, minutes: float
) -> list[str]:
    """Watch it run; returns what is wrong."""
    time.sleep(SETTLED_S)
    traffic.pause()
    first = look(reader, driver, traffic, interface)
    print(f"after {SETTLED_S:.0f} s: {first}", flush=True)
    traffic.resume()
    began = time.monotonic()
    while (passed_s := time.monotonic() - began) < minutes * 60:
        time.sleep(min(60.0, minutes * 60 - passed_s))
        print(f"{(time.monotonic() - began) / 60:5.1f} min: {look(reader, driver, traffic, interface)}", flush=True)
    passed_s = time.monotonic() - began
    traffic.pause()
    last = look(reader, driver, traffic, interface)
    sent, received = last.sent - first.sent, last.received - first.received
    overflows = last.overflows - first.overflows
    load = sent / passed_s * BITS_PER_FRAME / BIT_RATE
    print(
        f"in {passed_s:.0f} s: {sent:,} sent ({load:.0%} load), {sent - received} not received, {overflows} overflows"
    )
    wrong = []
    if last.dropped > first.dropped:
        wrong.append(f"the kernel dropped {last.dropped - first.dropped} frames: the driver was too slow")
    if sent != received and not overflows:
        wrong.append(f"{sent - received} frames are missing, and the controller reports no overflow")
    if last.told_overflows - first.told_overflows != overflows:
        wrong.append(f"the controller overflowed {overflows} times, the driver tells {last.told_overflows}")
    if last.files > first.files:
        wrong.append(f"{last.files - first.files} more files are open")
    if last.memory_kib > first.memory_kib + ALLOWED_GROWTH_KIB:
        wrong.append(f"the driver takes {last.memory_kib - first.memory_kib} KiB more")
    return wrong


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--load", type=float, default=0.6, help="share of the wire's time")
    parser.add_argument("--receives", default="can0", help="interface of the driver")
    parser.add_argument("--sends", default="can1", help="interface of the boards")
    arguments = parser.parse_args()
    for name in (arguments.receives, arguments.sends):
        subprocess.run(["ip", "link", "set", name, "type", "can", "bitrate", str(BIT_RATE)], check=True)
        subprocess.run(["ip", "link", "set", name, "txqueuelen", "4096", "up"], check=True)
    os.environ["SKINWARE_NAMESPACE"] = f"soak-{os.getpid()}"
    traffic = Traffic(arguments.sends, arguments.load * BIT_RATE / BITS_PER_FRAME)
    command = Path(sys.executable).with_name("skin-driver")
    driver = subprocess.Popen([command, "--bus", arguments.receives, "--listen-only", "--name", "soak"])
    try:
        with DriverReader("soak", timeout_s=120) as reader:
            wrong = watch(reader, driver, traffic, arguments.receives, arguments.minutes)
    finally:
        traffic.stop()
        driver.terminate()
        driver.wait(60)
        shutil.rmtree(Namespace().path, ignore_errors=True)
    sys.exit("; ".join(wrong) or None)


if __name__ == "__main__":
    main()
