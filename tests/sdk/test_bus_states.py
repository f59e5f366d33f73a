"""State, reason and age of a bus as people and programs are told, whatever its hardware does."""

from __future__ import annotations

import asyncio
import logging
import select
import threading
from collections.abc import Callable
from contextlib import closing
from typing import ClassVar

import pytest

from skinware import BusReason, BusState, DriverReader, DriverSnapshot, Status
from skinware.errors import BusNotAvailable
from skinware.realtime import now_ns
from skinware_drivers.can import CanAdapter
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.options import NoOptions
from skinware_drivers.running import bus_line, connection, news, runner
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.news import LINE_EVERY_S, LINES_AT_ONCE, BusNews
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions
from tests.sdk.clock import Clock
from tests.sdk.driving import TroubledBus, driving, emulated, follow, hardware_of, read_until

pytestmark = pytest.mark.usefixtures("hurry")


class ReportingBus(TroubledBus):
    """A bus whose controller reports what the test says, and whose interface can be lost without a word.

    Attributes:
        wrong: what the controller reports.
        lost_in_silence: ``check`` finds the interface gone; nothing else does.
        opening: as long as it is clear, ``open`` does not come back.
    """

    opens_slowly: ClassVar[bool] = False

    def __init__(self, *arguments: object, **more: object) -> None:
        super().__init__(*arguments, **more)
        self.wrong = BusReason.NONE
        self.lost_in_silence = False
        self.opening = threading.Event()
        self.opening.set()
        self.opened_in: set[str] = set()

    def open(self) -> None:
        self.opened_in.add(threading.current_thread().name)
        assert self.opening.wait(30)
        if self.lost_in_silence:
            raise BusNotAvailable("the bus is not there")
        super().open()

    def reason(self, time_ns: int) -> BusReason:
        return self.wrong

    def check(self) -> None:
        if self.lost_in_silence:
            raise BusNotAvailable("the bus has vanished")


class SlowBus(ReportingBus):
    """One whose ``open`` may take long."""

    opens_slowly = True


def reporting(kind: type[ReportingBus] = ReportingBus, **options: object) -> ReportingBus:
    return kind("", hardware=EmulatedRoboskin(EmulatedRoboskinOptions(boards=(7,), **options)))  # type: ignore[arg-type]


def told(caplog: pytest.LogCaptureFixture, bus: str) -> list[str]:
    return [r.getMessage() for r in caplog.records if r.getMessage().startswith(bus)]


def test_a_bus_off_is_told_with_its_time_and_ends_as_the_controller_says(caplog: pytest.LogCaptureFixture) -> None:
    bus, other = reporting(), emulated(boards=(7,))
    with caplog.at_level(logging.WARNING), driving(bus, other) as running, DriverReader("roboskin") as reader:
        live = read_until(reader, lambda f: f.bus_state.tolist() == [BusState.LIVE] * 2 and not f.status.any())
        assert live.bus_reason.tolist() == [BusReason.NONE] * 2
        before_ns = now_ns()
        assert 0 < live.bus_since_ns.max() < before_ns

        def go_off() -> None:
            bus.wrong = BusReason.BUS_OFF

        running.do(go_off)
        off = read_until(reader, lambda f: f.bus_reason[0] == BusReason.BUS_OFF)
        assert off.bus_state.tolist() == [BusState.DOWN, BusState.LIVE]
        assert before_ns < off.bus_since_ns[0] <= off.published_ns
        assert off.bus_since_ns[1] == live.bus_since_ns[1]
        later = read_until(reader, lambda f: f.sequence >= off.sequence + 3)
        assert later.bus_since_ns[0] == off.bus_since_ns[0]  # since then, not since now
        shown = running.status()["buses"][0]
        assert (shown["state"], shown["reason"]) == ("down", "bus_off")
        assert shown["state_age_s"] > 0
        bus.wrong = BusReason.NONE
        back = read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE)
        assert (back.bus_reason[0], back.generation) == (BusReason.NONE, live.generation)
        assert back.bus_since_ns[0] > off.bus_since_ns[0]
    first, second = (line for line in told(caplog, "bus bus0") if "bus-off" in line)
    assert first.startswith("bus bus0: bus-off: ")
    assert second == "bus bus0: in order again (was bus-off)"
    assert not told(caplog, "bus bus1")


def test_a_live_bus_tells_what_is_wrong_with_it(caplog: pytest.LogCaptureFixture) -> None:
    bus = reporting()
    with caplog.at_level(logging.WARNING), driving(bus), DriverReader("roboskin") as reader:
        for wrong in (BusReason.ERROR_WARNING, BusReason.ERROR_PASSIVE, BusReason.OVERFLOW):
            bus.wrong = wrong

            def fresh_and_told(frame: DriverSnapshot, wrong: BusReason = wrong) -> bool:
                is_live = frame.bus_state[0] == BusState.LIVE and not (frame.status & Status.STALE).any()
                return bool(is_live and frame.bus_reason[0] == wrong)

            read_until(reader, fresh_and_told)
    lines = told(caplog, "bus bus0")
    assert [line.split(":")[1].split()[0] for line in lines] == ["error-warning", "error-passive", "the"]


def test_silence_is_told_once_and_so_is_its_end(caplog: pytest.LogCaptureFixture) -> None:
    bus = emulated(boards=(7,), pattern="idle", boot_s=0.05)
    with caplog.at_level(logging.WARNING), driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: hardware_of(bus).kill(7, bus._clock()))
        silent = read_until(reader, lambda f: f.bus_state[0] == BusState.SILENT)
        assert silent.bus_reason[0] == BusReason.NOTHING_HEARD
        read_until(reader, lambda f: f.sequence >= silent.sequence + 3)
        running.do(lambda: hardware_of(bus).restart(7, bus._clock()))
        read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE and not f.bus_reason.any())
    assert told(caplog, "bus bus0") == ["bus bus0: nothing is heard any more", "bus bus0: frames come again"]


def test_a_loss_that_a_send_swallowed_is_found_and_the_bus_opened_again() -> None:
    """The kernel reports a vanished interface once: to the next send, if that comes before the next receive."""
    bus, other = reporting(pattern="idle"), emulated(boards=(7,))
    with driving(bus, other) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status[:192].any())

        def vanish() -> None:
            bus.lost_in_silence = True
            bus.hardware = EmulatedRoboskin(EmulatedRoboskinOptions(boards=(9,)))  # nothing that is heard

        running.do(vanish)
        gone = read_until(reader, lambda f: f.bus_state[0] == BusState.GONE)
        assert gone.bus_reason[0] == BusReason.INTERFACE_GONE
        assert gone.bus_state[1] == BusState.LIVE
        bus.lost_in_silence = False
        read_until(reader, lambda f: f.bus_state[0] == BusState.SILENT)


def test_an_interface_that_opens_slowly_holds_up_no_other_bus() -> None:
    slow, other = reporting(SlowBus), emulated(boards=(7,))
    with driving(slow, other) as running, DriverReader("roboskin") as reader:
        first = read_until(reader, lambda f: not f.status.any())
        slow.opened_in.clear()
        slow.opening.clear()
        running.do(slow.go_down)
        wait_until(lambda: bool(slow.opened_in))
        held = read_until(reader, lambda f: f.bus_state[0] == BusState.DOWN)
        read_until(reader, lambda f: f.sequence >= held.sequence + 10 and not f.status[192:].any())
        read_until(reader, lambda f: bool((f.status[:192] & Status.STALE).all()) and not f.status[192:].any())
        slow.down = False
        slow.opening.set()
        back = read_until(reader, lambda f: not f.status.any())
        assert back.generation == first.generation
    assert threading.current_thread().name not in slow.opened_in


def test_a_driver_stops_while_an_interface_is_being_opened() -> None:
    slow = reporting(SlowBus)
    with driving(slow) as running:
        slow.opened_in.clear()
        slow.opening.clear()
        running.do(slow.go_down)
        wait_until(lambda: bool(slow.opened_in))
        assert running.runner is not None
        running.do(running.runner.stop)
        slow.down = False
        slow.opening.set()
    assert slow.fileno() == -1  # opened after all, and closed


def test_an_interface_that_hangs_while_it_is_opened_holds_up_no_other(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connection, "_OPENING_S", 0.2)
    slow, other = reporting(SlowBus), emulated(boards=(8,))
    slow.opening.clear()
    with driving(slow, other), DriverReader("roboskin") as reader:
        frame = follow(reader, lambda f: f.bus_state.tolist() == [BusState.CONNECTING, BusState.LIVE])
        assert (frame.bus_reason[0], frame.structure.n_patches) == (BusReason.FAILED, 1)
        follow(reader, lambda f: f.sequence >= frame.sequence + 10 and not f.status.any())
        slow.opening.set()
        follow(reader, lambda f: f.structure.n_patches == 2 and not f.status.any())
    assert len(slow.opened_at_s) == 1  # nobody tried again while it hung
    assert told(caplog, "bus bus0") == [
        "bus bus0 is not open after 0.2 s: its interface hangs; waiting for it to appear",
        "bus bus0 is there",
    ]


@pytest.mark.parametrize("is_there", [True, False])
def test_a_driver_stops_while_an_interface_hangs(
    is_there: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(runner, "_END_S", 0.2)
    slow = reporting(SlowBus)
    if not is_there:
        slow.opening.clear()
    with driving(slow, wait=is_there) as running:
        if is_there:
            slow.opened_in.clear()
            slow.opening.clear()
            running.do(slow.go_down)
        wait_until(lambda: bool(slow.opened_in))
    assert told(caplog, "bus bus0")[-1] == ("bus bus0: its interface is still being opened, and is left to itself")
    threads = threading.active_count()
    slow.down = False
    slow.opening.set()  # nobody waits for it any more
    wait_until(lambda: threading.active_count() < threads)
    assert slow.fileno() == -1


def test_interfaces_are_closed_side_by_side(caplog: pytest.LogCaptureFixture) -> None:
    class Closing(SlowBus):
        all_at_once = threading.Barrier(3)

        def close(self) -> None:
            if self.fileno() >= 0:
                self.all_at_once.wait(30)
            super().close()

    buses = [Closing("", hardware=EmulatedRoboskin(EmulatedRoboskinOptions(boards=(7,)))) for _ in range(3)]
    with driving(*buses):
        pass
    assert [bus.fileno() for bus in buses] == [-1, -1, -1]
    assert "hangs" not in caplog.text


def test_a_bus_that_cannot_be_opened_again_for_an_odd_reason_is_tried_for_ever(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bus = reporting()
    with caplog.at_level(logging.WARNING), driving(bus) as running, DriverReader("roboskin") as reader:
        real, tries = bus.open, []

        def fail() -> None:
            tries.append(1)
            raise OSError("the library is confused")

        monkeypatch.setattr(bus, "open", fail)
        running.do(bus.go_down)
        frame = read_until(reader, lambda f: f.bus_reason[0] == BusReason.FAILED)
        assert frame.bus_state[0] == BusState.GONE
        wait_until(lambda: len(tries) > 3)
        bus.down = False
        monkeypatch.setattr(bus, "open", real)
        read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE)
    assert caplog.text.count("the library is confused") == 1


# -- news ---------------------------------------------------------------------------------------------------------


class Unhurried(CanAdapter[NoOptions]):
    """Its devices answer, then say nothing for long while they are being set up."""

    layout = Layout([Frame("data", [Identifier(0x180)], (2,), Values(0, "u1", 2))])

    def __init__(self) -> None:
        super().__init__(NoOptions())
        self.while_set_up: Callable[[], object] = lambda: None

    async def start(self, link: Link) -> None:
        self.while_set_up()


@pytest.mark.parametrize("listen_only", [False, True])
def test_silence_counts_only_where_devices_send_of_themselves(
    listen_only: bool, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, adapter = Clock(), Unhurried()
    monkeypatch.setattr(bus_line, "now_ns", clock)
    with closing(select.epoll()) as epoll:
        line = BusLine("can0", 0, adapter, emulated(boards=(7,), listen_only=listen_only), epoll)
        asyncio.run(line.open())

        def hear() -> None:
            clock.pass_s(0.01)
            line.condition.heard_ns = clock()
            line.look(0)

        def say_nothing() -> None:
            clock.pass_s(10)
            line.look(0)
            assert line.condition.state == BusState.SILENT

        adapter.while_set_up = say_nothing
        with caplog.at_level(logging.WARNING):
            hear()  # an answer to the discovery, or what others made the devices send
            if not listen_only:
                asyncio.run(line.set_up())
                say_nothing()  # they take their time
            before = told(caplog, "bus can0")
            hear()
            say_nothing()
            hear()
        line.remove()
    assert before == []
    assert told(caplog, "bus can0") == ["bus can0: nothing is heard any more", "bus can0: frames come again"]


def test_a_bus_that_comes_and_goes_for_an_hour_fills_no_log(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    news = BusNews(clock)
    with caplog.at_level(logging.WARNING):
        for number in range(36_000):
            news.log(f"bus can0: change {number}")
            clock.pass_s(0.1)
        clock.pass_s(LINE_EVERY_S)
        news.catch_up()
        news.catch_up()
    lines = told(caplog, "bus can0")
    assert lines[:LINES_AT_ONCE] == [f"bus can0: change {number}" for number in range(LINES_AT_ONCE)]
    assert len(lines) <= LINES_AT_ONCE + 3600 / LINE_EVERY_S + 1
    assert lines[-1].startswith("bus can0: change 35999 (")  # the last word is never lost
    kept_back = sum(int(line.partition("(")[2].split()[0]) for line in lines if "(" in line)
    assert kept_back + len(lines) == 36_000


def test_a_quiet_bus_may_speak_at_length_again(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    news = BusNews(clock)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            for number in range(LINES_AT_ONCE):
                news.log(f"bus can0: {number}")
            clock.pass_s(LINES_AT_ONCE * LINE_EVERY_S)
    assert len(told(caplog, "bus can0")) == 3 * LINES_AT_ONCE
    assert "were not logged" not in caplog.text


def test_a_flapping_bus_of_a_running_driver_is_told_of_a_few_times(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus_line, "_FIRST_PAUSE_S", 0.001)
    monkeypatch.setattr(bus_line, "_LONGEST_PAUSE_S", 0.001)
    monkeypatch.setattr(news, "LINES_AT_ONCE", 3)
    bus = reporting()
    with caplog.at_level(logging.WARNING), driving(bus) as running, DriverReader("roboskin") as reader:
        flaps = 0

        def flap() -> None:
            nonlocal flaps
            if bus.fileno() >= 0:
                bus.fail_next_receive(BusNotAvailable("the bus went down", is_down=True))
                flaps += 1

        while flaps < 30:
            running.do(flap)
        read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE)
    assert len(told(caplog, "the bus went down")) + len(told(caplog, "bus bus0")) <= 3
