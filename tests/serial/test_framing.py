"""What every framing promises, whatever arrives, in pieces of whatever size."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware_drivers.serial.delimited import Delimited
from skinware_drivers.serial.framing import Field, Framed
from skinware_drivers.serial.packets import Length, LengthTable, Packet
from tests.serial.framings import EXAMPLES, Example
from tests.serial.streams import BUSY, cut, feed, frames, noise, outcome, streams

names = st.sampled_from(list(EXAMPLES))


def starting(example: Example) -> bytes:
    """What has to come first so that the very first frame counts."""
    framing = example.framing
    is_bare = isinstance(framing, Delimited) and framing.checksum is None
    return bytes([framing.stuffing.delimiter]) if is_bare and isinstance(framing, Delimited) else b""


def ending(example: Example) -> bytes:
    """What has to follow so that the last frame is known to be one."""
    framing = example.framing
    if isinstance(framing, Packet) and framing.confirmed:
        return framing.encode(example.identifiers[0], bytes(framing.maximum_body))
    return b""


@pytest.mark.thorough
@settings(BUSY, max_examples=50)
@given(name=names, data=st.data())
def test_what_is_encoded_is_found_again(name: str, data: st.DataObject) -> None:
    example = EXAMPLES[name]
    sent = data.draw(st.lists(frames(example), min_size=1, max_size=6))
    stream = starting(example) + b"".join(frame for _, _, frame in sent) + ending(example)
    found, _, _ = outcome(example.framing, [stream])
    assert [(f.identifier, f.body) for f in found[: len(sent)]] == [(i, body) for i, body, _ in sent]


@pytest.mark.thorough
@settings(BUSY, max_examples=120)
@given(name=names, data=st.data())
def test_chunking_changes_nothing(name: str, data: st.DataObject) -> None:
    example = EXAMPLES[name]
    stream = data.draw(streams(example))
    chunks = cut(stream, data.draw(st.lists(st.integers(0, max(1, len(stream))), max_size=8)))
    assert outcome(example.framing, chunks) == outcome(example.framing, [stream])


@pytest.mark.thorough
@settings(BUSY, max_examples=20)
@given(name=names, data=st.data())
def test_a_trickle_of_single_bytes_gives_the_same(name: str, data: st.DataObject) -> None:
    example = EXAMPLES[name]
    stream = data.draw(streams(example))[:400]
    single = [stream[i : i + 1] for i in range(len(stream))]
    assert outcome(example.framing, single) == outcome(example.framing, [stream])


CHECKED = [
    name
    for name, example in EXAMPLES.items()
    if isinstance(example.framing, Packet | Delimited) and example.framing.checksum is not None and name != "no_sync"
]


@pytest.mark.thorough
@settings(BUSY, max_examples=80)
@given(name=st.sampled_from(CHECKED), data=st.data())
def test_whole_frames_behind_noise_are_found(name: str, data: st.DataObject) -> None:
    """All of them, in order; beyond them at most what the noise happens to hold."""
    example = EXAMPLES[name]
    framing = example.framing
    between = bytes([framing.stuffing.delimiter]) if isinstance(framing, Delimited) else b""
    stream, ends = b"", {}
    for _ in range(data.draw(st.integers(1, 4))):
        stream += data.draw(noise(example)) + between
        identifier, body, frame = data.draw(frames(example))
        stream += frame
        ends[len(stream)] = identifier, body
    found: list[Framed] = feed(framing.framer(), [stream, bytes(2 * framing.maximum_body + 64)])
    places = {f.end: (f.identifier, f.body) for f in found}
    missing = {end for end, frame in ends.items() if places.get(end) != frame}
    for end in missing:  # noise that goes on into a frame and is a good frame itself takes its place
        begin = end - len(framing.encode(*ends[end]))
        assert any(f.end > begin and f.end not in ends for f in found), (end, found)


def test_a_sync_pattern_within_a_body_is_harmless() -> None:
    framing = EXAMPLES["weiss_wts"].framing
    body = b"\xaa\xaa\xaa\x00\x04\x00" * 5 + b"\xaa\xaa"
    stream = b"".join(framing.encode(number, body) for number in range(60))
    for size in (7, 1000, len(stream)):
        framer = framing.framer()
        found = feed(framer, cut(stream, range(0, len(stream), size)))
        assert [f.identifier for f in found] == list(range(60))
        assert {f.body for f in found} == {body}
        assert framer.counters.checksum_errors == framer.counters.skipped_bytes == 0


def test_after_a_bad_checksum_the_search_goes_on_one_byte_behind_the_false_beginning() -> None:
    """A damaged length swallows good frames only until it is known to be damaged."""
    framing = EXAMPLES["weiss_wts"].framing
    frame = framing.encode(1, b"0123456789")
    damaged = frame[:4] + b"\x80" + frame[5:]  # 128 bytes for 10
    good = [framing.encode(number, bytes([number])) for number in range(30)]
    framer = framing.framer()
    found = feed(framer, [damaged, *good])
    assert [f.identifier for f in found] == list(range(30))
    assert framer.counters.checksum_errors == 1
    assert framer.counters.skipped_bytes == len(damaged)


def test_lengths_that_cannot_be_are_refused_at_once() -> None:
    framing = EXAMPLES["weiss_wts"].framing
    good = framing.encode(5, b"abc")
    found, counters, pending = outcome(framing, [b"\xaa\xaa\xaa\x00\xff\xff" + good])
    assert found == [Framed(5, b"abc", 6 + len(good))]
    assert (counters, pending) == ((6 + len(good), len(good), 0, 6, 1, 0, 1), 0)


@pytest.mark.thorough
@pytest.mark.parametrize("name", [name for name, e in EXAMPLES.items() if isinstance(e.framing, Packet)])
def test_no_length_leads_out_of_a_frame(name: str) -> None:
    """Every value of the smallest lengths, and of the largest."""
    example = EXAMPLES[name]
    framing, field = example.framing, None
    if isinstance(framing, Packet) and isinstance(framing.length, Length):
        field = framing.length.field
    elif isinstance(framing, Packet) and isinstance(framing.length, LengthTable):
        field = Field(framing.length.offset)
    good = framing.encode(example.identifiers[0], bytes(example.body_sizes()[0]))
    stream = good
    for says in (*range(24), *range(250, 256), (1 << 8 * field.size) - 1) if field else ():
        changed = bytearray(good.ljust(field.end if field else 0, b"\0"))
        if field:
            field.put(changed, says & field.mask)
        stream += bytes(changed) + good
    stream += bytes(2 * framing.maximum_body + 64)
    for size in (1, 7, len(stream)):
        assert outcome(framing, cut(stream, range(0, len(stream), size))) == outcome(framing, [stream])


def test_a_line_that_never_ends_is_not_kept() -> None:
    framing = EXAMPLES["lines"].framing
    framer_sees = [b"\n", b"x" * 1000, b"y" * 5000, b"z\nright\r\n"]
    found, counters, pending = outcome(framing, framer_sees)
    assert found == [Framed(0, b"right", 6010)]
    assert (counters, pending) == ((6010, 7, 0, 6003, 1, 0, 1), 0)


def test_half_a_line_before_the_first_end_of_line_is_no_line() -> None:
    framing = EXAMPLES["lines"].framing
    assert [f.body for f in feed(framing.framer(), [b"12,13\n14,15\n"])] == [b"14,15"]
    trusting = Delimited(framing.stuffing, maximum_body=120, trusts_first=True)  # type: ignore[attr-defined]
    assert [f.body for f in feed(trusting.framer(), [b"12,13\n14,15\n"])] == [b"12,13", b"14,15"]


def test_without_a_checksum_a_false_beginning_is_told_by_what_follows() -> None:
    """skintalk: 0x55 at the beginning of two frames in a row, or nothing."""
    framing = EXAMPLES["octocan"].framing
    stream = b"".join(framing.encode(number, b"\x01\x02\x03") for number in range(9))
    framer = framing.framer()
    assert [f.identifier for f in feed(framer, [b"\x01\x55\x09" + stream])] == list(range(9))
    assert (framer.counters.skipped_bytes, framer.counters.refused) == (3, 1)
