"""The writer's end of a service."""

from __future__ import annotations

import contextlib
import inspect
import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Self

import numpy.typing as npt

from skinware.errors import Closed, NameInUse, Paused
from skinware.memory import _layout, _segment
from skinware.memory.announcement import sweep
from skinware.memory.namespace import Namespace, check_name
from skinware.memory.ring import RingWriter
from skinware.memory.schema import Column, Schema
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, Periodic, now_ns
from skinware.service._server import Request, RequestServer
from skinware.service.messages import ACQUIRE

DEFAULT_SLOTS = _layout.DEFAULT_SLOTS
_FILE_CHECK_NS = NS_PER_S

Columns = Mapping[str, Column | tuple[npt.DTypeLike, int | tuple[int, ...]]]
"""Of every array of a frame, by name: dtype and length, or dtype and shape, or all that is known of it."""


class ServiceWriter:
    """The one writer of a service. It never waits for a reader.

    Args:
        name: unique in the namespace, 1 to 47 letters, digits, ``_`` or ``-``.
        columns: of every array of a frame, by name: (dtype, length or shape), or a :class:`Column` that also has a
            unit and a description. A dtype may be a structure.
        static: arrays that are written once and that readers find beside the ring.
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        kind: says what the columns mean (``data``, ``driver``).
        slots: frames that the ring holds, 2 to 64.
        rate_hz: nominal rate, told to readers; None for no fixed rate.
        group: group whose members may read; a namespace that is there already must have it.
        description: of the service, for people.
        operations: what programs may ask for beside a frame: name to function, called in the writer's own loop
            (``periodic``, ``on_request``) with the request's arguments; its docstring's first line describes it.

    Raises:
        NameInUse: a living writer has this name.
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
        slots: int = DEFAULT_SLOTS,
        rate_hz: float | None = None,
        group: str | None = None,
        description: str = "",
        operations: Mapping[str, Callable[..., object]] | None = None,
    ) -> None:
        self.name: str = check_name(name, "service")
        self.namespace: Namespace = Namespace.of(namespace)
        self.missed_periods: int = 0
        self._paused = self._stopping = False
        self._kind = kind
        self._slots = slots
        self._period_ns = round(NS_PER_S / rate_hz) if rate_hz else 0
        self._schema = Schema.of(columns, description)
        self._static = dict(static or {})
        self._operations = dict(operations or {})
        self._group = group
        self._server: RequestServer | None = None
        self.namespace.create(group)
        self._name_lock = _segment.take_name(self.namespace, name)
        try:
            sweep(self.namespace)
            self.namespace.socket_path(name).unlink(missing_ok=True)  # of a predecessor that was killed
            self._ring = self._new_generation()
        except BaseException:
            self._name_lock.close()
            raise

    @property
    def generation(self) -> int:
        """Number of the present generation."""
        return self._ring.segment.generation

    @property
    def sequence(self) -> int:
        """Sequence of the newest frame, 0 before the first."""
        return self._ring.sequence

    @property
    def paused(self) -> bool:
        """Whether ``pause`` was called last."""
        return self._paused

    def pause(self) -> None:
        """Publish nothing until ``resume``; readers and requesters are told. From any thread.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
        """
        self._set_paused(True)

    def resume(self) -> None:
        """Go on after ``pause``. From any thread.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
        """
        self._set_paused(False)

    def begin(self, *, from_last: bool = False) -> dict[str, npt.NDArray[Any]]:
        """Arrays of the next frame, to be filled in place; then ``commit``.

        Args:
            from_last: begin with the contents of the newest frame, to change parts of it only; otherwise the arrays
                hold something old.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
            Paused: it is paused.
            NameInUse: somebody removed the lock of the name, and another writer has it now; this one is closed then.
        """
        if now_ns() >= self._next_file_check_ns:
            self._keep_files()
        if self._paused:
            self._require_open()
            raise Paused(f"service {self.name!r} is paused; call resume() first")
        return self._ring.begin(from_last=from_last)

    def commit(self, acquired_ns: int, flags: int = 0) -> int:
        """Publish the frame: one system call wakes every reader.

        If it raises, readers have the frame before, and ``commit`` or ``begin`` may be called again.

        Args:
            acquired_ns: newest time stamp of the data, CLOCK_MONOTONIC ns. Below 0 (a device's stamp from before this
                machine booted) it counts as 0, and is counted in the statistics (``before_boot``).
            flags: bits for the service's own use.

        Returns:
            The frame's sequence.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
            ServiceError: there was no ``begin`` before it, or the service was restructured since.
            TypeError: ``acquired_ns`` or ``flags`` is no integer.
            ValueError: ``acquired_ns`` does not fit 63 bits, or ``flags`` 64.
        """
        return self._ring.commit(acquired_ns, flags)

    def periodic(self, rate_hz: float, *, from_last: bool = False) -> Iterator[dict[str, npt.NDArray[Any]]]:
        """Yield the arrays of one frame per period, at absolute deadlines; publish when the loop comes back.

        A loop body that takes too long misses periods (``missed_periods``); they are never made up for. While paused
        nothing is yielded. Requests are carried out between two periods.

        Args:
            rate_hz: above 0.
            from_last: as for ``begin``.
        """
        timer = Periodic(rate_hz)
        with self._closing_ends_the_loop():
            while timer.wait(self._must_end):
                if timer.missed > self.missed_periods:
                    self._ring.count_missed_periods(timer.missed - self.missed_periods)
                    self.missed_periods = timer.missed
                waiting = self._carry_out(self.requests())
                if self._paused:
                    continue
                self._ring.count_lateness(now_ns() - (timer.deadline_ns - timer.period_ns))
                yield from self._one_frame(waiting, from_last)

    def on_request(self, *, from_last: bool = False) -> Iterator[dict[str, npt.NDArray[Any]]]:
        """Yield the arrays of one frame whenever a program asks for one; publish when the loop comes back.

        Several requests that wait at the same time are answered with the same frame.

        Args:
            from_last: as for ``begin``.
        """
        with self._closing_ends_the_loop():
            while not self._must_end():
                waiting = self._carry_out(self.requests(WAIT_SLICE_NS / NS_PER_S))
                if waiting and not self._paused:
                    yield from self._one_frame(waiting, from_last)

    def requests(self, timeout_s: float = 0.0) -> list[Request]:
        """What programs ask for, for writers with a loop of their own; each wants its ``reply`` or ``fail``.

        ``acquire`` asks for a frame whose acquisition begins now or later: publish it, then reply with
        ``position=writer.position``. The first call makes the socket (:meth:`request_server`).

        Args:
            timeout_s: longest wait for one.
        """
        return self.request_server().take(timeout_s)

    def request_server(self) -> RequestServer:
        """The socket that requests come by, for event loops: readable when ``requests`` has something to say.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
            NamespaceError: the socket cannot be made.
        """
        self._require_open()
        if self._server is None:
            described = {name: _first_line(function) for name, function in self._operations.items()}
            self._server = RequestServer(self.namespace, self.name, described)
            self._server.paused = self._paused
        return self._server

    @property
    def position(self) -> tuple[int, int]:
        """(generation, sequence) of the newest frame."""
        return self.generation, self.sequence

    def restructure(
        self,
        columns: Columns,
        static: Mapping[str, npt.NDArray[Any]] | None = None,
        *,
        rate_hz: float | None = None,
    ) -> None:
        """Go on under the same name with other columns, as a new generation; readers are told.

        Args:
            columns: as for a new writer.
            static: as for a new writer.
            rate_hz: the nominal rate from now on; None: as before.

        Raises:
            ConfigurationError: columns that the format cannot hold; the old generation then goes on.
            NamespaceError: shared memory is full; the old generation then goes on.
            Closed: this writer was closed, or belongs to the process before a fork.
        """
        self._require_open()
        before = self._schema, self._static, self._period_ns
        try:
            if rate_hz is not None:
                self._period_ns = round(NS_PER_S / rate_hz)
            self._schema, self._static = Schema.of(columns, self._schema.description), dict(static or {})
            ring = self._new_generation()
        except BaseException:
            self._schema, self._static, self._period_ns = before
            raise
        self._ring.segment.descriptor.close()
        self._ring = ring

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

    @property
    def closed(self) -> bool:
        """Whether ``close`` was called, or this is the child of a fork."""
        return self._name_lock.fd < 0

    def close(self) -> None:
        """Withdraw the service and give the name back. Idempotent; in the child of a fork it does nothing."""
        if self.closed:
            return
        path = self.namespace.ring_path(self.name)
        if _segment.current_inode(self.namespace, self.name) == self._ring.segment.inode:
            path.unlink()
        if self._server is not None:
            self._server.close()
        self._ring.set_state(_layout.STATE_CLOSED)
        self._ring.segment.descriptor.close()
        self._name_lock.close()

    def _new_generation(self) -> RingWriter:
        segment = _segment.create(
            self.namespace,
            self.name,
            self._schema,
            self._static,
            slots=self._slots,
            kind=self._kind,
            period_ns=self._period_ns,
        )
        self._next_file_check_ns = now_ns() + _FILE_CHECK_NS
        ring = RingWriter(segment)
        if self._paused:
            ring.set_state(_layout.STATE_PAUSED)
        return ring

    def _set_paused(self, paused: bool) -> None:
        self._require_open()
        self._paused = paused
        self._ring.set_state(_layout.STATE_PAUSED if paused else 0)
        if self._server is not None:
            self._server.paused = paused

    def _one_frame(self, waiting: list[Request], from_last: bool) -> Iterator[dict[str, npt.NDArray[Any]]]:
        """A frame of a loop, which may be paused or closed from another thread at any moment."""
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

    def _carry_out(self, requests: list[Request]) -> list[Request]:
        """Do what is asked for; returns those that want a frame."""
        waiting = []
        for request in requests:
            if request.operation == ACQUIRE:
                waiting.append(request)
                continue
            try:
                result = self._operations[request.operation](**request.arguments)
            except Exception as error:  # noqa: BLE001
                request.fail(f"{request.operation}: {error}")
            else:
                request.reply(result, self.position)
        if self._paused:
            self._refuse(waiting)
        return waiting

    def _require_open(self) -> None:
        if self.closed:
            raise Closed(f"the writer of {self.name!r} was closed, or belongs to the process before a fork")

    def _keep_files(self) -> None:
        """Notice, once a second, that somebody removed our files, and make them again."""
        self._next_file_check_ns = now_ns() + _FILE_CHECK_NS
        if self.closed:
            return  # ``begin`` says so
        if _removed(self._name_lock.fd):
            self.namespace.create(self._group)
            try:
                name_lock = _segment.take_name(self.namespace, self.name)
            except NameInUse:
                self.close()
                raise
            self._name_lock.close()
            self._name_lock = name_lock
            self._renew_server()
        if _removed(self._ring.segment.descriptor.fd):
            ring = self._new_generation()
            self._ring.set_state(_layout.STATE_SUPERSEDED)
            self._ring.segment.descriptor.close()
            self._ring = ring
            self._renew_server()

    def _renew_server(self) -> None:
        if self._server is not None:
            self._server.renew()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r} in {self.namespace.name!r}, sequence {self.sequence}>"


def _removed(fd: int) -> bool:
    return os.fstat(fd).st_nlink == 0


def _first_line(function: Callable[..., object]) -> str:
    return (inspect.getdoc(function) or "").partition("\n")[0]
