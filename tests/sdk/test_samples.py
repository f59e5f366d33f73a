"""Of the frames that a driver cannot use some are kept, and shown, at a cost that does not grow with their number."""

from __future__ import annotations

from typing import Any

import pytest

from skinware import DriverReader
from skinware.sensor_types import PRESSURE
from skinware.status import Unused, sample_report, sample_text
from skinware_drivers import counters
from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch
from skinware_drivers.can import CanAdapter
from skinware_drivers.counters import Samples
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Byte, Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.options import NoOptions
from skinware_drivers.serial.checksums import XOR
from skinware_drivers.serial.packets import Packet
from skinware_drivers.testing.waiting import run_in_its_time
from skinware_drivers.virtual.bus import VirtualSerialBus
from skinware_drivers.virtual.hand_clock import HandClock
from skinware_drivers.virtual.hardware import WireFrame
from tests.sdk.driving import TroubledBus, driving_lines, read_until


class Babbler:
    """Sends what nobody asked for."""

    def __init__(self, *frames: tuple[int, bytes]) -> None:
        self._frames = frames
        self._due_ns = 0

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        pass

    def next_due_ns(self) -> int | None:
        return self._due_ns

    def emit(self, now_ns: int) -> list[WireFrame]:
        self._due_ns = now_ns + 1_000_000
        return [WireFrame(now_ns, *frame) for frame in self._frames]

    def skip(self, now_ns: int) -> int:
        self._due_ns = now_ns
        return 0

    def totals(self) -> dict[str, int]:
        return {}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    now = [0]
    monkeypatch.setattr(counters, "now_ns", lambda: now[0])
    return now


def wire(*identifiers: int) -> Any:
    batch = FrameBatch(len(identifiers))
    for identifier in identifiers:
        batch.append(0, 0, identifier, bytes([identifier & 0xFF, 2]))
    return batch.wire


def identifiers(kept: Samples) -> list[int]:
    return [sample["identifier"] for sample in sample_report(kept.rows)]


def test_different_identifiers_are_kept_and_the_newest_of_them(clock: list[int]) -> None:
    kept = Samples()
    for number in range(5):
        clock[0] += 10**9
        kept.take(Unused.UNKNOWN, wire(0x100 + number, 0x100 + number))
    assert sorted(identifiers(kept)) == [0x102, 0x103, 0x104]


def test_however_many_come_few_are_looked_at(clock: list[int]) -> None:
    kept, looked = Samples(), 0
    for _ in range(1000):
        clock[0] += 10**6
        looked += kept.wants(Unused.UNKNOWN)
        kept.take(Unused.UNKNOWN, wire(*range(50)))
    assert looked == 4


def test_a_flood_of_one_kind_hides_no_other(clock: list[int]) -> None:
    kept = Samples()
    kept.take(Unused.UNKNOWN, wire(*range(50)))
    kept.take(Unused.BAD_LENGTH, wire(0x7))
    kept.note(Unused.REFUSED, EXTENDED_FLAG | 0x8, bytes(64))
    told = [sample_text(sample) for sample in sample_report(kept.rows)]
    assert told == ["000 [2] 00 02", "007 [2] 07 02", "00000008 [64] 00 00 00 00 00 00 00 00 ..."]


class Pad(CanAdapter[NoOptions]):
    """Frames with a beginning that is known."""

    types = (PRESSURE.measured(unit="counts"),)
    patches = (Patch("pad", [Module(taxels(1))]),)
    layout = Layout([Frame("data", [Identifier(0x473), Byte(0, 0x40)], [8], Values(1, "u1", 1))])


def test_a_running_driver_shows_them() -> None:
    """Unknown, of a wrong length, without meaning, and refused by the bus; in its frames and in what it prints."""
    babbler = Babbler((0x123, b"\1\2"), (0x473, b"\x40\1"), (0x473, b"\x11" * 8), (0x222, bytes(64)))
    bus = TroubledBus("", hardware=babbler, listen_only=True)
    with (
        driving_lines([(Pad(NoOptions()), bus)], "skin", listen_only=True) as running,
        DriverReader("skin") as reader,
    ):
        frame = read_until(reader, lambda frame: len(set(frame.bus_samples["why"][0].tolist())) == 5)
        (told,) = running.status()["buses"]
    shown = {sample["why"]: sample_text(sample) for sample in sample_report(frame.bus_samples[0])}
    assert shown == {
        "unknown": "123 [2] 01 02",
        "bad_length": "473 [2] 40 01",
        "bad_content": "473 [8] 11 11 11 11 11 11 11 11",
        "refused": "222 [64] 00 00 00 00 00 00 00 00 ...",
    }
    assert {sample["why"] for sample in told["samples"]} == set(shown)


def test_bytes_of_a_serial_line_without_a_frame() -> None:
    clock = HandClock()

    async def scenario() -> list[str]:
        babbler = Babbler((0, b"\xaa\x55garbage"))
        bus = VirtualSerialBus("babbler", payload_size=64, listen_only=True, hardware=babbler, clock=clock)
        bus.use(Packet(sync=(0xAA, 0x55), length=9, checksum=XOR))
        bus.open()
        for _ in range(4):
            clock.pass_to(clock.now_ns + 5_000_000)
            bus.receive(FrameBatch(64, 64), 0)
        bus.close()
        return [sample_text(sample) for sample in sample_report(bus.samples.rows)]

    assert run_in_its_time(clock, scenario) == ["000 [9] AA 55 67 61 72 62 61 67 ..."]
