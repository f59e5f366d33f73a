"""Look after the patches of one bus: silent ones, restarted ones, and frames that fit no layout."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import partial
from typing import Any

from skinware.errors import BusError
from skinware.realtime import NS_PER_S, Periodic, now_ns
from skinware.status import PatchState, Unused, sample_report, sample_text
from skinware_drivers.adapter import Adapter
from skinware_drivers.bus import EXTENDED_FLAG, Bus, identifier_text
from skinware_drivers.description import Patch
from skinware_drivers.fields import Byte
from skinware_drivers.layout import Frame, Layout
from skinware_drivers.polling import Notice
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.generation import Generation
from skinware_drivers.running.guard import Backoff, hook
from skinware_drivers.running.news import TROUBLESHOOTING

Sample = Mapping[str, Any]
"""A sample of :func:`skinware.status.sample_report`."""


def why_unused(layout: Layout, bus: Bus) -> list[str]:
    """Return likely reasons why no data comes, in a few words each."""
    reasons: dict[tuple[str, int], str] = {}
    advice = ""
    kinds = {frame.extended for frame in layout.frames}
    for sample in sample_report(bus.samples.rows):
        length, is_extended = sample["length"], sample["extended"]
        if sample["why"] == Unused.BAD_LENGTH.name.lower():
            came = f"{length} byte{'' if length == 1 else 's'} came ({sample_text(dict(sample))})"
            for frame in layout.frames:
                if _is_of(frame, sample):
                    known = " or ".join(map(str, sorted(frame.length)))
                    reason = f"frames {frame.name!r} have length {known}, but {came}"
                    reasons.setdefault((frame.name, length), reason)
        elif sample["why"] == Unused.UNKNOWN.name.lower() and len(kinds) == 1 and is_extended not in kinds:
            number = identifier_text(_identifier(sample))
            heard, known = ("29 bits", "11 bits") if is_extended else ("11 bits", "29 bits")
            write = f"EXTENDED_FLAG | 0x{number}" if is_extended else f"0x{number}, without EXTENDED_FLAG"
            advice = advice or (
                f"heard 0x{number} ({heard}) where the layout has only identifiers of {known}: write {write}"
            )
    found = list(reasons.values())
    if advice and bus.medium == "can":
        found.append(advice)
    if wrong := bus.counters.framing.checksum_errors:
        found.append(
            f"{wrong} checksums were wrong: look at the kind of `checksum`, at its byte order and at what it `covers`"
        )
    return found


def _is_of(frame: Frame, sample: Sample) -> bool:
    """Return whether a sample can be a frame of this kind, but for its length."""
    identifier, data = _identifier(sample), bytes.fromhex(sample["data"])
    for condition in frame.when:
        if isinstance(condition, Byte):
            if condition.offset < len(data) and data[condition.offset] & condition.mask != condition.value:
                return False
        elif condition.extended != sample["extended"] or identifier & condition.mask != condition.value:
            return False
    return bool(frame.when) or not sample["extended"]


def _identifier(sample: Sample) -> int:
    return int(sample["identifier"]) | (EXTENDED_FLAG if sample["extended"] else 0)


log: logging.Logger = logging.getLogger("skinware.driver")

_DATA_TIMEOUT_S = 1.0
_SURE_NS = NS_PER_S
"""A patch that was live must be silent for so long beyond its age limit before it may be set up, which moves the
baseline of hardware that has not restarted."""
_DATA_CHECKS_HZ = 100
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0

Beside = Callable[[Coroutine[Any, Any, None]], asyncio.Task[None]]


class PatchCare:
    """Looks after the patches of one bus, while a generation is in service; ``beside`` starts a task of the driver."""

    def __init__(
        self,
        line: BusLine,
        generation: Callable[[], Generation | None],
        listen_only: bool,
        join: Callable[[], None],
        beside: Beside,
    ) -> None:
        self._line = line
        self._generation = generation
        self._listen_only = listen_only
        self._join = join
        self._beside = beside
        adapter = type(line.adapter)
        self._revives_all = adapter.revive is Adapter.revive
        self._knows_only_all = self._revives_all and adapter.probe is Adapter.probe
        # set-ups without effect, or that disturb others: at once, then after 1 s, 2 s, 4 s and so on, to 60 s
        self._set_ups: dict[int, Backoff] = {}  # by patch key, of those that answer and send nothing
        self._set_ups_of_all = Backoff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S)
        self._logged = ""
        self._begun_ns, self._error = 0, ""  # of the last set-up

    async def check_data(self) -> None:
        timer = Periodic(_DATA_CHECKS_HZ)
        silent = self._patches_in(PatchState.EXPECTED)
        for _ in range(round(_DATA_CHECKS_HZ * max(_DATA_TIMEOUT_S, 5 * self._line.adapter.period_s))):
            if not self._line.connection.lost.is_set() and not silent:
                return
            await asyncio.sleep((timer.deadline_ns - now_ns()) / NS_PER_S)
            timer.advance(now_ns())
            silent = self._patches_in(PatchState.EXPECTED)
        if silent:
            names = ", ".join(patch.name for patch in silent)
            who = f"{names} sends" if len(silent) == 1 else f"{len(silent)} patches send"
            which = "" if len(silent) == 1 else f": {names}"
            why = "".join(f"; {reason}" for reason in why_unused(self._line.adapter.layout, self._line.bus))
            log.warning("%s: %s no data%s%s", self._line.name, who, which, why)

    async def recover_silent(self) -> None:
        line, generation = self._line, self._generation()
        if generation is None or self._listen_only or line.connection.lost.is_set() or line.busy.locked():
            return
        begun_ns = max(line.connection.opened_ns, generation.begun_ns)
        if now_ns() - begun_ns < 2 * generation.publisher.pace.silence_ns:
            return  # unheard boards may send: to set them up again would move their baseline
        not_heard = generation.patches_in(line, PatchState.STALE, PatchState.EXPECTED, PatchState.RESTARTED)
        silent, asked_ns, live = self._surely_silent(not_heard), now_ns(), self._patches_in(PatchState.LIVE)
        if self._knows_only_all:
            is_due = self._set_ups_of_all.is_due or not live
            if not silent:
                self._set_ups_of_all.begin_again()
            elif is_due and live:  # which it disturbs: less and less often
                self._set_ups_of_all.begin()
            silent = silent[:1] if is_due else []  # the others are set up with it
        for patch in live:
            self._set_ups.pop(patch.key, None)
        for patch in silent:
            if await self._is_to_be_set_up(patch) and self._surely_silent([patch]):
                await self._revive(patch, asked_ns)

    def _surely_silent(self, patches: Sequence[Patch]) -> list[Patch]:
        """Return the patches that were silent for long enough, while this process ran."""
        line, generation = self._line, self._generation()
        if generation is None:
            return []
        silent_ns = generation.publisher.silent_ns
        found = [(patch, generation.number_of(line, patch)) for patch in patches]
        return [patch for patch, number in found if number is not None and silent_ns(number) >= _SURE_NS]

    async def _is_to_be_set_up(self, patch: Patch) -> bool:
        line, set_ups = self._line, self._set_ups.get(patch.key)
        if (set_ups is not None and not set_ups.is_due) or not line.condition.limits.knows_load_since(line.set_up_ns):
            return False
        try:
            with hook("probe", line.name):
                if not await line.adapter.probe(line.link, patch):
                    return False
        except BusError as error:
            log.debug("%s: %s", line.name, str(error))
            return False
        if set_ups is None:
            set_ups = self._set_ups[patch.key] = Backoff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S)
            if line.condition.limits.is_full:
                set_ups.not_before_ns = now_ns() + round(_LONGEST_PAUSE_S * NS_PER_S)
                log.warning(
                    "%s: %s answers, but its data finds no room: the bus is full; fewer boards, or a longer period"
                    " (%s)",
                    line.name,
                    patch.name,
                    TROUBLESHOOTING,
                )
                return False
        if not set_ups.begun:
            log.warning(
                "%s: %s is silent but answers: it has restarted, or was never configured", line.name, patch.name
            )
        elif set_ups.begun == 1:
            log.warning(
                "%s: %s answers and was configured, but sends nothing; it is configured again with growing pauses",
                line.name,
                patch.name,
            )
        set_ups.begin()
        return True

    async def attend(self, pause_s: Callable[[], float]) -> None:
        """Listen to reports of devices about themselves, indefinitely, with pauses after failures of the bus."""
        adapter = self._line.adapter
        reviving: dict[int, asyncio.Task[None]] = {}
        adapter.heard_by = partial(self._note, reviving)
        try:
            while True:
                try:
                    with hook("attend", self._line.name):
                        await adapter.attend(self._line.link)
                    await asyncio.Event().wait()  # indefinitely: it may still report something when it is asked
                except BusError as error:
                    if str(error) != self._logged and not self._line.connection.lost.is_set():  # once in a row
                        self._logged = str(error)
                        log.warning("%s: %s; attending to it again", self._line.name, self._logged)
                await asyncio.sleep(pause_s())
        finally:
            adapter.heard_by = None
            for task in reviving.values():
                task.cancel()

    def _note(self, reviving: dict[int, asyncio.Task[None]], patch: Patch, notice: Notice) -> None:
        line, generation = self._line, self._generation()
        number = None if generation is None else generation.number_of(line, patch)
        if generation is None or number is None:
            return
        if notice is Notice.SUSPECT:
            line.suspects.add(patch.key)
            with hook("Watch.suspect", line.name):
                generation.watch.suspect(number)
        elif notice is Notice.SOUND:
            line.suspects.discard(patch.key)
            with hook("Watch.forget", line.name):
                generation.watch.forget(number)
        elif notice is Notice.LOST or self._listen_only:
            generation.publisher.lose(number, PatchState.STALE)
        elif notice is Notice.CHANGED:
            generation.publisher.lose(number, PatchState.STALE)
            self._join()
        elif patch.key not in reviving or reviving[patch.key].done():
            log.warning("%s: %s has restarted", line.name, patch.name)
            generation.publisher.lose(number, PatchState.RESTARTED)
            reviving[patch.key] = self._beside(self._revive(patch, now_ns()))

    async def _revive(self, patch: Patch, asked_ns: int) -> None:
        """Set one patch up again; if that means the whole bus, once for all requests before it began."""
        line = self._line
        async with line.busy:
            generation = self._generation()
            number = None if generation is None else generation.number_of(line, patch)
            if generation is None or number is None:
                return
            generation.decoder.forget(number)
            if not self._revives_all or self._begun_ns < asked_ns:
                generation.publisher.lose(number, PatchState.RESTARTED)
                self._begun_ns, self._error = now_ns(), ""
                try:
                    with hook("revive", line.name):
                        await line.adapter.revive(line.link, patch)
                except BusError as error:
                    self._error = str(error) or type(error).__name__
            generation = self._generation()  # it may be another one by now
            number = None if generation is None else generation.number_of(line, patch)
            if generation is None or number is None:
                return
            if self._error:
                log.debug("%s: %s", line.name, self._error)
                generation.publisher.lose(number, PatchState.STALE)
            else:
                generation.publisher.patches.counts_from_ns[number] = now_ns()
                line.suspects.discard(patch.key)
                with hook("Watch.forget", line.name):
                    generation.watch.forget(number)

    def _patches_in(self, state: PatchState) -> list[Patch]:
        generation = self._generation()
        return [] if generation is None else generation.patches_in(self._line, state)
