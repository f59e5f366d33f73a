"""Sequence numbers and the counters of cycles: where they may be, and their old names."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.decoding.decoder import read_numbers
from skinware_drivers.fields import Identifier, SequenceNumber
from skinware_drivers.layout import Cycle, Frame, Layout, Values


@pytest.mark.parametrize(
    ("sequence", "number", "turn"),
    [
        (SequenceNumber(1, "u1"), 0xB4, 256),
        (SequenceNumber(1, "u1", mask=0xF0), 0xB, 16),
        (SequenceNumber(1, "u1", mask=0x0C), 1, 4),
        (SequenceNumber(0, ">u2", mask=0x0FF0), 0x2B, 256),
        (SequenceNumber(0, "<u2", modulo=50_000), 0xB412, 50_000),
    ],
)
def test_a_number_is_the_bits_of_its_mask(sequence: SequenceNumber, number: int, turn: int) -> None:
    payload = np.array([[0x12, 0xB4, 0xFF]], np.uint8)
    assert read_numbers(payload, sequence).tolist() == [number]
    assert sequence.turn == turn


def cycle_of(counter: Any, **of_frames: Any) -> Layout:
    frames = [Frame(f"f{i}", [Identifier(0x100 + i)], [4], Values(2, "u1", 1, to=[i]), **of_frames) for i in range(2)]
    return Layout(frames, Cycle(["f0", "f1"], 0.01, counter=counter))


@pytest.mark.parametrize(
    ("counter", "of_frames", "words"),
    [
        (SequenceNumber(3, "<u2"), {}, "'f0', counter of its cycle: the sequence number is not in every right payload"),
        (SequenceNumber(0, "i1"), {}, "'i1' is not unsigned"),
        (SequenceNumber(0, "u1", mask=0xA0), {}, "mask 0xa0 .* side by side"),
        (SequenceNumber(0, "u1", mask=0x1F0), {}, "mask 0x1f0"),
        (SequenceNumber(0, "u1", mask=0), {}, "mask 0x0"),
        (SequenceNumber(0, "u1", modulo=300), {}, "modulo 300"),
        (SequenceNumber(0, "u1", mask=1), {}, "has 2 values: two lost cycles look like none; it needs 4"),
        ([SequenceNumber(0, "u1")], {}, "one for each member"),
        ([SequenceNumber(0, "u1"), SequenceNumber(0, "u1", modulo=9)], {}, "of the same modulo"),
        (SequenceNumber(0, "u1"), {"sequence": SequenceNumber(0, "u1")}, "beside the counter of its cycle"),
    ],
)
def test_a_counter_that_cannot_be_is_refused(counter: Any, of_frames: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        cycle_of(counter, **of_frames)


def test_each_member_may_have_its_counter_elsewhere() -> None:
    counters = [SequenceNumber(0, "u1"), SequenceNumber(1, "u1")]
    assert cycle_of(counters).cycle.counters == counters  # type: ignore[union-attr]
