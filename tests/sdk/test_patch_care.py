"""How often a bus is set up for patches that are silent, or that say that they have restarted."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from skinware.errors import HandshakeTimeout
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import PatchState
from skinware_drivers.can import CanAdapter
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.link import Link
from skinware_drivers.options import NoOptions
from skinware_drivers.polling import Notice
from skinware_drivers.running import guard, patch_care
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
    """A bus on which every patch is silent at first; nothing is ever published.

    Attributes:
        states: of the patches, by their keys.
        forgotten: keys of the patches whose sequence numbers may begin anew.
        tasks: what was started beside the rest.
        is_full: what the bus' limits say.
    """

    def __init__(self, adapter: Silent, *, is_full: bool = False) -> None:
        self.is_full = is_full
        self.states = dict.fromkeys(range(len(PATCHES)), PatchState.STALE)
        self.forgotten: list[int] = []
        self.tasks: list[asyncio.Task[None]] = []
        nothing: Callable[..., None] = lambda *_: None  # noqa: E731
        pace, patches = SimpleNamespace(silence_ns=0), SimpleNamespace(counts_from_ns=[0] * len(PATCHES))
        generation = SimpleNamespace(
            begun_ns=0,
            publisher=SimpleNamespace(pace=pace, lose=nothing, silent_ns=lambda _patch: 1 << 62, patches=patches),
            decoder=SimpleNamespace(forget=self.forgotten.append),
            watch=SimpleNamespace(forget=nothing),
            patches_in=lambda _line, *states: [patch for patch in PATCHES if self.states[patch.key] in states],
            number_of=lambda _line, patch: patch.key,
        )
        line = SimpleNamespace(
            name="can0",
            adapter=adapter,
            link=None,
            connection=SimpleNamespace(lost=asyncio.Event(), opened_ns=0),
            condition=SimpleNamespace(limits=self),
            busy=asyncio.Lock(),
            suspects=set(),
            set_up_ns=0,
        )
        self.care = PatchCare(cast(Any, line), lambda: cast(Any, generation), False, lambda: None, self._begin)

    def knows_load_since(self, _time_ns: int) -> bool:
        return True

    def _begin(self, work: Any) -> asyncio.Task[None]:
        self.tasks.append(asyncio.ensure_future(work))
        return self.tasks[-1]


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize(("kind", "set_ups"), [(Silent, 1), (Answering, 1), (OneByOne, 8)])
def test_silent_patches_that_can_only_be_set_up_together_are_so_once(
    kind: type[Silent], set_ups: int, fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def run() -> None:
        adapter = kind(fails=fails)
        stage = Stage(adapter)
        await stage.care.recover_silent()
        assert adapter.set_ups == set_ups
        assert stage.forgotten == ([] if kind is Silent else list(range(8)))
        later_ns = now_ns() + NS_PER_S
        monkeypatch.setattr(guard, "now_ns", lambda: later_ns)
        monkeypatch.setattr(patch_care, "now_ns", lambda: later_ns)
        await stage.care.recover_silent()  # the next time it is tried again
        assert adapter.set_ups == 2 * set_ups

    asyncio.run(run())


def test_a_patch_that_stays_away_has_the_living_ones_disturbed_more_and_more_rarely(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock_ns = 1000 * NS_PER_S
    monkeypatch.setattr(guard, "now_ns", lambda: clock_ns)
    monkeypatch.setattr(patch_care, "now_ns", lambda: clock_ns)
    adapter = Silent(fails=False)
    stage = Stage(adapter)
    stage.states = {key: PatchState.STALE if key == 3 else PatchState.LIVE for key in stage.states}

    async def at_seconds(end_s: int) -> list[int]:
        """When it was set up, in the next seconds."""
        nonlocal clock_ns
        times = []
        for second in range(end_s):
            before = adapter.set_ups
            await stage.care.recover_silent()
            times += [second] * (adapter.set_ups - before)
            clock_ns += NS_PER_S
        return times

    assert asyncio.run(at_seconds(200)) == [0, 1, 3, 7, 15, 31, 63, 123, 183]
    stage.states[3] = PatchState.LIVE
    assert asyncio.run(at_seconds(2)) == []
    stage.states[5] = PatchState.STALE  # another time: at once
    assert asyncio.run(at_seconds(3)) == [0, 1]
    stage.states = dict.fromkeys(stage.states, PatchState.STALE)  # nobody is disturbed
    assert asyncio.run(at_seconds(3)) == [0, 1, 2]


@pytest.mark.parametrize(
    ("is_full", "set_up_at_s"),
    [(False, [0, 1, 3, 7, 15, 31, 63, 123, 183]), (True, [60, 61, 63, 67, 75, 91, 123, 183])],
)
def test_a_patch_that_answers_but_sends_nothing_is_set_up_more_and_more_rarely(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, is_full: bool, set_up_at_s: list[int]
) -> None:
    """Each set-up moves its baseline; and on a full bus it is most likely in order, and its frames find no room."""
    clock_ns = 1000 * NS_PER_S
    monkeypatch.setattr(guard, "now_ns", lambda: clock_ns)
    monkeypatch.setattr(patch_care, "now_ns", lambda: clock_ns)
    adapter = OneByOne(fails=False)
    stage = Stage(adapter, is_full=is_full)
    stage.states = {key: PatchState.STALE if key == 3 else PatchState.LIVE for key in stage.states}
    times = []

    async def see(end_s: int) -> None:
        nonlocal clock_ns
        for second in range(end_s):
            before = adapter.set_ups
            await stage.care.recover_silent()
            times.extend([second] * (adapter.set_ups - before))
            clock_ns += NS_PER_S

    asyncio.run(see(200))
    assert times == set_up_at_s
    assert len(caplog.records) == 2 + is_full  # however often
    assert ("the bus is full" in caplog.text) == is_full
    stage.states[3] = PatchState.LIVE  # it sends: another time it has restarted
    asyncio.run(see(1))
    stage.states[3] = PatchState.STALE
    times.clear()
    stage.is_full = False
    asyncio.run(see(1))
    assert times == [0]


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
