"""A robot's bridge that lies, over a network in this process."""

from __future__ import annotations

import json
import queue
import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skinware.bridge.link import Question
from skinware.bridge.messages import Keys
from skinware.memory import file_layout
from skinware.realtime import now_ns
from tests.bridge.net import Net, NetLink

ROBOT, INSTANCE, GENERATION = "evil", "00112233aabbccdd", 7
DEEP = b"[" * 200_000


def head(
    count: int = 64,
    slots: int = 8,
    *,
    period_ns: int = 10_000_000,
    before: int = 0,
) -> bytes:
    """A service's file up to its slots; frames have one column of ``count`` bytes."""
    stride, slot_offset = file_layout.aligned(64 + count), 4096
    made = np.zeros(1, file_layout.HEADER)
    made["magic"], made["version_major"], made["kind"], made["name"] = b"SKINRING", 1, b"data", b"x"
    made["file_size"] = file_layout.aligned(slot_offset + stride * slots, 4096)
    made["generation"], made["column_count"], made["slot_count"] = GENERATION, 1, slots
    made["slot_offset"], made["slot_stride"] = slot_offset, stride
    made["period_ns"], made["published_before"] = period_ns, before
    column = np.zeros(1, file_layout.COLUMN)
    column["name"], column["dtype"], column["count"], column["offset"], column["in_slot"] = b"x", b"|u1", count, 64, 1
    data = np.zeros(slot_offset, np.uint8)
    data[: made.nbytes] = made.view(np.uint8)
    begin = file_layout.COLUMN_OFFSET
    data[begin : begin + column.nbytes] = column.view(np.uint8)
    return data.tobytes()


def frame(sequence: int, time_ns: int | None = None) -> bytes:
    """A raw frame of such a file."""
    at_ns = now_ns() if time_ns is None else time_ns
    mask = (1 << 64) - 1
    slot = struct.pack("<QQQQ", sequence & mask, at_ns & mask, at_ns & mask, 0) + bytes(32 + 64)
    return struct.pack("<B7xQ", 0, GENERATION) + slot


def coded(payload: bytes, keeps: int = 1) -> bytes:
    return struct.pack("<BB6x", 1, keeps) + payload


def services(*names: str, **more: Any) -> bytes:
    one = {"generation": GENERATION, "state": "live", "sequence": 0} | more.pop("service", {})
    told = {"instance": INSTANCE, "start": "x", "services": dict.fromkeys(names or ("pose",), one)}
    return json.dumps(told | more).encode()


def generation(raw: bytes | None = None, about: bytes = b'{"operations":{"tare":"x"}}') -> bytes:
    return struct.pack("<I", len(about)) + about + zlib.compress(head() if raw is None else raw)


@dataclass
class Lies:
    """What the liar says; what is not given is true.

    Attributes:
        services, generation, newest, call: answers to questions; ``newest`` gets how many there were.
        clock: answers to a ping: (when it came, when it was answered), by our time.
        frames: messages that are pushed.
        tokens: of further bridges.
    """

    services: Callable[[], bytes] = services
    generation: Callable[[], bytes] = generation
    newest: Callable[[int], bytes] = frame
    call: Callable[[], bytes] = lambda: b'{"result": 1}'
    clock: Callable[[int], tuple[int, int]] = lambda at_ns: (at_ns, at_ns)
    frames: list[bytes] = field(default_factory=list)
    tokens: list[str] = field(default_factory=list)


@contextmanager
def lying(net: Net, lies: Lies) -> Iterator[NetLink]:
    keys, link, ended = Keys(ROBOT, INSTANCE), NetLink(net), threading.Event()
    asked: queue.SimpleQueue[Question] = queue.SimpleQueue()

    def ping(_key: str, message: bytes) -> None:
        who, asked_ns = struct.unpack("<16sq", message)
        mask = (1 << 64) - 1
        heard_ns, answered_ns = (time_ns & mask for time_ns in lies.clock(now_ns()))
        link.put(keys.pong(who.decode()), struct.pack("<qQQ", asked_ns, heard_ns, answered_ns))

    def push() -> None:
        sender, count = link.sender(keys.frame("pose")), 0
        while not ended.wait(0.005):
            for message in lies.frames:
                sender(message)
            while not asked.empty():
                count += 1
                asked.get().reply(lies.newest(count))

    link.answer(keys.services, lambda question: question.reply(lies.services()))
    link.answer(keys.of("*", "generation"), lambda question: question.reply(lies.generation()))
    link.answer(keys.of("*", "newest"), asked.put)
    link.answer(keys.of("*", "call/*"), lambda question: question.reply(lies.call()))
    link.listen(keys.ping, ping)
    for token in (keys.token, *lies.tokens):
        link.declare_token(token)
    pusher = threading.Thread(target=push, name="liar")
    pusher.start()
    try:
        yield link
    finally:
        ended.set()
        pusher.join()
        link.close()
