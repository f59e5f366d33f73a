"""What a graph is told of drivers that come, change, hang, die and come back, with a carrier of this process."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, DriverWriter, Namespace, Status
from skinware.conversion.ros_messages import Cdr
from skinware.errors import Paused
from skinware.ros2.serving import DriverTopics
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, publishing
from tests.recording.test_viewers import placed
from tests.ros2.graph import Graph, served

FRAMES, SENSORS, POINTS = "/skin/arm/frame", "/skin/arm/sensors", "/skin/arm/points/pressure"


def small(patches: int = 1) -> Any:
    return placed(fake_structure(patches, 2))


def told(graph: Graph, topic: str, count: int = 1) -> list[Any]:
    wait_until(lambda: len(graph.heard(topic)) >= count)
    return graph.heard(topic)


def heard_from(graph: Graph, topic: str, skin: FakeSkin) -> Any:
    """A message of a frame that is published now, once its topic is there."""
    before = len(graph.heard(topic))

    def came() -> bool:
        skin.publish()
        return len(graph.heard(topic)) > before

    wait_until(came)
    return graph.heard(topic)[-1]


def test_every_frame_comes_to_who_wants_each(namespace: Namespace) -> None:
    with FakeSkin("arm", small()) as skin, served(namespace) as (graph, server):
        graph.wanted = {FRAMES}
        heard_from(graph, FRAMES, skin)
        wait_until(lambda: graph.heard(FRAMES)[-1].sequence == skin.writer.sequence)
        begin, lost = skin.writer.sequence, server.drivers()["arm"].missed
        for _ in range(50):
            skin.publish()
            wait_until(lambda: graph.heard(FRAMES)[-1].sequence == skin.writer.sequence)
        sequences = [each.sequence for each in graph.heard(FRAMES)]
        assert sequences[sequences.index(begin) :] == list(range(begin, begin + 51))
        (sensors,) = graph.heard(SENSORS)
        assert sensors.generation == graph.heard(FRAMES)[-1].generation
        assert np.array_equal(sensors.uid, skin.structure.sensor_uid)
        assert server.drivers()["arm"].missed == lost
        assert graph.heard(POINTS) == []  # nobody wants them


def test_pictures_come_no_faster_than_wanted(namespace: Namespace) -> None:
    with publishing(FakeSkin("arm", small()), 200), served(namespace, rate_hz=5) as (graph, _):
        graph.wanted = {POINTS, FRAMES}
        begin = time.monotonic()
        points = told(graph, POINTS, 6)
        assert time.monotonic() - begin > 0.5  # at 200 Hz it would be 0.03 s
        told(graph, FRAMES, len(points) + 1)
        assert points[0].header.frame_id == "chest"


def test_frames_that_were_too_fast_are_counted_only_for_who_wants_each(namespace: Namespace) -> None:
    with FakeSkin("arm", small(), slots=2) as skin, served(namespace) as (graph, server):
        skin.publish()
        told(graph, SENSORS)
        skin.publish(30)
        assert server.drivers()["arm"].missed == 0
        graph.wanted = {FRAMES}
        heard_from(graph, FRAMES, skin)
        heard_from(graph, FRAMES, skin)

        def lost_some() -> bool:
            skin.publish(30)  # at once: most of them cannot be taken
            return server.drivers()["arm"].missed > 0

        wait_until(lost_some)


def test_a_restart_with_other_sensors_is_followed(namespace: Namespace) -> None:
    with served(namespace) as (graph, server):
        graph.wanted = {FRAMES, POINTS, "/skin/arm/points/temperature"}
        with FakeSkin("arm", small(1)) as skin:
            heard_from(graph, FRAMES, skin)
        with FakeSkin("arm", small(2)) as skin:
            wait_until(lambda: len(heard_from(graph, FRAMES, skin).value) == skin.structure.n_sensors)
            frame = graph.heard(FRAMES)[-1]
            sensors = graph.heard(SENSORS)[-1]
            assert (sensors.generation, len(sensors.uid)) == (frame.generation, skin.structure.n_sensors)
            structure = skin.structure
            only_pressure = structure.only(np.arange(structure.n_sensors)[structure.index("pressure")])
            skin.writer.restructure(only_pressure)
            columns = skin.writer.begin()
            columns["module_time_ns"][:] = time.monotonic_ns()
            skin.writer.commit(time.monotonic_ns())
            wait_until(lambda: len(graph.heard(FRAMES)[-1].value) == only_pressure.n_sensors)
            wait_until(lambda: "/skin/arm/points/temperature" not in graph.publishers)
            assert POINTS in graph.publishers
        wait_until(lambda: server.drivers()["arm"].state == "gone")


def test_states_are_taken_between_two_turns(namespace: Namespace, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another thread may ask while the server attaches to drivers, reads them, and forgets them."""
    publish, amid, answered = DriverTopics.publish, threading.Event(), threading.Event()
    answered_amid = []

    def slow_publish(*arguments: Any, **options: Any) -> None:
        amid.set()
        answered_amid.append(answered.wait(0.05))
        publish(*arguments, **options)

    def ask() -> set[str]:
        found = set(server.drivers())
        answered.set()
        return found

    monkeypatch.setattr(DriverTopics, "publish", slow_publish)
    with FakeSkin("arm", small()) as skin, served(namespace) as (_, server), ThreadPoolExecutor() as pool:
        skin.publish()
        amid.wait()
        assert pool.submit(ask).result() == {"arm"}
    assert not answered_amid[0]


def test_values_are_never_told_under_the_sensors_of_another_generation(namespace: Namespace) -> None:
    """A driver that changes all the time: the number of values is always that of the sensors told for it."""
    with served(namespace) as (graph, _):
        graph.wanted = {FRAMES}
        for round_ in range(12):
            with FakeSkin("arm", small(1 + round_ % 3)) as skin:
                heard_from(graph, FRAMES, skin)
        of_generation = {each.generation: len(each.uid) for each in graph.heard(SENSORS)}
        for frame in graph.heard(FRAMES):
            assert len(frame.value) == len(frame.status) == of_generation[frame.generation]


def told_after(graph: Graph, count: int) -> Any:
    """Diagnostics of a turn that began after so many."""
    return told(graph, "/diagnostics", count + 2)[count + 1]


def last_status(graph: Graph) -> Any:
    return graph.heard(FRAMES)[-1].status


@pytest.mark.thorough
def test_what_a_killed_driver_leaves_is_stale_and_it_may_come_back(namespace: Namespace) -> None:
    with served(namespace) as (graph, server):
        graph.wanted = {FRAMES, "/diagnostics"}
        with fake_process("arm") as process:
            told(graph, FRAMES, 3)
            wait_until(lambda: not (last_status(graph) & Status.STALE).all())
            process.kill()
            process.wait()
            wait_until(lambda: server.drivers()["arm"].state == "dead")
            told_dead = told_after(graph, len(graph.heard("/diagnostics")))
            assert told_dead.status[0].level == 2
            wait_until(lambda: bool((last_status(graph) & Status.STALE).all()))
            count = len(graph.heard(FRAMES))
            told_after(graph, len(graph.heard("/diagnostics")))
            assert len(graph.heard(FRAMES)) == count  # it is told once
        with fake_process("arm"):
            wait_until(lambda: not (last_status(graph) & Status.STALE).all())
            wait_until(lambda: server.drivers()["arm"].state == "live")


@pytest.mark.thorough
def test_a_driver_that_hangs_is_stale_until_it_goes_on(namespace: Namespace) -> None:
    with fake_process("arm") as process, served(namespace) as (graph, server):
        graph.wanted = {FRAMES}
        told(graph, FRAMES, 2)
        process.send_signal(signal.SIGSTOP)
        try:
            wait_until(lambda: bool((last_status(graph) & Status.STALE).all()))
            wait_until(lambda: server.drivers()["arm"].state == "silent")
        finally:
            process.send_signal(signal.SIGCONT)
        wait_until(lambda: not (last_status(graph) & Status.STALE).all())


def test_diagnostics_tell_what_is_wrong(namespace: Namespace) -> None:
    skin = FakeSkin("arm", fake_structure(4, 2))
    skin.break_some()
    skin.bus_state[0], skin.bus_reason[0] = 3, 6
    with publishing(skin), served(namespace) as (graph, _):
        graph.wanted = {"/diagnostics"}

        statuses: list[Any] = []

        def both_live() -> bool:
            statuses[:] = [each for message in graph.heard("/diagnostics")[-1:] for each in message.status]
            return len(statuses) == 2

        wait_until(both_live)
        driver, bus = statuses
        fresh = int((skin.status == 0).sum())
        assert (driver.name, driver.level, driver.hardware_id) == ("skin: arm", 1, "fake")
        assert driver.message == f"{fresh} of {len(skin.status)} sensors are fresh"
        values = {each.key: each.value for each in driver.values}
        assert (values["state"], values["fresh"], values["unknown"]) == ("live", str(fresh), "7")
        assert (bus.name, bus.level, bus.message) == ("skin: arm: can0", 2, "down: bus_off")


def test_only_those_that_were_named_are_told(namespace: Namespace) -> None:
    with FakeSkin("arm", small()) as arm, FakeSkin("leg", small()), served(namespace, "arm") as (graph, server):
        graph.wanted = {FRAMES}
        heard_from(graph, FRAMES, arm)
        assert set(server.drivers()) == {"arm"}
        assert not any("leg" in topic for topic in graph.publishers)


def test_two_drivers_with_one_topic(namespace: Namespace) -> None:
    troubles: list[str] = []
    with FakeSkin("left-arm", small()), FakeSkin("left_arm", small()):
        with served(namespace, trouble=troubles.append) as (_, server):
            wait_until(lambda: bool(troubles))
            assert set(server.drivers()) == {"left-arm"}
    assert troubles == ["driver 'left_arm' is left out: another one has its topics, /skin/left_arm/..."]


def test_a_carrier_that_takes_no_more_costs_nobody_else_anything(namespace: Namespace) -> None:
    with publishing(FakeSkin("arm", small())), served(namespace) as (graph, server):
        graph.wanted = {FRAMES, POINTS}
        graph.slow = {POINTS}
        told(graph, FRAMES, 20)
        wait_until(lambda: server.drivers()["arm"].left_out > 2)
        assert graph.heard(POINTS) == []
        graph.slow = set()
        told(graph, POINTS)


def test_topics_may_be_in_a_namespace_of_ros(namespace: Namespace) -> None:
    with FakeSkin("arm", small()) as skin, served(namespace, prefix="/robot", with_tare=True) as (graph, _):
        graph.wanted = {"/robot/skin/arm/frame", "/robot/skin/arm/points/pressure"}
        heard_from(graph, "/robot/skin/arm/frame", skin)
        heard_from(graph, "/robot/skin/arm/points/pressure", skin)
        assert "/diagnostics" in graph.publishers
        assert "/robot/skin/arm/tare" in graph.services


def test_no_transform_is_published(namespace: Namespace) -> None:
    """A robot's own description places these frames: a second parent would tear its tree."""
    with FakeSkin("arm", small()) as skin, served(namespace) as (graph, _):
        graph.wanted = {FRAMES}
        heard_from(graph, FRAMES, skin)
        assert "/tf_static" not in graph.publishers


# -- taring -----------------------------------------------------------------------------------------------------------


@contextmanager
def tareable(namespace: Namespace, error: str = "") -> Iterator[DriverWriter]:
    """A driver that publishes, and counts in its values how often it was tared."""
    writer = DriverWriter("arm", small(), namespace=namespace, operations={"tare": lambda: None})
    requests, ended = writer.request_server(), threading.Event()

    def work() -> None:
        tared = 0
        while not ended.is_set():
            for request in requests.take(0.005):
                if error:
                    request.fail(error)
                else:
                    tared += 1
                    request.reply()
            with contextlib.suppress(Paused):
                columns = writer.begin()
                columns["values"][:] = tared
                columns["module_time_ns"][:] = time.monotonic_ns()
                writer.commit(time.monotonic_ns())

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield writer
    finally:
        ended.set()
        thread.join()
        writer.close()


def test_a_service_tares_and_tells_the_drivers_errors(namespace: Namespace) -> None:
    with served(namespace, with_tare=True) as (graph, _):
        with tareable(namespace) as writer:
            wait_until(lambda: "/skin/arm/tare" in graph.services)
            answer = graph.call("/skin/arm/tare")
            assert (answer.success, answer.message) == (True, "")
            with DriverReader("arm", namespace=namespace) as reader:
                wait_until(lambda: bool((reader.read().values == 1).all()))
            writer.pause()
            answer = graph.call("/skin/arm/tare")
            assert not answer.success
            assert "paused" in answer.message
        answer = graph.call("/skin/arm/tare")
        assert not answer.success
        assert "'arm'" in answer.message
        with tareable(namespace, error="the valve is stuck"):
            answer = graph.call("/skin/arm/tare")
            assert not answer.success
            assert "the valve is stuck" in answer.message


def test_a_driver_that_cannot_be_tared_says_so(namespace: Namespace) -> None:
    with publishing(FakeSkin("arm", small())), served(namespace, with_tare=True) as (graph, _):
        wait_until(lambda: "/skin/arm/tare" in graph.services)
        answer = graph.call("/skin/arm/tare")
        assert not answer.success
        assert answer.message


def test_the_graph_can_only_read_by_default(namespace: Namespace) -> None:
    with FakeSkin("arm", small()) as skin, served(namespace) as (graph, _):
        graph.wanted = {FRAMES}
        heard_from(graph, FRAMES, skin)
        assert not graph.services


def test_the_end_of_the_bridge_waits_for_no_driver(namespace: Namespace) -> None:
    """A driver that takes a request and never answers."""
    with DriverWriter("arm", small(), namespace=namespace, operations={"tare": lambda: None}) as writer:
        writer.request_server()
        columns = writer.begin()
        columns["module_time_ns"][:] = time.monotonic_ns()
        writer.commit(time.monotonic_ns())
        answers: list[Any] = []
        with served(namespace, with_tare=True) as (graph, _):
            wait_until(lambda: "/skin/arm/tare" in graph.services)
            handler = graph.services["/skin/arm/tare"]
            asking = threading.Thread(target=lambda: answers.append(handler(Cdr().numbers("B", 0).done())))
            asking.start()
        asking.join(5)
        assert not asking.is_alive()
        assert b"cancelled" in answers[0]
