"""Frames as bytes, and back: every bit, whatever it is; and bytes that are no frames."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware.errors import BadRecording
from skinware.memory import file_layout
from skinware.memory.ring import Sample
from skinware.transfer.codec import HEADER, CodedColumn, FrameEncoder, Run, runs

DTYPES = ["u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<u8", "<i8", "<f8", "S7", "V13"]


class Source:
    """What frames are of."""

    context: object = None
    generation = 7
    period_ns = 0

    def __init__(self, columns: list[tuple[str, int]]) -> None:
        slot = {f"{number}": (np.dtype(code), count) for number, (code, count) in enumerate(columns)}
        self.layout = file_layout.plan({}, slot)
        self.columns: dict[str, tuple[tuple[int, ...], np.dtype[Any], int]] = {
            c.name: ((c.count,), c.dtype, c.offset) for c in self.layout.slot
        }
        self.coded = [CodedColumn.of(column) for column in self.layout.slot]

    def frame(self, sequence: int, contents: list[bytes]) -> Sample:
        """One with these bytes in its columns."""
        slot = bytearray(self.layout.slot_stride)
        head = np.frombuffer(slot, file_layout.SLOT, 1)
        head["sequence"], head["acquired_ns"], head["published_ns"], head["flags"] = sequence, 5, 1 << 61, 1 << 63
        for column, data in zip(self.layout.slot, contents, strict=True):
            slot[column.offset : column.offset + len(data)] = data
        return Sample(self, slot)


def changing(generator: np.random.Generator, dtype: np.dtype[Any], count: int, frames: int, step: int) -> list[bytes]:
    """Bytes of a column in some frames: of numbers that change by a step, or by anything."""
    if dtype.kind in "ui" and step:
        words: npt.NDArray[Any] = generator.integers(0, 256, count * dtype.itemsize).astype("u1").view(dtype)
        found = []
        for _ in range(frames):
            words = words + generator.integers(0, step + 1, count).astype(dtype) - dtype.type(step // 2)
            found.append(words.astype(dtype).tobytes())
        return found
    return [generator.bytes(count * dtype.itemsize) if step else bytes(count * dtype.itemsize) for _ in range(frames)]


@pytest.mark.thorough
@given(
    st.lists(st.tuples(st.sampled_from(DTYPES), st.sampled_from([0, 1, 3, 4, 700, 5000])), min_size=1, max_size=4),
    st.integers(1, 6),
    st.sampled_from([0, 1, 2, 8, 100]),
    st.sets(st.integers(1, 5)),
    st.integers(0, 1 << 32),
)
def test_every_bit_comes_back(columns: list[tuple[str, int]], count: int, step: int, keys: set[int], seed: int) -> None:
    source = Source(columns)
    generator = np.random.default_rng(seed)
    by_column = [changing(generator, np.dtype(code), n, count, step) for code, n in columns]
    frames = [source.frame(number + 1, list(contents)) for number, contents in enumerate(zip(*by_column, strict=True))]
    encoder, messages = FrameEncoder(source.coded), []
    for number, frame in enumerate(frames):
        if number in keys:
            encoder.next_is_key()
        messages.append(encoder.encode(frame))
    decoded = [
        bytes(slot)
        for generation, which in runs(messages)
        for slot in Run(messages[which], source.coded).decode_slots(source.layout.slot_stride)
        if generation == 7
    ]
    assert decoded == [bytes(frame.slot) for frame in frames]


def some_messages() -> tuple[Source, list[bytes]]:
    source = Source([("<u2", 3000), ("u1", 3000), ("<i8", 200), ("<f4", 5)])
    generator = np.random.default_rng(3)
    by_column = [changing(generator, column.dtype, column.count, 5, 9) for column in source.layout.slot]
    encoder = FrameEncoder(source.coded)
    return source, [encoder.encode(source.frame(n + 1, list(c))) for n, c in enumerate(zip(*by_column, strict=True))]


def test_noise_of_a_few_counts_takes_few_bits() -> None:
    source = Source([("<u2", 30_000)])
    generator = np.random.default_rng(1)
    level = generator.integers(0, 60_000, 30_000)
    encoder = FrameEncoder(source.coded)
    sizes = []
    for number in range(3):
        values = (level + np.round(generator.normal(0, 2, 30_000))).astype("<u2")
        sizes.append(len(encoder.encode(source.frame(number + 1, [values.tobytes()]))))
    assert sizes[0] > 55_000
    assert max(sizes[1:]) < 1.05 * 30_000 * 3.6 / 8  # entropy of the difference of two such noises: 3.55 bits
    unchanged = encoder.encode(source.frame(4, [values.tobytes()]))
    assert len(unchanged) < 64


def test_a_frame_without_the_one_before_it_is_left_out() -> None:
    source, messages = some_messages()
    other = FrameEncoder(source.coded)
    key = other.encode(source.frame(9, [bytes(column.count * column.dtype.itemsize) for column in source.layout.slot]))
    torn = [messages[1], b"short", messages[0], messages[1], messages[3], messages[4], key]
    assert list(runs(torn)) == [(7, slice(2, 4)), (7, slice(6, 7))]


def test_bytes_that_are_no_frames_are_refused_and_nothing_else_happens() -> None:
    source, messages = some_messages()
    generator = random.Random(5)
    refused = 0
    for _ in range(400):
        damaged = [bytearray(message) for message in messages]
        message = generator.choice(damaged)
        for _ in range(generator.randint(1, 5)):
            message[generator.randrange(HEADER.itemsize, len(message))] = generator.randrange(256)
        if generator.random() < 0.3:
            del message[generator.randrange(len(message)) :]
        for _, which in runs([bytes(one) for one in damaged]):
            try:
                Run([bytes(one) for one in damaged[which]], source.coded).decode_slots(source.layout.slot_stride)
            except BadRecording:
                refused += 1
    assert refused > 50


def test_a_column_that_claims_to_be_huge_is_not_unpacked() -> None:
    import zlib

    source = Source([("u1", 2000)])
    bomb = zlib.compressobj(9, zlib.DEFLATED, -15)
    data = bomb.compress(bytes(50_000_000)) + bomb.flush()
    header = np.zeros(1, HEADER).tobytes()
    message = header + bytes([0x81]) + np.array([len(data)], "<u4").tobytes() + data
    with pytest.raises(BadRecording, match="as many bytes"):
        Run([message], source.coded).decode_slots(source.layout.slot_stride)
