"""The reader's end of a service: for programs, and for loops of this package over many services."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, Self

from skinware.errors import Overrun, ServiceTimeout
from skinware.memory.announcement import ReaderRecord
from skinware.memory.file_layout import MAX_SLOTS
from skinware.memory.futex import Word
from skinware.memory.namespace import Namespace
from skinware.memory.ring import ACQUIRED, Sample, SampleT
from skinware.memory.ring_reader import NEWER, NEXT, RingReader
from skinware.realtime import NS_PER_S, Periodic, now_ns, short_turns
from skinware.service._taking import Position, Taking
from skinware.service.messages import ACQUIRE

_ENDLESS_NS = 1 << 61
_LEAST_MAY_COME = 4


class ServiceReader(Taking[SampleT]):
    """Reads one service, and attaches again by itself when the writer comes back.

    Not for several threads at once; make one per thread. Samples of one generation come in order; a reader that is
    slow misses samples (``missed`` counts them exactly, over restarts too) and never disturbs the writer or others.

    Args:
        name: the service.
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        timeout_s: how long to wait for the service to appear; 0 for not at all, None for no limit.
        announce: let others see this reader (``skin-info``).

    Attributes:
        is_too_slow: the last ``read_next`` left samples out, since this program cannot catch up.

    Raises:
        ServiceNotFound: it did not appear in time.
        BadServiceFile: its file cannot be read safely.
        NamespaceError: the namespace cannot be trusted or read.
    """

    def __init__(
        self,
        name: str,
        *,
        namespace: Namespace | str | None = None,
        timeout_s: float | None = 0.0,
        announce: bool = True,
    ) -> None:
        super().__init__(name, namespace, timeout_s, announce)
        self.is_too_slow: bool = False
        self._waiting_then, self._may_come = 0, MAX_SLOTS

    @property
    def missed(self) -> int:
        """Samples that were published since the first one that was taken, and that were not taken.

        Those of generations that came and went meanwhile are counted too: each file has the number of samples that
        were published under the name before it. It is unknown only if the namespace's files were removed in between.
        """
        self._settle()
        return self._accounts.record.missed

    @property
    def statistics(self) -> ReaderRecord:
        """Samples, losses and times that this reader has counted so far; ``skin-info`` shows them."""
        self._settle()
        return self._accounts.record

    @property
    def newest_position(self) -> Position | None:
        """Position of the newest sample of the generation at hand, None before the first."""
        sequence = self._ring.latest
        return (self._ring.generation, sequence) if sequence else None

    @property
    def waiting(self) -> int:
        """Samples of the generation at hand after the last one taken; before the first one, only the newest counts."""
        ring, last = self._ring, self._last_taken
        if self._turns_in_c:
            taken: int = ring.state_in_c.last
            return ring.latest - taken
        if last is None:
            return min(ring.latest, 1)
        return ring.latest - (last[1] if last[0] == ring.generation else 0)

    def refresh(self) -> Position | None:
        """Go over to a newer generation if there is one; position of the newest sample then.

        Reading does so by itself. If the newer one has another structure, ``structure_changed`` says so.

        Raises:
            Closed: this reader was closed, or belongs to the process before a fork.
        """
        self._require_open()
        if not self._moved:
            self._follow()
        return self.newest_position

    def read(
        self,
        *,
        newer_than: Sample | Position | None = None,
        max_age_s: float | None = None,
        timeout_s: float | None = 5.0,
    ) -> SampleT:
        """Return the newest sample, as a private copy.

        Args:
            newer_than: wait for a sample that is newer than this one; any sample of a later generation is.
                Default: take what is there, wait only if nothing was published yet.
            max_age_s: wait for a sample whose newest data (``acquired_ns``) is at most this old when it is handed out;
                default: of any age.
            timeout_s: longest wait; None for no limit.

        Raises:
            ServiceTimeout: no such sample came in time; the message says whether the writer lives.
            StructureChanged: the service came back with another structure, or as something that cannot be read; only
                when waiting for newer.
            Overrun: the writer is too fast for this number of slots.
            Closed: this reader was closed, or belongs to the process before a fork.
        """
        known = newer_than.position if isinstance(newer_than, Sample) else newer_than
        timeout_ns = _in_ns(timeout_s)
        if known is not None:
            return self._take_turn(NEWER, timeout_ns, max_age_s, known)
        return self._read(None, max_age_s, now_ns() + timeout_ns)

    def read_next(self, *, timeout_s: float | None = 5.0) -> SampleT:
        """Return the sample after the last one taken, and the newest at first: a program that was held up catches up.

        If half as many more come before it has (at least 4), it is too slow: it gets the newest ones. Each time that
        it has none to catch up with, one more may come the next time. ``missed`` counts what it did not get.

        Raises:
            ServiceTimeout, StructureChanged, Overrun, Closed: as ``read``.
        """
        before, waiting = self._waiting_then, self.waiting
        if waiting == 0:
            self._may_come = min(self._may_come + 1, MAX_SLOTS)
        elif before > 0:
            self._may_come = max(0, self._may_come - max(0, waiting - before))
        elif waiting > 1:
            self._may_come = min(self._may_come, max(_LEAST_MAY_COME, waiting // 2))
        self.is_too_slow = waiting > 1 and self._may_come == 0
        self._waiting_then = 0 if self.is_too_slow else max(0, waiting - 1)
        return self._take_turn(NEWER if self.is_too_slow else NEXT, _in_ns(timeout_s))

    def latest(self) -> SampleT | None:
        """Return the newest sample at once, as a private copy; None if nothing was published yet.

        Raises:
            Overrun, Closed: as ``read``.
        """
        try:
            return self._read(None, None, now_ns())
        except ServiceTimeout:
            return None

    @contextlib.contextmanager
    def view(self) -> Iterator[SampleT]:
        """The newest sample in place, with no copy, for as long as the block lasts.

        The writer may overwrite it meanwhile: ``frame.valid`` says whether it still is whole, and the end of the block
        asks once more. Use the results of the block only if that did not raise.

        It counts as taken if it is still valid at the end.

        Raises:
            ServiceTimeout: nothing was published yet.
            Overrun: the sample was overwritten before the end of the block.
            Closed: as ``read``.
        """
        alive = self._keep_up()  # which may replace the ring
        frame = self._whole(self._ring.view, alive)
        try:
            yield frame
        finally:
            valid = frame.valid
            if valid and (self._last is None or frame.position >= self._last):
                self._count(frame)
                self._end_turn()
        if not valid:
            self._accounts.record.overruns += 1
            raise Overrun(
                f"sample {frame.sequence} of {self.name!r} was overwritten while it was viewed: be quicker, take a copy"
                " with read(), or give the service more slots"
            )

    def samples(
        self, rate_hz: float | None = None, *, max_age_s: float | None = None, timeout_s: float | None = None
    ) -> Iterator[SampleT]:
        """Newest samples, without end.

        Args:
            rate_hz: None: each time the writer publishes (ASAP). A rate: at the deadlines of that rate, whatever
                is newest then; the same sample comes again if there is no newer one. Without a rate, other threads of
                this process keep the interpreter for 0.1 ms at the most, for as long as the loop lives.
            max_age_s: what is older is not handed out but waited for, as by ``read``; default: any age.
            timeout_s: longest wait for a sample; None for no limit. At a rate there is one to be had without a wait,
                unless nothing was published yet or all is older than ``max_age_s``.

        Raises:
            ServiceTimeout, StructureChanged, Overrun, Closed: as ``read``.
        """
        if rate_hz is None:
            self._accounts.begin_loop("asap")
            timeout_ns = _in_ns(timeout_s)
            with short_turns():
                while True:
                    yield self._take_turn(NEWER, timeout_ns, max_age_s)
        self._accounts.begin_loop(f"periodic {rate_hz:g} Hz")
        timer = Periodic(rate_hz)
        while timer.wait(lambda: self._closed):
            self._accounts.record.lateness.add(now_ns() - timer.deadline_ns + timer.period_ns)
            self._accounts.record.missed_periods = timer.missed
            frame = self.read(max_age_s=max_age_s, timeout_s=timeout_s)
            if self._moved:
                raise self._structure_changed()
            yield frame

    def __iter__(self) -> Iterator[SampleT]:
        return self.samples()

    def in_order(self, *, timeout_s: float | None = None) -> Iterator[SampleT]:
        """Every sample, one after the other, as long as this program keeps up within the ring's slots.

        For recorders and tests; a control loop wants the newest (``samples``). Samples that were overwritten before
        their turn are counted in ``missed``. As long as the loop lives, other threads of this process keep the
        interpreter for 0.1 ms at the most.

        Raises:
            ServiceTimeout, StructureChanged, Overrun, Closed: as ``read``.
        """
        self._accounts.begin_loop("in order")
        timeout_ns = _in_ns(timeout_s)
        with short_turns():
            while True:
                yield self._take_turn(NEXT, timeout_ns)

    def request(self, *, timeout_s: float = 5.0) -> SampleT:
        """Ask the writer for a sample, and wait for it: its acquisition begins after the writer heard of it.

        Raises:
            RequestTimeout: no answer in time.
            RequestRefused: the service takes no requests.
            Paused: it is paused.
            PeerGone: its writer is dead, or died or was restarted meanwhile.
            StructureChanged, Overrun, Closed: as ``read``.
        """
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        answer = self.ask(ACQUIRE).result(timeout_s)
        left_s = max(0.0, (deadline_ns - now_ns()) / NS_PER_S)
        return self.read(newer_than=(answer.generation, answer.sequence - 1), timeout_s=left_s)

    def reattach(self) -> None:
        """Go over to the present generation of the service, whatever its structure.

        Raises:
            ServiceNotFound: there is none any more.
            BadServiceFile: its file cannot be read safely, or is another kind of service.
            NamespaceError: the namespace cannot be trusted or read.
        """
        self._adopt(self._attach(self._ring))

    def stop(self) -> None:
        """End a wait in another thread with ``Closed``, within 50 ms; that thread then closes this reader."""
        self._closed = True

    def close(self) -> None:
        """Stop reading and take the announcement back. Samples that were handed out stay readable. Idempotent."""
        self._closed = True
        self._accounts.close()
        self._client.close()
        self._ring.segment.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.name!r} in {self.namespace.name!r}>"


def _in_ns(timeout_s: float | None) -> int:
    return _ENDLESS_NS if timeout_s is None else round(timeout_s * NS_PER_S)


def wake_word_of(reader: ServiceReader[Any]) -> tuple[Word, int]:
    """Return the futex that every publication wakes, and its present value; take it before looking for what is new."""
    ring = reader._ring  # noqa: SLF001
    return ring.wake_word, ring.wake_count


def samples_after(
    reader: ServiceReader[SampleT], position: Position | None, *, in_place: bool = False
) -> Iterator[SampleT]:
    """Yield the samples after a position that the generation at hand has; without a position the newest. Never wait.

    Args:
        in_place: do not copy them; ask ``valid`` of each after using it.
    """
    ring = reader._ring  # noqa: SLF001
    generation, known = position or (ring.generation, ring.latest - 1)
    first, latest = known + 1 if generation == ring.generation else 1, ring.latest
    sequences = range(max(1, first, latest - ring.slot_count + 2), latest + 1)
    yield from filter(None, map(ring.view if in_place else ring.copy, sequences))


class Tap(ServiceReader[SampleT]):
    """A reader whose owner looks for new generations and for the dead, and waits for many readers at once."""

    @property
    def head(self) -> bytes:
        """Bytes of the file that is being read, up to its slots."""
        return self._ring.segment.head

    @property
    def period_ns(self) -> int:
        """The writer's nominal period, 0 if it has none."""
        return self._ring.period_ns

    def ring_in_c(self) -> RingReader[SampleT]:
        if not self._turns_in_c:
            self._leave_to_c()
        return self._ring

    def report(self) -> None:
        """Count the samples taken in C and announce them, if that is due."""
        if now_ns() >= self._accounts.due_ns:
            self._settle()
            self._accounts.end_turn(None)

    @property
    def last_taken(self) -> Position | None:
        return self._last

    def begin_in_order(self, *, with_first: bool) -> None:
        """Read in order from now on, from the first sample of the generation at hand, or else from its newest."""
        self._accounts.begin_loop("in order")
        self._last = (self._ring.generation, 0 if with_first else max(0, self._ring.latest - 1))

    def next_in_order(self) -> SampleT | None:
        """Return the sample after the last one taken, over generations; None if it is not there yet. Never wait."""
        try:
            return self._read_in_order(0)
        except ServiceTimeout:
            return None

    def newest(self) -> SampleT:
        """Return a copy of the newest sample of the generation at hand."""
        return self._newest_now(self._ring.copy, True)

    def newest_acquired_ns(self) -> int:
        return self._acquisitions()[-1][1]

    def nearest(self, time_ns: int) -> SampleT:
        """Return a copy of the sample in the ring whose ``acquired_ns`` is nearest to a time."""
        sequence, _ = min(self._acquisitions(), key=lambda frame: abs(frame[1] - time_ns))
        return self._taken_from_the_past(sequence)

    def around(self, time_ns: int) -> tuple[SampleT, SampleT]:
        """Return copies of the last sample in the ring acquired by a time, and of the next one.

        Where there is none on one side of that time, both are the nearest.
        """
        times = self._acquisitions()
        later = next((number for number, (_, acquired_ns) in enumerate(times) if acquired_ns > time_ns), len(times))
        before, after = max(0, later - 1), min(later, len(times) - 1)
        first = self._taken_from_the_past(times[before][0])
        return first, first if before == after else self._taken_from_the_past(times[after][0])

    def _taken_from_the_past(self, sequence: int) -> SampleT:
        frame = self._ring.copy(sequence)
        if frame is None:
            raise Overrun(f"service {self.name!r}: sample {sequence} was overwritten before it was copied")
        before = self._last
        taken = self._newest_now(lambda: frame, True)
        if before is not None and before > taken.position:  # it came before, and is not missed again
            self._last = before
        return taken

    def _acquisitions(self) -> list[tuple[int, int]]:
        times = self._ring.times_ns(ACQUIRED)
        if not times:
            raise Overrun(f"service {self.name!r}: no sample could be read")
        return times
