"""What others send is read within limits."""

from __future__ import annotations

import zlib
from typing import Any

import msgspec
import pytest

from skinware.limits import LIMITS, Limits, read_json, unpack


class Event(msgspec.Struct):
    event: str
    count: int = 0


def test_reads_json_of_a_type() -> None:
    assert read_json(b'{"event": "missed", "count": 2}', Event) == Event("missed", 2)
    assert read_json(memoryview(b'[1, {"a": "[[["}]'), list[Any]) == [1, {"a": "[[["}]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"[" * 100_000, "nested deeper than 32"),
        (b'{"a":' * 33 + b"1" + b"}" * 33, "nested deeper than 32"),
        (b'"' + b"a" * LIMITS.json_size + b'"', "at most 1048576"),
        (b'{"event": "missed", "count": "x"}', "Expected `int`"),
        (b'{"event": "missed", "count": 1e400}', "out of range"),
        (b'{"event": "missed", "count": NaN}', "malformed"),
        (b'{"event": "\xff"}', "(?i)utf-8"),
        (b"", "truncated"),
    ],
)
def test_refuses_json(text: bytes, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        read_json(text, Event)


def test_brackets_in_strings_are_no_depth() -> None:
    text = b'["' + b"[" * 1000 + b'\\"' + b"{" * 1000 + b'"]'
    assert len(read_json(text, list[Any])) == 1
    beside = b"[" + b",".join([b"[]"] * 1000) + b"]"
    assert len(read_json(beside, list[Any])) == 1000


def test_unpacks_as_much_as_is_allowed() -> None:
    packed = zlib.compress(bytes(1000))
    assert unpack(packed, 1000) == bytes(1000)
    with pytest.raises(ValueError, match="more than 999 bytes"):
        unpack(packed, 999)
    with pytest.raises(ValueError, match="too early"):
        unpack(packed[:-5], 1000)
    with pytest.raises(ValueError, match="cannot be decompressed"):
        unpack(b"no zlib", 1000)


def test_room_is_by_ratio_from_a_size_on() -> None:
    limits = Limits(ratio=10, always_size=100)
    assert [limits.room(size) for size in (0, 10, 11)] == [100, 100, 110]


def test_times_of_others_can_be_added() -> None:
    assert LIMITS.is_time(0)
    assert LIMITS.is_time(-LIMITS.time_ns)
    for other in (1 << 62, -(1 << 63), 1.0, "1", True, None):
        assert not LIMITS.is_time(other)
