"""Topics of ROS 2 over zenoh as a skin: our own node, zenoh-ros2-sdk, and publishers that cannot be read."""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="needs the extra ros2")


from skinware import DriverReader, Namespace
from skinware.errors import ConfigurationError
from skinware.ros2.rmw_zenoh import ZenohNode, packed_attachment
from skinware.ros2.transport import Distro, MessageType, NodeIdentity, Qos
from skinware.status import Status
from skinware_drivers.registry import make_bus
from skinware_drivers.streams.dds import DdsTopic, HeardTopic
from skinware_drivers.streams.ros2 import Ros2Driver, Ros2Options
from skinware_drivers.streams.ros2_presets import TEXTS
from skinware_drivers.streams.ros2_zenoh import ZenohPort, ZenohTopicBus
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from tests.commands import run, running
from tests.ros2.graph_peer import peer
from tests.ros2.router import Router, router, sockets
from tests.ros2.sdk_peer import sdk_peer
from tests.sdk.driving import has_come, is_whole, later_than
from tests.streams.ros2_peer import Case, Talker, case_of, same, serialized

HASH = f"RIHS01_{0:064x}"
TIMED = Qos(depth=10)


@pytest.fixture(scope="module")
def at() -> Iterator[Router]:
    """A router. Zenoh's threads have descriptors of their own, which stay from now on."""
    with router() as one:
        with joined(one, 0, _topics("/warm")) as port, published(one, case_of("std_msgs/msg/UInt16"), "/warm"):
            wait_until(lambda: bool(port.read(0)))
        yield one


@pytest.fixture(autouse=True)
def _sessions_end(at: Router, namespace: Namespace) -> Iterator[None]:
    """Before anybody looks for leaks, all sockets and threads of the test's sessions are gone."""
    before, threads = sockets(), set(threading.enumerate())
    yield
    wait_until(lambda: sockets() <= before and set(threading.enumerate()) <= threads)


@contextmanager
def joined(at: Router, domain: int, topics: Sequence[DdsTopic], more: str = "") -> Iterator[ZenohPort]:
    bus = make_bus(f"ros2://{domain}?router={at.endpoint}{more}")
    assert isinstance(bus, ZenohTopicBus)
    bus.topics = topics
    bus.open()
    try:
        assert isinstance(bus._joined, ZenohPort)
        yield bus._joined
    finally:
        bus.close()


def _topics(name: str) -> Sequence[DdsTopic]:
    return Ros2Driver(Ros2Options(topic=(name,))).topics


@contextmanager
def published(at: Router, case: Case, topic: str = "/touch", domain: int = 0, **identity: Any) -> Iterator[Talker]:
    node = ZenohNode(NodeIdentity("talker", domain=domain, **identity), connect=[at.endpoint])
    publisher = node.publisher(topic, MessageType(case.type_name, HASH), TIMED)
    try:
        with Talker(lambda number: publisher.publish(serialized(case.sample(number)))) as talker:
            yield talker
    finally:
        node.close()


def driven(at: Router, domain: int, **options: Any) -> Any:
    bus = f"ros2://{domain}?router={at.endpoint}"
    return emulated_skin("ros2", bus=bus, driver_options={"learn_s": 0.2, **options})


@pytest.mark.parametrize("distro", list(Distro))
def test_values_of_our_own_node(at: Router, distro: Distro) -> None:
    domain = 1 + list(Distro).index(distro)
    case = case_of("tactile_msgs/msg/TactileState")
    with published(at, case, "/hand/touch", domain, distro=distro) as talker:
        with driven(at, domain, topic=("/hand/touch",)) as skin:
            frame = read_until(skin.reader, is_whole)
            for _ in range(5):
                assert any(same(frame.values, case.shown(number)) for number in range(talker.number + 1))
                frame = read_until(skin.reader, later_than(frame))
            [counters] = skin.reader.bus_counters(frame)
            assert [counters[name] for name in ("dropped", "refused", "bad_length")] == [0, 0, 0]


@pytest.mark.thorough
def test_values_of_zenoh_ros2_sdk(at: Router, tmp_path: Path) -> None:
    names = ("Float32MultiArray", "MultiArrayLayout", "MultiArrayDimension")
    texts = {f"std_msgs/msg/{name}": TEXTS[f"std_msgs/{name}"] for name in names}
    with sdk_peer(at.port, tmp_path, texts) as sdk:
        key = sdk.ask(ask="publish", topic="/touch", count=7, domain=3)
        assert key.startswith("3/touch/std_msgs::msg::dds_::Float32MultiArray_/RIHS01_")
        with driven(at, 3) as skin:
            first = read_until(skin.reader, is_whole)
            later = read_until(skin.reader, lambda f: is_whole(f) and f.values[0] >= first.values[0] + 20)
            for frame in (first, later):
                assert frame.values.tolist() == [frame.values[0] + n for n in range(7)]
            [counters] = skin.reader.bus_counters(later)
            assert [counters[name] for name in ("dropped", "refused", "bad_length")] == [0, 0, 0]


def test_publishers_come_and_go_and_others_cannot_be_read(at: Router, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    case = case_of("std_msgs/msg/UInt16")
    stranger = Case("my_msgs/msg/Hand", case.idl_type, case.sample, case.shown, [])
    with ExitStack() as first, published(at, stranger, domain=4):
        first.enter_context(published(at, case, domain=4))
        with driven(at, 4) as skin:
            read_until(skin.reader, is_whole)
            with published(at, case, domain=4):
                wait_until(lambda: "/touch has 2 publishers: only the first is read" in caplog.text)
                read_until(skin.reader, lambda f: skin.reader.bus_counters(f)[0]["refused"] > 0)
            assert "cannot be read: its type is my_msgs::msg::dds_::Hand_, not one of" in caplog.text
            first.close()
            wait_until(lambda: caplog.text.count("a publisher of rt/touch is gone") == 2)
            read_until(skin.reader, lambda f: bool((f.status & Status.STALE).all()))
            with published(at, case, domain=4):
                read_until(skin.reader, is_whole)


def test_samples_that_are_lost_or_wrong_are_counted(at: Router) -> None:
    """Sequence numbers with a gap, and samples without a proper attachment, beside a full queue."""
    [topic] = [one for one in _topics("/touch") if one.dds_type == "std_msgs::msg::dds_::UInt16_"]
    sample, key = serialized(case_of("std_msgs/msg/UInt16").sample(1)), f"5/touch/{topic.dds_type}/{HASH}"
    with joined(at, 5, [topic], "&depth=4") as port:
        for sequence in (1, 2, 5):
            port._sample(key, packed_attachment(sequence, 10**18, bytes(16)), sample)
        port._sample(key, b"", sample)
        port._sample(key, packed_attachment(6, 10**18, bytes(16)), sample)  # finds no room
        assert port.read(0).count(sample) == 3
        assert (port.dropped, port.refused) == (2, 1)
        port._sample(key, packed_attachment(7, 10**18, bytes(16)), sample)
        port._sample("5/touch/std_msgs::msg::dds_::Int8_/x", packed_attachment(8, 0, bytes(16)), sample)
        port._sample(key, packed_attachment(6, 10**18, bytes(16)), sample)  # 7 has overtaken it
        assert port.read(0).count(sample) == 1
        assert (port.dropped, port.refused) == (3, 3)
        port._sample(key, packed_attachment(8, 10**18, bytes(16)), bytes(1 << 21))
        assert len(port._samples[0][2]) < 1 << 21
        assert port.read(0) == b""
        assert port.refused == 4


def test_the_graph_shows_one_subscription_to_all_publishers_of_a_type(at: Router) -> None:
    """``ros2 topic pub --once`` of rmw_zenoh_cpp 0.2.10 waits for one."""
    case = case_of("std_msgs/msg/UInt16")
    with peer(at.endpoint, 8) as other, joined(at, 8, _topics("/touch")) as port:
        with published(at, case, "/other", 8), published(at, case, domain=8), published(at, case, domain=8):
            wait_until(lambda: (port.look(0), len(port.publishers))[1] == 3)
            shown = other.wait_for("MS", "/touch")
            assert (shown.type_hash, shown.qos[0]) == (HASH, "2")  # best effort fits all publishers
            assert other.found("NN")[shown.node].node == f"/_skin_driver_{os.getpid()}"  # hidden from ros2 node list
            assert len(port._shown) == 1


def test_a_silent_topic_of_a_known_type_needs_no_map(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, bus = Ros2Driver(Ros2Options(topic=("/touch",))), make_bus("ros2://0")
    monkeypatch.setattr(bus, "heard", lambda: [HeardTopic("rt/touch", "std_msgs::msg::dds_::UInt16_", 1)])
    monkeypatch.setattr(driver, "_line", bus, raising=False)
    assert driver._nothing() == "no messages on /touch within 5 s; topics there: /touch (std_msgs/msg/UInt16)"


def test_topics_are_found(at: Router) -> None:
    with published(at, case_of("sensor_msgs/msg/PointCloud2"), "/cloud", 6):
        bus_name = f"ros2://6?router={at.endpoint}"
        [bus] = json.loads(run("skin-find", bus_name, "--json").stdout)["buses"]
        [topic] = bus["topics"]
        assert (topic["topic"], topic["publishers"], topic["drivers"]) == ("rt/cloud", 1, ["ros2"])


@pytest.mark.thorough
def test_topics_are_captured_and_replayed(at: Router, tmp_path: Path) -> None:
    capture = f"{tmp_path}/touch.mcap"
    bus = ("--bus", f"ros2://7?router={at.endpoint}", "--capture", capture)
    with published(at, case_of("tactile_msgs/msg/TactileState"), domain=7):
        with running("skin-driver", "--driver", "ros2", *bus) as driver:
            assert driver.wait_for("ready")["sensors"] == 8
            driver.wait_for("status", lambda event: event["buses"][0]["frames"] > 100)
    with running("skin-driver", "--bus", f"replay:{capture}") as replayed:
        assert replayed.wait_for("ready")["sensors"] == 8
        with DriverReader("ros2") as reader:
            assert read_until(reader, has_come).structure.module_name.tolist() == [b"thumb", b"sensors 1"]


@pytest.mark.parametrize("name", ["ros2://x", "ros2://300", "ros2://0?router=nowhere", "ros2://0?qos=reliable"])
def test_names_that_are_wrong(name: str) -> None:
    with pytest.raises(ConfigurationError):
        emulated_skin("ros2", bus=name).__enter__()


def test_emulated_devices_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="emulated devices publish on dds://0"):
        make_bus("ros2://0", for_devices=True)


def test_tokens_of_no_publisher(at: Router) -> None:
    with joined(at, 0, _topics("/touch")) as port:
        for token in ("", "@ros2_lv/0/a/0/1/SS/%/%/n/%t/T/h/::", "@ros2_lv/0/a/0/1/MP/%/%/n/%t"):
            port._token(token, is_there=True)
        port.look(0)
        assert not port.publishers


def test_nothing_is_closed_while_a_thread_of_zenoh_wakes_it(at: Router, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its number may be another file's the next moment."""
    waking, link_closed = threading.Event(), threading.Event()

    def slow_write(fd: int, _value: int) -> None:
        waking.set()
        link_closed.wait()
        time.sleep(0.05)  # it must not be closed in this time, nor later
        os.fstat(fd)

    def close_link() -> None:
        end_link()
        link_closed.set()

    with joined(at, 0, _topics("/touch")) as port, ThreadPoolExecutor() as pool:
        end_link = port._link.close
        monkeypatch.setattr(port._link, "close", close_link)
        monkeypatch.setattr(os, "eventfd_write", slow_write)
        woken = pool.submit(port._wake)
        waking.wait()
        port.close()
        woken.result()
    assert port.fileno() == -1
