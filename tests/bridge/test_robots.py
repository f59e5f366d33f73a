"""Several robots over one network: none is ever taken for another."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from skinware import DriverReader, DriverWriter
from skinware.bridge.messages import Keys, Summary
from skinware.bridge.watching import Watcher
from skinware.memory.namespace import Namespace
from skinware_drivers.testing.waiting import wait_until
from tests.bridge.net import Net, NetLink
from tests.bridge.rig import joining, network, publish, serving, structure


def driver(namespace: Namespace) -> DriverWriter:
    return DriverWriter("arm", structure(), namespace=namespace, rate_hz=50)


@pytest.mark.thorough
@pytest.mark.parametrize("mode", ["push", "pull"])
def test_two_robots_of_one_name_are_told_and_never_mixed(namespace: Namespace, mode: str) -> None:
    with ExitStack() as stack:
        net = stack.enter_context(network())
        ends = stack.enter_context(joining(net, namespace, mode))
        seen: list[int] = []

        def sees(value: int) -> bool:
            for writer, own in ((first, 1), (second, 2)):
                publish(writer, own)
            try:
                with DriverReader("arm", namespace=ends.here) as reader:
                    seen.append(int(reader.read().values[0]) if reader.alive else 0)
            except Exception:  # noqa: BLE001, not there yet
                return False
            return seen[-1] == value

        other = Namespace(f"{namespace.name}-other")
        stack.callback(shutil.rmtree, other.path, ignore_errors=True)
        first, second = stack.enter_context(driver(namespace)), stack.enter_context(driver(other))
        with ExitStack() as one:
            one.enter_context(serving(net, namespace))
            wait_until(lambda: sees(1))
            served = next(event for event in ends.events if event["event"] == "connected")
            stack.enter_context(serving(net, other))
            wait_until(lambda: any("served by two bridges" in event.get("why", "") for event in ends.events))
            for _ in range(50):
                sees(1)
            assert set(seen) <= {0, 1}
        wait_until(lambda: sees(2))
        values = [value for value in seen if value]
        assert values == sorted(values), "the first came back after the other"
        (switched,) = (event for event in ends.events if event["event"] == "switched")
        assert switched["robot"] == served["robot"]
        assert switched["instance"] != served["instance"]
        assert served["instance"][:8] in switched["why"], "the bridge that was followed before is not named"


@contextmanager
def watching(net: Net) -> Iterator[Watcher]:
    link = NetLink(net)
    watcher = Watcher(link)
    thread = threading.Thread(target=watcher.run, name="watch")
    thread.start()
    try:
        yield watcher
    finally:
        watcher.stop()
        thread.join()
        link.close()


def told(watcher: Watcher, robot: str) -> Summary | None:
    return next((seen.summary for seen in watcher.robots() if seen.robot == robot), None)


def state(watcher: Watcher) -> str:
    """Of the left robot's arm."""
    summary = told(watcher, "left")
    return "" if summary is None else summary.drivers["arm"].state


@pytest.mark.thorough
def test_each_robot_tells_how_it_is(namespace: Namespace) -> None:
    with ExitStack() as stack:
        net = stack.enter_context(network())
        watcher = stack.enter_context(watching(net))
        other = Namespace(f"{namespace.name}-other")
        stack.callback(shutil.rmtree, other.path, ignore_errors=True)
        writers = [stack.enter_context(driver(place)) for place in (namespace, other)]
        stack.enter_context(serving(net, namespace, "left"))
        with serving(net, other, "right"):
            summaries: dict[str, Summary] = {}

            def all_told() -> bool:
                for writer in writers:
                    publish(writer)
                summaries.update((name, summary) for name in ("left", "right") if (summary := told(watcher, name)))
                return len(summaries) == 2 and all(
                    summary.drivers and summary.drivers["arm"].rate_hz > 0 for summary in summaries.values()
                )

            wait_until(all_told)
            arm = summaries["left"].drivers["arm"]
            assert (arm.state, arm.sensors, arm.fresh, arm.patches) == ("live", 64, 64, 1)
            assert (arm.silent, arm.n_silent) == (("palm",), 1)
            assert arm.problems == 2, "patch and bus have said nothing of their state"
            assert arm.age_ms is not None
            assert arm.age_ms >= 0
            assert summaries["right"].namespace == other.name
            wait_until(lambda: all(seen.clock.is_known for seen in watcher.robots()))
            writers[0].desert()
            wait_until(lambda: state(watcher) == "dead")
            summary = told(watcher, "left")
            assert summary is not None
            assert (summary.drivers["arm"].fresh, summary.drivers["arm"].problems) == (0, 1)
            again = stack.enter_context(driver(namespace))

            def is_back() -> bool:
                publish(again)
                return state(watcher) == "live"

            wait_until(is_back)
        wait_until(lambda: [seen.robot for seen in watcher.robots()] == ["left"])
        with serving(net, other, "left"):
            wait_until(lambda: [seen.robot for seen in watcher.robots()] == ["left", "left"])
            wait_until(lambda: {seen.summary and seen.summary.namespace for seen in watcher.robots()} >= {other.name})
        assert all(seen.bytes < 10_000 for seen in watcher.robots())


def test_nothing_is_told_where_nobody_listens_and_nonsense_is_left_out(namespace: Namespace) -> None:
    with network() as net, serving(net, namespace) as server, driver(namespace) as writer:
        publish(writer)
        kinds: list[str] = []

        def loses(kind: str, _key: str) -> bool:
            kinds.append(kind)
            return False

        net.loses = loses
        wait_until(lambda: server.frames().get("arm", ("", 0, 0))[1] > 0)
        assert not kinds
        with watching(net) as watcher:
            wait_until(lambda: told(watcher, "walle") is not None)
            nonsense = NetLink(net)
            for payload in (b"", b"\xff\xfe", b"[]", b'{"drivers": 5}'):
                nonsense.put(Keys("walle", watcher.robots()[0].instance).summary, payload)
                nonsense.put(Keys("eve", "00000000000000ee").summary, payload)
            net.idle()
            assert [seen.robot for seen in watcher.robots()] == ["walle"]


def test_a_robot_of_another_version_is_there_and_tells_nothing() -> None:
    with network() as net, watching(net) as watcher:
        other = NetLink(net)
        other.declare_token("skinware/live/eve/9/abcd")
        wait_until(lambda: [(seen.robot, seen.version) for seen in watcher.robots()] == [("eve", 9)])
        other.close()
        wait_until(lambda: not watcher.robots())


@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_robot_that_goes_as_its_clock_is_asked_for_leaves_nothing(moment: str) -> None:
    with network() as net:
        robot = NetLink(net)

        class Vanishing(NetLink):
            """The robot goes right before, or right after, somebody listens to the answers of its clock."""

            def listen(self, key: str, heard: Callable[[str, bytes], object]) -> Callable[[], None]:
                end = super().listen(key, heard) if moment == "after" else None
                if "/pong/" in key:
                    robot.close()
                    net.idle()
                    watcher.stop()
                return end or super().listen(key, heard)

        link = Vanishing(net)
        watcher = Watcher(link)
        robot.declare_token(Keys("eve", "00000000000000ee").token)
        watcher.run()
        assert not watcher.robots()
        assert not [key for key, _ in net.listeners if "/pong/" in key]
        link.close()
