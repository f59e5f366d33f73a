"""Receive and decode, through a socket, into values, status and module times of a real ring: frames/s on one core.

The socket is UDP on the loopback, which shares receive buffer, time stamps and drop counter with CAN sockets in the
kernel: its datagrams are ``struct can_frame``. The frames are those of 7 boards x 16 triangles, their bursts
interleaved, with 1 % lost halves, wrong lengths and foreign identifiers. All drain the same frames in turns:

* native: the compiled path from the socket into the ring of a ``DriverWriter``;
* numpy: ``SocketCanBus.receive``, ``SpecifiedDecoder``, ``Publisher`` into such a ring;
* kernel: ``recvmmsg`` alone, with time stamps: nobody can be faster;
* python-can: its ``Notifier`` with a listener that decodes each frame into the same kind of arrays.

python-can runs its own socketcan interface, whose socket alone is replaced. Both get the frames in portions of a few
cycles and are timed while they drain them: a long queue in the kernel would measure its cache misses.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import random
import select
import socket
import statistics
import struct
import threading
import time

import can
import numpy as np
from can.interfaces.socketcan import SocketcanBus

from skinware import DriverReader, DriverWriter, Namespace
from skinware_drivers import native
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.can.socketcan import SocketCanBus
from skinware_drivers.decoding.decoder import PATCH_COUNTERS
from skinware_drivers.description import assemble
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch
from skinware_drivers.running.native_path import NativePath
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS
from tests.specification.decoding import SpecifiedDecoder
from tests.specification.publishing import SpecifiedPublisher

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


class Numpy:
    """The specification in numpy, from socket to ring."""

    def __init__(self, namespace: Namespace, sock: socket.socket) -> None:
        self.bus = SocketCanBus("bench")
        self.bus.adopt(sock)
        driver = RoboskinDriver(RoboskinOptions())
        patches = driver.patches_set_up(BOARDS)
        tables = assemble([("bench", patches)], driver.types, driver.dtype)
        self.decoder = SpecifiedDecoder([driver.layout], tables)
        self.writer = DriverWriter(
            "bench",
            tables.structure,
            namespace=namespace,
            bus_counters=ALL_BUS_COUNTERS,
            patch_counters=PATCH_COUNTERS,
        )
        self.publisher = SpecifiedPublisher(
            self.writer, self.decoder, driver.watch(tables), driver.period_s, driver.by_cycle
        )
        self.publisher.buses.counters = [self.bus.counters]
        self.batch = FrameBatch(2048, 8, self.decoder.compiled.headroom)

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


class Native(Numpy):
    """The product's compiled path, from socket to ring."""

    def __init__(self, namespace: Namespace, sock: socket.socket) -> None:
        super().__init__(namespace, sock)
        self.path, self.epoll = NativePath(self.decoder, self.publisher, self.batch), select.epoll()
        self.epoll.register(sock, select.EPOLLIN)
        self.source = (structs.Source * 1)()
        self.flow = structs.Flow(epoll_fd=self.epoll.fileno(), loop_fd=-1, until_ns=1 << 62, n_sources=1)
        self.flow.sources = ctypes.addressof(self.source)

    def drain(self) -> int:
        """Take, decode and publish everything that waits, which one call does; returns the number of frames."""
        source = self.source[0]
        if not self.bus.hand_over(self.batch, source):
            raise SystemExit("decode: the socket is not read natively")
        self.flow.rest_until_ns = 0
        self.path._words.must_leave = True
        self.path.run(self.flow)
        return int(self.bus._can.frames)

    def close(self) -> None:
        """Take the service back."""
        self.epoll.close()
        super().close()


class Kernel:
    """The least: receive, with time stamps."""

    def __init__(self, _namespace: Namespace, sock: socket.socket) -> None:
        self.bus = SocketCanBus("bench")
        self.bus.adopt(sock)
        self.source, self.rows = structs.Source(), compile_batch(FrameBatch(2048), structs.Arrays())
        self.bus.hand_over(FrameBatch(0), self.source)

    def drain(self) -> int:
        """Receive everything that waits; returns the number of frames."""
        total, receive = 0, native.library().quick.skinware_can_receive
        while (count := receive(ctypes.byref(self.source), ctypes.byref(self.rows))) > 0:
            total += count
        return total

    def close(self) -> None:
        """Close the socket."""
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


def measure(kind: type[Numpy | Kernel], frames: list[bytes], namespace: Namespace) -> tuple[float, int]:
    """Seconds per frame, and frames lost."""
    sender, receiver = sockets()
    path = kind(namespace, receiver)
    time.sleep(0.1)  # the kernel begins to stamp in the background
    taken, passed = 0, 0.0
    for portion in portions(frames):
        for frame in portion:
            sender.send(frame)
        begin = time.perf_counter()
        taken += path.drain()
        passed += time.perf_counter() - begin
    if isinstance(path, Numpy):
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
    kinds: dict[str, type[Numpy | Kernel]] = {"native": Native, "numpy": Numpy, "kernel": Kernel}
    found: dict[str, list[float]] = {name: [] for name in (*kinds, "python-can")}
    try:
        for _ in range(arguments.rounds):
            row = {name: measure(kind, frames, namespace) for name, kind in kinds.items()}
            row["python-can"] = measure_python_can(few)
            for name, (seconds, _) in row.items():
                found[name].append(seconds)
            print("  " + "   ".join(f"{name} {1e6 * s:.3f} us/frame ({lost} lost)" for name, (s, lost) in row.items()))
    finally:
        remove(namespace)
    for name, taken in found.items():
        of_kernel = statistics.median(k / s for k, s in zip(found["kernel"], taken, strict=True))
        times = statistics.median(p / s for p, s in zip(found["python-can"], taken, strict=True))
        rate = f"{1 / statistics.median(taken):>11,.0f} frames/s"
        print(f"{name:>10}: {rate}, {100 * of_kernel:.0f} % of the kernel's rate, {times:.1f} times python-can")


def remove(namespace: Namespace) -> None:
    """The bench's own namespace."""
    import shutil

    shutil.rmtree(namespace.path, ignore_errors=True)


if __name__ == "__main__":
    main()
