"""Recordings damaged at random, and what must still be read of them. tools/fuzz runs it for longer."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import skinware.recording
from skinware.errors import BadRecording, SkinwareError
from skinware.recording.mcap_reading import McapSource
from skinware.recording.topics import FRAME, service_of, wire_of
from skinware.wire import Piece, read_pieces
from tests.recording.rig import contents_of

WIRE_HEADER_BYTES = 32

Frames = dict[tuple[str, int, int], dict[str, bytes]]
"""Contents of frames by service, generation and sequence."""
OnWire = tuple[str, str, bool, int, bytes]
"""A frame, or bytes: (driver, bus, is_sent, CLOCK_MONOTONIC ns, it)."""


def damaged(data: bytes, generator: random.Random) -> tuple[bytes, list[range]]:
    """The same bytes with a little damage, and which of the old ones are gone or changed."""
    out, gone = bytearray(data), []
    for _ in range(generator.randint(1, 4)):
        at, count = generator.randrange(len(out)), int(2 ** generator.uniform(0, 10))
        match generator.choice(("bits", "noise", "zeros", "cut")):
            case "bits":
                out[at] ^= 1 << generator.randrange(8)
                gone.append(range(at, at + 1))
            case "noise":
                out[at : at + count] = generator.randbytes(len(out[at : at + count]))
                gone.append(range(at, at + count))
            case "zeros":
                out[at : at + count] = bytes(len(out[at : at + count]))
                gone.append(range(at, at + count))
            case "cut":
                gone.append(range(at, len(data)))
                del out[at:]
                if not out:
                    break
    if generator.random() < 0.2 and out:  # bytes that are missing move all that follow
        at, count = generator.randrange(len(out)), generator.randint(1, 300)
        gone.append(range(at, at + count))
        del out[at : at + count]
    return bytes(out), gone


def with_a_bad_chunk(file: Path) -> bytes:
    """A recording in which one bit of a chunk with frames is wrong."""
    data = bytearray(file.read_bytes())
    with McapSource(file) as source:
        place = source.chunks[len(source.chunks) // 2]
    data[place.compressed_at + place.compressed_size // 2] ^= 1
    return bytes(data)


def frames_of(file: Path) -> Frames:
    """All that can be read, frame by frame and as columns, which must be the same."""
    found: Frames = {}
    with skinware.recording.open(file) as opened:
        for name in opened.services:
            for frame in opened[name].samples():
                found[name, frame.generation, frame.sequence] = contents_of(frame)
            for part in opened[name].parts:
                series = part.read()
                assert all(
                    found[name, int(generation), int(sequence)]["times"][8:16] == published.tobytes()
                    for generation, sequence, published in zip(
                        series.generation, series.sequence, series.published_ns, strict=True
                    )
                )
        assert sum(1 for _ in opened.snapshots()) <= len(found)
        assert all("\n" not in problem for problem in opened.problems)
    return found


def on_wires(file: Path) -> set[OnWire]:
    """All that can be read of what went over wires."""
    with skinware.recording.open(file) as opened:
        return {
            found
            for wire in opened.wires
            for piece in wire.pieces()
            for found in _parts(wire.driver, wire.bus, Piece(piece.is_sent, piece.time_ns, piece.frames, piece.data))
        }


def _parts(driver: str, bus: str, piece: Piece) -> Iterator[OnWire]:
    rows = [piece.data] if piece.frames is None else [row.tobytes() for row in piece.frames]
    for time_ns, row in zip(piece.time_ns.tolist(), rows, strict=True):
        yield driver, bus, piece.is_sent, time_ns, row


class Original:
    """A recording before it is damaged, with what is in which of its chunks.

    Args:
        file: it.
    """

    def __init__(self, file: Path) -> None:
        self.data = file.read_bytes()
        self.frames = frames_of(file)
        self.on_wires = on_wires(file)
        self._chunks: list[tuple[range, set[tuple[str, int]], set[str]]] = []
        self._wire_chunks: list[tuple[range, set[OnWire]]] = []
        with McapSource(file) as source:
            for place in source.chunks:
                frames, heads, wires = set(), set(), set()
                for message in source.contents(place).messages:
                    channel = source.channels[message.channel_id]
                    found, wire = service_of(channel), wire_of(channel)
                    if wire is not None:
                        pieces, _ = read_pieces(message.data[WIRE_HEADER_BYTES:])
                        wires |= {part for piece in pieces for part in _parts(*wire, piece)}
                    if found is not None and found[1] == FRAME:
                        frames.add((found[0], message.sequence))
                    elif found is not None:
                        heads.add(found[0])
                self._chunks.append((range(place.offset, place.end), frames, heads))
                self._wire_chunks.append((range(place.offset, place.end), wires))

    def expected(self, gone: list[range]) -> set[tuple[str, int]]:
        """(service, sequence) of the frames whose chunk is undamaged, if their generation is told in another such."""
        whole = [(frames, heads) for place, frames, heads in self._chunks if not _touched(place, gone)]
        told = {name for _, heads in whole for name in heads}
        return {frame for frames, _ in whole for frame in frames if frame[0] in told}

    def check(self, generator: random.Random, file: Path) -> int:
        """Damage it and look; how many frames were read."""
        data, gone = damaged(self.data, generator)
        file.write_bytes(data)
        refused = ""
        try:
            found = frames_of(file)
        except BadRecording as error:
            found, refused = {}, str(error)
        assert "\n" not in refused
        assert all(self.frames[position] == contents for position, contents in found.items())
        missing = self.expected(gone) - {(name, sequence) for name, _, sequence in found}
        assert not missing, f"{len(missing)} frames of undamaged chunks: {refused}"
        if self.on_wires:
            on_wire = set() if refused else on_wires(file)
            assert on_wire <= self.on_wires
            whole = {part for place, parts in self._wire_chunks if not _touched(place, gone) for part in parts}
            assert whole <= on_wire, f"{len(whole - on_wire)} of a wire in undamaged chunks: {refused}"
        return len(found)


def _touched(place: range, gone: list[range]) -> bool:
    """Whether any of some damage is in a chunk."""
    return any(part.start < place.stop and place.start < part.stop for part in gone)


def recover_too(file: Path, target: Path) -> Frames:
    """What is in a damaged file after it was made whole; nothing if that is not possible."""
    from skinware.recording.files import recover

    try:
        recover(file, target)
    except SkinwareError:
        return {}
    return frames_of(target)
