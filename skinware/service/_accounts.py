"""What a reader counts and tells of itself."""

from __future__ import annotations

import os
import sys
import time

from skinware.memory.announcement import Announcement, ReaderRecord
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Frame
from skinware.realtime import NS_PER_S, now_ns

_ANNOUNCE_EVERY_NS = NS_PER_S // 4


class Accounts:
    """Counts at the moments at which a reader is in no hurry: before it sleeps.

    Args:
        namespace, service: what is read.
        announce: let others see it.
    """

    def __init__(self, namespace: Namespace, service: str, announce: bool) -> None:
        program = os.path.basename(sys.argv[0] or sys.executable)
        self.record = ReaderRecord(service, os.getpid(), program, "on demand")
        self._announcement = Announcement(namespace, service) if announce else None
        self._announced_ns = self._announced_frames = 0
        self._in_loop = False
        self._taken_ns = self._acquired_ns = 0
        self._cpu_ns = 0
        self.settle()

    def begin_loop(self, kind: str) -> None:
        """The reader reads in a loop from now on, whose turns are timed."""
        self.record.kind = kind
        self._in_loop = True

    def taken(self, frame: Frame, lost: int) -> None:
        """A frame is about to be handed out."""
        self._taken_ns, self._acquired_ns = now_ns(), frame.acquired_ns
        self.record.frames += 1
        self.record.lost += lost

    def settle(self) -> None:
        """Count what was done since the last call, and tell everybody now and then."""
        time_ns = now_ns()
        record = self.record
        if self._taken_ns:
            age_ns = self._taken_ns - self._acquired_ns
            record.age.add(age_ns)
            record.age_ms = round(age_ns / 1e6, 3)
            if self._in_loop:
                record.wall.add(time_ns - self._taken_ns)
                cpu_ns = time.thread_time_ns()
                if 0 < self._cpu_ns <= cpu_ns:
                    record.cpu.add(cpu_ns - self._cpu_ns)
                self._cpu_ns = cpu_ns
            self._taken_ns = 0
        passed_ns = time_ns - self._announced_ns
        if passed_ns >= _ANNOUNCE_EVERY_NS and self._announcement is not None:
            if self._announced_ns:
                record.rate_hz = round((record.frames - self._announced_frames) * NS_PER_S / passed_ns, 2)
            self._announcement.write(record)
            self._announced_ns, self._announced_frames = time_ns, record.frames

    def close(self) -> None:
        """Take the announcement back. Idempotent."""
        if self._announcement is not None:
            self._announcement.close()
