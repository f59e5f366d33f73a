"""A node over zenoh, in a graph with a router and a peer that was written from the documentation of rmw_zenoh alone."""

from __future__ import annotations

import itertools
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from skinware.errors import BridgeError, ConfigurationError
from skinware.memory.namespace import Namespace
from skinware.ros2.rmw_zenoh import ZenohNode
from skinware.ros2.transport import Distro, MessageType, NodeIdentity, Qos, ServiceType
from skinware_drivers.testing.waiting import PATIENCE_S, wait_until
from tests.ros2.graph_peer import GID, Found, GraphPeer, Heard, Message, peer
from tests.ros2.router import Router, router, sockets

STRING = MessageType("std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")
TRIGGER = ServiceType(
    "std_srvs/srv/Trigger",
    "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    MessageType("std_srvs/srv/Trigger_Request", "RIHS01_0"),
    MessageType("std_srvs/srv/Trigger_Response", "RIHS01_0"),
)
HELLO = b"\x00\x01\x00\x00\x06\x00\x00\x00hello\x00"


READY = b"ready"
"""Asked first, so that a service is known to who asks."""


@contextmanager
def node(at: Router, identity: NodeIdentity, tell: Callable[[bool, str], None] = print) -> Iterator[ZenohNode]:
    one = ZenohNode(identity, connect=[at.endpoint], router_changed=tell)
    try:
        yield one
    finally:
        one.close()


@dataclass
class Graph:
    """A node of ours, and another one.

    Attributes:
        at: router by which they find each other.
        domain: that only they have.
        skin: ours.
        other: the other.
    """

    at: Router
    domain: int
    skin: ZenohNode
    other: GraphPeer


@contextmanager
def graph_at(at: Router, domain: int) -> Iterator[Graph]:
    with node(at, NodeIdentity("skin", "/icub", domain)) as skin, peer(at.endpoint, domain) as other:
        yield Graph(at, domain, skin, other)


@pytest.fixture(scope="module")
def at() -> Iterator[Router]:
    """A router of tests that do not end it. Zenoh's threads have descriptors of their own, which stay from now on."""
    with router() as one:
        with graph_at(one, 0) as graph:
            publisher = graph.skin.publisher("/skin/arm/greeting", STRING, Qos())
            publishing(publisher, graph.other.hear(graph.other.wait_for("MP", "/skin/arm/greeting")))
        yield one


@pytest.fixture
def sessions_end(at: Router, namespace: Namespace) -> Iterator[None]:
    """Before anybody looks for leaks, all sockets and threads of the test's sessions are gone."""
    before, threads = sockets(), set(threading.enumerate())
    yield
    wait_until(lambda: sockets() <= before and set(threading.enumerate()) <= threads)


_domains = itertools.count(1)


@pytest.fixture
def graph(at: Router, sessions_end: None) -> Iterator[Graph]:
    with graph_at(at, next(_domains)) as one:
        yield one


def publishing(publisher: Any, heard: Heard, message: bytes = HELLO) -> None:
    """Publish until one more is heard: a subscriber is known to publishers only after a while."""
    before = len(heard)

    def another() -> bool:
        publisher.publish(message)
        return len(heard) > before

    wait_until(another)


def test_a_topic_is_found_and_heard(graph: Graph) -> None:
    skin, other = graph.skin, graph.other
    publisher = skin.publisher("/skin/arm/greeting", STRING, Qos(depth=3))
    assert other.wait_for("NN", "/icub/skin").kind == "NN"
    topic = other.wait_for("MP", "/skin/arm/greeting")
    assert (topic.node, topic.type_name, topic.type_hash) == (
        "/icub/skin",
        "std_msgs::msg::dds_::String_",
        STRING.hash,
    )
    assert topic.qos == ("", "", ",3", ",", ",", ",,")
    heard, before_ns = other.hear(topic), time.time_ns()
    publishing(publisher, heard)
    first = heard.messages[0]
    assert first.payload == HELLO
    assert first.gid == topic.gid
    assert before_ns <= first.time_ns <= time.time_ns()
    for text in (b"a", b"b"):
        publishing(publisher, heard, text)
    sequences = [message.sequence for message in heard.messages]
    assert sequences == sorted(set(sequences))


def test_sequences_begin_with_one_and_each_publisher_has_its_own(graph: Graph) -> None:
    skin, other = graph.skin, graph.other
    publishers = [skin.publisher(f"/skin/arm/{name}", STRING, Qos()) for name in "ab"]
    topics = [other.wait_for("MP", f"/skin/arm/{name}") for name in "ab"]
    heard = [other.hear(topic) for topic in topics]
    wait_until(lambda: all(publisher.is_wanted for publisher in publishers))
    for publisher in publishers:
        assert publisher.publish(HELLO)
    wait_until(lambda: all(heard))
    assert [one.messages[0].sequence for one in heard] == [1, 1]
    assert heard[0].messages[0].gid != heard[1].messages[0].gid


def test_it_is_known_whether_anybody_listens(graph: Graph) -> None:
    skin, other = graph.skin, graph.other
    publisher = skin.publisher("/skin/arm/greeting", STRING, Qos())
    topic = other.wait_for("MP", "/skin/arm/greeting")
    assert not publisher.is_wanted
    other.hear(topic)
    wait_until(lambda: publisher.is_wanted)
    other.stop_hearing()
    wait_until(lambda: not publisher.is_wanted)


def test_the_router_passes_on_what_others_want(graph: Graph) -> None:
    publisher = graph.skin.publisher("/skin/arm/greeting", STRING, Qos())
    graph.skin.service("/skin/arm/tare", TRIGGER, lambda request: b"answer to " + request)
    with peer(graph.at.endpoint, graph.domain, "client") as far:
        publishing(publisher, far.hear(far.wait_for("MP", "/skin/arm/greeting")))
        assert far.call(far.wait_for("SS", "/skin/arm/tare"), b"request").payload == b"answer to request"


def test_who_comes_late_has_the_last_of_a_latched_topic(graph: Graph) -> None:
    publisher = graph.skin.publisher("/skin/arm/places", STRING, Qos(depth=2, latched=True))
    assert publisher.is_wanted
    for number in range(4):
        assert publisher.publish(b"%d" % number)
    topic = graph.other.wait_for("MP", "/skin/arm/places")
    assert topic.qos[:3] == ("", "1", ",2")
    heard = graph.other.hear(topic, late=True)
    wait_until(lambda: [message.payload for message in heard.messages][-2:] == [b"2", b"3"])
    publishing(publisher, heard, b"4")
    assert heard.messages[-1].payload == b"4"


def test_a_service_answers_with_the_sequence_and_the_identity_of_the_request(graph: Graph) -> None:
    skin, other = graph.skin, graph.other
    end = skin.service("/skin/arm/tare", TRIGGER, lambda request: b"answer to " + request)
    service = other.wait_for("SS", "/skin/arm/tare")
    assert (service.type_name, service.type_hash) == ("std_srvs::srv::dds_::Trigger_", TRIGGER.hash)
    for sequence in (1, 2, 1 << 40):
        before_ns = time.time_ns()
        answer = other.call(service, b"%d" % sequence, sequence)
        assert isinstance(answer, Message)
        assert (answer.payload, answer.sequence, answer.gid) == (b"answer to %d" % sequence, sequence, GID)
        assert before_ns <= answer.time_ns <= time.time_ns()
    end()
    end()
    wait_until(lambda: not other.found("SS"))
    assert not list(other.ask(service, b""))


@pytest.mark.parametrize("attachment", [b"", bytes(32), bytes(40), bytes(16) + b"\x18" + bytes(24)])
def test_a_request_without_a_proper_attachment_is_refused(graph: Graph, attachment: bytes) -> None:
    asked: list[bytes] = []

    def handle(request: bytes) -> bytes:
        asked.append(request)
        return b"done"

    skin, other = graph.skin, graph.other
    skin.service("/skin/arm/tare", TRIGGER, handle)
    service = other.wait_for("SS", "/skin/arm/tare")
    assert "attachment" in other.call(service, b"request", attachment=attachment)
    answer = other.call(service, b"request")
    assert answer.payload == b"done"
    assert asked == [b"request"]


def test_one_request_at_a_time_and_no_more_than_ten_wait(graph: Graph) -> None:
    begun, go, running = threading.Event(), threading.Event(), threading.Lock()

    def handle(request: bytes) -> bytes:
        if request == READY:
            return READY
        begun.set()
        with_lock = running.acquire(blocking=False)
        go.wait(60)
        if with_lock:
            running.release()
        return b"alone" if with_lock else b"not alone"

    skin, other = graph.skin, graph.other
    for name in "ab":
        skin.service(f"/skin/{name}/tare", TRIGGER, handle)
    services = [other.wait_for("SS", f"/skin/{name}/tare") for name in "ab"]
    for service in services:
        assert other.call(service, READY).payload == READY
    try:
        answers = [other.ask(services[0], b"")]
        assert begun.wait(30)
        answers += [other.ask(services[number % 2], b"") for number in range(12)]
        refused = [next(iter(answer)) for answer in answers[-2:]]
    finally:
        go.set()
    assert ["too many requests" in reply.err.payload.to_string() for reply in refused] == [True, True]
    payloads = [reply.ok.payload.to_bytes() for answer in answers[:-2] for reply in answer]
    assert payloads == [b"alone"] * 11


def test_ending_a_service_waits_for_its_answer(graph: Graph) -> None:
    begun, go = threading.Event(), threading.Event()

    def handle(request: bytes) -> bytes:
        if request == READY:
            return READY
        begun.set()
        go.wait(60)
        return b"late"

    skin, other = graph.skin, graph.other
    end = skin.service("/skin/arm/tare", TRIGGER, handle)
    service = other.wait_for("SS", "/skin/arm/tare")
    assert other.call(service, READY).payload == READY
    answers = [other.ask(service, b"") for _ in range(2)]
    assert begun.wait(30)
    wait_until(lambda: skin._jobs.qsize() == 1)
    (ended,) = skin._endpoints
    ending = threading.Thread(target=end)
    ending.start()
    wait_until(lambda: not ended._is_open)
    assert service.name in other.found("SS")
    go.set()
    ending.join()
    first, second = [next(iter(answer)) for answer in answers]
    assert first.ok.payload.to_bytes() == b"late"
    assert second.err.payload.to_string() == "the service ended"


def test_graphs_of_other_domains_and_releases_do_not_meet(graph: Graph) -> None:
    graph.skin.publisher("/skin/arm/greeting", STRING, Qos())
    graph.other.wait_for("MP", "/skin/arm/greeting")
    humble = NodeIdentity("old", domain=next(_domains), distro=Distro.HUMBLE)
    with node(graph.at, humble) as old, peer(graph.at.endpoint, humble.domain) as other:
        publisher = old.publisher("/skin/arm/greeting", STRING, Qos())
        topic = other.wait_for("MP", "/skin/arm/greeting")
        assert (topic.node, topic.type_hash) == ("/old", "TypeHashNotSupported")
        publishing(publisher, other.hear(topic))
        assert list(other.found("NN")) == ["/old"]
        assert list(graph.other.found("NN")) == ["/icub/skin"]


def test_what_ends_is_not_found_and_says_no_more(graph: Graph) -> None:
    skin, other = graph.skin, graph.other
    publishers = [skin.publisher(f"/skin/arm/{name}", STRING, Qos()) for name in "ab"]
    other.wait_for("MP", "/skin/arm/a")
    other.wait_for("MP", "/skin/arm/b")
    publishers[0].close()
    publishers[0].close()
    wait_until(lambda: list(other.found("MP")) == ["/skin/arm/b"])
    assert not publishers[0].publish(HELLO)
    assert not publishers[0].is_wanted
    skin.close()
    skin.close()
    assert not publishers[1].publish(HELLO)
    wait_until(lambda: not other.found("MP") and not other.found("NN"))


def test_what_cannot_be_is_refused(graph: Graph) -> None:
    with pytest.raises(ConfigurationError, match="no endpoint"):
        ZenohNode(NodeIdentity("skin"), connect=["localhost:7447"])
    with pytest.raises(BridgeError, match="no absolute name"):
        graph.skin.publisher("skin", STRING, Qos())
    with pytest.raises(BridgeError, match="no absolute name"):
        graph.skin.service("/skin/*", TRIGGER, lambda request: request)


@pytest.mark.thorough
def test_a_router_that_comes_late_goes_and_comes_back(sessions_end: None) -> None:
    """The node publishes all the time and is not told of any of it; people are, once each time."""
    told: queue.SimpleQueue[tuple[bool, str]] = queue.SimpleQueue()
    at = Router()
    try:
        with node(at, NodeIdentity("skin"), lambda *told_now: told.put(told_now)) as skin:
            publisher = skin.publisher("/skin/arm/greeting", STRING, Qos())
            assert next_of(told) == (False, f"no zenoh router at {at.endpoint}: ")
            assert publisher.publish(HELLO)
            for _ in range(2):
                at.start()
                assert next_of(told) == (True, f"the zenoh router at {at.endpoint} is there: ")
                assert skin.is_seen
                with peer(at.endpoint) as other:
                    publishing(publisher, other.hear(other.wait_for("MP", "/skin/arm/greeting")))
                    at.kill()
                    assert next_of(told) == (False, f"no zenoh router at {at.endpoint}: ")
                    assert not skin.is_seen
        assert told.empty()
    finally:
        at.kill()


def next_of(told: queue.SimpleQueue[tuple[bool, str]]) -> tuple[bool, str]:
    """What is told next, and how it begins."""
    is_there, line = told.get(timeout=PATIENCE_S)
    return is_there, line.partition(": ")[0] + ": "


@pytest.mark.thorough
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_subscriber_that_dies_or_hangs_costs_others_nothing(graph: Graph, how: signal.Signals) -> None:
    """Messages are large: what one subscriber does not take fills its queue within a few of them."""
    large = bytes(500_000)
    skin, other = graph.skin, graph.other
    publisher = skin.publisher("/skin/arm/points", STRING, Qos())
    topic = other.wait_for("MP", "/skin/arm/points")
    with hearing_elsewhere(graph, topic) as (victim, has_heard), ThreadPoolExecutor(1) as pool:
        heard = other.hear(topic)
        waiting = pool.submit(has_heard)
        wait_until(lambda: publisher.publish(large) and waiting.done() and len(heard) > 0)
        os.kill(victim, how)
        before = heard.messages[-1].sequence
        for _ in range(100):
            publisher.publish(large)
        wait_until(lambda: publisher.publish(b"newest") and heard.messages[-1].payload == b"newest")
        assert heard.messages[-1].sequence > before + 100


@contextmanager
def hearing_elsewhere(graph: Graph, topic: Found) -> Iterator[tuple[int, Callable[[], None]]]:
    """A process that hears a topic: its id, and what waits until it has heard something."""
    program = "import sys; from tests.ros2.graph_peer import main; main(*sys.argv[1:])"
    process = subprocess.Popen(
        [sys.executable, "-c", program, graph.at.endpoint, str(graph.domain), topic.name],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    lines = process.stdout

    def has_heard() -> None:
        assert lines.readline() == "heard\n"

    try:
        yield process.pid, has_heard
    finally:
        process.kill()
        process.communicate()


@pytest.mark.thorough
def test_publishers_and_services_that_come_and_go_leave_nothing(graph: Graph) -> None:
    skin, other = graph.skin, graph.other
    for _ in range(100):
        publisher = skin.publisher("/skin/arm/greeting", STRING, Qos())
        end = skin.service("/skin/arm/tare", TRIGGER, lambda request: request)
        publisher.close()
        end()
    publisher = skin.publisher("/skin/arm/last", STRING, Qos())
    publishing(publisher, other.hear(other.wait_for("MP", "/skin/arm/last")))
    wait_until(lambda: list(other.found("MP")) == ["/skin/arm/last"] and not other.found("SS"))
    assert skin._endpoints == {publisher}
