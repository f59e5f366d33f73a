"""The vectors of the open patch protocol: openpatch.h makes them, the driver's framing reads and makes them."""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from skinware_drivers.serial.openpatch import OpenPatchDriver
from tests.openpatch import wire
from tests.openpatch.microcontroller import HERE, program

VECTORS = Path(__file__).parents[2] / "docs/protocols/patch-serial-vectors.txt"
LANGUAGES = ("c99", "c++11", "sanitized")
SAID = wire.Said(modules=[(0, 1), (0, 1)])  # as the header says it: each by itself


def vectors() -> list[tuple[str, str]]:
    """(word, rest) of every line."""
    lines = (line.partition(" ") for line in VECTORS.read_text().splitlines())
    return [(word, rest.strip()) for word, _, rest in lines]


def frames(word: str) -> list[bytes]:
    return [bytes.fromhex(rest) for kind, rest in vectors() if kind == word]


def run(firmware: Path, commands: Sequence[str]) -> list[bytes]:
    """What the patch says to each command."""
    text = "".join(f"{command}\n" for command in commands)
    done = subprocess.run([str(firmware)], input=text, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    said = [bytes.fromhex(line) for line in done.stdout.splitlines()]
    assert len(said) == len(commands)
    return said


@pytest.mark.thorough
@pytest.mark.parametrize("language", LANGUAGES)
def test_the_header_says_what_the_vectors_say(language: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    firmware = program(HERE / "vectors.c", language, tmp_path_factory)
    commands: list[str] = []
    expected: list[bytes] = []
    for word, rest in vectors():
        if word == "patch":
            expected[-1] += bytes.fromhex(rest)
            continue
        commands.append({"clock": "time", "host": "receive", "send": "send"}[word] + " " + rest)
        expected.append(b"")
    assert run(firmware, commands) == expected


def test_the_drivers_framing_reads_and_makes_every_vector() -> None:
    host, patch = frames("host"), frames("patch")
    assert (len(host), len(patch)) == (18, 24)
    for side in (host, patch):
        framer = OpenPatchDriver.framing.framer()
        found = framer.feed(b"".join(side))
        again = [OpenPatchDriver.framing.encode(frame.identifier, frame.body) for frame in found]
        assert again == side
        assert framer.counters.skipped_bytes == 0


def test_the_vectors_are_what_the_text_says() -> None:
    """Some of them, put together again from the fields of the tables."""
    items = SAID.items()
    crc = wire.crc32(b"".join(items))
    assert wire.crc32(b"123456789") == 0xCBF43926
    host, patch = frames("host"), frames("patch")
    assert host[0] == wire.frame(1, bytes((1, 1, 0)))
    assert patch[0] == wire.frame(0x60, wire.greeting(items, reset=1))
    assert patch[2:7] == [wire.frame(0x42, struct.pack("<BBH", 2 + n, 0, n) + item) for n, item in enumerate(items)]
    assert wire.frame(3, struct.pack("<BI", 15, crc)) in host
    assert wire.frame(0x80, struct.pack("<BHIB4H", 0, 0, 500_000, 0, 1, 0, 0xFFFF, 300)) in patch
    assert wire.frame(0x80, struct.pack("<BHIB4H4B", 0, 1, 500_000, 0, 1, 0, 0xFFFF, 300, 0, 0, 8, 0)) in patch
    assert wire.frame(0x80, struct.pack("<BHIB4H", 1, 0, 500_000, 32, 0x101, 0, 0xFFFF, 300)) in patch
    assert wire.frame(0x61, struct.pack("<IIII", 1500, 4, 0, 0)) in patch


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return program(HERE / "vectors.c", "sanitized", tmp_path_factory)


def request(message_type: int, *payload: int) -> str:
    return "receive " + wire.frame(message_type, bytes(payload)).hex()


def start() -> str:
    return request(3, 1, *struct.pack("<I", wire.crc32(b"".join(SAID.items()))))


def test_damaged_requests_are_counted_and_the_next_is_answered(firmware: Path) -> None:
    good = wire.frame(1, bytes((9, 1, 0)))
    flipped = bytes((*good[:3], good[3] ^ 0x10, *good[4:]))
    lost = good[:4] + good[5:]
    torn = good[:6]
    long = wire.frame(1, bytes(range(100)))
    said = run(
        firmware,
        [
            "poll",
            *(f"receive {damaged.hex()}" for damaged in (flipped, lost, b"\x05\x06\x00", long, torn + good)),
            "receive 000000",
            request(8, 2),
        ],
    )
    answer = wire.frame(0x48, struct.pack("<BBIIII", 2, 0, 0, 0, 0, 5))
    assert said[1:] == [b""] * 6 + [answer]


def test_what_only_a_patch_says_is_not_answered(firmware: Path) -> None:
    echo = [f"receive {vector.hex()}" for vector in frames("patch") if len(vector) <= 24]
    said = run(firmware, ["poll", *echo, request(0x20, 1), request(0, 1), request(0x1F, 7)])
    assert said[1:] == [b""] * (len(echo) + 2) + [wire.frame(0x5F, bytes((7, 1)))]


def test_boot_is_announced_until_somebody_answers(firmware: Path) -> None:
    items = SAID.items()
    said = run(firmware, ["poll", "time 999999", "time 1000000", request(4, 1), "time 2000000", "time 3000000"])
    assert said[:3] == [
        wire.frame(0x60, wire.greeting(items, reset=1)),
        b"",
        wire.frame(0x60, wire.greeting(items, reset=1, uptime_ms=1000)),
    ]
    assert said[3:] == [wire.frame(0x44, bytes((1, 0))), b"", b""]


def test_a_message_without_room_is_dropped_whole_and_counted(firmware: Path) -> None:
    said = run(firmware, ["poll", start(), "room 20", "send 0 0", "room 4096", "send 0 0", request(8, 2)])
    assert said[3] == b""
    assert said[5] == wire.frame(0x80, struct.pack("<BHIB4H", 0, 1, 0, 0, 1, 0, 0xFFFF, 300))
    assert said[6] == wire.frame(0x48, struct.pack("<BBIIII", 2, 0, 0, 1, 1, 0))


def test_a_module_that_is_off_says_so_once_in_every_stream(firmware: Path) -> None:
    off, on, stop = request(6, 2, 1, 0), request(6, 3, 0xFF, 1), request(4, 4)
    said = run(
        firmware, ["poll", off, start(), *["send 1 8"] * 2, stop, "send 1 0", start(), "send 1 0", on, "send 1 8"]
    )

    def sample(sequence: int, status: int) -> bytes:
        return wire.frame(0x80, struct.pack("<BHIB4H", 1, sequence, 0, status, 0x101, 0, 0xFFFF, 300))

    assert [said[n] for n in (3, 4, 6, 8, 10)] == [sample(0, 32), b"", b"", sample(1, 32), sample(2, 8)]


def test_the_clock_may_wrap(firmware: Path) -> None:
    said = run(firmware, ["poll", start(), *(f"time {n * 2**31 % 2**32}" for n in range(1, 5)), request(8, 2)])
    assert said[-1] == wire.frame(0x48, struct.pack("<BBIIII", 2, 0, 4 * 2**31 // 1000, 0, 0, 0))


def test_a_note(firmware: Path) -> None:
    words = "µ" * 150
    said = run(firmware, ["poll", "note hot", f"note {words}"])
    assert said[1:] == [wire.frame(0x62, b"\x01hot"), wire.frame(0x62, b"\x01" + words.encode()[:200])]
