"""Handshakes on a bus: who waits gets what it waits for, and can be told to give up at any moment."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from skinware.errors import BusSendError, ConfigurationError, HandshakeTimeout
from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch
from skinware_drivers.fields import Match, Reply
from skinware_drivers.link import AT_ONCE, Link


class Nowhere:
    """A bus that takes everything."""

    listen_only = False
    name = "bus nowhere"
    medium = "can"

    def send(self, identifier: int, payload: bytes) -> None:
        """Gone."""


def offer(link: Link, *frames: tuple[int, bytes]) -> list[int]:
    """Let frames arrive; the rows that nobody waited for."""
    batch = FrameBatch(16)
    for identifier, payload in frames:
        batch.append(0, 7, identifier, payload)
    return list(link.offer(batch, np.arange(len(batch))).tolist())


@pytest.mark.parametrize("turns", range(6))
def test_a_request_that_is_cancelled_as_its_answer_arrives_does_not_go_on(turns: int) -> None:
    async def scenario() -> None:
        link = Link(Nowhere())  # type: ignore[arg-type]

        async def handshake() -> None:
            await link.request(0x100, b"", Match(0x101), timeout_s=60)
            await asyncio.sleep(60)

        task = asyncio.create_task(handshake())
        await asyncio.sleep(0)
        offer(link, (0x101, b"\x01"))
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        done, _ = await asyncio.wait([task], timeout=5)
        assert done, "the cancellation was swallowed"
        assert task.cancelled()

    asyncio.run(scenario())


@pytest.mark.parametrize("match", [Match(0x750), Match(0x700, 0x70F), Match(0x750, 0x7FF)])
def test_a_29_bit_identifier_is_no_answer_where_one_of_11_bits_is_awaited_nor_the_other_way_round(match: Match) -> None:
    """Their lowest 11 bits may be the same: frames of other devices made boards that do not exist."""

    async def scenario() -> None:
        link = Link(Nowhere())  # type: ignore[arg-type]
        with link.follow(match) as heard:
            assert offer(link, (EXTENDED_FLAG | 0x18DA_F750, b""), (EXTENDED_FLAG | 0x750, b""), (0x750, b"")) == [0, 1]
            assert [reply.identifier for reply in heard._queue] == [0x750]  # type: ignore[attr-defined]
        with link.follow(Match(EXTENDED_FLAG | 0x18DA_F750)):
            assert offer(link, (0x750, b""), (EXTENDED_FLAG | 0x18DA_F750, b""), (EXTENDED_FLAG | 0x750, b"")) == [0, 2]
        assert match.filter.mask & EXTENDED_FLAG

    asyncio.run(scenario())


def test_who_follows_hears_everything_that_matches_in_order_until_it_stops() -> None:
    async def scenario() -> None:
        link = Link(Nowhere())  # type: ignore[arg-type]
        with link.follow(Match(0x700, mask=0x7F0), Match(0x081, prefix=b"\x10")) as heard:
            frames = ((0x705, b"\x05"), (0x081, b"\x11"), (0x081, b"\x10"), (0x123, b""), (0x701, b"\x00"))
            assert offer(link, *frames) == [1, 3]
            found = [heard.get_nowait() for _ in range(heard.qsize())]
            assert found == [Reply(7, *frames[0]), Reply(7, *frames[2]), Reply(7, *frames[4])]
        assert offer(link, (0x705, b"\x05")) == [0]

    asyncio.run(scenario())


def test_an_answer_is_awaited_while_a_question_is_open_and_not_while_somebody_follows() -> None:
    async def scenario() -> None:
        link = Link(Nowhere())  # type: ignore[arg-type]
        with link.follow(Match(0x700)):
            assert not link.is_awaiting
            asking = asyncio.create_task(link.request(0x100, b"", Match(0x101), timeout_s=60))
            await asyncio.sleep(0)
            assert link.is_awaiting
            offer(link, (0x101, b"\x01"))
            await asking
            assert not link.is_awaiting
            with pytest.raises(HandshakeTimeout):
                await link.request(0x100, b"", Match(0x101), timeout_s=0)
            assert not link.is_awaiting

    asyncio.run(scenario())


def test_an_answer_that_comes_too_late_is_no_stranger() -> None:
    async def scenario() -> None:
        link = Link(Nowhere())  # type: ignore[arg-type]
        with pytest.raises(HandshakeTimeout):
            await link.request(0x207, b"\x1c", Match(0x270, prefix=b"\x1c"), timeout_s=0)
        assert offer(link, (0x270, b"\x1c"), (0x270, b"\x1d"), (0x280, b"\x1c")) == [1, 2]
        assert await link.collect(0x70F, b"\xff", Match(0x700, mask=0x70F), duration_s=0) == []
        assert offer(link, (0x7E0, b"\xff")) == []

    asyncio.run(scenario())


# -- sending ------------------------------------------------------------------------------------------------------


class Clocked(asyncio.SelectorEventLoop):
    """A loop whose time the test moves: sleeping costs nothing and takes as long as it should."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 100.0

    def time(self) -> float:
        return self.now_s

    def _run_once(self) -> None:
        scheduled = self._scheduled  # type: ignore[attr-defined]
        if not self._ready and scheduled:  # type: ignore[attr-defined]
            self.now_s = max(self.now_s, scheduled[0].when())
        super()._run_once()  # type: ignore[misc]


class Full(Nowhere):
    """A bus whose queue is full until a given time."""

    def __init__(self, loop: Clocked, until_s: float) -> None:
        self._loop, self._until_s = loop, until_s
        self.tries_s: list[float] = []

    def send(self, identifier: int, payload: bytes) -> None:
        """Refused or gone."""
        self.tries_s.append(self._loop.time())
        if self._loop.time() < self._until_s:
            raise BusSendError("No buffer space available")


def test_a_full_queue_is_tried_with_growing_pauses_until_the_deadline() -> None:
    loop = Clocked()
    bus = Full(loop, until_s=1e9)
    link = Link(bus)  # type: ignore[arg-type]
    with pytest.raises(BusSendError, match="No buffer space"):
        loop.run_until_complete(link.send(0x100, b"", timeout_s=1.0))
    pauses = np.diff(bus.tries_s)
    assert bus.tries_s[-1] == pytest.approx(101.0, abs=0.001)
    assert pauses[:4] == pytest.approx([0.002, 0.004, 0.008, 0.016])
    assert len(pauses) < 30  # not a flood
    loop.close()


def test_a_frame_goes_out_once_there_is_room() -> None:
    loop = Clocked()
    bus = Full(loop, until_s=100.3)
    link = Link(bus)  # type: ignore[arg-type]
    loop.run_until_complete(link.send(0x100, b"", timeout_s=0.5))
    assert 100.3 <= bus.tries_s[-1] <= 100.36
    loop.close()


@pytest.mark.parametrize("pace_per_ms", [0.5, 4.0])
def test_thousands_of_frames_go_out_at_the_pace(pace_per_ms: float) -> None:
    loop = Clocked()
    bus = Full(loop, until_s=0)
    link = Link(bus, pace_per_ms)  # type: ignore[arg-type]

    async def flood() -> None:
        for _ in range(4000):
            await link.send(0x100, b"")

    loop.run_until_complete(flood())
    sent_s = np.array(bus.tries_s)
    assert len(sent_s) == 4000
    window = 100  # in no stretch of frames are there more than the pace allows, and eight at once
    fastest_s = (sent_s[window:] - sent_s[:-window]).min()
    assert fastest_s >= (window - AT_ONCE) / (1e3 * pace_per_ms) - 1e-6
    assert sent_s[-1] - sent_s[0] < 1.01 * 4000 / (1e3 * pace_per_ms)  # and not slower either
    loop.close()


def test_frames_after_a_rest_are_not_made_up_for() -> None:
    loop = Clocked()
    bus = Full(loop, until_s=0)
    link = Link(bus)  # type: ignore[arg-type]

    async def now_and_then() -> None:
        for _ in range(3):
            for _ in range(3 * AT_ONCE):
                await link.send(0x100, b"")
            await asyncio.sleep(60)

    loop.run_until_complete(now_and_then())
    at_once = [bus.tries_s.count(time_s) for time_s in dict.fromkeys(bus.tries_s)]
    assert max(at_once) <= AT_ONCE + 1
    loop.close()


def test_an_identifier_of_29_bits_is_sent_with_its_flag_or_not_at_all() -> None:
    async def scenario() -> None:
        link = Link(Nowhere())  # type: ignore[arg-type]
        with pytest.raises(ConfigurationError, match=r"has more than 11 bits; .* EXTENDED_FLAG \| 0x18DA00F1"):
            await link.send(0x18DA00F1, b"")
        await link.send(EXTENDED_FLAG | 0x18DA00F1, b"")
        await link.send(0x7FF, b"")

    asyncio.run(scenario())
