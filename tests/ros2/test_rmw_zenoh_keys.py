"""Keys, tokens and attachments, as the design document of rmw_zenoh (docs/design.md) and its sources have them."""

from __future__ import annotations

import importlib.util

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
from skinware.ros2.transport import Distro, MessageType, NodeIdentity, Qos

STRING = MessageType("std_msgs/msg/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")
TRIGGER = MessageType("std_srvs/srv/Trigger", "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f")
TALKER = NodeIdentity("talker", domain=2)


def test_keys_of_topics() -> None:
    hashed = "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert key(NodeIdentity("talker"), "/chatter", STRING) == f"0/chatter/{hashed}"
    assert key(NodeIdentity("talker", "/robot1"), "/robot1/chatter", STRING) == f"0/robot1/chatter/{hashed}"


def test_key_of_a_service() -> None:
    assert key(TALKER, "/arm/tare", TRIGGER) == f"2/arm/tare/std_srvs::srv::dds_::Trigger_/{TRIGGER.hash}"


def test_humble_has_no_hashes() -> None:
    humble = NodeIdentity("talker", distro=Distro.HUMBLE)
    assert key(humble, "/chatter", STRING) == "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"
    token = endpoint_token(humble, "f00d", 1, PUBLISHER, "/chatter", STRING, Qos(depth=7))
    assert token == (
        "@ros2_lv/0/f00d/0/1/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported/::,7:,:,:,,"
    )


def test_tokens_of_nodes() -> None:
    assert node_token(NodeIdentity("skin", "/robots/icub"), "1") == "@ros2_lv/0/1/0/0/NN/%/%robots%icub/skin"
    assert node_token(TALKER, "aac3178e146b") == "@ros2_lv/2/aac3178e146b/0/0/NN/%/%/talker"


@pytest.mark.parametrize(
    ("number", "name", "qos", "written", "attachment"),
    [
        (11, "be", Qos(5, reliable=False), "2::,5:,:,:,,", "e628b99db87bec181046c9d069042bb2fb8cca0b35d6351fe1"),
        (12, "tl", Qos(3, latched=True), ":1:,3:,:,:,,", "7e5bba9db87bec18108f6611fe230ec3d4909a8493518ce771"),
    ],
)
def test_real_tokens_and_attachments(number: int, name: str, qos: Qos, written: str, attachment: str) -> None:
    """A node of rmw_zenoh_cpp 0.2.10 (Jazzy, zenoh 1.8.0) sent them on 2026-11-29."""
    type_hash = "RIHS01_0599f6f85b4bfca379873a0b4375a0aca022156bd2d7021275d116ed1fa8bfe0"
    floats, session = MessageType("std_msgs/msg/Float32MultiArray", type_hash), "35473f6db0e08eb24f0f8dd1e3351cd0"
    token = endpoint_token(NodeIdentity("talker", "/hand"), session, number, PUBLISHER, f"/hand/{name}", floats, qos)
    place = f"@ros2_lv/0/{session}/0/{number}/MP/%/%hand/talker/%hand%{name}"
    assert token == f"{place}/std_msgs::msg::dds_::Float32MultiArray_/{type_hash}/{written}"
    sequence, time_ns, publisher = read_attachment(data := bytes.fromhex(f"0100000000000000{attachment}"))
    assert (sequence, time_ns // 10**9, publisher) == (1, 1795946384, gid(token))
    assert packed_attachment(sequence, time_ns, publisher) == data


def test_token_of_a_service() -> None:
    token = endpoint_token(TALKER, "f", 10, SERVICE, "/tare", TRIGGER, Qos(depth=10))
    assert token == f"@ros2_lv/2/f/0/10/SS/%/%/talker/%tare/std_srvs::srv::dds_::Trigger_/{TRIGGER.hash}/::,10:,:,:,,"


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Qos(), "::,5:,:,:,,"),
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
