"""SDO transfers against literal frames of CiA 301, and against the server of the canopen package."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import canopen
import numpy as np
import pytest

from skinware.errors import HandshakeTimeout
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can import canopen_objects
from skinware_drivers.can.canopen_objects import SdoAborted, SdoClient
from skinware_drivers.link import Link
from tests.commands import PATIENCE_S

T = TypeVar("T")
NODE = 5
Answer = Callable[[bytes], list[str]]


class Wire:
    """A bus on which every request is answered at once: by ``answer``, with frames of 0x585 in hexadecimal."""

    listen_only = False
    name = "bus wire"
    medium = "can"

    def __init__(self, answer: Answer) -> None:
        self._answer = answer
        self.requests: list[str] = []
        self.link = Link(self)  # type: ignore[arg-type]

    def send(self, identifier: int, payload: bytes) -> None:
        assert identifier == 0x600 + NODE
        self.requests.append(payload.hex())
        batch = FrameBatch(16)
        for text in self._answer(payload):
            at, _, data = text.rpartition(":")
            batch.append(0, 1, int(at or "585", 16), bytes.fromhex(data))
        self.link.offer(batch, np.arange(len(batch)))


def transfer(wire: Wire, what: Callable[[SdoClient], Awaitable[T]]) -> T:
    async def run() -> T:
        return await asyncio.wait_for(what(SdoClient(wire.link, NODE)), PATIENCE_S)

    return asyncio.run(run())


def scripted(*answers: list[str]) -> Wire:
    script = iter(answers)
    return Wire(lambda _request: next(script, []))


@pytest.fixture(autouse=True)
def short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(canopen_objects, "REPLY_S", 0.05)


# Literal frames


@pytest.mark.parametrize(
    ("answer", "data"),
    [
        ("4300100091010200", "91010200"),
        ("4B0010000D0A0000", "0d0a"),
        ("4F00100007000000", "07"),
        ("4700100001020300", "010203"),
        ("4200100091010200", "91010200"),  # the size is not said: all four
    ],
)
def test_expedited_reads(answer: str, data: str) -> None:
    wire = scripted([answer])
    assert transfer(wire, lambda client: client.read(0x1000)) == bytes.fromhex(data)
    assert wire.requests == ["4000100000000000"]


def test_a_segmented_read() -> None:
    wire = scripted(["4108100009000000"], ["0041424344454647"], ["1B48490000000000"])
    assert transfer(wire, lambda client: client.read(0x1008)) == b"ABCDEFGHI"
    assert wire.requests == ["4008100000000000", "6000000000000000", "7000000000000000"]


def test_expedited_writes() -> None:
    wire = scripted(["6017100000000000"], ["6000180500000000"], ["6000180100000000"])

    async def write(client: SdoClient) -> None:
        await client.write(0x1017, 0, b"\x64\x00")
        await client.write(0x1800, 5, b"\x07")
        await client.write(0x1800, 1, b"\x85\x01\x00\x80")

    transfer(wire, write)
    assert wire.requests == ["2b17100064000000", "2f00180507000000", "2300180185010080"]


def test_a_segmented_write() -> None:
    wire = scripted(["6000200100000000"], ["2000000000000000"], ["3000000000000000"])
    transfer(wire, lambda client: client.write(0x2000, 1, b"ABCDEFGHI"))
    assert wire.requests == ["2100200109000000", "0041424344454647", "1b48490000000000"]


def test_a_refusal_says_what_was_refused_and_why() -> None:
    wire = scripted(["8000200100000206"])
    with pytest.raises(
        SdoAborted, match=r"object 2000:1 of node 5: Object does not exist \(abort code 0x06020000\)"
    ) as e:
        transfer(wire, lambda client: client.read(0x2000, 1))
    assert e.value.code == 0x06020000


def test_silence_is_a_timeout() -> None:
    with pytest.raises(HandshakeTimeout, match="no answer from object 1000:0 of node 5"):
        transfer(scripted(), lambda client: client.read(0x1000))


@pytest.mark.parametrize(
    "strange",
    [
        "586:4300100091010200",  # another node
        "80000585:4300100091010200",  # 29 bits
        "4301100091010200",  # another object
        "43001000910102",  # too short
        "",
        "6000100000000000",  # an answer to a write
        "8001100000000206",  # a refusal of something else
    ],
)
def test_what_is_no_answer_is_passed_over(strange: str) -> None:
    wire = scripted([strange, "4F00100007000000"])
    assert transfer(wire, lambda client: client.read(0x1000)) == b"\x07"


def test_a_segment_with_the_wrong_toggle_is_no_answer() -> None:
    with pytest.raises(HandshakeTimeout):
        transfer(scripted(["4108100009000000"], ["1041424344454647"]), lambda client: client.read(0x1008))


@pytest.mark.thorough
def test_an_endless_object_is_given_up() -> None:
    toggle = iter([0, 16] * 100_000)

    def answer(request: bytes) -> list[str]:
        return ["4108100009000000"] if request[0] == 0x40 else [f"{next(toggle):02X}41424344454647"]

    with pytest.raises(SdoAborted, match="more than 65536 bytes"):
        transfer(Wire(answer), lambda client: client.read(0x1008))


def test_transfers_to_one_node_wait_for_each_other() -> None:
    wire = scripted(["4F00100001000000"], ["4F01100002000000"])

    async def both(client: SdoClient) -> tuple[bytes, bytes]:
        first, second = await asyncio.gather(client.read(0x1000), client.read(0x1001))
        return first, second

    assert transfer(wire, both) == (b"\x01", b"\x02")


# The canopen package's server


class Server:
    """A LocalNode whose answers go where the wire wants them."""

    def __init__(self) -> None:
        dictionary = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
        for index, data_type in ((0x2000, 0xF), (0x1017, 6)):
            variable = canopen.objectdictionary.ODVariable(f"{index:04X}", index)
            variable.data_type = data_type
            dictionary.add_object(variable)
        self.node = canopen.LocalNode(NODE, dictionary)
        self.node.sdo.network = self  # type: ignore[assignment]
        self._answers: list[str] = []

    def send_message(self, can_id: int, data: Any) -> None:
        self._answers.append(f"{can_id:X}:{bytes(data).hex()}")

    def answer(self, request: bytes) -> list[str]:
        self._answers = []
        self.node.sdo.on_request(0x600 + NODE, bytearray(request), 0.0)  # type: ignore[no-untyped-call]
        return self._answers


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 7, 8, 13, 14, 15, 100, 889])
def test_what_is_written_is_read_again(size: int) -> None:
    data = bytes(range(256)) * 4
    server = Server()
    wire = Wire(server.answer)

    async def there_and_back(client: SdoClient) -> bytes:
        await client.write(0x2000, 0, data[:size])
        return await client.read(0x2000)

    assert transfer(wire, there_and_back) == data[:size]
    assert server.node.get_data(0x2000, 0) == data[:size]


def test_a_value_of_the_wrong_size_is_refused() -> None:
    with pytest.raises(SdoAborted, match="Data type and length code do not match"):
        transfer(Wire(Server().answer), lambda client: client.write(0x1017, 0, b"\x01"))
