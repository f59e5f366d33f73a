"""Receive and decode, through a socket, into values, status and module times of a real ring: frames/s on one core.

The socket is UDP on the loopback, which shares receive buffer, time stamps and drop counter with CAN sockets in the
kernel: its datagrams are ``struct can_frame``. The frames are those of 7 boards x 16 triangles, their bursts
interleaved, with 1 % lost halves, wrong lengths and foreign identifiers. Both paths drain the same frames in turns:

* ours: ``SocketCanBus.receive``, ``Decoder``, ``Publisher`` into a ``DriverWriter``;
* python-can: its ``Notifier`` with a listener that decodes each frame into the same kind of arrays.

python-can runs its own socketcan interface, whose socket alone is replaced. Both get the frames in portions of a few
cycles and are timed while they drain them: a long queue in the kernel would measure its cache misses.
"""

from __future__ import annotations

import argparse
import os
import random
import socket
import statistics
import struct
import threading
import time

import can
import numpy as np
from can.interfaces.socketcan import SocketcanBus

from skinware import DriverReader, DriverWriter, Namespace
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.roboskin import RoboskinDriver, RoboskinOptions
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.description import assemble
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS, ALL_PATCH_COUNTERS, Publisher

BOARDS = range(7, 14)
CAN_FRAME = struct.Struct("=IB3x8s")
SO_TIMESTAMPNS = 35
PORTION = 2016  # 9 cycles


def make_frames(cycles: int, seed: int = 1) -> list[bytes]:
    """Interleaved bursts with faults, as raw ``struct can_frame``."""
    rng = random.Random(seed)
    frames = []
    for cycle in range(cycles):
        for triangle in range(16):
            for header, tail in ((0x40, b""), (0xC0, b"\0\0")):
                for board in BOARDS:
                    fate = rng.random()
                    values = bytes([cycle % 256]) * (7 - len(tail))
                    payload = bytes([header]) + values + tail
                    identifier = 0x400 | board << 4 | triangle
                    if fate < 0.01:
                        continue
                    if fate < 0.012:
                        payload = payload[:3]
                    if fate > 0.99:
                        frames.append(CAN_FRAME.pack(0x523, 8, bytes(8)))
                    frames.append(CAN_FRAME.pack(identifier, len(payload), payload))
    return frames


class Ours:
    """The product's path, from socket to ring."""

    def __init__(self, namespace: Namespace, sock: socket.socket) -> None:
        self.bus = SocketCanBus("bench")
        self.bus.adopt(sock)
        driver = RoboskinDriver(RoboskinOptions())
        patches = driver.patches_set_up(BOARDS)
        tables = assemble([("bench", patches)], driver.types, driver.dtype)
        self.decoder = Decoder([driver.layout], tables)
        self.writer = DriverWriter(
            "bench",
            tables.structure,
            namespace=namespace,
            bus_counters=ALL_BUS_COUNTERS,
            patch_counters=ALL_PATCH_COUNTERS,
        )
        self.publisher = Publisher(self.writer, self.decoder, driver.watch(tables), driver.period_s, driver.by_cycle)
        self.publisher.bus_counters = [self.bus.counters]
        self.batch = FrameBatch(2048, 8, self.decoder.headroom)

    def drain(self) -> int:
        """Take and decode everything that waits; returns the number of frames."""
        total = 0
        while True:
            self.decoder.put_back(self.batch)
            while self.batch.free and (count := self.bus.receive(self.batch, 0)):
                total += count
            if len(self.batch) == self.batch.headroom - self.batch.start:
                return total
            found, foreign = self.decoder.decode(self.batch)
            self.decoder.count_unknown(self.batch, foreign)
            self.publisher.take(found)

    def close(self) -> None:
        """Take the service back."""
        self.writer.close()
        self.bus.close()


class SocketBus(SocketcanBus):
    """python-can's socketcan interface on another datagram socket."""

    def __init__(self, sock: socket.socket) -> None:
        self.socket = sock
        self.channel = "bench"
        self._is_filtered = False
        self._bcm_sockets = {}
        self._can_protocol = can.CanProtocol.CAN_20
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        can.BusABC.__init__(self, channel="bench")

    def _apply_filters(self, filters: object) -> None:
        """A datagram socket has none."""


class PerFrame(can.Listener):
    """What a driver on python-can does: a dictionary, a pairing rule, a numpy slice a frame."""

    def __init__(self) -> None:
        self.expected = 0
        self.done = threading.Event()
        self.values = np.zeros((len(BOARDS) * 16, 12), np.uint8)
        self.status = np.ones(len(BOARDS) * 16, np.uint8)
        self.times = np.zeros(len(BOARDS) * 16)
        self.module = {0x400 | b << 4 | t: (b - 7) * 16 + t for b in BOARDS for t in range(16)}
        self.before: dict[int, can.Message] = {}
        self.count = 0

    def on_message_received(self, msg: can.Message) -> None:
        """Decode one frame."""
        self.count += 1
        if self.count == self.expected:
            self.done.set()
        module = self.module.get(msg.arbitration_id)
        if module is None:
            return
        board = msg.arbitration_id >> 4
        head, self.before[board] = self.before.get(board), msg
        if msg.dlc != 8 or msg.data[0] != 0xC0 or head is None or head.arbitration_id != msg.arbitration_id:
            return
        if head.dlc == 8 and head.data[0] == 0x40 and msg.timestamp - head.timestamp < 0.025:
            row = self.values[module]
            row[:7] = head.data[1:8]
            row[7:] = msg.data[1:6]
            self.status[module] = msg.data[6] | msg.data[7]
            self.times[module] = head.timestamp


def sockets() -> tuple[socket.socket, socket.socket]:
    """A connected pair of UDP sockets on the loopback."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    try:
        receiver.setsockopt(socket.SOL_SOCKET, 33, 32 << 20)  # SO_RCVBUFFORCE
    except PermissionError:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect(receiver.getsockname())
    return sender, receiver


def portions(frames: list[bytes]) -> list[list[bytes]]:
    """The frames, some cycles at a time."""
    return [frames[i : i + PORTION] for i in range(0, len(frames), PORTION)]


def measure_ours(frames: list[bytes], namespace: Namespace) -> tuple[float, int]:
    """Seconds per frame, and frames lost."""
    sender, receiver = sockets()
    path = Ours(namespace, receiver)
    time.sleep(0.1)  # the kernel begins to stamp in the background
    taken, passed = 0, 0.0
    for portion in portions(frames):
        for frame in portion:
            sender.send(frame)
        begin = time.perf_counter()
        taken += path.drain()
        passed += time.perf_counter() - begin
    with DriverReader("bench", namespace=namespace) as reader:
        values = reader.read().values.reshape(-1, 12)
        assert (values.min(axis=1) == values.max(axis=1)).all()
    path.close()
    sender.close()
    return passed / taken, len(frames) - taken - path.bus.counters.refused


def measure_python_can(frames: list[bytes]) -> tuple[float, int]:
    """Seconds per frame through a Notifier, and frames lost."""
    sender, receiver = sockets()
    bus, listener = SocketBus(receiver), PerFrame()
    passed = 0.0
    for portion in portions(frames):
        for frame in portion:
            sender.send(frame)
        listener.expected += len(portion)
        listener.done.clear()
        begin = time.perf_counter()
        notifier = can.Notifier(bus, [listener], timeout=0.01)
        listener.done.wait(30)
        passed += time.perf_counter() - begin
        notifier.stop()
    bus.shutdown()
    sender.close()
    return passed / max(1, listener.count), len(frames) - listener.count


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--cycles", type=int, default=100, help="bursts of all boards in a round")
    arguments = parser.parse_args()
    namespace = Namespace(f"bench-{os.getpid()}")
    frames = make_frames(arguments.cycles)
    few = frames[: max(1, len(frames) // 4)]
    print(f"{len(frames)} frames of {len(BOARDS)} boards x 16 triangles, {arguments.rounds} rounds")
    ratios: list[float] = []
    rows: list[tuple[float, float]] = []
    try:
        for _ in range(arguments.rounds):
            ours, ours_lost = measure_ours(frames, namespace)
            theirs, theirs_lost = measure_python_can(few)
            rows.append((ours, theirs))
            ratios.append(theirs / ours)
            print(
                f"  ours {ours * 1e6:.3f} us/frame ({1 / ours:,.0f} frames/s, {ours_lost} lost)"
                f"   python-can Notifier {theirs * 1e6:.2f} us/frame ({theirs_lost} lost)   ratio {ratios[-1]:.1f}"
            )
    finally:
        remove(namespace)
    ours, theirs = (statistics.median(column) for column in zip(*rows, strict=True))
    print(f"median: ours {1 / ours:,.0f} frames/s, python-can {1 / theirs:,.0f}, ratio {statistics.median(ratios):.1f}")


def remove(namespace: Namespace) -> None:
    """The bench's own namespace."""
    import shutil

    shutil.rmtree(namespace.path, ignore_errors=True)


if __name__ == "__main__":
    main()
