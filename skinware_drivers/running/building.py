"""Builds the structure of a driver, and all that runs on it, from what is attached to its buses."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from skinware.driver_service import DriverWriter
from skinware.errors import StructureError
from skinware.geometry import Geometry
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.decoding.decoder import PATCH_COUNTERS, Decoder
from skinware_drivers.description import Patch, SkinTables, assemble, join_types, uid_on_bus
from skinware_drivers.layout import Layout
from skinware_drivers.operations import Operation
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.generation import Generation, latency_for, make_watch
from skinware_drivers.running.guard import Ending, hook
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS, Publisher, RequestDesk, offered

log: logging.Logger = logging.getLogger("skinware.driver")

PublishMode = Literal["cycle", "rate", "request"]


@dataclass(frozen=True)
class Identity:
    """How a driver appears to programs.

    Attributes:
        namespace, slots, group: as for :class:`skinware.driver_service.DriverWriter`.
    """

    name: str
    driver_type: str
    listen_only: bool
    namespace: Namespace
    slots: int | None
    group: str | None


class Builder:
    """Builds a new generation whenever what is attached to the buses has changed.

    Args:
        publish, latency_s: as for :class:`.runner.Runner`.
        geometry: where the sensors are; None: as the buses and their adapters say.
        began: called with each new generation.

    Attributes:
        geometry: as given; call ``build`` after a change.
        writer, desk, generation: in service; None before there is a structure.
        built: locked while a generation is built, and notified afterwards.
    """

    def __init__(
        self,
        identity: Identity,
        lines: Sequence[BusLine],
        publish: PublishMode | None,
        latency_s: float | None,
        geometry: Geometry | None,
        ending: Ending,
        began: Callable[[Generation], None],
    ) -> None:
        self._identity, self._lines = identity, lines
        self._publish, self._latency_s = publish, latency_s
        self._ending, self._began = ending, began
        self.geometry = geometry
        self.writer: DriverWriter | None = None
        self.desk: RequestDesk | None = None
        self.generation: Generation | None = None
        self.built = asyncio.Condition()

    async def build(self) -> None:
        """(Re)build once every bus has been asked what is attached to it; if nothing has changed, do nothing.

        Raises:
            DriverError: the driver's own code failed, and nothing has changed.
        """
        async with self.built:
            self.rebuild()

    def rebuild(self, *, forced: bool = False) -> None:
        """Build, with ``built`` held; if forced, also if nothing has changed but the bus behind a name."""
        if any(line.patches is None for line in self._lines):
            return
        adapters = [line.adapter for line in self._lines if line.patches]
        if not adapters:
            if forced and self.generation is not None:  # the sensors stay, without data
                described = self.generation.decoder.compiled.described
                structure = described.structure.replace(buses=[line.name for line in self._lines])
                self._change_to(replace(described, structure=structure))
            return
        try:
            tables = assemble(
                [(line.name, line.patches or ()) for line in self._lines],
                join_types([adapter.types for adapter in adapters]),
                np.result_type(*(adapter.dtype for adapter in adapters)),
            )
            tables = put_in_place(tables, self.geometry, [line.geometry for line in self._lines])
        except StructureError as error:
            log.error("the devices that were found do not form a valid skin: %s", str(error))
            return
        if not forced and self.generation is not None:
            compiled = self.generation.decoder.compiled
            if (compiled.described.structure, compiled.layouts) == (tables.structure, self._layouts):
                return
        self._change_to(tables)
        self.built.notify_all()

    def _change_to(self, described: SkinTables) -> None:
        # the driver's own code comes first: if it fails, nothing has changed
        periods_s = [line.adapter.period_s for line in self._lines]
        decoder = Decoder(self._layouts, described, periods_s)
        structure = decoder.compiled.tables.structure
        watch = make_watch(self._lines, decoder.compiled.tables)
        if self.writer is None:
            self.writer = self._make_writer(decoder.compiled.tables)
        else:
            self.writer.restructure(structure, rate_hz=1 / self._period_s)
            log.info("new generation: %r", structure)
        by_cycle = self._lines[0].adapter.by_cycle if self._publish is None else self._publish != "rate"
        publisher = Publisher(
            self.writer, decoder, watch, self._period_s, by_cycle, self.desk, self._publish == "request"
        )
        latency_s = latency_for(min(self._periods_s)) if self._latency_s is None else self._latency_s
        publisher.latency_ns[:] = round(latency_s * NS_PER_S)
        self.generation = Generation(self._lines, decoder, watch, publisher, self._period_s)
        self._began(self.generation)

    def _make_writer(self, tables: SkinTables) -> DriverWriter:
        identity = self._identity
        writer = DriverWriter(
            identity.name,
            tables.structure,
            driver_type=identity.driver_type,
            bus_counters=ALL_BUS_COUNTERS,
            patch_counters=PATCH_COUNTERS,
            namespace=identity.namespace,
            slots=identity.slots,
            rate_hz=1 / self._period_s,
            operations=offered(self._lines),
        )
        server = writer.request_server()
        self.desk = RequestDesk(server, self._lines, identity.listen_only, self._after_operation, self._ending)
        asyncio.get_running_loop().add_reader(server.fileno(), self._ending.guard(self.desk.take))
        return writer

    @property
    def _layouts(self) -> list[Layout | None]:
        return [line.adapter.layout if line.patches else None for line in self._lines]

    @property
    def _periods_s(self) -> list[float]:
        present = [line for line in self._lines if not line.is_removed] or self._lines
        return [line.adapter.period_s for line in present]

    @property
    def _period_s(self) -> float:
        return max(self._periods_s)

    def _after_operation(self, line: BusLine, patches: Sequence[Patch], operation: Operation) -> None:
        generation = self.generation
        if generation is None:
            return
        if self._period_s != generation.period_s or self._layouts != generation.decoder.compiled.layouts:
            self._change_to(generation.decoder.compiled.described)
            return
        for patch in () if operation.looks else patches:
            if (number := generation.number_of(line, patch)) is not None:
                generation.publisher.patches.counts_from_ns[number] = now_ns()
                if operation.sets_up:
                    with hook("Watch.forget", line.name):
                        generation.watch.forget(number)

    async def close(self) -> None:
        if self.desk is not None and self.writer is not None:
            asyncio.get_running_loop().remove_reader(self.writer.request_server().fileno())
            await self.desk.close()


def put_in_place(tables: SkinTables, given: Geometry | None, of_buses: Sequence[Geometry | None]) -> SkinTables:
    """Return the tables with the places of the sensors; as they are if no place is known.

    Args:
        given: by a person; nothing else counts then.
        of_buses: by the uids that sensors have on their bus, in the order of the driver's buses.
    """
    if given is not None:
        tables = tables.placed(given)
        geometry = tables.structure.geometry
        if geometry is not None and not geometry.known.any():
            log.warning(
                "the geometry has no place for any of the sensors: types and uid in its file are of another skin"
            )
        return tables
    known = []
    for bus, geometry in enumerate(of_buses):
        if geometry is not None:  # each bus has a coordinate frame of its own
            frames = [f"{frame} {bus + 1}" if bus else frame for frame in geometry.frame.tolist()]
            known.append(replace(geometry, uid=uid_on_bus(bus, geometry.uid), frame=np.array(frames, object)))
    placed = tables.placed(Geometry.joined(known)) if known else tables
    geometry = placed.structure.geometry
    return placed if geometry is not None and geometry.known.any() else tables
