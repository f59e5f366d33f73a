"""Vectors in YARP's carriers: literal bytes, made by hand from the manual."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from skinware.yarp.carriers import READ, Carrier, VectorMessage, framed, unframed
from tests.yarp.peers import READING

MESSAGE = VectorMessage(np.array([1.0, 2.5, 0.123456]), 7, 1215723086.25)


def test_text() -> None:
    assert MESSAGE.of(Carrier.TEXT) == b"do 7 1215723086.250000\r\n1.0 2.5 0.123\r\n"
    assert MESSAGE.of(Carrier.TEXT_ACK) is MESSAGE.of(Carrier.TEXT)


@pytest.mark.parametrize(("yarp", "tag"), [(3, "0A010000"), (4, "14010000")])
def test_binary(yarp: int, tag: str) -> None:
    message = VectorMessage(np.array([1.0, 2.5, 0.123456]), 7, 1215723086.25, yarp)
    command = b"do 7 1215723086.250000\0"
    block = (
        bytes.fromhex("17000000 7E 00 00 01")
        + command
        + bytes.fromhex(f"{tag} 03000000")
        + struct.pack("<3d", 1.0, 2.5, 0.123456)
    )
    index = bytes.fromhex("59410A0000005250 01 01 FFFFFFFFFFFFFFFF") + struct.pack("<ii", len(block), 0)
    assert len(command) == 0x17
    assert message.of(Carrier.TCP) == index + block
    assert message.of(Carrier.FAST_TCP) is message.of(Carrier.TCP)


def test_how_connections_begin() -> None:
    assert Carrier.TEXT.greeting("/a") == b"CONNECT /a\r\n"
    assert Carrier.TEXT_ACK.greeting("/a") == b"CONNACK /a\r\n"
    assert Carrier.TCP.greeting("/a") == bytes.fromhex("5941E41E00005250 03000000") + b"/a\0"
    assert Carrier.FAST_TCP.greeting("/a") == bytes.fromhex("5941641E00005250 03000000") + b"/a\0"


def test_a_port_is_asked_to_send_as_real_ones_are() -> None:
    assert Carrier.FAST_TCP.greeting("skinware") + READ == READING


@pytest.mark.parametrize("number", [0, 10, 7780, -1])
def test_marked_numbers(number: int) -> None:
    assert unframed(framed(number)) == number
    assert unframed(b"XA" + framed(number)[2:]) is None
