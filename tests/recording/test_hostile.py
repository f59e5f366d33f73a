"""Recordings whose checksums fit and whose contents are hostile: an error of ours, and little memory."""

from __future__ import annotations

import random
import resource
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard

import skinware.recording
from skinware import Namespace
from skinware.errors import BadRecording
from skinware.limits import LIMITS, Limits
from skinware.memory import file_layout
from skinware.recording.files import recover
from skinware.recording.mcap_reading import Damaged, McapSource
from skinware.recording.mcap_writing import McapFile, OpenChunk
from skinware.recording.replaying import Replayer
from skinware.recording.topics import CLOCK, EVENTS, FRAME, GENERATION, Channels
from tests.recording.hostile import Forger, use
from tests.recording.made import generation_of_service
from tests.recording.rig import two_drivers_and_a_service

FORGERIES = 150
START_NS = 10**18


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "hostile.mcap"


def head(slot_bytes: int, *, slots: int = 2, period_ns: int = 10_000_000) -> bytes:
    """A service's file up to its slots, with one column of so many bytes."""
    made = bytearray(generation_of_service("big", {"x": ("u1", (64,))}).head)
    header = np.frombuffer(made, file_layout.HEADER, 1)
    stride = file_layout.aligned(file_layout.SLOT.itemsize + slot_bytes)
    header["slot_stride"], header["slot_count"], header["period_ns"] = stride, slots, period_ns
    header["file_size"] = file_layout.aligned(int(header["slot_offset"][0]) + stride * slots, 4096)
    columns = np.frombuffer(made, file_layout.COLUMN, int(header["column_count"][0]), file_layout.COLUMN_OFFSET)
    columns["count"][columns["name"] == b"x"] = slot_bytes
    return bytes(made)


def frame(generation: int, sequence: int, *, time_ns: int = 10**15) -> bytes:
    """A frame of such a service that is all zero."""
    return struct.pack("<QQqqQQ", generation, sequence, time_ns, time_ns, 0, 0) + bytes(5)


def write(path: Path, messages: list[tuple[str, str, bytes]]) -> None:
    """A recording of (service, what, data); of events and clocks the service is empty."""
    file, channels, chunk = McapFile(path), Channels(), OpenChunk()
    for number, (service, what, data) in enumerate(messages):
        channel, schema = channels.of_service(service, what) if service else channels.of_all(what)
        chunk.add(channel, schema, number, START_NS + number, data)
    file.add(chunk.close())
    file.finish()


def of_frames(path: Path, made: bytes, n: int = 3, service: str = "big", time_ns: int = 10**15) -> None:
    """A recording with frames of a generation."""
    number = int(np.frombuffer(made, file_layout.HEADER, 1)["generation"][0])
    frames = [(service, FRAME, frame(number, each + 1, time_ns=time_ns)) for each in range(n)]
    write(path, [(service, GENERATION, made), *frames])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"[" * 100_000, "nested deeper than 32"),
        (b'{"event":"missed","count":"x"}', "Expected `int`"),
        (b'{"event":"missed","count":1e400}', "out of range"),
        (b'{"event":"missed","count":-1}', ">= 0"),
        (b'{"event":"missed","count":NaN}', "malformed"),
        (b'{"event":"missed","time_ns":9223372036854775807}', "<= 46116"),
        (b"[]", "Expected `object`"),
    ],
)
def test_events_that_cannot_be_read_are_left_out_and_said(path: Path, text: bytes, says: str) -> None:
    good = b'{"event":"missed","count":2,"service":"big"}'
    write(path, [("big", GENERATION, head(64)), ("big", FRAME, frame(1, 1)), ("", EVENTS, good), ("", EVENTS, text)])
    with skinware.recording.open(path) as opened:
        assert opened.missed == 2
        assert [event["event"] for event in opened.events] == ["missed"]
        assert [problem for problem in opened.problems if "/skin/events" in problem and says in problem]
        list(opened.moments())


@pytest.mark.parametrize(
    ("made", "says"),
    [
        ({"slot_bytes": 1 << 30}, "frames of 1073741888 bytes; at most 33554432 are read"),
        ({"slot_bytes": 64, "period_ns": 1}, "a period of 1 ns"),
        ({"slot_bytes": 64, "period_ns": -5}, "a period of -5 ns"),
    ],
)
def test_generations_that_ask_for_too_much_are_left_out_and_said(
    path: Path, namespace: Namespace, made: dict[str, int], says: str
) -> None:
    del namespace
    of_frames(path, head(**made), 2000)
    with skinware.recording.open(path) as opened:
        assert list(opened["big"].samples()) == []
        assert [problem for problem in opened.problems if says in problem]


@pytest.mark.thorough
def test_frames_of_a_chunk_that_become_too_much_are_left_out_and_said(path: Path) -> None:
    of_frames(path, head(30 << 20), 5)
    with skinware.recording.open(path) as opened:
        assert sum(1 for _ in opened["big"].samples()) == LIMITS.frames_size // (30 << 20) == 4
        assert "become more than" in opened.problems[0]


@pytest.mark.parametrize("time_ns", [-(1 << 63), -1, 1 << 62, (1 << 63) - 1])
def test_times_beyond_what_clocks_have_are_left_out_and_said(path: Path, time_ns: int) -> None:
    of_frames(path, head(64), time_ns=time_ns)
    with skinware.recording.open(path) as opened:
        assert list(opened.moments()) == []
        assert opened.problems == ["big: a frame has a time that no clock has"]


@pytest.mark.parametrize("time_ns", [-(1 << 63), (1 << 63) - 1])
def test_a_wire_of_a_time_beyond_what_clocks_have(path: Path, time_ns: int) -> None:
    file, channels, chunk = McapFile(path), Channels(), OpenChunk()
    chunk.add(*channels.of_service("big", GENERATION), 1, START_NS, head(64))
    chunk.add(*channels.of_wire("tip", "can0"), 1, START_NS, struct.pack("<QQqQ", 1, 1, time_ns, 0))
    file.add(chunk.close())
    file.finish()
    with skinware.recording.open(path) as opened:
        (wire,) = opened.wires
        assert len(wire.frames()) == 0
        assert opened.problems == ["wire of can0: a message has a time that no clock has"]


def test_a_message_of_a_time_beyond_63_bits_costs_its_chunk(path: Path) -> None:
    file, channels = McapFile(path), Channels()
    for time_ns in (START_NS, (1 << 64) - 1):
        chunk = OpenChunk()
        chunk.add(*channels.of_all(CLOCK), 1, time_ns, b'{"monotonic_ns":1}')
        file.add(chunk.close())
    file.finish()
    with skinware.recording.open(path) as opened:
        assert len(opened.clock) == 1
        assert opened.duration_s == 0
        assert opened.problems == ["1 chunk damaged and left out"]


@pytest.mark.parametrize("service", ["\x1b[2Jx", "<img src=x>", "x" * 300])
def test_names_that_no_service_can_have(path: Path, service: str) -> None:
    of_frames(path, head(64), service=service)
    with skinware.recording.open(path) as opened:
        assert opened.services == ()
        assert "no service can have this name" in opened.problems[0]
        assert "\x1b" not in opened.problems[0]


def test_a_name_with_a_path_in_it_is_no_service(path: Path) -> None:
    of_frames(path, head(64), service="../../x")
    with pytest.raises(BadRecording, match="not a recording of a skin"):
        skinware.recording.open(path)


def test_a_ring_that_is_too_large_is_not_replayed(path: Path, namespace: Namespace) -> None:
    of_frames(path, head(30 << 20, slots=64), 1)
    with skinware.recording.open(path) as opened, pytest.raises(BadRecording, match="needs a ring of"):
        Replayer(opened, namespace=namespace)


def test_a_chunk_that_claims_too_much_is_named(path: Path) -> None:
    file, channels = McapFile(path), Channels()
    for size in (100, 200_000):
        chunk = OpenChunk()
        chunk.add(*channels.of_all(CLOCK), 1, START_NS, b'{"a":"' + b"a" * size + b'"}')
        file.add(chunk.close())
    file.finish()
    with McapSource(path, Limits(chunk_size=100_000)) as source:
        assert (len(source.chunks), source.damaged) == (1, 1)
        assert source.refused[0].endswith("bytes; at most 100000 are read")
    with McapSource(path, Limits(always_size=150_000, ratio=1)) as source:  # all of them together
        assert (len(source.chunks), source.damaged) == (1, 1)


@pytest.mark.thorough
def test_a_chunk_that_becomes_more_than_it_claims_costs_no_memory(path: Path) -> None:
    bomb = zstandard.compress(bytes(1 << 30))
    file, channels = McapFile(path), Channels()
    chunk = OpenChunk()
    chunk.add(*channels.of_all(CLOCK), 1, START_NS, b"{}")
    closed = chunk.close()
    file.add(closed)
    file.finish()
    with McapSource(path) as source:
        (place,) = source.chunks
        data = bytearray(path.read_bytes())
        path.write_bytes(data[: place.compressed_at] + bomb)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with McapSource(path) as source, pytest.raises(Damaged, match="not as large as it says"):
        source.contents(
            type(place)(place.offset, 0, 0, place.size, place.compressed_at, len(bomb), zlib.crc32(b""), None)
        )
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 19  # kB


def test_reading_whole_columns_is_bounded_by_the_size_of_the_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    of_frames(path, head(1 << 20), 3)
    monkeypatch.setattr("skinware.recording.tracks.LIMITS", Limits(always_size=1 << 21, ratio=1))
    with skinware.recording.open(path) as opened:
        with pytest.raises(BadRecording, match="read fewer columns"):
            opened["big"].read()
        assert len(opened["big"].read([])) == 3


@pytest.mark.thorough
def test_forged_contents_are_an_error_of_ours(tmp_path: Path, made: dict[str, bytes]) -> None:
    original, forged = tmp_path / "original.mcap", tmp_path / "forged.mcap"
    if not made:
        two_drivers_and_a_service(original)
        made["skin"] = original.read_bytes()
    original.write_bytes(made["skin"])
    forger, generator = Forger(original), random.Random(5)
    found = 0
    for _ in range(FORGERIES):
        forger.forge(generator, forged)
        problems = use(forged, tmp_path / "recovered.mcap")
        assert not any("\n" in problem or "\x1b" in problem for problem in problems)
        found += bool(problems)
    assert found > FORGERIES // 4


def test_what_is_refused_is_no_part_of_a_recovered_file(path: Path, tmp_path: Path) -> None:
    file, channels = McapFile(path), Channels()
    for size in (100, LIMITS.chunk_size):
        chunk = OpenChunk()
        chunk.add(*channels.of_all(CLOCK), 1, START_NS, b'{"boot":"' + b"a" * size + b'"}')
        file.add(chunk.close())
    file.finish()
    recovered = recover(path, tmp_path / "recovered.mcap")
    assert (recovered.messages, recovered.damaged, recovered.was_whole) == ({"/skin/clock": 1}, 1, False)
