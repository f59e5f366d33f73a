"""The name server, as a caller sees it."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from skinware.yarp.names import Contact, NameServer, configured_server, is_port_name
from tests.yarp.peers import END, LOCAL, PORT, Answering, robot, until_gone


def test_a_port_is_looked_up_as_the_manual_says() -> None:
    with robot(until_gone) as there:
        server = NameServer(LOCAL, there.server.port)
        assert server.query(PORT) == Contact(PORT, LOCAL, there.port.port, "tcp")
        assert server.query("/nobody") is None
        assert there.asked == [b"query " + PORT.encode(), b"query /nobody"]


def answers(*pieces: bytes) -> Callable[[socket.socket], None]:
    """Says this whatever it hears."""

    def handle(caller: socket.socket) -> None:
        for piece in pieces:
            caller.sendall(piece)
        until_gone(caller)

    return handle


def asked(handle: Callable[[socket.socket], None], name: str = "/write") -> Contact | None:
    there = Answering(handle)
    try:
        return NameServer(LOCAL, there.port).query(name)
    finally:
        there.close()


MANUAL = (  # "The name server protocol"
    b"Welcome foo\r\nregistration name /write ip 5.255.112.227 port 10001 type tcp\r\n*** end of message\r\n"
)


def test_the_answer_of_the_manual() -> None:
    assert asked(answers(MANUAL)) == Contact("/write", "5.255.112.227", 10001, "tcp")
    assert asked(answers(*(MANUAL[at : at + 1] for at in range(len(MANUAL))))) is not None
    assert asked(answers(MANUAL), "/other") is None


@pytest.mark.parametrize(
    "wrong",
    [
        b"registration name /write ip h port 70000 type tcp\n",
        b"registration name /write ip h port 0 type tcp\n",
        b"registration\n",
    ],
)
def test_an_answer_that_cannot_be_is_none(wrong: bytes) -> None:
    assert asked(answers(wrong + END)) is None


def test_what_is_no_name_server_is_said_to_be_none() -> None:
    with pytest.raises(OSError, match="name server"):
        asked(answers(b"x" * 200_000))

    def hangs_up(caller: socket.socket) -> None:
        caller.recv(10)

    with pytest.raises(OSError, match=f"name server at {LOCAL}"):
        asked(hangs_up)


def test_one_that_says_nothing_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skinware.yarp.names._PATIENCE_S", 0.1)
    over = threading.Event()

    def drips(caller: socket.socket) -> None:
        while not over.wait(0.02):
            caller.sendall(b"x")

    with pytest.raises(OSError, match=r"timed out|no answer|no name server"):
        asked(until_gone)
    try:
        with pytest.raises(OSError, match=r"timed out|no answer|no name server"):
            asked(drips)
    finally:
        over.set()


def test_nobody_there() -> None:
    with socket.create_server((LOCAL, 0)) as probe:
        port = probe.getsockname()[1]
    with pytest.raises(OSError, match=rf"name server at {LOCAL}:{port}: .*refused"):
        NameServer(LOCAL, port).query(PORT)


@pytest.mark.parametrize("name", ["", "hand", "/", "/a/", "/a b", '/a"', "/a\nquit", "/a(b)", "/é", "/" + "a" * 300])
def test_names_that_no_port_has_are_never_sent(name: str) -> None:
    assert not is_port_name(name)
    with pytest.raises(ValueError, match="no name of a YARP port"):
        NameServer(LOCAL, 1).query(name)


def test_where_programs_of_yarp_look(tmp_path: Path) -> None:
    file = tmp_path / "yarp" / "yarp.conf"
    file.parent.mkdir()
    environment = {"XDG_CONFIG_HOME": str(tmp_path), "HOME": str(tmp_path / "no")}
    assert configured_server(environment) == ("127.0.0.1", 10000)
    file.write_text("10.0.0.1 10009 yarp\n")
    assert configured_server(environment) == ("10.0.0.1", 10009)
    assert configured_server({"YARP_CONFIG_HOME": str(file.parent)}) == ("10.0.0.1", 10009)
    for text in ("", "10.0.0.1", "host port", "host 99999999"):
        file.write_text(text)
        assert configured_server(environment) == ("127.0.0.1", 10000)
