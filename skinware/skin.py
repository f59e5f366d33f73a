"""The skin as a user sees it: all living drivers of a namespace as one, whatever comes and goes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator
from typing import Self

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import (
    BadServiceFile,
    Closed,
    ConfigurationError,
    NamespaceError,
    Overrun,
    ServiceNotFound,
    ServiceTimeout,
)
from skinware.geometry import Geometry
from skinware.memory import futex, segments
from skinware.memory.look import Look, PythonsTurn, look_at
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, Periodic, now_ns, short_turns
from skinware.service._tap import Tap, wake_word_of
from skinware.skin_layout import SkinLayout
from skinware.snapshot import Snapshot
from skinware.status import age_limit_ns
from skinware.structure import Structure

log = logging.getLogger("skinware.skin")

_DISCOVERY_NS = NS_PER_S // 5
_REFUSED_FOR_NS, _NEVER_NS = 10 * NS_PER_S, 1 << 62

DriverCallback = Callable[[str, Structure], object]
"""Called with a driver's name and a structure."""


class _Reader(Tap[DriverSnapshot], DriverReader):
    """A reader of one driver of a skin."""


class Skin:
    """All running drivers of a namespace as one skin; drivers may come and go at any time.

    A driver joins with its first frame, and leaves when it stops or dies. The change happens between two snapshots,
    never within one. Use it in one thread at a time.

    A callback that raises is logged, and everything else goes on.

    Args:
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        drivers: names of the drivers to read. Default: all. The others are not read, and wake nobody.
        types: only drivers with sensors of one of these types; all of their sensors are read. Default: all.
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
        drivers: Collection[str] | None = None,
        types: Collection[str] | None = None,
        on_attach: DriverCallback | None = None,
        on_detach: DriverCallback | None = None,
        on_structure: DriverCallback | None = None,
    ) -> None:
        self.namespace: Namespace = Namespace.of(namespace)
        self._on_attach, self._on_detach, self._on_structure = on_attach, on_detach, on_structure
        self._drivers, self._types = _names(drivers), _names(types)
        self._readers: dict[str, _Reader] = {}
        self._trouble = ""  # why a driver could not be read by this program
        self._refused: dict[str, tuple[tuple[int, int], int]] = {}  # which file, and when to look at it again
        self._layout = SkinLayout((), ())
        self._in_c: Look[DriverSnapshot] | None = None
        self._inodes_in_c: dict[str, int] = {}
        self._latest: Snapshot | None = None  # what C looks for news of
        self._next_discovery_ns = self._next_look_ns = 0
        self._closed = False

    @property
    def layout(self) -> SkinLayout:
        """Which drivers there were when this skin was last read or refreshed."""
        return self._layout

    def refresh(self) -> SkinLayout:
        """Look for new and dead drivers now; the layout then. Reading does so by itself.

        Raises:
            NamespaceError: the namespace cannot be trusted or read.
        """
        self._next_discovery_ns = 0
        self._discover()
        return self._layout

    def geometry(self, type_name: str) -> Geometry:
        """Where every sensor of a type is, as the drivers tell, in the order of snapshots of the present layout.

        Positions, normals and radii are NaN where a driver has no geometry, or none for that sensor.

        Raises:
            StructureError: no driver has such sensors; before the first ``read`` no driver is known.
        """
        return self._layout.geometry(type_name)

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

    def read(
        self,
        *,
        newer_than: Snapshot | None = None,
        max_age_s: float | None = None,
        align: bool = False,
        timeout_s: float | None = 5.0,
    ) -> Snapshot:
        """The newest frame of every living driver.

        Args:
            newer_than: wait until a driver has published something newer, came or went. Default: take what is
                there, and wait only if there is no driver.
            max_age_s: wait until the newest data of every driver is at most this old; default: of any age.
            align: of every driver, of the frames that its ring still holds, the one nearest to one moment: the newest
                that all of them have reached. A driver that has fallen silent does not hold the moment back.
                ``Snapshot.spread_s`` says how near they came.
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
            words, snapshot = self._look(newer_than, align)
            too_old = _too_old(snapshot, max_age_s) if snapshot is not None else []
            if snapshot is not None and not too_old:
                if any_will_do:
                    self._go_on_in_c(snapshot)
                return snapshot
            time_ns = now_ns()
            if time_ns >= deadline_ns:
                raise ServiceTimeout(self._why_nothing_came(too_old))
            if not slept:
                futex.sleep_on(words, min(time_ns + WAIT_SLICE_NS, deadline_ns))

    def _look_in_c(self, known: Snapshot | None, deadline_ns: int) -> tuple[bool, Snapshot | None]:
        """Whether C had a look for anything newer and waited for it, and a snapshot if it found it."""
        time_ns = now_ns()
        if self._in_c is not None and time_ns >= self._next_discovery_ns:
            if self.namespace.service_inodes() == self._inodes_in_c:  # and C asks whether their writers live
                self._next_discovery_ns = time_ns + _DISCOVERY_NS
            else:
                self._discover()
            for reader in self._readers.values():
                reader.tell()
        if self._in_c is None or self._closed or (known is not None and known is not self._latest):
            return False, None
        try:
            frames = self._in_c.newest(None if known is None else min(deadline_ns, self._next_discovery_ns))
        except PythonsTurn:
            self._in_c = None
            return False, None
        if frames is None:
            return True, None
        self._latest = Snapshot(self._layout, frames)
        return True, self._latest

    def _go_on_in_c(self, snapshot: Snapshot) -> None:
        """Leave the looks after this one to C, where there is C, until something else happens than frames."""
        rings = [reader.ring_in_c() for reader in self._readers.values()]
        if self._in_c is None or self._in_c.rings != rings:
            self._in_c = look_at(rings)
            self._inodes_in_c = {name: reader.inode[1] for name, reader in self._readers.items()}
        self._latest = snapshot

    def _look(self, known: Snapshot | None, align: bool) -> tuple[list[tuple[futex.Word, int]], Snapshot | None]:
        if self._closed:
            raise Closed("this skin was closed")
        if now_ns() >= self._next_look_ns or self._moved_on():
            self._discover()
        words = [wake_word_of(reader) for reader in self._readers.values()]
        is_newer = self._readers and self._is_newer(known)
        snapshot = self._snapshot(align) if is_newer else None
        if align and snapshot is not None and known is not None and _same_frames(snapshot, known):
            snapshot = None
        return words, snapshot

    def _moved_on(self) -> bool:
        """Whether a driver has told that it closed, or published something else; who was killed is found by looking."""
        return any(reader.moved_on or reader.latest is None for reader in self._readers.values())

    def frames(
        self,
        rate_hz: float | None = None,
        *,
        max_age_s: float | None = None,
        align: bool = False,
        timeout_s: float | None = None,
    ) -> Iterator[Snapshot]:
        """Snapshots without end: whenever any driver publishes, or at the deadlines of a rate.

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
        return self.frames()

    def stop(self) -> None:
        """End a wait in another thread with ``Closed``, within 50 ms; that thread then closes this skin."""
        self._closed = True

    def close(self) -> None:
        """Detach from all drivers; snapshots stay readable. Idempotent."""
        self._closed = True
        for reader in self._readers.values():
            reader.close()
        self._readers, self._in_c, self._latest = {}, None, None

    def _discover(self) -> None:
        self._next_look_ns = now_ns() + WAIT_SLICE_NS
        for name in [name for name, reader in self._readers.items() if not self._still_there(reader)]:
            self._readers.pop(name).close()
        if now_ns() >= self._next_discovery_ns:
            self._next_discovery_ns = now_ns() + _DISCOVERY_NS
            for name in self.namespace.services():
                reader = self._attach(name) if self._may_join(name) else None
                if reader is not None:
                    self._readers[name] = reader
            self._readers = dict(sorted(self._readers.items()))
        drivers = tuple(self._readers)
        structures = tuple(reader.structure for reader in self._readers.values())
        if drivers != self._layout.drivers or any(
            a is not b for a, b in zip(structures, self._layout.structures, strict=True)
        ):
            before, self._layout, self._in_c = self._layout, SkinLayout(drivers, structures), None
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

    def _may_join(self, name: str) -> bool:
        return name not in self._readers and (self._drivers is None or name in self._drivers)

    def _attach(self, name: str) -> _Reader | None:
        inode = segments.living_inode(self.namespace, name)
        refused, again_ns = self._refused.get(name, (None, 0))
        if inode is None or (inode == refused and now_ns() < again_ns):
            return None
        try:
            reader = _Reader(name, namespace=self.namespace)
        except (BadServiceFile, NamespaceError) as error:  # not a driver; or memory was short: another look is worth it
            self._refused[name] = inode, now_ns() + _REFUSED_FOR_NS
            self._trouble = str(error) if isinstance(error, NamespaceError) else ""
            return None
        except ServiceNotFound:
            return None  # just gone
        self._trouble = ""
        if self._has_wanted(reader) and reader.alive and reader.latest is not None:
            return reader
        reader.close()  # another generation came in between
        return None

    def _has_wanted(self, reader: _Reader) -> bool:
        if self._types is None or any(sensor_type.name in self._types for sensor_type in reader.structure.types):
            return True
        self._refused[reader.name] = reader.inode, _NEVER_NS
        return False

    def _still_there(self, reader: _Reader) -> bool:
        if reader.refresh() is None and reader.alive:
            return True  # it came back and is about to publish
        if reader.structure_changed:
            try:
                reader.reattach()
            except ServiceNotFound:
                return False
            except (BadServiceFile, NamespaceError) as error:
                log.warning("driver %r left the skin: %s", reader.name, str(error))
                return False
            if not self._has_wanted(reader):
                return False
        return reader.alive

    def _is_newer(self, known: Snapshot | None) -> bool:
        if known is None or known.layout is not self._layout:
            return True
        return any(
            reader.latest != frame.position for reader, frame in zip(self._readers.values(), known.frames, strict=True)
        )

    def _snapshot(self, align: bool) -> Snapshot | None:
        if self._moved_on():
            return None  # between two lives of a driver
        readers = list(self._readers.values())
        try:
            frames = _nearest(readers) if align else tuple(reader.newest() for reader in readers)
        except Overrun:
            return None
        return Snapshot(self._layout, frames)

    def _why_nothing_came(self, too_old: list[str]) -> str:
        if too_old:
            return f"drivers whose data is too old: {', '.join(too_old)} (choose others with Skin(drivers=[...]))"
        chosen = [*sorted(self._drivers or ()), *(f"with {name} sensors" for name in sorted(self._types or ()))]
        if not self._readers:
            wanted = f" ({', '.join(chosen)})" if chosen else ""
            if self._trouble:
                return f"no driver{wanted} can be read: {self._trouble}"
            return f"no driver{wanted} runs in namespace {self.namespace.name!r}; start one (skin-driver --bus ...)"
        return f"no driver of namespace {self.namespace.name!r} published anything newer: {', '.join(self._readers)}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Skin of namespace {self.namespace.name!r}: {', '.join(self._readers) or 'no driver'}>"


def _names(given: Collection[str] | None) -> frozenset[str] | None:
    if isinstance(given, str):
        raise ConfigurationError(f"give a list of names, as [{given!r}], not a text")
    return None if given is None else frozenset(given)


def _nearest(readers: list[_Reader]) -> tuple[DriverSnapshot, ...]:
    newest_ns = [reader.newest_acquired_ns() for reader in readers]
    time_ns = now_ns()
    reached_ns = [
        newest
        for reader, newest in zip(readers, newest_ns, strict=True)
        if time_ns - newest <= age_limit_ns(reader.period_ns)
    ]
    moment_ns = min(reached_ns or newest_ns)
    return tuple(reader.nearest(moment_ns) for reader in readers)


def _same_frames(one: Snapshot, other: Snapshot) -> bool:
    return one.layout is other.layout and all(
        a.position == b.position for a, b in zip(one.frames, other.frames, strict=True)
    )


def _too_old(snapshot: Snapshot, max_age_s: float | None) -> list[str]:
    if max_age_s is None:
        return []
    ages = zip(snapshot.layout.drivers, (frame.age_ns / NS_PER_S for frame in snapshot.frames), strict=True)
    return [f"{driver} ({age_s:.3g} s)" for driver, age_s in ages if age_s > max_age_s]


def _call(callback: DriverCallback | None, name: str, structure: Structure) -> None:
    if callback is None:
        return
    try:
        callback(name, structure)
    except Exception:
        log.exception("what was to be called about driver %r failed; the skin goes on", name)
