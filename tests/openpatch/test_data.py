"""What the driver makes of data messages: status, time, and damage on the way."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware import Status
from skinware_drivers.decoding.decoder import BUS_COUNTERS
from skinware_drivers.serial.openpatch import OpenPatchDriver
from tests.openpatch import wire
from tests.openpatch.scripted import data, decoded


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


@pytest.mark.thorough
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
        found += [(frame.identifier, frame.body) for frame in framer.feed(rest[:size])]
        rest = rest[size:]
    assert all(identifier == 0x80 and body in sent for identifier, body in found)
    state = decoded(wire.Said(), found).state
    for module in range(2):
        shown = set(state.values[4 * module : 4 * module + 4].tolist())
        assert len(shown) == 1
        assert shown <= {0, *samples}


def test_samples_have_the_time_at_which_they_were_taken() -> None:
    samples = [(0x80, data(n % 2, bytes(8), us=(n * 10_000 - 10_000) % 2**32)) for n in range(4)]
    received_ns = [1_000_000_000, 1_010_000_000, 1_055_000_000, 1_056_000_000]
    state = decoded(wire.Said(), samples, received_ns).state
    assert state.module_time_ns.tolist() == [1_020_000_000, 1_030_000_000]
