"""Publish a recording again, so that readers and services work on it as on the recorded drivers."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Collection
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any

from skinware.errors import BadRecording
from skinware.limits import LIMITS, SLOWEST_REPLAY
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns, short_turns
from skinware.recording.reading import Recording
from skinware.recording.timeline import GONE, Moment
from skinware.transfer.republishing import Republisher

_LATE_NS = 10_000_000
_MOST_BEHIND_NS = 50_000_000
"""A replay that is later than that shifts its time: catching up at once would overrun the rings."""
_FINE_NS = 1_500_000
"""So long before a sample is due, no request is answered: that wait has a resolution of a millisecond."""
_NEAR_S = 1.0
_TIDY_NS = NS_PER_S // 2


class _Tape:
    """Moves along the moments of a recording, and publishes what was newest at each place.

    Args:
        start_s, end_s: the part to publish, s since the recording began.

    Attributes:
        reached_s: time of the last published moment.
    """

    def __init__(
        self,
        recording: Recording,
        names: Collection[str] | None,
        ahead: Executor,
        republisher: Republisher,
        start_s: float,
        end_s: float,
    ) -> None:
        self._recording, self._republisher = recording, republisher
        self._timeline = recording.timeline(names, ahead=ahead)
        self._first_s = self._timeline.first_s()
        self.start_s, self._end_s = start_s, end_s
        self.last_s: float = min(end_s, recording.duration_s)
        self.next: Moment | None = None
        self.reached_s: float = start_s
        self._jumped: set[str] = set()  # services whose next sample does not follow the published one

    @property
    def next_s(self) -> float:
        """Time of the moment that is due next; at the end, the end."""
        return self.last_s if self.next is None else self.next.time_s

    def take_next(self) -> Moment | None:
        """Take the moment that is due next from the timeline, if there is one before the end."""
        if self.next is None:
            self.next = self._timeline.next()
            if self.next is not None and self.next.time_s >= self._end_s:
                self._put_back()
        return self.next

    def publish_next(self) -> Moment | None:
        moment, self.next = self.take_next(), None
        if moment is not None:
            self._apply(moment)
        return moment

    def go_to(self, time_s: float) -> None:
        """Publish what was newest at a time, samples of this very time among it."""
        self._put_back()
        self._timeline.seek(min(math.nextafter(time_s, math.inf), self._end_s))
        self.reached_s = time_s
        self._show(self._timeline.services)

    def step_back(self, samples: int) -> None:
        self._put_back()
        changed: dict[str, None] = {}
        while samples and (moment := self._timeline.back()) is not None:
            if moment.time_s < self.start_s:
                self._timeline.next()
                break
            changed[moment.service] = None
            samples -= moment.frame is not None
        before = self._timeline.back()
        if before is not None:
            self._timeline.next()
        self.reached_s = self.start_s if before is None else max(self.start_s, before.time_s)
        self._show(changed)

    def _put_back(self) -> None:
        if self.next is not None:
            self._timeline.back()
            self.next = None

    def _apply(self, moment: Moment) -> None:
        self.reached_s = moment.time_s
        if moment.frame is None:
            self._republisher.happened(moment.service, moment.event)
        else:
            follows = moment.service not in self._jumped
            self._jumped.discard(moment.service)
            generation = self._recording[moment.service].generation(moment.frame.generation)
            self._republisher.publish(moment.service, moment.frame, generation, follows=follows)

    def _show(self, services: Collection[str]) -> None:
        so_far = self._timeline.so_far(services)
        for name in services:
            self._jumped.add(name)
            moments = so_far.get(name, [])
            if moments[-1].event in GONE if moments else self._first_s.get(name, 0.0) > self.reached_s + _NEAR_S:
                self._republisher.withdraw_later(name)
                continue
            for moment in moments:
                self._apply(moment._replace(time_s=self.reached_s))
            self._jumped.add(name)


class Replayer:
    """Publishes recorded services under the same names, with the same tables, and in the same rhythm.

    Programs may request the operations :meth:`replay`, :meth:`pause`, :meth:`resume`, :meth:`step`, :meth:`seek`,
    :meth:`speed` and :meth:`loop` from any of its services; all services follow. In Python, call them in the thread
    that runs the replay.

    Args:
        speed: 2.0 is twice as fast as recorded.
        start_s: begin at this time, s since the recording began.
        end_s: end before this time; None: at the end of the recording.
        loop: begin again at the end.
        paused: wait for ``resume`` or ``step`` first.
        stays: pause at the end instead of ending.
        keeps_times: keep the recorded times; False: move them to now.

    Attributes:
        late: samples that were published more than 10 ms after their time.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        names: Collection[str] | None = None,
        namespace: Namespace | str | None = None,
        speed: float = 1.0,
        start_s: float = 0.0,
        end_s: float | None = None,
        loop: bool = False,
        paused: bool = False,
        stays: bool = False,
        keeps_times: bool = False,
    ) -> None:
        self._recording = recording
        _check_rings(recording, recording.services if names is None else names)
        self._ahead = ThreadPoolExecutor(1, "skinware replay")
        self._loops, self._paused, self._stays = loop, paused, stays
        operations = (self.replay, self.pause, self.resume, self.step, self.seek, self.speed, self.loop)
        self._republisher = Republisher(
            Namespace.of(namespace), {call.__name__: call for call in operations}, keeps_times=keeps_times
        )
        self._republisher.speed = speed
        self._republisher.pause(paused)
        until_s = math.inf if end_s is None else end_s
        self._tape = _Tape(recording, names, self._ahead, self._republisher, start_s, until_s)
        self._from_s, self._from_ns = start_s, now_ns()
        self._turned = 0
        self._goes_on = False
        self._stopping = False
        self._report_ns = self._tidy_ns = 0
        self.late: int = 0

    @property
    def time_s(self) -> float:
        """Position in the recording, s since it began."""
        if self._paused:
            return self._from_s
        passed_s = self._from_s + (now_ns() - self._from_ns) / NS_PER_S * self._republisher.speed
        return max(self._tape.reached_s, min(passed_s, self._tape.next_s))

    @property
    def frames(self) -> Counter[str]:
        return self._republisher.frames

    def run(self, report: Callable[[], object] = lambda: None, every_s: float = 1.0) -> None:
        """Publish the recording, until its end or until ``stop``.

        Args:
            report: called about every ``every_s``.

        Raises:
            NameInUse: a running driver or service has one of the names.
            NamespaceError: the namespace cannot be used, or shared memory is full.
        """
        tape = self._tape
        if tape.start_s > self._recording.duration_s:
            return
        with short_turns():
            self._go_to(tape.start_s)
            if self._paused and not self.frames:  # programs that are to resume it must find its services
                self.step()
            while not self._stopping:
                if self._paused:
                    self._wait(now_ns() + WAIT_SLICE_NS, report, every_s)
                    continue
                tape.take_next()
                ahead_s = (tape.next_s - self._from_s) / self._republisher.speed
                due_ns = self._from_ns + round(ahead_s * NS_PER_S)
                if not self._wait(due_ns, report, every_s) or self._paused:
                    continue
                behind_ns = now_ns() - due_ns
                moment = tape.publish_next()
                if moment is None:
                    if not self._end():
                        return
                    continue
                if behind_ns > _MOST_BEHIND_NS:
                    self._from_ns += behind_ns
                self.late += moment.frame is not None and behind_ns > _LATE_NS
                self._goes_on = True

    def stop(self) -> None:
        """End the replay; from any thread or signal handler."""
        self._stopping = True

    def close(self) -> None:
        self._ahead.shutdown()
        self._republisher.close()

    def watch(self, fd: int, call: Callable[[], object]) -> None:
        """Call a function whenever a descriptor can be read, while the replay runs."""
        self._republisher.watch(fd, call)

    def unwatch(self, fd: int) -> None:
        self._republisher.unwatch(fd)

    # -- operations -----------------------------------------------------------------------------------------------

    def replay(self) -> dict[str, Any]:
        """Return the file, time_s, duration_s, speed, late, and whether the replay is paused and loops."""
        return {
            "file": str(self._recording.path),
            "time_s": self.time_s,
            "duration_s": self._recording.duration_s,
            "speed": self._republisher.speed,
            "paused": self._paused,
            "loop": self._loops,
            "late": self.late,
        }

    def pause(self) -> dict[str, Any]:
        """Pause, and return what :meth:`replay` does."""
        self._set_paused(True, self.time_s)
        return self.replay()

    def resume(self) -> dict[str, Any]:
        """Resume after a pause, and return what :meth:`replay` does."""
        self._set_paused(False, self.time_s)
        return self.replay()

    def step(self, frames: int = 1) -> dict[str, Any]:
        """Pause, publish the next samples (below 0: go back), and return what :meth:`replay` does."""
        if _number(frames, "frames") != int(frames) or not frames:
            raise ValueError(f"frames={frames!r}: give a whole number, below 0 to go back")
        self._set_paused(True, self.time_s)
        if frames < 0:
            self._tape.step_back(-frames)
        while frames > 0 and (moment := self._tape.publish_next()) is not None:
            frames -= moment.frame is not None
        self._from_now(self._tape.reached_s)
        return self.replay()

    def seek(self, time_s: float) -> dict[str, Any]:
        """Go to a time, publish the newest samples then, and return what :meth:`replay` does.

        Args:
            time_s: since the recording began.
        """
        time_s = _number(time_s, "time_s")
        self._go_to(min(max(time_s, self._tape.start_s), self._tape.last_s))
        return self.replay()

    def speed(self, factor: float) -> dict[str, Any]:
        """Set the speed as a multiple of the recording's, and return what :meth:`replay` does."""
        factor = _number(factor, "factor")
        if not factor >= SLOWEST_REPLAY:
            raise ValueError(f"factor={factor!r}: a speed is at least {SLOWEST_REPLAY}; 1 is that of the recording")
        self._from_now(self.time_s)
        self._republisher.speed = factor
        return self.replay()

    def loop(self, on: bool = True) -> dict[str, Any]:
        """Switch looping on or off, and return what :meth:`replay` does."""
        self._loops = bool(on)
        return self.replay()

    def _go_to(self, time_s: float) -> None:
        self._tape.go_to(time_s)
        self._from_now(time_s)

    # -- time -----------------------------------------------------------------------------------------------------

    def _from_now(self, time_s: float) -> None:
        """Continue from a time in the recording, and end the wait for the next moment."""
        self._from_ns, self._from_s = now_ns(), time_s
        self._turned += 1

    def _wait(self, due_ns: int, report: Callable[[], object], every_s: float) -> bool:
        """Wait until a time, and answer requests; return False if one of them, or ``stop``, ended the wait."""
        turned = self._turned
        while not self._stopping and self._turned == turned:
            time_ns = now_ns()
            if time_ns >= self._report_ns:
                self._report_ns = time_ns + round(every_s * NS_PER_S)
                report()
            if time_ns >= self._tidy_ns:
                self._tidy_ns = time_ns + _TIDY_NS
                self._republisher.tidy()
            left_ns = due_ns - now_ns()
            if left_ns <= 0:
                return True
            if left_ns > _FINE_NS:
                self._republisher.answer(min(left_ns - _FINE_NS, WAIT_SLICE_NS) / NS_PER_S)
            else:
                time.sleep(left_ns / NS_PER_S)
        return False

    def _end(self) -> bool:
        """Loop or pause at the end; return False if the replay is over."""
        if self._loops and self._goes_on:
            self._goes_on = False
            self._go_to(self._tape.start_s)
        elif self._stays:
            self._set_paused(True, self._tape.last_s)
        else:
            return False
        return True

    def _set_paused(self, paused: bool, time_s: float) -> None:
        self._paused = paused
        self._republisher.pause(paused)
        self._from_now(time_s)


def _check_rings(recording: Recording, names: Collection[str]) -> None:
    whole = 0
    for name in names:
        ring = max((generation.ring_size for generation in recording[name].generations), default=0)
        whole += ring
        if ring > LIMITS.ring_size or whole > LIMITS.robot_size:
            most = f"{LIMITS.ring_size} bytes, and {LIMITS.robot_size} of all services together"
            raise BadRecording(f"{recording.path}: {name!r} needs a ring of {ring} bytes; at most {most} are published")


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name}={value!r}: give a number")
    return float(value)
