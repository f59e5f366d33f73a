"""A port that is read: what it says to YARP's tools, whom it calls, and that nobody can hold it up."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from skinware.yarp.carriers import Carrier, VectorMessage, YarpWord, framed, packed, unpacked
from skinware.yarp.names import NameServer
from skinware.yarp.port import _ADMINISTRATION, _WHICH_YARP, OutputPort
from skinware_drivers.testing.waiting import wait_until
from tests.yarp.peers import GREETING, LOCAL, PATIENCE_S, READING, Answering, Robot, robot, until_gone

OURS = "/skinware/hand"


class There:
    def __init__(self, names: NameServer) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()
        self.port = OutputPort(OURS, names, yarp=3)
        self.number = asyncio.run_coroutine_threadsafe(self.port.open(LOCAL), self.loop).result(PATIENCE_S)
        self.count = 0

    def send(self, *values: float) -> None:
        self.count += 1
        message = VectorMessage(np.array(values), self.count, time.time(), yarp=3)
        done = threading.Event()
        self.loop.call_soon_threadsafe(self.port.send, message)
        self.loop.call_soon_threadsafe(done.set)
        assert done.wait(PATIENCE_S)

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self.port.close(), self.loop).result(PATIENCE_S)
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(PATIENCE_S)
        self.loop.run_until_complete(self.loop.shutdown_default_executor())
        self.loop.close()


@pytest.fixture
def yarp() -> Iterator[Robot]:
    with robot(until_gone) as there:
        yield there


@pytest.fixture
def there(yarp: Robot) -> Iterator[There]:
    with contextlib.closing(There(NameServer(LOCAL, yarp.server.port))) as port:
        yield port


@contextmanager
def called(there: There, text: bytes) -> Iterator[socket.socket]:
    with socket.create_connection((LOCAL, there.number), PATIENCE_S) as connection:
        connection.sendall(text)
        yield connection


def hear(connection: socket.socket, end: bytes) -> bytes:
    data = b""
    while not data.endswith(end):
        more = connection.recv(1 << 16)
        assert more, data
        data += more
    return data


def test_a_reader_as_the_manual_has_it(there: There) -> None:
    with called(there, b"CONNECT foo\n") as connection:
        assert hear(connection, b"\r\n") == b"Welcome foo\r\n"
        connection.sendall(b"*\n")
        assert (
            hear(connection, b"connections\r\n") == b"This is /skinware/hand\r\nThere are no outgoing connections\r\n"
        )
        connection.sendall(b"what\n")
        assert b"not understood" in hear(connection, b"for help.\r\n")
        connection.sendall(b"?\n")
        assert b"Reverse connection type" in hear(connection, b"this help\r\n")
        connection.sendall(b"d\nhello yarp\nr\n")
        wait_until(lambda: len(there.port.receivers) == 1)
        there.send(1.0, 2.5)
        head, vector = hear(connection, b"2.5\r\n").splitlines()
        assert head.startswith(b"do 1 1")
        assert vector == b"1.0 2.5"
    wait_until(lambda: not there.port.receivers)


def test_it_quits_when_it_is_told(there: There) -> None:
    with called(there, b"CONNECT foo\r\nq\r\n") as connection:
        assert hear(connection, b"foo\r\n")
        assert connection.recv(10) == b""


class Input(Answering):
    """An input port of a carrier; ``heard`` is everything, and each message is acknowledged once ``acks`` is set."""

    def __init__(self, carrier: Carrier) -> None:
        self.carrier = carrier
        self.heard = b""
        self.acks = threading.Event()
        super().__init__(self._take)

    def _take(self, caller: socket.socket) -> None:
        greeting = len(self.carrier.greeting(OURS))
        while len(self.heard) < greeting:
            self.heard += caller.recv(greeting - len(self.heard))
        if not self.carrier.is_text:
            caller.sendall(b"YA\1\2\0\0RP")
        while more := caller.recv(1 << 16):
            self.heard += more
            if self.carrier.acknowledges:
                self.acks.wait(PATIENCE_S)
                caller.sendall(b"YA\2\0\0\0RPxx")

    @property
    def messages(self) -> int:
        return self.heard.count(b"do ")


def connect(there: There, name: str) -> bytes:
    """What ``yarp connect /skinware/hand NAME`` asks, as it asks it, and the last answer."""
    told = b"a\r\n[list] [out] " + name.rpartition(":/")[2].encode() + b"\r\na\r\n[add] " + name.encode() + b"\r\n"
    with called(there, b"CONNACK admin\r\n" + told) as connection:
        data = b""
        while data.count(b"<ACK>\r\n") < 2:
            data += connection.recv(1 << 12)
        return data.split(b"<ACK>\r\n")[1]


@pytest.mark.parametrize("carrier", [Carrier.TCP, Carrier.FAST_TCP, Carrier.TEXT])
def test_it_calls_a_port_that_it_is_told_to_call(yarp: Robot, there: There, carrier: Carrier) -> None:
    with contextlib.closing(Input(carrier)) as gui:
        gui.acks.set()
        yarp.ports["/gui:i"] = (LOCAL, gui.port, "tcp")
        assert connect(there, f"{carrier.title}://gui:i") == b'0 "Added connection from /skinware/hand to /gui:i"\r\n'
        wait_until(lambda: len(there.port.receivers) == 1)
        there.send(3.0)
        wait_until(lambda: gui.messages == 1)
        wait_until(lambda: not there.port.receivers[0].is_busy)
        there.send(4.0)
        wait_until(lambda: gui.messages == 2)
        assert gui.heard.startswith(carrier.greeting(OURS))
        if not carrier.is_text:
            assert gui.heard.endswith(struct.pack("<iid", 266, 1, 4.0))
        with called(there, b"CONNACK admin\r\na\r\n[list] [out] /gui:i\r\na\r\n[del] /gui:i\r\n") as connection:
            told = hear(connection, b'/gui:i"\r\n<ACK>\r\n')
            assert f"(carrier {carrier.title})".encode() in told
            assert b'0 "Removed connection' in told
        wait_until(lambda: not there.port.receivers)


def test_a_port_that_is_called_again_is_not_called_twice(yarp: Robot, there: There) -> None:
    with contextlib.closing(Input(Carrier.FAST_TCP)) as gui:
        yarp.ports["/gui:i"] = (LOCAL, gui.port, "tcp")
        for _ in range(3):
            connect(there, "fast_tcp://gui:i")
        wait_until(lambda: len(there.port.receivers) == 1)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        (b"/nobody", b"the name server does not know it"),
        (b"/gone", b"refused"),
        (b"udp://gui:i", b"only text, tcp and fast_tcp"),
        (b"nonsense", b"no name of a port"),
        (b'"/a b"', b"no name of a port"),
    ],
)
def test_whom_it_cannot_call(yarp: Robot, there: There, name: bytes, why: bytes) -> None:
    with socket.create_server((LOCAL, 0)) as probe:
        yarp.ports["/gone"] = (LOCAL, probe.getsockname()[1], "tcp")
    with called(there, b"CONNECT admin\r\na\r\n[add] " + name + b"\r\n") as connection:
        said = hear(connection, b'"\r\n')
        assert said.startswith(b"Welcome admin\r\n-1 ")
        assert why in said.lower()


def test_other_things_that_are_asked_for(there: There) -> None:
    asked = b"a\r\n[ver]\r\na\r\n[list] [in]\r\na\r\n[prop] get x\r\n!/gui\r\n/nobody\r\n"
    with called(there, b"CONNECT admin\r\n" + asked + b"q\r\n") as connection:
        said = hear(connection, b"know it\r\n").splitlines()
        assert said[1:4] == [b"[ver] 1 2 3", b"", b'[fail] "send [help] for list of valid commands"']


@pytest.mark.thorough
def test_a_reader_that_does_not_read_misses_vectors_and_holds_nobody_up(yarp: Robot, there: There) -> None:
    many = [0.125] * 3000
    with contextlib.closing(Input(Carrier.TCP)) as busy, called(there, b"CONNECT slow\nr\n"):
        yarp.ports["/busy"] = (LOCAL, busy.port, "tcp")
        connect(there, "/busy")
        with called(there, b"CONNECT quick\nr\n") as quick:
            wait_until(lambda: len(there.port.receivers) == 3)
            for number in range(300):
                there.send(*many, float(number))
                hear(quick, f" {number}.0\r\n".encode())
            by_name = {receiver.name: receiver for receiver in there.port.receivers}
            assert (by_name["quick"].sent, by_name["quick"].passed_over) == (300, 0)
            assert (by_name["/busy"].sent, by_name["/busy"].passed_over) == (1, 299)
            assert by_name["slow"].passed_over > 100
            busy.acks.set()
            wait_until(lambda: not by_name["/busy"].is_busy)
            there.send(1.0)
            wait_until(lambda: busy.messages == 2)


def test_a_reader_in_binary(there: There) -> None:
    with called(there, GREETING) as connection:
        assert hear(connection, b"RP") == b"YA" + there.number.to_bytes(4, "little") + b"RP"
        connection.sendall(READING[len(GREETING) :])
        wait_until(lambda: [(r.name, r.carrier) for r in there.port.receivers] == [("skinware", Carrier.FAST_TCP)])
        there.send(4.0)
        assert hear(connection, struct.pack("<iid", 266, 1, 4.0))


INDEX = "59410a0000005250 0201 ffffffffffffffff 08000000 {:02x}000000 00000000 00000000 7e{:02x}0001"


def question(letter: str, data: str) -> bytes:
    """As ``yarp rpc`` 3.8.1 asks: a command of one letter, and a list."""
    return bytes.fromhex(INDEX.format(len(bytes.fromhex(data)), ord(letter)) + data)


NO_MORE = bytes.fromhex("59410a0000005250 0101 ffffffffffffffff 0a000000 00000000 02000000 7e000001") + b"q\0"
LIST_OUT = "09010000 02000000 6c697374 6f757400"
VER = "09010000 01000000 76657200"
ADD = "00010000 02000000 09000000 61646400 04000000 07000000" + b"/nobody".hex()
FOO = "00010000 03000000 04000000 03000000 666f6f 01000000 05000000 01010000 02000000 01000000 02000000"


def test_questions_in_binary_are_answered_as_a_real_port_answers_them(yarp: Robot, there: There) -> None:
    """The questions, the answer to ``[ver]`` and those to lists of nothing are those of a port of YARP 3.8.1."""
    with called(there, Carrier.TCP.greeting("anon_rpc")) as connection:
        assert hear(connection, b"RP")
        connection.sendall(question("a", VER))
        ver = bytes.fromhex("00010000 04000000 09000000 76657200 01000000 01000000 01000000 02000000 01000000 03000000")
        assert hear(connection, framed(0)) == ver + framed(0)
        connection.sendall(question("a", LIST_OUT))
        assert hear(connection, framed(0)) == bytes.fromhex("00010000 00000000") + framed(0)
        connection.sendall(question("a", ADD))
        assert unpacked(hear(connection, framed(0))[:-8]) == [
            -1,
            "Cannot connect to /nobody: the name server does not know it",
        ]
        connection.sendall(question("a", FOO))
        assert unpacked(hear(connection, framed(0))[:-8])[0] == "fail"
        connection.sendall(question("a", "09010000 01000000 68656c70"))
        many = unpacked(hear(connection, framed(0))[:-8])
        assert (many[0], len(many)) == ("many", 1 + len(_ADMINISTRATION))
        connection.sendall(question("d", "04010000 01000000 05000000" + b"hello".hex()))
        assert "only sends" in str(unpacked(hear(connection, framed(0))[:-8])[1])
        connection.sendall(question("D", "04010000 01000000 05000000" + b"hello".hex()))
        assert hear(connection, framed(0)) == framed(0)
        connection.sendall(NO_MORE)
        assert hear(connection, framed(0)) == framed(0)
        assert connection.recv(10) == b""


def test_one_who_asks_in_binary_can_have_us_call(yarp: Robot, there: There) -> None:
    with contextlib.closing(Input(Carrier.FAST_TCP)) as gui:
        yarp.ports["/gui:i"] = (LOCAL, gui.port, "tcp")
        with called(there, Carrier.FAST_TCP.greeting("anon_rpc")) as connection:
            assert hear(connection, b"RP")
            add = ["add", "fast_tcp://gui:i"]
            connection.sendall(question("a", packed([YarpWord(add[0]), add[1]]).hex()))
            told = packed([0, "Added connection from /skinware/hand to /gui:i"])
            assert hear(connection, told[-8:]) == told
            wait_until(lambda: len(there.port.receivers) == 1)
            connection.sendall(question("a", packed([YarpWord("list"), YarpWord("out"), "/gui:i"]).hex()))
            listed = packed(["push", 1])
            assert unpacked(hear(connection, listed)) == [
                ["from", OURS],
                ["to", "/gui:i"],
                ["carrier", "fast_tcp"],
                ["connectionless", 0],
                ["push", 1],
            ]


@pytest.mark.parametrize(
    "said",
    [
        b"YA\x0b\0\0\0RP" + bytes(20),
        b"YA\x0a\0\0\0RP\xff\xff" + bytes(8),
        bytes.fromhex("59410a0000005250 0101 ffffffffffffffff ffffff7f 00000000"),
        bytes.fromhex("59410a0000005250 0101 ffffffffffffffff ffffffff 00000000"),
        bytes.fromhex("59410a0000005250 0101 ffffffffffffffff 08000000 00000000 00000000 21610001"),
        bytes.fromhex("59410a0000005250 0101 ffffffffffffffff 08000000 00000000 ffffff7f 7e610001"),
        question("a", ""),
        question("a", "00010000 ffffff7f"),
        question("a", "00010000 01000000 04000000 ffffffff"),
        question("a", "00010000 01000000 0a000000 00000000"),
        question("a", "00010000 01000000" * 8),
        question("a", VER + "00"),
    ],
)
def test_what_is_no_question_in_binary_is_hung_up_on(there: There, said: bytes) -> None:
    with called(there, Carrier.TCP.greeting("anon_rpc") + said) as connection, contextlib.suppress(ConnectionError):
        assert hear(connection, b"RP")
        assert connection.recv(100) == b""


def test_no_reader_in_binary_is_served_where_its_version_is_not_known(
    yarp: Robot, there: There, caplog: pytest.LogCaptureFixture
) -> None:
    there.port._yarp = None
    for _ in range(2):
        with called(there, READING) as connection, contextlib.suppress(ConnectionError):
            assert hear(connection, b"RP")
            assert connection.recv(100) == b""
    assert [record.message for record in caplog.records] == [
        f"/skinware/hand: skinware reads by fast_tcp and is refused: {_WHICH_YARP}"
    ]
    with contextlib.closing(Input(Carrier.TEXT)) as gui:
        yarp.ports["/gui:i"] = (LOCAL, gui.port, "tcp")
        assert b"start skin-bridge yarp with --yarp 3 or --yarp 4" in connect(there, "tcp://gui:i")
        assert not gui.callers
        assert connect(there, "text://gui:i").startswith(b'0 "Added')


@pytest.mark.parametrize(
    "said",
    [
        b"YA\x65\x1e\0\0RP",
        b"YA\x64\x1e\0\0RP\xff\xff\xff\x7f",
        b"GET / HTTP/1.1\r\n",
        b"\0" * 100,
        b"CONNECT " + b"x" * 10_000,
    ],
)
def test_who_speaks_otherwise_is_hung_up_on(there: There, said: bytes) -> None:
    with called(there, said) as connection, contextlib.suppress(ConnectionError):
        assert connection.recv(100) == b""


def test_whatever_is_said_the_port_goes_on(there: There) -> None:
    rng = random.Random(5)
    words = [
        b"a",
        b"d",
        b"*",
        b"?",
        b"[list]",
        b"[out]",
        b"[del]",
        b"[set]",
        b"(",
        b")",
        b'"',
        b"/",
        b"!/x",
        b"\xff",
        b"\0",
        b"",
    ]
    for _ in range(30):
        lines = [b" ".join(rng.choices(words, k=rng.randint(1, 5))) for _ in range(20)]
        with called(there, b"CONNECT x\r\n" + b"\n".join(lines)), contextlib.suppress(OSError):
            pass
    with called(there, b"CONNECT foo\nr\n") as connection:
        wait_until(lambda: [receiver.name for receiver in there.port.receivers] == ["foo"])
        there.send(1.0)
        assert hear(connection, b"1.0\r\n")


def test_a_crowd_is_not_served(there: There) -> None:
    with contextlib.ExitStack() as crowd:
        for number in range(80):
            crowd.enter_context(called(there, b"CONNECT x%d\nr\n" % number))
        wait_until(lambda: len(there.port.receivers) == 64)
        there.send(1.0)
    wait_until(lambda: not there.port.receivers)
