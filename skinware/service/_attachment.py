"""Attach to the present generation of a service, and ask its writer."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Generic

import numpy.typing as npt

from skinware.errors import BadServiceFile, Closed, NamespaceError, PeerGone, RequestRefused, ServiceNotFound
from skinware.memory import file_layout, segments
from skinware.memory.namespace import Namespace, check_name
from skinware.memory.ring import ACQUIRED, PUBLISHED, Sample, SampleT
from skinware.memory.ring_reader import RingReader
from skinware.memory.schema import Schema
from skinware.memory.statistics import WriterStatistics, read_statistics
from skinware.realtime import NS_PER_S, Periodic, now_ns
from skinware.service._client import PendingRequest, RequestClient
from skinware.service.messages import OPERATIONS

GENERATION_ENDED = file_layout.STATE_SUPERSEDED | file_layout.STATE_CLOSED

_TELLING_SPAN_NS = NS_PER_S // 2
_HASTE = 2
"""So many times faster than its data came, a writer does not publish for long."""


class Attachment(Generic[SampleT]):
    """Attached to one service by name; goes over to its next generation when the writer comes back."""

    frame_class: type[Any] = Sample

    def __init__(self, name: str, namespace: Namespace | str | None, timeout_s: float | None) -> None:
        self.name: str = check_name(name, "service")
        self.namespace: Namespace = Namespace.of(namespace)
        self._client = RequestClient(self.namespace, name)
        self._closed = False
        self._moved = False
        timer = Periodic(10)
        deadline_ns = None if timeout_s is None else now_ns() + round(timeout_s * NS_PER_S)
        while True:
            try:
                self._ring: RingReader[SampleT] = self._attach()
                break
            except ServiceNotFound:
                if deadline_ns is not None and now_ns() >= deadline_ns:
                    raise
            timer.wait()

    @property
    def writer_statistics(self) -> WriterStatistics:
        """Figures of the writer of the generation that is being read."""
        return read_statistics(self._ring.segment.data)

    @property
    def schema(self) -> Schema:
        """dtype, shape, unit and description of every column, and the service's own description."""
        return self._ring.segment.schema

    @property
    def generation(self) -> int:
        return self._ring.generation

    @property
    def alive(self) -> bool:
        """Whether the writer of the generation that is being read lives (it may still be silent)."""
        return self._ring.segment.writer_lives()

    @property
    def paused(self) -> bool:
        """Whether the writer says that it publishes nothing for now."""
        return bool(self._ring.state & file_layout.STATE_PAUSED)

    @property
    def moved_on(self) -> bool:
        """Whether the writer closed the generation at hand or went over to another; a killed one leaves no mark."""
        return bool(self._ring.state & GENERATION_ENDED)

    @property
    def structure_changed(self) -> bool:
        """Whether the service came back with other columns, so that ``reattach`` is due."""
        return self._moved

    @property
    def kind(self) -> str:
        """Meaning of the service's columns: ``driver``, ``data``."""
        return bytes(self._ring.segment.header["kind"]).decode()

    @property
    def writer_pid(self) -> int:
        """Process id of the writer, in the writer's own pid namespace."""
        return int(self._ring.segment.header["writer_pid"])

    @property
    def slack_ns(self) -> int:
        """How long it takes the writer to go round its ring at its nominal rate, 0 if it has none."""
        return self._ring.period_ns * self._ring.slot_count

    @property
    def missed_periods(self) -> int:
        return self._ring.missed_periods

    def rate_hz(self) -> float | None:
        """Return how often the writer publishes, from the times of the samples that the ring holds.

        None where they are too few: after its start a writer may publish two samples at once and then wait.
        A writer that was held up publishes what has waited at once; then the times of the data count.
        """
        times = [time_ns for _, time_ns in self._ring.times_ns(PUBLISHED)]
        span_ns = times[-1] - times[0] if times else 0
        is_full = len(times) >= self._ring.slot_count - 1  # the writer may be filling the last one
        if not span_ns or (span_ns < _TELLING_SPAN_NS and not is_full):
            return None
        rate_hz = (len(times) - 1) * NS_PER_S / span_ns
        acquired_ns = [time_ns for _, time_ns in self._ring.times_ns(ACQUIRED)]
        intervals_ns = sorted(after - before for before, after in pairwise(acquired_ns))
        usual_ns = intervals_ns[len(intervals_ns) // 2] if intervals_ns else 0
        if span_ns < _TELLING_SPAN_NS and rate_hz * usual_ns > _HASTE * NS_PER_S:
            rate_hz = NS_PER_S / usual_ns
        return round(rate_hz, 3)

    def static(self) -> dict[str, npt.NDArray[Any]]:
        """Return the static columns of the generation that is being read, read-only."""
        return self._ring.segment.static_columns()

    def call(self, operation: str, /, *, timeout_s: float = 5.0, **arguments: Any) -> Any:
        """Have the writer do something that it declares (see ``operations``), and wait for the result.

        Args:
            arguments: of the operation, by name; anything that JSON can hold.

        Raises:
            RequestTimeout: no answer in time; the request is cancelled, but may have been carried out.
            RequestRefused: unknown operation, or the service takes no requests.
            RequestFailed: it went wrong; the message is the writer's.
            Paused: the service is paused.
            PeerGone: its writer is dead, or died or was restarted meanwhile.
            Closed: this reader was closed.
        """
        return self.ask(operation, **arguments).result(timeout_s).result

    def ask(self, operation: str, /, **arguments: Any) -> PendingRequest:
        """Like ``call``, without waiting: the answer is picked up, or the request cancelled, later.

        Raises:
            RequestTimeout: so many requests wait already that this one cannot be sent.
            RequestRefused, PeerGone, Closed: as ``call``.
        """
        self._require_writer()
        try:
            return self._client.send(operation, arguments)
        except RequestRefused:
            self._require_writer()  # it may have been closed meanwhile, with its socket
            raise

    def operations(self, *, timeout_s: float = 5.0) -> dict[str, str]:
        """Return the operations that ``call`` can ask for: descriptions by name.

        Raises:
            RequestTimeout, RequestRefused, PeerGone, Closed: as ``call``.
        """
        return dict(self.call(OPERATIONS, timeout_s=timeout_s))

    def _attach(self, known: RingReader[SampleT] | None = None) -> RingReader[SampleT]:
        segment = segments.attach(self.namespace, self.name)
        if known is not None and _digest(segment) == _digest(known.segment):
            return RingReader(segment, self.frame_class, known.context)
        return RingReader(segment, self.frame_class, self._describe(segment))

    def _describe(self, _attached: segments.Segment) -> object:
        """Return the ``context`` of samples (a subclass reads its structure here); kept while the columns are equal."""
        return None

    def _adopt(self, ring: RingReader[SampleT]) -> None:
        self._ring.segment.close()
        self._ring = ring
        self._moved = False

    def _require_open(self) -> None:
        if self._closed or self._ring.segment.descriptor.fd < 0:
            raise Closed(f"the reader of {self.name!r} was closed, or belongs to the process before a fork")

    def _require_writer(self) -> None:
        if not self._keep_up() and not self._successor_lives():
            unreadable = ", or is one that this program cannot read" if self._moved else ""
            raise PeerGone(f"the writer of {self.name!r} is dead{unreadable}; start it again") from None

    def _keep_up(self) -> bool:
        """Go over to a new generation if there may be one; whether the writer of the present one lives."""
        self._require_open()
        alive = self.alive
        if (self._ring.state & GENERATION_ENDED or not alive) and not self._moved:
            self._follow()
            alive = self.alive
        return alive

    def _follow(self) -> None:
        """Go over to a newer generation if there is one of the same structure; remember if it has another."""
        inode = segments.current_inode(self._ring.segment.path)
        if inode is None or inode == self._ring.segment.inode:
            return
        try:
            ring = self._attach(self._ring)
        except (ServiceNotFound, NamespaceError):
            return
        except BadServiceFile:  # another kind of service, or a format to come: ``reattach`` says what it is
            self._moved = True
            return
        if _digest(ring.segment) == _digest(self._ring.segment):
            self._adopt(ring)
        else:
            ring.segment.close()
            self._moved = True

    def _successor_lives(self) -> bool:
        """Return whether the writer of a generation with another structure lives."""
        if not self._moved:
            return False
        try:
            segment = segments.attach(self.namespace, self.name)
        except (ServiceNotFound, NamespaceError, BadServiceFile):
            return False
        try:
            return segment.writer_lives()
        finally:
            segment.close()


def _digest(segment: segments.Segment) -> bytes:
    return bytes(segment.header["digest"])
