"""Patches whose answers a test writes down, and what the driver makes of them."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable, Sequence
from typing import Any

from skinware.errors import HandshakeTimeout
from skinware_drivers.bus import FrameBatch
from skinware_drivers.description import Patch, assemble
from skinware_drivers.fields import Match, Reply
from skinware_drivers.link import Link
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.openpatch import OpenPatchDriver, OpenPatchOptions
from tests.openpatch import wire
from tests.specification.decoding import SpecifiedDecoder

Answer = Callable[[int, bytes], bytes | None]


class ScriptedLink(Link):
    """Requests are answered by a function: type and arguments to the reply behind the number; None: no answer."""

    def __init__(self, answer: Answer) -> None:
        super().__init__(SerialBus("/dev/ttyNOWHERE"))
        self._answer = answer

    async def request(
        self, identifier: int, payload: bytes, reply: Match, *, timeout_s: float, tries: int = 1
    ) -> Reply:
        for _ in range(tries):
            said = self._answer(identifier, payload[1:])
            if said is not None:
                return Reply(0, 0x40 + identifier, payload[:1] + said)
        raise HandshakeTimeout("no answer")


def answering(items: Sequence[bytes], *, sent: int = 0, dropped: int = 0, **greeting: Any) -> Answer:
    """A patch with these items."""

    def answer(request: int, arguments: bytes) -> bytes:
        if request == 1:
            return b"\0" + wire.greeting(items, **greeting)
        if request == 2:
            return b"\0" + arguments + items[int.from_bytes(arguments, "little")]
        if request == 8:
            return b"\0" + struct.pack("<IIII", 1000, sent, dropped, 0)
        return b"\0"

    return answer


def describe(answer: Answer) -> OpenPatchDriver:
    driver = OpenPatchDriver(OpenPatchOptions())
    patches = asyncio.run(driver.describe(ScriptedLink(answer)))
    assert [type(patch) for patch in patches] == [Patch]
    return driver


def decoded(
    said: wire.Said, messages: Sequence[tuple[int, bytes]], received_ns: Sequence[int] | None = None
) -> SpecifiedDecoder:
    """A decoder that has seen some messages of a patch."""
    driver = OpenPatchDriver(OpenPatchOptions())
    patches = asyncio.run(driver.describe(ScriptedLink(answering(said.items()))))
    decoder = SpecifiedDecoder([driver.layout], assemble([("bus", patches)], driver.types, driver.dtype))
    batch = FrameBatch(64, driver.payload_size, decoder.compiled.headroom)
    decoder.put_back(batch)
    times_ns = range(1, len(messages) + 1) if received_ns is None else received_ns
    for time_ns, (identifier, payload) in zip(times_ns, messages, strict=True):
        batch.append(0, time_ns, identifier, payload)
    updates, foreign = decoder.decode(batch)
    decoder.count_unknown(batch, foreign)
    decoder.state.show(updates)
    return decoder


def data(module: int, values: bytes, *, status: int = 0, sequence: int = 0, us: int = 123) -> bytes:
    """Payload of a data message."""
    return struct.pack("<BHIB", module, sequence, us, status) + values
