"""Frames that tell the device's own time: module times are those at which values were taken."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import BUS_COUNTERS
from skinware_drivers.description import Module, Patch, assemble, taxels
from skinware_drivers.fields import DeviceTime, Identifier, SequenceNumber
from skinware_drivers.layout import Cycle, Frame, Layout, Values
from tests.specification.decoding import SpecifiedDecoder

MS = 1_000_000
BEGIN_NS = 7_000_000 * MS
TIME = DeviceTime(4, "<u2", 1e-3)


def frame(name: str, identifier: int, first_channel: int) -> Frame:
    to = range(first_channel, first_channel + 2)
    return Frame(
        name,
        [Identifier(identifier)],
        [8],
        Values(0, "<u2", 2, to=tuple(to)),
        sequence=SequenceNumber(6, "u1"),
        time=TIME,
    )


def decoder(layout: Layout, n_buses: int = 1) -> SpecifiedDecoder:
    patch = Patch("tip", [Module(taxels(4))])
    return SpecifiedDecoder(
        [layout] * n_buses, assemble([(f"b{i}", [patch]) for i in range(n_buses)], [PRESSURE], np.uint16)
    )


def payload(value: int, stamp_ms: int, sequence: int) -> bytes:
    return np.array([value, value, stamp_ms & 0xFFFF], "<u2").tobytes() + bytes([sequence & 0xFF, 0])


@pytest.mark.thorough
def test_late_frames_have_the_time_of_their_values_and_gaps_are_counted_too() -> None:
    compiled = decoder(Layout([frame("one", 1, 0), frame("two", 2, 2)]), n_buses=2)
    batch = FrameBatch(64, 8, compiled.compiled.headroom)
    told: list[tuple[int, int]] = []
    for number in range(400):
        true_ns = BEGIN_NS + number * 10 * MS
        late_ns = 30 * MS if number % 7 == 3 else 0
        compiled.put_back(batch)
        for bus, first_stamp in enumerate((65_000, 123)):
            for identifier, kind in ((1, 0), (2, 1)):
                data = payload(number, first_stamp + 10 * number + kind, 2 * number + kind)
                batch.append(bus, true_ns + kind * MS + late_ns, identifier, data)
        updates, foreign = compiled.decode(batch)
        assert not len(foreign)
        compiled.state.show(updates)
        assert (updates.newest_ns <= true_ns + MS + late_ns).all()
        if number:
            assert set((updates.newest_ns - true_ns).tolist()) <= {0, MS}
        told += zip(updates.module.tolist(), updates.newest_ns.tolist(), strict=True)
    assert len(told) == 1600
    assert len(compiled.device_stamps.clocks) == 2
    assert all(clock.restarts == 0 for clock in compiled.device_stamps.clocks.values())
    assert compiled.state.patch_counters[:, 3:].sum() == 0  # sequence numbers


def test_frames_that_wait_for_their_partners_are_told_their_time_once() -> None:
    cycle = Cycle(["one", "two"], maximum_age_s=0.1)
    compiled = decoder(Layout([frame("one", 1, 0), frame("two", 2, 2)], cycle))
    batch = FrameBatch(64, 8, compiled.compiled.headroom)
    for number in range(50):
        true_ns = BEGIN_NS + number * 10 * MS
        for identifier, kind in ((1, 0), (2, 1)):  # each in a batch of its own
            compiled.put_back(batch)
            late_ns = 0 if number == 0 else 3 * MS
            batch.append(0, true_ns + kind * MS + late_ns, identifier, payload(number, 10 * number + kind, 0))
            updates, _ = compiled.decode(batch)
            assert len(updates.module) == kind
        assert updates.newest_ns.tolist() == [true_ns + MS]
        assert updates.oldest_ns.tolist() == [true_ns]


def one_frame(compiled: SpecifiedDecoder, time_ns: int, stamp_ms: int) -> int:
    """The time that the module has after it."""
    batch = FrameBatch(1, 8, compiled.compiled.headroom)
    batch.append(0, time_ns, 1, payload(0, stamp_ms, 0))
    updates, _ = compiled.decode(batch)
    return int(updates.newest_ns[0])


def test_a_clock_that_stands_still_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    compiled = decoder(Layout([frame("one", 1, 0)]))
    told_ns = [one_frame(compiled, BEGIN_NS + n * 1000 * MS, 0) for n in range(8)]
    assert told_ns == [BEGIN_NS + n * 1000 * MS for n in (0, 0, 0, 3, 4, 5, 6, 7)]
    assert [record.message.split(";")[0] for record in caplog.records] == [
        "b0: the clock of tip stands still, or is far too slow: its samples have the times of their receipt"
    ]


def test_a_patch_that_was_set_up_anew_has_a_clock_that_begins_anew() -> None:
    compiled = decoder(Layout([frame("one", 1, 0)]))
    assert one_frame(compiled, BEGIN_NS, 0) == BEGIN_NS
    assert one_frame(compiled, BEGIN_NS + 800 * MS, 10) == BEGIN_NS + 10 * MS  # late
    compiled.forget(0)
    assert one_frame(compiled, BEGIN_NS + 900 * MS, 20) == BEGIN_NS + 900 * MS


def test_a_stamp_before_boot_becomes_the_earliest_and_is_counted_on_its_bus() -> None:
    compiled = decoder(Layout([Frame("one", [Identifier(1)], [8], Values(0, "<u2", 2))]), n_buses=2)
    batch = FrameBatch(8, 8, compiled.compiled.headroom)
    for bus, time_ns in ((0, 5), (1, -5), (1, -1 << 62), (1, 0), (1, 6)):
        batch.append(bus, time_ns, 1, bytes(8))
    updates, _ = compiled.decode(batch)
    assert updates.newest_ns.tolist() == [1, 1, 1, 5, 6]
    assert compiled.state.bus_counters[:, BUS_COUNTERS.index("before_boot")].tolist() == [0, 3]


def test_times_that_cannot_be() -> None:
    with pytest.raises(ConfigurationError, match="'one': the device's time is not in every right payload"):
        Layout([Frame("one", [], [5], Values(0, "u1", 2), time=TIME)])
    other = DeviceTime(4, "<u2", 1e-6)
    with pytest.raises(ConfigurationError, match="one clock"):
        Layout(
            [
                Frame("one", [Identifier(1)], [8], Values(0, "u1", 2), time=TIME),
                Frame("two", [Identifier(2)], [8], Values(0, "u1", 2), time=other),
            ]
        )
