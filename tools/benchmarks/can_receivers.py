"""Receivers of the CAN benchmark: ``can_receivers.py KIND BUSY BUSES BOARDS LATENCY_MS SECONDS``, each a process.

Prints the ports that it listens on, a line; then, when nothing has come for a while, or so many seconds after the first
frame, what it received, as JSON: who is that far behind has lost the rest.
``busy`` adds a thread that computes in pure Python all the time, as a control loop in the same process would.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import select
import socket
import sys
import threading
import time
from collections.abc import Sequence

import can
from decode import SocketBus, sockets

from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.counters import BusCounters
from skinware_drivers.description import Patch
from skinware_drivers.link import Link
from skinware_drivers.running.generation import FlowLoop
from skinware_drivers.running.runner import Runner

QUIET_S = 2.5
LOOK_S = 1.0  # seldom: what it costs is measured with the rest
NOTED_EVERY = 64


class LoopbackBus(SocketCanBus):
    """A UDP port that is received from as a CAN interface is."""

    def __init__(self) -> None:
        super().__init__("loopback")
        sender, self.receiver = sockets()
        sender.close()

    def open(self) -> None:
        """There is nothing to look for."""
        self.adopt(self.receiver)

    def send(self, identifier: int, payload: bytes) -> None:
        """Nobody listens."""


class StreamingBoards(RoboskinDriver):
    """Boards that are known and stream already."""

    n_boards = 14

    async def describe(self, link: Link) -> Sequence[Patch]:  # noqa: ARG002
        """All of them."""
        return self.patches_set_up(range(1, 1 + self.n_boards))

    async def configure(self, link: Link) -> None:
        """Nothing to do."""

    async def start(self, link: Link) -> None:
        """Nothing to do."""

    async def stop(self, link: Link) -> None:
        """Nothing to do."""


def spin() -> None:
    """A control loop that never rests."""
    number = 0
    while True:
        number += 1


class Measured:
    """Processor time from the first frame on."""

    def __init__(self, longest_s: float) -> None:
        self.began: tuple[float, float] | None = None
        self.ended = (0.0, 0.0)
        self._longest_s = longest_s

    @property
    def is_over(self) -> bool:
        """Whether the time is over."""
        return self.began is not None and time.monotonic() - self.began[0] > self._longest_s

    def note(self) -> None:
        """Called as frames come."""
        now = (time.monotonic(), time.process_time())
        self.began = self.began or now
        self.ended = now

    def report(self, frames: Sequence[int], lost: int) -> None:
        """Print the result."""
        wall_s, cpu_s = (b - a for a, b in zip(self.began or self.ended, self.ended, strict=True))
        print(json.dumps({"frames": list(frames), "lost": lost, "wall_s": wall_s, "cpu_s": cpu_s}), flush=True)


def driver(n_buses: int, n_boards: int, latency_ms: float, measured: Measured) -> None:
    """The product: a driver with one writer buffer over all buses."""
    StreamingBoards.n_boards = n_boards
    buses = [LoopbackBus() for _ in range(n_buses)]
    options = RoboskinOptions()
    lines = [(f"bus{i}", StreamingBoards(options), bus) for i, bus in enumerate(buses)]
    runner = Runner("roboskin", lines, name="bench", latency_s=latency_ms / 1e3)
    print(*[bus.receiver.getsockname()[1] for bus in buses], flush=True)

    def frames() -> int:
        return sum(bus.counters.frames for bus in buses)

    async def run() -> None:
        running = asyncio.create_task(runner.run())
        last, since = 0, time.monotonic()
        while not (running.done() or measured.is_over) and (not last or time.monotonic() - since < QUIET_S):
            await asyncio.sleep(LOOK_S)
            if frames() != last:
                last, since = frames(), time.monotonic()
                measured.note()
        runner.stop()
        await running

    with asyncio.Runner(loop_factory=FlowLoop) as loop:
        loop.run(run())
    counters: list[BusCounters] = [bus.counters for bus in buses]
    measured.report([c.frames for c in counters], sum(c.dropped for c in counters))


def one_by_one(kind: str, measured: Measured) -> None:
    """python-can, by ``recv`` or Notifier, and the plain socket."""
    sender, receiver = sockets()
    sender.close()
    print(receiver.getsockname()[1], flush=True)
    frames = 0
    if kind == "socket":
        receiver.setblocking(True)
        while not measured.is_over and select.select([receiver], [], [], QUIET_S if frames else None)[0]:
            with contextlib.suppress(BlockingIOError):
                while frames % NOTED_EVERY or not measured.is_over:
                    receiver.recv(16, socket.MSG_DONTWAIT)
                    frames += 1
                    if frames % NOTED_EVERY == 1:
                        measured.note()
            measured.note()
        measured.report([frames], 0)
        return
    bus = SocketBus(receiver)
    if kind == "recv":
        while (frames % NOTED_EVERY or not measured.is_over) and bus.recv(QUIET_S if frames else None) is not None:
            frames += 1
            if frames % NOTED_EVERY == 1:
                measured.note()
        measured.report([frames], 0)
        bus.shutdown()
        return

    class Counting(can.Listener):
        count = 0

        def on_message_received(self, msg: can.Message) -> None:  # noqa: ARG002
            self.count += 1

    listener = Counting()
    notifier = can.Notifier(bus, [listener])
    last, since = 0, time.monotonic()
    while not measured.is_over and (not last or time.monotonic() - since < QUIET_S):
        time.sleep(0.05)
        if listener.count != last:
            last, since = listener.count, time.monotonic()
            measured.note()
    measured.report([listener.count], 0)
    notifier.stop()
    bus.shutdown()


def main() -> None:
    """Entry point."""
    kind, busy, n_buses, n_boards = sys.argv[1], sys.argv[2] == "busy", int(sys.argv[3]), int(sys.argv[4])
    latency_ms, measured = float(sys.argv[5]), Measured(float(sys.argv[6]))
    logging.disable()  # boards begin and end
    if busy:
        threading.Thread(target=spin, daemon=True).start()
    if kind == "ours":
        driver(n_buses, n_boards, latency_ms, measured)
    else:
        one_by_one(kind, measured)
    sys.stdout.flush()
    os._exit(0)  # a busy thread does not end


if __name__ == "__main__":
    main()
