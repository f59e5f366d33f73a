"""What patches say of themselves: everything that can be said is understood, and lies are refused with clear words."""

from __future__ import annotations

import contextlib
import math
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware.sensor_types import CATALOGUE
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.description import assemble
from skinware_drivers.serial.openpatch_description import BadDescription, Greeting, Report, read_description
from tests.openpatch import wire
from tests.openpatch.scripted import answering, data, decoded, describe

DTYPES = ("u1", "<i2", "<u2", "<i4", "<f4")
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


@pytest.mark.parametrize("count", [0, 257, 0xFFFF])
def test_a_description_of_too_many_items_is_not_asked_for(count: int) -> None:
    def answer(request: int, arguments: bytes) -> bytes:
        assert request == 1
        return b"\0" + struct.pack("<BBBBIIH", 1, 0, 0, 0, 0, 0, count)

    with pytest.raises(BadDescription, match=f"a description of {count} items"):
        describe(answer)


def test_what_later_versions_add_is_passed_over() -> None:
    items = [item + b"\x01more" for item in wire.Said(more=[b"\x63unknown", b"\x04\x00"]).items()]
    driver = describe(answering(items, reset=77))
    assert [t.name for t in driver.types] == ["pressure", "temperature"]


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


@pytest.mark.thorough
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


@pytest.mark.thorough
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
