"""Take the samples of a service: wait for them, and count them and those that were missed."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

from skinware.errors import Overrun, ServiceTimeout, StructureChanged
from skinware.memory.announcement import Announcement, ReaderRecord
from skinware.memory.namespace import Namespace
from skinware.memory.ring import COPY_ATTEMPTS, Sample, SampleT
from skinware.memory.ring_reader import NEXT, RingReader, Turn, Turns
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns
from skinware.service._attachment import GENERATION_ENDED, Attachment

_ANNOUNCE_EVERY_NS = NS_PER_S // 4

Position = tuple[int, int]
"""(generation, sequence) of a sample."""


class Accounts:
    """Counts at the moments at which a reader is in no hurry: it notes times before it sleeps, and adds them up later.

    With more readers than processors, what one does before it sleeps makes the next one's sample older.

    Args:
        announce: let others see it, from its first sample or wait on.
    """

    def __init__(self, namespace: Namespace, service: str, announce: bool) -> None:
        program = os.path.basename(sys.argv[0] or sys.executable)
        self._record = ReaderRecord(service, os.getpid(), program, "on demand")
        self._namespace, self._announce_it = namespace, announce
        self._announcement: Announcement | None = None
        self._announced_ns = self._announced_frames = self.due_ns = 0
        self._in_loop = False
        self._turns: list[Turn] = []
        self._cpu_ns = 0

    @property
    def record(self) -> ReaderRecord:
        """The figures so far, all turns added up."""
        record = self._record
        turns, self._turns = self._turns, []
        for acquired_ns, taken_ns, ended_ns, cpu_ns in turns:
            age_ns = taken_ns - acquired_ns
            record.age.add(age_ns)
            record.age_ms = round(age_ns / 1e6, 3)
            if cpu_ns:
                record.wall.add(ended_ns - taken_ns)
                if 0 < self._cpu_ns <= cpu_ns:
                    record.cpu.add(cpu_ns - self._cpu_ns)
                self._cpu_ns = cpu_ns
        return record

    def begin_loop(self, kind: str) -> None:
        """From now on the reader reads in a loop, whose turns are timed."""
        self._record.kind = kind
        self._in_loop = True

    def taken(self, missed: int) -> None:
        self._record.frames += 1
        if missed:
            self._record.missed += missed

    def settle(self, turns: Turns) -> None:
        self._record.frames += turns.frames
        self._record.missed += turns.missed
        self._turns += turns.over if self._in_loop else [turn._replace(cpu_ns=0) for turn in turns.over]

    def end_turn(self, turn: tuple[int, int] | None) -> None:
        """Note the turn that ends now, if there is one; add up and announce now and then."""
        time_ns = now_ns()
        if turn is not None:
            self._turns.append(Turn(*turn, time_ns, time.thread_time_ns() if self._in_loop else 0))
        if time_ns < self.due_ns:
            return
        record = self.record
        if self._announced_ns:
            passed_ns = time_ns - self._announced_ns
            record.rate_hz = round((record.frames - self._announced_frames) * NS_PER_S / passed_ns, 2)
        if self._announce_it:
            if self._announcement is None:
                self._announcement = Announcement(self._namespace, record.service)
            self._announcement.write(record)
        self._announced_ns, self._announced_frames = time_ns, record.frames
        self.due_ns = time_ns + _ANNOUNCE_EVERY_NS

    def close(self) -> None:
        self._announce_it = False
        if self._announcement is not None:
            self._announcement.close()


class Taking(Attachment[SampleT]):
    """Takes the samples of a service: the newest, or one after the other."""

    def __init__(self, name: str, namespace: Namespace | str | None, timeout_s: float | None, announce: bool) -> None:
        super().__init__(name, namespace, timeout_s)
        self._last_taken: Position | None = None
        self._open_turn: tuple[int, int] | None = None
        self._turns_in_c = False  # whether the ring counts at the moment, for a loop
        self._accounts = Accounts(self.namespace, name, announce)

    def _adopt(self, ring: RingReader[SampleT]) -> None:
        self._end_turn()
        if self._last is not None and ring.generation != self._ring.generation:
            before = self._ring.segment
            taken = before.published_before + self._last[1]
            published = ring.segment.published_before
            if published < taken:  # the count began again: the lock's file was removed
                published = before.published
            self._accounts.record.missed += published - taken
            self._last = (ring.generation, 0)
        super()._adopt(ring)

    def _read(self, known: Position | None, max_age_s: float | None, deadline_ns: int) -> SampleT:
        if known is None:
            alive = self._keep_up()
            if self._ring.latest:
                frame = self._newest_now(self._ring.copy, alive)
                if _is_young(frame, max_age_s):
                    return frame
                known = frame.position
        while True:
            frame = self._next_frame(known, deadline_ns, max_age_s=max_age_s)
            if _is_young(frame, max_age_s):
                return frame
            known = frame.position

    def _read_in_order(self, deadline_ns: int) -> SampleT:
        self._require_open()
        last = self._last
        if last is not None and last < (self._ring.generation, self._ring.latest):
            self._end_turn()  # the generation at hand has newer samples, though there may be another one already
            return self._taken(self._next_in_order, self.alive)
        return self._next_frame(last, deadline_ns, in_order=True)

    def _next_frame(
        self,
        known: Position | None,
        deadline_ns: int,
        *,
        in_order: bool = False,
        max_age_s: float | None = None,
    ) -> SampleT:
        """Wait for a sample that is newer than ``known``: the newest, or the next in order.

        One that is slept for was published within the last slice, when its writer lived.
        """
        slept = look_around = False
        self._end_turn()
        while True:
            self._require_open()
            ring = self._ring
            wake_count = ring.wake_count
            outdated = known is not None and ring.generation < known[0]
            if (look_around or outdated or ring.state & GENERATION_ENDED) and not self._moved:
                self._follow()
                ring = self._ring
                wake_count = ring.wake_count
            latest = ring.latest
            if latest and (known is None or (ring.generation, latest) > known):
                take = self._next_in_order if in_order else ring.copy
                return self._taken(take, slept or self.alive)
            if self._moved:
                raise self._structure_changed()
            remaining_ns = deadline_ns - now_ns()
            if remaining_ns <= 0:
                raise ServiceTimeout(self._why_nothing_came(max_age_s))
            self._end_turn()
            ring.wake_word.wait(wake_count, min(remaining_ns, WAIT_SLICE_NS))
            slept = ring.latest != latest
            look_around = not slept

    def _structure_changed(self) -> StructureChanged:
        return StructureChanged(
            f"service {self.name!r} came back with another structure; call reattach() and read it again"
        )

    def _why_nothing_came(self, max_age_s: float | None) -> str:
        wanted = "newer sample" if max_age_s is None else f"sample younger than {max_age_s:g} s"
        if not self.alive:
            return f"no {wanted} of {self.name!r}: its writer is dead or was stopped; start it again"
        if self.paused:
            return f"no {wanted} of {self.name!r}: its writer is paused"
        if not self._ring.latest:
            return f"no sample of {self.name!r} yet: its writer is running, but has published nothing so far"
        return f"no {wanted} of {self.name!r}: its writer is running, but is silent (hung, stopped or waiting)"

    def _next_in_order(self) -> SampleT | None:
        last = self._last[1] if self._last is not None and self._last[0] == self._ring.generation else None
        if last is None:
            return self._ring.copy()
        frame = self._ring.copy(last + 1)
        if frame is not None:
            return frame
        for _ in range(COPY_ATTEMPTS):  # it missed some
            latest = self._ring.latest
            oldest = max(last + 1, latest - self._ring.slot_count + 2)
            for sequence in range(oldest, latest + 1):
                frame = self._ring.copy(sequence)
                if frame is not None:
                    return frame
        raise Overrun(
            f"no slot of {self.name!r} could be read, {COPY_ATTEMPTS} times in a row: give it more slots, publish less"
            " often, or start it again if it died while it filled one"
        )

    def _newest_now(self, take: Callable[[], SampleT | None], alive: bool) -> SampleT:
        """Return the newest sample without a wait, so that this is the moment to count it."""
        frame = self._taken(take, alive)
        self._end_turn()
        return frame

    def _whole(self, take: Callable[[], SampleT | None], alive: bool) -> SampleT:
        try:
            frame = take()
        except Overrun:
            self._accounts.record.overruns += 1
            raise
        if frame is None:
            raise ServiceTimeout(f"service {self.name!r} has published nothing yet")
        frame.stale = not alive
        return frame

    def _taken(self, take: Callable[[], SampleT | None], alive: bool) -> SampleT:
        frame = self._whole(take, alive)
        self._count(frame)
        return frame

    @property
    def _last(self) -> Position | None:
        self._settle()
        return self._last_taken

    @_last.setter
    def _last(self, position: Position | None) -> None:
        self._come_back()
        self._last_taken = position

    def _take_turn(
        self, wanted: int, timeout_ns: int, max_age_s: float | None = None, newer_than: Position | None = None
    ) -> SampleT:
        """Return the sample after ``newer_than`` or the last one taken; C takes it while only samples come."""
        begun_ns = 0
        if self._turns_in_c and max_age_s is None and not self._closed:
            ring = self._ring
            if newer_than is None or newer_than == (ring.generation, ring.state_in_c.last):
                frames = ring.take.next(wanted, timeout_ns)
                if frames:
                    return frames[0]
                begun_ns = ring.take.state_in_c.begun_ns
        deadline_ns = (begun_ns or now_ns()) + timeout_ns
        if wanted == NEXT:
            frame = self._read_in_order(deadline_ns)
        else:
            frame = self._read(newer_than or self._last, max_age_s, deadline_ns)
        self._leave_to_c()
        return frame

    def _leave_to_c(self) -> None:
        """Leave the next turns to C until something else happens than samples."""
        if self._last_taken is not None:
            self._ring.resume_turns(self._last_taken[1], self._accounts.due_ns, self._open_turn)
            self._turns_in_c, self._open_turn = True, None

    def _come_back(self) -> None:
        if self._turns_in_c:
            self._settle()
            self._open_turn = self._ring.end_turn()
            self._turns_in_c = False

    def _settle(self) -> None:
        """Count the samples that were taken in C since the last time."""
        turns = self._ring.settle_turns() if self._turns_in_c else None
        if turns is not None:
            self._last_taken = self._ring.generation, turns.last
            self._accounts.settle(turns)

    def _end_turn(self) -> None:
        self._come_back()
        turn, self._open_turn = self._open_turn, None
        self._accounts.end_turn(turn)

    def _count(self, frame: SampleT) -> None:
        self._come_back()
        if self._open_turn is not None:  # of a loop, in whose turn something else is read
            self._end_turn()
        last, self._last_taken = self._last_taken, (frame.generation, frame.sequence)
        missed = 0 if last is None else max(0, frame.sequence - last[1] - 1)  # of this generation: _adopt saw to it
        self._accounts.taken(missed)
        self._open_turn = frame.acquired_ns, now_ns()


def _is_young(frame: Sample, max_age_s: float | None) -> bool:
    return max_age_s is None or frame.age_ns <= max_age_s * NS_PER_S
