"""Keys, tokens and attachments, as the design document of rmw_zenoh (docs/design.md) and its sources have them."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as some

from skinware.errors import BridgeError, MissingExtra
from skinware.ros2 import rmw_zenoh
from skinware.ros2.rmw_zenoh import (
    PUBLISHER,
    SERVICE,
    endpoint_token,
    gid,
    key,
    node_token,
    packed_attachment,
    qos_text,
    read_attachment,
)
from skinware.ros2.transport import Distro, MessageType, NodeIdentity, Qos, ServiceType

STRING = MessageType("std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")
ADD = ServiceType(
    "example_interfaces/srv/AddTwoInts",
    "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    MessageType("example_interfaces/srv/AddTwoInts_Request", "RIHS01_0"),
    MessageType("example_interfaces/srv/AddTwoInts_Response", "RIHS01_0"),
)
TALKER = NodeIdentity("talker", domain=2)


def test_keys_of_topics() -> None:
    hashed = "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert key(NodeIdentity("talker"), "/chatter", STRING) == f"0/chatter/{hashed}"
    assert key(NodeIdentity("talker", "/robot1"), "/robot1/chatter", STRING) == f"0/robot1/chatter/{hashed}"


def test_key_of_a_service() -> None:
    assert key(NodeIdentity("add_two_ints_server", domain=2), "/add_two_ints", ADD) == (
        "2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_"
        "/RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
    )


def test_humble_has_no_hashes() -> None:
    humble = NodeIdentity("talker", distro=Distro.HUMBLE)
    assert key(humble, "/chatter", STRING) == "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"
    token = endpoint_token(humble, "f00d", 0, 1, PUBLISHER, "/chatter", STRING, Qos(depth=7))
    assert token == (
        "@ros2_lv/0/f00d/0/1/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported/::,7:,:,:,,"
    )


def test_token_of_a_node() -> None:
    listener = NodeIdentity("listener", domain=2)
    assert node_token(listener, "aac3178e146ba6f1fc6e6a4085e77f21", 0) == (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    )


def test_token_of_a_node_in_namespaces() -> None:
    assert node_token(NodeIdentity("skin", "/robots/icub"), "1", 3) == "@ros2_lv/0/1/3/3/NN/%/%robots%icub/skin"


def test_token_of_a_publisher() -> None:
    session = "8b20917502ee955ac4476e0266340d5c"
    assert endpoint_token(TALKER, session, 0, 10, PUBLISHER, "/chatter", STRING, Qos(depth=7)) == (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_"
        "/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,"
    )


def test_token_of_a_service() -> None:
    server = NodeIdentity("add_two_ints_server", domain=2)
    session = "f9980ee0495eaafb3e38f0d19e2eae12"
    assert endpoint_token(server, session, 0, 10, SERVICE, "/add_two_ints", ADD, Qos(depth=10)) == (
        "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints"
        "/example_interfaces::srv::dds_::AddTwoInts_"
        "/RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a/::,10:,:,:,,"
    )


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Qos(), "::,5:,:,:,,"),
        (Qos(depth=5, reliable=False), "2::,5:,:,:,,"),
        (Qos(depth=1, latched=True), ":1:,1:,:,:,,"),
        (Qos(depth=42), "::,:,:,:,,"),  # the depth of who says none
    ],
)
def test_qos_in_tokens(qos: Qos, text: str) -> None:
    assert qos_text(qos) == text


@pytest.mark.parametrize(
    "name", ["", "/", "chatter", "/chatter/", "//chatter", "/a b", "/a*", "/a$b", "/2d", "/a/ä", "/a?x"]
)
def test_names_that_ros_does_not_have_are_refused(name: str) -> None:
    with pytest.raises(BridgeError, match="no absolute name"):
        key(TALKER, name, STRING)


def test_identities_are_hashes_of_tokens() -> None:
    assert gid("").hex() == "7f498d4624c30160d8984701d306aa99"  # XXH3, 128 bits, of nothing; its low half first
    tokens = [
        endpoint_token(identity, session, 0, number, PUBLISHER, "/chatter", STRING, Qos())
        for identity in (TALKER, replace(TALKER, domain=3))
        for session in ("1", "2")
        for number in (1, 2)
    ]
    assert len({gid(token) for token in tokens}) == len(tokens)
    assert {len(gid(token)) for token in tokens} == {16}


def test_an_attachment_has_33_bytes() -> None:
    attachment = 258, 1_700_000_000_000_000_001, bytes(range(16))
    assert packed_attachment(*attachment).hex(" ") == (
        "02 01 00 00 00 00 00 00 01 00 2a 36 fe 9c 97 17 10 00 01 02 03 04 05 06 07 08 09 0a 0b 0c 0d 0e 0f"
    )
    assert read_attachment(packed_attachment(*attachment)) == attachment


@pytest.mark.parametrize("data", [b"", bytes(32), bytes(34), bytes(33), bytes(16) + b"\x11" + bytes(16)])
def test_bytes_that_are_no_attachment_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="bytes, not"):
        read_attachment(data)


@given(some.binary(max_size=64))
def test_any_bytes_are_an_attachment_or_refused(data: bytes) -> None:
    try:
        assert packed_attachment(*read_attachment(data)) == data
    except ValueError:
        assert len(data) != 33 or data[16] != 16


@pytest.mark.parametrize("package", ["zenoh", "xxhash"])
def test_a_package_that_is_missing_is_one_of_an_extra(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else find_spec(name))
    with pytest.raises(MissingExtra, match=r"pip install 'skinware\[ros2-zenoh\]'"):
        importlib.reload(rmw_zenoh)
