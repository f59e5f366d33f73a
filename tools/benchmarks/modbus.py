"""A hand of 1062 taxels behind a pymodbus server: our driver, pymodbus' own client, and a bare loop, in turns.

    tools/bench modbus [tcp] [rtu] [--turnaround-us US] [--seconds 3] [--rounds 3] [--one-processor]

The taxels are read in 9 reads of at most 125 registers, as fast as the server answers. The bare loop sends a question
and waits for as many bytes as its reply has, without looking at them: what the server's turnaround allows. ``rtu`` is a
line of two pseudo terminals, opened at 921,600 baud, with a process between them that carries the bytes; a pseudo
terminal knows no baud rate. On it, the driver and the bare loop are silent for 3.5 characters before each question
(42 us), or for as long as is said; the bare loop counts that time busily, and so takes more processor time. A line per
way: hands a second and processor time per read, medians of the rounds, and what they are of the bare loop and of
pymodbus' client. Processor time of our driver includes decoding and publishing; it runs as with ``--realtime normal``.

Who sends to a process that sleeps on another processor wakes that processor, in its own processor time; in a virtual
machine that takes longer than all else. With ``--one-processor``, all have one, and nobody wakes another.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import multiprocessing
import os
import select
import signal
import socket
import statistics
import sys
import time
import tty
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from skinware import Namespace
from skinware.realtime import Profile
from skinware.sensor_types import PRESSURE
from skinware_drivers import Module, NoOptions, Patch, taxels
from skinware_drivers.modbus import ModbusAdapter, Registers, wire
from skinware_drivers.registry import make_bus
from skinware_drivers.running.generation import FlowLoop
from skinware_drivers.running.runner import Runner

PARTS = ("tcp", "rtu")
FIRST, N_TAXELS, BAUDRATE = 3000, 1062, 921_600
SILENCE_US = 3.5 * 11 / BAUDRATE * 1e6
READS = [(FIRST + at, min(125, N_TAXELS - at)) for at in range(0, N_TAXELS, 125)]
_WARM_S = 0.7
_FORK = multiprocessing.get_context("fork")
Result = tuple[float, float]
"""Hands a second, processor time per read in us."""


class Hand(ModbusAdapter[NoOptions]):
    """All taxels of one unit."""

    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    patches = (Patch("hand", [Module(taxels(N_TAXELS))]),)
    registers = (Registers(FIRST, N_TAXELS),)
    period_s = 0.0002  # shorter than any server takes for a hand
    timeout_s = 0.5


def serve(where: str) -> None:
    """A pymodbus server, until it is killed."""
    from pymodbus import FramerType
    from pymodbus.server import ModbusSerialServer, ModbusTcpServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    async def run() -> None:
        data = SimData(FIRST, values=[value % 4096 for value in range(N_TAXELS)], datatype=DataType.REGISTERS)
        hand = SimDevice(id=1, simdata=[data])
        server: Any
        if where.startswith("/"):
            server = ModbusSerialServer([hand], framer=FramerType.RTU, port=where, baudrate=BAUDRATE)
        else:
            server = ModbusTcpServer([hand], address=("127.0.0.1", int(where)))
        await server.serve_forever()

    asyncio.run(run())


def carry(one: int, other: int) -> None:
    """What is between two pseudo terminals, until it is killed."""
    to = {one: other, other: one}
    while True:
        for fd in select.select([one, other], [], [])[0]:
            os.write(to[fd], os.read(fd, 4096))


def ask_barely(where: str, seconds: float, silence_us: float) -> Result:
    """The bare loop."""
    is_line = where.startswith("/")
    with contextlib.ExitStack() as stack:
        if is_line:
            fd = os.open(where, os.O_RDWR | os.O_NOCTTY)
            stack.callback(os.close, fd)
            tty.setraw(fd)
        else:
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", int(where))))
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            fd = connection.fileno()
        questions = []
        for number, (address, count) in enumerate(READS):
            message = wire.Message(1, wire.question_to_read(3, address, count), number)
            around = 5 if is_line else 9
            questions.append((wire.rtu_frame(message) if is_line else wire.tcp_frame(message), around + 2 * count))

        silence_ns = round(1000 * silence_us) if is_line else 0

        def read_hand() -> None:
            for question, size in questions:
                os.write(fd, question)
                while size > 0:
                    size -= len(os.read(fd, 4096))
                if silence_ns:
                    end_ns = time.monotonic_ns() + silence_ns
                    while time.monotonic_ns() < end_ns:
                        pass

        return _measured(read_hand, seconds)


def ask_by_pymodbus(where: str, seconds: float, _silence_us: float) -> Result:
    """Its synchronous client, the faster of its two."""
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient

    client: Any
    if where.startswith("/"):
        client = ModbusSerialClient(where, baudrate=BAUDRATE)
    else:
        client = ModbusTcpClient("127.0.0.1", port=int(where))
    client.connect()

    def read_hand() -> None:
        for address, count in READS:
            assert len(client.read_holding_registers(address, count=count, device_id=1).registers) == count

    try:
        return _measured(read_hand, seconds)
    finally:
        client.close()


def ask_by_async_pymodbus(where: str, seconds: float, _silence_us: float) -> Result:
    """Its client for asyncio."""
    from pymodbus import FramerType
    from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient

    async def run() -> Result:
        client: Any
        if where.startswith("/"):
            client = AsyncModbusSerialClient(where, framer=FramerType.RTU, baudrate=BAUDRATE)
        else:
            client = AsyncModbusTcpClient("127.0.0.1", port=int(where))
        await client.connect()

        async def read_hand() -> None:
            for address, count in READS:
                answer = await client.read_holding_registers(address, count=count, device_id=1)
                assert len(answer.registers) == count

        end = time.monotonic() + _WARM_S
        while time.monotonic() < end:
            await read_hand()
        hands, cpu, begun = 0, time.process_time(), time.monotonic()
        while (now := time.monotonic()) < begun + seconds:
            await read_hand()
            hands += 1
        client.close()
        return hands / (now - begun), 1e6 * (time.process_time() - cpu) / (hands * len(READS))

    return asyncio.run(run())


def ask_by_driver(where: str, seconds: float, silence_us: float) -> Result:
    """Our driver, from the question to the published frame."""
    name = f"modbus:tcp://127.0.0.1:{where}"
    if where.startswith("/"):
        name = f"modbus:{where}?baudrate={BAUDRATE}&turnaround_ms={silence_us / 1000}"
    Profile.normal().apply()
    adapter = Hand(NoOptions())
    bus = make_bus(name, payload_size=adapter.payload_size)
    namespace = Namespace(f"bench-modbus-{os.getpid()}")
    found: list[Result] = []

    async def run() -> None:
        runner = Runner("hand", [("bus", adapter, bus)], name="hand", namespace=namespace)
        task = asyncio.create_task(runner.run())
        await asyncio.sleep(_WARM_S)
        sent, published, cpu, begun = _count(bus, runner)
        await asyncio.sleep(seconds)
        sent_then, published_then, cpu_then, now = _count(bus, runner)
        assert not bus.counters.polls_unanswered
        runner.stop()
        await task
        found.append(((published_then - published) / (now - begun), 1e6 * (cpu_then - cpu) / (sent_then - sent)))

    try:
        with asyncio.Runner(loop_factory=FlowLoop) as loop:
            loop.run(run())
    finally:
        for file in namespace.path.rglob("*"):
            if file.is_file():
                file.unlink()
        for folder in sorted(namespace.path.rglob("*"), reverse=True):
            folder.rmdir()
        namespace.path.rmdir()
    return found[0]


def _count(bus: Any, runner: Runner) -> tuple[int, int, float, float]:
    [patch] = runner.status()["patches"]
    return bus.counters.sent, patch["updates"], time.process_time(), time.monotonic()


def _measured(read_hand: Callable[[], None], seconds: float) -> Result:
    end = time.monotonic() + _WARM_S
    while time.monotonic() < end:
        read_hand()
    hands, cpu, begun = 0, time.process_time(), time.monotonic()
    while (now := time.monotonic()) < begun + seconds:
        read_hand()
        hands += 1
    return hands / (now - begun), 1e6 * (time.process_time() - cpu) / (hands * len(READS))


WAYS = {
    "bare loop": ask_barely,
    "pymodbus": ask_by_pymodbus,
    "pymodbus, asyncio": ask_by_async_pymodbus,
    "driver": ask_by_driver,
}


@contextlib.contextmanager
def hand(part: str) -> Iterator[str]:
    """A server; yields the port, or the path of its line."""
    with contextlib.ExitStack() as stack:
        where = there = ""
        if part == "tcp":
            with socket.create_server(("127.0.0.1", 0)) as probe:
                where = there = str(probe.getsockname()[1])
        else:
            ends = [os.openpty(), os.openpty()]
            for fd in (fd for end in ends for fd in end):
                tty.setraw(fd)
                stack.callback(os.close, fd)
            stack.enter_context(_process(carry, ends[0][0], ends[1][0]))
            where, there = (os.ttyname(slave) for _, slave in ends)
        stack.enter_context(_process(serve, there))
        time.sleep(2)  # it imports, and tells nobody when it is ready
        yield where


@contextlib.contextmanager
def _process(work: Callable[..., None], *arguments: Any) -> Iterator[None]:
    process = _FORK.Process(target=work, args=arguments)
    process.start()
    try:
        yield
    finally:
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()


def _report(pipe: Connection, way: str, *how: Any) -> None:
    pipe.send(WAYS[way](*how))


def measure(way: str, *how: Any) -> Result:
    """One way, in a process of its own."""
    mine, theirs = _FORK.Pipe()
    process = _FORK.Process(target=_report, args=(theirs, way, *how))
    process.start()
    theirs.close()
    try:
        result: Result = mine.recv()
    finally:
        process.join()
    return result


def main() -> None:
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)  # it tells of every connection that ends
    logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL + 1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="which wires; default: both")
    parser.add_argument("--seconds", type=float, default=3.0, help="of each way in each round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--turnaround-us", type=float, default=SILENCE_US, help="silence before a question on a line")
    parser.add_argument("--one-processor", action="store_true", help="server, wire and clients share one")
    given = parser.parse_args()
    if given.one_processor:
        os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
    for part in given.parts or PARTS:
        with hand(part) as where:
            found: dict[str, list[Result]] = {way: [] for way in WAYS}
            for _ in range(given.rounds):
                for way, results in found.items():
                    results.append(measure(way, where, given.seconds, given.turnaround_us))
        print(f"{part}: {N_TAXELS} taxels in {len(READS)} reads")
        for way, results in found.items():
            rate = statistics.median(one[0] for one in results)
            cpu = statistics.median(one[1] for one in results)
            of_bare = statistics.median(one[0] / bare[0] for one, bare in zip(results, found["bare loop"], strict=True))
            of_other = statistics.median(
                one[1] / other[1] for one, other in zip(results, found["pymodbus"], strict=True)
            )
            print(
                f"  {way:17} {rate:7.1f} hands/s, {of_bare:.2f} of the bare loop;"
                f" {cpu:6.1f} us of processor a read, {of_other:.2f} of pymodbus"
            )


if __name__ == "__main__":
    main()
