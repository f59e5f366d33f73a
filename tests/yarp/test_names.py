"""The name server, as a caller sees it."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from skinware.yarp.names import NameServer, PortAddress, configured_server, is_port_name
from tests.yarp.peers import END, LOCAL, PORT, Answering, robot, until_gone


def test_a_port_is_looked_up_as_the_manual_says() -> None:
    with robot(until_gone) as there:
        server = NameServer(LOCAL, there.server.port)
        assert server.query(PORT) == PortAddress(PORT, LOCAL, there.port.port, "tcp")
        assert server.query("/nobody") is None
        assert there.asked == [b"query " + PORT.encode(), b"query /nobody"]


def answers(*pieces: bytes) -> Callable[[socket.socket], None]:

    def handle(caller: socket.socket) -> None:
        for piece in pieces:
            caller.sendall(piece)
        until_gone(caller)

    return handle


def asked(handle: Callable[[socket.socket], None], name: str = "/write") -> PortAddress | None:
    there = Answering(handle)
    try:
        return NameServer(LOCAL, there.port).query(name)
    finally:
        there.close()


MANUAL = (  # "The name server protocol"
    b"Welcome foo\r\nregistration name /write ip 5.255.112.227 port 10001 type tcp\r\n*** end of message\r\n"
)


def test_the_answer_of_the_manual() -> None:
    assert asked(answers(MANUAL)) == PortAddress("/write", "5.255.112.227", 10001, "tcp")
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
        with pytest.raises(OSError, match=r"timed out|no answer|not that of a name server"):
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


TRANSCRIPTS = Path(__file__).parents[3] / "shared/data/yarp_transcripts"


def recorded(name: str) -> list[tuple[bytes, bytes]]:
    """What was asked of a real yarpserver in each connection, and what it answered."""
    path = TRANSCRIPTS / f"{name}.txt"
    if not path.exists():
        pytest.skip(f"there are no exchanges with a real YARP: {path} is missing")
    exchanges = []
    for connection in path.read_text().split("\nconnection ")[1:]:
        lines = {way: re.findall(rf"^{way} ([0-9a-f]{{8,}})$", connection, re.MULTILINE) for way in "<>"}
        exchanges.append((bytes.fromhex("".join(lines[">"])), bytes.fromhex("".join(lines["<"]))))
    return exchanges


def test_a_real_name_server_is_asked_and_understood_byte_by_byte() -> None:
    exchanges = recorded("name_server_text")
    asked: list[bytes] = []

    def replay(caller: socket.socket) -> None:
        question, answer = exchanges[len(asked)]
        with caller.makefile("rb") as lines:
            asked.append(b"".join(next(lines) for _ in range(question.count(b"\n"))))
        caller.sendall(answer)
        until_gone(caller)

    with contextlib.closing(Answering(replay)) as there:
        server = NameServer(LOCAL, there.port)
        assert server.register("/sk/in", LOCAL, 12346) == PortAddress("/sk/in", LOCAL, 12346, "tcp")
        assert server.register("/sk/in2", "...", 12347) == PortAddress("/sk/in2", LOCAL, 12347, "tcp")
        assert server.query("/sk/in") == PortAddress("/sk/in", LOCAL, 12346, "tcp")
        assert server.query("/not/there") is None
        assert asked == [question for question, _ in exchanges[:4]]
        exchanges[4:5] = []  # the list of all ports, which is never asked for
        server.unregister("/sk/in")
        server.unregister("/sk/in2")
        assert asked == [question for question, _ in exchanges[:6]]


def test_carriers_are_registered_as_real_ports_register_theirs() -> None:
    """The transcript has them in the form NAME_SERVER; behind its first word the question is the same."""
    real = {
        key: (question.removeprefix(b"NAME_SERVER ").strip(), answer)
        for question, answer in recorded("name_server_cli")
        for key in ("offers", "accepts")
        if f" {key} ".encode() in question
    }
    carriers = real["offers"][0].split(b" offers ")[1].decode().split()
    asked: list[bytes] = []

    def replay(caller: socket.socket) -> None:
        with caller.makefile("rb") as lines:
            asked.append([next(lines) for _ in range(3)][2].strip())
        caller.sendall(b"Welcome skinware\r\n" + real["offers" if b" offers " in asked[-1] else "accepts"][1])
        until_gone(caller)

    with contextlib.closing(Answering(replay)) as there:
        NameServer(LOCAL, there.port).describe("/foo/bar", carriers)
    assert asked == [question for question, _ in real.values()]
