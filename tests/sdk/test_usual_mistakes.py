"""What authors of drivers get wrong at first is said in words, where they did it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from skinware.errors import ConfigurationError
from skinware_drivers import Frame, Identifier
from skinware_drivers.link import Link
from skinware_drivers.registry import make_bus
from skinware_drivers.serial import Field, Packet

frame: Any = Frame  # what is wrong is wrong for a type checker, too
packet: Any = Packet
place: Any = Field


@pytest.mark.parametrize(
    ("declared", "told"),
    [
        (lambda: place(2, 9), "Field at 2: size = 9: give 1, 2 or 4 bytes"),
        (lambda: place(2, 2, ">"), "Field at 2: order = '>': give little or big"),
        (lambda: packet(sync="SK", length=4), "write b'SK', not 'SK'"),
        (lambda: packet(trailer="\n", length=4), r"sync and trailer are bytes: write b'\\n'"),
        (lambda: frame("all", Identifier(1)), "frame 'all': `when` is a list"),
        (lambda: frame("all", length=8), r"frame 'all': `length` is a list: write length=\[...\]"),
        (lambda: make_bus("10.0.0.2:5000"), "of a device behind a network, tcp://10.0.0.2:5000"),
    ],
)
def test_a_wrong_declaration_is_refused_in_words(declared: Callable[[], Any], told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        declared()


@pytest.mark.parametrize("name", ["TCP://10.0.0.2:5000", "http://10.0.0.2", "ws://10.0.0.2:5000"])
def test_the_name_of_a_network_that_is_not_known_tells_those_that_are(name: str) -> None:
    bus = make_bus(name)
    with pytest.raises(ConfigurationError, match=r"over a network: tcp://HOST:PORT, udp://HOST:PORT or websocket:ws"):
        bus.open()


def test_a_payload_that_is_no_bytes_is_named() -> None:
    payload: Any = 1
    with pytest.raises(TypeError, match=r"the payload 1 is no bytes: write b'...', or bytes\(\[...\]\)"):
        asyncio.run(Link(make_bus("/dev/ttyUSB0")).send(0x10, payload))
