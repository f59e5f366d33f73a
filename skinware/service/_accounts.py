"""What a reader counts and tells of itself."""

from __future__ import annotations

import os
import sys
import time

from skinware.memory.announcement import Announcement, ReaderRecord
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Turn, Turns
from skinware.realtime import NS_PER_S, now_ns

_ANNOUNCE_EVERY_NS = NS_PER_S // 4


class Accounts:
    """Counts at the moments at which a reader is in no hurry: it notes times before it sleeps, and adds them up later.

    With more readers than processors, what one does before it sleeps makes the next one's frame older.

    Args:
        namespace, service: what is read.
        announce: let others see it, from its first frame or wait on.
    """

    def __init__(self, namespace: Namespace, service: str, announce: bool) -> None:
        program = os.path.basename(sys.argv[0] or sys.executable)
        self._record = ReaderRecord(service, os.getpid(), program, "on demand")
        self._namespace, self._announce_it = namespace, announce
        self._announcement: Announcement | None = None
        self._announced_ns = self._announced_frames = 0
        self._in_loop = False
        self._turns: list[Turn] = []
        self._cpu_ns = 0

    @property
    def record(self) -> ReaderRecord:
        self._add_up()
        return self._record

    def begin_loop(self, kind: str) -> None:
        """The reader reads in a loop from now on, whose turns are timed."""
        self._record.kind = kind
        self._in_loop = True

    def taken(self, lost: int) -> None:
        self._record.frames += 1
        if lost:
            self._record.lost += lost

    @property
    def due_ns(self) -> int:
        return self._announced_ns + _ANNOUNCE_EVERY_NS

    def settle(self, turns: Turns) -> None:
        self._record.frames += turns.frames
        self._record.lost += turns.lost
        self._turns += turns.over

    def end_turn(self, turn: tuple[int, int] | None) -> None:
        """Note the turn that ends now, if there is one; add up and tell everybody now and then."""
        time_ns = now_ns()
        if turn is not None:
            self._turns.append(Turn(*turn, time_ns, time.thread_time_ns() if self._in_loop else 0))
        if time_ns - self._announced_ns >= _ANNOUNCE_EVERY_NS:
            self._add_up()
            self._announce(time_ns)

    def _add_up(self) -> None:
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

    def _announce(self, time_ns: int) -> None:
        record = self._record
        if self._announced_ns:
            passed_ns = time_ns - self._announced_ns
            record.rate_hz = round((record.frames - self._announced_frames) * NS_PER_S / passed_ns, 2)
        if self._announce_it:
            if self._announcement is None:
                self._announcement = Announcement(self._namespace, record.service)
            self._announcement.write(record)
        self._announced_ns, self._announced_frames = time_ns, record.frames

    def close(self) -> None:
        self._announce_it = False
        if self._announcement is not None:
            self._announcement.close()
