"""The writer's end of a service."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Self

import numpy.typing as npt

from skinware.errors import Closed, Paused
from skinware.memory.namespace import Namespace
from skinware.memory.schema import Schema
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, Periodic, now_ns
from skinware.service._ownership import Columns, Ownership
from skinware.service._server import Request
from skinware.service.messages import ACQUIRE

_LONGEST_WAIT_S = 1.0


class Writer(Ownership):
    """Publish the samples of a service; it never waits for a reader."""

    missed_periods: int = 0
    _stopping = False

    def begin(
        self, *, from_last: bool = False, skip: int = 0, contents: memoryview | None = None
    ) -> dict[str, npt.NDArray[Any]]:
        """Arrays of the next sample, to be filled in place; then ``commit``.

        Args:
            from_last: begin with the contents of the newest sample, to change parts of it only; otherwise the arrays
                hold something old.
            skip: sequences before this sample that are left out, where a program passes samples on and some did not
                arrive: readers count them as missed. It may become one more: the newest sample stays readable.
            contents: a slot of a service with the same columns (``Sample.slot``), to begin with.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
            Paused: it is paused.
            NameInUse: somebody removed the lock of the name, and another writer has it now; this one is closed then.
        """
        self.keep_files()
        if self._paused:
            self._require_open()
            raise Paused(f"service {self.name!r} is paused; call resume() first")
        return self._ring.begin(from_last=from_last, skip=skip, contents=contents)

    def commit(self, acquired_ns: int, flags: int = 0) -> int:
        """Publish the sample: one system call wakes every reader.

        If it raises, readers have the sample before, and ``commit`` or ``begin`` may be called again.

        Args:
            acquired_ns: newest time stamp of the data, CLOCK_MONOTONIC ns. Below 0 (a device's stamp from before this
                machine booted) it counts as 0, and is counted in the statistics (``before_boot``). More than 0.2 s in
                the future it stays as it is, and is counted there (``ahead``): nothing in such a sample is fresh.
            flags: bits for the service's own use.

        Returns:
            The sample's sequence.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
            ServiceError: there was no ``begin`` before it, or the service was restructured since.
            TypeError: ``acquired_ns`` or ``flags`` is no integer.
            ValueError: ``acquired_ns`` does not fit 63 bits, or ``flags`` 64.
        """
        return self._ring.commit(acquired_ns, flags)

    def periodic(self, rate_hz: float, *, from_last: bool = False) -> Iterator[dict[str, npt.NDArray[Any]]]:
        """Yield the arrays of one sample per period, at absolute deadlines; publish when the loop comes back.

        A loop body that takes too long misses periods (``missed_periods``); they are never made up for. While paused
        nothing is yielded. Requests are carried out between two periods.

        Args:
            rate_hz: above 0.
            from_last: as for ``begin``.
        """
        timer = Periodic(rate_hz)
        self.request_server().fit_into(timer.period_ns)
        with self._closing_ends_the_loop():
            while timer.wait(self._must_end):
                if timer.missed > self.missed_periods:
                    self._ring.count_missed_periods(timer.missed - self.missed_periods)
                    self.missed_periods = timer.missed
                waiting = self.answer_requests()
                if self._paused:
                    continue
                self._ring.count_lateness(now_ns() - (timer.deadline_ns - timer.period_ns))
                yield from self._one_frame(waiting, from_last)

    def on_request(self, *, from_last: bool = False) -> Iterator[dict[str, npt.NDArray[Any]]]:
        """Yield the arrays of one sample whenever a program asks for one; publish when the loop comes back.

        Several requests that wait at the same time are answered with the same sample.

        Args:
            from_last: as for ``begin``.
        """
        with self._closing_ends_the_loop():
            while not self._must_end():
                waiting = self.answer_requests(WAIT_SLICE_NS / NS_PER_S)
                if waiting and not self._paused:
                    yield from self._one_frame(waiting, from_last)

    def requests(self, timeout_s: float = 0.0) -> list[Request]:
        """Return the requests of programs, for writers with a loop of their own; each needs ``reply`` or ``fail``.

        ``acquire`` asks for a sample whose acquisition begins now or later: publish it, then reply with
        ``position=writer.position``. The first call makes the socket (:meth:`request_server`).

        Args:
            timeout_s: longest wait for one.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
            NamespaceError: the socket cannot be made.
            NameInUse: as ``keep_files``.
        """
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        while True:
            self.keep_files()
            left_s = max(0.0, (deadline_ns - now_ns()) / NS_PER_S)
            found = self.request_server().take(min(left_s, _LONGEST_WAIT_S))
            if found or left_s <= _LONGEST_WAIT_S:
                return found

    def answer_requests(self, timeout_s: float = 0.0) -> list[Request]:
        """Carry out the operations that are asked for, within the time of one turn, as the loops above do.

        Args:
            timeout_s: longest wait for the first request.

        Returns:
            Those that ask for a sample (``acquire``), for a ``reply`` as in :meth:`requests`; none while paused.

        Raises:
            Closed, NamespaceError, NameInUse: as for :meth:`requests`.
        """
        self.keep_files()
        server = self.request_server()
        waiting: list[Request] = []
        found = server.take(timeout_s, at_most=1)
        end_ns = now_ns() + server.turn_ns
        while found:
            (request,) = found
            if request.operation == ACQUIRE:
                waiting.append(request)
            else:
                try:
                    result = self._operations[request.operation](**request.arguments)
                except Exception as error:  # noqa: BLE001
                    request.fail(f"{request.operation}: {error}")
                else:
                    request.reply(result, self.position)
            found = server.take(at_most=1) if now_ns() < end_ns else []
        if not self._paused:
            return waiting
        self._refuse(waiting)
        return []

    def stop(self) -> None:
        """End ``periodic`` or ``on_request`` in another thread, within 50 ms; that thread then closes this writer."""
        self._stopping = True

    def _must_end(self) -> bool:
        return self._stopping or self.closed

    @contextlib.contextmanager
    def _closing_ends_the_loop(self) -> Iterator[None]:
        """Another thread may close this writer between any two steps of a loop."""
        try:
            yield
        except Closed:
            if not self.closed:
                raise

    def _one_frame(self, waiting: list[Request], from_last: bool) -> Iterator[dict[str, npt.NDArray[Any]]]:
        """Yield a sample of a loop, which may be paused or closed from another thread at any moment."""
        acquired_ns = now_ns()
        try:
            columns = self.begin(from_last=from_last)
        except Paused:
            self._refuse(waiting)
            return
        ring = self._ring
        yield columns
        if self.closed:
            return
        if self._paused:
            self._refuse(waiting)
            return
        if self._ring is not ring:  # restructured: what was filled belongs to the generation before
            for request in waiting:
                request.fail("the service changed its structure meanwhile; ask again")
            return
        self.commit(acquired_ns)
        for request in waiting:
            request.reply(position=self.position)

    def _refuse(self, waiting: list[Request]) -> None:
        for request in waiting:
            request.fail("the service is paused", "paused")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r} in {self.namespace.name!r}, sequence {self.sequence}>"


class ServiceWriter(Writer):
    """Publishes a service; each service has one writer. It never waits for a reader.

    Args:
        name: unique in the namespace, 1 to 47 letters, digits, ``_`` or ``-``.
        columns: the arrays of a sample, by name: (dtype, length or shape), or a :class:`Column` that also has a
            unit and a description. A dtype may be a structure.
        static: arrays that are written once, for readers, besides the samples.
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        kind: of the service (``data``, ``driver``).
        slots: samples that the ring holds, 2 to 64; default: those of a second at ``rate_hz``, but at least 8, at most
            64, and not more than 16 MiB; 8 where there is no rate.
        rate_hz: nominal rate, for readers; None for no fixed rate.
        group: group whose members may read; an existing namespace must have the same.
        description: of the service, for people.
        operations: what programs may ask for besides a sample: name to function, called in the writer's own loop
            (``periodic``, ``on_request``) with the request's arguments; its docstring's first line describes it.
        published_before: samples that were published under this name before, for a program that passes samples on
            and counts as their origin does; None: the count in the files of the name.

    Raises:
        NameInUse: a running writer has this name.
        NamespaceError: the namespace cannot be used, or shared memory is full.
        ConfigurationError: a bad name, slot count or column.
    """

    def __init__(
        self,
        name: str,
        columns: Columns,
        static: Mapping[str, npt.NDArray[Any]] | None = None,
        *,
        namespace: Namespace | str | None = None,
        kind: str = "data",
        slots: int | None = None,
        rate_hz: float | None = None,
        group: str | None = None,
        description: str = "",
        operations: Mapping[str, Callable[..., object]] | None = None,
        published_before: int | None = None,
    ) -> None:
        super().__init__(
            name,
            namespace,
            schema=Schema.of(columns, description),
            static=static or {},
            kind=kind,
            slots=slots,
            period_ns=round(NS_PER_S / rate_hz) if rate_hz else 0,
            group=group,
            operations=operations or {},
            published_before=published_before,
        )

    def restructure(
        self,
        columns: Columns,
        static: Mapping[str, npt.NDArray[Any]] | None = None,
        *,
        rate_hz: float | None = None,
        skip: int = 0,
    ) -> None:
        """Go on under the same name with other columns, as a new generation; readers notice it.

        Args:
            columns: as for a new writer.
            static: as for a new writer.
            rate_hz: the nominal rate from now on; None: as before.
            skip: samples before its first one that are left out; readers count them as missed.

        Raises:
            ConfigurationError: columns that the format cannot hold; the old generation then goes on.
            NamespaceError: shared memory is full; the old generation then goes on.
            Closed: this writer was closed, or belongs to the process before a fork.
        """
        self._succeed(Schema.of(columns, self._ring.segment.schema.description), static or {}, rate_hz, skip)
