"""Handshakes on a bus: who waits gets what it waits for, and can be told to give up at any moment."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from skinware_drivers.bus import FrameBatch
from skinware_drivers.link import Link, Match, Reply


class Nowhere:
    """A bus that takes everything."""

    listen_only = False
    channel = "nowhere"

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
