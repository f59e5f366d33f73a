"""A reader's end of a service."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Self

from skinware.errors import Overrun
from skinware.memory.announcement import ReaderRecord
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample, SampleT
from skinware.memory.take import NEWER, NEXT
from skinware.realtime import NS_PER_S, Periodic, now_ns, short_turns
from skinware.service._taking import Position, Taking
from skinware.service.messages import ACQUIRE

_ENDLESS_NS = 1 << 61


class ServiceReader(Taking[SampleT]):
    """Reads one service, and attaches again by itself when the writer comes back.

    Not for several threads at once; make one per thread. Frames of one generation come in order; a reader that is
    slow loses frames (``lost`` counts them exactly, over restarts too) and never disturbs the writer or other readers.

    Args:
        name: the service.
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        timeout_s: how long to wait for the service to appear; 0 for not at all, None for no limit.
        announce: let others see this reader (``skin-info``).

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

    @property
    def lost(self) -> int:
        """Frames that were published since the first one that was taken, and that were not taken.

        Those of generations that came and went meanwhile are counted too: each file tells how many were published under
        the name before it. Only where somebody removed the namespace's files in between, that number is unknown.
        """
        self._settle()
        return self._accounts.record.lost

    @property
    def statistics(self) -> ReaderRecord:
        """What this reader has counted so far: frames, losses, times; what ``skin-info`` shows of it."""
        self._settle()
        return self._accounts.record

    @property
    def latest(self) -> Position | None:
        """Position of the newest frame of the generation at hand, None before the first."""
        sequence = self._ring.latest
        return (self._ring.generation, sequence) if sequence else None

    def refresh(self) -> Position | None:
        """Go over to a newer generation if there is one; position of the newest frame then.

        Reading does so by itself. If the newer one has another structure, ``structure_changed`` says so.

        Raises:
            Closed: this reader was closed, or belongs to the process before a fork.
        """
        self._require_open()
        if not self._moved:
            self._follow()
        return self.latest

    def read(
        self,
        *,
        newer_than: Sample | Position | None = None,
        max_age_s: float | None = None,
        timeout_s: float | None = 5.0,
    ) -> SampleT:
        """The newest frame, as a private copy.

        Args:
            newer_than: wait for a frame that is newer than this one; any frame of a later generation is.
                Default: take what is there, wait only if nothing was published yet.
            max_age_s: wait for a frame whose newest data (``acquired_ns``) is at most this old when it is handed out;
                default: of any age.
            timeout_s: longest wait; None for no limit.

        Raises:
            ServiceTimeout: no such frame came in time; the message says whether the writer lives.
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

    @contextlib.contextmanager
    def view(self) -> Iterator[SampleT]:
        """The newest frame in place, with no copy, for as long as the block lasts.

        The writer may overwrite it meanwhile: ``frame.valid`` says whether it still is whole, and the end of the block
        asks once more. What was computed in the block counts only if that did not raise.

        It counts as taken if it is still valid at the end.

        Raises:
            ServiceTimeout: nothing was published yet.
            Overrun: the frame was overwritten before the end of the block.
            Closed: as ``read``.
        """
        alive = self._keep_up()  # which may replace the ring
        frame = self._checked(self._whole(self._ring.view), alive)
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
                f"frame {frame.sequence} of {self.name!r} was overwritten while it was viewed: be quicker, take a copy"
                " with read(), or give the service more slots"
            )

    def frames(
        self, rate_hz: float | None = None, *, max_age_s: float | None = None, timeout_s: float | None = None
    ) -> Iterator[SampleT]:
        """Newest frames, without end.

        Args:
            rate_hz: None: each time the writer publishes (ASAP). A rate: at the deadlines of that rate, whatever
                is newest then; the same frame comes again if there is no newer one. Without a rate, other threads of
                this process keep the interpreter for 0.1 ms at the most, for as long as the loop lives.
            max_age_s: what is older is not handed out but waited for, as by ``read``; default: any age.
            timeout_s: longest wait for a frame; None for no limit. At a rate there is one to be had without a wait,
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
        return self.frames()

    def in_order(self, *, timeout_s: float | None = None) -> Iterator[SampleT]:
        """Every frame, one after the other, as long as this program keeps up within the ring's slots.

        For recorders and tests; a control loop wants the newest (``frames``). What was overwritten before its turn
        is counted in ``lost``. Other threads of this process keep the interpreter for 0.1 ms at the most, for
        as long as the loop lives.

        Raises:
            ServiceTimeout, StructureChanged, Overrun, Closed: as ``read``.
        """
        self._accounts.begin_loop("in order")
        timeout_ns = _in_ns(timeout_s)
        with short_turns():
            while True:
                yield self._take_turn(NEXT, timeout_ns)

    def request(self, *, timeout_s: float = 5.0) -> SampleT:
        """Ask the writer for a frame, and wait for it: its acquisition begins after the writer heard of it.

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
        """Stop reading and take the announcement back. Frames that were handed out stay readable. Idempotent."""
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
