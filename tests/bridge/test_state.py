"""What a bridge tells of itself, and where people see it."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import pytest

from skinware import DriverWriter, ServiceWriter
from skinware.bridge.clock import answer_pings
from skinware.bridge_state import MOST, BridgeReader, BridgeState, BridgeStateWriter, ServiceState, service_name
from skinware.cli._report import report
from skinware.cli.info import as_text
from skinware.cli.top import show_lines
from skinware.errors import BadServiceFile
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.views.live import LiveBridges
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.rules import Severity
from skinware_drivers.testing.waiting import wait_until
from tests.bridge.rig import ROBOT, joined, publish, serving, structure
from tests.doctor.rig import found, looked

ARM = ServiceState("live", "pull", 20.0, 7, 1e6, 3e7, 9e7, 5.0)


def state(*, is_up: bool = True, **services: ServiceState) -> BridgeState:
    return BridgeState("walle", is_up, now_ns() - 3 * NS_PER_S, 40, 50_000, 300_000, services)


@contextmanager
def telling(told: BridgeState, namespace: Namespace) -> Iterator[None]:
    with BridgeStateWriter(told.robot, namespace) as writer:
        writer.publish(told, now_ns())
        yield


@pytest.mark.parametrize(
    "told",
    [
        state(),
        state(is_up=False, arm=ServiceState("unheard", "push")),
        state(arm=ARM, hand=ServiceState("paused", "push", 0.0, 0, 0.0)),
        BridgeState("walle", False, 0, None, None, 0, {}),
    ],
)
def test_what_is_told_is_what_is_read(namespace: Namespace, told: BridgeState) -> None:
    with telling(told, namespace), BridgeReader(service_name("walle"), namespace=namespace) as reader:
        assert reader.read(timeout_s=0).state == told


def test_more_services_than_there_is_room_for_are_left_out(namespace: Namespace) -> None:
    told = replace(state(), services={f"arm{number}": ARM for number in range(MOST + 3)})
    with telling(told, namespace), BridgeReader(service_name("walle"), namespace=namespace) as reader:
        assert len(reader.read(timeout_s=0).state.services) == MOST


def test_another_service_is_refused(namespace: Namespace) -> None:
    with (
        ServiceWriter("x", {"count": ("<u4", ())}, namespace=namespace, kind="bridge"),
        pytest.raises(BadServiceFile, match="no state of a bridge"),
    ):
        BridgeReader("x", namespace=namespace)


@pytest.mark.parametrize("text", [b"", b"{", b"\xff", b"[]", b'{"robot": 1}'])
def test_a_state_that_is_none_is_named_and_left_out(namespace: Namespace, text: bytes) -> None:
    with BridgeStateWriter("walle", namespace) as writer, telling(replace(state(), robot="eve"), namespace):
        writer.begin()["state"][...] = text
        writer.commit(now_ns())
        (problem,) = report(namespace)["problems"]
        assert problem.startswith("service 'walle-bridge' publishes no state of a bridge (")
        assert "\n" not in problem
        with contextlib.closing(LiveBridges(namespace, BridgeReader)) as live:
            live.look()
            assert [each.robot for each in live.states()] == ["eve"]


def test_a_bridge_tells_how_it_is_where_its_services_appear(namespace: Namespace) -> None:
    begin_ns = now_ns()
    with (
        joined(namespace, "push") as ends,
        serving(ends.net, ends.there),
        DriverWriter("arm", structure(), namespace=ends.there, rate_hz=50) as writer,
    ):

        def newest() -> BridgeState:
            publish(writer)
            return reader.read().state

        with BridgeReader(service_name(ROBOT), namespace=ends.here, timeout_s=30) as reader:
            wait_until(lambda: newest().is_up and bool(newest().services) and newest().services["arm"].rate_hz > 0)
            seen = newest()
            arm = seen.services["arm"]
            assert (arm.state, arm.mode) == ("live", "push")
            assert arm.age_p50_ns is not None
            assert arm.age_p99_ns is not None
            assert 0 < arm.age_p50_ns <= arm.age_p99_ns < now_ns() - begin_ns
            assert begin_ns < seen.since_ns < now_ns()
            assert seen.clock_offset_ns is not None
            assert seen.clock_error_ns is not None
            assert abs(seen.clock_offset_ns) <= seen.clock_error_ns
            ends.net.is_cut = True
            wait_until(lambda: not newest().is_up)
            assert newest().since_ns > seen.since_ns
            assert newest().services["arm"].state == "unheard"
            ends.net.is_cut = False
            wait_until(lambda: newest().is_up)


def test_the_true_error_of_the_clock_is_not_more_than_what_is_told(
    namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock of the robot's bridge is 0.1 s away and drifts by 50 parts in a million."""
    begin_ns, away_ns = now_ns(), 100_000_000

    def clock() -> int:
        return now_ns() + away_ns + round((now_ns() - begin_ns) * 50e-6)

    monkeypatch.setattr("skinware.bridge.serving.answer_pings", partial(answer_pings, clock=clock))
    ended = threading.Event()
    with joined(namespace, "push") as ends, serving(ends.net, ends.there):
        wait_until(lambda: ends.joiner.clock.is_known)
        for _ in range(30):
            ended.wait(0.05)
            with ends.joiner._mirror.lock:
                time_ns = now_ns()
                true_ns = -away_ns - round((time_ns - begin_ns) * 50e-6)
                assert abs(ends.joiner.clock.offset_ns(time_ns) - true_ns) <= ends.joiner.clock.error_ns


def test_people_see_it(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    with telling(state(arm=ARM), namespace):
        text = "\n".join(as_text(report(namespace)))
        assert re.search(r"robot walle heard for [\d.]+ s, its clock known to 50 us, round trip 0\.3 ms", text)
        assert [word for line in text.splitlines() if line.startswith("  arm") for word in line.split()] == (
            ["arm", "live", "pull", "20.0", "Hz", "30", "ms", "90", "ms", "7"]
        )
        show_lines(namespace, 0.05)
        assert "robot walle heard for" in capsys.readouterr().out
        assert any(one.what == "robot walle" for one in examine(looked(0.0)).looked)
        (slow,) = (finding for finding in found(0.0) if finding.area == "bridges")
        assert (slow.severity, slow.where) == (Severity.NOTE, "arm of robot walle")
    with telling(state(is_up=False, arm=ServiceState("unheard", "push")), namespace):
        (down,) = (finding for finding in found(0.0) if finding.area == "bridges")
        assert (down.severity, down.what) == (Severity.ERROR, "a robot is not heard over its bridge")
