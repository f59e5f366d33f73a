"""How much data of others may ask for: one set of limits for recordings and for links.

Every limit is far above what a real skin needs (30,848 sensors: 0.3 MB a sample, 1.2 MB a head, 16 MiB a ring), and low
enough that a small file, or one message of a peer, can neither fill the memory of a robot nor hold up a program.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from typing import TypeVar

import msgspec

_JSON_STRING = re.compile(rb'"(?:[^"\\]|\\.)*"?', re.DOTALL)
_JSON_BRACKET = re.compile(rb"[\[\]{}]")
_Type = TypeVar("_Type")


@dataclass(frozen=True)
class Limits:
    """Limits of sizes, ratios, depths and counts. Sizes are in bytes.

    Attributes:
        json_size: of one JSON text.
        json_depth: arrays and objects within each other in a JSON text.
        head_size: of a service's file up to its slots (tables, places of sensors), unpacked.
        slot_size: of one sample of a service.
        ring_size: of all slots of a service that is published here for others.
        robot_size: of the rings and heads of all services of one robot.
        services: of one robot.
        robots: that a program lists, and that one router may have.
        chunk_size: of the contents of a chunk of a recording, decompressed.
        frames_size: of the samples of one service in one chunk, decoded.
        ratio: data that becomes more than ``always_size`` may become so many times as large as it is packed.
        always_size: data of any size may become so large; see :meth:`room`.
        time_ns: absolute value of a time, ns; a sum of two such times fits 64 bits.
    """

    json_size: int = 1 << 20
    json_depth: int = 32
    head_size: int = 64 << 20
    slot_size: int = 32 << 20
    ring_size: int = 256 << 20
    robot_size: int = 1 << 30
    services: int = 64
    robots: int = 256
    chunk_size: int = 64 << 20
    frames_size: int = 128 << 20
    ratio: int = 1000
    always_size: int = 1 << 30
    time_ns: int = (1 << 62) - 1

    def room(self, size: int) -> int:
        """Return how many bytes so many packed bytes may become."""
        return max(self.always_size, self.ratio * size)

    def is_time(self, time_ns: object) -> bool:
        """Return whether a value of others is a time in ns that can be computed with."""
        return type(time_ns) is int and abs(time_ns) <= self.time_ns


LIMITS = Limits()
"""The limits of all commands, and the default of everything that takes limits."""

SLOWEST_REPLAY = 1e-6
"""Least speed of a replay, whose periods must fit 64 bits."""


def read_json(data: bytes | memoryview, type_: type[_Type]) -> _Type:
    """Decode a JSON text that others wrote.

    Args:
        data: UTF-8.
        type_: what it must be, as :mod:`msgspec` has it.

    Raises:
        ValueError: it is no JSON of that type, or is larger or deeper than the limits allow; the message says which.
    """
    if len(data) > LIMITS.json_size:
        raise ValueError(f"JSON of {len(data)} bytes; at most {LIMITS.json_size} are read")
    if _is_deeper(bytes(data), LIMITS.json_depth):
        raise ValueError(f"JSON nested deeper than {LIMITS.json_depth}")
    try:
        return msgspec.json.decode(data, type=type_)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(str(error)) from None


def unpack(data: bytes | memoryview, most: int) -> bytes:
    """Decompress zlib's data that others packed; ValueError if they are broken or become larger than this."""
    unpacker = zlib.decompressobj()
    try:
        unpacked = unpacker.decompress(data, most + 1)
    except zlib.error as error:
        raise ValueError(f"packed data cannot be decompressed ({error})") from None
    if len(unpacked) > most:
        raise ValueError(f"packed data becomes more than {most} bytes")
    if not unpacker.eof:
        raise ValueError("packed data ends too early")
    return unpacked


def _is_deeper(text: bytes, depth: int) -> bool:
    if text.count(b"[") + text.count(b"{") <= depth:
        return False
    level = 0
    for bracket in _JSON_BRACKET.findall(_JSON_STRING.sub(b"", text)):
        level += 1 if bracket in b"[{" else -1
        if level > depth:
            return True
    return False
