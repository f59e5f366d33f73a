"""Reading in asyncio programs and notebooks.

::

    import skinware.aio

    async with skinware.aio.Skin() as skin:
        async for snapshot in skin:
            print(snapshot.physical("pressure").max())

The calls are those of :class:`skinware.Skin` and :class:`skinware.ServiceReader`, awaited. They may be cancelled at any
time. However many of them wait, one thread of the process waits for all of shared memory, asleep until a writer
publishes. One coroutine at a time per reader or skin: make as many as you like.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any, Generic, Self

import skinware.skin
from skinware.aio._wakeups import WakeWord, wakeups
from skinware.errors import RequestTimeout, ServiceTimeout
from skinware.memory.ring import SampleT
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, Periodic, now_ns
from skinware.service import Position, ServiceReader
from skinware.service._tap import wake_word_of
from skinware.snapshot import Snapshot

_ANSWER_POLL_S = 0.005


class _Awaited:
    """What is awaited shares one thread with all others until it is closed."""

    sync: ServiceReader[Any] | skinware.skin.Skin

    def __init__(self) -> None:
        self._wakeups = wakeups()
        self._closed = False

    def close(self) -> None:
        self.sync.close()
        if not self._closed:
            self._closed = True
            self._wakeups.leave()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


class Reader(_Awaited, Generic[SampleT]):
    """A reader of one service for asyncio.

    Args:
        reader: from now on used and closed by this object.

    Attributes:
        sync: that reader, for everything that does not wait.
    """

    def __init__(self, reader: ServiceReader[SampleT]) -> None:
        self.sync: ServiceReader[SampleT] = reader
        super().__init__()

    async def read(
        self,
        *,
        newer_than: SampleT | Position | None = None,
        max_age_s: float | None = None,
        timeout_s: float | None = 5.0,
    ) -> SampleT:
        """As :meth:`skinware.ServiceReader.read`; it raises the same."""
        deadline_ns = _deadline_ns(timeout_s)
        while True:
            word = wake_word_of(self.sync)
            try:
                return self.sync.read(newer_than=newer_than, max_age_s=max_age_s, timeout_s=0)
            except ServiceTimeout:
                remaining_s = _remaining_s(deadline_ns)
                if remaining_s <= 0:
                    raise
            await self._wakeups.wait([word], remaining_s)
            self.sync.refresh()

    async def frames(
        self, rate_hz: float | None = None, *, max_age_s: float | None = None, timeout_s: float | None = None
    ) -> AsyncIterator[SampleT]:
        """As :meth:`skinware.ServiceReader.frames`; it raises the same."""
        frame: SampleT | None = None
        timer = None if rate_hz is None else Periodic(rate_hz)
        while timer is None or await _deadline(timer):
            newer_than = frame if timer is None or self.sync.structure_changed else None
            frame = await self.read(newer_than=newer_than, max_age_s=max_age_s, timeout_s=timeout_s)
            yield frame

    def __aiter__(self) -> AsyncIterator[SampleT]:
        return self.frames()

    async def request(self, *, timeout_s: float = 5.0) -> SampleT:
        """As :meth:`skinware.ServiceReader.request`; it raises the same."""
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        answer = await self._ask("acquire", {}, timeout_s)
        left_s = max(0.0, (deadline_ns - now_ns()) / NS_PER_S)
        return await self.read(newer_than=(answer.generation, answer.sequence - 1), timeout_s=left_s)

    async def call(self, operation: str, /, *, timeout_s: float = 5.0, **arguments: Any) -> Any:
        """As :meth:`skinware.ServiceReader.call`; it raises the same."""
        return (await self._ask(operation, arguments, timeout_s)).result

    async def _ask(self, operation: str, arguments: dict[str, Any], timeout_s: float) -> Any:
        pending = self.sync.ask(operation, **arguments)
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        try:
            while not pending.done():
                if now_ns() >= deadline_ns:
                    raise RequestTimeout(f"{self.sync.name}: no answer to {operation!r} within {timeout_s:g} s")
                await asyncio.sleep(_ANSWER_POLL_S)
            return pending.result(0.0)
        finally:
            pending.cancel()  # if it was not answered


class Skin(_Awaited):
    """All running drivers as one skin, for asyncio.

    Args:
        skin: from now on used and closed by this object. Default: ``skinware.Skin()``.

    Attributes:
        sync: that skin, for everything that does not wait.
    """

    def __init__(self, skin: skinware.skin.Skin | None = None) -> None:
        self.sync: skinware.skin.Skin = skinware.skin.Skin() if skin is None else skin
        super().__init__()

    async def read(
        self,
        *,
        newer_than: Snapshot | None = None,
        max_age_s: float | None = None,
        align: bool = False,
        timeout_s: float | None = 5.0,
    ) -> Snapshot:
        """As :meth:`skinware.Skin.read`; it raises the same."""
        deadline_ns = _deadline_ns(timeout_s)
        while True:
            words = self._words()
            try:
                return self.sync.read(newer_than=newer_than, max_age_s=max_age_s, align=align, timeout_s=0)
            except ServiceTimeout:
                remaining_s = _remaining_s(deadline_ns)
                if remaining_s <= 0:
                    raise
            await self._wakeups.wait(words, remaining_s)

    async def frames(
        self,
        rate_hz: float | None = None,
        *,
        max_age_s: float | None = None,
        align: bool = False,
        timeout_s: float | None = None,
    ) -> AsyncIterator[Snapshot]:
        """As :meth:`skinware.Skin.frames`; it raises the same."""
        snapshot: Snapshot | None = None
        timer = None if rate_hz is None else Periodic(rate_hz)
        while timer is None or await _deadline(timer):
            newer_than = snapshot if timer is None else None
            snapshot = await self.read(newer_than=newer_than, max_age_s=max_age_s, align=align, timeout_s=timeout_s)
            yield snapshot

    def __aiter__(self) -> AsyncIterator[Snapshot]:
        return self.frames()

    def _words(self) -> list[WakeWord]:
        return [wake_word_of(self.sync.reader(driver)) for driver in self.sync.layout.drivers]


def _deadline_ns(timeout_s: float | None) -> int | None:
    return None if timeout_s is None else now_ns() + round(timeout_s * NS_PER_S)


def _remaining_s(deadline_ns: int | None) -> float:
    """Until the deadline, and at most until the next look around."""
    remaining_ns = WAIT_SLICE_NS if deadline_ns is None else min(WAIT_SLICE_NS, deadline_ns - now_ns())
    return remaining_ns / NS_PER_S


async def _deadline(timer: Periodic) -> bool:
    await asyncio.sleep(max(0.0, (timer.deadline_ns - now_ns()) / NS_PER_S))
    timer.advance(now_ns())
    return True


__all__ = ["Reader", "Skin"]
