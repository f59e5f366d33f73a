"""The skin as a user sees it: all living drivers of a namespace as one, whatever comes and goes."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Collection, Iterator
from typing import Self

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.drivers import Drivers
from skinware.errors import Closed, ConfigurationError, NamespaceError, Overrun, ServiceNotFound, ServiceTimeout
from skinware.geometry import Geometry
from skinware.memory import futex
from skinware.memory.namespace import Namespace
from skinware.memory.ring_reader import NEWER, NEWEST, Take
from skinware.moments import SkinMoment
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, Periodic, now_ns, short_turns
from skinware.service._reader import Tap
from skinware.skin_layout import SkinLayout
from skinware.snapshot import Snapshot
from skinware.status import age_limit_ns
from skinware.structure import Structure
from skinware.text import nearest_name

log = logging.getLogger("skinware.skin")

_NEVER_NS = 1 << 62

DriverCallback = Callable[[str, Structure], object]
"""Called with a driver's name and a structure."""


class _SkinReader(Tap[DriverSnapshot], DriverReader):
    """A reader of one driver of a skin."""


class Skin:
    """All running drivers of a namespace as one skin; drivers may come and go at any time.

    A driver joins with its first snapshot, and leaves when it stops or dies. The change happens between two snapshots
    of the skin, never within one. Use a skin in one thread at a time.

    An exception in a callback is logged, and reading continues.

    Args:
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        drivers: names of the drivers to read; default: all. The others are not read and do not wake this program.
        types: only drivers with sensors of one of these types; all of their sensors are read. Default: all.
        on_attach: called with a driver's name and structure when it joins, before the first snapshot that has it.
        on_detach: called with its name and last structure when it leaves.
        on_structure: called with its name and new structure when it came back with another one.

    Raises:
        ConfigurationError: a bad namespace name in the environment, or a text where a list of names is needed.
    """

    def __init__(
        self,
        namespace: Namespace | str | None = None,
        *,
        drivers: Collection[str] | None = None,
        types: Collection[str] | None = None,
        on_attach: DriverCallback | None = None,
        on_detach: DriverCallback | None = None,
        on_structure: DriverCallback | None = None,
    ) -> None:
        self.namespace: Namespace = Namespace.of(namespace)
        for names in (drivers, types):
            if isinstance(names, str):
                raise ConfigurationError(f"give a list of names, as [{names!r}], not a text")
        chosen = [*sorted(drivers or ()), *(f"with {name} sensors" for name in sorted(types or ()))]
        self._chosen = f" ({', '.join(chosen)})" if chosen else ""  # for messages
        self._on_attach, self._on_detach, self._on_structure = on_attach, on_detach, on_structure
        self._drivers = Drivers(
            self.namespace,
            _SkinReader,
            drivers,
            wants=lambda reader: types is None or any(one.name in types for one in reader.structure.types),
            only_living=True,
        )
        self._layout = SkinLayout((), ())
        self._in_c: Take[DriverSnapshot] | None = None
        self._latest: Snapshot | None = None  # the one that C waits for newer data than
        self._next_check_ns = 0
        self._closed = False

    @property
    def layout(self) -> SkinLayout:
        """Which drivers there were when this skin was last read or refreshed."""
        return self._layout

    def refresh(self) -> SkinLayout:
        """Look for new and dead drivers now, and return the layout. Reading does so by itself.

        Raises:
            NamespaceError: the namespace cannot be trusted or read.
        """
        self._discover(at_once=True)
        if self._drivers.trouble:
            raise NamespaceError(self._drivers.trouble)
        return self._layout

    def geometry(self, type_name: str) -> Geometry:
        """Return the places of all sensors of a type, in the order of snapshots of the present layout.

        Positions, normals and radii are NaN where a driver has no geometry, or none for that sensor.

        Raises:
            StructureError: no driver has such sensors; before the first ``read`` no driver is known.
        """
        return self._layout.geometry(type_name)

    def reader(self, driver: str) -> DriverReader:
        """Return the reader behind one driver, for its counters and losses.

        Raises:
            ServiceNotFound: no such driver in this skin now.
        """
        try:
            return self._drivers.readers[driver]
        except KeyError:
            others = nearest_name(driver, self._drivers.readers)
            raise ServiceNotFound(f"no driver {driver!r} in this skin now{others}") from None

    def read(
        self,
        *,
        newer_than: Snapshot | None = None,
        max_age_s: float | None = None,
        align: bool = False,
        timeout_s: float | None = 5.0,
    ) -> Snapshot:
        """Return the newest snapshot of every living driver.

        Args:
            newer_than: wait until a driver has published something newer, came or went. Default: take what is
                there, and wait only if there is no driver.
            max_age_s: wait until the newest data of every driver is at most this old; default: of any age.
            align: take from each ring the snapshot nearest to the newest moment that all drivers have reached. A silent
                driver does not hold the moment back. ``Snapshot.spread_s`` is the remaining difference.
            timeout_s: longest wait; None for no limit.

        Raises:
            ServiceTimeout: no driver, nothing newer, or not all young enough in time; the message says which.
            NamespaceError: the namespace cannot be trusted or read.
            Closed: this skin was closed.
        """
        deadline_ns = _NEVER_NS if timeout_s is None else now_ns() + round(timeout_s * NS_PER_S)
        any_will_do = max_age_s is None and not align
        while True:
            slept, snapshot = self._look_in_c(newer_than, deadline_ns) if any_will_do else (False, None)
            if snapshot is not None:
                return snapshot
            if self._closed:
                raise Closed("this skin was closed")
            if now_ns() >= self._next_check_ns or self._moved_on():
                self._discover()
            words = self._drivers.wake_words()
            snapshot = self._look(newer_than, align)
            too_old = [] if snapshot is None or max_age_s is None else _too_old(snapshot, max_age_s)
            if snapshot is not None and not too_old:
                if any_will_do:
                    self._leave_to_c(snapshot)
                return snapshot
            time_ns = now_ns()
            if time_ns >= deadline_ns:
                raise ServiceTimeout(self._why_nothing_came(too_old))
            if not slept:
                futex.sleep_on(words, min(time_ns + WAIT_SLICE_NS, deadline_ns))

    def latest(self) -> Snapshot | None:
        """Return the newest snapshot of every living driver at once; None without any.

        Raises:
            NamespaceError, Closed: as ``read``.
        """
        try:
            return self.read(timeout_s=0.0)
        except ServiceTimeout:
            return None

    def at(self, time_ns: int, *, timeout_s: float = 0.0) -> SkinMoment:
        """Return the skin at a moment of the last second or so, such as the one of a camera's image.

        Each driver's ring holds as many samples as it has slots; an older moment is answered with the oldest, and
        ``SkinMoment.off_s`` says how far it is away.

        Args:
            time_ns: the moment, CLOCK_MONOTONIC ns.
            timeout_s: longest wait for a sample after the moment from every driver that is not silent; 0: do not wait.

        Raises:
            ServiceTimeout: no driver.
            NamespaceError, Closed: as ``read``.
        """
        deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
        snapshot = self.read(timeout_s=timeout_s)
        while True:
            left_ns = deadline_ns - now_ns()
            if left_ns > 0 and _is_to_come(snapshot, time_ns):
                with contextlib.suppress(ServiceTimeout):
                    snapshot = self.read(newer_than=snapshot, timeout_s=left_ns / NS_PER_S)
                continue
            readers = list(self._drivers.readers.values())
            try:
                pairs = [reader.around(time_ns) for reader in readers]
            except Overrun:
                continue
            before, after = (Snapshot(self._layout, tuple(samples)) for samples in zip(*pairs, strict=True))
            return SkinMoment(time_ns, before, after)

    def _look_in_c(self, known: Snapshot | None, deadline_ns: int) -> tuple[bool, Snapshot | None]:
        """Return whether C waited for anything newer, and the snapshot if there is one."""
        if self._in_c is not None and now_ns() >= self._drivers.next_look_ns:
            if self._drivers.look():
                self._discover()
            for reader in self._drivers.readers.values():
                reader.report()
        if self._in_c is None or self._closed or (known is not None and known is not self._latest):
            return False, None
        if known is None:
            samples = self._in_c.next(NEWEST, 0)
        else:
            samples = self._in_c.next(NEWER, min(deadline_ns, self._drivers.next_look_ns) - now_ns())
        if not samples:
            if samples is None:
                self._in_c = None
            return samples is not None, None
        self._latest = Snapshot(self._layout, samples)
        return True, self._latest

    def _leave_to_c(self, snapshot: Snapshot) -> None:
        """Leave the looks after this one to C until something else happens than samples."""
        rings = [reader.ring_in_c() for reader in self._drivers.readers.values()]
        if self._in_c is None or self._in_c.rings != rings:
            self._in_c = Take(rings, is_loop=False) if 1 <= len(rings) <= futex.MAX_WORDS else None
        self._latest = snapshot

    def _look(self, known: Snapshot | None, align: bool) -> Snapshot | None:
        readers = list(self._drivers.readers.values())
        if not readers or self._moved_on():
            return None  # no driver, or between two lives of one
        known_at = None
        if known is not None and known.layout is self._layout:
            known_at = [frame.position for frame in known.samples]
        if known_at == [reader.newest_position for reader in readers]:
            return None
        try:
            samples = _nearest(readers) if align else tuple(reader.newest() for reader in readers)
        except Overrun:
            return None
        if align and known_at == [frame.position for frame in samples]:
            return None
        return Snapshot(self._layout, samples)

    def _moved_on(self) -> bool:
        """Return whether a driver closed, or began another generation; a killed one is found by ``_discover``."""
        return any(reader.moved_on or reader.newest_position is None for reader in self._drivers.readers.values())

    def samples(
        self,
        rate_hz: float | None = None,
        *,
        max_age_s: float | None = None,
        align: bool = False,
        timeout_s: float | None = None,
    ) -> Iterator[Snapshot]:
        """Yield snapshots without end: whenever any driver publishes, or at the deadlines of a rate.

        Args:
            rate_hz: None: whenever any driver publishes. A rate: at its deadlines, what is newest then.
            max_age_s: as for ``read``, for every snapshot.
            align: as for ``read``, for every snapshot.
            timeout_s: longest wait for a snapshot; None for no limit.

        Raises:
            ServiceTimeout, NamespaceError, Closed: as ``read``.
        """
        snapshot: Snapshot | None = None
        if rate_hz is None:
            with short_turns():
                while True:
                    snapshot = self.read(newer_than=snapshot, max_age_s=max_age_s, align=align, timeout_s=timeout_s)
                    yield snapshot
        timer = Periodic(rate_hz)
        while timer.wait(lambda: self._closed):
            yield self.read(max_age_s=max_age_s, align=align, timeout_s=timeout_s)

    def __iter__(self) -> Iterator[Snapshot]:
        return self.samples()

    def stop(self) -> None:
        """End a wait in another thread with ``Closed``, within 50 ms; that thread then closes this skin."""
        self._closed = True

    def close(self) -> None:
        """Detach from all drivers; snapshots stay readable. Idempotent."""
        self._closed = True
        self._drivers.close()
        self._in_c = self._latest = None

    def _discover(self, *, at_once: bool = False) -> None:
        self._next_check_ns = now_ns() + WAIT_SLICE_NS
        for name in list(self._drivers.readers):
            reader = self._drivers.keep_up(name)
            if reader is not None and not reader.alive:
                self._drivers.drop(name)
            elif reader is None and name in self._drivers.unreadable:
                log.warning("driver %r left the skin: %s", name, self._drivers.unreadable[name])
        self._drivers.look(at_once=at_once)
        structures = {name: reader.structure for name, reader in self._drivers.readers.items()}
        before = dict(zip(self._layout.drivers, self._layout.structures, strict=True))
        if structures.keys() != before.keys() or any(before[name] is not one for name, one in structures.items()):
            self._layout, self._in_c = SkinLayout(tuple(structures), tuple(structures.values())), None
            self._call_back(before, structures)

    def _call_back(self, before: dict[str, Structure], after: dict[str, Structure]) -> None:
        calls = [(self._on_detach, name, one) for name, one in before.items() if name not in after]
        for name, structure in after.items():
            if name not in before:
                calls.append((self._on_attach, name, structure))
            elif before[name] is not structure:
                calls.append((self._on_structure, name, structure))
        for callback, name, structure in calls:
            try:
                if callback is not None:
                    callback(name, structure)
            except Exception:
                log.exception("the callback for driver %r failed; the skin goes on", name)

    def _why_nothing_came(self, too_old: list[str]) -> str:
        names = ", ".join(self._drivers.readers)
        if too_old:
            return f"drivers whose data is too old: {', '.join(too_old)} (choose others with Skin(drivers=[...]))"
        if names:
            return f"no driver of namespace {self.namespace.name!r} published anything newer: {names}"
        if self._drivers.trouble:
            return f"no driver{self._chosen} can be read: {self._drivers.trouble}"
        return f"no driver{self._chosen} runs in namespace {self.namespace.name!r}; start one (skin-driver --bus ...)"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Skin of namespace {self.namespace.name!r}: {', '.join(self._drivers.readers) or 'no driver'}>"


def _nearest(readers: list[_SkinReader]) -> tuple[DriverSnapshot, ...]:
    newest_ns = [reader.newest_acquired_ns() for reader in readers]
    time_ns = now_ns()
    reached_ns = [
        newest
        for reader, newest in zip(readers, newest_ns, strict=True)
        if time_ns - newest <= age_limit_ns(reader.period_ns)
    ]
    moment_ns = min(reached_ns or newest_ns)
    return tuple(reader.nearest(moment_ns) for reader in readers)


def _is_to_come(snapshot: Snapshot, time_ns: int) -> bool:
    """Return whether a driver that is not silent has yet to reach a moment."""
    return any(
        frame.acquired_ns <= time_ns and frame.age_ns <= age_limit_ns(frame.period_ns) for frame in snapshot.samples
    )


def _too_old(snapshot: Snapshot, max_age_s: float) -> list[str]:
    ages = zip(snapshot.layout.drivers, (frame.age_ns / NS_PER_S for frame in snapshot.samples), strict=True)
    return [f"{driver} ({age_s:.3g} s)" for driver, age_s in ages if age_s > max_age_s]
