"""A fault in a driver's own code: it never goes on as if nothing had happened, and no bus takes the others along."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager

import pytest

from skinware import BusReason, BusState, DriverReader
from skinware.errors import DriverError, PeerGone, RequestFailed
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.decoding.decoder import Updates
from skinware_drivers.description import Patch, SkinTables
from skinware_drivers.link import Link
from skinware_drivers.operations import operation
from skinware_drivers.polling import Poll, Watch
from skinware_drivers.running import serving
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import Event
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions as EmulatorOptions
from tests.sdk.driving import Driving, commands, driving, driving_lines, emulated, follow, hardware_of, troubled

pytestmark = pytest.mark.usefixtures("hurry")

HOOKS = ("describe", "configure", "start", "probe", "revive", "attend", "join", "polls")


class Faulty(RoboskinDriver):
    """A ROBOSKIN driver with a bug in one hook, on the bus with board 7.

    Attributes:
        fault: the hook.
        error: what it raises.
    """

    fault = ""
    error: type[BaseException] = KeyError

    def fail(self, name: str) -> None:
        if name == self.fault and 7 in self.options.boards:
            raise self.error("oops")

    async def describe(self, link: Link) -> Sequence[Patch]:
        self.fail("describe")
        return await super().describe(link)

    async def configure(self, link: Link) -> None:
        self.fail("configure")
        await super().configure(link)

    async def start(self, link: Link) -> None:
        self.fail("start")
        await super().start(link)

    async def stop(self, link: Link) -> None:
        self.fail("stop")
        await super().stop(link)

    async def probe(self, link: Link, patch: Patch) -> bool:
        self.fail("probe")
        return await super().probe(link, patch)

    async def revive(self, link: Link, patch: Patch) -> None:
        self.fail("revive")
        await super().revive(link, patch)

    async def attend(self, link: Link) -> None:
        self.fail("attend")

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
        self.fail("join")
        return known

    @property
    def polls(self) -> Sequence[Poll]:
        self.fail("polls")
        return ()


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "_FIRST_PAUSE_S", 0.5)
    monkeypatch.setattr(serving, "_LONGEST_PAUSE_S", 0.5)


def faulty(fault: str, error: type[BaseException] = KeyError) -> type[Faulty]:
    return type("Faulty", (Faulty,), {"fault": fault, "error": error})


@contextmanager
def fails(words: str, running: AbstractContextManager[Driving]) -> Iterator[Driving]:
    """A driver that ends by itself, with an error that says this."""
    ended_by_itself = False
    with pytest.raises(DriverError, match=words), running as driver:  # noqa: PT012
        yield driver
        wait_until(lambda: driver.failure is not None)
        ended_by_itself = True
    assert ended_by_itself


def provoke(running: Driving, bus: VirtualCanBus, fault: str) -> None:
    """Have the runner call a hook that is called only when something has happened."""
    if fault in ("probe", "revive"):
        running.do(lambda: hardware_of(bus).restart(7, bus._clock()))
    elif fault == "join":
        assert running.runner is not None
        running.do(running.runner.join)


@pytest.mark.parametrize(
    ("fault", "error"),
    [*((fault, KeyError) for fault in HOOKS), ("probe", SystemExit), ("attend", asyncio.CancelledError)],
)
def test_on_the_only_bus_it_ends_the_driver_with_bus_hook_and_cause(fault: str, error: type[BaseException]) -> None:
    bus = emulated(boards=(7,), boot_s=0.05)
    driver = faulty(fault, error)
    words = rf"^bus bus0: `{fault}` failed: \S*{error.__name__}.* \(test_failing_hooks.py, line \d+\)$"
    lines = [(driver(RoboskinOptions(boards=(7,))), bus)]
    with fails(words, driving_lines(lines, "roboskin", wait=False)) as running:
        wait_until(running.ready.is_set)
        provoke(running, bus, fault)


@pytest.mark.thorough
@pytest.mark.parametrize("fault", HOOKS)
def test_one_bus_is_set_aside_and_tried_again_and_the_others_go_on(
    fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    driver = faulty("" if fault in ("probe", "revive", "join") else fault)
    first, second = emulated(boards=(7,), boot_s=0.05), emulated(boards=(8,))
    lines = [(driver(RoboskinOptions(boards=(board,))), bus) for board, bus in ((7, first), (8, second))]
    with driving_lines(lines, "roboskin") as running, DriverReader("roboskin") as reader:
        follow(reader, lambda f: 0 in f.status)
        driver.fault = fault
        provoke(running, first, fault)
        follow(reader, lambda f: f.bus_reason[0] == BusReason.SET_ASIDE and f.bus_state[0] == BusState.DOWN)
        assert f"bus bus0: `{fault}` failed: KeyError" in caplog.text
        aside = follow(reader, lambda f: f.bus_state[1] == BusState.LIVE)
        newest_ns = int(aside.module_time_ns.max())
        follow(reader, lambda f: int(f.module_time_ns.max()) > newest_ns + 200_000_000)  # board 8 goes on
        driver.fault = ""
        both = follow(reader, lambda f: len(f.patch_state) == 2 and not f.status.any())
        assert both.bus_reason.tolist() == [BusReason.NONE, BusReason.NONE]


def test_the_driver_ends_when_the_last_bus_that_was_served_fails() -> None:
    class Faultier(Faulty):
        fault = "configure"

        def fail(self, name: str) -> None:
            if name == self.fault:
                raise KeyError("oops")

    lines = [(Faultier(RoboskinOptions(boards=(board,))), emulated(boards=(board,))) for board in (7, 8)]
    with (
        pytest.raises(DriverError, match="`configure` failed"),
        driving_lines(lines, "roboskin", wait=False) as running,
    ):
        wait_until(lambda: running.failure is not None)


@pytest.mark.parametrize("fault", ["describe", "configure", "start"])
def test_an_error_of_the_system_is_told_with_bus_and_hook_and_tried_again(
    fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    driver = faulty(fault, OSError)
    with driving_lines(
        [(driver(RoboskinOptions(boards=(7,))), emulated(boards=(7,)))], "roboskin", wait=False
    ) as running:
        wait_until(lambda: f"bus bus0: `{fault}` failed: OSError: oops" in caplog.text)
        driver.fault = ""
        wait_until(running.ready.is_set)
        assert running.failure is None


def test_an_error_of_the_system_in_attending_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    driver = faulty("attend", OSError)
    with driving_lines([(driver(RoboskinOptions(boards=(7,))), emulated(boards=(7,)))], "roboskin") as running:
        wait_until(lambda: "bus bus0: `attend` failed: OSError: oops" in caplog.text)
        with DriverReader("roboskin") as reader:
            first = follow(reader, lambda f: not f.status.any())
            follow(reader, lambda f: f.module_time_ns.min() > first.module_time_ns.max() + 2 * 10**9)
        assert running.failure is None
    assert caplog.text.count("`attend` failed") == 1


def test_what_is_no_patch_is_named() -> None:
    class Wrong(RoboskinDriver):
        async def describe(self, link: Link) -> Sequence[Patch]:
            return ["board 7"]  # type: ignore[list-item]

    words = "`describe` failed: TypeError: it returned 'board 7'"
    with fails(words, driving(emulated(boards=(7,)), driver=Wrong, wait=False)):
        pass


def test_a_stop_that_fails_skips_no_other_bus() -> None:
    log: list[Event] = []
    lines = [
        (faulty("stop")(RoboskinOptions(boards=(7,))), emulated(boards=(7,))),
        (RoboskinDriver(RoboskinOptions(boards=(8,))), emulated(log, boards=(8,))),
    ]
    with pytest.raises(DriverError, match="bus bus0: `stop` failed: KeyError"), driving_lines(lines, "roboskin"):
        pass
    assert commands(log)[-1][1:] == (0x208, "0701")


@pytest.mark.parametrize("when", ["made", "looking"])
def test_a_watch_that_fails_ends_the_driver(when: str) -> None:
    class Blind(Watch):
        def look(self, updates: Updates) -> None:
            raise KeyError("oops")

    class Watched(RoboskinDriver):
        @classmethod
        def watch(cls, tables: SkinTables) -> Watch:
            if when == "made":
                raise KeyError("oops")
            return Blind(tables)

    words = "bus bus0: `watch` failed" if when == "made" else "bus bus0: `Watch.look` failed"
    bus = emulated(boards=(7,), no_ack=("7/0",))
    with fails(f"{words}: KeyError: 'oops'", driving(bus, driver=Watched, wait=False)):
        pass


def test_a_watch_that_fails_after_an_operation_is_named() -> None:
    class Unforgiving(Watch):
        def forget(self, patch: int) -> None:
            raise KeyError("oops")

    class Watched(RoboskinDriver):
        @classmethod
        def watch(cls, tables: SkinTables) -> Watch:
            return Unforgiving(tables)

    words = "^bus bus0: `Watch.forget` failed: KeyError: 'oops'"
    with fails(words, driving(emulated(boards=(7,)), driver=Watched)), DriverReader("roboskin") as reader:
        with contextlib.suppress(PeerGone, RequestFailed):
            reader.call("rebaseline")


def test_a_watch_that_fails_for_a_known_suspect_is_named_and_nothing_has_changed() -> None:
    class Unsuspecting(Watch):
        def suspect(self, patch: int) -> None:
            raise KeyError("oops")

    class Watched(RoboskinDriver):
        @classmethod
        def watch(cls, tables: SkinTables) -> Watch:
            return Unsuspecting(tables)

    late = troubled(boards=(8,))
    late.down = True
    words = "^bus bus0: `Watch.suspect` failed: KeyError: 'oops'"
    with (
        fails(words, driving(emulated(boards=(7,)), late, driver=Watched)) as running,
        DriverReader("roboskin") as reader,
    ):
        before = follow(reader, lambda f: 0 in f.status)
        runner = running.runner
        assert runner is not None
        (board,) = runner.lines[0].patches or ()
        runner.lines[0].suspects.add(board.key)  # as if it had reported an error, and gone on sending
        late.down = False
        wait_until(lambda: running.failure is not None)
        assert reader.structure.n_patches == 1
        assert reader.generation == before.generation


@pytest.mark.parametrize(
    ("where", "error"),
    [("a take", KeyError), ("a take", SystemExit), ("a publication", KeyError), ("requests", KeyError)],
)
def test_nothing_that_fails_in_the_event_loop_is_only_logged(where: str, error: type[BaseException]) -> None:
    def fail(*_: object) -> None:
        raise error("oops")

    words = f"^the driver failed: {error.__name__}: '?oops'? "
    with fails(words, driving(emulated(boards=(7,)))) as running, DriverReader("roboskin") as reader:
        runner = running.runner
        assert runner is not None
        assert runner.builder.generation is not None
        assert runner.builder.desk is not None
        broken, method = {
            "a take": (runner.builder.generation, "digest"),
            "a publication": (runner.builder.generation.path, "publish_if_due"),
            "requests": (runner.builder.desk._server, "take"),
        }[where]
        running.do(lambda: setattr(broken, method, fail))
        with contextlib.suppress(PeerGone):
            reader.call("enable")


def test_a_bus_whose_code_fails_is_lost_and_opened_again(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(VirtualCanBus):
        fault = ""

        def receive(self, batch: FrameBatch, ordinal: int) -> int:
            if self.fault == "receive":
                self.fault = ""
                raise KeyError("oops")
            return super().receive(batch, ordinal)

        def check(self) -> None:
            if self.fault == "check":
                self.fault = ""
                raise KeyError("oops")

    bus = Broken("", hardware=EmulatedRoboskin(EmulatorOptions(boards=(7,))))
    with driving(bus) as running, DriverReader("roboskin") as reader:
        follow(reader, lambda f: not f.status.any())
        for fault in ("receive", "check"):
            bus.fault = fault
            if fault == "check":  # it is asked only when nothing comes
                running.do(lambda: hardware_of(bus).restart(7, bus._clock()))
            wait_until(lambda: f"bus bus0: `{fault}` failed: KeyError: 'oops'" in caplog.text)  # noqa: B023
            follow(reader, lambda f: not f.status.any() and f.bus_state[0] == BusState.LIVE)


def test_an_operation_that_fails_is_told_to_who_asked_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    class Operated(RoboskinDriver):
        @operation()
        async def polish(self, link: Link, patches: Sequence[Patch]) -> None:
            """Fail."""
            raise KeyError("oops")

    with driving(emulated(boards=(7,)), driver=Operated), DriverReader("roboskin") as reader:
        with pytest.raises(RequestFailed, match="KeyError: 'oops'"):
            reader.call("polish")
        follow(reader, lambda f: not f.status.any())
    assert "bus bus0: `polish` failed: KeyError: 'oops' (test_failing_hooks.py" in caplog.text
