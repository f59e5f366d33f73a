"""Frames without a checksum whose values look like the mark between them, frame after frame: none is shown shifted."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from skinware_drivers.serial.anyskin import AnySkinDriver, AnySkinOptions
from skinware_drivers.serial.contactile import Dev001Driver, Dev001Options
from skinware_drivers.serial.framing import Framing
from skinware_drivers.serial.packets import Packet
from skinware_drivers.serial.robotiq_tsf import RobotiqPackets
from skinware_drivers.serial.skintalk import SkintalkDriver
from skinware_drivers.serial.tactile_glove import TactileGloveDriver
from tests.serial.streams import cut, outcome

FLEXITAC = Packet(sync=b"\xaa\x55", length=258, confirmed="each")
DEV001 = Dev001Driver(Dev001Options()).framing
RECORD = bytes.fromhex("200e0000")
UNDAMAGED, FRAMES, MOST_DAMAGED = 4, 120, 12
FRAMERS: dict[str, tuple[Framing, bytes, int, bytes, bytes]] = {
    "flexitac": (FLEXITAC, b"\xaa\x55", 256, b"", b"\xaa\x55"),
    "anyskin": (AnySkinDriver(AnySkinOptions()).framing, b"", 80, b"\r\n", b"\r\n"),
    "skintalk": (SkintalkDriver.framing, b"\x55", 4, b"", b"\x55"),
    "dev001": (DEV001, struct.pack("<II", 3, 7) + RECORD, 16, b"", struct.pack("<II", 1, 9) + RECORD),
}
"""Name: the framing; of a frame the bytes before the values, their number, the bytes behind; values that look so."""

STRICT = ("flexitac", "dev001")
"""The others can take a damaged frame with the beginning of the next for one, but not frame after frame."""


def frames_of(name: str, at: int, rng: np.random.Generator) -> list[bytes]:
    _, head, count, tail, mark = FRAMERS[name]
    frames = []
    for _ in range(FRAMES):
        values = bytearray(rng.integers(0, 256, count, np.uint8).tobytes())
        values[at : at + len(mark)] = mark
        frames.append(head + values + tail)
    return frames


def lose(frame: bytes, rng: np.random.Generator) -> bytes:
    at, count = int(rng.integers(len(frame))), int(rng.integers(1, 20))
    return frame[:at] + frame[at + count :]


def double(frame: bytes, rng: np.random.Generator) -> bytes:
    at, count = int(rng.integers(len(frame))), int(rng.integers(1, 20))
    return frame[: at + count] + frame[at:]


def restart(frame: bytes, rng: np.random.Generator) -> bytes:
    return frame[: int(rng.integers(len(frame)))]


DAMAGES = (lose, double, restart)


def damaged(
    frames: Sequence[bytes], damages: Sequence[Callable[[bytes, np.random.Generator], bytes]], rng: np.random.Generator
) -> bytes:
    """Some of the frames damaged, but not the first, and not those of the last tenth."""
    places = {at for at in range(UNDAMAGED, len(frames) * 9 // 10) if rng.random() < 0.04}
    stream = list(frames)
    for at in places:
        stream[at] = damages[int(rng.integers(len(damages)))](frames[at], rng)
    return b"".join(stream)


def shown(framing: Framing, stream: bytes, rng: np.random.Generator) -> list[bytes]:
    """Return the bodies that C and its specification find, however the stream is cut."""
    found, _, _ = outcome(framing, cut(stream, rng.integers(0, len(stream), 30).tolist()))
    return [frame.body for frame in found]


@pytest.mark.parametrize("name", FRAMERS)
@pytest.mark.parametrize("seed", range(3))
def test_no_frame_is_shown_shifted(name: str, seed: int) -> None:
    framing, head, count, tail, mark = FRAMERS[name]
    rng = np.random.default_rng([seed, count])
    at = int(rng.integers(count - len(mark) + 1))
    if 2 * (at + len(head or tail)) == len(head) + count + len(tail):  # nothing distinguishes a half from the other
        at -= 1
    frames = frames_of(name, at, rng)
    sent = set(shown(framing, b"".join(frames), rng))
    assert len(sent) >= FRAMES - 1
    found = shown(framing, damaged(frames, DAMAGES, rng), rng)
    shifted = [body for body in found if body not in sent]
    assert len(shifted) <= (0 if name in STRICT else MOST_DAMAGED)
    assert len(found) > FRAMES // 2
    assert found[-1] in list(sent)


def test_a_damaged_mark_costs_the_frames_on_both_sides_and_no_other() -> None:
    rng = np.random.default_rng(1)
    frames = frames_of("flexitac", 100, rng)
    stream = bytearray(b"".join(frames))
    for number in (20, 40, 60):
        stream[number * 258] ^= 0x10
    found = shown(FLEXITAC, bytes(stream), rng)
    lost = {19, 20, 39, 40, 59, 60, FRAMES - 1}
    assert found == [frame[2:] for number, frame in enumerate(frames) if number not in lost]


def test_the_step_changes_at_once_when_the_false_mark_goes() -> None:
    """Joined halfway, the false mark is found first: nothing distinguishes it before it changes."""
    rng = np.random.default_rng(2)
    frames = frames_of("flexitac", 100, rng)
    frames[60:] = [frame[:102] + b"\1" + frame[103:] for frame in frames[60:]]
    found = shown(FLEXITAC, b"".join(frames)[50:], rng)
    bodies = [frame[2:] for frame in frames]
    assert not set(found[:59]) & set(bodies)
    assert found[-58:] == bodies[-59:-1]


def test_a_mark_that_stays_for_a_while_is_outvoted() -> None:
    rng = np.random.default_rng(3)
    frames = [b"\xaa\x55" + rng.integers(0, 256, 256, np.uint8).tobytes() for _ in range(12)]
    frames[:2] = [frame[:102] + b"\xaa\x55" + frame[104:] for frame in frames[:2]]
    assert shown(FLEXITAC, b"".join(frames)[50:], rng) == [frame[2:] for frame in frames[1:-1]]


def test_the_gloves_frame_cannot_be_seen_shifted() -> None:
    """Its mark is a number, 01 and, three bytes later, 00: no offset has all of them, whatever the values."""
    rng = np.random.default_rng(4)
    for value in (0x3C01, 0x013C, 0x4000, 0x0100, 0x3C3C, 0x0101):
        frames = [bytes((0x3C + n % 64, 1, *value.to_bytes(2), 0)) for n in range(FRAMES)]
        stream = damaged(frames, (lose, restart), rng)
        for body in shown(TactileGloveDriver.framing, stream, rng):
            assert body == value.to_bytes(2)


def test_a_packet_of_a_tsf_is_known_by_its_fields() -> None:
    rng = np.random.default_rng(5)
    head = b"\x9a\0\x61\x39"
    frames = []
    for _ in range(FRAMES):
        values = bytearray(rng.integers(0, 256, 56, np.uint8).tobytes())
        values[20:24] = head
        frames.append(head + b"\x10" + values)
    sent = {bytes(4) + frame[5:] for frame in frames}
    found = shown(RobotiqPackets(), damaged(frames, DAMAGES, rng), rng)
    assert len(found) > FRAMES // 2
    assert len([body for body in found if body not in sent]) <= MOST_DAMAGED
