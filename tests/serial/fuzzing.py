"""One fuzzer's input, run against a framing: what ``tools/fuzz`` does, and what its seeds replay in the tests.

An input is a script. It says how the stream is cut into chunks, and then what the stream consists of: frames, damaged
frames, bytes that are no frames.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from skinware.errors import ConfigurationError
from skinware_drivers.serial.delimited import Delimited
from skinware_drivers.serial.framing import Framing
from skinware_drivers.serial.packets import Packet
from tests.serial.framings import EXAMPLES, ONLY_IN_PYTHON, Example
from tests.serial.streams import cut, outcome

_LONGEST_STREAM = 1 << 14


class Script:
    """Numbers and bytes out of an input; zeros when it ends."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def is_over(self) -> bool:
        """Whether everything was used."""
        return self._at >= len(self._data)

    def number(self, below: int) -> int:
        """A number from 0 to ``below`` - 1."""
        size = 1 if below <= 256 else 2
        return int.from_bytes(self.bytes(size), "little") % below

    def bytes(self, count: int) -> bytes:
        """So many bytes."""
        taken = self._data[self._at : self._at + count]
        self._at += count
        return taken.ljust(count, b"\0")


def changed(inputs: Sequence[bytes], rng: random.Random, longest: int) -> bytes:
    """One input with parts of others and of itself, flipped bits and random bytes."""
    data = bytearray(rng.choice(inputs))
    for _ in range(rng.randint(1, 6)):
        at = rng.randint(0, len(data))
        what = rng.randrange(5)
        if what == 0 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif what == 1:
            data[at:at] = rng.randbytes(rng.randint(1, 16))
        elif what == 2:
            del data[at : at + rng.randint(1, 16)]
        elif what == 3:
            data[at:at] = data[rng.randint(0, len(data)) :][:64]
        else:
            other = rng.choice(inputs)
            data[at:] = other[rng.randint(0, len(other)) :]
    return bytes(data[:longest])


def run(example: Example, data: bytes) -> None:
    """Run one input.

    Raises:
        AssertionError: the framing does not hold what it promises.
    """
    framing = example.framing
    script = Script(data)
    sizes = [script.number(97) for _ in range(script.number(12))]
    ends_early = script.number(8)
    stream, wholes = _stream(example, script)
    places: list[int] = []
    place = 0
    while sizes and place < len(stream):
        place += 1 + sizes[len(places) % len(sizes)]
        places.append(place)
    part = stream[: max(0, len(stream) - ends_early)]
    assert outcome(framing, cut(part, places)) == outcome(framing, [part])
    if _is_checked(framing):
        _check_recovery(framing, stream, wholes)


def _stream(example: Example, script: Script) -> tuple[bytes, dict[int, tuple[int, bytes, bytes]]]:
    """The stream of a script; and its undamaged frames by their ends: identifier, body, frame."""
    framing = example.framing
    between = bytes([framing.stuffing.delimiter]) if isinstance(framing, Delimited) else b""
    stream, wholes = b"", {}
    while not script.is_over and len(stream) < _LONGEST_STREAM:
        what = script.number(8)
        if what == 0:
            stream += script.bytes(script.number(64))
            continue
        if what == 1 and isinstance(framing, Packet):
            sync = bytes(byte if isinstance(byte, int) else min(byte) for byte in framing.sync)
            stream += sync[: 1 + script.number(8)]
            continue
        frame = _frame(example, script)
        if frame is None:
            stream += script.bytes(4)
            continue
        if what >= 5:
            stream += between + frame[2]
            wholes[len(stream)] = frame
            continue
        damaged = bytearray(frame[2])
        at = script.number(len(damaged))
        if what == 2:
            damaged[at] ^= 1 << script.number(8)
        elif what == 3:
            del damaged[at]
        else:
            damaged = damaged[:at]
        stream += damaged
    return stream, wholes


def _frame(example: Example, script: Script) -> tuple[int, bytes, bytes] | None:
    sizes = example.body_sizes()
    if not sizes or not example.identifiers:  # a device that describes itself has no frames before it has
        return None
    size = sizes[script.number(len(sizes))] if script.number(16) == 0 else sizes[min(len(sizes) - 1, script.number(32))]
    pattern = script.bytes(min(size, 1 + script.number(16)))
    body = (pattern * (size // max(1, len(pattern)) + 1))[:size]
    identifier = example.identifiers[script.number(len(example.identifiers))]
    try:
        return identifier, body, example.framing.encode(identifier, body)
    except ValueError:  # a line with an end of line in it
        return None


def _is_checked(framing: Framing) -> bool:
    return isinstance(framing, Packet | Delimited) and framing.checksum is not None


def _check_recovery(framing: Framing, stream: bytes, wholes: dict[int, tuple[int, bytes, bytes]]) -> None:
    """Every undamaged frame is found, unless something that is a good frame too begins earlier and reaches into it."""
    assert isinstance(framing, Packet | Delimited)
    rest = bytes(2 * framing.maximum_body + 64)  # so that nothing waits for more
    found, _, _ = outcome(framing, [stream + rest])
    by_end = {frame.end: frame for frame in found}
    for end, (identifier, body, frame) in wholes.items():
        seen = by_end.get(end)
        if seen is not None and (seen.identifier, seen.body) == (identifier, body):
            continue
        assert any(other.end > end - len(frame) for other in found if other.end not in wholes or other is seen), (
            f"lost: {frame.hex()} which ends at {end} of {stream.hex()}"
        )


def known_examples() -> dict[str, Example]:
    """All framings there are to be fuzzed."""
    return {**EXAMPLES, **ONLY_IN_PYTHON, **examples_of_drivers()}


def examples_of_drivers() -> dict[str, Example]:
    """The framings of all installed drivers of serial devices."""
    from importlib.metadata import entry_points

    from skinware_drivers.registry import DRIVERS, load_driver

    found = {}
    for entry in entry_points(group=DRIVERS):
        try:
            driver = load_driver(entry.name)
        except ConfigurationError:
            continue
        framing = getattr(driver, "framing", None)
        if isinstance(framing, Packet | Delimited):
            found[f"driver_{entry.name}"] = Example(framing, _identifiers(framing))
    return found


def _identifiers(framing: Packet | Delimited) -> list[int]:
    """Identifiers that frames can carry."""
    body = bytes(framing.maximum_body)
    found = []
    for identifier in range(256):
        try:
            framing.encode(identifier, body)
        except ValueError:
            continue
        found.append(identifier)
    return found
