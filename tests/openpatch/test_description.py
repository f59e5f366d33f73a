"""What patches say of themselves: everything that can be said is understood, and lies are refused with clear words."""

from __future__ import annotations

import asyncio
import contextlib
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware import Status
from skinware.errors import BusError, HandshakeTimeout
from skinware.sensor_types import CATALOGUE
from skinware_drivers.adapter import Notice
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoder import Decoder
from skinware_drivers.description import Patch, assemble
from skinware_drivers.link import Link, Match, Reply
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.openpatch import OpenPatchDriver, OpenPatchOptions
from skinware_drivers.serial.openpatch_description import BadDescription, Greeting, Report, read_description
from skinware_drivers.skin_state import BUS_COUNTERS
from tests.openpatch import wire

Answer = Callable[[int, bytes], bytes | None]
DTYPES = ("u1", "<i2", "<u2", "<i4", "<f4")


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


def answering(items: Sequence[bytes], **greeting: Any) -> Answer:
    """A patch with these items."""

    def answer(request: int, arguments: bytes) -> bytes:
        if request == 1:
            return b"\0" + wire.greeting(items, **greeting)
        if request == 2:
            return b"\0" + arguments + items[int.from_bytes(arguments, "little")]
        return b"\0"

    return answer


def describe(answer: Answer) -> OpenPatchDriver:
    driver = OpenPatchDriver(OpenPatchOptions())
    patches = asyncio.run(driver.describe(ScriptedLink(answer)))
    assert [type(patch) for patch in patches] == [Patch]
    return driver


def decoded(said: wire.Said, messages: Sequence[tuple[int, bytes]]) -> Decoder:
    """A decoder that has seen some messages of a patch."""
    driver = OpenPatchDriver(OpenPatchOptions())
    patches = asyncio.run(driver.describe(ScriptedLink(answering(said.items()))))
    decoder = Decoder([driver.layout], assemble([("bus", patches)], driver.types, driver.dtype))
    batch = FrameBatch(64, driver.payload_size, decoder.headroom)
    decoder.put_back(batch)
    for number, (identifier, payload) in enumerate(messages):
        batch.append(0, number + 1, identifier, payload)
    updates, foreign = decoder.decode(batch)
    decoder.count_unknown(batch, foreign)
    decoder.state.show(updates)
    return decoder


TYPE, KIND = wire.Said().types[0], wire.Said().kinds[0]
LIES: dict[str, tuple[dict[str, Any], str]] = {
    "no module": ({"modules": []}, "the patch has 0 modules; 1 to 255 can be"),
    "modules of no kind": ({"modules": [(7, 1)]}, "modules of kind 7, but there are only 1 kinds"),
    "too many modules": ({"modules": [(0, 255), (0, 1)]}, "the patch has 256 modules; 1 to 255 can be"),
    "too many values": (
        {"kinds": [("k", 0, [(1000, [0])])], "modules": [(0, 17)]},
        "the patch has 17000 values; 1 to 16384 can be",
    ),
    "no type": ({"types": [], "kinds": [("k", 0, [(1, [0xFF])])]}, "the patch has 0 types; 1 to 64 can be"),
    "no sensor": ({"kinds": [("k", 0, [(5, [0xFF])])]}, "the patch has no sensors"),
    "a run of nothing": ({"kinds": [("k", 0, [(0, [0])])]}, "kind 'k' has a run of 0 taxels with 1 axes"),
    "a run without axes": ({"kinds": [("k", 0, [(1, [])])]}, "kind 'k' has a run of 1 taxels with 0 axes"),
    "a kind of nothing": ({"kinds": [("k", 0, [])]}, "kind 'k' has 0 bytes of values; 1 to 1016 fit"),
    "a kind that is too large": ({"kinds": [("k", 3, [(255, [0])])]}, "kind 'k' has 1020 bytes of values"),
    "65535 taxels of 9 axes": (
        {
            "types": [(77 << 12 | n, 1.0, 0.0, 0.0, 0.0, f"t{n}", "") for n in range(9)],
            "kinds": [("k", 4, [(65535, list(range(9)))] * 80)],
        },
        "kind 'k' has 188740800 bytes of values",
    ),
    "an unknown dtype": ({"kinds": [("k", 5, [(1, [0])])]}, "kind 'k' has values of dtype 5; known are 0 to 4"),
    "an unknown type": ({"kinds": [("k", 0, [(1, [2])])]}, "kind 'k' has values of type 2, but there are only 2"),
    "one type twice": ({"kinds": [("k", 0, [(1, [0, 0])])]}, "kind 'k' has taxels with two values of one type"),
    "a type of no id": ({"types": [(0, *TYPE[1:5], "x", "")]}, "item 1 of the description: id 0 of type 'x'"),
    "no scale": ({"types": [(1, 0.0, *TYPE[2:])]}, "scale must be finite and not 0"),
    "a scale that is no number": ({"types": [(1, math.nan, *TYPE[2:])]}, "scale must be finite and not 0"),
    "a range that is none": ({"types": [(*TYPE[:3], 5.0, 4.0, "pressure", "")]}, "ranges from 5.0 to 4.0"),
    "a range of no numbers": ({"types": [(*TYPE[:3], math.nan, 4.0, "pressure", "")]}, "ranges from nan"),
    "a name of the catalogue": ({"types": [(99 << 12, *TYPE[1:])]}, "is called 'pressure'; in the shared catalogue"),
    "a number of the catalogue": ({"types": [(*TYPE[:5], "force", "N")]}, "type 1 is called 'force'"),
    "two types of one name": (
        {"types": [(77 << 12 | n, 1.0, 0.0, 0.0, 0.0, "t", "") for n in range(2)]},
        "two types of the patch share a name or an id",
    ),
    "too many types": (
        {"types": [(77 << 12 | n, 1.0, 0.0, 0.0, 0.0, f"t{n}", "") for n in range(65)]},
        "the patch has 65 types",
    ),
    "too many kinds": ({"kinds": [KIND] * 33}, "the patch has 33 kinds of module; 1 to 32 can be"),
    "whole and real numbers": (
        {"kinds": [("a", 3, [(1, [0])]), ("b", 4, [(1, [0])])], "modules": [(0, 1), (1, 1)]},
        "32-bit whole numbers beside floating point",
    ),
    "a long name": ({"product": "x" * 33}, "a text that does not end within 32 bytes"),
    "a long kind": ({"kinds": [("x" * 17, 0, [(1, [0])])]}, "a text that does not end within 16 bytes"),
    "no name": ({"product": "", "serial_number": ""}, "neither a product nor a serial number"),
    "control characters": ({"product": "\x1b[31m"}, "is no text"),
    "no period": ({"periods_us": (0, 0, 0)}, "a period of 0 us, between 0 and 0"),
    "a period out of its range": ({"periods_us": (500, 1000, 2000)}, "a period of 500 us, between 1000 and 2000"),
}


@pytest.mark.parametrize("lie", LIES)
def test_lies_are_refused_with_clear_words(lie: str) -> None:
    changes, message = LIES[lie]
    with pytest.raises(BadDescription, match=message):
        describe(answering(replace(wire.Said(), **changes).items()))


def test_a_patch_of_another_version_is_refused() -> None:
    with pytest.raises(BadDescription, match=r"speaks version 2\.0 of the protocol, this driver version 1"):
        describe(answering(wire.Said().items(), major=2))
    with pytest.raises(BadDescription, match="speaks no version"):
        describe(lambda request, arguments: b"\0")


@pytest.mark.parametrize("count", [0, 257, 0xFFFF])
def test_a_description_of_too_many_items_is_not_asked_for(count: int) -> None:
    def answer(request: int, arguments: bytes) -> bytes:
        assert request == 1
        return b"\0" + struct.pack("<BBBBIIH", 1, 0, 0, 0, 0, 0, count)

    with pytest.raises(BadDescription, match=f"a description of {count} items"):
        describe(answer)


def test_a_description_that_changes_while_it_is_read_is_refused() -> None:
    one, other = wire.Said().items(), wire.Said(firmware="1.1").items()

    def answer(request: int, arguments: bytes) -> bytes | None:
        return answering(one if request == 1 else other)(request, arguments)

    with pytest.raises(BadDescription, match="the description changed while it was being read"):
        describe(answer)


def test_answers_that_are_none() -> None:
    good = answering(wire.Said().items())
    with pytest.raises(HandshakeTimeout):
        describe(lambda request, arguments: None)
    with pytest.raises(BusError, match="refuses request 0x02: there is no such module or item"):
        describe(lambda request, arguments: good(request, arguments) if request == 1 else b"\x03")
    with pytest.raises(BusError, match="error 200"):
        describe(lambda request, arguments: good(request, arguments) if request == 1 else b"\xc8")
    with pytest.raises(BadDescription, match="asked for item 0 and sent another"):
        describe(lambda request, arguments: good(request, arguments) if request == 1 else b"\0\x01\0abc")
    with pytest.raises(BadDescription, match="the answer to request 0x01 has 1 bytes"):
        describe(lambda request, arguments: b"")


def test_a_lost_answer_is_asked_for_again() -> None:
    asked: list[tuple[int, bytes]] = []

    def answer(request: int, arguments: bytes) -> bytes | None:
        asked.append((request, arguments))
        return answering(wire.Said().items())(request, arguments) if len(asked) % 3 == 0 else None

    driver = describe(answer)
    assert driver.period_s == 0.01
    assert len(asked) == 3 * (1 + len(wire.Said().items()))


def test_what_later_versions_add_is_passed_over() -> None:
    items = [item + b"\x01more" for item in wire.Said(more=[b"\x63unknown", b"\x04\x00"]).items()]
    driver = describe(answering(items, reset=77))
    assert [t.name for t in driver.types] == ["pressure", "temperature"]


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


def test_a_probe_tells_what_happened() -> None:
    items = wire.Said().items()
    driver = describe(answering(items))
    patch = asyncio.run(driver.describe(ScriptedLink(answering(items))))[0]
    told: list[Notice] = []

    async def probe(answer: Answer) -> bool:
        link = ScriptedLink(answer)
        attending = asyncio.create_task(driver.attend(link, lambda patch, notice: told.append(notice)))
        await asyncio.sleep(0)
        try:
            return await driver.probe(link, patch)
        finally:
            attending.cancel()

    assert asyncio.run(probe(answering(items, streaming=False)))
    assert not asyncio.run(probe(answering(items, streaming=True)))
    assert told == []
    assert not asyncio.run(probe(answering(wire.Said(product="other").items())))
    assert told == [Notice.CHANGED]


def test_another_patch_in_its_place_is_not_started() -> None:
    items = wire.Said().items()
    driver = describe(answering(items))
    told: list[Notice] = []

    def answer(request: int, arguments: bytes) -> bytes:
        assert (request, arguments) == (3, struct.pack("<I", wire.crc32(b"".join(items))))
        return b"\x08"

    async def start() -> None:
        link = ScriptedLink(answer)
        attending = asyncio.create_task(driver.attend(link, lambda patch, notice: told.append(notice)))
        await asyncio.sleep(0)
        try:
            await driver.start(link)
        finally:
            attending.cancel()

    with pytest.raises(BusError, match="its description is not the one that was read"):
        asyncio.run(start())
    assert told == [Notice.CHANGED]


def data(module: int, values: bytes, *, status: int = 0, sequence: int = 0) -> bytes:
    return struct.pack("<BHIB", module, sequence, 123, status) + values


def test_status_bits_of_modules_and_values() -> None:
    said = wire.Said(kinds=[("k", 4, [(3, [0]), (1, [0xFF])])])
    values = np.array([1, math.nan, 3, math.nan], "<f4").tobytes()
    state = decoded(said, [(0x80, data(0, values)), (0x80, data(1, values + b"\x01\x08\x42\xff", status=0x84))]).state
    nan = int(Status.NOT_CONNECTED)
    assert state.status[:3].tolist() == [0, nan, 0]
    assert state.status[3:].tolist() == [4, 4 | 8 | nan, 4 | 0x42]
    assert state.values[[0, 2]].tolist() == [1, 3]


@pytest.mark.parametrize(
    ("payload", "is_module"),
    [
        *((payload, True) for payload in (b"", bytes(7), data(0, bytes(7)), data(0, bytes(9)), data(0, bytes(13)))),
        (data(2, bytes(8)), False),
    ],
)
def test_data_of_a_wrong_form_is_not_shown(payload: bytes, is_module: bool) -> None:
    state = decoded(wire.Said(), [(0x80, payload), (0x81, data(0, bytes(8)))]).state
    assert (state.status == int(Status.NEVER_SEEN)).all()
    counters = dict(zip(BUS_COUNTERS, state.bus_counters[0].tolist(), strict=True))
    assert counters["bad_length"] == is_module
    assert counters["unknown"] == 1 + (not is_module)  # a kind that there is not, a module that there is not


def stamped(driver: OpenPatchDriver, stamps: Sequence[int], received_ns: Sequence[int]) -> list[int]:
    batch = FrameBatch(len(stamps), driver.payload_size)
    for stamp, time_ns in zip(stamps, received_ns, strict=True):
        batch.append(0, time_ns, 0x80, struct.pack("<BHIB", 0, 0, stamp, 0))
    driver.stamp(batch.wire, batch.time_ns)
    times: list[int] = batch.time_ns.tolist()
    return times


def test_samples_have_the_time_at_which_they_were_taken() -> None:
    driver = OpenPatchDriver(OpenPatchOptions())
    wrapping = [2**32 - 10_000, 0, 10_000, 20_000]
    assert stamped(driver, wrapping, [10**9, 1_010_000_000, 1_055_000_000, 1_056_000_000]) == [
        1_000_000_000,
        1_010_000_000,
        1_020_000_000,
        1_030_000_000,
    ]
    batch = FrameBatch(2, driver.payload_size)
    batch.append(0, 5, 0x41, bytes(20))
    batch.append(0, 6, 0x80, bytes(3))
    driver.stamp(batch.wire, batch.time_ns)
    assert batch.time_ns.tolist() == [5, 6]


def test_a_clock_that_stands_still_is_not_believed_for_long() -> None:
    driver = OpenPatchDriver(OpenPatchOptions())
    received_ns = [n * 10**8 for n in range(1, 50)]
    told = [stamped(driver, [7], [time_ns])[0] for time_ns in received_ns]
    assert all(time_ns - then <= 2 * 10**9 for time_ns, then in zip(received_ns, told, strict=True))


NAMES = st.text(st.characters(codec="utf-8", categories=["L", "N"]), max_size=4)
REALS = st.floats(width=32, allow_nan=False, allow_infinity=False)
LIMITS = st.tuples(REALS, REALS).map(lambda pair: (min(pair), max(pair)))


@st.composite
def sayings(draw: st.DrawFn) -> wire.Said:
    """Any description that a patch may give."""
    numbers = draw(st.lists(st.integers(1, 14) | st.integers(1 << 12, 2**32 - 1), min_size=1, max_size=9, unique=True))
    known = {t.id: t.name for t in CATALOGUE.values()}
    types = [
        (number, draw(REALS.filter(bool)), draw(REALS), *draw(LIMITS), known.get(number, f"t{n}"), draw(NAMES))
        for n, number in enumerate(numbers)
    ]
    axes = st.lists(st.sampled_from(range(len(types))), min_size=1, max_size=9, unique=True)
    runs = st.lists(st.tuples(st.integers(1, 6), axes | st.just([0xFF])), min_size=1, max_size=4)
    size = st.sampled_from(draw(st.sampled_from([(0, 1, 2, 3), (0, 1, 2, 4)])))
    kinds = draw(st.lists(st.tuples(NAMES, size, runs), min_size=1, max_size=4))
    kinds[0] = (*kinds[0][:2], [*kinds[0][2], (2, [0])])
    modules = draw(st.lists(st.tuples(st.sampled_from(range(len(kinds))), st.integers(0, 5)), max_size=5))
    return wire.Said(draw(NAMES), "7", draw(NAMES), (10, 10, 10), types, kinds, [(0, 1), *modules])


@settings(deadline=None, max_examples=40)
@given(sayings(), st.data())
def test_every_description_and_its_data_come_out_as_they_were_said(said: wire.Said, more: st.DataObject) -> None:
    of_module = [said.kinds[kind] for kind, count in said.modules for _ in range(count)]
    values, messages = [], []
    for number, (name, dtype, runs) in enumerate(of_module):
        kind = said.kinds.index((name, dtype, runs))
        n = sum(count * len(axes) for count, axes in runs)
        if n * int(DTYPES[dtype][-1]) > 1016:
            return
        values.append(np.frombuffer(more.draw(st.binary(min_size=4 * n, max_size=4 * n)), DTYPES[dtype])[:n])
        messages.append((0x80 + kind, data(number, values[-1].tobytes())))
    decoder = decoded(said, messages)
    structure = decoder.tables.structure
    expected: list[tuple[int, int, int, float]] = []
    uid = 0
    for number, (_, _, runs) in enumerate(of_module):
        place = 0
        for count, axes in runs:
            for _ in range(count):
                for axis in axes:
                    if axis != 0xFF:
                        expected.append((number, said.types[axis][0], uid, values[number][place]))
                    place += 1
                uid += axes != [0xFF]
    columns = (structure.sensor_module, structure.sensor_type, structure.sensor_uid)
    assert list(zip(*(c.tolist() for c in columns), strict=True)) == [row[:3] for row in expected]
    np.testing.assert_array_equal(decoder.state.values, np.array([row[3] for row in expected], structure.dtype))
    assert [t.scale for t in structure.types] == pytest.approx([t[1] for t in said.types])
    assert structure.module_kind.tolist() == [kind[0].encode() for kind in of_module]


@settings(deadline=None, max_examples=100)
@given(st.lists(st.integers(0, 65535), min_size=1, max_size=30), st.data())
def test_of_a_damaged_stream_only_whole_messages_are_shown(samples: list[int], more: st.DataObject) -> None:
    """Flipped bits, lost and inserted bytes: every update that comes out is one that was sent."""
    sent = [data(n % 2, struct.pack("<4H", *[value] * 4), sequence=n) for n, value in enumerate(samples)]
    stream = bytearray(b"".join(wire.frame(0x80, message) for message in sent))
    for _ in range(more.draw(st.integers(0, 8))):
        at = more.draw(st.integers(0, max(0, len(stream) - 1)))
        stream[at : at + more.draw(st.integers(0, 3))] = more.draw(st.binary(max_size=3))
    framer = OpenPatchDriver.framing.framer()
    found, rest = [], bytes(stream)
    while rest:
        size = more.draw(st.integers(1, 200))
        found += [
            (i, body) for f in [framer.feed(rest[:size])] for i, body in zip(f.identifier, f.bodies(), strict=True)
        ]
        rest = rest[size:]
    assert all(identifier == 0x80 and body in sent for identifier, body in found)
    state = decoded(wire.Said(), found).state
    for module in range(2):
        shown = set(state.values[4 * module : 4 * module + 4].tolist())
        assert len(shown) == 1
        assert shown <= {0, *samples}


def test_listening_alone_is_refused_with_the_reason() -> None:
    link = Link(SerialBus("/dev/ttyNOWHERE", listen_only=True))
    with pytest.raises(BusError, match="only when it is asked"):
        asyncio.run(OpenPatchDriver(OpenPatchOptions()).describe(link))


@settings(deadline=None, max_examples=300)
@given(st.data())
def test_damaged_descriptions_are_understood_or_refused(more: st.DataObject) -> None:
    """Whatever the CRC agrees with makes a skin or a clear refusal, and never anything else."""
    items = wire.Said().items()
    for _ in range(more.draw(st.integers(1, 3))):
        number = more.draw(st.integers(0, len(items) - 1))
        item = bytearray(items[number])
        at = more.draw(st.integers(0, len(item)))
        item[at : at + more.draw(st.integers(0, 3))] = more.draw(st.binary(max_size=3))
        items[number] = bytes(item)
    try:
        found = read_description(items, wire.crc32(b"".join(items)))
    except BadDescription:
        return
    Decoder([found.layout], assemble([("bus", [found.patch])], found.types, found.dtype))


@given(st.binary(max_size=40), st.lists(st.binary(max_size=60), max_size=4))
def test_any_bytes_are_understood_or_refused(message: bytes, items: list[bytes]) -> None:
    for read in (Greeting.read, Report.read, lambda _: read_description(items, wire.crc32(b"".join(items)))):
        with contextlib.suppress(BadDescription):
            read(message)
