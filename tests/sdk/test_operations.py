"""What user programs ask a running driver: operations on its boards, and frames on request."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Sequence
from typing import Any

import pytest

from skinware import DriverReader, Namespace, PatchState, Status
from skinware.errors import PeerGone, RequestCancelled, RequestFailed, RequestRefused, RequestTimeout
from skinware.realtime import now_ns
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.description import Patch
from skinware_drivers.link import Link
from skinware_drivers.loading import registered
from skinware_drivers.operations import operation, operations_of
from skinware_drivers.registry import DRIVERS, load_driver
from skinware_drivers.running.data_loop import Attention
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.hardware import Event
from tests.sdk.driving import commands, driving, emulated, hardware_of, read_until

pytestmark = pytest.mark.usefixtures("hurry")


def told(log: list[Event], since: int = 0) -> list[tuple[int, str]]:
    """(identifier, payload) of what boards were told, from a position of the log on."""
    return [(identifier, payload.replace(" ", "").upper()) for _, identifier, payload in commands(log)[since:]]


def test_a_driver_tells_what_it_can_do() -> None:
    with driving(emulated(boards=(7,))), DriverReader("roboskin") as reader:
        assert {name: text.split()[0] for name, text in reader.operations().items()} == {
            "enable": "Make",
            "rate": "Change",
            "rebaseline": "Make",
            "versions": "Return",
        }


def test_rebaseline_sets_up_the_patches_that_are_meant_and_no_other() -> None:
    log: list[Event] = []
    with driving(emulated(log, boards=(7, 8))), DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        assert reader.call("rebaseline", patch="board 8") == {"bus0": None}
        assert told(log, before) == [(0x208, "4D0032F0"), (0x208, "50000F02010022"), (0x208, "0700")]
        before = len(commands(log))
        assert reader.call("rebaseline", bus="bus0") == {"bus0": None}
        assert {identifier for identifier, _ in told(log, before)} == {0x207, 0x208}


def test_rebaseline_ends_a_suspicion() -> None:
    bus = emulated(boards=(7,))
    with driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: hardware_of(bus).set_triangle(7, 3, "no_ack", bus._clock()))
        read_until(reader, lambda f: bool((f.status & Status.SUSPECT).all()))
        running.do(lambda: hardware_of(bus).set_triangle(7, 3, "ack", bus._clock()))
        reader.call("rebaseline")
        read_until(reader, lambda f: not f.status.any())


def test_disabled_boards_stay_silent_until_they_are_enabled() -> None:
    log: list[Event] = []
    with driving(emulated(log, boards=(7, 8))), DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        reader.call("enable", patch="board 7", on=False)
        frame = read_until(reader, lambda f: f.patch_state[0] == PatchState.STALE)
        later = read_until(reader, lambda f: f.sequence > frame.sequence + 30)  # longer than it takes to probe
        read_until(
            reader,
            lambda f: f.sequence >= later.sequence and f.patch_state.tolist() == [PatchState.STALE, PatchState.LIVE],
        )
        assert told(log, before) == [(0x207, "0701")]  # nobody took it for restarted
        reader.call("enable", patch="board 7")
        read_until(reader, lambda f: f.patch_state[0] == PatchState.LIVE and not f.status.any())
        assert told(log, before) == [(0x207, "0701"), (0x207, "0700")]


def test_silence_counts_from_the_end_of_an_operation_that_changes_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    """A board that was enabled again is silent until it first sends: that must not look like a restart."""
    monkeypatch.setattr(Attention, "look", lambda *_: None)  # a hold-up would move the times
    with driving(emulated(boards=(7, 8))) as running, DriverReader("roboskin") as reader:
        from_ns = running.runner.builder.generation.publisher.patches.counts_from_ns  # type: ignore[union-attr]
        reader.call("versions")
        assert from_ns.tolist() == [0, 0]
        asked_ns = now_ns()
        reader.call("enable", patch="board 8")
        assert from_ns[0] == 0 < asked_ns < from_ns[1]


def test_another_rate() -> None:
    log: list[Event] = []
    with driving(emulated(log, boards=(7,))), DriverReader("roboskin") as reader:
        first = read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        assert reader.call("rate", hz=100) == {"bus0": 100.0}
        assert (0x207, "4D000AF0") in told(log, before)
        frame = read_until(reader, lambda f: f.generation != first.generation and not f.status.any())
        assert not reader.structure_changed  # the same sensors: users go on without noticing
        times = [read_until(reader, lambda _: True).acquired_ns for _ in range(40)]
        gaps_ms = sorted((b - a) / 1e6 for a, b in itertools.pairwise(times))
        assert gaps_ms[len(gaps_ms) // 2] < 25, "half of the updates come within 25 ms, which were 50 ms apart"
        assert frame.values.max() > 0


@pytest.mark.parametrize(
    ("operation", "arguments", "error", "words"),
    [
        ("rate", {"hz": 0}, RequestFailed, "bus0: 0 Hz: boards send every 1 to 255 ms"),
        ("rate", {"hz": 20, "patch": "board 7"}, RequestFailed, "do not name a patch"),
        ("rate", {}, RequestRefused, "missing a required argument: 'hz'; it takes: bus, patch, hz: 'float'"),
        ("enable", {"off": True}, RequestRefused, "unexpected keyword argument 'off'; it takes: bus, patch, on"),
        (
            "enable",
            {"patch": "board 9"},
            RequestRefused,
            "no patch 'board 9'; did you mean 'board 8'[?] There are: board 7, board 8",
        ),
        ("enable", {"bus": "can5"}, RequestRefused, "no bus 'can5' with patches; there are: bus0"),
        ("describe", {}, RequestRefused, "no operation 'describe'; there are: enable, rate, rebaseline"),
    ],
)
def test_bad_requests(operation: str, arguments: dict[str, Any], error: type[Exception], words: str) -> None:
    log: list[Event] = []
    with driving(emulated(log, boards=(7, 8))), DriverReader("roboskin") as reader:
        before = len(commands(log))
        with pytest.raises(error, match=words):
            reader.call(operation, **arguments)
        assert told(log, before) == []


def test_a_listener_does_nothing() -> None:
    bus = emulated(boards=(7,), streaming=True, listen_only=True)
    with (
        driving(bus, listen_only=True, learn_s=0.3),
        DriverReader("roboskin") as reader,
        pytest.raises(RequestRefused, match="this driver only listens"),
    ):
        reader.call("rebaseline")


class Slow(RoboskinDriver):
    """With operations that take their time, or go wrong."""

    calls = 0

    @operation()
    async def wait(self, link: Link, patches: Sequence[Patch], seconds: float) -> int:
        """Wait."""
        del patches
        Slow.calls += 1
        await link.sleep(seconds)
        return Slow.calls

    @operation()
    async def fail(self, link: Link, patches: Sequence[Patch]) -> None:
        """Fail."""
        raise RuntimeError(f"{len(patches)} patches on {link.bus_name} are hot")


def test_a_slow_operation_holds_up_neither_frames_nor_other_requests() -> None:
    Slow.calls = 0
    with driving(emulated(boards=(7,)), driver=Slow) as running, DriverReader("roboskin") as reader:
        slow = reader.ask("wait", seconds=30)
        frame = reader.read()
        read_until(reader, lambda f: f.sequence > frame.sequence + 5)
        assert not slow.done()
        assert "wait" in reader.operations()
        queued = reader.ask("wait", seconds=0)  # one at a time on a bus
        slow.cancel()
        with pytest.raises(RequestCancelled):
            slow.result(1.0)
        with pytest.raises(RequestTimeout):
            queued.result(0.1)
        waiting = reader.ask("wait", seconds=0)
        running.stop()
        with pytest.raises(PeerGone):
            waiting.result(10.0)
        assert Slow.calls == 1


def test_what_goes_wrong_on_a_bus_is_told_with_its_name() -> None:
    with driving(emulated(boards=(7,)), emulated(boards=(8, 9)), driver=Slow), DriverReader("roboskin") as reader:
        with pytest.raises(RequestFailed) as caught:
            reader.call("fail")
        assert "bus0: RuntimeError: 1 patches on" in str(caught.value)
        assert "bus1: RuntimeError: 2 patches on" in str(caught.value)
        assert reader.call("wait", seconds=0).keys() == {"bus0", "bus1"}


@pytest.mark.parametrize("publish", ["cycle", "rate", "request"])
def test_a_frame_on_request_is_newer_than_the_request(publish: Any) -> None:
    with driving(emulated(boards=(7, 8)), publish=publish), DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any()) if publish != "request" else reader.request()
        for _ in range(5):
            asked_ns = now_ns()
            frame = reader.request()
            new = frame.module_time_ns >= asked_ns
            assert new.any()
            assert frame.acquired_ns >= asked_ns
            if publish != "rate":  # a whole burst, of one board at least
                assert new.reshape(2, 16).all(axis=1).any()


def test_nothing_is_published_that_nobody_asked_for() -> None:
    with driving(emulated(boards=(7,)), publish="request") as running, DriverReader("roboskin") as reader:
        frame = reader.request()
        updates = running.status()["patches"][0]["updates"]
        wait_until(lambda: running.status()["patches"][0]["updates"] > updates + 16 * 10)
        assert reader.read().sequence == frame.sequence
        assert reader.request().sequence == frame.sequence + 1


def test_a_request_to_a_dead_skin_is_answered_with_its_state() -> None:
    bus = emulated(boards=(7,))
    with driving(bus, publish="request") as running, DriverReader("roboskin") as reader:
        reader.request()
        running.do(lambda: hardware_of(bus).kill(7, bus._clock()))
        wait_until(lambda: bool((reader.request().status & Status.STALE).all()))


def test_requests_go_on_after_the_files_were_removed() -> None:
    with driving(emulated(boards=(7,))), DriverReader("roboskin") as reader:
        assert reader.operations()
        place = Namespace()
        place.socket_path("roboskin").unlink()
        place.ring_path("roboskin").unlink()
        wait_until(lambda: place.ring_path("roboskin").exists() and place.socket_path("roboskin").exists())
        with DriverReader("roboskin") as another:
            assert another.operations().keys() == {"enable", "rate", "rebaseline", "versions"}
            assert another.request().sequence > 0


def test_operations_are_coroutines_of_the_loop() -> None:
    """An operation runs in the driver's loop, not in a thread: it may touch what handshakes touch."""
    loops: list[object] = []

    class Looking(RoboskinDriver):
        @operation()
        async def look(self, link: Link, patches: Sequence[Patch]) -> None:
            """Look."""
            del link, patches
            loops.append(asyncio.get_running_loop())

    with driving(emulated(boards=(7,)), driver=Looking) as running, DriverReader("roboskin") as reader:
        reader.call("look")
        assert loops == [running._loop]


def test_a_driver_that_publishes_on_request_only_makes_a_removed_socket_again(namespace: Namespace) -> None:
    """Nobody can ask for a frame without it, and without a frame the driver has no other reason to look."""
    with driving(emulated(boards=(7,)), publish="request"), DriverReader("roboskin") as reader:
        reader.request()
        namespace.socket_path("roboskin").unlink()
        wait_until(namespace.socket_path("roboskin").exists)


@pytest.mark.parametrize("driver", sorted(registered(DRIVERS)))
def test_what_only_returns_something_needs_no_confirmation(driver: str) -> None:
    for name, declared in operations_of(load_driver(driver), alone=True).items():
        returns = (declared.method.__doc__ or "").startswith("Return ")
        assert declared.looks or not returns, f"{driver}: {name} changes nothing: declare looks=True"
