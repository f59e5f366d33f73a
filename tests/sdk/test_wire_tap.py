"""What a bus keeps of its wire while somebody wants it, and how it is read."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest

from skinware.wire import BATCH_BYTES, BYTES, CLASSIC, FD, IS_CUT, IS_FD, PIECE, Piece, read_pieces, size_of
from skinware_drivers.bus import EXTENDED_FLAG, wire_dtype
from skinware_drivers.wire_tap import WireTap

Frames = list[tuple[bool, int, int, int, bytes]]
"""is_sent, time, identifier, flags, payload."""


def pieces_of(tap: WireTap) -> list[Piece]:
    found = []
    for batch in tap.fetch():
        assert 0 < len(batch) <= BATCH_BYTES
        pieces, is_whole = read_pieces(bytes(batch))
        assert is_whole
        found += pieces
    return found


def frames_of(tap: WireTap) -> Frames:
    return [
        (piece.is_sent, int(time_ns), int(row["identifier"]), int(row["flags"]), bytes(row["payload"][: row["length"]]))
        for piece in pieces_of(tap)
        if piece.frames is not None
        for time_ns, row in zip(piece.time_ns, piece.frames, strict=True)
    ]


@pytest.fixture
def tap() -> WireTap:
    tap = WireTap()
    tap.open()
    return tap


def test_nothing_is_kept_while_it_is_closed() -> None:
    tap = WireTap()
    tap.keep_frame(1, 0x123, b"abc")
    tap.keep_bytes(1, b"abc")
    tap.keep_rows(np.zeros(3, wire_dtype(8)), np.zeros(3, np.int64))
    assert (tap.address, tap.missed, list(tap.fetch())) == (0, 0, [])
    tap.open()
    tap.keep_bytes(1, b"abc")
    tap.close()
    tap.open()
    assert list(tap.fetch()) == []


def test_frames_and_bytes_come_back_in_order(tap: WireTap) -> None:
    tap.keep_frame(5, EXTENDED_FLAG | 0x18DA00F1, b"\1\2", is_sent=True)
    tap.keep_bytes(6, b"hello")
    tap.keep_frame(7, 0x7FF, bytes(range(12)), flags=1)
    tap.keep_bytes(8, b"you", is_sent=True)
    first, second, third, fourth = pieces_of(tap)
    assert (first.is_sent, first.time_ns.tolist(), first.data) == (True, [5], b"")
    assert (second.is_sent, second.time_ns.tolist(), second.frames, second.data) == (False, [6], None, b"hello")
    assert third.frames is not None
    assert third.frames["flags"].tolist() == [1 | IS_FD]
    assert third.frames["payload"][0][:13].tolist() == [*range(12), 0]
    assert (fourth.is_sent, fourth.data) == (True, b"you")
    assert pieces_of(tap) == []


@pytest.mark.parametrize("payload_size", [8, 16, 64])
def test_rows_of_a_batch_are_kept_without_what_was_there_before(tap: WireTap, payload_size: int) -> None:
    wire = np.zeros(150, wire_dtype(payload_size))
    wire["payload"] = 0xEE
    wire["identifier"], wire["length"] = np.arange(150), np.arange(150) % (payload_size + 3)
    wire["flags"][wire["length"] > 8] = IS_FD
    tap.keep_rows(wire, np.arange(150) + 1000)
    found = frames_of(tap)
    assert [frame[1:3] for frame in found] == [(1000 + number, number) for number in range(150)]
    for number, (_, _, _, flags, payload) in enumerate(found):
        length = number % (payload_size + 3)
        assert payload == b"\xee" * min(length, payload_size)
        assert flags == (IS_FD if length > 8 else 0) | (IS_CUT if length > payload_size else 0)


def test_what_has_no_room_is_counted_and_the_rest_goes_on(tap: WireTap) -> None:
    chunk = bytes(100_000)
    for _ in range(11):
        tap.keep_bytes(1, chunk)
    kept = sum(len(piece.data) for piece in pieces_of(tap))
    assert kept + tap.missed == 1_100_000
    assert kept > 1_000_000
    tap.keep_bytes(2, b"more")
    assert [piece.data for piece in pieces_of(tap)] == [b"more"]


def test_frames_that_are_no_can_frames_are_not_kept(tap: WireTap) -> None:
    tap.keep_rows(np.zeros(3, wire_dtype(128)), np.zeros(3, np.int64))
    tap.keep_frame(1, 0, bytes(65))
    assert pieces_of(tap) == []


@pytest.mark.parametrize("damage", [lambda d: d[:-1], lambda d: b"\xff" * 16 + d, lambda d: d + b"\0" * 15])
def test_damaged_pieces_are_told_and_never_raise(tap: WireTap, damage: Callable[[bytes], bytes]) -> None:
    tap.keep_frame(1, 0x123, b"abc")
    tap.keep_bytes(2, b"abc")
    (data,) = (bytes(batch) for batch in tap.fetch())
    pieces, is_whole = read_pieces(damage(data))
    assert not is_whole
    assert len(pieces) <= 2


def test_any_bytes_are_read_without_an_error() -> None:
    generator = np.random.default_rng(7)
    for _ in range(300):
        data = bytearray(generator.bytes(int(generator.integers(0, 400))))
        if len(data) >= PIECE.itemsize:
            data[8] = generator.integers(0, 5)
            count = int(generator.integers(0, 8))
            data[4:8] = struct.pack("<I", count)
            if data[8] in (CLASSIC, FD, BYTES):
                data[:4] = struct.pack("<I", size_of(data[8], count))
        pieces, _ = read_pieces(bytes(data))
        assert all(piece.frames is None or len(piece.frames) == len(piece.time_ns) for piece in pieces)
