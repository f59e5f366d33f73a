"""What a driver does when its buses do not: down, gone, full, silent, at any moment of its life."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
import pytest

from skinware import BusState, DriverReader, Namespace, PatchState, Status
from skinware.errors import BusSendError
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.link import Link
from skinware_drivers.running import bus_line
from skinware_drivers.testing.waiting import PATIENCE_S, wait_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import Event
from tests.sdk.driving import commands, driving, emulated, hardware_of, read_until, troubled

pytestmark = pytest.mark.usefixtures("hurry")

SET_UP = [(0x207, "4d0032f0"), (0x207, "50000f02010022"), (0x207, "0700")]


def sent(log: list[Event]) -> list[tuple[int, str]]:
    return [(identifier, payload) for _, identifier, payload in commands(log)]


def once(action: Callable[[], object], prefix: bytes) -> Callable[[int, bytes], None]:
    """Something to happen before the first frame that begins with ``prefix``."""
    done: list[bytes] = []

    def before_send(_identifier: int, payload: bytes) -> None:
        if not done and payload.startswith(prefix):
            done.append(payload)
            action()

    return before_send


def refuse() -> None:
    raise BusSendError("the queue is full")


# Down and up again


def test_a_bus_that_is_down_is_opened_again_with_growing_pauses(caplog: pytest.LogCaptureFixture) -> None:
    log: list[Event] = []
    first, second = emulated(boards=(7,)), troubled(log, boards=(7,))
    with caplog.at_level(logging.WARNING), driving(first, second) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        second.opened_at_s.clear()
        running.do(second.go_down)
        frame = read_until(reader, lambda f: f.bus_state.tolist() == [BusState.LIVE, BusState.DOWN])
        wait_until(lambda: len(second.opened_at_s) >= 7)
        pauses_s = np.diff(second.opened_at_s)
        assert (pauses_s >= [0.03, 0.06, 0.12, 0.12, 0.12, 0.12][: len(pauses_s)]).all()
        read_until(reader, lambda f: bool((f.status[192:] & Status.STALE).all()) and not f.status[:192].any())
        second.down = False
        back = read_until(reader, lambda f: f.bus_state[1] == BusState.LIVE and not f.status.any())
        assert back.generation == frame.generation
        assert len(commands(log)) == before  # its boards were sending all the time
    assert caplog.text.count("the bus went down; waiting for it to come back") == 1
    assert caplog.text.count("bus bus1 is back") == 1


def test_boards_that_lost_power_while_their_bus_was_away_are_set_up() -> None:
    log: list[Event] = []
    bus = troubled(log, boards=(7,), boot_s=0.05)
    with driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        running.do(bus.go_down)
        read_until(reader, lambda f: f.bus_state[0] == BusState.DOWN)
        running.do(lambda: hardware_of(bus).restart(7, bus._clock()))
        bus.down = False
        read_until(reader, lambda f: f.patch_state[0] != PatchState.LIVE)
        read_until(reader, lambda f: f.patch_state[0] == PatchState.LIVE)
        assert sent(log)[before:] == [(0x207, "1c0200"), *SET_UP]


def test_a_bus_that_goes_down_while_boards_are_looked_for() -> None:
    log: list[Event] = []
    bus = troubled(log, boards=(7,))
    bus.before_send = once(bus.go_down, b"\xff")
    with driving(bus, wait=False) as running:
        wait_until(lambda: len(bus.opened_at_s) >= 3)
        bus.down = False
        assert running.ready.wait(30)
        with DriverReader("roboskin") as reader:
            read_until(reader, lambda f: not f.status.any())
    assert sent(log) == [(0x70F, "ff"), *SET_UP, (0x207, "0701")]


def test_a_bus_that_goes_down_while_boards_are_set_up(caplog: pytest.LogCaptureFixture) -> None:
    log: list[Event] = []
    bus = troubled(log, boards=(7,))
    bus.before_send = once(bus.go_down, b"\x50")
    with caplog.at_level(logging.WARNING), driving(bus, wait=False) as running:
        wait_until(lambda: "bus0: set-up failed: " in caplog.text)
        wait_until(lambda: len(bus.opened_at_s) >= 3)
        bus.down = False
        assert running.ready.wait(30)
        with DriverReader("roboskin") as reader:
            read_until(reader, lambda f: not f.status.any())
    assert sent(log)[-4:] == [*SET_UP, (0x207, "0701")]  # from the beginning
    assert "trying again" in caplog.text


# Frames that cannot be sent


def test_a_full_queue_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Link.send, "__kwdefaults__", {"timeout_s": PATIENCE_S})
    log: list[Event] = []
    bus = troubled(log, boards=(7,))
    tries: list[bytes] = []

    def before_send(_identifier: int, payload: bytes) -> None:
        tries.append(payload)
        if tries.count(payload) < 4:
            refuse()

    bus.before_send = before_send
    with driving(bus):
        pass
    assert sent(log) == [(0x70F, "ff"), *SET_UP, (0x207, "0701")]
    assert len(tries) == 4 * 5


def test_set_up_that_fails_is_tried_again(caplog: pytest.LogCaptureFixture) -> None:
    bus = troubled(boards=(7,))
    refusing = [True]
    bus.before_send = lambda _identifier, payload: refuse() if refusing and payload[0] == 0x50 else None
    with caplog.at_level(logging.WARNING), driving(bus, wait=False) as running:
        wait_until(lambda: "bus0: set-up failed: the queue is full; trying again" in caplog.text)
        refusing.clear()
        assert running.ready.wait(30)
        with DriverReader("roboskin") as reader:
            read_until(reader, lambda f: not f.status.any())


def test_a_restarted_board_that_cannot_be_set_up_is_tried_again() -> None:
    bus = troubled(boards=(7, 8), boot_s=0.05, pattern="idle")
    with driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        bus.before_send = lambda _identifier, payload: refuse() if payload[0] == 0x4D else None
        running.do(lambda: hardware_of(bus).restart(8, bus._clock()))
        read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE, PatchState.RESTARTED])
        read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE, PatchState.STALE])
        bus.before_send = lambda _identifier, _payload: None
        read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE] * 2)


def test_boards_that_cannot_be_stopped_are_told_of_and_the_others_are_stopped(
    caplog: pytest.LogCaptureFixture, namespace: Namespace
) -> None:
    log: list[Event] = []
    first, second = troubled(boards=(7,)), emulated(log, boards=(8,))
    with caplog.at_level(logging.WARNING), driving(first, second):
        first.before_send = lambda _identifier, _payload: refuse()
    assert "bus0: not stopped in good order: the queue is full" in caplog.text
    assert sent(log)[-1] == (0x208, "0701")
    assert namespace.services() == []


class Slow(RoboskinDriver):
    """A driver that takes its time to stop."""

    async def stop(self, link: Link) -> None:
        """Far too long."""
        await link.sleep(10)


def test_a_stop_that_takes_too_long_is_given_up(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus_line, "_STOP_TIMEOUT_S", 0.05)
    with caplog.at_level(logging.WARNING), driving(emulated(boards=(7,)), driver=Slow):
        pass
    assert "bus0: not stopped in good order: it took too long" in caplog.text


# What readers are shown of a bus


def test_a_bus_on_which_nothing_is_heard_is_silent_until_something_is() -> None:
    bus = emulated(boards=(7,), pattern="idle", boot_s=0.05)
    with driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: hardware_of(bus).kill(7, bus._clock()))
        frame = read_until(reader, lambda f: f.bus_state[0] == BusState.SILENT)
        later = read_until(reader, lambda f: f.sequence >= frame.sequence + 3)  # frames go on
        assert (later.status & Status.STALE).all()
        assert later.patch_state[0] == PatchState.STALE
        running.do(lambda: hardware_of(bus).restart(7, bus._clock()))
        read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE and not f.status.any())


def test_what_a_bus_counts_and_notes_is_told(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(VirtualCanBus, "note", "a buffer is small")
    buses = emulated(boards=(7,)), emulated(boards=(7,))

    def count() -> None:
        counters = buses[1].counters
        counters.dropped, counters.errors, counters.refused, counters.send_failures = 3, 5, 2, 1

    with caplog.at_level(logging.WARNING), driving(*buses) as running, DriverReader("roboskin") as reader:
        running.do(count)
        frame = read_until(reader, lambda f: reader.bus_counters(f)[1]["dropped"] == 3)
        shown = reader.bus_counters(frame)
        names = ("dropped", "errors", "refused", "send_failures")
        assert [[row[name] for name in names] for row in shown] == [[0, 0, 0, 0], [3, 5, 2, 1]]
        told = running.status()["buses"]
        assert [[row[name] for name in names] for row in told] == [[0, 0, 0, 0], [3, 5, 2, 1]]
        assert shown[1]["sent"] == 4
    assert caplog.text.count("a buffer is small") == 2


def test_frames_stamped_before_boot_are_counted_and_end_nothing() -> None:
    bus = emulated(boards=(7,))
    receive = bus.receive

    def receive_too_early(batch: FrameBatch, ordinal: int) -> int:
        first = batch.stop
        count = receive(batch, ordinal)
        batch.time_ns[first : batch.stop] -= 1 << 62
        return count

    bus.receive = receive_too_early  # type: ignore[method-assign]
    with driving(bus, wait=False) as running, DriverReader("roboskin", timeout_s=30) as reader:
        frame = read_until(reader, lambda f: reader.bus_counters(f)[0]["before_boot"] > 100)
        assert (frame.status == Status.STALE).all()  # heard, and nobody knows when
        assert (frame.module_time_ns == 1).all()
        running.do(lambda: setattr(bus, "receive", receive))
        read_until(reader, lambda f: not f.status.any())


class Talkative(RoboskinDriver):
    """Sends thousands of frames to set its boards up, while they send data already."""

    async def configure(self, link: Link) -> None:
        """Far more than any board needs."""
        await super().start(link)
        for number in range(4000):
            await link.send(0x7E0, number.to_bytes(4, "little"))


@pytest.mark.thorough
def test_a_set_up_of_thousands_of_frames_starves_no_reception() -> None:
    """By conditions, not by time: whatever the machine does, few frames are sent between two looks at the buses."""
    bus = troubled(boards=(7,))
    other = emulated(boards=(8,))
    sent_between = [0]
    looks = [0]
    real = other.receive

    def look(batch: FrameBatch, ordinal: int) -> int:
        looks[0] += 1
        sent_between.append(0)
        return real(batch, ordinal)

    def before_send(identifier: int, _payload: bytes) -> None:
        if identifier == 0x7E0:
            sent_between[-1] += 1

    bus.before_send = before_send
    other.receive = look  # type: ignore[method-assign]
    with driving(bus, other, driver=Talkative) as running, DriverReader("roboskin") as reader:
        wait_until(lambda: running.status()["buses"][0]["sent"] >= 4000)  # boards send data before all is said
        read_until(reader, lambda f: not f.status.any())
        assert all(row["dropped"] == 0 for row in running.status()["buses"])
    assert sum(sent_between) == 4000
    assert max(sent_between) < 1000  # the boards deliver every 50 ms, in which the pace allows 200
    assert looks[0] > 4
