"""Frames that C takes from serial lines into the ring while the event loop rests."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader
from skinware.sensor_types import PRESSURE
from skinware.status import BusReason, BusState, DataPath
from skinware_drivers.bus import FrameBatch
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.options import NoOptions
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.framing import Framed, Framer, Framing, ReceivedFraming
from skinware_drivers.serial.packets import Packet
from skinware_drivers.serial.stream import NativeFramer
from skinware_drivers.testing.driving import Driving, driving_lines
from skinware_drivers.testing.waiting import wait_until
from tests.serial.lines import DATA, FRAMING, N_TAXELS, Line, data_frame, line

_FEW = 4
"""Sources that flow.c asks without a look before."""


class Fingertip(SerialAdapter[NoOptions]):
    """One that sends by itself."""

    framing: Framing = FRAMING
    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    layout = Layout([Frame("taxels", [Identifier(DATA)], [2 * N_TAXELS], Values(0, "<u2", N_TAXELS))])
    patches = (Patch("tip", (Module(taxels(N_TAXELS)),)),)
    period_s = 0.01


class Bus(SerialBus):
    """Counts how often Python received."""

    received = 0

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        self.received += 1
        return super().receive(batch, ordinal)


@contextmanager
def flowing(
    *devices: Line, driver: type[Fingertip] = Fingertip, first: bytes = data_frame(1)
) -> Iterator[tuple[Driving, list[Bus]]]:
    """A driver of these, once each of them lives."""
    buses = [Bus(device.path, payload_size=64) for device in devices]
    lines: Sequence[Any] = [(driver(NoOptions()), bus) for bus in buses]
    with driving_lines(lines, "fingertip") as running:
        for device in devices:
            device.write(first)
        wait_until(lambda: all(bus["state"] == "live" for bus in running.status()["buses"]))
        yield running, buses


def value_is(reader: DriverReader, value: int) -> Any:
    """Wait for a frame with this value everywhere."""
    found = reader.read()

    def is_there() -> bool:
        nonlocal found
        found = reader.read()
        return bool((found.values == value).all())

    wait_until(is_there)
    return found


def test_frames_flow_and_python_reads_none_of_them() -> None:
    with line() as device, flowing(device) as (_, [bus]), DriverReader("fingertip") as reader:
        value_is(reader, 1)
        before, frames = bus.received, 1
        for value in range(2, 40):
            device.write(data_frame(value))
            frame = value_is(reader, value)
            frames += 1
        assert bus.received == before
        assert (frame.data_path, frame.bus_state[0]) == (DataPath.NATIVE, BusState.LIVE)
        wait_until(lambda: bus.counters.frames == frames)
        device.write(data_frame(40))
        counters = reader.bus_counters(value_is(reader, 40))[0]
        assert (counters["frames"], counters["frame_bytes"]) == (frames + 1, (frames + 1) * len(data_frame(1)))
        assert counters["bytes_in"] == counters["frame_bytes"]


def test_frames_that_come_byte_by_byte() -> None:
    with line() as device, flowing(device) as (_, [bus]), DriverReader("fingertip") as reader:
        for value in (2, 3):
            for byte in data_frame(value):
                device.write(bytes([byte]))
            value_is(reader, value)
        wait_until(lambda: bus.counters.frames == 3)


def test_what_is_damaged_is_counted_and_kept_as_a_sample() -> None:
    with line() as device, flowing(device) as (running, [bus]), DriverReader("fingertip") as reader:
        damaged = bytearray(data_frame(2))
        damaged[5] ^= 0x40
        device.write(bytes(damaged))
        wait_until(lambda: bus.counters.errors == 1)
        device.write(data_frame(3) + FRAMING.encode(2, bytes(60))[:-4] + b"\0" + data_frame(4))
        counters = reader.bus_counters(value_is(reader, 4))[0]
        assert (counters["errors"], counters["checksum_errors"]) == (2, 2) or counters["bad_form"] == 1
        [sample] = running.status()["buses"][0]["samples"]
        assert (sample["why"], sample["length"], sample["data"]) == ("refused", len(damaged), damaged[:8].hex())


def test_a_line_that_says_nothing_sensible_is_told_of() -> None:
    with line() as device, flowing(device) as (running, _):
        ending = threading.Event()

        def babble() -> None:
            while not ending.wait(0.01):
                device.write(b"\x55" * 60)

        babbler = threading.Thread(target=babble, daemon=True)
        babbler.start()
        try:
            wait_until(lambda: running.status()["buses"][0]["reason"] == BusReason.BUS_ERRORS.name.lower())
        finally:
            ending.set()
            babbler.join(30)


@pytest.mark.parametrize("count", [1, _FEW + 2])
def test_whatever_comes_at_once_is_taken_and_nothing_is_lost(count: int) -> None:
    """More than a batch holds; of few lines, and of so many that C has to ask which of them have something."""
    with ExitStack() as stack:
        devices = [stack.enter_context(line()) for _ in range(count)]
        running, buses = stack.enter_context(flowing(*devices))
        frames = b"".join(data_frame(value) for value in range(1, 2000))
        writers = [threading.Thread(target=device.write, args=(frames,), daemon=True) for device in devices]

        def begin() -> None:  # in the driver's thread: nothing is taken before all have begun
            for writer in writers:
                writer.start()

        running.do(begin)
        for writer in writers:
            writer.join(30)
        wait_until(lambda: [bus.counters.frames for bus in buses] == count * [2000])
        assert not any(bus.counters.framing.skipped_bytes for bus in buses)


def test_what_the_port_does_not_take_at_once_is_sent_while_frames_flow() -> None:
    with line() as device, flowing(device) as (running, [bus]), DriverReader("fingertip") as reader:
        question = FRAMING.encode(2, bytes(range(1, 61)))
        n = 60_000 // len(question)

        def ask() -> None:
            for _ in range(n):
                bus.send(2, bytes(range(1, 61)))

        running.do(ask)
        device.write(data_frame(2))
        value_is(reader, 2)
        got = b""
        while len(got) < n * len(question):
            got += device.read()
        assert got == n * question
        before = bus.received
        device.write(data_frame(3))
        value_is(reader, 3)
        device.write(data_frame(4))
        value_is(reader, 4)
        assert bus.received <= before + 1  # C has it back


def test_it_is_unplugged_while_frames_flow() -> None:
    with line() as device, flowing(device) as (running, _):
        device.unplug()
        wait_until(lambda: running.status()["buses"][0]["state"] == "gone")


class OfItsOwn(ReceivedFraming):
    """What a package outside may write."""

    maximum_body = 2 * N_TAXELS

    def framer(self) -> Framer:
        return Shouting(Packet(sync=b"\xa5", length=1 + 2 * N_TAXELS, confirmed="each"))


class Shouting(NativeFramer):
    """Whose values are ten more than were sent."""

    def feed(self, chunk: bytes) -> list[Framed]:
        return [Framed(f.identifier, bytes(b + 10 for b in f.body), f.end) for f in super().feed(chunk)]


class Loud(Fingertip):
    framing = OfItsOwn()
    layout = Layout([Frame("taxels", [], [2 * N_TAXELS], Values(0, "u1", N_TAXELS))])


def test_a_framing_that_only_python_knows_stays_in_python() -> None:
    frames = 2 * (b"\xa5" + bytes(2 * N_TAXELS))
    with (
        line() as device,
        flowing(device, driver=Loud, first=frames) as (_, [bus]),
        DriverReader("fingertip") as reader,
    ):
        before = bus.received
        assert value_is(reader, 10).data_path == DataPath.PYTHON
        device.write(frames)
        wait_until(lambda: bus.counters.frames == 3)
        assert bus.received > before
