"""One data path of a driver, in numpy or in C: from the batch to the ring, with everything that it has on the way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverReader, DriverWriter
from skinware.memory.namespace import Namespace
from skinware.status import Status
from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters, read_own
from skinware_drivers.decoding.decoder import PATCH_COUNTERS, Decoder, Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Layout
from skinware_drivers.polling import Watch
from skinware_drivers.running.native_path import NativePath
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS, NEVER_NS, Publisher, RequestDesk
from skinware_drivers.testing.waiting import defect
from tests.specification.decoding import SpecifiedDecoder
from tests.specification.publishing import SpecifiedPublisher

Arrays = dict[str, npt.NDArray[Any] | bytes | int | str]
_OF_STATE = (
    "values",
    "status",
    "group_time_ns",
    "updated",
    "touched",
    "patch_time_ns",
    "bus_counters",
    "patch_counters",
)
_OF_PATCHES = ("group_heard_ns", "heard_ns", "lives_until_ns", "state")


@dataclass(frozen=True)
class Publishing:
    """How frames are published.

    Attributes:
        period_s: nominal time between two updates of a module.
        by_cycle: see :class:`Publisher`.
        on_request: likewise.
        slots: of the ring; so many frames are published at once, at the most.
        has_desk: somebody may ask for frames.
    """

    period_s: float = 0.02
    by_cycle: bool = True
    on_request: bool = False
    slots: int = 8
    has_desk: bool = True


class Asking(RequestDesk):
    """Those who wait for frames.

    Attributes:
        waiting: since when each does.
        answered: (oldest data of the frame, its sequence) of each frame that was told of.
    """

    def __init__(self) -> None:
        self.waiting: list[int] = []
        self.answered: list[tuple[int, int]] = []

    @property
    def wanted_ns(self) -> int:
        """Since when the first of them waits; far ahead if nobody does."""
        return min(self.waiting, default=NEVER_NS)

    def published(self, oldest_ns: int, position: tuple[int, int]) -> None:
        self.answered.append((oldest_ns, position[1]))
        self.waiting = [time_ns for time_ns in self.waiting if time_ns > oldest_ns]


class Marking(Watch):
    """Holds every flagged value against its module, and writes down what it was shown."""

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        self.seen: list[bytes] = []

    def look(self, updates: Updates) -> None:
        self.module_status[updates.module[updates.status.any(axis=1)]] |= np.uint8(Status.SUSPECT)
        parts = updates.module, updates.whole, updates.status, updates.oldest_ns, updates.newest_ns, updates.sensors
        self.seen.append(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))


class MarkingAll(Marking):
    """Likewise, but it wants to be shown ten takes of updates also where none is flagged."""

    sees_all = True

    def look(self, updates: Updates) -> None:
        super().look(updates)
        self.sees_all = len(self.seen) < 10


class Way:
    """One of the two paths, from the batch to the ring.

    Attributes:
        batch: to be filled.
        decoder, watch, publisher, desk: as the runner has them.
    """

    decoder_class: type[Decoder] = Decoder
    publisher_class: type[Publisher] = Publisher

    def __init__(
        self,
        name: str,
        layouts: Sequence[Layout | None],
        tables: SkinTables,
        periods_s: Sequence[float],
        publishing: Publishing,
        rows: int,
        watch: Callable[[SkinTables], Watch],
        namespace: Namespace | str | None,
        payload_size: int,
    ) -> None:
        self.decoder = self.decoder_class(layouts, tables, periods_s)
        self.writer = DriverWriter(
            name,
            self.decoder.tables.structure,
            bus_counters=ALL_BUS_COUNTERS,
            patch_counters=PATCH_COUNTERS,
            slots=publishing.slots,
            namespace=namespace,
        )
        self.reader = DriverReader(name, namespace=namespace)
        self.watch = watch(tables)
        self.desk = Asking() if publishing.has_desk else None
        self.publisher = self.publisher_class(
            self.writer,
            self.decoder,
            self.watch,
            publishing.period_s,
            publishing.by_cycle,
            self.desk,
            publishing.on_request,
        )
        self.publisher.buses.counters = [BusCounters() for _ in layouts]
        longest = max((layout.payload_size for layout in layouts if layout is not None), default=8)
        self.batch = FrameBatch(rows, payload_size or longest, self.decoder.compiled.headroom)

    def empty(self) -> None:
        """Empty the batch, but for what waits for partners."""
        raise NotImplementedError

    def digest(self, interrupted: Sequence[int]) -> None:
        """Decode the batch and publish what is due; some buses have lost frames before it."""
        raise NotImplementedError

    def publish_if_due(self, read_ns: int) -> None:
        raise NotImplementedError

    def inside(self) -> Arrays:
        raise NotImplementedError

    def arrays(self) -> Arrays:
        decoder, state, publisher = self.decoder, self.decoder.state, self.publisher
        found: Arrays = {name: getattr(state, name) for name in _OF_STATE}
        found |= {f"patches.{name}": getattr(publisher.patches, name) for name in _OF_PATCHES}
        found["sequence"] = publisher.writer.sequence
        found |= {
            "last sequence numbers": decoder.last_sequence,
            "haste": decoder.haste,
            "unknown_identifiers": decoder.unknown_identifiers,
            "timing": publisher.timing.both,
            "timing, before_ns": publisher.timing.before_ns,
            "bursts.pause_ns": publisher.patches.pause_ns,
            "bursts.gap_ns": publisher.patches.gap_ns,
            "module_status": self.watch.module_status,
            "seen by the watch": repr(getattr(self.watch, "seen", None)),
            "own counters": repr([read_own(counters) for counters in publisher.buses.counters]),
            "desk": repr(vars(self.desk)) if self.desk is not None else "",
            "knows_clock": decoder.knows_clock,
            "clock_stops": decoder.clock_stops,
        }
        for number, cycle in enumerate(decoder.compiled.cycles):
            if cycle.punctuality is not None:
                found[f"cycle {number}, last_ns"] = cycle.punctuality.last_ns
                found[f"cycle {number}, spacings_ns"] = cycle.punctuality.spacings_ns
        for number, samples in enumerate(decoder.samples):
            found[f"bus {number}, samples"] = samples.rows
            found[f"bus {number}, next samples"] = repr(vars(samples)["next_ns"])
        return found | self.inside()

    def frame(self, sequence: int) -> Arrays:
        frame = self.reader._ring.copy(sequence)
        if frame is None:
            defect(f"frame {sequence} is not in the ring")
        found: Arrays = {name: frame.column(name) for name in self.writer.column_offsets()}
        return found | {"acquired_ns": frame.acquired_ns}

    def close(self) -> None:
        self.reader.close()
        self.writer.close()


class NumpyWay(Way):
    """The specification."""

    decoder_class = SpecifiedDecoder
    publisher_class = SpecifiedPublisher
    decoder: SpecifiedDecoder
    publisher: SpecifiedPublisher

    def empty(self) -> None:
        self.decoder.put_back(self.batch)

    def digest(self, interrupted: Sequence[int]) -> None:
        updates, foreign = self.decoder.decode(self.batch, interrupted)
        if len(foreign):
            self.decoder.count_unknown(self.batch, foreign)
        self.publisher.take(updates)

    def publish_if_due(self, read_ns: int) -> None:
        self.publisher.publish_if_due(read_ns)

    def inside(self) -> Arrays:
        kept, held = self.decoder._carried, self.publisher.bursts._held
        none = np.zeros(0, np.int64)
        wire, time_ns, bus = kept if kept is not None else (self.batch.wire[:0], none, none.astype(np.uint16))
        return {
            "carried": wire.tobytes(),
            "carried times": time_ns,
            "carried buses": bus,
            "held": 0 if held is None else len(held),
            "newest_ns": self.decoder.state.newest_ns,
            "deadline_ns": self.publisher.deadline_ns,
        }


class NativeWay(Way):
    """The same in C."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._path = NativePath(self.decoder, self.publisher, self.batch)

    def empty(self) -> None:
        self._path.empty()

    def digest(self, interrupted: Sequence[int]) -> None:
        self._path.digest(interrupted)

    def publish_if_due(self, read_ns: int) -> None:
        self._path.publish_if_due(read_ns)

    def inside(self) -> Arrays:
        words, batch = self._path._words, self.batch
        rows = slice(batch.headroom - words.carried, batch.headroom)
        return {
            "carried": batch.wire[rows].tobytes(),
            "carried times": batch.time_ns[rows],
            "carried buses": batch.bus[rows],
            "held": int(words.n_held),
            "newest_ns": int(words.newest_ns),
            "deadline_ns": self._path.deadline_ns,
        }
