"""Viewers that are slow, broken or mean cost the driver and the other viewers nothing."""

from __future__ import annotations

import json
import os
import socket
import struct
from urllib.parse import urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed

from skinware.errors import ConfigurationError
from skinware.views import server
from skinware.views.looks import operation_of
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.views.client import page_of
from tests.views.conftest import Serve

BAD = (
    "",
    "next",
    "[]",
    "{}",
    '{"op":"format","disk":"all"}',
    '{"op":"look","mode":"upside down"}',
    '{"op":"look","fps":1e9}',
    '{"op":"look","fps":0}',
    '{"op":"look","scale":[5,5]}',
    '{"op":"look","scale":[1e999,5]}',
    '{"op":"look","scale":[1]}',
    '{"op":"look","type":7}',
    '{"op":"exact","sensors":[[0]]}',
    '{"op":"exact","sensors":[[0,-1]]}',
    '{"op":"exact","sensors":' + json.dumps([[0, 0]] * 33) + "}",
    '{"op":"names","driver":9,"type":"pressure"}',
    '{"op":"names","driver":0,"type":"smell"}',
    '{"op":"series","driver":0,"position":99999}',
    '{"op":"wipe","action":"explode"}',
    '{"op":"replay","action":"pause"}',
    "[" * 5000,
    '{"op":"next","protocol":"skinware.view.0"}',
)


@pytest.mark.thorough
@pytest.mark.parametrize("text", BAD)
def test_what_cannot_be_done_is_said_in_the_next_turn(serving: Serve, text: str) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 1))), serving() as url, page_of(url) as page:
        page.pull_picture()
        page.connection.send(text)
        if '"next"' in text:
            assert b"reload" in page.connection.recv()
            return
        turn = page.pull_until(lambda turn: "error" in turn)
        assert 0 < len(turn["error"]) < 500
        page.pull_picture()


def test_looking_at_a_type_that_is_not_there_shows_nothing(serving: Serve) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 1))), serving() as url, page_of(url) as page:
        page.pull_picture()
        page.say("look", type="smell")
        page.pull()
        for _ in range(3):
            assert "pictures" not in page.pull()
        page.say("look", type="pressure")
        page.pull_picture()


@given(st.one_of(st.text(), st.binary()))
def test_any_message_is_an_operation_or_refused(message: str | bytes) -> None:
    with pytest.raises(ConfigurationError):
        operation_of(message)


@pytest.mark.thorough
@given(st.recursive(st.none() | st.booleans() | st.floats() | st.integers() | st.text(), st.lists, max_leaves=5))
def test_any_arguments_are_taken_or_refused(value: object) -> None:
    for name in ("next", "look", "exact", "names", "series", "tare", "wipe", "record", "replay"):
        text = json.dumps({"op": name, **dict.fromkeys(("mode", "scale", "fps", "sensors", "driver", "type"), value)})
        try:
            operation_of(text)
        except ConfigurationError:
            continue


def test_a_huge_message_ends_only_its_sender(serving: Serve) -> None:
    with publishing(FakeSkin("torso", fake_structure(1, 1))), serving() as url, page_of(url) as page:
        with page_of(url) as mean:
            mean.connection.send("x" * 1_000_000)
            with pytest.raises(ConnectionClosed, match="1009"):
                mean.connection.recv()
        page.pull_picture()


@pytest.mark.thorough
def test_who_never_reads_holds_up_nobody(serving: Serve) -> None:
    """It asks for thousands of turns and takes none."""
    with publishing(FakeSkin("torso", fake_structure(8, 32))) as skin, serving() as url, page_of(url) as page:
        where = urlsplit(url)
        with socket.create_connection((where.hostname or "", where.port or 0)) as mute:
            mute.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            mute.sendall(handshake(where.netloc))
            mute.setblocking(False)
            with pytest.raises(BlockingIOError):
                fill(mute, masked('{"op":"next"}') * 1000)
            before = skin.writer.sequence
            for _ in range(20):
                page.pull_picture()
            assert skin.writer.sequence > before


def test_many_come_and_go_in_the_middle(serving: Serve) -> None:
    with publishing(FakeSkin("torso", fake_structure(4, 32))), serving() as url, page_of(url) as page:
        for number in range(30):
            where = urlsplit(url)
            with socket.create_connection((where.hostname or "", where.port or 0)) as short:
                short.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # ends with a reset
                short.sendall(handshake(where.netloc)[: None if number % 2 else number])
                if number % 3:
                    short.sendall(masked('{"op":"next"}')[: number % 12])
        for _ in range(5):
            page.pull_picture()


def test_no_more_viewers_than_there_is_room_for(serving: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "_MOST_VIEWERS", 1)
    with serving() as url, page_of(url) as page:
        page.pull()
        with page_of(url) as other, pytest.raises(ConnectionClosed, match="1013"):
            other.connection.recv()
        page.pull()


def fill(connection: socket.socket, data: bytes) -> None:
    """Send until nothing more goes in."""
    while True:
        connection.send(data)


def handshake(host: str) -> bytes:
    lines = ["GET /live HTTP/1.1", f"Host: {host}", "Upgrade: websocket", "Connection: Upgrade"]
    lines += ["Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13", "", ""]
    return "\r\n".join(lines).encode()


def masked(text: str) -> bytes:
    """A web socket's frame of text as a client has to send it."""
    mask = os.urandom(4)
    body = bytes(byte ^ mask[at % 4] for at, byte in enumerate(text.encode()))
    return bytes([0x81, 0x80 | len(body)]) + mask + body
