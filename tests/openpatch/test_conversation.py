"""What the driver asks of a patch, and how it takes each answer, good, bad or none."""

from __future__ import annotations

import asyncio
import struct

import pytest

from skinware.errors import BusError, HandshakeTimeout
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.link import Link
from skinware_drivers.polling import Notice
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.openpatch import OpenPatchDriver, OpenPatchOptions
from skinware_drivers.serial.openpatch_description import BadDescription
from tests.openpatch import wire
from tests.openpatch.scripted import Answer, ScriptedLink, answering, describe

PATCH = Patch("finger", [Module(taxels(1))])


def test_a_patch_of_another_version_is_refused() -> None:
    with pytest.raises(BadDescription, match=r"speaks version 2\.0 of the protocol, this driver version 1"):
        describe(answering(wire.Said().items(), major=2))
    with pytest.raises(BadDescription, match="speaks no version"):
        describe(lambda request, arguments: b"\0")


def test_answers_that_are_none() -> None:
    good = answering(wire.Said().items())
    with pytest.raises(HandshakeTimeout):
        describe(lambda request, arguments: None)
    with pytest.raises(BusError, match="refuses command 0x02 with status 3: there is no such module or item"):
        describe(lambda request, arguments: good(request, arguments) if request == 1 else b"\x03")
    with pytest.raises(BusError, match="with status 200: look into the maker's manual"):
        describe(lambda request, arguments: good(request, arguments) if request == 1 else b"\xc8")
    with pytest.raises(BadDescription, match="asked for item 0 and sent another"):
        describe(lambda request, arguments: good(request, arguments) if request == 1 else b"\0\x01\0abc")
    with pytest.raises(BusError, match="the patch's answer to command 0x01 has no status"):
        describe(lambda request, arguments: b"")


def test_a_lost_answer_is_asked_for_again() -> None:
    asked: list[tuple[int, bytes]] = []

    def answer(request: int, arguments: bytes) -> bytes | None:
        asked.append((request, arguments))
        return answering(wire.Said().items())(request, arguments) if len(asked) % 3 == 0 else None

    driver = describe(answer)
    assert driver.period_s == 0.01
    assert len(asked) == 3 * (1 + len(wire.Said().items()))


def test_a_known_description_is_not_read_again_and_another_is() -> None:
    items = wire.Said().items()
    asked: list[int] = []

    def answer(request: int, arguments: bytes) -> bytes | None:
        asked.append(request)
        return answering(items)(request, arguments)

    driver = describe(answer)
    asked.clear()
    link = ScriptedLink(answer)
    first = asyncio.run(driver.describe(link))
    assert asked == [1]
    items[:] = wire.Said(modules=[(0, 3)]).items()
    assert len(asyncio.run(driver.describe(link))[0].modules) == 3 != len(first[0].modules)


def test_a_description_that_changes_while_it_is_read_is_refused() -> None:
    one, other = wire.Said().items(), wire.Said(firmware="1.1").items()

    def answer(request: int, arguments: bytes) -> bytes | None:
        return answering(one if request == 1 else other)(request, arguments)

    with pytest.raises(BadDescription, match="the description changed while it was being read"):
        describe(answer)


def test_a_probe_tells_what_happened() -> None:
    items = wire.Said().items()
    driver = describe(answering(items))
    patch = asyncio.run(driver.describe(ScriptedLink(answering(items))))[0]
    told: list[Notice] = []
    driver.heard_by = lambda patch, notice: told.append(notice)

    async def probe(answer: Answer) -> bool:
        link = ScriptedLink(answer)
        return await driver.probe(link, patch)

    assert asyncio.run(probe(answering(items, streaming=False)))
    assert not asyncio.run(probe(answering(items, streaming=True)))
    assert told == []
    assert not asyncio.run(probe(answering(wire.Said(product="other").items())))
    assert told == [Notice.CHANGED]


def test_samples_that_this_machine_reads_late_are_not_held_against_the_patch(caplog: pytest.LogCaptureFixture) -> None:
    items = wire.Said().items()
    driver = describe(answering(items))

    def blamed(sent: int, dropped: int) -> bool:
        caplog.clear()
        link = ScriptedLink(answering(items, sent=sent, dropped=dropped, streaming=True))
        assert not asyncio.run(driver.probe(link, PATCH))
        return "its sampling hangs" in caplog.text

    assert not blamed(5, 0)
    assert not blamed(6, 0)
    assert not blamed(6, 1)  # its line is slow
    assert blamed(6, 1)


def test_a_patch_whose_modules_are_all_off_is_not_blamed_for_its_silence(caplog: pytest.LogCaptureFixture) -> None:
    link = ScriptedLink(answering(wire.Said().items(), streaming=True))
    driver = describe(answering(wire.Said().items()))

    def probed() -> bool:
        for _ in range(2):
            assert not asyncio.run(driver.probe(link, PATCH))
        return "its sampling hangs" in caplog.text

    asyncio.run(driver.enable(link, [PATCH], on=False))
    assert not probed()
    asyncio.run(driver.enable(link, [PATCH], module=1))
    assert probed()


def test_another_patch_in_its_place_is_not_started() -> None:
    items = wire.Said().items()
    driver = describe(answering(items))
    told: list[Notice] = []
    driver.heard_by = lambda patch, notice: told.append(notice)

    def answer(request: int, arguments: bytes) -> bytes:
        assert (request, arguments) == (3, struct.pack("<I", wire.crc32(b"".join(items))))
        return b"\x08"

    async def start() -> None:
        await driver.start(ScriptedLink(answer))

    with pytest.raises(BusError, match="its description is not the one that was read"):
        asyncio.run(start())
    assert told == [Notice.CHANGED]


def test_listening_alone_is_refused_with_the_reason() -> None:
    link = Link(SerialBus("/dev/ttyNOWHERE", listen_only=True))
    with pytest.raises(BusError, match="only when it is asked"):
        asyncio.run(OpenPatchDriver(OpenPatchOptions()).describe(link))
