"""The writer's end of a service."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import Any, Self

import numpy.typing as npt

from skinware.memory import _layout, _segment
from skinware.memory.announcement import sweep
from skinware.memory.namespace import Namespace, check_name
from skinware.memory.ring import RingWriter
from skinware.realtime import NS_PER_S, Periodic, now_ns

DEFAULT_SLOTS = _layout.DEFAULT_SLOTS
_FILE_CHECK_NS = NS_PER_S


class ServiceWriter:
    """The one writer of a service. It never waits for a reader.

    Args:
        name: unique in the namespace, 1 to 47 letters, digits, ``_`` or ``-``.
        columns: (dtype, length) of every array of a frame.
        static: arrays that are written once and that readers find beside the ring.
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        kind: says what the columns mean (``data``, ``driver``).
        slots: frames that the ring holds, 2 to 64.
        rate_hz: nominal rate, told to readers; None for no fixed rate.
        group: group whose members may read, if the namespace is made now.

    Raises:
        NameInUse: a living writer has this name.
        NamespaceError: the namespace cannot be used, or shared memory is full.
        ConfigurationError: a bad name, slot count or column.
    """

    def __init__(
        self,
        name: str,
        columns: Mapping[str, tuple[npt.DTypeLike, int]],
        static: Mapping[str, npt.NDArray[Any]] | None = None,
        *,
        namespace: Namespace | None = None,
        kind: str = "data",
        slots: int = DEFAULT_SLOTS,
        rate_hz: float | None = None,
        group: str | None = None,
    ) -> None:
        self.name = check_name(name, "service")
        self.namespace = namespace or Namespace()
        self.missed_periods = 0
        self._kind = kind
        self._slots = slots
        self._period_ns = round(NS_PER_S / rate_hz) if rate_hz else 0
        self._columns = dict(columns)
        self._static = dict(static or {})
        self.namespace.create(group)
        self._name_lock = _segment.take_name(self.namespace, name)
        try:
            sweep(self.namespace)
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

    def begin(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays of the next frame, to be filled in place; then ``commit``.

        Raises:
            Closed: this writer was closed, or belongs to the process before a fork.
        """
        if now_ns() >= self._next_file_check_ns:
            self._keep_file()
        return self._ring.begin()

    def commit(self, acquired_ns: int, flags: int = 0) -> int:
        """Publish the frame: one system call wakes every reader.

        Args:
            acquired_ns: newest time stamp of the data, CLOCK_MONOTONIC ns.
            flags: bits for the service's own use.

        Returns:
            The frame's sequence.
        """
        return self._ring.commit(acquired_ns, flags)

    def periodic(self, rate_hz: float) -> Iterator[dict[str, npt.NDArray[Any]]]:
        """Yield the arrays of one frame per period, at absolute deadlines; publish when the loop comes back.

        A loop body that takes too long misses periods (``missed_periods``); they are never made up for.
        """
        timer = Periodic(rate_hz)
        while timer.wait(lambda: self.closed):
            if timer.missed > self.missed_periods:
                self._ring.count_missed_periods(timer.missed - self.missed_periods)
                self.missed_periods = timer.missed
            acquired_ns = now_ns()
            yield self.begin()
            self.commit(acquired_ns)

    def restructure(
        self, columns: Mapping[str, tuple[npt.DTypeLike, int]], static: Mapping[str, npt.NDArray[Any]]
    ) -> None:
        """Go on under the same name with other columns, as a new generation; readers are told.

        Raises:
            ConfigurationError: columns that the format cannot hold; the old generation then goes on.
            NamespaceError: shared memory is full; the old generation then goes on.
        """
        before = self._columns, self._static
        self._columns, self._static = dict(columns), dict(static)
        try:
            ring = self._new_generation()
        except BaseException:
            self._columns, self._static = before
            raise
        self._ring.segment.descriptor.close()
        self._ring = ring

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
        self._ring.set_state(_layout.STATE_CLOSED)
        self._ring.segment.descriptor.close()
        self._name_lock.close()

    def _new_generation(self) -> RingWriter:
        layout = _layout.plan(self._static, self._columns, self._slots)
        segment = _segment.create(
            self.namespace, self.name, layout, self._static, kind=self._kind, period_ns=self._period_ns
        )
        self._next_file_check_ns = now_ns() + _FILE_CHECK_NS
        return RingWriter(segment)

    def _keep_file(self) -> None:
        """Notice, once a second, that somebody removed our file, and make it again."""
        self._next_file_check_ns = now_ns() + _FILE_CHECK_NS
        fd = self._ring.segment.descriptor.fd
        if fd >= 0 and os.fstat(fd).st_nlink == 0:
            self.namespace.create()
            ring = self._new_generation()
            self._ring.set_state(_layout.STATE_SUPERSEDED)
            self._ring.segment.descriptor.close()
            self._ring = ring

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r} in {self.namespace.name!r}, sequence {self.sequence}>"
