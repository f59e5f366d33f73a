"""No message of a peer ends a join, a list or a route, nor costs memory beyond the limits; each is counted."""

from __future__ import annotations

import contextlib
import os
import random
import struct
import threading
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware.bridge.link import Guard, Question
from skinware.bridge.messages import (
    About,
    CallResult,
    Service,
    Services,
    Summary,
    Wish,
    read_text,
    split_generation,
    token_parts,
)
from skinware.bridge.mirror import MemoryBudget
from skinware.bridge.peer import Jobs
from skinware.bridge.streaming import FrameStream
from skinware.bridge.watching import Watcher
from skinware.errors import BridgeError, RequestError
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.service import ServiceReader
from skinware_drivers.testing.waiting import wait_until
from tests.bridge.liar import DEEP, INSTANCE, ROBOT, Lies, coded, frame, generation, head, lying, services
from tests.bridge.net import NetLink
from tests.bridge.rig import joining, network, serving

LAST = 2**64 - 1
WRONG_TIMES = [2**63 - 1, -(2**63), -1]
GARBAGE = random.Random(4)


def garbage(most: int) -> bytes:
    return GARBAGE.randbytes(GARBAGE.randrange(1, most))


def codes(size: int) -> bytes:
    """A coded frame of the liar's file whose one column is packed, of ``size`` bytes."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = packer.compress(bytes(size)) + packer.flush()
    return coded(struct.pack("<6Q", 7, 5, 1, 1, 0, 0) + bytes([0x81]) + struct.pack("<I", len(packed)) + packed)


@dataclass(frozen=True)
class Lie:
    """Attributes: what is said, what is said to be wrong about it, and whether frames come all the same."""

    lies: Callable[[], Lies]
    why: str
    comes: bool = False


def about(**operations: str) -> bytes:
    return msgspec.json.encode({"operations": operations})


LIES = {
    "a clock far ahead": Lie(lambda: Lies(clock=lambda _: (2**63 - 1, 2**63 - 1)), "a clock"),
    "a clock far behind": Lie(lambda: Lies(clock=lambda _: (-(2**63), -(2**63))), "a clock"),
    "a clock that runs back": Lie(lambda: Lies(clock=lambda at: (at + 10**9, at - 10**9)), "a clock"),
    "a wild clock": Lie(lambda: Lies(clock=lambda _: (GARBAGE.getrandbits(64), GARBAGE.getrandbits(64))), "a clock"),
    "a name with a path": Lie(lambda: Lies(services=lambda: services("../../lab/pwn", "pose")), "a list of services"),
    "a long name": Lie(lambda: Lies(services=lambda: services("a" * 300)), "a list of services"),
    "a name with an escape": Lie(lambda: Lies(services=lambda: services("\x1b]0;x\x07")), "a list of services"),
    "a negative generation": Lie(
        lambda: Lies(services=lambda: services(service={"generation": -1})), "a list of services"
    ),
    "an unknown state": Lie(lambda: Lies(services=lambda: services(service={"state": "odd"})), "a list of services"),
    "any instance": Lie(lambda: Lies(services=lambda: services(instance="*")), "a list of services"),
    "an odd instance": Lie(lambda: Lies(services=lambda: services(instance="a/b#?$**")), "a list of services"),
    "deep services": Lie(
        lambda: Lies(services=lambda: b'{"instance":"' + INSTANCE.encode() + b'","zzz":' + DEEP), "a list of services"
    ),
    "too many services": Lie(
        lambda: Lies(services=lambda: services(*(f"s{number}" for number in range(20_000)))), "a list of services"
    ),
    "too many operations": Lie(
        lambda: Lies(generation=lambda: generation(None, about(**{f"op{i}": "y" for i in range(5000)}))), "service"
    ),
    "a deep generation": Lie(lambda: Lies(generation=lambda: generation(None, b'{"q":' + DEEP)), "service"),
    "a garbled generation": Lie(lambda: Lies(generation=partial(garbage, 5000)), "service"),
    "garbled frames": Lie(lambda: Lies(newest=lambda _: garbage(400), frames=[garbage(300)]), "a frame"),
    "garbled coded frames": Lie(lambda: Lies(newest=lambda _: coded(garbage(300))), "a frame"),
    "coded frames of odd numbers": Lie(
        lambda: Lies(
            newest=lambda _: coded(
                struct.pack("<QQqqQQ", 7, LAST, -(2**63), 2**63 - 1, 0, 0) + b"\0" + struct.pack("<I", 0)
            )
        ),
        "a frame",
    ),
    "a coded frame that swells": Lie(lambda: Lies(newest=lambda _: codes(1 << 24)), "a frame"),
    "odd numbers": Lie(lambda: Lies(newest=lambda i: frame([LAST, 2**63, LAST - 1][i % 3])), "a frame"),
    "numbers that jump": Lie(lambda: Lies(newest=lambda i: frame(1 if i == 1 else 2**62 + i)), "a frame"),
    "odd times": Lie(lambda: Lies(newest=lambda i: frame(i, WRONG_TIMES[i % 3])), "a frame"),
    "a time before all": Lie(
        lambda: Lies(newest=lambda i: frame(i, 0), clock=lambda at: (at + (1 << 60), at + (1 << 60))), "a frame"
    ),
    "frames beyond counting before": Lie(lambda: Lies(generation=lambda: generation(head(before=LAST))), "service"),
    "a negative period": Lie(lambda: Lies(generation=lambda: generation(head(period_ns=-(2**63)))), "service"),
    "a tiny period": Lie(lambda: Lies(generation=lambda: generation(head(period_ns=1))), "service"),
    "a ring beyond all": Lie(lambda: Lies(generation=lambda: generation(head(60 << 20, 64))), "service"),
    "odd tokens": Lie(
        lambda: Lies(
            tokens=[
                f"skinware/live/{ROBOT}/{version}/{number}" for version in ("x", "99", "²", "1") for number in range(9)
            ]
        ),
        "a token",
        comes=True,
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", LIES)
def test_no_lie_ends_a_join_and_each_is_counted(namespace: Namespace, name: str) -> None:
    lie = LIES[name]
    with network() as net, joining(net, namespace, robot=ROBOT) as ends, lying(net, lie.lies()):
        guard = ends.joiner._peer.guard
        if lie.why:
            wait_until(lambda: guard.count > 0)
            wait_until(lambda: any(f"robot {ROBOT}: {lie.why}" in event.get("why", "") for event in ends.events))
        if lie.comes:
            wait_until(lambda: "pose" in ends.here.services())
        ends.joiner._jobs.add((answered := threading.Event()).set)
        assert answered.wait(30), "it goes on"


@pytest.mark.parametrize("answer", [b'{"result":' + DEEP, b"", b'{"generation": 1e400}', b"\xff", b"[]"])
def test_an_odd_answer_to_a_call_is_an_error_of_the_call(namespace: Namespace, answer: bytes) -> None:
    with (
        network() as net,
        joining(net, namespace, robot=ROBOT) as ends,
        lying(net, Lies(call=lambda: answer)),
    ):
        wait_until(lambda: "pose" in ends.here.services())
        with (
            ServiceReader[Sample]("pose", namespace=ends.here, timeout_s=30) as reader,
            pytest.raises(RequestError),
        ):
            reader.call("tare")


def test_the_rings_of_a_robot_have_one_limit() -> None:
    budget = MemoryBudget(100)
    budget.reserve("a", 60)
    budget.reserve("a", 90)
    with pytest.raises(BridgeError, match=r"beside 0\.0 MB of other services"):
        budget.reserve("b", 11)
    budget.release("a")
    budget.reserve("b", 100)


@pytest.mark.thorough
def test_a_generation_that_swells_costs_no_more_than_it_may() -> None:
    packer = zlib.compressobj(9)
    bomb = generation(b"")[: 4 + len(about(tare="x"))] + packer.compress(bytes(300 << 20)) + packer.flush()
    assert len(bomb) < 1 << 20
    tracemalloc.start()
    try:
        with pytest.raises(BridgeError, match="becomes more than"):
            split_generation(bomb)
        assert tracemalloc.get_traced_memory()[1] < 200 << 20
    finally:
        tracemalloc.stop()


def test_what_waits_for_its_turn_is_bounded() -> None:
    jobs = Jobs()
    try:
        done: list[int] = []
        for number in range(10_000):
            jobs.add(partial(done.append, number), 1 << 16)
        assert jobs.left_out > 0
        jobs.run()
        assert len(done) + jobs.left_out == 10_000
    finally:
        jobs.close()


# -- every kind of message, changed in every way ------------------------------------------------------------------

TRUE: list[tuple[type[Any], Any]] = [
    (Services, Services(INSTANCE, "x", ("me",), {"arm": Service(7)}, "", "nao")),
    (Summary, Summary("lab")),
    (About, About({"tare": "x"})),
    (CallResult, CallResult(7, 1, msgspec.Raw(b'{"a":[1]}'))),
    (Wish, Wish(("palm",), ())),
]
ODD: list[Any] = [None, True, -1, 2**63, 10**400, 1.5, "", "\x1b[2J", "a" * 100_000, [], {}, [[]] * 3, {"": {}}]


@given(st.data())
def test_every_message_is_read_or_refused(data: st.DataObject) -> None:
    kind, true = data.draw(st.sampled_from(TRUE))
    tree = msgspec.json.decode(msgspec.json.encode(true))
    at = tree
    while True:
        keys: list[Any] = list(at) if isinstance(at, dict) else list(range(len(at)))
        key = data.draw(st.sampled_from(keys))
        if not isinstance(at[key], dict | list) or not at[key] or data.draw(st.booleans()):
            break
        at = at[key]
    at[key] = data.draw(st.sampled_from(ODD))
    with contextlib.suppress(msgspec.MsgspecError, OverflowError), contextlib.suppress(BridgeError):
        read_text(msgspec.json.encode(tree), kind)


@given(st.sampled_from(TRUE), st.binary(max_size=8), st.integers(0, 200))
def test_every_message_with_other_bytes_is_read_or_refused(kind: tuple[type[Any], Any], other: bytes, at: int) -> None:
    text = msgspec.json.encode(kind[1])
    with contextlib.suppress(BridgeError):
        read_text(text[:at] + other + text[at + len(other) :], kind[0])


@pytest.mark.thorough
@given(st.text(max_size=300))
def test_every_token_is_read_or_refused(text: str) -> None:
    for key in (text, f"skinware/live/{ROBOT}/{text}/{INSTANCE}", f"skinware/live/{ROBOT}/1/{text}"):
        with contextlib.suppress(BridgeError):
            token_parts(key)


# -- the robot's end, and those that watch ------------------------------------------------------------------------


@pytest.mark.thorough
def test_no_question_ends_a_robots_bridge_and_each_is_counted(namespace: Namespace) -> None:
    with network() as net, serving(net, namespace) as server:
        eve = NetLink(net)
        answers: list[bytes | None] = []
        root = server._keys.root
        keys = (f"{root}/services", f"{root}/arm/generation", f"{root}/arm/newest", f"{root}/arm/call/tare")
        odd: tuple[dict[str, object], ...] = (
            {"sequence": "²"},
            {"who": "x" * 1000, "base": "9" * 4000},
            {"part": "../x"},
            {"form": "0"},
            {},
        )
        for key in keys:
            for parameters in odd:
                for payload in (b"", DEEP, b"\xff", b'{"patches": [5]}', b"[" * 2_000_000):
                    eve.ask(key, answers.append, timeout_s=1, priority=None, parameters=parameters, payload=payload)
        eve.put(f"{root}/ping", b"")
        eve.put(f"{root}/ping", os.urandom(24))
        net.idle()
        wait_until(lambda: len(answers) == len(keys) * len(odd) * 5)
        asked = threading.Event()
        eve.ask(keys[0], lambda _: asked.set(), timeout_s=1, priority=None)
        assert asked.wait(30)


class Asked:
    """A question for the newest frame, with its answers."""

    def __init__(self, **parameters: str) -> None:
        self.answers: list[bytes] = []
        self.question = Question("", parameters, b"", self.answers.append, self.answers.append)


class NoSender:
    is_heard = False

    def close(self) -> None:
        pass


def test_pullers_and_their_questions_are_bounded() -> None:
    stream = FrameStream(NoSender(), lambda work, *arguments: work(*arguments))  # type: ignore[arg-type]
    many = [Asked(who=f"w{number}") for number in range(500)]
    for question in many:
        stream.asked(question.question)
    assert stream.n_pullers <= 64
    assert sum(bool(question.answers) for question in many) >= 400
    often = [Asked(who="w") for _ in range(3000)]
    for question in often:
        stream.asked(question.question)
    assert sum(b"too many" in b"".join(question.answers) for question in often) >= 1900
    stream.close()
    assert all(question.answers for question in (*many, *often))


def test_what_cannot_be_read_of_a_robot_is_counted_where_robots_are_listed() -> None:
    with network() as net:
        link, eve = NetLink(net), NetLink(net)
        watcher = Watcher(link)
        eve.declare_token(f"skinware/live/{ROBOT}/1/{INSTANCE}")
        for token in ("skinware/live/x y/1/z", f"skinware/live/{ROBOT}/²/{INSTANCE[::-1]}"):
            eve.declare_token(token)
        for payload in (DEEP, b"\xff", b'{"namespace": "\\u001b[31m"}', b'{"drivers": {"a": {}}}'):
            eve.put(f"skinware/1/{ROBOT}/{INSTANCE}/summary", payload)
        net.idle()
        seen = next(seen for seen in watcher.robots() if seen.instance == INSTANCE)
        assert seen.guard.count == 4
        assert watcher.guard.count == 1
        link.close()


def test_each_kind_is_reported_once() -> None:
    reported: list[tuple[str, str]] = []
    guard = Guard(lambda *what: reported.append(what))
    for _ in range(5):
        guard.refuse("a frame", "too long")
        assert not guard.run("a clock", lambda: 1 / 0)
    assert guard.count == 10
    assert [kind for kind, _ in reported] == ["a frame", "a clock"]
    assert guard.last == "a clock: ZeroDivisionError: division by zero"
