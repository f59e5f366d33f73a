"""The skin as a user sees it: all living drivers of a namespace as one, whatever comes and goes."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverFrame, DriverReader
from skinware.errors import (
    BadServiceFile,
    Closed,
    Overrun,
    ServiceNotFound,
    ServiceTimeout,
    StructureError,
)
from skinware.memory import futex, segments
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, Periodic, now_ns
from skinware.structure import Index, Structure

log = logging.getLogger("skinware.skin")

_DISCOVERY_NS = NS_PER_S // 5
_POLL_NS = 1_000_000
_REFUSED_FOR_NS = 10 * NS_PER_S

Told = Callable[[str, Structure], object]
"""Called with a driver's name and a structure."""


@dataclass(frozen=True, eq=False)
class SkinLayout:
    """Which drivers the skin is made of at a time. A hot-plug makes a new one; this one never changes.

    Attributes:
        drivers: names, sorted; the order of everything below.
        structures: one per driver.
    """

    drivers: tuple[str, ...]
    structures: tuple[Structure, ...]

    @cached_property
    def types(self) -> tuple[str, ...]:
        """Names of all sensor types, in order of first appearance."""
        return tuple(dict.fromkeys(t.name for structure in self.structures for t in structure.types))

    @cached_property
    def _parts(self) -> dict[str, list[tuple[int, Index]]]:
        return {
            name: [
                (driver, structure.index(name))
                for driver, structure in enumerate(self.structures)
                if any(t.name == name for t in structure.types)
            ]
            for name in self.types
        }

    def parts(self, type_name: str) -> list[tuple[int, Index]]:
        """Where the sensors of a type are: (driver, positions in that driver's frame), in order.

        Raises:
            StructureError: no driver has such sensors; the message lists the types there are.
        """
        try:
            return self._parts[type_name]
        except KeyError:
            there_are = ", ".join(self.types) or "none (no driver runs)"
            raise StructureError(f"no sensor type {type_name!r} in this skin; it has: {there_are}") from None

    def uids(self, type_name: str) -> npt.NDArray[np.uint64]:
        """(n,) uint64: uid of every sensor of a type, in the order of ``Snapshot.physical``."""
        parts = self.parts(type_name)
        return np.concatenate([self.structures[driver].sensor_uid[index] for driver, index in parts])

    def driver_of(self, type_name: str) -> npt.NDArray[np.int64]:
        """(n,) int64: index into ``drivers`` of every sensor of a type, in the same order."""
        return np.concatenate(
            [np.full(len(self.structures[driver].sensor_uid[index]), driver) for driver, index in self.parts(type_name)]
        )

    def position(self, type_name: str, uid: int, driver: str | None = None) -> int:
        """Where a sensor is in the order of ``Snapshot.physical``.

        Args:
            type_name: its type.
            uid: its uid, unique among the sensors of that type of one driver.
            driver: which driver's, where several have it.

        Raises:
            StructureError: there is none, or several drivers have one.
        """
        found = self._positions(type_name).get(uid, [])
        if driver is not None:
            of = self.driver_of(type_name)
            found = [position for position in found if self.drivers[of[position]] == driver]
        if len(found) == 1:
            return found[0]
        whose = f" of driver {driver!r}" if driver is not None else ""
        if not found:
            raise StructureError(f"no {type_name!r} sensor with uid {uid:#x}{whose} in this skin")
        names = ", ".join(self.drivers[self.driver_of(type_name)[position]] for position in found)
        raise StructureError(f"several drivers have a {type_name!r} sensor with uid {uid:#x}: {names}; say which")

    def _positions(self, type_name: str) -> dict[int, list[int]]:
        if type_name not in self._by_uid:
            positions: dict[int, list[int]] = {}
            for position, uid in enumerate(self.uids(type_name).tolist()):
                positions.setdefault(uid, []).append(position)
            self._by_uid[type_name] = positions
        return self._by_uid[type_name]

    @cached_property
    def _by_uid(self) -> dict[str, dict[int, list[int]]]:
        return {}

    def __repr__(self) -> str:
        sensors = sum(structure.n_sensors for structure in self.structures)
        return f"<SkinLayout {', '.join(self.drivers) or 'no driver'}: {sensors} sensors>"


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The newest frame of every driver. Each is coherent in itself; between drivers, compare the times.

    Attributes:
        layout: which drivers; the same object as long as nothing was plugged in or out.
        frames: one per driver of ``layout``.
    """

    layout: SkinLayout
    frames: tuple[DriverFrame, ...]

    def values(self, type_name: str) -> npt.NDArray[Any]:
        """(n,) raw values of all sensors of a type, of the narrowest dtype that holds those of every driver.

        Raises:
            StructureError: no driver has such sensors.
        """
        return np.concatenate([self.frames[driver].values[index] for driver, index in self.layout.parts(type_name)])

    def physical(self, type_name: str) -> npt.NDArray[np.float32]:
        """(n,) float32 values of all sensors of a type, each in its own driver's unit and scale.

        Raises:
            StructureError: no driver has such sensors.
        """
        return np.concatenate([self.frames[driver].physical(type_name) for driver, _ in self.layout.parts(type_name)])

    def status(self, type_name: str) -> npt.NDArray[np.uint8]:
        """(n,) uint8 status of all sensors of a type; 0 = fresh and good.

        Raises:
            StructureError: no driver has such sensors.
        """
        return np.concatenate([self.frames[driver].status[index] for driver, index in self.layout.parts(type_name)])

    @property
    def acquired_ns(self) -> npt.NDArray[np.int64]:
        """(n_drivers,) int64: time of the newest data of each driver, CLOCK_MONOTONIC ns."""
        return np.array([frame.acquired_ns for frame in self.frames], np.int64)


class Skin:
    """All living drivers of a namespace as one skin; drivers may come and go at any time.

    A driver joins with its first frame, and leaves when it stops or dies. The change happens between two snapshots,
    never within one. Not for several threads at once.

    A callback that raises is logged, and everything else goes on.

    Args:
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        on_attach: called with a driver's name and structure when it joins, before the first snapshot that has it.
        on_detach: called with its name and last structure when it leaves.
        on_structure: called with its name and new structure when it came back with another one.

    Raises:
        ConfigurationError: a bad namespace name in the environment.
    """

    def __init__(
        self,
        namespace: Namespace | str | None = None,
        *,
        on_attach: Told | None = None,
        on_detach: Told | None = None,
        on_structure: Told | None = None,
    ) -> None:
        self.namespace: Namespace = Namespace.of(namespace)
        self._on_attach, self._on_detach, self._on_structure = on_attach, on_detach, on_structure
        self._readers: dict[str, DriverReader] = {}
        self._refused: dict[str, tuple[tuple[int, int], int]] = {}  # which file, and when to look at it again
        self._layout = SkinLayout((), ())
        self._next_discovery_ns = self._next_look_ns = 0
        self._closed = False

    @property
    def layout(self) -> SkinLayout:
        """The present layout; looks for new and dead drivers."""
        self._discover()
        return self._layout

    def reader(self, driver: str) -> DriverReader:
        """The reader behind one driver, for its counters and losses.

        Raises:
            ServiceNotFound: no such driver in this skin now.
        """
        try:
            return self._readers[driver]
        except KeyError:
            there_are = ", ".join(self._readers) or "none"
            raise ServiceNotFound(f"no driver {driver!r} in this skin now; it has: {there_are}") from None

    def read(self, *, newer_than: Snapshot | None = None, timeout_s: float | None = 5.0) -> Snapshot:
        """The newest frame of every living driver.

        Args:
            newer_than: wait until a driver has published something newer, came or went. Default: take what is
                there, and wait only if there is no driver.
            timeout_s: longest wait; None for ever.

        Raises:
            ServiceTimeout: no driver, or nothing newer, in time.
            NamespaceError: the namespace cannot be trusted or read.
            Closed: this skin was closed.
        """
        deadline_ns = None if timeout_s is None else now_ns() + round(timeout_s * NS_PER_S)
        while True:
            if self._closed:
                raise Closed("this skin was closed")
            if now_ns() >= self._next_look_ns or self._moved_on():
                self._discover()
            words = [reader.wake_word() for reader in self._readers.values()]
            if self._readers and self._is_newer(newer_than):
                snapshot = self._snapshot()
                if snapshot is not None:
                    return snapshot
            time_ns = now_ns()
            if deadline_ns is not None and time_ns >= deadline_ns:
                raise ServiceTimeout(self._why_nothing_came())
            until_ns = time_ns + WAIT_SLICE_NS
            _sleep_on(words, until_ns if deadline_ns is None else min(until_ns, deadline_ns))

    def _moved_on(self) -> bool:
        """Whether a driver has told that it closed, or published something else; who was killed is found by looking."""
        return any(reader.peek() is None for reader in self._readers.values())

    def frames(self, rate_hz: float | None = None, *, timeout_s: float | None = None) -> Iterator[Snapshot]:
        """Snapshots for ever: whenever any driver publishes, or at the deadlines of a rate.

        Raises:
            ServiceTimeout, NamespaceError, Closed: as ``read``.
        """
        snapshot: Snapshot | None = None
        if rate_hz is None:
            while True:
                snapshot = self.read(newer_than=snapshot, timeout_s=timeout_s)
                yield snapshot
        timer = Periodic(rate_hz)
        while timer.wait(lambda: self._closed):
            yield self.read(timeout_s=timeout_s)

    def __iter__(self) -> Iterator[Snapshot]:
        return self.frames()

    def stop(self) -> None:
        """End a wait in another thread with ``Closed``, within 50 ms; that thread then closes this skin."""
        self._closed = True

    def close(self) -> None:
        """Detach from all drivers; snapshots stay readable. Idempotent."""
        self._closed = True
        for reader in self._readers.values():
            reader.close()
        self._readers = {}

    def _discover(self) -> None:
        self._next_look_ns = now_ns() + WAIT_SLICE_NS
        for name in [name for name, reader in self._readers.items() if not self._still_there(reader)]:
            self._readers.pop(name).close()
        if now_ns() >= self._next_discovery_ns:
            self._next_discovery_ns = now_ns() + _DISCOVERY_NS
            for name in self.namespace.services():
                reader = None if name in self._readers else self._attach(name)
                if reader is not None:
                    self._readers[name] = reader
            self._readers = dict(sorted(self._readers.items()))
        drivers = tuple(self._readers)
        structures = tuple(reader.structure for reader in self._readers.values())
        if drivers != self._layout.drivers or any(
            a is not b for a, b in zip(structures, self._layout.structures, strict=True)
        ):
            before, self._layout = self._layout, SkinLayout(drivers, structures)
            self._tell(before, self._layout)

    def _tell(self, before: SkinLayout, after: SkinLayout) -> None:
        old, new = (dict(zip(layout.drivers, layout.structures, strict=True)) for layout in (before, after))
        for name, structure in old.items():
            if name not in new:
                _call(self._on_detach, name, structure)
        for name, structure in new.items():
            if name not in old:
                _call(self._on_attach, name, structure)
            elif old[name] is not structure:
                _call(self._on_structure, name, structure)

    def _attach(self, name: str) -> DriverReader | None:
        inode = segments.living_inode(self.namespace, name)
        refused, again_ns = self._refused.get(name, (None, 0))
        if inode is None or (inode == refused and now_ns() < again_ns):
            return None
        try:
            reader = DriverReader(name, namespace=self.namespace)
        except BadServiceFile:  # not a driver; or memory was short, so that another look is worth it
            self._refused[name] = inode, now_ns() + _REFUSED_FOR_NS
            return None
        except ServiceNotFound:
            return None  # just gone
        if reader.alive and reader.latest is not None:
            return reader
        reader.close()  # another generation came in between
        return None

    @staticmethod
    def _still_there(reader: DriverReader) -> bool:
        if reader.latest is None and reader.alive:
            return True  # it came back and is about to publish
        if reader.structure_changed:
            try:
                reader.reattach()
            except ServiceNotFound:
                return False
            except BadServiceFile as error:
                log.warning("driver %r left the skin: %s", reader.name, str(error))
                return False
        return reader.alive

    def _is_newer(self, known: Snapshot | None) -> bool:
        if known is None or known.layout is not self._layout:
            return True
        return any(
            reader.peek() != frame.position for reader, frame in zip(self._readers.values(), known.frames, strict=True)
        )

    def _snapshot(self) -> Snapshot | None:
        if self._moved_on():
            return None  # between two lives of a driver
        try:
            return Snapshot(self._layout, tuple(reader.take_newest() for reader in self._readers.values()))
        except Overrun:
            return None

    def _why_nothing_came(self) -> str:
        if not self._readers:
            return f"no driver runs in namespace {self.namespace.name!r}; start one (skin-driver --bus ...)"
        return f"no driver of namespace {self.namespace.name!r} published anything newer: {', '.join(self._readers)}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Skin of namespace {self.namespace.name!r}: {', '.join(self._readers) or 'no driver'}>"


def _call(told: Told | None, name: str, structure: Structure) -> None:
    if told is None:
        return
    try:
        told(name, structure)
    except Exception:
        log.exception("what was to be called about driver %r failed; the skin goes on", name)


def _sleep_on(words: list[tuple[futex.Word, int]], until_ns: int) -> None:
    """Sleep until any of the futex words changes or the time comes; may return early."""
    remaining_ns = max(0, until_ns - now_ns())
    if len(words) == 1:
        word, expected = words[0]
        word.wait(expected, remaining_ns)
    elif not words:
        time.sleep(remaining_ns / NS_PER_S)
    elif not futex.wait_any(words[: futex.MAX_WORDS], until_ns):
        time.sleep(min(remaining_ns, _POLL_NS) / NS_PER_S)
