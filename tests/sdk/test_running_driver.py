"""The ROBOSKIN driver on emulated boards, end to end: frames on a (virtual) wire to a user's arrays."""

from __future__ import annotations

import asyncio
import logging
import os
import select
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from skinware import BusState, DriverReader, DriverSnapshot, PatchState, Skin, Status
from skinware.errors import NameInUse
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.running.runner import Runner
from skinware_drivers.testing.rig import play
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hand_clock import HandClock
from skinware_drivers.virtual.hardware import Event
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions as EmulatorOptions
from skinware_drivers.virtual.snapshot_log import SnapshotLog
from tests.sdk.driving import EveryFrame, LateBoards, Together, commands, driving, emulated, hardware_of, read_until
from tests.virtual.rig import damaged_cycles


class Flood(VirtualCanBus):
    """A bus on which more frames wait, always, than a batch holds.

    Attributes:
        frames: which frames.
    """

    flooding = False
    frames: Sequence[tuple[int, bytes]] = ()
    _always_readable = -1

    def open(self) -> None:
        super().open()
        self._always_readable = os.eventfd(1)

    def fileno(self) -> int:
        return self._always_readable

    def close(self) -> None:
        super().close()
        if self._always_readable >= 0:
            os.close(self._always_readable)
            self._always_readable = -1

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        count = super().receive(batch, ordinal)
        while self.flooding and batch.free:
            identifier, payload = self.frames[self.counters.frames % len(self.frames)]
            batch.append(ordinal, time.monotonic_ns(), identifier, payload)
            count += 1
            self.counters.frames += 1
        return count


FOREIGN = [(0x7F1, b"")]
ONE_TRIANGLE = [(0x473, b"\x40" + bytes(7)), (0x473, b"\xc0" + bytes(7))]


@pytest.mark.thorough
@pytest.mark.usefixtures("hurry")
@pytest.mark.parametrize("frames", [FOREIGN, ONE_TRIANGLE])
def test_a_flood_on_one_bus_holds_up_no_other(
    monkeypatch: pytest.MonkeyPatch, frames: Sequence[tuple[int, bytes]]
) -> None:
    monkeypatch.setattr("skinware_drivers.bus.BATCH_FRAMES", 128)
    hardware = EmulatedRoboskin(EmulatorOptions(boards=(7,)))
    flood = Flood("", hardware=hardware)
    flood.frames = frames
    others = [emulated(boards=(board,), pattern="idle") for board in (8, 9)]
    with driving(flood, *others) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: setattr(flood, "flooding", True))
        flooded = flood.counters.frames
        wait_until(lambda: reader.bus_counters(reader.read())[0]["frames"] > flooded + 10_000)
        first = reader.read()

        def all_go_on() -> bool:
            frame = reader.read()
            others = frame.module_time_ns[16:] > first.module_time_ns[16:] + 10**9
            return bool(others.all()) and frame.patch_state.tolist() == [PatchState.LIVE] * 3

        wait_until(all_go_on)
        running.do(lambda: setattr(flood, "flooding", False))


def test_boards_are_set_up_in_the_real_order_with_the_real_waits() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8))
    with driving(bus):
        pass
    sent = [(identifier, payload.replace(" ", "").lower()) for _, identifier, payload in commands(log)]
    unique = list(dict.fromkeys(sent))  # the emulator logs a broadcast once per board
    assert unique == [
        (0x70F, "ff"),
        (0x207, "4d0032f0"),
        (0x208, "4d0032f0"),
        (0x207, "50000f02010022"),
        (0x208, "50000f02010022"),
        (0x207, "0700"),
        (0x208, "0700"),
        (0x207, "0701"),
        (0x208, "0701"),
    ]
    times = {key: time_ns for (time_ns, *_), key in zip(commands(log), sent, strict=True)}
    assert times[0x207, "0700"] - times[0x208, "50000f02010022"] >= 510_000_000


@pytest.mark.usefixtures("hurry")
def test_values_reach_the_user_as_they_were_on_the_wire() -> None:
    def source(board: int, triangle: int, cycle: int, time_ns: int) -> list[int]:
        return [(board + triangle + channel) % 256 for channel in range(12)]

    hardware = EmulatedRoboskin(EmulatorOptions(boards=(7, 9)), source=source)
    with driving(VirtualCanBus("", hardware=hardware)), DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        uid = frame.structure.sensor_uid.astype(np.int64)
        assert frame.values.tolist() == ((uid >> 16) + (uid >> 8 & 0xFF) + (uid & 0xFF)).tolist()
        assert frame.patch_state.tolist() == [PatchState.LIVE] * 2
        assert frame.bus_state.tolist() == [BusState.LIVE]
        with Skin() as skin:
            assert len(skin.read().physical("pressure")) == 2 * 16 * 10


@pytest.mark.thorough
@pytest.mark.usefixtures("hurry")
def test_with_lost_halves_nothing_torn_is_fresh_and_every_loss_is_known() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), pattern="cycle", lose=0.01)
    shown: dict[int, set[int]] = {module: set() for module in range(32)}
    with driving(bus, period_ms=20) as running, EveryFrame(running) as every:
        wait_until(lambda: len(every.taken) > 200)
        before_ns, reader = np.zeros(32, np.int64), every.reader
        for frame in every.taken[:200]:
            values, status = frame.values.reshape(32, 12), frame.status.reshape(32, 12)
            is_new = frame.module_time_ns != before_ns
            before_ns = frame.module_time_ns.copy()
            for module in np.flatnonzero(is_new | (status == 0).all(axis=1)).tolist():
                cycles = set(values[module].tolist())
                assert len(cycles) == 1, f"module {module} is torn: {values[module]}"
                shown[module].add(int(values[module][0]))
        assert reader.missed == 0
        orphans = [counters["orphans"] for counters in reader.patch_counters(frame)]
        assert min(orphans) > 10
        told = running.status()["patches"]
        assert all(few <= patch["orphans"] for few, patch in zip(orphans, told, strict=True))
        assert len(damaged_cycles(log)) > 20
    halves = Counter((e.board, e.triangle, e.cycle) for e in log if e.fault in ("lost", "unsent"))
    both = [place for place, count in halves.items() if count == 2]
    # after a cycle that was lost whole, the next is not trusted
    damaged = {*damaged_cycles(log), *((board, triangle, cycle + 1) for board, triangle, cycle in both)}
    for module, cycles in shown.items():
        board, triangle = 7 + module // 16, module % 16
        between = range(min(cycles), max(cycles) + 1) if max(cycles) - min(cycles) < 250 else range(0)
        missing = {cycle for cycle in between if cycle not in cycles}
        assert missing == {c for b, t, c in damaged if (b, t) == (board, triangle) and c in between}
    total = sum(patch["orphans"] for patch in running.status()["patches"])
    lost = sum(event.fault in ("lost", "unsent") for event in log)
    assert lost - 2 * len(both) - 4 <= total <= lost  # at most one head per board still waited at the end


def test_jitter_costs_no_cycle_and_makes_nothing_stale() -> None:
    async def scenario(clock: HandClock) -> SnapshotLog:
        hardware = EmulatedRoboskin(EmulatorOptions(boards=(7, 8), pattern="cycle", jitter_us=8_000))
        bus = VirtualCanBus("", hardware=hardware, clock=clock)
        runner = Runner("roboskin", [("bus", RoboskinDriver(RoboskinOptions(period_ms=20)), bus)], name="roboskin")
        record = SnapshotLog(clock)
        clock.before_passing.append(lambda: record.look(runner))
        task = asyncio.create_task(runner.run())
        await asyncio.sleep(3)
        assert record.reader is not None
        assert record.reader.missed == 0
        record.close()
        runner.stop()
        await task
        return record

    record = play(scenario)
    start = next(number for number, frame in enumerate(record.frames) if not frame.status.any())
    shown: list[list[int]] = [[], []]
    for frame in record.frames[start:]:
        assert not frame.status.any()
        for board, values in enumerate(frame.values.reshape(2, 192).tolist()):
            assert len(set(values)) == 1, "a frame holds two bursts of a board"
            shown[board].append(values[0])
    for cycles in shown:
        assert set((np.diff(cycles) % 256).tolist()) <= {0, 1}
        assert len(cycles) > 50


@pytest.mark.usefixtures("hurry")
def test_a_dead_board_beside_a_living_one(caplog: pytest.LogCaptureFixture) -> None:
    bus = emulated(boards=(7, 8))
    with caplog.at_level(logging.WARNING), driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: hardware_of(bus).kill(8, bus._clock()))
        frame = read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE, PatchState.STALE])
        assert (frame.status[192:] & Status.STALE).all()
        later = read_until(
            reader, lambda f: f.sequence >= frame.sequence + 20 and not (f.status[:192] & Status.STALE).any()
        )
        assert (later.status[192:] & Status.STALE).all()
        assert (later.published_ns - later.acquired_ns) < 1_000_000_000
        wait_until(lambda: "board 8 fell silent" in caplog.text)
    assert caplog.text.count("board 8 fell silent") == 1


def test_a_restarted_board_is_set_up_alone() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), boot_s=0.1)
    with driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        running.do(lambda: hardware_of(bus).restart(8, bus._clock()))
        read_until(reader, lambda f: f.patch_state[1] == PatchState.RESTARTED)
        frame = read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE] * 2)
        assert reader.bus_counters(frame)[0]["unknown"] == 0  # the answers to its own questions are none
        sent = {(i, p.replace(" ", "").lower()) for _, i, p in commands(log)[before:]}
    assert {identifier for identifier, payload in sent if not payload.startswith("0701")} == {0x208}
    assert {"4d0032f0", "50000f02010022", "0700"} <= {payload for _, payload in sent}


@pytest.mark.usefixtures("hurry")
def test_a_hold_up_while_a_snapshot_is_due_silences_nothing(caplog: pytest.LogCaptureFixture) -> None:
    bus = emulated(boards=(7,))
    with caplog.at_level(logging.WARNING), driving(bus) as running, DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        receive, data = bus.receive, running.runner._data  # type: ignore[union-attr]

        def held_up(*arguments: Any) -> int:
            bus.receive = receive  # type: ignore[method-assign]
            time.sleep(1.2)
            return receive(*arguments)

        def publish() -> None:
            select.select([bus.fileno()], [], [])
            bus.receive = held_up  # type: ignore[assignment,method-assign]
            data._publish_when_due()

        running.do(publish)
        read_until(reader, lambda f: f.sequence > frame.sequence + 20 and not f.status.any())
    assert "nothing is heard" not in caplog.text
    assert "silent" not in caplog.text.replace("silence is counted", "")


@pytest.mark.usefixtures("hurry")
def test_diagnostics_of_the_hardware_reach_the_user() -> None:
    bus = emulated(boards=(7,), out_of_range=("7/2/5",), not_connected=("7/3",), pattern="idle")
    with driving(bus, skin_type=2) as running, DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not (f.status & Status.NEVER_SEEN).any())
        assert frame.status[2 * 12 + 5] == Status.OUT_OF_RANGE
        assert set(frame.status[36:48].tolist()) == {int(Status.NOT_CONNECTED)}
        running.do(lambda: hardware_of(bus).set_triangle(7, 4, "unplugged", bus._clock()))
        frame = read_until(reader, lambda f: bool((f.status[48:60] & Status.NOT_CONNECTED).all()))
        assert set(frame.values[48:60].tolist()) == {0}  # full pressure, if it were not for the flag


@pytest.mark.usefixtures("hurry")
def test_a_board_that_recalibrates_itself_is_suspect() -> None:
    bus = emulated(boards=(7, 8), pattern="idle")
    with driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: hardware_of(bus).set_triangle(7, 1, "no_ack", bus._clock()))
        frame = read_until(reader, lambda f: bool((f.status[:192] & Status.SUSPECT).all()))
        assert not (frame.status[192:] & Status.SUSPECT).any()


@pytest.mark.usefixtures("hurry")
def test_damaged_and_foreign_frames_are_counted() -> None:
    bus = emulated(boards=(7,), truncate=0.05, foreign_hz=200)
    with driving(bus) as running, DriverReader("roboskin") as reader:

        def both_counted(frame: DriverSnapshot) -> bool:
            (counters,) = reader.bus_counters(frame)
            return counters["bad_length"] > 5 and counters["unknown"] > 5

        read_until(reader, both_counted)
        assert running.status()["buses"][0]["bad_content"] == 0


def test_a_listener_sends_nothing_and_learns_what_it_hears() -> None:
    bus = emulated(boards=(7, 9), streaming=True, listen_only=True)
    with driving(bus, listen_only=True, learn_s=0.3), DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not (f.status & Status.NEVER_SEEN).any())
        assert [bytes(name) for name in frame.structure.patch_name] == [b"board 7", b"board 9"]
    assert bus.counters.sent == bus.counters.send_failures == 0


@pytest.mark.usefixtures("hurry")
def test_a_driver_waits_for_a_board_and_goes_on_when_one_appears(caplog: pytest.LogCaptureFixture) -> None:
    late = LateBoards(EmulatedRoboskin(EmulatorOptions(boards=(7,))))
    bus = VirtualCanBus("", hardware=late)
    with caplog.at_level(logging.WARNING), driving(bus, wait=False) as running:
        wait_until(lambda: "no patch answers; waiting" in caplog.text)
        late.present = True
        assert running.ready.wait(30)
        with DriverReader("roboskin") as reader:
            assert read_until(reader, lambda f: not f.status.any()).structure.n_sensors == 192
    assert caplog.text.count("no patch answers") == 1


def test_a_listener_that_hears_nobody_says_so(caplog: pytest.LogCaptureFixture) -> None:
    bus = emulated(boards=(7,), listen_only=True)
    with caplog.at_level(logging.WARNING), driving(bus, wait=False, listen_only=True, learn_s=0.1):
        wait_until(lambda: "no patch is heard, and no device may be asked; waiting for one to appear" in caplog.text)


def test_what_a_listener_hears_later_is_counted_and_joins_on_request() -> None:
    late = LateBoards(EmulatedRoboskin(EmulatorOptions(boards=(9,), streaming=True)))
    both = Together(EmulatedRoboskin(EmulatorOptions(boards=(7,), streaming=True)), late)
    bus = VirtualCanBus("", hardware=both, listen_only=True)
    with driving(bus, listen_only=True, learn_s=0.3) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        assert reader.structure.n_patches == 1
        running.do(lambda: setattr(late, "present", True))
        read_until(reader, lambda f: reader.bus_counters(f)[0]["unknown"] > 1000)  # longer than it learns
        assert reader.structure.n_patches == 1
        assert running.runner is not None
        running.do(running.runner.join)
        wait_until(lambda: reader.refresh() is not None and reader.structure_changed)
        reader.reattach()
        frame = read_until(reader, lambda f: not f.status.any())
        assert [bytes(name) for name in frame.structure.patch_name] == [b"board 7", b"board 9"]


@pytest.mark.usefixtures("hurry")
def test_a_bus_that_goes_away_comes_back_and_never_holds_up_the_other(caplog: pytest.LogCaptureFixture) -> None:
    log: list[Event] = []
    first, second = emulated(boards=(7,)), emulated(log, boards=(7,))
    with caplog.at_level(logging.WARNING), driving(first, second) as running, DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        assert frame.structure.sensor_uid[192] == 1 << 32 | 7 << 16
        running.do(second.vanish)
        frame = read_until(reader, lambda f: f.bus_state[1] == BusState.GONE and f.patch_state[1] == PatchState.STALE)
        read_until(
            reader,
            lambda f: (
                f.sequence >= frame.sequence + 20
                and f.bus_state.tolist() == [BusState.LIVE, BusState.GONE]
                and not (f.status[:192] & Status.STALE).any()
            ),
        )
        before = len(commands(log))
        running.do(second.come_back)
        back = read_until(reader, lambda f: f.bus_state[1] == BusState.LIVE and not f.status.any())
        read_until(reader, lambda f: f.sequence >= back.sequence + 20)
        assert len(commands(log)) == before  # boards that sent all the time are not set up again
        assert reader.generation == frame.generation
    assert caplog.text.count("went away") == 1


@pytest.mark.usefixtures("hurry")
def test_a_living_drivers_name_is_refused() -> None:
    with driving(emulated(boards=(7,))):
        with pytest.raises(NameInUse, match="roboskin"), driving(emulated(boards=(7,))):
            pass


@pytest.mark.usefixtures("hurry")
def test_a_burst_that_waited_is_published_cycle_by_cycle() -> None:
    """After a stall of the driver several cycles are decoded at once; each still becomes a frame of its own."""
    bus = emulated(boards=(7,), pattern="cycle")
    with driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: time.sleep(0.4))  # the whole loop stands still
        seen = [int(f.values[0]) for _, f in zip(range(30), reader.in_order(timeout_s=30), strict=False)]
        steps = np.diff(seen) % 256
        assert set(steps.tolist()) <= {0, 1}


def test_a_frame_holds_one_burst_of_a_board_from_the_first_on() -> None:
    """Set-up takes longer than a patch may be silent; the first burst must not be taken for whole too early."""
    bus = emulated(boards=(7,), pattern="cycle")
    with driving(bus, wait=False), DriverReader("roboskin", timeout_s=30) as reader:
        whole = 0
        for frame in reader.in_order(timeout_s=30):
            if not frame.status.any():
                assert len(set(frame.values.tolist())) == 1
                whole += 1
            if whole == 10:
                break


def test_a_full_batch_loses_nothing() -> None:
    bus = emulated(boards=(7, 8))
    bus.open()
    batch = FrameBatch(10, 8)
    for board in (7, 8):
        for payload in ("4D0032F0", "50000F02010022", "0700"):
            bus.send(0x200 | board, bytes.fromhex(payload))
    total = 0
    while total < 200:
        batch.clear()
        total += bus.receive(batch, 0)
        assert len(batch) <= 10
    bus.close()
    assert bus.counters.dropped == 0
