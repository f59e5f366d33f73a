"""Warnings before something is lost, and when something was: once each, and only when true."""

from __future__ import annotations

import ctypes
import logging
from pathlib import Path

import pytest

from skinware import DriverReader
from skinware.status import LOAD_FILTERED, LOAD_UNKNOWN, load_report
from skinware_drivers import native
from skinware_drivers.bus import EXTENDED_FLAG, Bus, FrameBatch
from skinware_drivers.native import structs
from skinware_drivers.native.compiling import compile_batch
from skinware_drivers.running.news import HIGH_FILL, HIGH_LOAD, BusLimits, MachineLimits
from tests.sdk.clock import Clock
from tests.sdk.driving import driving, emulated, read_until


@pytest.fixture
def watched() -> tuple[Bus, BusLimits, Clock]:
    bus, clock = emulated(boards=(7,)), Clock()
    bus.bit_rate = 1_000_000
    return bus, BusLimits("can0", bus, clock), clock


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


def test_a_bus_within_its_limits_is_not_worth_a_word(
    watched: tuple[Bus, BusLimits, Clock], caplog: pytest.LogCaptureFixture
) -> None:
    bus, limits, clock = watched
    for _ in range(100):
        bus.wire_bits += round(1_000_000 * HIGH_LOAD)
        bus.fullest = HIGH_FILL
        clock.pass_s(1)
        limits.look()
    assert limits.load == pytest.approx(HIGH_LOAD)
    assert warnings(caplog) == []


def test_each_limit_is_told_once(watched: tuple[Bus, BusLimits, Clock], caplog: pytest.LogCaptureFixture) -> None:
    bus, limits, clock = watched
    with caplog.at_level(logging.WARNING):
        for _ in range(10):
            bus.wire_bits += 2 * 910_000
            bus.fullest = 0.7
            bus.counters.dropped += 3
            clock.pass_s(2)
            limits.look()
            limits.look()  # within the same second: nothing new
    load, fill, lost = warnings(caplog)
    assert load.startswith("bus can0: about 91% of its time is in use")
    assert load_report(limits.permille) == {"load": 0.91, "load_unknown": None}
    assert fill.startswith("bus can0: the receive buffer was 70% full")
    assert lost.startswith("bus can0: 3 frames dropped")
    assert bus.fullest == 0.0


def test_where_the_bit_rate_is_not_known_no_load_is_made_up(
    watched: tuple[Bus, BusLimits, Clock], caplog: pytest.LogCaptureFixture
) -> None:
    bus, limits, clock = watched
    bus.bit_rate = 0
    bus.wire_bits = 10**9
    clock.pass_s(1)
    limits.look()
    assert limits.load is None
    assert load_report(limits.permille) == {"load": None, "load_unknown": "bit_rate"}
    assert warnings(caplog) == []


def test_of_a_bus_with_filters_the_load_is_not_known(watched: tuple[Bus, BusLimits, Clock]) -> None:
    bus, limits, clock = watched
    bus.bit_rate, bus.narrows = 0, True
    clock.pass_s(1)
    limits.look()
    assert load_report(limits.permille) == {"load": None, "load_unknown": "filter"}


def test_every_reader_sees_the_load() -> None:
    filtered, busy = emulated(boards=(7,)), emulated(boards=(8,))
    filtered.narrows, filtered.bit_rate = True, 0  # as a bus that leaves frames out
    with driving(filtered, busy), DriverReader("roboskin") as reader:
        assert LOAD_UNKNOWN != LOAD_FILTERED
        read_until(reader, lambda f: f.bus_load[0] == LOAD_FILTERED and 60 <= f.bus_load[1] <= 90)
    # 32 frames of 130 bits every 50 ms are 83 thousandths of 1 Mbit/s; the machine may be busy


def wire_bits(batch: FrameBatch, rows: slice = slice(None), speed_up: float = 1.0) -> float:
    first, stop, _ = rows.indices(batch.stop)
    can = structs.CanSocket(is_counted=True, speed_up=speed_up)
    at = [ctypes.c_int64(number) for number in (first, stop - first)]
    native.library().quick.skinware_can_count(
        ctypes.byref(can), ctypes.byref(compile_batch(batch, structs.Arrays())), *at
    )
    assert can.frames == stop - first
    return float(can.wire_bits)


def test_bits_on_the_wire_lie_between_no_and_all_stuff_bits() -> None:
    batch = FrameBatch(4)
    batch.append(0, 0, 0x123, b"")
    batch.append(0, 0, 0x123, bytes(8))
    batch.append(0, 0, EXTENDED_FLAG | 0x123, bytes(8))
    bits = [wire_bits(batch, slice(row, row + 1)) for row in range(3)]
    for told, least, most in zip(bits, (47, 111, 131), (55, 135, 160), strict=True):
        assert least <= told <= most
    assert wire_bits(batch) == pytest.approx(sum(bits))
    assert wire_bits(batch, slice(0)) == 0
    assert 0.8 < 8_000 * bits[1] / 1_000_000 < 1.0  # 8000 frames/s are a full bus of 1 Mbit/s
    wide = FrameBatch(3, 64)
    wide.append(0, 0, 0x123, b"")
    wide.append(0, 0, 0x123, bytes(8))
    wide.append(0, 0, EXTENDED_FLAG | 0x123, bytes(8))
    assert wire_bits(wide, speed_up=8.0) == pytest.approx(sum(bits))  # classic frames among FD frames


SWITCHED, IS_FD = 0x01, 0x04


@pytest.mark.parametrize(
    ("identifier", "length", "flags", "least", "most"),
    [  # ISO 11898-1:2015 without and with all stuff bits that there can be, counted by hand; 8 times as fast
        (0x123, 64, IS_FD | SWITCHED, 30 + 549 / 8, 33 + 678 / 8),
        (0x123, 64, IS_FD, 30 + 549, 33 + 678),
        (0x123, 8, IS_FD | SWITCHED, 30 + 96 / 8, 33 + 113 / 8),
        (0x123, 16, IS_FD, 30 + 160, 33 + 193),
        (EXTENDED_FLAG | 0x123, 64, IS_FD | SWITCHED, 49 + 549 / 8, 57 + 678 / 8),
    ],
)
def test_fd_frames_take_the_time_of_both_bit_rates(
    identifier: int, length: int, flags: int, least: float, most: float
) -> None:
    batch = FrameBatch(1, 64)
    batch.append(0, 0, identifier, bytes(length))
    batch.wire["flags"][0] = flags
    assert least <= wire_bits(batch, speed_up=8.0) <= most


def stat(*dropped: int) -> str:
    return "".join(f"00001a2b {count:08x} 00000001 00000000\n" for count in dropped)


def test_what_the_machine_dropped_is_summed_over_processors_and_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file, clock = tmp_path / "softnet_stat", Clock()
    file.write_text(stat(5, 0x10))
    limits = MachineLimits(file, clock)
    with caplog.at_level(logging.WARNING):
        for dropped in ((5, 0x10), (6, 0x10), (6, 0x1A)):
            file.write_text(stat(*dropped))
            clock.pass_s(1)
            limits.look()
    assert limits.softnet_dropped == 11
    (line,) = warnings(caplog)
    assert line.startswith("this machine dropped 1 network packets")


@pytest.mark.parametrize("text", ["", "x\n", "zz yy\n", None])
def test_a_machine_that_does_not_tell_is_no_trouble(tmp_path: Path, text: str | None) -> None:
    file, clock = tmp_path / "softnet_stat", Clock()
    if text is not None:
        file.write_text(text)
    limits = MachineLimits(file, clock)
    clock.pass_s(1)
    limits.look()
    assert limits.softnet_dropped == 0
    assert MachineLimits().softnet_dropped == 0
