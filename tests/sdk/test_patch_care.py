"""How often a bus is set up for patches that are silent, or that say that they have restarted."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from skinware.errors import HandshakeTimeout
from skinware_drivers.adapter import NoOptions, Notice
from skinware_drivers.can.adapter import CanAdapter
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.link import Link
from skinware_drivers.running.patch_care import PatchCare

PATCHES = [Patch(f"patch {key}", [Module(taxels(1, first_uid=key))], key=key) for key in range(8)]


class Silent(CanAdapter[NoOptions]):
    """Many patches on one bus that cannot be asked, and can only be set up all at once."""

    def __init__(self, *, fails: bool) -> None:
        super().__init__(NoOptions())
        self._fails = fails
        self.set_ups = 0

    async def start(self, link: Link) -> None:
        self.set_ups += 1
        await asyncio.sleep(0)
        if self._fails:
            raise HandshakeTimeout("no answer")


class Answering(Silent):
    """They can be asked."""

    async def probe(self, link: Link, patch: Patch) -> bool:
        return True


class OneByOne(Answering):
    """They can be set up one by one."""

    async def revive(self, link: Link, patch: Patch) -> None:
        await self.start(link)


class Stage:
    """A bus on which every patch is silent; nothing is ever published.

    Attributes:
        forgotten: keys of the patches whose sequence numbers may begin anew.
        tasks: what was started beside the rest.
    """

    def __init__(self, adapter: Silent) -> None:
        self.forgotten: list[int] = []
        self.tasks: list[asyncio.Task[None]] = []
        nothing: Callable[..., None] = lambda *_: None  # noqa: E731
        generation = SimpleNamespace(
            begun_ns=0,
            publisher=SimpleNamespace(silence_ns=0, lose=nothing),
            decoder=SimpleNamespace(forget=self.forgotten.append),
            watch=SimpleNamespace(forget=nothing),
            patches_in=lambda *_: PATCHES,
            number_of=lambda _line, patch: patch.key,
        )
        line = SimpleNamespace(
            name="can0",
            adapter=adapter,
            link=None,
            lost=asyncio.Event(),
            busy=asyncio.Lock(),
            opened_ns=0,
            revived_ns=0,
            suspects=set(),
        )
        self.care = PatchCare(cast(Any, line), lambda: cast(Any, generation), False, lambda: None, self._begin)

    def _begin(self, work: Any) -> asyncio.Task[None]:
        self.tasks.append(asyncio.ensure_future(work))
        return self.tasks[-1]


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize(("kind", "set_ups"), [(Silent, 1), (Answering, 1), (OneByOne, 8)])
def test_silent_patches_that_can_only_be_set_up_together_are_so_once(
    kind: type[Silent], set_ups: int, fails: bool
) -> None:
    async def run() -> None:
        adapter = kind(fails=fails)
        stage = Stage(adapter)
        await stage.care.recover_silent()
        assert adapter.set_ups == set_ups
        assert stage.forgotten == ([] if kind is Silent else list(range(8)))
        await stage.care.recover_silent()  # the next time it is tried again
        assert adapter.set_ups == 2 * set_ups

    asyncio.run(run())


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize(("kind", "set_ups"), [(Silent, 1), (OneByOne, 8)])
def test_patches_that_restart_together_are_set_up_together(kind: type[Silent], set_ups: int, fails: bool) -> None:
    async def run() -> None:
        adapter = kind(fails=fails)
        stage = Stage(adapter)
        reviving: dict[int, asyncio.Task[None]] = {}
        for patch in PATCHES:
            stage.care._note(reviving, patch, Notice.RESTARTED)
        await asyncio.gather(*stage.tasks)
        assert (adapter.set_ups, stage.forgotten) == (set_ups, list(range(8)))
        stage.care._note(reviving, PATCHES[3], Notice.RESTARTED)  # later: it needs another
        await asyncio.gather(*stage.tasks)
        assert adapter.set_ups == set_ups + 1

    asyncio.run(run())


def test_what_is_told_outside_of_attend_is_heard_until_the_end() -> None:
    async def run() -> None:
        adapter = Silent(fails=False)
        stage = Stage(adapter)
        attending = asyncio.ensure_future(stage.care.attend(lambda: 0.0))
        await asyncio.sleep(0)
        adapter.tell(PATCHES[3], Notice.RESTARTED)
        await asyncio.gather(*stage.tasks)
        assert stage.forgotten == [3]
        attending.cancel()
        await asyncio.gather(attending, return_exceptions=True)
        adapter.tell(PATCHES[3], Notice.RESTARTED)
        assert len(stage.tasks) == 1

    asyncio.run(run())
