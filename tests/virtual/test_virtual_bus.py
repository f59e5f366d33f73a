"""The bus ``virtual`` keeps the contract of a bus."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from skinware.errors import BusError, BusNotAvailable, BusSendError, ConfigurationError
from skinware_drivers.bus import FrameBatch
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hand_clock import MonotonicClock
from skinware_drivers.virtual.hardware import WireFrame
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions

from .rig import MS


class Clock(MonotonicClock):
    """A clock that only the test moves. It begins at the real time, which is all that descriptors know."""

    def __init__(self) -> None:
        self.now_ns = time.monotonic_ns()

    def __call__(self) -> int:
        return self.now_ns

    def pass_ms(self, duration_ms: float) -> None:
        self.now_ns += round(duration_ms * MS)


def boards(**options: object) -> EmulatedRoboskin:
    return EmulatedRoboskin(EmulatedRoboskinOptions(**options))  # type: ignore[arg-type]


MakeBus = Callable[..., VirtualCanBus]


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def make_bus(clock: Clock) -> Iterator[MakeBus]:
    buses: list[VirtualCanBus] = []

    def make(payload_size: int = 8, listen_only: bool = False, **options: object) -> VirtualCanBus:
        options.setdefault("boards", (7, 8))
        bus = VirtualCanBus(
            "", hardware=boards(**options), payload_size=payload_size, listen_only=listen_only, clock=clock
        )
        buses.append(bus)
        bus.open()
        return bus

    yield make
    for bus in buses:
        bus.close()


def is_readable(bus: VirtualCanBus, timeout_s: float = 0) -> bool:
    return bool(select.select([bus.fileno()], [], [], timeout_s)[0])


def frames_of(batch: FrameBatch) -> list[WireFrame]:
    found = []
    for at in range(batch.start, batch.stop):
        row = batch.wire[at]
        payload = bytes(row["payload"][: row["length"]])
        found.append(WireFrame(int(batch.time_ns[at]), int(row["identifier"]), payload))
    return found


def test_frames_arrive_as_the_hardware_sends_them(make_bus: MakeBus, clock: Clock) -> None:
    bus, reference = make_bus(streaming=True, foreign_hz=100), boards(boards=(7, 8), streaming=True, foreign_hz=100)
    reference.skip(clock.now_ns)
    batch = FrameBatch(1000, headroom=5)
    batch.wire["payload"] = 0xAA
    clock.pass_ms(200)
    count = bus.receive(batch, 3)
    expected = reference.emit(clock.now_ns)
    assert count == len(batch) == len(expected) == bus.counters.frames > 200
    assert frames_of(batch) == expected
    assert set(batch.bus[batch.start : batch.stop].tolist()) == {3}
    padding = batch.wire[batch.start : batch.stop]
    assert all(not row["payload"][row["length"] :].any() for row in padding)
    assert not padding["flags"].any()
    assert not padding["reserved"].any()


def test_a_full_batch_leaves_the_rest_and_the_bus_stays_readable(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus(streaming=True)
    whole, small = FrameBatch(1000), FrameBatch(10)
    other = make_bus(streaming=True)
    clock.pass_ms(60)
    other.receive(whole, 0)
    got: list[WireFrame] = []
    while True:
        assert not got or is_readable(bus)
        assert bus.receive(small, 0) == len(small) <= 10
        got += frames_of(small)
        if len(small) < 10:
            break
        small.clear()
    assert got == frames_of(whole)
    assert bus.counters.dropped == 0
    assert bus.receive(small, 0) == 0


def test_a_batch_without_room_takes_nothing_and_nothing_is_lost(make_bus: MakeBus, clock: Clock) -> None:
    bus, other = make_bus(streaming=True), make_bus(streaming=True)
    batch, whole = FrameBatch(4), FrameBatch(1000)
    clock.pass_ms(60)
    bus.receive(batch, 0)
    assert bus.receive(batch, 0) == 0
    clock.pass_ms(60)
    assert bus.receive(batch, 0) == 0
    assert is_readable(bus)
    other.receive(FrameBatch(0), 0)
    assert is_readable(other, 5)  # nothing was fetched, and something is due
    got = frames_of(batch)
    rest = FrameBatch(1000)
    bus.receive(rest, 0)
    bus.receive(rest, 0)
    other.receive(whole, 0)
    assert got + frames_of(rest) == frames_of(whole)


def test_who_never_catches_up_loses_frames_and_memory_stays_bounded(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus(streaming=True)
    batch = FrameBatch(8)
    for _ in range(400):
        clock.pass_ms(50)
        bus.receive(batch, 0)
        batch.clear()
        assert len(bus._pending) <= 2 * 21 * 32
    assert bus.counters.dropped == bus.hardware.totals()["unheard"] > 10_000


def test_a_batch_that_is_full_by_chance_does_not_hide_what_comes_later(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus(boards=(7,), streaming=True)
    bus.receive(batch := FrameBatch(32), 0)
    clock.pass_ms(60)
    assert bus.receive(batch, 0) == 32
    clock.pass_ms(60)
    assert is_readable(bus, 1)
    batch.clear()
    assert bus.receive(batch, 0) == 32


def test_the_descriptor_is_readable_when_frames_are_due_and_not_before() -> None:
    with_clock = VirtualCanBus("roboskin", {"boards": "7", "streaming": "yes"})
    try:
        with_clock.open()
        batch = FrameBatch(1000)
        for _ in range(3):
            due_ns = with_clock.hardware.next_due_ns()
            assert due_ns is not None
            assert is_readable(with_clock, 30)
            assert time.monotonic_ns() >= due_ns
            batch.clear()
            assert with_clock.receive(batch, 0) >= 1
            assert batch.time_ns[0] >= due_ns  # later, if nobody came for so long that frames were lost
    finally:
        with_clock.close()


def test_silent_hardware_never_wakes_and_a_reply_does(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus()
    assert not is_readable(bus)
    assert bus.receive(batch := FrameBatch(10), 0) == 0
    assert not is_readable(bus)
    clock.now_ns = time.monotonic_ns()
    bus.send(0x207, bytes.fromhex("1C0200"))
    assert is_readable(bus, 5)
    clock.pass_ms(1)
    assert bus.receive(batch, 0) == 1
    assert frames_of(batch)[0].payload == bytes.fromhex("1C 0B 01 19 00 02 00 01")
    assert bus.counters.sent == 1
    assert not is_readable(bus)


def test_listen_only_refuses_to_send(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus(listen_only=True)
    with pytest.raises(BusSendError, match="listen only"):
        bus.send(0x207, b"\x07\x00")
    assert (bus.counters.sent, bus.counters.send_failures) == (0, 1)
    clock.pass_ms(200)
    assert bus.receive(FrameBatch(10), 0) == 0


def test_too_long_payloads_are_refused(make_bus: MakeBus) -> None:
    bus = make_bus()
    with pytest.raises(BusSendError, match="9 bytes"):
        bus.send(0x207, bytes(9))


def test_rows_for_64_bytes(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus(payload_size=64, streaming=True)
    batch = FrameBatch(1000, 64)
    clock.pass_ms(60)
    assert bus.receive(batch, 0) >= 64
    assert np.unique(batch.wire["length"][: len(batch)]).tolist() == [8]


def test_frames_that_no_row_can_hold_are_counted(clock: Clock) -> None:
    class LongFrames:
        def receive(self, identifier: int, payload: bytes, now_ns: int) -> None: ...
        def next_due_ns(self) -> int | None:
            return None

        def emit(self, now_ns: int) -> list[WireFrame]:
            return [WireFrame(now_ns, 1, bytes(12)), WireFrame(now_ns, 2, bytes(3))]

        def skip(self, now_ns: int) -> int:
            return 0

        def totals(self) -> dict[str, int]:
            return {}

    bus = VirtualCanBus("", hardware=LongFrames(), clock=clock)
    bus.open()
    assert bus.receive(batch := FrameBatch(10), 0) == 1
    assert frames_of(batch)[0].identifier == 2
    assert (bus.counters.refused, bus.counters.frames) == (1, 1)
    bus.close()


def test_what_nobody_fetches_for_a_second_is_lost_and_counted(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus(boards=(7,), streaming=True)
    clock.pass_ms(10_000)
    batch = FrameBatch(10_000)
    count = bus.receive(batch, 0)
    totals = bus.hardware.totals()
    assert bus.counters.dropped == totals["unheard"]
    assert bus.counters.dropped + count == totals["bursts"] * 32 == 200 * 32
    assert batch.time_ns[0] >= clock.now_ns - 1000 * MS
    clock.pass_ms(900)
    lost = bus.counters.dropped
    bus.receive(batch, 0)
    assert bus.counters.dropped == lost


# Opening and closing


def test_close_is_idempotent_and_gives_the_descriptor_back(make_bus: MakeBus) -> None:
    before = set(os.listdir("/proc/self/fd"))
    bus = make_bus()
    descriptor = bus.fileno()
    assert not os.get_inheritable(descriptor)
    bus.open()  # once more changes nothing
    assert bus.fileno() == descriptor
    bus.close()
    bus.close()
    assert bus.fileno() == -1
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)
    for _ in range(20):
        bus.open()
        bus.close()
    assert set(os.listdir("/proc/self/fd")) == before


def test_a_closed_bus_neither_receives_nor_sends(make_bus: MakeBus) -> None:
    bus = make_bus()
    bus.close()
    with pytest.raises(BusNotAvailable):
        bus.receive(FrameBatch(10), 0)
    with pytest.raises(BusSendError, match="not open"):
        bus.send(0x207, b"\x07\x00")


def test_boards_live_on_while_the_bus_is_closed(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus(boards=(7,), streaming=True, pattern="cycle")
    batch = FrameBatch(1000)
    clock.pass_ms(51)
    bus.receive(batch, 0)
    bus.close()
    clock.pass_ms(500)
    bus.open()
    clock.pass_ms(100)
    batch.clear()
    bus.receive(batch, 0)
    frames = frames_of(batch)
    assert min(frame.time_ns for frame in frames) > clock.now_ns - 100 * MS
    assert {frame.payload[1] for frame in frames} <= {10, 11, 12, 13}
    assert bus.counters.dropped == 0
    assert bus.counters.frames > len(frames)


def test_frames_kept_for_later_are_gone_with_a_close(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus(streaming=True)
    clock.pass_ms(60)
    bus.receive(FrameBatch(3), 0)
    bus.close()
    clock.pass_ms(3_600_000)
    bus.open()
    assert bus.receive(FrameBatch(100), 0) == 0
    assert bus.hardware.totals()["unheard"] > 3590 * 2 * 20 * 32


def test_vanishing_is_told_once_and_opening_fails_until_it_is_back(make_bus: MakeBus, clock: Clock) -> None:
    bus = make_bus(streaming=True)
    bus.vanish()
    assert is_readable(bus, 1)
    with pytest.raises(BusNotAvailable, match="went away"):
        bus.receive(FrameBatch(10), 0)
    with pytest.raises(BusSendError):
        bus.send(0x207, b"\x07\x00")
    bus.close()
    with pytest.raises(BusNotAvailable, match="away"):
        bus.open()
    assert bus.fileno() == -1
    bus.come_back()
    bus.open()
    clock.pass_ms(100)
    assert bus.receive(FrameBatch(1000), 0) > 0


def test_a_short_absence_is_told_too(make_bus: MakeBus) -> None:
    bus = make_bus()
    bus.vanish()
    bus.come_back()
    with pytest.raises(BusNotAvailable):
        bus.receive(FrameBatch(10), 0)
    assert bus.receive(FrameBatch(10), 0) == 0


def test_fail_next_receive(make_bus: MakeBus) -> None:
    bus = make_bus()
    bus.fail_next_receive(BusError("as you wish"))
    assert is_readable(bus, 1)
    with pytest.raises(BusError, match="as you wish"):
        bus.receive(FrameBatch(10), 0)
    assert bus.receive(FrameBatch(10), 0) == 0


# Names and options


def test_the_channel_names_the_emulator_and_nothing_is_roboskin() -> None:
    for channel in ("", "roboskin"):
        bus = VirtualCanBus(channel, {"boards": "7-9", "lose": "0.01"})
        assert isinstance(bus.hardware, EmulatedRoboskin)
        assert bus.name == "bus virtual:roboskin"
        bus.open()
        assert bus.receive(FrameBatch(10), 0) == 0
        bus.close()


def test_unknown_emulators_and_options_are_named() -> None:
    with pytest.raises(ConfigurationError, match="did you mean 'roboskin'"):
        VirtualCanBus("robskin")
    with pytest.raises(ConfigurationError, match="did you mean 'boards'"):
        VirtualCanBus("", {"bords": "7"})
    with pytest.raises(ConfigurationError, match="address 15 is outside 1-14"):
        VirtualCanBus("", {"boards": "15"})
