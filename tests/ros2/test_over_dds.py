"""The command, and programs of the other side in processes of their own, over real DDS of this machine alone."""

from __future__ import annotations

import base64
import contextlib
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs the extra ros2")

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from skinware import DriverReader, Namespace
from skinware.conversion.ros_messages import skin_frame
from skinware.conversion.showing import in_topic
from skinware.errors import BridgeError, ConfigurationError
from skinware.ros2 import cyclone, dds, messages
from skinware.ros2.transport import Distro, NodeIdentity, Qos
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import Running, refused, running
from tests.recording.test_viewers import placed
from tests.ros2.alone import own_domain
from tests.ros2.store import typestore
from tests.ros2.test_serving import tareable

STORE = typestore()
FRAME = ("rt/skin/arm/frame", "skinware_msgs/msg/SkinFrame")
SENSORS = ("rt/skin/arm/sensors", "skinware_msgs/msg/Sensors")
POINTS = ("rt/skin/arm/points/pressure", "sensor_msgs/msg/PointCloud2")


@pytest.fixture
def domain(namespace: Namespace, monkeypatch: pytest.MonkeyPatch) -> int:
    return own_domain(namespace, monkeypatch)


def bridge(*options: str) -> Any:
    return running("skin-bridge", "ros2", *options)


def peer(domain: int, *options: str) -> Any:
    return running("python", "-m", "tests.ros2.peer", str(domain), *options)


def message(of: Running, topic: str, name: str, condition: Callable[[Any], bool] = lambda _: True) -> Any:
    """A message that a peer got, as rosbags reads it, and which fulfils a condition."""
    found: list[Any] = []

    def fulfils(event: dict[str, Any]) -> bool:
        if event["topic"] != topic:
            return False
        found[:] = [STORE.deserialize_cdr(base64.b64decode(event["data"]), name)]
        return condition(found[0])

    of.wait_for("message", fulfils)
    return found[0]


@pytest.mark.thorough
def test_a_program_in_the_graph_gets_what_the_driver_publishes(namespace: Namespace, domain: int) -> None:
    skin = FakeSkin("arm", placed(fake_structure(2, 8)))
    skin.break_some()
    skin.values = np.zeros(skin.structure.n_sensors)
    skin.values[skin.structure.index("pressure")] = np.arange(160)
    with publishing(skin), bridge() as ours:
        told = ours.wait_for("ready")
        node = f"/skinware_{in_topic(namespace.name)}"
        assert told == {"event": "ready", "rmw": "dds", "domain": domain, "node": node, "namespace": namespace.name}
        with peer(domain, "--look", "--listen", *FRAME, "--listen", *POINTS, "--listen-late", *SENSORS) as theirs:
            sensors = message(theirs, *SENSORS)
            assert np.array_equal(sensors.uid, skin.structure.sensor_uid)
            frame = message(theirs, *FRAME)
            assert len(frame.value) == skin.structure.n_sensors
            assert frame.generation == sensors.generation
            assert np.array_equal(frame.value[skin.structure.index("pressure")], 255 - np.arange(160, dtype=float))
            assert np.array_equal(frame.status, skin.status)
            points, geometry = message(theirs, *POINTS), skin.structure.geometry
            assert geometry is not None
            assert points.width == int(geometry.known[skin.structure.index("pressure")].sum())
        ours.wait_for("status", lambda event: event["drivers"]["arm"]["messages"] > 10)


@pytest.mark.thorough
def test_endpoints_and_the_node_have_names_and_hashes(namespace: Namespace, domain: int) -> None:
    info = ("ros_discovery_info", "rmw_dds_common/msg/ParticipantEntitiesInfo")
    with FakeSkin("arm", placed(fake_structure(1, 2))) as skin, bridge() as ours:
        skin.publish()
        node = ours.wait_for("ready")["node"]
        with peer(domain, "--look") as looking:
            found = looking.wait_for("publication", lambda event: event["topic"] == POINTS[0])
            assert found["type"] == "sensor_msgs::msg::dds_::PointCloud2_"
            assert found["data"] == f"typehash={messages.POINTS.hash};"
        with peer(domain, "--listen-late", *info) as theirs:  # the two events have no order in one program
            told = message(
                theirs,
                *info,
                lambda each: (
                    found["key"]
                    in [bytes(gid.data).hex() for of in each.node_entities_info_seq for gid in of.writer_gid_seq]
                ),
            )
            (of_node,) = told.node_entities_info_seq
            assert of_node.node_namespace + of_node.node_name == node


@pytest.mark.thorough
def test_a_service_tares(namespace: Namespace, domain: int) -> None:
    with tareable(namespace), bridge("--tare") as ours:
        ours.wait_for("ready")
        with peer(domain, "--call", "/skin/arm/tare") as theirs:
            answers = [theirs.wait_for("answer") for _ in range(2)]
        assert [(each["guid"], each["sequence"]) for each in answers] == [(2**63 + 7, 1), (5, 2)]
        assert all((each["success"], each["message"]) == (True, "") for each in answers)
        with DriverReader("arm", namespace=namespace) as reader:
            wait_until(lambda: bool((reader.read().values == 2).all()))


def test_a_service_that_ends_leaves_the_graph(domain: int) -> None:
    participant = DomainParticipant(domain)
    requests = Topic(participant, "rq/tareRequest", dds._type(messages.TRIGGER.request, with_id=True))
    caller = DataWriter(participant, requests)
    with contextlib.closing(dds.DdsNode(NodeIdentity("skin", domain=domain))) as node:
        end = node.service("/tare", messages.TRIGGER, lambda request: request)
        wait_until(lambda: len(caller.get_matched_subscriptions()) == 1)
        end()
        wait_until(lambda: not caller.get_matched_subscriptions())


@pytest.mark.thorough
def test_a_stopped_and_a_killed_subscriber_cost_nobody_else_anything(namespace: Namespace, domain: int) -> None:
    """Of a topic whose messages fill what is kept for a reader that acknowledges nothing."""
    skin = FakeSkin("arm", placed(fake_structure(20, 64)))
    listening = ("--only-heads", "--listen", *POINTS)
    with publishing(skin, 50), bridge("--rate", "50") as ours, peer(domain, *listening) as theirs:
        with peer(domain, *listening) as other:
            for each in (theirs, other):
                assert each.wait_for("message")["size"] > 250_000
            other.process.send_signal(signal.SIGSTOP)
            try:
                for _ in range(30):  # more than what was on the way
                    theirs.wait_for("message")
                before = ours.wait_for("status")["drivers"]["arm"]
                for _ in range(30):
                    theirs.wait_for("message")
                after = ours.wait_for("status", lambda event: event["drivers"]["arm"]["messages"] > before["messages"])
                assert after["drivers"]["arm"]["left_out"] == before["left_out"]
            finally:
                other.process.send_signal(signal.SIGCONT)
            other.wait_for("message")
            other.stop(signal.SIGKILL)
        for _ in range(30):
            theirs.wait_for("message")


@pytest.mark.thorough
def test_messages_are_the_same_without_the_private_way(monkeypatch: pytest.MonkeyPatch, domain: int) -> None:
    monkeypatch.setattr(cyclone, "write_bytes", None)
    node = dds.DdsNode(NodeIdentity("skin", domain=domain))
    with contextlib.closing(node), peer(domain, "--listen", "rt/x", messages.SKIN_FRAME.name) as theirs:
        publisher = node.publisher("/x", messages.SKIN_FRAME, Qos())
        assert not publisher.is_wanted or theirs
        wait_until(lambda: publisher.is_wanted)
        sent = made_frame()
        wait_until(lambda: publisher.publish(sent))
        data = theirs.wait_for("message")["data"]
        assert base64.b64decode(data)[: len(sent)] == sent
    assert not publisher.publish(b"")


def made_frame() -> bytes:
    with FakeSkin("leg", fake_structure(1, 1)) as skin, DriverReader("leg") as reader:
        skin.publish()
        return skin_frame(reader.read(), 10**18)


def test_wrong_usage_is_one_clear_line(domain: int) -> None:
    for options, told in (
        (["--domain", "233"], "domain 233 of ROS: give 0 to 232"),
        (["--ros-namespace", "robot"], "namespace 'robot' of ROS: give / or names after slashes, as /robot_1"),
        (["--rate", "0"], "rate of 0.0 Hz"),
    ):
        done = refused("skin-bridge", "ros2", *options)
        assert done.returncode == 2
        assert told in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert refused("skin-bridge", "ros2", "--domain", "x").returncode == 2


def test_a_network_that_is_not_there(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(
        "CYCLONEDDS_URI",
        "<CycloneDDS><Domain id='any'><General><Interfaces><NetworkInterface name='none0'/></Interfaces></General>"
        "</Domain></CycloneDDS>",
    )
    with pytest.raises(BridgeError, match=rf"domain {domain} of DDS cannot be joined"):
        dds.DdsNode(NodeIdentity("skin", domain=domain))


def udp_addresses() -> set[str]:
    """Addresses that UDP sockets of this process are bound to, but for those that receive on all."""
    own = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            own.add(str(descriptor.readlink()))
    lines = [line.split() for line in Path("/proc/self/net/udp").read_text().splitlines()[1:]]
    words = [int(line[1].partition(":")[0], 16) for line in lines if f"socket:[{line[9]}]" in own]
    return {socket.inet_ntoa(word.to_bytes(4, sys.byteorder)) for word in words if word}


def test_this_machine_alone_by_default(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CYCLONEDDS_URI")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    before = udp_addresses()
    with contextlib.closing(dds.DdsNode(NodeIdentity("skin", domain=domain))):
        assert udp_addresses() - before == {"127.0.0.1"}


@pytest.mark.parametrize("name", ["lo", "127.0.0.1"])
def test_an_interface_is_chosen_by_name_or_address(name: str, domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CYCLONEDDS_URI")
    before = udp_addresses()
    with contextlib.closing(dds.DdsNode(NodeIdentity("skin", domain=domain), [name])):
        assert udp_addresses() - before == {"127.0.0.1"}
    with pytest.raises(BridgeError, match="cannot be joined"):
        dds.DdsNode(NodeIdentity("skin", domain=domain), ["none'0"])


def test_an_interface_beside_a_configuration_is_refused(domain: int) -> None:
    done = refused("skin-bridge", "ros2", "--interface", "lo")
    assert done.returncode == 2
    assert "--interface and CYCLONEDDS_URI both choose networks: give one of them" in done.stderr
    done = refused("skin-bridge", "ros2", "--rmw", "zenoh", "--interface", "lo")
    assert done.returncode == 2
    assert "--interface is for --rmw dds" in done.stderr


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.delitem(sys.modules, "skinware.ros2.dds")
    done = refused("skin-bridge", "ros2")
    assert done.returncode == 1
    assert done.stderr == ("skin-bridge: packages for ROS 2 over DDS are not installed: pip install 'skinware[ros2]'\n")


@pytest.mark.parametrize("fields", [{"name": "1st"}, {"name": "a b"}, {"namespace": "x"}, {"domain": -1}])
def test_identities_that_ros_does_not_know(fields: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError):
        NodeIdentity(**{"name": "skin", **fields})
    assert NodeIdentity("skin", "/", 0, Distro.HUMBLE).prefix == ""
