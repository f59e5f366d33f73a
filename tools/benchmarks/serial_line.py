"""Serial lines: framing, checksum and decoding, in memory and through a pseudo terminal; the driver beside C.

    tools/bench serial [memory] [pty] [rest]     default: all three

The wire is that of a patch of 100 modules with 12 taxels each: COBS, the number of the module, 24 bytes of uint16
values, CRC-16/XMODEM; 3 Mbaud carry 100 of its cycles a second. Beside ours, in the same rounds: a state machine that
takes one byte after the other, and pyserial's ``read_until``.

A pseudo terminal knows no baud rate: 3 Mbaud (0.3 MB/s) is paced by the writer, a process of its own that writes once
a millisecond.
"""

from __future__ import annotations

import argparse
import asyncio
import binascii
import contextlib
import multiprocessing
import os
import select
import statistics
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import serial

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from skinware import Namespace
from skinware.sensor_types import PRESSURE
from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters
from skinware_drivers.description import Module, Patch, assemble, taxels
from skinware_drivers.fields import Bits
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.options import NoOptions
from skinware_drivers.running.generation import FlowLoop
from skinware_drivers.running.runner import Runner
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.stream import Stream, stream_of
from tests.serial.framings import EXAMPLES
from tests.specification.decoding import SpecifiedDecoder

PARTS = ("memory", "pty", "rest")
NAME = "cobs_crc"
FRAMING = EXAMPLES[NAME].framing
BODY = 24
MODULES = 100
LAYOUT = Layout([Frame("taxels", [], [BODY], Values(0, "<u2", BODY // 2), module=Bits(0, 8))])
PATCH = Patch("skin", [Module(taxels(12, first_uid=12 * module), key=module) for module in range(MODULES)])
PACED_B_S = 300_000
SIZES = {
    "cobs_crc": 24,
    "weiss_wts": 24,
    "fixed_crc32": 34,
    "slip_sum": 24,
    "ability_hand": 24,
    "lines": 80,
    "wuji": 3082,
    "cobs_long": 3000,
}


class Skin(SerialAdapter[NoOptions]):
    """The device."""

    framing = FRAMING
    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    layout = LAYOUT
    patches = (PATCH,)
    period_s = 0.01


def frames_of(name: str, total: int) -> tuple[bytes, int]:
    """A stream of about so many bytes, and the number of its frames."""
    random = np.random.default_rng(3)
    example, size = EXAMPLES[name], 0
    frames: list[bytes] = []
    while size < total:
        body = b"123," * (SIZES[name] // 4) if name == "lines" else random.bytes(SIZES[name])
        identifier = len(frames) % MODULES if name == NAME else example.identifiers[0]
        frames.append(example.framing.encode(identifier, body))
        size += len(frames[-1])
    return b"".join(frames), len(frames)


# In memory


def fed(stream: Stream, data: bytes, chunk: int, batch: FrameBatch, empty: Callable[[], None]) -> Iterator[int]:
    """The bytes into a stream, and its frames into the emptied batch: how many, again and again."""
    for start in range(0, len(data), chunk):
        stream.add(data[start : start + chunk], start)
        while stream.is_behind:
            empty()
            yield stream.fill(batch, 0)


def ours(name: str, stream: bytes, chunk: int) -> int:
    """Frames found and copied into rows of a batch."""
    framing = EXAMPLES[name].framing
    size = -(-framing.maximum_body // 8) * 8
    batch = FrameBatch(1 + min(chunk, len(stream)) // 16, size)
    return sum(fed(stream_of(framing, size, BusCounters()), stream, chunk, batch, batch.clear))


def ours_decoded(stream: bytes, chunk: int) -> int:
    """Frames found, decoded and shown."""
    decoder, batch, found = make_decoder(), FrameBatch(chunk // 16, 64), 0
    for count in fed(stream_of(FRAMING, 64, BusCounters()), stream, chunk, batch, lambda: decoder.put_back(batch)):
        decoder.state.show(decoder.decode(batch)[0])
        found += count
    return found


def make_decoder() -> SpecifiedDecoder:
    """Of one patch."""
    return SpecifiedDecoder([LAYOUT], assemble([("line", [PATCH])], Skin.types, np.uint16))


class ByteMachine:
    """A decoder of the wire as drivers have it: one byte after the other."""

    def __init__(self) -> None:
        self.body = bytearray()
        self.left = 0
        self.code = 0
        self.frames = 0
        self.stamp = bytearray(8)

    def take(self, byte: int) -> None:
        """Take one byte."""
        if byte == 0:
            body = self.body
            if self.left == 0 and len(body) > 2 and binascii.crc_hqx(body[:-2], 0) == body[-2] | body[-1] << 8:
                self.frames += 1
                self.stamp = body[1:9]
            body.clear()
            self.left = self.code = 0
        elif self.left == 0:
            if self.code and self.code < 0xFF:
                self.body.append(0)
            self.code = byte
            self.left = byte - 1
        else:
            self.body.append(byte)
            self.left -= 1

    def feed(self, chunk: bytes) -> None:
        """Take many."""
        for byte in chunk:
            self.take(byte)


def byte_machine(stream: bytes, _chunk: int) -> int:
    """Frames that the machine finds."""
    machine = ByteMachine()
    machine.feed(stream)
    return machine.frames


def timed(action: Callable[[], int], expected: int) -> float:
    """Seconds that it takes to find all frames."""
    begin = time.perf_counter()
    found = action()
    passed = time.perf_counter() - begin
    assert expected - 1 <= found <= expected, (found, expected)
    return passed


def in_memory(rounds: int) -> None:
    """MB/s and microseconds a frame, of every framing."""
    print("in memory, chunks of 64 KiB   MB/s   us/frame")
    stream, n = frames_of(NAME, 1 << 21)
    few, n_few = frames_of(NAME, 1 << 17)
    rows: list[tuple[str, bytes, int, Callable[[], int]]] = [
        (f"{name}, {SIZES[name]} B", part, count, lambda name=name, part=part: ours(name, part, 65536))  # type: ignore[misc]
        for name in SIZES
        for part, count in [frames_of(name, 1 << 21)]
    ]
    rows += [
        (f"{NAME} and decoded", stream, n, lambda: ours_decoded(stream, 65536)),
        (f"{NAME}, chunks of 300 B", few, n_few, lambda: ours(NAME, few, 300)),
        (f"{NAME}, byte by byte", few, n_few, lambda: byte_machine(few, 0)),
    ]
    times: list[list[float]] = [[] for _ in rows]
    for _ in range(rounds):
        for (_, _, count, action), passed in zip(rows, times, strict=True):
            passed.append(timed(action, count))
    for (what, part, count, _), passed in zip(rows, times, strict=True):
        middle = statistics.median(passed)
        print(f"  {what:26} {len(part) / middle / 1e6:7.1f}   {middle / count * 1e6:8.3f}")


# Through a pseudo terminal


@contextlib.contextmanager
def line(write: Callable[[int], None]) -> Iterator[str]:
    """A port that a process of its own writes to."""
    master, slave = os.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    process = multiprocessing.get_context("fork").Process(target=write, args=(master,), daemon=True)
    process.start()
    try:
        yield path
    finally:
        process.terminate()
        process.join()
        os.close(master)
        os.close(slave)


def flat_out(stream: bytes) -> Callable[[int], None]:
    """Write as fast as it goes, indefinitely."""

    def write(fd: int) -> None:
        while True:
            os.write(fd, stream[: len(stream)])

    return write


def paced(bytes_per_s: int) -> Callable[[int], None]:
    """Write whole frames once a millisecond, with the time of writing in each."""

    def write(fd: int) -> None:
        begin = due = time.monotonic()
        sent, number = 0, 0
        while True:
            due += 0.001
            time.sleep(max(0, due - time.monotonic()))
            data = b""
            while not data or sent + len(data) < (due - begin) * bytes_per_s:
                stamp = time.monotonic_ns().to_bytes(8, "little")
                data += FRAMING.encode(number % MODULES, stamp.ljust(BODY, b"\1"))
                number += 1
            os.write(fd, data)
            sent += len(data)

    return write


Reader = Callable[[str, float, list[int]], int]
"""Reads a port for a time; notes the ages of frames in ns; gives the number of bytes of good frames."""


def read_ours(path: str, seconds: float, ages_ns: list[int]) -> int:
    """The bus and the decoder in an epoll loop, which never rests."""
    bus, decoder, batch = SerialBus(path, payload_size=64), make_decoder(), FrameBatch(4096, 64)
    bus.use(FRAMING)
    bus.open()
    epoll = select.epoll()
    epoll.register(bus.fileno(), select.EPOLLIN)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if not epoll.poll(0.1):
            continue
        decoder.put_back(batch)
        if bus.receive(batch, 0):
            decoder.state.show(decoder.decode(batch)[0])
            stamp = batch.wire["payload"][batch.stop - 1, :8].tobytes()
            ages_ns.append(time.monotonic_ns() - int.from_bytes(stamp, "little"))
    epoll.close()
    bus.close()
    return int(bus.counters.framing.frame_bytes)


def read_driver(path: str, seconds: float, _ages_ns: list[int]) -> int:
    """The whole driver: it decodes and publishes."""
    bus = SerialBus(path, payload_size=64)

    async def run() -> None:
        runner = Runner("bench", [(path, Skin(NoOptions()), bus)], name="bench", namespace=namespace)
        asyncio.get_running_loop().call_later(seconds, runner.stop)
        await runner.run()

    namespace = Namespace(f"bench-{os.getpid()}")
    try:
        with asyncio.Runner(loop_factory=FlowLoop) as loop:
            loop.run(run())
    finally:
        import shutil

        shutil.rmtree(namespace.path, ignore_errors=True)
    return int(bus.counters.framing.frame_bytes)


def read_until(path: str, seconds: float, ages_ns: list[int]) -> int:
    """pyserial's ``read_until`` and the decoding of one frame in plain Python."""
    port = serial.Serial(path, 3_000_000, timeout=0.1)
    good, end = 0, time.monotonic() + seconds
    while time.monotonic() < end:
        frame = port.read_until(b"\0")
        machine = ByteMachine()
        machine.feed(frame)
        if machine.frames:
            good += len(frame)
            ages_ns.append(time.monotonic_ns() - int.from_bytes(machine.stamp, "little"))
    port.close()
    return good


def read_polling(path: str, seconds: float, ages_ns: list[int]) -> int:
    """What many drivers do: ask for what is there, sleep a millisecond, take byte after byte."""
    port = serial.Serial(path, 3_000_000, timeout=0)
    machine, good, end = ByteMachine(), 0, time.monotonic() + seconds
    while time.monotonic() < end:
        data = port.read(port.in_waiting or 1)
        if not data:
            time.sleep(0.001)
            continue
        before = machine.frames
        machine.feed(data)
        if machine.frames > before:
            good += (machine.frames - before) * 29
            ages_ns.append(time.monotonic_ns() - int.from_bytes(machine.stamp, "little"))
    port.close()
    return good


READERS: dict[str, Reader] = {
    "ours": read_ours,
    "the whole driver": read_driver,
    "read(in_waiting), 1 ms": read_polling,
    "read_until": read_until,
}


def run_reader(reader: Reader, path: str, seconds: float) -> tuple[float, float, list[int]]:
    """MB/s of good frames, percent of a core, and ages."""
    ages_ns: list[int] = []
    cpu, begin = time.process_time(), time.monotonic()
    good = reader(path, seconds, ages_ns)
    passed = time.monotonic() - begin
    return good / passed / 1e6, 100 * (time.process_time() - cpu) / passed, ages_ns


def through_pty(rounds: int, seconds: float) -> None:
    """Throughput, processor time at 3 Mbaud, and latency."""
    stream, _ = frames_of(NAME, 1 << 16)
    for title, write in (
        ("through a pty, flat out", flat_out(stream)),
        ("paced at 3 Mbaud (0.3 MB/s)", paced(PACED_B_S)),
        ("one frame a millisecond", paced(1)),
    ):
        print(f"{title:30} MB/s  CPU %   age median, p99 us")
        results: dict[str, list[tuple[float, float, list[int]]]] = {name: [] for name in READERS}
        for _ in range(rounds):
            for name, reader in READERS.items():
                with line(write) as path:
                    results[name].append(run_reader(reader, path, seconds))
        for name, parts in results.items():
            rate, cpu = statistics.median(p[0] for p in parts), statistics.median(p[1] for p in parts)
            ages = sorted(age for part in parts for age in part[2][20:])
            age = f"{ages[len(ages) // 2] / 1e3:8.0f} {ages[len(ages) * 99 // 100] / 1e3:8.0f}" if ages else ""
            print(f"  {name:26} {rate:6.3f}  {cpu:5.1f}   {age if 'flat' not in title else ''}")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="default: all")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="for each reader and round")
    parser.add_argument("--latency", type=float, default=5.0, metavar="MS", help="of rest: how long both do")
    arguments = parser.parse_args()
    assert threading.active_count() == 1  # writers are forked
    parts = arguments.parts or PARTS
    if "memory" in parts:
        in_memory(arguments.rounds)
    if "pty" in parts:
        through_pty(arguments.rounds, arguments.seconds)
    if "rest" in parts:
        import serial_rest  # which imports this module

        serial_rest.compare(arguments.rounds, arguments.seconds, arguments.latency)


if __name__ == "__main__":
    main()
